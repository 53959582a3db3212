"""Uncertainty of Type B: what the reference, the clock and the thermometer do to the coefficients.

First order (JCGM 100, 5.1): each source is moved by its standard uncertainty in the record and the
linear estimate is repeated with the same weights; the change is the contribution.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from piga.records.distribution import shape_of, standard_uncertainty
from piga.records.run import Run
from piga.records.run_file import UNCERTAINTY_UNITS
from piga.records.spool import arrays_like, spans
from piga.stand import stand_changes
from piga.units import G0, from_si

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Source:
    """One source of Type B: name, standard uncertainty in ``unit``, the record moved by it, distribution."""

    name: str
    value: float
    unit: str
    moved: Run
    distribution: str = "normal"
    degrees_of_freedom: float = math.inf


def sources(run: Run, size: float = 1.0) -> Iterator[Source]:
    """The sources named in the run file's ``[uncertainty]``, moved by ``size`` standard uncertainties.

    ``reference_scale`` multiplies the specific force; ``reference_bias`` adds along X0, Y0 and Z0 (three
    independent sources); ``reference_misalignment`` turns it about X0, Y0 and Z0; ``gravity`` acts as a
    scale, relative to 1 g; ``timing`` stretches the clock; ``temperature`` shifts the thermometer. The
    parameters of the servo move what of the model is known of it; the
    entries of a particular stand (levelling, dividing errors, arm, rate ...) act through its own geometry.
    """
    for name, like in UNCERTAINTY_UNITS.items():
        given = getattr(run.uncertainty, name)
        standard = 0.0 if given is None else standard_uncertainty(given, like, f"[uncertainty] {name}")
        if standard == 0.0:
            continue
        value, shape = size * standard, shape_of(given)
        shown, unit = from_si(standard, like), like
        if name in ("reference_scale", "gravity"):
            relative = value if name == "reference_scale" else value / G0
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
            shape = (parameter.distribution, parameter.degrees_of_freedom)
            yield Source(name, shown, parameter.unit, replace(run, servo=entries), *shape)
    for change in stand_changes(run):
        number, _, written_unit = change.written.partition(" ")
        moved = _felt(run, partial(_added, run.f, size, change.change))
        shape = (change.distribution, change.degrees_of_freedom)
        yield Source(change.name, float(number), written_unit or "1", moved, *shape)


def _felt(run: Run, moved: Callable[[slice], Array]) -> Run:
    """The run with another specific force, ``moved`` of every slice of rows; on disk when the record is."""
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


def contributions(run: Run, base: Array, estimate: Callable[[Run], Array]) -> list[tuple[Source, Array]]:
    """Change of the coefficients (file units) that each source makes; ``base`` is the estimate unmoved.

    The moved records are not kept: each is as large as the record.
    """
    found = []
    for source in sources(run):
        change = estimate(source.moved) - base
        if source.moved.servo is not run.servo and not change.any():
            continue
        found.append((replace(source, moved=run), change))
    return found
