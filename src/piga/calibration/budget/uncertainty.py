"""Uncertainty of Type B: effect of the reference, the clock and the thermometer on the coefficients.

First order (JCGM 100, 5.1). Each source is moved by its standard uncertainty in the record. The linear estimate
is repeated with the same weights. The change is the contribution. A source that takes a new value in each
segment is moved in one segment at a time, which gives one change per segment.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from piga.progress import SILENT, Steps
from piga.records.distribution import shape_of, standard_uncertainty
from piga.records.run import Run
from piga.records.run_file import UNCERTAINTY_UNITS, Draw, drawn_for
from piga.records.spool import arrays_like, spans
from piga.results import Result
from piga.stand import stand_changes
from piga.units import G0, from_si

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Source:
    """One source of Type B: name, standard uncertainty in ``unit``, the record moved by it, distribution.

    ``draw`` says how often the source takes a new value. In ``moved`` all segments are moved.
    """

    name: str
    value: float
    unit: str
    moved: Run
    distribution: str = "normal"
    degrees_of_freedom: float = math.inf
    draw: Draw = "reference"


@dataclass(frozen=True, eq=False, repr=False)
class SharedSource(Result):
    """A source of Type B that runs can share.

    ``name`` includes its runs; ``value`` is the standard uncertainty. ``moved`` maps the index of a run to the index
    of its source. ``segments`` is the number of independent draws in its run, or 0 for one common draw.
    """

    name: str
    value: float
    unit: str
    moved: dict[int, int]
    distribution: str = "normal"
    degrees_of_freedom: float = math.inf
    segments: int = 0
    in_fit: bool = False


def sources(run: Run, size: float = 1.0) -> Iterator[Source]:
    """The sources named in the run file's ``[uncertainty]``, moved by ``size`` standard uncertainties.

    ``reference_scale`` multiplies the specific force; ``reference_bias`` adds along X0, Y0 and Z0 (three
    independent sources); ``reference_misalignment`` turns it about X0, Y0 and Z0; ``gravity`` acts as a
    scale, relative to 1 g; ``timing`` stretches the clock; ``temperature`` shifts the thermometer. Uncertain
    servo parameters change the coefficients that the model takes from them. The
    entries of a particular stand (levelling, dividing errors, arm, rate ...) act through its own geometry.
    A ``..._repeatability`` acts like the error of the same name.
    """
    for name, like in UNCERTAINTY_UNITS.items():
        given = getattr(run.uncertainty, name)
        standard = 0.0 if given is None else standard_uncertainty(given, like, f"[uncertainty] {name}")
        if standard == 0.0:
            continue
        value, shape = size * standard, (*shape_of(given), drawn_for(name))
        shown, unit = from_si(standard, like), like
        if name in ("reference_scale", "reference_repeatability", "gravity"):
            relative = value / G0 if name == "gravity" else value
            yield Source(name, shown, unit, _felt(run, partial(_scaled, run.f, 1.0 + relative)), *shape)
        elif name == "timing":
            moved = replace(run, t=_column(run.t, 1.0 + value, 0.0))
            yield Source(name, shown, unit, moved, *shape)
        elif name == "temperature":
            if run.temperature is not None:
                moved = replace(run, temperature=_column(run.temperature, 1.0, value))
                yield Source(name, shown, unit, moved, *shape)
        else:
            move = _bias if name == "reference_bias" else _turn
            for axis, label in enumerate(("X0", "Y0", "Z0")):
                moved = _felt(run, partial(move, run.f, axis, value))
                yield Source(f"{name} {label}", shown, unit, moved, *shape)
    for parameter in run.servo:
        if parameter.standard > 0.0:
            value = parameter.value + size * parameter.standard
            entries = tuple(replace(p, value=value) if p is parameter else p for p in run.servo)
            name = f"servo {parameter.name.replace('_', ' ')}"
            shown = from_si(parameter.standard, parameter.unit)
            known = (parameter.distribution, parameter.degrees_of_freedom)
            yield Source(name, shown, parameter.unit, replace(run, servo=entries), *known)
    for change in stand_changes(run):
        number, _, written_unit = change.written.partition(" ")
        moved = _felt(run, partial(_added, run.f, size, change.change))
        shape = (change.distribution, change.degrees_of_freedom, change.draw)
        yield Source(change.name, float(number), written_unit or "1", moved, *shape)


def _felt(run: Run, moved: Callable[[slice], Array]) -> Run:
    """The run with another specific force: ``moved`` gives it for a slice of rows. On disk when the record is."""
    f = arrays_like(run.t).empty((3, run.size)).T
    for part in spans(run.size):
        f[part] = moved(part)
    return replace(run, f=f)


def _column(values: Array, factor: float, offset: float) -> Array:
    """``factor`` times the values plus ``offset``; on disk when they are."""
    moved: Array = arrays_like(values).empty(values.size)
    for part in spans(values.size):
        moved[part] = values[part] * factor + offset
    return moved


def _scaled(f: Array, factor: float, part: slice) -> Array:
    return f[part] * factor


def _added(f: Array, size: float, change: Callable[[slice], Array], part: slice) -> Array:
    return f[part] + size * change(part)


def _bias(f: Array, axis: int, value: float, part: slice) -> Array:
    moved = f[part].copy()
    moved[:, axis] += value
    return moved


def _turn(f: Array, axis: int, angle: float, part: slice) -> Array:
    """Specific force as seen when the reference is turned by ``angle`` about one axis (first order)."""
    moved = f[part].copy()
    second, third = (axis + 1) % 3, (axis + 2) % 3
    moved[:, second] -= angle * f[part, third]
    moved[:, third] += angle * f[part, second]
    return moved


Estimate = Callable[[Run], Array]
OneByOne = Callable[[Run], Iterable[Array]]


def contributions(
    run: Run, base: Array, estimate: Estimate, one_by_one: OneByOne | None = None, *, steps: Steps = SILENT
) -> Iterator[tuple[Source, Array]]:
    """Change of the coefficients (draws, n; file units) by each source; ``base`` is the unmoved estimate.

    ``estimate`` gives the coefficients of a moved record. ``one_by_one`` gives the coefficients with one segment
    moved at a time; by default it calls ``estimate``. A source has one draw, or one draw per segment. Moved records
    are not kept, because each is as large as the record. ``steps`` hears of each source.
    """
    for number, source in enumerate(sources(run)):
        steps.parts(number, f"adding up the budget: {source.name}")
        if source.draw != "segment":
            moved = [estimate(source.moved)]
        elif one_by_one is not None:
            moved = list(one_by_one(source.moved))
        else:
            moved = [estimate(_in_segment(run, source.moved, s)) for s in range(len(run.labels))]
        changes = np.array(moved) - base
        if source.moved.servo is run.servo or changes.any():
            yield replace(source, moved=run), changes


def _in_segment(run: Run, moved: Run, segment: int) -> Run:
    """The run with the specific force of ``moved`` in one segment."""

    def force(part: slice) -> Array:
        own = run.segment_index[part, None] == segment
        return np.where(own, moved.f[part], run.f[part])

    return _felt(run, force)


def stated_scatter(run: Run) -> Array:
    """Variance [rad^2/s^2] of the mean rate of every segment (m,) by the sources with a new value in each segment.

    It is the sum over these sources of the squared ``K`` times mean change of the axial specific force.
    """
    variance = np.zeros(len(run.labels))
    count = np.bincount(run.segment_index, minlength=variance.size)
    for source in sources(run):
        if source.draw == "segment":
            change = np.zeros(variance.size)
            for part in spans(run.size):
                axial = source.moved.f[part, 0] - run.f[part, 0]
                change += np.bincount(run.segment_index[part], axial, minlength=variance.size)
            variance += (run.scale_factor * change / count) ** 2
    return variance
