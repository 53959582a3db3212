"""The sources of Type B of a record: those that are stated, those of an assumed size, and those that nobody stated."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.earth import EARTH_RATE, Site
from piga.errors import RunFileError
from piga.records.arrays import norms, scaled, stored
from piga.records.calibration.coefficient import StandSource
from piga.records.run import Run
from piga.records.run_file import (
    ASSUMED_SOURCES,
    UNCERTAINTY_UNITS,
    Draw,
    UncertaintyTable,
    drawn_for,
    standard_uncertainty,
)
from piga.results import Array
from piga.stand import stand_changes
from piga.units import G0, from_si, to_si

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
_INSTEAD = {"gravity": ("reference_scale", "centrifuge")}
"""A source that another key states too, but on one stand: a scale of the reference contains local gravity."""


def catalogue(run: Run) -> dict[str, str]:
    """Sources that exist on the stand of a record, with their units. A record without a stand has a logged reference."""
    stand = run.stand or {}
    parts = stand.get("parts")
    kinds = [part.get("kind") for part in parts] if isinstance(parts, (list, tuple)) else [stand.get("kind")]
    listed: dict[str, str] = {}
    for kind in kinds:
        listed |= _OF_STAND.get(str(kind), LOGGED)
    thermal = run.temperature is not None and any(term.endswith("_T") for term in run.model.terms)
    return listed | ({"temperature": "K"} if thermal else {})


def _is_stated(run: Run, name: str) -> bool:
    """True if ``[uncertainty]`` states a source by its key, or by one that contains it."""
    other, but = _INSTEAD.get(name, (name, ""))
    stand = (run.stand or {}).get("kind")
    names = (name,) if stand == but else (name, other)
    repeated = {
        "levelling": ("levelling_repeatability",),
        "reference_misalignment": ("mounting_repeatability",),
    }
    return any(getattr(run.uncertainty, key) is not None for key in (*names, *repeated.get(name, ())))


def _assumed_sizes(run: Run) -> dict[str, str]:
    """Sources that nobody stated and that have an assumed size, each with its size in words."""
    waived, sizes = run.uncertainty.waived, {}
    if not run.direct and run.base_rate is None and "earth_rate" not in waived and _gravity_alone(run):
        ppm = 1e6 * EARTH_RATE / (run.scale_factor * G0)
        sizes["earth_rate"] = (
            f"no base rate and no site are given: the rotation of the Earth is up to {ppm:.2g} ppm of K, {ppm:.2g} ug"
        )
    if "height" not in waived and run.uncertainty.gravity is None and _unknown_height(run):
        sizes["height"] = (
            f"not stated: {HEIGHT:.0f} m assumed, {1e6 * _GRADIENT * HEIGHT:.3g} ppm of local gravity"
        )
    return sizes


def _gravity_alone(run: Run) -> bool:
    """True if the largest specific force is 1 g: gravity is the reference."""
    return abs(float(norms(run.f).max()) / G0 - 1.0) < _GRAVITY_REFERENCE


def _unknown_height(run: Run) -> bool:
    """True if gravity is computed from a latitude alone."""
    if not run.computed_reference or run.stand is None:
        return False
    parts = run.stand.get("parts")
    tables = parts if isinstance(parts, (list, tuple)) else [run.stand]
    return any("latitude" in table and not {"height", "gravity"} & set(table) for table in tables)


def _assumed(run: Run, size: float) -> Iterator[Source]:
    """Sources with an assumed size: the rotation of the Earth, upwards and across, and the height of the site."""
    sizes = _assumed_sizes(run)
    if "earth_rate" in sizes:
        half = size * EARTH_RATE / math.sqrt(3.0)
        shown = EARTH_RATE / math.sqrt(3.0)
        upwards = scaled(run.f.T, half / G0).T
        across = scaled(upwards.T, 1.0).T
        across[:, 0], across[:, 1] = -upwards[:, 1], upwards[:, 0]
        for name, rate in (("upwards", upwards), ("across", across)):
            fields = {"base_rate": rate}
            yield Source(run, f"earth_rate {name}", shown, "rad/s", "rectangular", fields=fields)
    if "height" in sizes:
        lower = -size * _GRADIENT * HEIGHT
        yield Source(run, "height", HEIGHT, "m", force=partial(_times, lower, partial(_itself, run)))


Force = Callable[[slice], Array]
"""Change of the specific force [m/s^2] in a slice of rows, (n, 3)."""


@dataclass(frozen=True)
class Source:
    """One source of Type B of a run: name, standard uncertainty in ``unit``, distribution, and what it moves.

    ``force`` is the change of the specific force, ``stretch`` the relative change of the clock, ``warmth`` [K] that of the
    thermometer; ``fields`` are other data of the run in place of its own. ``draw`` says how often the source takes a new
    value.
    """

    run: Run
    name: str
    value: float
    unit: str
    distribution: str = "normal"
    degrees_of_freedom: float = math.inf
    draw: Draw = "reference"
    force: Force | None = None
    stretch: float = 0.0
    warmth: float = 0.0
    fields: Mapping[str, Any] = field(default_factory=dict)

    @property
    def moved(self) -> Run:
        """The record moved by the source, in all segments; made anew at each call, because it is as large as the record."""
        run, fields = self.run, dict(self.fields)
        if self.force is not None:
            fields["f"] = stored(run.f + self.force(slice(None)))
        if self.stretch:
            fields["t"] = scaled(run.t, 1.0 + self.stretch)
        if self.warmth and run.temperature is not None:
            fields["temperature"] = scaled(run.temperature, 1.0, self.warmth)
        return replace(run, **fields)


def sources(run: Run, size: float = 1.0) -> Iterator[Source]:
    """The sources named in the run file's ``[uncertainty]``, moved by ``size`` standard uncertainties.

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
        standard, distribution, degrees = standard_uncertainty(given, like, f"[uncertainty] {name}")
        if standard == 0.0:
            continue
        value, shape = size * standard, (distribution, degrees, drawn_for(name))
        whole = partial(Source, run, name, from_si(standard, like), like, *shape)
        if name in ("reference_scale", "reference_repeatability", "gravity"):
            scale = value / G0 if name == "gravity" else value
            yield whole(force=partial(_times, scale, partial(_itself, run)))
        elif name == "timing":
            yield whole(stretch=value)
        elif name == "temperature":
            if run.temperature is not None:
                yield whole(warmth=value)
        elif name == "vibration":
            yield whole(force=partial(_times, value, partial(_along, run, 0)))
        else:
            move = _along if name == "reference_bias" else _about
            for axis, label in enumerate(("X0", "Y0", "Z0")):
                force = partial(_times, value, partial(move, run, axis))
                yield replace(whole(force=force), name=f"{name} {label}")
    yield from _assumed(run, size)
    for parameter in run.servo:
        if parameter.standard > 0.0:
            value = parameter.value + size * parameter.standard
            entries = tuple(replace(p, value=value) if p is parameter else p for p in run.servo)
            name = f"servo {parameter.name.replace('_', ' ')}"
            shown = from_si(parameter.standard, parameter.unit)
            known = (parameter.distribution, parameter.degrees_of_freedom)
            yield Source(run, name, shown, parameter.unit, *known, fields={"servo": entries})
    for change in stand_changes(run):
        number, _, written_unit = change.written.partition(" ")
        shape = (change.distribution, change.degrees_of_freedom, change.draw)
        force = partial(_times, size, change.change)
        yield Source(run, change.name, float(number), written_unit or "1", *shape, force=force)


def _times(size: float, change: Force, part: slice) -> Array:
    return size * change(part)


def _itself(run: Run, part: slice) -> Array:
    """The specific force: times a size, the change by a scale."""
    return np.asarray(run.f[part])


def _along(run: Run, axis: int, part: slice) -> Array:
    """A unit along one axis."""
    return np.broadcast_to(np.eye(3)[axis], run.f[part].shape)


def _about(run: Run, axis: int, part: slice) -> Array:
    """Change of the specific force by a turn of the reference about one axis (first order)."""
    return np.cross(np.eye(3)[axis], run.f[part])


def listed(run: Run) -> tuple[StandSource, ...]:
    """The sources that exist on the stand of a record, each with its status; without their effects."""
    waived, units = run.uncertainty.waived, catalogue(run)
    result = [
        StandSource(
            name,
            "waived" if name in waived else "stated" if _is_stated(run, name) else "unstated",
            unit,
            reason=waived.get(name, ""),
        )
        for name, unit in units.items()
    ]
    result += [StandSource(name, "waived", reason=why) for name, why in waived.items() if name not in units]
    result += [StandSource(name, "assumed", reason=words) for name, words in _assumed_sizes(run).items()]
    return tuple(result)


def with_units(run: Run) -> Run:
    """The record with one unit of each source that is not stated, and no other source.

    Those of a stand that does not describe the record are left out: their effects are not known.
    """
    units = {
        source.name: source.unit if source.unit[0].isdigit() else f"1 {source.unit}"
        for source in listed(run)
        if source.status == "unstated"
    }
    waived = dict.fromkeys(ASSUMED_SOURCES, "not of interest here")
    moved = replace(run, uncertainty=UncertaintyTable(**units, waived=waived))
    try:
        next(stand_changes(moved), None)
    except RunFileError:
        general = {name: unit for name, unit in units.items() if name in UNCERTAINTY_UNITS}
        moved = replace(run, uncertainty=UncertaintyTable(**general, waived=waived))
    return moved


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
