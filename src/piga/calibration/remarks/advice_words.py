"""Words of the advice: what is wrong with the data, and which entry of the run file to change, and how.

A unit 'larger' by a factor makes the same numbers of the file mean that much more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from piga.records.run import Run

SNAP = 0.1
"""Relative distance of the scale factor from a known factor that is taken for it (nominal values are close)."""
AXES = ("X0", "Y0", "Z0")
_ARRAYS = {"reference": "f (wanted in m/s^2)", "time": "t (wanted in s)"}
"""Arguments of ``Run.from_arrays`` by the key of ``[data]``."""
_PLACES = ("first", "second", "third")


@dataclass(frozen=True)
class Factor:
    """A factor between two units; ``units`` (larger, smaller) by the key of ``[data]`` where they are mixed up."""

    value: float
    units: dict[str, tuple[str, str]] = field(default_factory=dict)


FACTORS = (
    Factor(9.80665, {"reference": ("g", "m/s^2")}),
    Factor(1000.0, {"reference": ("g", "mg"), "output": ("rad", "mrad"), "time": ("s", "ms")}),
    Factor(1e6, {"reference": ("g", "ug"), "output": ("rad", "urad"), "time": ("s", "us")}),
    Factor(180.0 / math.pi, {"output": ("rad", "deg")}),
    Factor(3600.0, {"output": ("deg", "arcsec"), "time": ("h", "s")}),
    Factor(648000.0 / math.pi, {"output": ("rad", "arcsec")}),
    Factor(2.0 * math.pi, {"output": ("rev", "rad")}),
    Factor(360.0, {"output": ("rev", "deg")}),
    Factor(4.0),
)
"""Factors of units that are mixed up, and the four edges of a quadrature encoder."""


@dataclass(frozen=True)
class Reading:
    """Another reading of the data: axis of the record behind each base axis, signs, divisor of the output."""

    axes: tuple[int, int, int] = (0, 1, 2)
    signs: tuple[int, int, int] = (1, 1, 1)
    output: float = 1.0

    @property
    def changes(self) -> int:
        """How much of the run file would have to change."""
        moved = sum(axis != place for place, axis in enumerate(self.axes))
        return 2 * moved + 3 * self.signs.count(-1) + (2 if self.output != 1.0 else 0)

    @property
    def negative(self) -> list[str]:
        """Names of the axes whose sign is changed."""
        return [AXES[place] for place, sign in enumerate(self.signs) if sign < 0]

    def words(self) -> str:
        """What is wrong if this reading is right."""
        parts = []
        swapped = [AXES[place] for place, axis in enumerate(self.axes) if axis != place]
        if len(swapped) == 2:
            parts.append(f"{swapped[0]} and {swapped[1]} swapped")
        elif swapped:
            parts.append(f"X0, Y0, Z0 taken from {', '.join(AXES[axis] for axis in self.axes)}")
        if self.negative:
            parts.append(f"{' and '.join(self.negative)} negative")
        if self.output < 0.0:
            parts.append("the output negative")
        elif self.output > 1.0:
            parts.append(f"the output divided by {self.output:.6g}")
        elif self.output < 1.0:
            parts.append(f"the output multiplied by {1.0 / self.output:.6g}")
        return " and ".join(parts) or "the data as they are"

    def remedy(self, run: Run) -> str:
        """What to change in the run file, or in the data, if this reading is right."""
        parts = []
        if self.axes != (0, 1, 2):
            order = ", ".join(_PLACES[axis] for axis in self.axes)
            parts.append(f"in [data] reference list the columns in the order {order}")
        if self.negative:
            parts.append(f"change the sign of {' and '.join(self.negative)} in the data file")
        if self.output < 0.0:
            parts.append("change the sign of the output in the data file")
        elif self.output != 1.0:
            parts.append(
                f"in {_output_unit(run, max(self.output, 1.0 / self.output), larger=self.output < 1.0)}"
            )
        return " and ".join(parts)


def factor_near(ratio: float) -> Factor | None:
    """The factor that a ratio, or its inverse, is next to; None beyond ``SNAP``."""
    ratio = max(ratio, 1.0 / ratio)
    near = min(FACTORS, key=lambda factor: abs(ratio / factor.value - 1.0))
    return near if abs(ratio / near.value - 1.0) < SNAP else None


def better_words(ratio: float, reading: Reading, alike: list[Reading], run: Run) -> str:
    """The data fit far better with a reading; ``alike`` are those that the record cannot tell from it."""
    others = "; ".join(other.words() for other in alike)
    equal = f" (this record cannot tell it from: {others})" if others else ""
    times = f"{float(f'{ratio:.1g}'):.0f}"
    return (
        f"the data fit {times} times better with {reading.words()}{equal}: {reading.remedy(run)}; not applied"
    )


def sign_words(*, output: bool) -> str:
    """The scale factor is negative; ``output``: that of the output may be the wrong sign."""
    what = "X0 of the reference or the output has" if output else "X0 of the reference has"
    return (
        f"the scale factor comes out negative: {what} the wrong sign; change it in the data file; not applied"
    )


def unit_words(ratio: float, factor: Factor, run: Run, *, output: bool) -> str:
    """The scale factor is ``ratio`` times the nominal one; ``output``: the output's unit may be to blame."""
    larger, size = ratio > 1.0, f"{factor.value:.6g}"
    mixed = [(key, factor.units[key]) for key in ("reference", "time") if key in factor.units]
    times = f"{'multiplied' if larger else 'divided'} by {size}"
    if run.source:
        places = [_change(key, units, larger=larger, rate=False) for key, units in mixed]
        if output and ("output" in factor.units or factor.value == 4.0):
            places.append(_output_unit(run, factor.value, larger=not larger))
        places.append(f"[instrument] scale_factor {times}")
    else:
        places = [f"{_ARRAYS[key]} {times}" for key, _ in mixed]
        if output and "output" in factor.units:
            unit = "rad/s" if run.kind == "rate" else "rad"
            places.append(f"output (wanted in {unit}) {'divided' if larger else 'multiplied'} by {size}")
        places.append(f"scale_factor {times}")
    return (
        f"the scale factor comes out {ratio:.4g} times the nominal one, near the factor {size} of mixed-up units: "
        f"right may be {', or '.join(places)}; not applied"
    )


def _output_unit(run: Run, value: float, *, larger: bool) -> str:
    """The change of the output's unit by a factor."""
    if run.resolution > 0.0:
        return f"[instrument] counts_per_revolution {'divided' if larger else 'multiplied'} by {value:.6g}"
    factor = factor_near(value)
    if factor is None or "output" not in factor.units:
        return f"[data] output a unit {value:.6g} times {'larger' if larger else 'smaller'}"
    return _change("output", factor.units["output"], larger=larger, rate=run.kind == "rate")


def _change(key: str, units: tuple[str, str], *, larger: bool, rate: bool) -> str:
    """``[data] key`` with one of two units where it says the other."""
    right, wrong = (f"'{unit}/s'" if rate else f"'{unit}'" for unit in (units if larger else units[::-1]))
    return f"[data] {key} unit = {right} where it says {wrong}"
