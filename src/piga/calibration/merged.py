"""Triangles of runs, solved: one run, or several runs of one instrument together.

Coefficients belong to the instrument, except phases (each power-up has its own zero of the output angle) and
the terms named in ``per_run``. Every run is weighted by its own noise levels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from piga.calibration.intervals import Interval, Repetition, find_interval
from piga.calibration.model.design import Design, Names, ServoState, given_servo, phaseless_columns
from piga.calibration.model.identifiability import Examination, examine_parts, refuse_if_confounded
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.request import harmonics_of, shared_of
from piga.calibration.model.solution import (
    Estimate,
    Layout,
    Owner,
    merged_groups,
    name_parameters,
    solve_parts,
)
from piga.calibration.servo import at_state, state_of
from piga.calibration.weights import RATE, Noise, Positions
from piga.errors import CalibrationError
from piga.records.calibration.coefficient import Coefficient, Level, Number
from piga.records.run import Run
from piga.records.run_file import Draw
from piga.records.terms import GYRO, SERVO_TERMS
from piga.results import Array

_SAME_SERVO = 0.02
"""Largest relative difference of a servo coefficient between runs that is accepted; different rates cause it."""
_STEADY = 1e-3
"""Relative change of the force below which a run of one segment holds one position."""


@dataclass(frozen=True)
class SourceSummary:
    """One source of Type B of a run. Its column in the triangles of the positions is named by its number.

    The column is the change of the observations, less that of the model, by one standard uncertainty of the source. ``in_fit``:
    True if the weights include the source. ``draw`` as in the run file. ``stated``: False for one unit of a source that nobody
    stated.
    """

    name: str
    value: Number
    unit: str
    distribution: str = "normal"
    degrees_of_freedom: Level = math.inf
    known_servo: tuple[tuple[str, Number], ...] = ()
    draw: Draw = "reference"
    in_fit: bool = False
    stated: bool = True


def source_column(number: int) -> str:
    """Name of the column of a source."""
    return f"source {number}"


@dataclass(frozen=True, eq=False, repr=False)
class RunTriangles:
    """Triangles of the positions of one run, and what is needed to solve them.

    Attributes
    ----------
    name:
        Name of the run (unique among runs that are solved together).
    scale_factor, inner_scale_factor:
        Nominal K [(rad/s)/(m/s^2)], and K inside the regressors.
    noise:
        Levels of this run that weigh its rows.
    labels:
        Segment of each phase group (None: one phase for the run).
    positions:
        Triangle ``[columns | rate | sources | y]`` of each position, with its phase group, the variance of its rate, and its
        times. Columns of the servo have no phase.
    ranges:
        Range in which a calibration with this run is valid (SI).
    sources:
        Sources of Type B.
    known_servo:
        Servo coefficients [1/(m/s^2)^2] from the servo parameters of the run file.
    unit:
        Unit of the output rate.
    """

    name: str
    scale_factor: Level
    inner_scale_factor: Level
    noise: Noise
    labels: tuple[str | None, ...]
    positions: tuple[Repetition, ...]
    ranges: dict[str, tuple[Number, Number]]
    sources: tuple[SourceSummary, ...] = ()
    known_servo: tuple[tuple[str, Number], ...] = ()
    unit: str = GYRO

    @classmethod
    def of_rows(
        cls,
        name: str,
        design: Design,
        noise: Noise,
        rows: Sequence[Reduction],
        positions: Positions | None = None,
    ) -> RunTriangles:
        """From a design without phases of the servo, and the triangles of its positions."""
        run = design.run
        return cls(
            name,
            run.scale_factor,
            design.scale_factor,
            noise,
            run.labels if design.per_segment else (None,),
            repetitions(design, noise, rows, positions),
            validity_ranges(run),
            known_servo=tuple(given_servo(run).items()),
            unit=run.unit,
        )

    @cached_property
    def parts(self) -> tuple[Reduction, ...]:
        """Triangle ``[columns | y]`` of each phase group, with the scatter of the positions in its weights."""
        alone = [position.part.without((RATE,), position.variance) for position in self.positions]
        return tuple(merged_groups(alone, tuple(position.group for position in self.positions)))

    @property
    def holds_one_position(self) -> bool:
        """True if the run has one segment in which the force stays the same."""
        ranges = [self.ranges[name] for name in ("a_x", "a_t") if name in self.ranges]
        largest = max((abs(end) for limits in ranges for end in limits), default=0.0)
        steady = all(high - low <= _STEADY * largest for low, high in ranges)
        return steady and (self.positions[0].block or len(self.positions) == 1)

    def weighted(self, noise: Noise) -> Self:
        """The triangles with the variances of the rates that these levels give."""
        variances = noise.rate_variances(len(self.positions)).tolist()
        positions = zip(self.positions, variances, noise.stated_rates(len(variances)), strict=True)
        held = tuple(replace(p, variance=own, stated=known) for p, own, known in positions)
        return replace(self, noise=noise, positions=held)

    @property
    def count(self) -> int:
        """Number of observations."""
        return sum(position.part.count for position in self.positions)

    def columns(self, local: tuple[str, ...], shared: tuple[str, ...]) -> tuple[str, ...]:
        """Names of the wanted columns in this summary. The ``k1`` of another run may be its scale factor."""
        held = self.positions[0].part.names
        return (*local, *("scale_factor" if name == "k1" and "k1" not in held else name for name in shared))

    def choose(
        self, parts: tuple[Reduction, ...], local: tuple[str, ...], shared: tuple[str, ...]
    ) -> list[Reduction]:
        """Parts with only the wanted columns, in the wanted order."""
        held = parts[0].names
        columns = self.columns(local, shared)
        missing = [name for name in columns if name not in held]
        if missing:
            raise CalibrationError(
                f"the summary of run '{self.name}' has no column for {', '.join(missing)}",
                remedy="summarise the run again with these terms",
            )
        if "scale_factor" in held and "scale_factor" not in shared:
            parts = tuple(part.less("scale_factor", self.scale_factor) for part in parts)
        return [part.select(columns) for part in parts]


def repetitions(
    design: Design, noise: Noise, parts: Sequence[Reduction], positions: Positions | None = None
) -> tuple[Repetition, ...]:
    """The positions of a run, with their triangles, as repetitions of the measurement."""
    run, positions = design.run, positions or Positions.of(design.run)
    begin, end = positions.times(run)
    names = [run.labels[k] for k in positions.segments.tolist()]
    if positions.continuous:
        names = [f"{k + 1} of {positions.count}" for k in range(positions.count)]
    variances = noise.rate_variances(positions.count).tolist()
    stated = noise.stated_rates(positions.count)
    columns = zip(parts, positions.segments.tolist(), variances, names, begin, end, stated, strict=True)
    return tuple(
        Repetition(
            part,
            design.groups[segment],
            variance,
            name,
            float(t0),
            float(t1),
            block=positions.continuous,
            stated=known,
        )
        for part, segment, variance, name, t0, t1, known in columns
    )


def validity_ranges(run: Run) -> dict[str, tuple[float, float]]:
    """Range in which the calibration is valid (SI): axial and transverse force, temperature."""
    square = run.f[:, 1] ** 2 + run.f[:, 2] ** 2
    transverse = (math.sqrt(square.min()), math.sqrt(square.max()))
    ranges = {"a_x": (float(run.f[:, 0].min()), float(run.f[:, 0].max())), "a_t": transverse}
    if run.temperature is not None:
        ranges["temperature"] = (float(run.temperature.min()), float(run.temperature.max()))
    return ranges


@dataclass(frozen=True)
class Wish:
    """Request for all runs together: union of their terms, and the terms that may differ between runs."""

    terms: tuple[str, ...]
    per_run: tuple[str, ...]
    own: tuple[tuple[str, ...], ...]

    @classmethod
    def of_one(cls, terms: tuple[str, ...]) -> Wish:
        """The request for one run."""
        return cls(terms, (), (terms,))

    def terms_of(self, index: int) -> tuple[str, ...]:
        """Terms of one run: the common terms, and those ``per_run`` terms that the run asks for."""
        return tuple(t for t in self.terms if t not in self.per_run or t in self.own[index])


@dataclass(frozen=True)
class MergedRuns:
    """Runs to solve together: their request and summaries, the common layout, and the shared columns of every run."""

    wish: Wish
    summaries: tuple[RunTriangles, ...]
    layout: Layout
    shared: tuple[Names, ...]

    @classmethod
    def of(cls, wish: Wish, summaries: Sequence[RunTriangles]) -> MergedRuns:
        """The runs with the layout of their request."""
        shared = tuple(shared_of(wish.terms_of(index)) for index in range(len(summaries)))
        keys: list[tuple[str, str | None]] = []
        for term in shared_of(wish.terms):
            if term in wish.per_run:
                keys += [(term, s.name) for s, own in zip(summaries, shared, strict=True) if term in own]
            else:
                keys.append((term, None))
        tails = []
        for summary, own in zip(summaries, shared, strict=True):
            at = [keys.index((t, summary.name if t in wish.per_run else None)) for t in own]
            tails += [np.array(at, dtype=np.int64)] * len(summary.parts)
        layout = Layout("tan_beta" in wish.terms, harmonics_of(wish.terms), tuple(keys), tuple(tails))
        return cls(wish, tuple(summaries), layout, shared)

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Range in which the result is valid: that of all runs together (SI)."""
        names = dict.fromkeys(name for summary in self.summaries for name in summary.ranges)
        held = {name: [s.ranges[name] for s in self.summaries if name in s.ranges] for name in names}
        return {name: (min(low for low, _ in own), max(high for _, high in own)) for name, own in held.items()}

    @property
    def local(self) -> Names:
        """Columns that turn with the phase of a group."""
        return self.layout.columns[: self.layout.local]

    def first_group(self, index: int) -> int:
        """Number of the first phase group of a run."""
        return sum(len(summary.parts) for summary in self.summaries[:index])

    def run_of(self, group: int) -> int:
        """Number of the run of a phase group."""
        return int(np.searchsorted(np.cumsum([len(s.parts) for s in self.summaries]), group, side="right"))

    def wanted(self, index: int) -> Names:
        """Columns of a run in the fit."""
        return self.summaries[index].columns(self.local, self.shared[index])

    def stored(self, index: int, beside: Names = ()) -> Names:
        """Shared columns of a run, and more, as its summary contains them: those of the servo without a phase."""
        shared = (*self.shared[index], *beside)
        plain = tuple(name for name in shared if name not in SERVO_TERMS)
        return plain + phaseless_columns((*shared, *self.known_servo(index)))

    def known_servo(self, index: int) -> dict[str, float]:
        """K times the servo coefficients that a run gives and that are not estimated."""
        summary = self.summaries[index]
        return {
            name: summary.inner_scale_factor * size
            for name, size in summary.known_servo
            if name not in self.shared[index]
        }

    def _moved_servo(self, index: int) -> dict[str, dict[str, float]]:
        """Changes of ``known_servo`` by each source of a run that moves it, by its column.

        The fit that made the column may have estimated the servo, or had another phase.
        """
        summary, known = self.summaries[index], self.known_servo(index)
        return {
            source_column(number): {
                name: summary.inner_scale_factor * size - known[name]
                for name, size in source.known_servo
                if name in known
            }
            for number, source in enumerate(summary.sources)
            if source.known_servo
        }

    def parts(self, state: ServoState | None) -> list[Reduction]:
        """Summaries of all phase groups; with a state, combined at it."""
        parts: list[Reduction] = []
        for index, summary in enumerate(self.summaries):
            held = summary.choose(summary.parts, self.local, self.stored(index))
            if state is not None:
                wanted, first, known = self.wanted(index), len(parts), self.known_servo(index)
                held = [at_state(part, wanted, state, group, known) for group, part in enumerate(held, first)]
            parts += held
        return parts

    def servo_state(self) -> ServoState | None:
        """State that combines the servo columns in all phase groups; None without servo terms.

        Raises
        ------
        CalibrationError
            If the runs give different parameters of the servo.
        """
        known = [self.known_servo(index) for index in range(len(self.summaries))]
        if not any(known) and not any(name in SERVO_TERMS for names in self.shared for name in names):
            return None
        for index, given in enumerate(known):
            alike = given.keys() == known[0].keys() and all(
                abs(size - known[0][name]) <= _SAME_SERVO * abs(size) for name, size in given.items()
            )
            if not alike:
                first, other = self.summaries[0].name, self.summaries[index].name
                raise CalibrationError(
                    f"run '{first}' and run '{other}' give different parameters of the servo",
                    remedy="write the same [instrument] servo in all run files of an instrument, or in none",
                )
        wanted = [self.wanted(index) for index, summary in enumerate(self.summaries) for _ in summary.parts]
        several = all(len(summary.labels) > 1 for summary in self.summaries)
        return state_of(
            self.layout, self.parts(None), wanted, known[0], per_segment=several, runs=len(self.summaries)
        )

    def solved(self) -> tuple[ServoState | None, Examination, Estimate]:
        """State of the servo columns, examination and estimate.

        Raises
        ------
        CalibrationError
            If a column of a summary is missing, or the runs give different parameters of the servo.
        IdentifiabilityError
            If the runs together cannot separate what is asked.
        """
        state = self.servo_state()
        parts = self.parts(state)
        examination = examine_parts(self.layout, parts)
        refuse_if_confounded(examination, len(self.summaries))
        return state, examination, solve_parts(self.layout, parts)

    def repetitions(self, state: ServoState | None, beside: Names = (RATE,)) -> list[Repetition]:
        """The positions of all runs, with the columns of the fit and those ``beside`` them.

        The blocks of a run that holds one position are one repetition: their scatter does not show that of positions.
        """
        result: list[Repetition] = []
        for index, summary in enumerate(self.summaries):
            held = self.positions(index, state, beside)
            if summary.holds_one_position and len(self.summaries) > 1:
                whole = Reduction.stacked([block.part for block in held])
                held = [replace(held[0], part=whole, name=summary.name, end=held[-1].end, block=False)]
            result += held
        return result

    def positions(self, index: int, state: ServoState | None, beside: Names = (RATE,)) -> list[Repetition]:
        """The positions of one run, with the columns of the fit and those ``beside`` them."""
        summary, first = self.summaries[index], self.first_group(index)
        wanted, known = (*self.wanted(index), *beside), self.known_servo(index)
        stored, moved = self.stored(index, beside), self._moved_servo(index)
        held = summary.choose(tuple(p.part for p in summary.positions), self.local, stored)
        result = []
        for position, part in zip(summary.positions, held, strict=True):
            group = first + position.group
            chosen = part if state is None else at_state(part, wanted, state, group, known, moved)
            name = f"{summary.name}:{position.name}" if summary.name else position.name
            result.append(replace(position, part=chosen, group=group, run=index, name=name))
        return result

    def values_of(self, estimate: Estimate, index: int) -> Array:
        """Coefficients of the columns of a run in each of its phase groups."""
        first, count = self.first_group(index), len(self.summaries[index].labels)
        phases = estimate.phases if self.layout.coupled else np.zeros(first + count)
        return np.array(
            [self.layout.linear(estimate.amplitudes, phases[g], g) for g in range(first, first + count)]
        )

    def design_at(
        self, design: Design, estimate: Estimate, state: ServoState | None, index: int = 0
    ) -> tuple[Design, Array]:
        """A design of a run with its servo columns at the phases of an estimate, and its coefficients in each segment."""
        segments, values = len(design.run.labels), self.values_of(estimate, index)
        if len(values) != segments:
            values = np.tile(values[0], (segments, 1))
        if state is not None:
            first = self.first_group(index)
            own = state.phases[first : first + len(self.summaries[index].labels)]
            state = replace(state, phases=own if len(own) == segments else own * segments)
        return design.with_servo(state), values

    def interval_of(self, estimate: Estimate, state: ServoState | None) -> Interval:
        """Covariance and degrees of freedom of the internal parameters, by the scatter of the positions of all runs."""
        stated = any(summary.noise.stated for summary in self.summaries)
        return find_interval(self.layout, estimate, self.repetitions(state), stated=stated)

    def named(self, estimate: Estimate, covariance: Array) -> tuple[tuple[Coefficient, ...], Array]:
        """Coefficients of all runs in file units, and their covariance, from that of the internal parameters."""
        owners: list[Owner] = []
        if self.layout.coupled:
            owners = [(label, summary.name or None) for summary in self.summaries for label in summary.labels]
        nominal = self.summaries[0].scale_factor
        return name_parameters(
            self.layout, estimate, covariance, nominal, self.wish.terms, owners, self.summaries[0].unit
        )
