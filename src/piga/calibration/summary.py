"""Summaries of runs, and their solution: of one run, or of several runs of one instrument together.

A summary has a fixed size: a triangle for each position. Coefficients belong to the instrument, except phases (each power-up
has its own zero of the output angle) and the terms named in ``per_run``. Every run is weighted by its own noise levels. On disk
a summary has the schema ``piga.run-summary/2``: exact, readable, checked when read.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np

from piga.calibration.intervals import Repetition
from piga.calibration.model.design import Design, Names, given_servo
from piga.calibration.model.identifiability import (
    Examination,
    examine_parts,
    refuse_if_confounded,
    refuse_if_servo_alike,
)
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.request import harmonics_of, make_request, shared_of
from piga.calibration.model.solution import (
    PHASELESS,
    Estimate,
    Layout,
    Owner,
    at_phase,
    merged_groups,
    name_parameters,
    phaseless_columns,
    solve_parts,
)
from piga.calibration.sources import SourceSummary, across_squared
from piga.calibration.weights import RATE, Noise, Positions
from piga.errors import CalibrationError
from piga.output import check_results
from piga.records.arrays import spans
from piga.records.calibration.coefficient import Coefficient, Level, Number, StandSource
from piga.records.calibration.diagnostics import Outlier, Quality, SegmentSummary
from piga.records.run import Run
from piga.records.terms import GYRO, SERVO_TERMS, check_name
from piga.results import Array, Result
from piga.text_files import JsonError, converted, json_object, read_whole
from piga.threads import one_thread
from piga.upper import doors

SCHEMA = "piga.run-summary/2"
MOST_SUMMARY_BYTES = 256 << 20
_SAME_SERVO = 0.02
"""Largest relative difference of a servo coefficient between runs that is accepted; different rates cause it."""
_STEADY = 1e-3
"""Relative change of the force below which a run of one segment holds one position."""
CONSTANT = 1e-3
"""Largest relative change of a squared force that counts as constant."""
_FORCE_SAMPLES = 4096
"""Samples used for this."""


def source_column(number: int) -> str:
    """Name of the column of a source."""
    return f"source {number}"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class RunSummary(Result):
    """Data of one run for a calibration alone or with others.

    Attributes
    ----------
    name:
        Name of the run (unique among runs that are solved together).
    serial, kind, unit:
        Serial number of the instrument; kind of the output; unit of the output rate.
    terms, per_run, phases:
        As requested in its run file.
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
    squares:
        ``a_x^2 + a_t^2`` and ``(u_t/K)^2`` [m^2/s^4]; None for one that changes.
    bending:
        Means over the record of ``a_x^2 (u_t/K)^2`` and of ``a_x^2``: by a servo, K changes as their ratio.
    turning:
        True if the regressors depend on K (a base rotation is recorded).
    stand, reference_id:
        Kind of the stand and name of the reference. Runs that agree in both share the errors of the reference.
    undetermined:
        Terms that this run alone cannot determine.
    sources, stand_sources:
        Sources of Type B; those that exist on its stand, and whether they are stated.
    known_servo:
        Servo coefficients [1/(m/s^2)^2] from the servo parameters of the run file.
    quality, segments, figures:
        As in a calibration of this run alone.
    """

    name: str
    serial: str
    kind: str
    unit: str = GYRO
    terms: tuple[str, ...]
    per_run: tuple[str, ...] | None
    phases: str
    scale_factor: Level
    inner_scale_factor: Level
    noise: Noise
    labels: tuple[str | None, ...]
    positions: tuple[Repetition, ...]
    ranges: dict[str, tuple[Number, Number]]
    squares: tuple[Level | None, Level | None]
    bending: tuple[Level, Level]
    temperature_reference: Level
    time_reference: Number
    turning: bool
    stand: str | None
    reference_id: str | None
    undetermined: tuple[str, ...]
    sources: tuple[SourceSummary, ...] = ()
    stand_sources: tuple[StandSource, ...] = ()
    known_servo: tuple[tuple[str, Number], ...] = ()
    quality: Quality
    segments: tuple[SegmentSummary, ...]
    figures: dict[str, Level]
    input_sha256: dict[str, str] = field(default_factory=dict)
    source: str = ""
    software: str = ""
    created: str = ""
    outliers: tuple[Outlier, ...] = ()

    @classmethod
    @one_thread()
    def of(
        cls, run: Run, terms: str | list[str] | tuple[str, ...] | None = None, *, name: str = ""
    ) -> RunSummary:
        """Reduce a run to a summary that contains the columns of all terms.

        Parameters
        ----------
        run:
            The record.
        terms:
            Terms of the fit for the noise levels; default: those of the run file.
        name:
            Name of the run; default: the stem of its run file.

        Raises
        ------
        CalibrationError, ArgumentError
            If the request does not fit the record.
        """
        request = make_request(run, terms, "information")
        summary: RunSummary = doors().reduced_runs().summary_of_all_terms(run, request, name)
        return summary

    @classmethod
    def of_rows(cls, design: Design, noise: Noise, rows: Sequence[Reduction]) -> RunSummary:
        """Triangles of the positions of a run, with what is needed to solve them: no name, no sources, no residuals.

        ``design`` has no phases of the servo.
        """
        run, request = design.run, design.request
        return cls(
            name="",
            serial=run.serial,
            kind=run.kind,
            unit=run.unit,
            terms=request.terms,
            per_run=request.per_run,
            phases=request.phases,
            scale_factor=run.scale_factor,
            inner_scale_factor=design.scale_factor,
            noise=noise,
            labels=run.labels if design.per_segment else (None,),
            positions=repetitions(design, noise, rows),
            ranges=_ranges(run),
            squares=_constant_squares(run),
            bending=_bending(run),
            temperature_reference=request.temperature_reference,
            time_reference=design.time_reference,
            turning=run.base_rate is not None,
            stand=None if run.stand is None else str(run.stand.get("kind")),
            reference_id=run.uncertainty.reference_id,
            undetermined=(),
            known_servo=tuple(given_servo(run).items()),
            quality=run.quality,
            segments=(),
            figures={},
            input_sha256=dict(run.input_sha256),
            source=run.source,
        )

    def to_json(self, path: str | Path) -> None:
        """Write the summary (schema ``piga.run-summary/2``): exact."""
        document = {"schema": SCHEMA} | msgspec.to_builtins(self, enc_hook=lambda array: array.tolist())
        document["phase"] = document.pop("phases")
        text = json.dumps(document, ensure_ascii=False, allow_nan=False)
        Path(path).write_text(text + "\n", encoding="utf-8")

    @staticmethod
    def from_json(path: str | Path) -> RunSummary:
        """Read a summary.

        Raises
        ------
        CalibrationError
            If the file is missing, damaged, or no summary of a known schema; also if its parts do not fit together.
        """
        path = Path(path)
        check_results(path.parent)
        raw = read_whole(path, MOST_SUMMARY_BYTES, "a run summary", CalibrationError)
        try:
            document = json_object(raw)
            kind = document.get("schema")
            if kind != SCHEMA:
                raise CalibrationError(
                    f"{path}: no run summary of schema '{SCHEMA}' (it says: {kind})",
                    remedy="name a run file (.toml), or a summary that --summary wrote",
                )
            document["phases"] = document.pop("phase", None)
            summary = converted(document, RunSummary, lambda _, numbers: np.array(numbers, dtype=np.float64))
        except (JsonError, msgspec.ValidationError) as error:
            raise CalibrationError(
                f"{path}: not a valid run summary: {error}", remedy="summarise the run again"
            ) from None
        damaged = summary._damaged()
        if damaged:
            raise CalibrationError(f"{path}: its {damaged} are damaged", remedy="summarise the run again")
        return summary

    def _damaged(self) -> str:
        """The parts that are not whole or do not fit together; empty if all do."""
        names: set[str] = set()
        for part in (position.part for position in self.positions):
            size, names = len(part.names) + 1, names.union(part.names)
            fits = part.factor.shape == (size, size) and part.count >= 0
            if not (fits and np.isfinite(part.factor).all() and not np.tril(part.factor, -1).any()):
                return "summaries"
        plain = (name for name in names if name not in ("p", "q", RATE, *PHASELESS))
        known = all(name.startswith("source ") or check_name(name) for name in plain)
        if not known or {position.group for position in self.positions} != set(range(len(self.labels))):
            return "summaries"
        return "" if {source_column(k) for k in range(len(self.sources))} <= names else "sources"

    @property
    def holds_one_position(self) -> bool:
        """True if the run has one segment in which the force stays the same."""
        ranges = [self.ranges[name] for name in ("a_x", "a_t") if name in self.ranges]
        largest = max((abs(end) for limits in ranges for end in limits), default=0.0)
        steady = all(high - low <= _STEADY * largest for low, high in ranges)
        return steady and (self.positions[0].block or len(self.positions) == 1)

    @property
    def count(self) -> int:
        """Number of observations."""
        return sum(position.part.count for position in self.positions)

    def weighted(self, noise: Noise) -> RunSummary:
        """The summary with the variances of the rates that these levels give."""
        variances = noise.rate_variances(len(self.positions)).tolist()
        positions = zip(self.positions, variances, noise.stated_rates(len(variances)), strict=True)
        held = tuple(replace(p, variance=own, stated=known) for p, own, known in positions)
        return replace(self, noise=noise, positions=held)


def repetitions(
    design: Design, noise: Noise, parts: Sequence[Reduction], positions: Positions | None = None
) -> tuple[Repetition, ...]:
    """The positions of a run, with their triangles, as repetitions of the measurement."""
    run, positions = design.run, positions or Positions.of(design.run)
    begin, end = positions.times(run)
    names = [run.labels[k] for k in positions.segments.tolist()]
    if positions.continuous:
        names = [f"{k + 1} of {positions.count}" for k in range(positions.count)]
    groups, block = [design.groups[k] for k in positions.segments.tolist()], positions.continuous
    variances, stated = noise.rate_variances(positions.count).tolist(), noise.stated_rates(positions.count)
    columns = zip(parts, groups, variances, names, begin.tolist(), end.tolist(), stated, strict=True)
    return tuple(
        Repetition(part, group, variance, name, t0, t1, block=block, stated=known)
        for part, group, variance, name, t0, t1, known in columns
    )


def _ranges(run: Run) -> dict[str, tuple[float, float]]:
    """Range in which the calibration is valid (SI): axial and transverse force, temperature."""
    square = run.f[:, 1] ** 2 + run.f[:, 2] ** 2
    ranges = {"a_x": (float(run.f[:, 0].min()), float(run.f[:, 0].max()))}
    ranges["a_t"] = (math.sqrt(square.min()), math.sqrt(square.max()))
    if run.temperature is not None:
        ranges["temperature"] = (float(run.temperature.min()), float(run.temperature.max()))
    return ranges


def _given_servo(summaries: Sequence[RunSummary]) -> dict[str, float]:
    """K times the servo coefficients that the runs give; refused if they give different ones."""
    given = [{name: s.inner_scale_factor * size for name, size in s.known_servo} for s in summaries]
    for summary, own in zip(summaries, given, strict=True):
        alike = own.keys() == given[0].keys() and all(
            abs(size - given[0][name]) <= _SAME_SERVO * abs(size) for name, size in own.items()
        )
        if not alike:
            raise CalibrationError(
                f"run '{summaries[0].name}' and run '{summary.name}' give different parameters of the servo",
                remedy="write the same [instrument] servo in all run files of an instrument, or in none",
            )
    return given[0]


def _constant_squares(run: Run) -> tuple[float | None, float | None]:
    """``a_x^2 + a_t^2`` and ``(u_t/K)^2`` [m^2/s^4] of a record; None for one that changes."""
    at = np.unique(np.linspace(0, run.size - 1, _FORCE_SAMPLES).astype(np.int64))
    squares: list[float | None] = []
    for square in ((run.f[at] ** 2).sum(axis=1), across_squared(run, at)):
        low, middle, high = np.quantile(square, (0.005, 0.5, 0.995))
        squares.append(float(middle) if high - low <= CONSTANT * middle else None)
    return squares[0], squares[1]


def _bending(run: Run) -> tuple[float, float]:
    """Means of ``a_x^2 (u_t/K)^2`` and of ``a_x^2``."""
    sums = np.zeros(2)
    for part in spans(run.size):
        along = run.f[part, 0] ** 2
        sums += along @ across_squared(run, part), along.sum()
    return float(sums[0]) / run.size, float(sums[1]) / run.size


@dataclass(frozen=True)
class MergedRuns:
    """Runs to solve together: union of their terms, those with a value in each run, summaries, common layout.

    ``shared`` are the shared columns of every run.
    """

    terms: Names
    per_run: Names
    summaries: tuple[RunSummary, ...]
    layout: Layout
    shared: tuple[Names, ...]

    @classmethod
    def of(cls, summaries: Sequence[RunSummary], terms: Names, per_run: Names = ()) -> MergedRuns:
        """The runs with the layout of the request. A run has those of the ``per_run`` terms that it asks for."""
        steady = tuple(name for name in shared_of(terms) if name not in SERVO_TERMS)
        shared = tuple(tuple(t for t in steady if t not in per_run or t in one.terms) for one in summaries)
        keys: list[tuple[str, str | None]] = []
        for term in steady:
            if term in per_run:
                keys += [(term, s.name) for s, own in zip(summaries, shared, strict=True) if term in own]
            else:
                keys.append((term, None))
        tails = []
        for summary, own in zip(summaries, shared, strict=True):
            at = [keys.index((t, summary.name if t in per_run else None)) for t in own]
            tails += [np.array(at, dtype=np.int64)] * len(summary.labels)
        servo = tuple(name for name in SERVO_TERMS if name in terms)
        given = tuple(item for item in _given_servo(summaries).items() if item[0] not in servo)
        layout = Layout("tan_beta" in terms, harmonics_of(terms), tuple(keys), tuple(tails), servo, given)
        return cls(terms, per_run, tuple(summaries), layout, shared)

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Range in which the result is valid: that of all runs together (SI)."""
        names = dict.fromkeys(name for summary in self.summaries for name in summary.ranges)
        held = {name: [s.ranges[name] for s in self.summaries if name in s.ranges] for name in names}
        return {name: (min(low for low, _ in own), max(high for _, high in own)) for name, own in held.items()}

    def first_group(self, index: int) -> int:
        """Number of the first phase group of a run."""
        return sum(len(summary.labels) for summary in self.summaries[:index])

    def wanted(self, index: int) -> Names:
        """Columns of a run in the fit. The ``k1`` of another run may be its scale factor."""
        held, shared = self.summaries[index].positions[0].part.names, self.shared[index]
        local = self.layout.columns[: self.layout.local]
        return (*local, *("scale_factor" if n == "k1" and "k1" not in held else n for n in shared))

    def _moved_servo(self, index: int) -> dict[str, dict[str, float]]:
        """Changes of the given servo by each source of a run that moves it, by its column.

        The fit that made the column may have estimated the servo, or had another phase.
        """
        summary, given = self.summaries[index], dict(self.layout.given)
        own, scale = dict(summary.known_servo), summary.inner_scale_factor
        return {
            source_column(number): {n: scale * (own[n] - size) for n, size in source.known_servo if n in given}
            for number, source in enumerate(summary.sources)
            if source.known_servo
        }

    def positions(
        self, index: int, estimate: Estimate | None = None, beside: Names = (RATE,)
    ) -> list[Repetition]:
        """The positions of one run, with the columns of the fit and those ``beside`` them, of servo terms at the phase."""
        summary, first, moved = self.summaries[index], self.first_group(index), self._moved_servo(index)
        held, wanted = summary.positions[0].part.names, (*self.wanted(index), *beside)
        plain = tuple(name for name in wanted if name not in SERVO_TERMS)
        missing = [name for name in (*plain, *phaseless_columns(wanted)) if name not in held]
        if missing:
            raise CalibrationError(
                f"the summary of run '{summary.name}' has no column for {', '.join(missing)}",
                remedy="summarise the run again with these terms",
            )
        result = []
        for position in summary.positions:
            part, group = position.part, first + position.group
            if "scale_factor" in held and "scale_factor" not in plain:
                part = part.less("scale_factor", summary.scale_factor)
            phase = float(estimate.phases[group]) if estimate and self.layout.coupled else 0.0
            name = f"{summary.name}:{position.name}" if summary.name else position.name
            part = at_phase(part, wanted, phase, moved)
            result.append(replace(position, part=part, group=group, run=index, name=name))
        return result

    def repetitions(self, estimate: Estimate, beside: Names = (RATE,)) -> list[Repetition]:
        """The positions of all runs, with the columns of the fit and those ``beside`` them.

        The blocks of a run that holds one position are one repetition: their scatter does not show that of positions.
        """
        result: list[Repetition] = []
        for index, summary in enumerate(self.summaries):
            held = self.positions(index, estimate, beside)
            if len(self.summaries) > 1 and summary.holds_one_position:
                whole = Reduction.stacked([block.part for block in held])
                held = [replace(held[0], part=whole, name=summary.name, end=held[-1].end, block=False)]
            result += held
        return result

    def solved(self) -> tuple[Examination, Estimate]:
        """Examination and estimate; an error if the runs cannot separate what is asked."""
        runs = len(self.summaries)
        held = [position for index in range(runs) for position in self.positions(index)]
        alone = [position.part.without((RATE,), position.variance) for position in held]
        parts = merged_groups(alone, tuple(position.group for position in held))
        if self.layout.coupled and self.layout.servo_columns:
            several = all(len(summary.labels) > 1 for summary in self.summaries)
            refuse_if_servo_alike(self.layout, parts, per_segment=several, runs=runs)
            estimate = solve_parts(self.layout, parts)
            examination = examine_parts(self.layout, parts, estimate.phases.tolist())
            refuse_if_confounded(examination, runs)
            return examination, estimate
        examination = examine_parts(self.layout, parts)
        refuse_if_confounded(examination, runs)
        return examination, solve_parts(self.layout, parts)

    def values_of(self, estimate: Estimate, index: int) -> Array:
        """Coefficients of the columns of a run in each of its phase groups."""
        first, count = self.first_group(index), len(self.summaries[index].labels)
        phases = estimate.phases if self.layout.coupled else np.zeros(first + count)
        return np.array(
            [self.layout.linear(estimate.amplitudes, phases[g], g) for g in range(first, first + count)]
        )

    def values_in_segments(self, design: Design, estimate: Estimate, index: int = 0) -> Array:
        """Coefficients of the columns of a design of a run in each of its segments."""
        segments, values = len(design.run.labels), self.values_of(estimate, index)
        return values if len(values) == segments else np.tile(values[0], (segments, 1))

    def named(self, estimate: Estimate, covariance: Array) -> tuple[tuple[Coefficient, ...], Array]:
        """Coefficients of all runs in file units, and their covariance, from that of the internal parameters."""
        owners: list[Owner] = []
        if self.layout.coupled:
            owners = [(label, summary.name or None) for summary in self.summaries for label in summary.labels]
        first = self.summaries[0]
        return name_parameters(
            self.layout, estimate, covariance, first.scale_factor, self.terms, owners, first.unit
        )

    def scale_factor_of(self, estimate: Estimate) -> float:
        """K by an estimate; the nominal one where it is not estimated."""
        keys = self.layout.amplitude_keys
        if ("scale_factor", None) not in keys:
            return self.summaries[0].scale_factor
        return float(estimate.amplitudes[keys.index(("scale_factor", None))])
