"""Coefficients of a calibration for compensation (SI), their range of validity, the flags of rows, and the phase at power-up."""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Container, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels.compensation import data as at
from piga._kernels.compensation import terms as kernels
from piga._kernels.estimation import coupling_columns, innovation_weights, whiten
from piga.errors import CalibrationError
from piga.records.arrays import integrated_rate
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.coefficient import Coefficient
from piga.records.run import Run
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
            a_x=_widened(*span, _RANGE_MARGIN * max(map(abs, span))) if span else (-math.inf, math.inf),
            a_t=float(transverse[1]) * (1.0 + _RANGE_MARGIN) if transverse else math.inf,
            temperature=_widened(*warm, 2.0) if warm else (-math.inf, math.inf),
        )


def _widened(low: float, high: float, least: float) -> tuple[float, float]:
    margin = max(_RANGE_MARGIN * (high - low), least)
    return float(low - margin), float(high + margin)


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


def with_phase(calibration: Calibration, phase: Phase | None) -> Calibration:
    """The calibration with this phase in place of its own; None: as it is."""
    if phase is None:
        return calibration
    kept = [i for i, c in enumerate(calibration.coefficients) if c.name != "phi"]
    coefficients = [calibration.coefficients[i] for i in kept]
    covariance = np.zeros((len(kept) + 1, len(kept) + 1))
    covariance[:-1, :-1], covariance[-1, -1] = calibration.covariance[np.ix_(kept, kept)], phase.std**2
    coefficients.append(Coefficient("phi", phase.value, phase.std, "rad"))
    return replace(calibration, coefficients=tuple(coefficients), covariance=covariance)


@dataclass(frozen=True)
class Model:
    """One instrument for one phase, for the kernels.

    ``instrument``: one record of :class:`piga._kernels.compensation.data.Instrument`. ``needs``: columns that its terms need, of
    temperature and vibration. ``places``: place of each uncertain coefficient in the calibration; ``units``: what one of its
    units there is in the kernels. ``scale``: what the output is multiplied by; it is not 1 for a direct instrument, whose output
    is made a small angle that never turns far.
    """

    instrument: Any
    needs: tuple[str, ...]
    places: NDArray[np.int64]
    units: Array
    scale: float = 1.0

    def check_logged(self, names: Container[str]) -> None:
        """Refuse samples without a column that terms of the calibration need."""
        for name in self.needs:
            if name not in names:
                terms, unit = _LOGGED[name]
                raise CalibrationError(
                    f"the calibration has {terms}, and no {name} is given",
                    remedy=f"add [data] {name} = {{ column = '...', unit = '{unit}' }}, or '{name}' [{unit}] to the samples",
                )


_LOGGED = {"temperature": ("temperature terms", "K"), "vibration": ("the term k2v", "m/s^2")}
"""Columns that terms of the calibration need: the terms, the unit."""


def make_model(
    calibration: Calibration,
    *,
    method: str = "exact",
    segment: str | None = None,
    limits: Limits | None = None,
    typical: float = math.nan,
) -> Model:
    """Take the coefficients of one segment (or the shared ones) from a calibration.

    ``typical`` [s]: the time that a rate sample stands for at the start of a stretch.
    """
    used = _used_coefficients(calibration, segment)
    values = {c.name: c.value * si_factor(c.name) for c in used}
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
    certain = np.diag(calibration.covariance) <= 0.0
    places = np.array(
        [i for i, c in enumerate(calibration.coefficients) if c in used and not certain[i]], np.int64
    )
    uncertain = [calibration.coefficients[i] for i in places]
    codes = [_code(c.name) for c in uncertain]
    units = np.array([si_factor(c.name) * (scale if c.name == "scale_factor" else 1.0) for c in uncertain])
    if max(len(orders), len(codes)) > at.MOST_TERMS:
        raise CalibrationError(
            f"the calibration holds {len(codes)} uncertain coefficients and harmonics of {len(orders)} orders; at most "
            f"{at.MOST_TERMS} of each are supported",
            remedy="calibrate again with fewer terms",
        )
    one, count = instrument[0], len(codes)
    one["waves"], one["uncertain"] = len(orders), count
    for i, n in enumerate(orders):
        one["orders"][i] = n
        one["sines"][i], one["cosines"][i] = (values.get(f"{wave}{n}", 0.0) for wave in "sc")
    one["codes"][:count] = codes
    one["factor"][:count, :count] = _triangle(calibration.covariance[np.ix_(places, places)]) * units
    needs = (
        *["temperature"] * any(name in values for name in THERMAL_TERMS),
        *["vibration"] * ("k2v" in values),
    )
    return Model(instrument, needs, places, units, scale)


def velocity_variance(calibration: Calibration, parts: Iterable[tuple[Model, Array]]) -> float:
    """Variance of a velocity [m^2/s^2] from the sums of its rows (:func:`piga._kernels.compensation.terms.add_to_velocity`).

    ``parts``: a model for each segment, and its sums. The coefficients act on all rows together, the noise of the angle at the
    ends of each stretch only (docs/theory/compensation).
    """
    slope, total, variance = np.zeros(len(calibration.coefficients)), np.zeros(kernels.SUMS), 0.0
    for model, sums in parts:
        total += sums
        slope[model.places] += sums[: model.places.size] * model.units
        p = model.instrument[0]
        gain = sums[kernels.GAIN] / sums[kernels.TIME] if sums[kernels.TIME] > 0.0 else 1.0
        noise = 2.0 * p["white"] * sums[kernels.STRETCHES] + p["walk"] * sums[kernels.TIME]
        variance += gain * float(noise) / float(p["K"]) ** 2
    variance += float(slope @ calibration.covariance @ slope)
    return variance + float(total[kernels.DOUBT] + total[kernels.HIDDEN] ** 2 + total[kernels.DEAD] ** 2)


def phases(calibration: Calibration) -> dict[str | None, Coefficient]:
    """Phases of a calibration by segment (None: shared). Phases of single runs are named by run and segment."""
    return {
        c.segment if c.run is None else f"run {c.owner}": c for c in calibration.coefficients if c.name == "phi"
    }


def _used_coefficients(calibration: Calibration, segment: str | None) -> tuple[Coefficient, ...]:
    shared = tuple(c for c in calibration.coefficients if c.name != "phi")
    differ = sorted({c.name for c in shared if c.run is not None})
    if differ:
        raise CalibrationError(
            f"{', '.join(differ)} differs between the runs of this joint calibration",
            remedy=f"take it as one run sees it: --as-run {calibration.runs[0].name} (in Python Calibration.for_run)",
        )
    by_segment = phases(calibration)
    for name in (None, segment):
        if name in by_segment:
            return (*shared, by_segment[name])
    if not by_segment:
        if any(c.name == "tan_beta" for c in shared):
            raise CalibrationError(
                "the calibration has tan_beta but no phi",
                remedy="calibrate again, or identify the phase at power-up (--identify-phase)",
            )
        return shared
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
        return at.HARMONIC + 2 * wave[1] + (wave[0] == "c")
    return (*at.TERMS, "scale_factor", "tan_beta", "phi").index(name)


def _triangle(covariance: Array) -> Array:
    """A triangular factor R of a covariance R'R that may have directions without variance."""
    size = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(np.linalg.qr(root.T, mode="r")) * size


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
        "vibration near the Nyquist frequency; above 7 times it u_ax contains too little",
    ),
}
FLAGS = {name: bit for name, (bit, _) in _FLAGS.items()}
"""Bit of each flag."""
MEANING = {name: words for name, (_, words) in _FLAGS.items()}
"""Meaning of each flag."""


_LEAST_TURN = 2.0 * math.pi
"""Least turn of the output [rad] before a phase is given (own choice, like the next two)."""
_SERVO_ROUNDS = 4
"""Iterations for the servo's stiffness. Each reduces the error of the phase by the ratio of stiffness to coupling, 1e-2 at most."""
_USELESS = 0.5
"""Largest standard uncertainty [rad] of a phase that is given."""


class PhaseFinder:
    """Find the phase online, chunk by chunk, while the instrument is at rest.

    The fit to the output angle has a constant rate, which takes up ``a_x``, bias and base rotation, and the two
    columns of the coupling, linear in ``cos(phi)`` and ``sin(phi)``. Increments are whitened with the noise levels of
    the calibration, so that the uncertainty is valid (docs/theory/compensation). The effect of the servo is known except
    for the phase: its damping is added to the columns of the coupling; its stiffness turns at twice the angle and is subtracted.

    Parameters
    ----------
    calibration:
        Provides the coupling ``K tan_beta``, first harmonics, servo terms and noise levels.
    """

    def __init__(self, calibration: Calibration) -> None:
        calibration.require_gimbal("the phase at power-up")
        p = self._instrument = make_model(with_phase(calibration, Phase(0.0))).instrument[0]
        if p["tan_beta"] == 0.0 and p["offset_y"] == 0.0 and p["offset_z"] == 0.0:
            raise CalibrationError(
                "the calibration has no cross-coupling: there is no phase to find",
                remedy="leave --identify-phase out",
            )
        self._white, self._walk = max(float(p["white"]), 1e-24), float(p["walk"])
        self._normal = np.zeros((6, 6))
        self._whitener, self._variance = np.zeros(6), 0.0
        self._last: tuple[float, float, float, float] | None = None
        self._turned = 0.0

    def push(self, t: ArrayLike, output: ArrayLike, a_Y: ArrayLike, a_Z: ArrayLike) -> Phase | None:
        """Add samples: time [s], output angle psi [rad], transverse force [m/s^2], each (n,).

        Returns
        -------
        phase:
            The phase from all samples so far; None before one full revolution.
        """
        columns = [np.atleast_1d(np.asarray(c, dtype=float)) for c in (t, output, a_Y, a_Z)]
        if self._last is not None:
            columns = [np.concatenate(([before], c)) for before, c in zip(self._last, columns, strict=True)]
        time, psi, y, z = columns
        self._last = (float(time[-1]), float(psi[-1]), float(y[-1]), float(z[-1]))
        if time.size > 1:
            self._add(time, psi, y, z)
        return self.phase()

    def _add(self, t: Array, psi: Array, y: Array, z: Array) -> None:
        h, turn = np.diff(t), np.diff(psi)
        self._turned += float(np.abs(turn).sum())
        p, K = self._instrument, float(self._instrument["K"])
        coupling = K * p["tan_beta"]
        straight, spent = np.zeros(h.size), float(h.sum())
        v = float(turn.sum()) / (K * spent) if spent > 0.0 else 0.0
        damping, stiffness = K * p["servo_damping"] * v * v, K * p["servo"] * v
        rows, bows = np.empty((6, h.size)), np.zeros((2, h.size))
        rows[0], rows[5] = h, turn
        across = coupling * y + p["offset_y"] - damping * z, coupling * z + p["offset_z"] + damping * y
        coupling_columns(psi, *across, bows, h, straight, 1.0, rows[1:3])
        twice = stiffness * (y * y - z * z), stiffness * 2.0 * y * z
        coupling_columns(psi, *twice, bows, h, straight, 2.0, rows[3:5])
        carry, scale, white = np.empty(h.size), np.empty(h.size), np.empty_like(rows)
        self._variance = innovation_weights(h, self._white, self._walk, self._variance, carry, scale)
        whiten(rows, carry, scale, self._whitener, white)
        self._normal += white @ white.T

    def phase(self) -> Phase | None:
        """The phase from all samples so far; None before one full revolution."""
        if self._turned < _LEAST_TURN:
            return None
        # The rate column is h itself; the coupling columns contain the factor K tan_beta a_t, so p and q are cos and sin.
        matrix = self._normal[:3, :3]
        size = np.sqrt(np.diag(matrix))
        if not size.min() > 0.0:
            return None
        covariance = np.linalg.inv(matrix / np.outer(size, size)) / np.outer(size, size)
        p, q = 1.0, 0.0
        for _ in range(_SERVO_ROUNDS):  # cos and sin of twice the phase times what turns twice as fast
            twice = 2.0 * math.atan2(q, p)
            right = self._normal[:3] @ np.array([0, 0, 0, math.sin(twice), -math.cos(twice), 1.0])
            _, p, q = covariance @ right
        slope = np.array([0.0, -q, p]) / math.hypot(p, q)
        return Phase(math.atan2(q, p), float(np.sqrt(slope @ covariance @ slope)))


def identify_phase(record: Run, calibration: Calibration, duration: float) -> Phase:
    """Phase of a record from its first ``duration`` seconds, or until a new stretch begins. The instrument must be at rest.

    Raises
    ------
    CalibrationError
        If the output does not complete one turn in that time, or the coupling is too weak to determine the phase.
    """
    later = record.t > record.t[0] + duration
    some = slice(0, int(np.argmax(later)) + 1 if later.any() else record.size)
    t, output, begins = record.t[some], record.output[some], record.begins[some]
    y, z = record.f[some, 1], record.f[some, 2]
    rows = t <= t[0] + duration
    starts = np.flatnonzero(begins[1:]) + 1
    if starts.size:
        rows[starts[0] :] = False
    psi = integrated_rate(t, output, begins) if record.kind == "rate" else output
    finder = PhaseFinder(calibration)
    if not (y[rows].any() or z[rows].any()):
        raise CalibrationError(
            f"{record.source}: no transverse specific force in the first {duration:g} s",
            remedy="rest in a position with a_Y or a_Z; without them the coupling is zero",
        )
    phase = finder.push(t[rows], psi[rows], y[rows], z[rows])
    if phase is None:
        raise CalibrationError(
            f"{record.source}: the output does not turn once in the first {duration:g} s",
            remedy="take a longer time at rest",
        )
    if not phase.std < _USELESS:
        raise CalibrationError(
            f"{record.source}: the phase is known to {phase.std:.2g} rad only after {duration:g} s",
            remedy="take a longer time at rest, or an attitude with more transverse specific force",
        )
    return phase
