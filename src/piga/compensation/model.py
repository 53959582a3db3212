"""Coefficients of a calibration for compensation (SI), their range of validity, and the flags of rows."""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga._kernels.compensation import data as at
from piga._kernels.compensation import terms as kernels
from piga.errors import CalibrationError
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.coefficient import Coefficient
from piga.records.terms import harmonic, si_factor
from piga.results import Array
from piga.terms import THERMAL_TERMS

_RANGE_MARGIN = 0.05
"""Margin beyond the calibrated range before a value is flagged, as a share of the range."""


@dataclass(frozen=True)
class Limits:
    """Range in which the calibration is valid; infinite where it is not known.

    Attributes
    ----------
    a_x:
        Lowest and highest specific force along the input axis [m/s^2].
    a_t:
        Largest transverse specific force [m/s^2].
    temperature:
        Lowest and highest temperature [K].
    """

    a_x: tuple[float, float] = (-math.inf, math.inf)
    a_t: float = math.inf
    temperature: tuple[float, float] = (-math.inf, math.inf)

    @staticmethod
    def of(calibration: Calibration) -> Limits:
        """Limits from a calibration record: its ``diagnostics.range``, else from the means of its segments.

        The range has the optional keys ``a_x`` [low, high] and ``a_t`` [low, high] in m/s^2, and
        ``temperature`` [low, high] in K. Each range is widened by ``_RANGE_MARGIN``.
        """
        ranges = calibration.diagnostics.range
        means = [segment.mean_a_x for segment in calibration.segments]
        span = ranges.get("a_x") or ((min(means), max(means)) if len(means) > 2 else None)
        transverse, warm = ranges.get("a_t"), ranges.get("temperature")
        return Limits(
            a_x=_widened(span) if span else (-math.inf, math.inf),
            a_t=float(transverse[1]) * (1.0 + _RANGE_MARGIN) if transverse else math.inf,
            temperature=_widened(warm, 2.0) if warm else (-math.inf, math.inf),
        )


def _widened(span: Any, least: float = 0.0) -> tuple[float, float]:
    low, high = float(span[0]), float(span[1])
    margin = max(
        _RANGE_MARGIN * (high - low), least, _RANGE_MARGIN * max(abs(low), abs(high)) if least == 0.0 else 0.0
    )
    return low - margin, high + margin


def age_flag(calibration: Calibration, max_age_days: float | None) -> int:
    """The ``age`` flag if the calibration is older than ``max_age_days`` or has no readable date; None: any age is accepted."""
    if max_age_days is None:
        return 0
    try:
        made = dt.datetime.fromisoformat(calibration.provenance.created)
    except ValueError:
        return at.AGE
    age = dt.datetime.now(dt.UTC) - (made if made.tzinfo else made.replace(tzinfo=dt.UTC))
    return at.AGE if age.total_seconds() > 86400.0 * max_age_days else 0


_SMALL_K = 1e-9
"""K [(rad/s)/(m/s^2)] that stands for that of a direct instrument: its angles are below all limits of the motion."""


@dataclass(frozen=True)
class Phase:
    """Phase of the output zero [rad] with its standard uncertainty, as identified at power-up."""

    value: float
    std: float = 0.0


@dataclass(frozen=True)
class Model:
    """One instrument for one phase, for the kernels.

    ``instrument``: one record of :class:`piga._kernels.compensation.data.Instrument`. ``needs``: columns that its terms need, of
    temperature and vibration. ``places``: place of each uncertain coefficient in the calibration; -1: a phase that is given, with
    the standard uncertainty ``phase_std`` [rad]. ``scale``: what the output is multiplied by; it is not 1 for a direct instrument,
    whose output is made a small angle that never turns far.
    """

    instrument: Any
    needs: tuple[str, ...]
    places: tuple[int, ...]
    phase_std: float
    scale: float = 1.0


def make_model(
    calibration: Calibration,
    *,
    method: str = "exact",
    segment: str | None = None,
    phase: Phase | None = None,
    limits: Limits | None = None,
    typical: float = math.nan,
) -> Model:
    """Take the coefficients of one segment (or the shared ones) from a calibration.

    ``typical`` [s]: the time that a rate sample stands for at the start of a stretch.
    """
    used = _used_coefficients(calibration, segment, phase)
    values = {c.name: c.value * si_factor(c.name) for c in used}
    if phase is not None:
        values["phi"] = phase.value
    instrument = at.records(1, at.INSTRUMENT)
    for name in at.TERMS:
        instrument[name] = values.get(name, 0.0)
    K = values.get("scale_factor", calibration.scale_factor_nominal)
    scale = _SMALL_K / K if calibration.direct else 1.0
    chosen, T_0 = limits or Limits.of(calibration), calibration.temperature_reference
    low, high = chosen.a_x
    cold, hot = chosen.temperature
    for name, value in {
        "K": K * scale, "per_K": 1.0 / (K * scale), "coupling": K * scale * values.get("tan_beta", 0.0),
        "tan_beta": values.get("tan_beta", 0.0), "phi": values.get("phi", 0.0),
        "offset_y": K * values.get("s1", 0.0), "offset_z": -K * values.get("c1", 0.0),
        "t_0": calibration.time_reference, "T_0": T_0,
        "white": (scale * calibration.angle_rms) ** 2, "walk": (scale * calibration.angle_random_walk) ** 2,
        "low": low, "high": high, "most": chosen.a_t, "cold": cold - T_0, "hot": hot - T_0,
        "has_terms": float(any(values.get(name, 0.0) != 0.0 for name in at.TERMS)),
        "published": float(method == "published"), "typical": typical,
    }.items():  # fmt: skip
        instrument[name] = value
    orders = sorted({wave[1] for name in values if (wave := harmonic(name)) and wave[1] > 1})
    codes, factor, places = _covariance_factor(calibration, used, phase, scale)
    if max(len(orders), codes.size) > at.MOST_TERMS:
        raise CalibrationError(
            f"the calibration holds {codes.size} uncertain coefficients and harmonics of {len(orders)} orders; at most "
            f"{at.MOST_TERMS} of each are supported",
            remedy="calibrate again with fewer terms",
        )
    one = instrument[0]
    one["waves"], one["uncertain"], one["rank"] = len(orders), codes.size, factor.shape[0]
    for i, n in enumerate(orders):
        one["orders"][i] = n
        one["sines"][i], one["cosines"][i] = (values.get(f"{wave}{n}", 0.0) for wave in "sc")
    one["codes"][: codes.size], one["factor"][: factor.shape[0], : codes.size] = codes, factor
    needs = (
        *["temperature"] * any(name in values for name in THERMAL_TERMS),
        *["vibration"] * ("k2v" in values),
    )
    return Model(instrument, needs, places, 0.0 if phase is None else phase.std, scale)


def velocity_variance(calibration: Calibration, parts: Iterable[tuple[Model, Array]]) -> float:
    """Variance of a velocity [m^2/s^2] from the sums of its rows (:func:`piga._kernels.compensation.terms.add_to_velocity`).

    ``parts``: a model for each segment, and its sums. The coefficients act on all rows together, the noise of the angle at the
    ends of each stretch only (docs/theory/compensation).
    """
    slope, given, variance = np.zeros(len(calibration.coefficients)), 0.0, 0.0
    total = np.zeros(kernels.SUMS)
    for model, sums in parts:
        total += sums
        for place, value in zip(model.places, sums, strict=False):
            if place < 0:
                given += value * model.phase_std
            else:
                is_scale = calibration.coefficients[place].name == "scale_factor"
                slope[place] += value * (model.scale if is_scale else 1.0)
        p = model.instrument[0]
        gain = sums[kernels.GAIN] / sums[kernels.TIME] if sums[kernels.TIME] > 0.0 else 1.0
        noise = 2.0 * p["white"] * sums[kernels.STRETCHES] + p["walk"] * sums[kernels.TIME]
        variance += gain * float(noise) / float(p["K"]) ** 2
    slope *= [si_factor(c.name) for c in calibration.coefficients]
    variance += float(slope @ calibration.covariance @ slope) + given**2
    return variance + float(total[kernels.DOUBT] + total[kernels.HIDDEN] ** 2 + total[kernels.DEAD] ** 2)


def phases(calibration: Calibration) -> dict[str | None, Coefficient]:
    """Phases of a calibration by segment (None: shared). Phases of single runs are named by run and segment."""
    return {
        c.segment if c.run is None else f"run {c.owner}": c for c in calibration.coefficients if c.name == "phi"
    }


def _used_coefficients(
    calibration: Calibration, segment: str | None, phase: Phase | None
) -> tuple[Coefficient, ...]:
    shared = tuple(c for c in calibration.coefficients if c.name != "phi")
    if any(c.run is not None for c in shared):
        names = ", ".join(sorted({c.name for c in shared if c.run is not None}))
        raise CalibrationError(
            f"{names} differs between the runs of this joint calibration",
            remedy=f"take it as one run sees it: --as-run {calibration.runs[0].name} (in Python Calibration.for_run)",
        )
    by_segment = phases(calibration)
    if not by_segment:
        if any(c.name == "tan_beta" for c in shared) and phase is None:
            raise CalibrationError(
                "the calibration has tan_beta but no phi",
                remedy="calibrate again, or identify the phase at power-up (--identify-phase)",
            )
        return shared
    if phase is not None:
        return (*shared, Coefficient("phi", phase.value, phase.std, "rad"))
    if None in by_segment:
        return (*shared, by_segment[None])
    if segment in by_segment:
        return (*shared, by_segment[segment])
    have = ", ".join(str(c.owner) for c in list(by_segment.values())[:8])
    wanted = "this record" if segment is None else f"segment '{segment}'"
    raise CalibrationError(
        f"the calibration holds no phase phi for {wanted} (it has per-segment phases: {have})",
        remedy="identify the phase at power-up from a few revolutions at rest (--identify-phase), "
        "or give it with --phase",
    )


def _code(name: str) -> int:
    wave = harmonic(name)
    if wave:
        return at.HARMONIC + 2 * wave[1] + (0 if wave[0] == "s" else 1)
    special = {"scale_factor": at.SCALE_FACTOR, "tan_beta": at.TAN_BETA, "phi": at.PHI}
    return special[name] if name in special else at.TERMS.index(name)


def _covariance_factor(
    calibration: Calibration, used: tuple[Coefficient, ...], phase: Phase | None, output_scale: float
) -> tuple[NDArray[np.int64], Array, tuple[int, ...]]:
    """Codes of the uncertain coefficients in falling order, a triangular factor of their covariance in SI, and their places."""
    index = {c.key: i for i, c in enumerate(calibration.coefficients)}
    count = len(used)
    matrix = np.zeros((count, count))
    inside = [i for i, c in enumerate(used) if phase is None or c.name != "phi"]
    rows = [index[used[i].key] for i in inside]
    matrix[np.ix_(inside, inside)] = calibration.covariance[np.ix_(rows, rows)]
    for i, coefficient in enumerate(used):
        if i not in inside:
            matrix[i, i] = coefficient.std**2
    units = np.array([si_factor(c.name) * (output_scale if c.name == "scale_factor" else 1.0) for c in used])
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    spread = scale > 0.0
    size = scale[spread]
    values, vectors = np.linalg.eigh(matrix[np.ix_(spread, spread)] / np.outer(size, size))
    keep = values > 1e-12
    root = (vectors[:, keep] * np.sqrt(values[keep])) * (size * units[spread])[:, None]
    codes = np.array([_code(c.name) for c, some in zip(used, spread, strict=True) if some], dtype=np.int64)
    places = [index[c.key] if i in inside else -1 for i, c in enumerate(used) if spread[i]]
    order = np.argsort(-codes)
    factor = np.ascontiguousarray(np.linalg.qr(root[order].T, mode="r"))
    return codes[order], factor, tuple(places[i] for i in order)


def check_method(method: str | None, calibration: Calibration) -> str:
    """The requested method, or the one that matches the calibration's ``phase_source``."""
    if method is None:
        return "published" if calibration.phase_source == "input" else "exact"
    if method not in ("exact", "published"):
        raise CalibrationError(f"method: '{method}' is not known", remedy="one of: exact, published")
    return method


_FLAGS = {
    "no_increment": (
        at.NO_INCREMENT,
        "a stretch begins here: the row has no increment, and its dv is set to 0",
    ),
    "locked": (
        at.LOCKED,
        "|a_x| < a_t tan(beta): the output stands still, and a_x is known only to the dead zone",
    ),
    "near_critical": (at.NEAR_CRITICAL, "|a_x| below 1.25 a_t tan(beta): next to the dead zone"),
    "out_of_range": (at.OUT_OF_RANGE, "specific force outside the calibrated range"),
    "temperature": (at.TEMPERATURE, "temperature outside the calibrated range"),
    "age": (at.AGE, "the calibration is older than allowed"),
    "coarse": (at.COARSE, "the output turned by more than 1 rad since the row before"),
    "fault": (at.FAULT, "the instruments of the set contradict each other"),
    "vibration": (
        at.VIBRATION,
        "vibration near the Nyquist frequency: an interval hides part of it; above 7 times it u_ax contains too little",
    ),
}
FLAGS = {name: bit for name, (bit, _) in _FLAGS.items()}
"""Bit of each flag."""
MEANING = {name: words for name, (_, words) in _FLAGS.items()}
"""Meaning of each flag."""
