"""A recorded test as plain data in SI, and its time base. Every estimator and compensator works on it.

A *stretch* is a sequence of samples with regular time. Increments are never formed across its ends. Times that repeat,
jump back or leave a gap are detected and counted. Nothing is interpolated.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.errors import ArgumentError
from piga.records.arrays import changes, stored
from piga.records.calibration.diagnostics import Event, Quality, counted
from piga.records.run_file import (
    EstimationTable,
    GivenParameter,
    ModelTable,
    UncertaintyTable,
    check_direct_unit,
    faults_of_waived,
    refuse,
)
from piga.records.terms import GYRO, integral_unit, scale_factor_in
from piga.results import Array, Plotted, Reported, Result, first_lines
from piga.tables import Column, Tabular
from piga.terms import LOGGED_TERMS
from piga.text_files import convert_table
from piga.units import G0, conversion_factor, numbers_are_si, offset_to_si, si_or_text
from piga.upper import doors

if TYPE_CHECKING:
    from types import ModuleType

_LONG_INTERVAL = 1.5
"""A step longer than this many nominal steps is a gap."""
_UNITS = {"f": "m/s^2", "base_rate": "rad/s", "temperature": "K", "vibration": "m/s^2"}
"""SI unit of the arrays beside the output."""


@dataclass(frozen=True, eq=False, repr=False)
class Run(Result, Plotted, Reported, Tabular):
    """One recorded test. Arrays share their length n; everything is SI.

    ``plot()`` shows interval, output and reference against time: three panels.

    Attributes
    ----------
    serial, scale_factor:
        Serial number of the instrument and its nominal K [(rad/s)/(m/s^2); ``unit`` per m/s^2]. Compare it with
        ``cal["scale_factor"].value_si``; ``cal["scale_factor"].value`` is in rad/s/g, the unit of calibration.json.
    t:
        Time [s]. It increases inside a stretch.
    output:
        Output angle psi [rad], unwrapped; or rate [rad/s] when ``kind`` is ``"rate"``. Of a direct instrument: its count,
        or its output in ``unit``.
    f:
        Reference specific force in base axes [m/s^2], shape (n, 3).
    base_rate:
        Inertial angular rate of the base [rad/s], shape (n, 3); None when not recorded.
    temperature:
        [K], or None.
    segment_index, labels:
        Index of the segment of each sample, and the names of the segments. :meth:`segment` cuts them out by name.
    begins:
        True where a stretch begins. No increment ends at such a sample.
    phase_group:
        Group index of each segment. Segments of one group share the unknown zero of the output angle.
    row:
        1-based row in the data file.
    resolution:
        Angle of one count [rad]; 0 if the output is not counted.
    left_out:
        Samples with a wrong output, or None. Their output is replaced by the prediction of the model, and no
        increment ends at them.
    stand:
        The run file's ``[stand]`` table as written, for the uncertainty budget.
    computed_reference:
        True if ``f`` was computed from the stand, not logged.
    servo:
        Known parameters of the servo by name [SI], from the run file's ``[instrument] servo``; empty if none are given.
    unit:
        Unit of the output rate: ``rad/s``, or that of a direct instrument, e.g. ``V`` or ``count/s``.
    """

    serial: str
    scale_factor: float
    kind: str
    t: Array
    output: Array
    f: Array
    base_rate: Array | None
    temperature: Array | None
    segment_index: NDArray[np.int32]
    labels: tuple[str, ...]
    begins: NDArray[np.bool_]
    phase_group: tuple[int, ...]
    row: NDArray[np.int64]
    resolution: float
    quality: Quality
    model: ModelTable = field(default_factory=ModelTable)
    estimation: EstimationTable = field(default_factory=EstimationTable)
    uncertainty: UncertaintyTable = field(default_factory=UncertaintyTable)
    left_out: NDArray[np.bool_] | None = None
    stand: dict[str, Any] | None = None
    computed_reference: bool = False
    servo: tuple[GivenParameter, ...] = ()
    source: str = ""
    input_sha256: dict[str, str] = field(default_factory=dict)
    unit: str = GYRO
    vibration: Array | None = None

    def shows(self, term: str) -> bool:
        """True unless the term needs a column of the log that is missing, or is the same everywhere."""
        column = LOGGED_TERMS.get(term)
        values = None if column is None else getattr(self, column)
        return column is None or (values is not None and float(values.min()) < float(values.max()))

    @property
    def direct(self) -> bool:
        """True for a direct instrument: one without a gimbal."""
        return self.unit != GYRO

    @property
    def quantity(self) -> Literal["angle", "rate", "count"]:
        """What the output is."""
        return "rate" if self.kind == "rate" else "count" if self.direct else "angle"

    @property
    def size(self) -> int:
        """Number of samples."""
        return int(self.t.size)

    @property
    def duration(self) -> float:
        """Sum of the recorded intervals [s], without gaps and moves."""
        return float(np.diff(self.t)[~self.begins[1:]].sum())

    @cached_property
    def median_step(self) -> float:
        """Median interval inside stretches [s]; 0 if there is none."""
        steps = np.diff(self.t)[~self.begins[1:]]
        return float(np.median(steps)) if steps.size else 0.0

    @property
    def output_unit(self) -> str:
        """Unit of ``output``: rad, or rad/s for a rate log; of a direct instrument count, or its ``unit``."""
        return self.unit if self.kind == "rate" else integral_unit(self.unit)

    def table_columns(self, part: slice = slice(None)) -> dict[str, Column]:
        """The samples as a table in SI; ``part`` takes some rows."""
        columns = {"t": Column(self.t[part], "s"), "output": Column(self.output[part], self.output_unit)}
        for letter, vectors, unit in (("f", self.f, "m/s^2"), ("w", self.base_rate, "rad/s")):
            if vectors is not None:
                columns |= {f"{letter}{axis}": Column(vectors[part, i], unit) for i, axis in enumerate("xyz")}
        for name, values in (("temperature", self.temperature), ("vibration", self.vibration)):
            if values is not None:
                columns[name] = Column(values[part], _UNITS[name])
        columns["segment"] = Column(self.segment_index[part].astype(np.int32), "1", self.labels)
        return columns | {"row": Column(self.row[part])}

    def _subject(self) -> ModuleType:
        return doors().shown_record()

    def in_brief(self) -> list[tuple[str, str]]:
        """What ``repr`` shows of the record."""
        findings = ", ".join(f"{event.count} {event.kind}" for event in self.quality.events)
        logged = [name.replace("_", " ") for name in _UNITS if name != "f" and getattr(self, name) is not None]
        return [
            ("instrument", f"{self.serial or 'not named'}, {self.scale_factor * G0:.6g} {self.unit}/g nominal"),
            ("samples", f"{self.size} of {self.quality.rows} rows; output is the {self.quantity}"),
            ("time", f"{self.t[0]:.6g} to {self.t[-1]:.6g} s, {self.duration:.6g} s recorded"),
            ("segments", f"{len(self.labels)}: {', '.join(first_lines(list(self.labels), 9))}"),
            ("beside force", ", ".join(logged) or "nothing"),
            ("findings", findings or "none"),
            ("terms", " ".join(self.model.terms)),
        ]

    @cached_property
    def _edges(self) -> tuple[int, ...]:
        return (0, *(1 + np.flatnonzero(np.diff(self.segment_index))).tolist(), self.size)

    def segment_edges(self) -> NDArray[np.int64]:
        """First sample of each segment, then the number of samples."""
        return np.array(self._edges, dtype=np.int64)

    @classmethod
    def from_arrays(
        cls,
        t: ArrayLike,
        output: ArrayLike,
        f: ArrayLike,
        *,
        scale_factor: float | str,
        units: Mapping[str, str] | Literal["SI"] | None = None,
        kind: str = "angle",
        base_rate: ArrayLike | None = None,
        temperature: ArrayLike | None = None,
        vibration: ArrayLike | None = None,
        segment: ArrayLike | None = None,
        gaps: ArrayLike | None = None,
        resolution: float = 0.0,
        serial: str = "",
        model: ModelTable | dict[str, object] | None = None,
        estimation: EstimationTable | dict[str, object] | None = None,
        uncertainty: UncertaintyTable | dict[str, object] | None = None,
        stand: dict[str, object] | None = None,
        unit: str = GYRO,
    ) -> Run:
        """Make a run from arrays in memory. For counts, or rows with faults, see :meth:`from_dataframe`.

        A stretch begins with each segment and after each gap. A gap is an interval longer than 1.5 times the median
        interval, as in files.

        Parameters
        ----------
        t, output, f:
            Time and output (n,), reference specific force (n, 3).
        scale_factor, kind:
            Nominal K, e.g. ``"0.8884 rad/s/g"``; ``"angle"`` (unwrapped) or ``"rate"``.
        units:
            ``"SI"``: every array, and a plain number as ``scale_factor``, is SI. Or units by argument, e.g.
            ``{"f": "g", "output": "deg"}``: an argument that it does not name is SI, but ``f`` must be named.
        base_rate, temperature, vibration:
            Inertial rate of the base (n, 3), temperature (n,), and root mean square of the vibration along X0 (n,).
        segment:
            Segment of each sample (n,): numbers, or names. A name that returns later is a new segment ``name#2``, as in files.
        gaps:
            True (n,) where a stretch begins, in addition to the gaps of the clock.
        resolution, serial:
            Angle of one count [rad]; serial number.
        model, estimation, uncertainty, stand:
            The tables of the run file, e.g. ``uncertainty={"reference_scale": "10 ppm"}``.
        unit:
            Unit of the output rate of a direct instrument: ``"V"``, ``"mA"`` with kind ``"rate"``; ``"count/s"`` for counts,
            with kind ``"angle"``. A plain ``scale_factor`` is then in this unit per m/s^2.

        Raises
        ------
        ArgumentError
            If the unit of ``f`` is not stated, shapes do not match, a sample is not finite or time does not increase (the
            message names argument and index), or if a table is not valid.
        """
        if unit != GYRO:
            check_direct_unit(unit, "unit")
            if base_rate is not None:
                raise ArgumentError("base_rate: a direct instrument does not add it", remedy="leave it out")
        si, told = units == "SI", {} if units is None or isinstance(units, str) else units
        if not si and "f" not in told:
            raise ArgumentError(
                "f: its unit is not stated", remedy="units='SI' if it is in m/s^2, or e.g. units={'f': 'g'}"
            )
        like = {"t": "s", "output": unit if kind == "rate" else integral_unit(unit)} | _UNITS
        unknown = next((name for name in told if name not in like), None)
        if unknown is not None:
            raise ArgumentError(f"units: there is no argument '{unknown}'", remedy="name arrays, e.g. 'f'")
        named = {"t": t, "output": output, "f": f, "base_rate": base_rate, "temperature": temperature}
        arrays = {
            name: _in_si(name, values, told, like[name])
            for name, values in (named | {"vibration": vibration}).items()
            if values is not None
        }
        t = arrays["t"]
        places, names = _segments(segment, t.size)
        marks = np.zeros(t.size, np.bool_) if gaps is None else np.asarray(gaps, np.bool_)
        for message, remedy in _wrong_arrays(arrays, places, marks, kind):
            raise ArgumentError(message, remedy=remedy)
        row = np.arange(1, t.size + 1, dtype=np.int64)
        base = examine_time(t, places, row)
        budget = convert_table("uncertainty", uncertainty or {}, UncertaintyTable)
        refuse(faults_of_waived(budget))
        with numbers_are_si(si):
            nominal = scale_factor_in(scale_factor, unit)
        columns: dict[str, Any] = {"base_rate": None, "temperature": None} | arrays
        return cls(
            serial=serial,
            scale_factor=nominal,
            kind=kind,
            **columns,
            segment_index=places,
            labels=names,
            begins=base.begins | marks,
            phase_group=(0,) * len(names),
            row=row,
            resolution=resolution,
            quality=Quality(rows=t.size, used=t.size, masked=0, events=base.events),
            model=convert_table("model", model or {}, ModelTable).of(unit, "model terms"),
            estimation=convert_table("estimation", estimation or {}, EstimationTable),
            uncertainty=budget,
            stand=stand,
            unit=unit,
        )

    @classmethod
    def from_dataframe(
        cls,
        table: object,
        *,
        scale_factor: float | str,
        time: str | None = "t",
        output: str = "psi",
        reference: Sequence[str] | None = ("fx", "fy", "fz"),
        kind: str = "angle",
        units: Mapping[str, str] | Literal["SI"] | None = None,
        base_rate: Sequence[str] | None = None,
        temperature: str | None = None,
        segment: str | None = None,
        sample_rate: float | str | None = None,
        serial: str = "",
        counts_per_revolution: float | None = None,
        counter_bits: int | None = None,
        wraps_at: float | str | None = None,
        model: ModelTable | dict[str, object] | None = None,
        estimation: EstimationTable | dict[str, object] | None = None,
        uncertainty: UncertaintyTable | dict[str, object] | None = None,
        stand: dict[str, object] | None = None,
        unit: str = GYRO,
    ) -> Run:
        """Make a run from a table: pandas, polars, pyarrow, anything that gives Arrow, or a dict of arrays.

        The rows are read, checked and repaired as those of a file, and ``quality`` counts what was noticed: missing
        values, gaps, repeats, counters that wrap.

        Parameters
        ----------
        table:
            The table.
        scale_factor:
            Nominal K, e.g. ``"0.8884 rad/s/g"``.
        time, output, reference, base_rate, temperature, segment:
            Names of the columns. ``reference=None`` with ``stand``: the stand gives it. ``time=None`` with ``sample_rate``.
            The time may be a column of dates (``datetime64``), times of day or durations; dates count from the first midnight.
        kind:
            What the output is: ``"angle"``, ``"rate"`` or ``"counts"``.
        units:
            Unit of a column by its name, e.g. ``{"fx": "g", "fy": "g", "fz": "g"}``. Else the table's own
            (:meth:`to_arrow`, :meth:`to_dataframe`). A column in use that has none is refused; a time is then in seconds.
            ``"SI"``: columns without a unit and plain numbers are SI.
        sample_rate, serial, counts_per_revolution, counter_bits, wraps_at, model, estimation, uncertainty, stand:
            As in the run file.
        unit:
            Unit of the output rate of a direct instrument, as for :meth:`from_arrays`.

        Raises
        ------
        ArgumentError
            If the description is not valid.
        DataError
            If the columns do not hold what it says. The message names row, column and remedy.
        """
        si = units == "SI"
        described = {
            "instrument": {
                "serial": serial,
                "scale_factor": _told(scale_factor, f"{unit}/(m/s^2)", si),
                "counts_per_revolution": counts_per_revolution,
                "counter_bits": counter_bits,
                "kind": "gyro" if unit == GYRO else "direct",
            },
            "data": {
                "file": "table",
                "output": {"column": output, "kind": kind, "wraps_at": _told(wraps_at, "rad", si)},
                "time": None if time is None or sample_rate is not None else {"column": time},
                "sample_rate": _told(sample_rate, "Hz", si),
                "reference": None if reference is None else {"columns": reference},
                "base_rate": None if base_rate is None else {"columns": base_rate},
                "temperature": None if temperature is None else {"column": temperature},
                "segment": segment,
            },
            "model": convert_table("model", model or {}, ModelTable).of(unit, "model terms"),
            "estimation": convert_table("estimation", estimation or {}, EstimationTable),
            "uncertainty": convert_table("uncertainty", uncertainty or {}, UncertaintyTable),
            "stand": stand,
        }
        told = {} if units is None or isinstance(units, str) else dict(units)
        return doors().run_reference().run_from_table(table, described, told, unit, si=si)

    def between(self, start: float | str, stop: float | str) -> Run:
        """The samples with ``start <= t <= stop`` [s; or text, e.g. ``"8 min"``], as a run.

        Raises
        ------
        ArgumentError
            If fewer than two samples are left.
        """
        low, high = si_or_text(start, "s", what="between start"), si_or_text(stop, "s", what="between stop")
        return self._cut((self.t >= low) & (self.t <= high), f"between {low:g} and {high:g} s")

    def segment(self, *labels: str) -> Run:
        """The segments with these names, as a run: ``run.segment("7")``. :attr:`segment_index` tells the samples apart.

        Raises
        ------
        ArgumentError
            If no name is given, or there is no such segment.
        """
        known = f"segments: {', '.join(map(repr, self.labels[:40]))}{', ...' if len(self.labels) > 40 else ''}"
        strange = [f"there is no segment {label!r}" for label in labels if label not in self.labels]
        if strange or not labels:
            raise ArgumentError(f"segment: {'; '.join(strange) or 'no name is given'}", remedy=known)
        wanted = np.isin(self.segment_index, [self.labels.index(label) for label in labels])
        return self._cut(wanted, f"segments {', '.join(labels)}")

    def without(self, rows: ArrayLike) -> Run:
        """The record without some rows, as a run. A stretch begins behind them.

        ``rows`` are file rows (:attr:`row`, 1-based, as messages name them), or True (n,) for each sample to leave out.

        Raises
        ------
        ArgumentError
            If a row is not in the record, or fewer than two samples are left.
        """
        named, wrong = np.atleast_1d(np.asarray(rows)), ""
        if named.dtype != np.bool_:
            strange, named = named[~np.isin(named, self.row)], np.isin(self.row, named)
            wrong = f"row {strange[0]} is not in the record" if strange.size else ""
        elif named.shape != (self.size,):
            wrong = f"{named.size} truth values for {self.size} samples"
        if wrong:
            raise ArgumentError(
                f"without: {wrong}", remedy="name rows of run.row, or give a truth value per sample"
            )
        return self._cut(~named, f"without {int(np.count_nonzero(named))} rows")

    def _cut(self, kept: NDArray[np.bool_], words: str) -> Run:
        index = np.flatnonzero(kept)
        if index.size < 2:
            raise ArgumentError(
                f"{words}: {index.size} of {self.size} samples are left", remedy="keep two or more"
            )
        begins = self.begins[index] | (np.diff(index, prepend=index[0]) > 1)
        begins[0] = True
        old, place = np.unique(self.segment_index[index], return_inverse=True)
        quality, gone = self.quality, self.size - index.size
        events = (*quality.events, Event("cut", gone, None, words)) if gone else quality.events
        columns = {name: values for name, values in vars(self).items() if isinstance(values, np.ndarray)}
        taken: dict[str, Any] = {name: np.ascontiguousarray(values[index]) for name, values in columns.items()}
        taken |= {"segment_index": place.astype(np.int32), "begins": begins}
        return replace(
            self,
            **taken,
            labels=tuple(self.labels[i] for i in old),
            phase_group=tuple(self.phase_group[i] for i in old),
            quality=replace(quality, used=quality.used - gone, masked=quality.masked + gone, events=events),
        )


def _told(value: float | str | None, unit: str, si: bool) -> float | str | None:
    """A plain number as text with its unit, if numbers are SI."""
    return value if value is None or isinstance(value, str) or not si else f"{float(value)!r} {unit}"


def _in_si(name: str, values: ArrayLike, units: Mapping[str, str], like: str) -> Array:
    """An array in SI, each column contiguous. Without a unit in ``units`` it is in SI already."""
    array = np.asarray(values, dtype=float, order="F")
    if name not in units:
        return array
    return array * conversion_factor(units[name], like, what=f"units: {name}") + offset_to_si(units[name])


def _segments(segment: ArrayLike | None, size: int) -> tuple[NDArray[np.int32], tuple[str, ...]]:
    given = np.zeros(size, np.int32) if segment is None else np.asarray(segment)
    named = given.dtype.kind in "OUS"
    labels, codes = np.unique(given.astype(str) if named else given, return_inverse=True)
    index, names = codes.astype(np.int32).reshape(given.shape), tuple(map(str, labels))
    return segments_of_visits(index, names) if named else (index, names)


def segments_of_visits(
    codes: NDArray[np.int32], labels: Sequence[str]
) -> tuple[NDArray[np.int32], tuple[str, ...]]:
    """Segment index of each sample (n,), and the names of the segments, from codes (n,): indices into ``labels``, -1 for none.

    Each visit of a label is a segment. A label that returns later is ``label#2``.
    """
    starts = np.flatnonzero(np.diff(codes, prepend=codes[:1] - 1))
    index, visits, names = np.full(starts.size, -1, np.int32), Counter[int](), []
    for at, code in enumerate(codes[starts].tolist()):
        if code >= 0:
            visits[code] += 1
            names.append(labels[code] if visits[code] == 1 else f"{labels[code]}#{visits[code]}")
            index[at] = len(names) - 1
    return np.repeat(index, np.diff(np.append(starts, codes.size))), tuple(names)


def _wrong_arrays(
    arrays: dict[str, Array], segment: NDArray[np.int32], gaps: NDArray[np.bool_], kind: str
) -> Iterator[tuple[str, str]]:
    """What does not fit together, with argument and first index, and the remedy."""
    t = arrays["t"]
    if kind not in ("angle", "rate"):
        yield f"kind: '{kind}' is neither 'angle' nor 'rate'", "turn counts into an angle first"
    if t.ndim != 1 or t.size < 2:
        yield f"t: shape {t.shape}, needs at least two samples in one dimension", "give two or more times"
    for name, array in (arrays | {"segment": segment, "gaps": gaps}).items():
        shape = (t.size, 3) if name in ("f", "base_rate") else (t.size,)
        if array.shape != shape:
            yield f"{name}: shape {array.shape}, but t has {t.size} samples", f"give shape {shape}"
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            yield f"{name}[{np.argwhere(~np.isfinite(array))[0][0]}] is not finite", "leave such samples out"
    back = 1 + np.flatnonzero((np.diff(segment) == 0) & (np.diff(t) <= 0.0))
    if back.size:
        yield f"t[{back[0]}] = {t[back[0]]!r} is not after t[{back[0] - 1}]", "sort by time"


def begins_stretch(step: Array, nominal: float) -> NDArray[np.bool_]:
    """True for a sample that begins a stretch: time repeats, jumps back or leaves a gap before it.

    ``step`` (n,) [s] is the time since the sample before. ``nominal`` [s] is the nominal interval. Files, arrays in
    memory and live streams all use this rule.
    """
    return np.asarray((step <= 0.0) | (step > _LONG_INTERVAL * nominal))


@dataclass(frozen=True)
class TimeBase:
    """``begins`` marks the used samples that begin a stretch. ``nominal`` is the nominal step [s]. ``events`` lists faults."""

    begins: NDArray[np.bool_]
    nominal: float
    events: tuple[Event, ...]
    step: Array


def examine_time(t: Array, segment: NDArray[np.int32], rows: NDArray[np.int64]) -> TimeBase:
    """Find backward jumps and gaps between the used samples. The nominal step is the median of all forward steps."""
    same, step = np.append(False, segment[1:] == segment[:-1]), stored(changes(t))
    forward = step[same & (step > 0.0)]
    nominal = float(np.median(forward, overwrite_input=True)) if forward.size else 0.0
    begins = ~same | begins_stretch(step, nominal)
    backs, gaps = (np.flatnonzero(same & where) for where in (step <= 0.0, step > _LONG_INTERVAL * nominal))
    longest = float(step[gaps].max(initial=0.0))
    missing = int(np.round(step[gaps] / nominal - 1.0).sum()) if nominal > 0.0 else 0
    none = "no increment is formed across it"
    events = counted("time-jump-back", backs, rows, none)
    events += counted("gap", gaps, rows, f"longest {longest:.6g} s, about {missing} samples missing; {none}")
    return TimeBase(stored(begins), nominal, tuple(events), step)
