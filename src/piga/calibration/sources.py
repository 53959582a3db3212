"""The sources of Type B of a record: those that are stated, those of an assumed size, and those that nobody stated."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.calibration.model.design import given_servo
from piga.earth import EARTH_RATE, Site
from piga.errors import RunFileError
from piga.records.arrays import norms, stored
from piga.records.calibration.coefficient import Level, Number, StandSource
from piga.records.run import Run
from piga.records.run_file import (
    ASSUMED_SOURCES,
    UNCERTAINTY_UNITS,
    Draw,
    UncertaintyTable,
    drawn_for,
    standard_uncertainty,
)
from piga.records.terms import si_factor
from piga.results import Array
from piga.stand import stand_changes
from piga.units import G0, from_si, to_si

SERVO_SOURCE = "servo "
"""Prefix of the names of sources that belong to the instrument."""
HEIGHT = 500.0
"""Standard uncertainty [m] of a height that is not stated."""
_GRADIENT = 3.1e-7
"""Relative change of gravity with height [1/m] (free air)."""
_GRAVITY_REFERENCE = 0.05
"""Largest relative difference of the specific force from 1 g for which gravity is the reference."""

ANY = {"reference_misalignment": "arcsec", "timing": "ppm", "vibration": "ug"}
LOGGED = {"reference_scale": "ppm", "reference_bias": "ug"} | ANY
_OF_STAND: dict[str, dict[str, str]] = {
    "dividing-head": {"gravity": "ug", "levelling": "arcsec", "angle_error": "arcsec", "settling": "arcsec"}
    | ANY,
    "centrifuge": {
        "reference_scale": "ppm",
        "arm_radius": "um",
        "arm_stretch": "1e-9 s^2/rad^2",
        "rate_error": "ppm",
        "gravity": "ug",
        "levelling": "arcsec",
    }
    | ANY,
    "rate-table": {"gravity": "ug", "levelling": "arcsec", "arm_radius": "um", "rate_error": "ppm"} | ANY,
    "vibration-table": {"levelling": "arcsec", "transverse_motion": "ppm", "rocking": "arcsec"} | LOGGED,
}
"""Sources that exist on each stand, by the key of ``[uncertainty]``, with the unit in which they are listed."""
_REPEATED = {
    "levelling": ("levelling_repeatability",),
    "reference_misalignment": ("mounting_repeatability",),
}
"""Keys that state a source with a new value at each position."""
_INSTEAD = {"gravity": ("reference_scale", "centrifuge")}
"""A source that another key states too, but on one stand: a scale of the reference contains local gravity."""


def _stand_tables(run: Run) -> list[dict[str, Any]]:
    """The tables of the stand of a record, one for each of its parts; an empty one without a stand."""
    stand = run.stand or {}
    parts = stand.get("parts")
    return list(parts) if isinstance(parts, (list, tuple)) else [stand]


def _assumed_sizes(run: Run) -> dict[str, str]:
    """Sources that nobody stated and that have an assumed size, each with its size in words."""
    waived, sizes = run.uncertainty.waived, {}
    if not run.direct and run.base_rate is None and "earth_rate" not in waived and _gravity_alone(run):
        ppm = 1e6 * EARTH_RATE / (run.scale_factor * G0)
        sizes["earth_rate"] = (
            f"no base rate and no site are given: the rotation of the Earth is up to {ppm:.2g} ppm of K, {ppm:.2g} ug"
        )
    unknown_height = run.computed_reference and any(
        "latitude" in table and not {"height", "gravity"} & set(table) for table in _stand_tables(run)
    )
    if "height" not in waived and run.uncertainty.gravity is None and unknown_height:
        sizes["height"] = (
            f"not stated: {HEIGHT:.0f} m assumed, {1e6 * _GRADIENT * HEIGHT:.3g} ppm of local gravity"
        )
    return sizes


def _gravity_alone(run: Run) -> bool:
    """True if the largest specific force is 1 g: gravity is the reference."""
    return abs(float(norms(run.f).max()) / G0 - 1.0) < _GRAVITY_REFERENCE


@dataclass(frozen=True)
class SourceSummary:
    """One source of Type B of a run. Its column in the triangles of the positions is named by its number.

    The column is the change of the observations, less that of the model, by one standard uncertainty of the source.
    ``degrees_of_freedom`` None: known exactly. ``in_fit``: True if the weights include the source. ``draw`` as in the run file.
    ``stated``: False for one unit of a source that nobody stated.
    """

    name: str
    value: Number
    unit: str
    distribution: str = "normal"
    degrees_of_freedom: Level | None = None
    known_servo: tuple[tuple[str, Number], ...] = ()
    draw: Draw = "reference"
    in_fit: bool = False
    stated: bool = True


@dataclass(frozen=True)
class Source:
    """A source of a record: by how much it changes the data ``key``, or what replaces data that are no numbers or missing."""

    summary: SourceSummary
    run: Run
    key: str
    change: Callable[[], Any]

    @property
    def moved(self) -> Run:
        """The record moved by the source, in all segments; made anew at each call, because it is as large as the record."""
        values, change = getattr(self.run, self.key), self.change()
        moved: Any = stored(values + change) if isinstance(values, np.ndarray) else change
        return replace(self.run, **{self.key: moved})


def sources(run: Run) -> Iterator[Source]:
    """The sources named in the run file's ``[uncertainty]``, each with the change by one standard uncertainty.

    ``reference_scale`` multiplies the specific force; ``reference_bias`` adds along X0, Y0 and Z0 (three
    independent sources); ``reference_misalignment`` turns it about X0, Y0 and Z0; ``gravity`` acts as a
    scale, relative to 1 g; ``timing`` stretches the clock; ``temperature`` shifts the thermometer. Uncertain
    servo parameters change the coefficients that the model takes from them. The
    entries of a particular stand (levelling, dividing errors, arm, rate ...) act through its own geometry.
    A ``..._repeatability`` acts like the error of the same name. ``vibration`` is a bias along X0. The rate of the Earth and
    the height of the site are sources of an assumed size if nothing says them (docs/theory/calibration).
    """
    for name, like in UNCERTAINTY_UNITS.items():
        given = getattr(run.uncertainty, name)
        if given is None:
            continue
        value, shape, degrees = standard_uncertainty(given, like, f"[uncertainty] {name}")
        if value == 0.0:
            continue
        shown, draw = from_si(value, like), drawn_for(name)
        whole = SourceSummary(name, shown, like, shape, _finite(degrees), draw=draw)
        if name in ("reference_scale", "reference_repeatability", "gravity"):
            share = value / G0 if name == "gravity" else value
            yield Source(whole, run, "f", partial(np.multiply, share, run.f))
        elif name == "timing":
            yield Source(whole, run, "t", partial(np.multiply, value, run.t))
        elif name == "temperature":
            if run.temperature is not None:
                yield Source(whole, run, name, partial(float, value))
        elif name == "vibration":
            yield Source(whole, run, "f", partial(np.array, value * np.eye(3)[0]))
        else:
            for axis, label in zip(value * np.eye(3), ("X0", "Y0", "Z0"), strict=True):
                own = replace(whole, name=f"{name} {label}")
                moved = partial(np.array, axis) if name == "reference_bias" else partial(np.cross, axis, run.f)
                yield Source(own, run, "f", moved)
    yield from _assumed(run)
    for parameter in run.servo:
        if parameter.standard > 0.0:
            value = parameter.value + parameter.standard
            entries = tuple(replace(p, value=value) if p is parameter else p for p in run.servo)
            name = SERVO_SOURCE + parameter.name.replace("_", " ")
            own = SourceSummary(
                name,
                from_si(parameter.standard, parameter.unit),
                parameter.unit,
                parameter.distribution,
                _finite(parameter.degrees_of_freedom),
                tuple(given_servo(replace(run, servo=entries)).items()),
            )
            yield Source(own, run, "servo", partial(tuple, entries))
    for change in stand_changes(run):
        number, _, unit = change.written.partition(" ")
        degrees_of_freedom = _finite(change.degrees_of_freedom)
        own = SourceSummary(
            change.name, float(number), unit or "1", change.distribution, degrees_of_freedom, draw=change.draw
        )
        yield Source(own, run, "f", partial(change.change, slice(None)))


def _assumed(run: Run) -> Iterator[Source]:
    """Sources with an assumed size: the rotation of the Earth, upwards and across, and the height of the site."""
    sizes = _assumed_sizes(run)
    if "earth_rate" in sizes:
        shown = EARTH_RATE / math.sqrt(3.0)
        upwards = shown / G0 * run.f
        across = np.column_stack([-upwards[:, 1], upwards[:, 0], upwards[:, 2]])
        for name, rate in (("upwards", upwards), ("across", across)):
            own = SourceSummary(f"earth_rate {name}", shown, "rad/s", "rectangular")
            yield Source(own, run, "base_rate", partial(stored, rate))
    if "height" in sizes:
        own = SourceSummary("height", HEIGHT, "m")
        yield Source(own, run, "f", partial(np.multiply, -_GRADIENT * HEIGHT, run.f))


def _finite(degrees: float) -> float | None:
    return degrees if math.isfinite(degrees) else None


def stated_scatter(run: Run) -> tuple[float, ...]:
    """Variance [rad^2/s^2] of the mean rate of every segment (m,) by the sources with a new value in each segment.

    It is the sum over these sources of the squared ``K`` times mean change of the axial specific force. Empty without such a
    source.
    """
    variance = np.zeros(len(run.labels))
    count = np.bincount(run.segment_index, minlength=variance.size)
    for source in sources(run):
        if source.summary.draw == "segment":
            axial = source.moved.f[:, 0] - run.f[:, 0]
            change = np.bincount(run.segment_index, axial, minlength=variance.size)
            variance += (run.scale_factor * change / count) ** 2
    return tuple(variance.tolist()) if variance.any() else ()


def listed(run: Run) -> tuple[StandSource, ...]:
    """The sources that exist on the stand of a record, each with its status; without their effects.

    A record without a stand has a logged reference. A source is stated by its key, or by one that contains it.
    """
    waived, units, result = run.uncertainty.waived, dict[str, str](), list[StandSource]()
    for table in _stand_tables(run):
        units |= _OF_STAND.get(str(table.get("kind")), LOGGED)
    if run.temperature is not None and any(term.endswith("_T") for term in run.model.terms):
        units["temperature"] = "K"
    for name, unit in units.items():
        other, but = _INSTEAD.get(name, (name, ""))
        names = (name,) if (run.stand or {}).get("kind") == but else (name, other)
        keys = (*names, *_REPEATED.get(name, ()))
        stated = any(getattr(run.uncertainty, key) is not None for key in keys)
        if name in waived:
            result.append(StandSource(name, "waived", unit, reason=waived[name]))
        else:
            result.append(StandSource(name, "stated" if stated else "unstated", unit))
    result += [StandSource(name, "waived", reason=why) for name, why in waived.items() if name not in units]
    result += [StandSource(name, "assumed", reason=words) for name, words in _assumed_sizes(run).items()]
    return tuple(result)


def units_of(run: Run) -> list[Source]:
    """One unit of each source that nobody stated, and 1 ug/g^3 of a servo, averaged over turns of the output.

    Such a servo lowers the output, as a reference that is as much too large. Sources of a stand that does not describe the
    record are left out: their effects are not known.
    """
    units = {
        source.name: source.unit if source.unit[0].isdigit() else f"1 {source.unit}"
        for source in listed(run)
        if source.status == "unstated"
    }
    waived = dict.fromkeys(ASSUMED_SOURCES, "not of interest here")
    plain = replace(run, servo=(), uncertainty=UncertaintyTable(**units, waived=waived))
    try:
        next(stand_changes(plain), None)
    except RunFileError:
        general = {name: unit for name, unit in units.items() if name in UNCERTAINTY_UNITS}
        plain = replace(plain, uncertainty=UncertaintyTable(**general, waived=waived))
    unstated = [replace(source, run=run) for source in sources(plain)]
    by_servo = SourceSummary("servo", 1.0, "ug/g^3")
    return [*unstated, Source(by_servo, run, "f", partial(_bend, run))]


def _bend(run: Run) -> Array:
    """The change of the specific force by 1 ug/g^3 of a servo, averaged over turns of the output."""
    change = np.zeros_like(run.f)
    change[:, 0] = 1e-6 * si_factor("servo") * run.f[:, 0] * across_squared(run, slice(None))
    return change


def gravity_in_words(run: Run) -> str:
    """The local gravity that the reference contains, and where it comes from; empty if it is not known."""
    stand = run.stand or {}
    if run.computed_reference and "latitude" in stand:
        height = to_si(stand.get("height", 0.0), "m", what="[stand] height")
        site = Site(to_si(stand["latitude"], "rad", what="[stand] latitude"), height=height)
        if "gravity" in stand:
            return f"{to_si(stand['gravity'], 'm/s^2', what='[stand] gravity'):.8g} m/s^2, from [stand] gravity"
        where = f"{height:.0f} m" if "height" in stand else "sea level (the height is not stated)"
        return f"{site.local_gravity:.8g} m/s^2, normal gravity at latitude {stand['latitude']} and {where}"
    if not run.computed_reference and _gravity_alone(run):
        mean = float(norms(run.f).mean())
        if abs(mean / G0 - 1.0) < _GRAVITY_REFERENCE:
            return f"{mean:.8g} m/s^2, mean size of the logged reference"
    return ""


def across_squared(run: Run, at: NDArray[np.int64] | slice) -> Array:
    """``(u_t/K)^2`` [m^2/s^4] at some samples: what bends the servo, specific force less base rate over K across X0."""
    across = run.f[at, 1:]
    if run.base_rate is not None:
        across = across - run.base_rate[at, 1:] / run.scale_factor
    return np.asarray((across**2).sum(axis=1))
