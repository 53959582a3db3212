"""A recorded test as plain data in SI, and its time base. Every estimator and compensator works on it.

A *stretch* is a sequence of samples with regular time. Increments are never formed across its ends. Times that repeat,
jump back or leave a gap are detected and counted. Nothing is interpolated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError
from piga.records.calibration import Event, Quality
from piga.records.distribution import GivenParameter
from piga.records.run_file import EstimationTable, ModelTable, UncertaintyTable
from piga.records.spool import Arrays, exact_median, spans, steps
from piga.results import Column, Reported, Result, Tabular, plotted

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Run(Result, Reported, Tabular):
    """One recorded test. Arrays share their length n; everything is SI.

    Attributes
    ----------
    serial, scale_factor:
        Serial number of the instrument and its nominal K [(rad/s)/(m/s^2)]. Compare it with
        ``cal["scale_factor"].value_si``; ``cal["scale_factor"].value`` is in rad/s/g, the unit of calibration.json.
    t:
        Time [s]. It increases inside a stretch.
    output:
        Output angle psi [rad], unwrapped; or rate [rad/s] when ``kind`` is ``"rate"``.
    f:
        Reference specific force in base axes [m/s^2], shape (n, 3).
    base_rate:
        Inertial angular rate of the base [rad/s], shape (n, 3); None when not recorded.
    temperature:
        [K], or None.
    segment, labels:
        Segment index of each sample, and the names of the segments.
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
    servo:
        Known parameters of the servo by name [SI], from the run file's ``[instrument] servo``; empty if none are given.
    """

    serial: str
    scale_factor: float
    kind: str
    t: Array
    output: Array
    f: Array
    base_rate: Array | None
    temperature: Array | None
    segment: NDArray[np.int32]
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
    servo: tuple[GivenParameter, ...] = ()
    source: str = ""
    input_sha256: dict[str, str] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Number of samples."""
        return int(self.t.size)

    @property
    def duration(self) -> float:
        """Sum of the recorded intervals [s], without gaps and moves."""
        return float(sum(step.sum() for step in self._steps_inside()))

    @cached_property
    def median_step(self) -> float:
        """Median interval inside stretches [s]; 0 if there is none."""
        return exact_median(self._steps_inside)

    @property
    def output_unit(self) -> str:
        """Unit of ``output``: rad, or rad/s for a rate log."""
        return "rad/s" if self.kind == "rate" else "rad"

    def table_columns(self, part: slice = slice(None)) -> dict[str, Column]:
        """The samples as a table in SI; ``part`` takes some rows."""
        columns = {"t": Column(self.t[part], "s"), "output": Column(self.output[part], self.output_unit)}
        columns |= {f"f{axis}": Column(self.f[part, i], "m/s^2") for i, axis in enumerate("xyz")}
        if self.base_rate is not None:
            columns |= {f"w{axis}": Column(self.base_rate[part, i], "rad/s") for i, axis in enumerate("xyz")}
        if self.temperature is not None:
            columns["temperature"] = Column(self.temperature[part], "K")
        columns["segment"] = Column(self.segment[part].astype(np.int32), "1", self.labels)
        return columns | {"row": Column(self.row[part])}

    def in_brief(self) -> list[tuple[str, str]]:
        """What a notebook shows of the record."""
        from piga.units import from_si

        quality = self.quality
        optional = {"base rate": self.base_rate, "temperature": self.temperature}
        return [
            ("instrument", self.serial or "not named"),
            ("scale_factor", f"{from_si(self.scale_factor, 'rad/s/g'):.6g} rad/s/g, nominal"),
            ("samples", f"{self.size} of {quality.rows} rows; output is the {self.kind}"),
            ("time", f"{self.t[0]:.6g} to {self.t[-1]:.6g} s, {self.duration:.6g} s recorded"),
            (
                "segments",
                f"{len(self.labels)}: {', '.join(self.labels[:8])}{', ...' if len(self.labels) > 8 else ''}",
            ),
            (
                "beside force",
                ", ".join(name for name, held in optional.items() if held is not None) or "nothing",
            ),
            ("findings", ", ".join(f"{event.count} {event.kind}" for event in quality.events) or "none"),
            ("terms", " ".join(self.model.terms)),
        ]

    def plot(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Interval, output and reference against time: three panels. See :class:`piga.results.Plots`."""
        return plotted(self, ax)

    def segment_edges(self) -> NDArray[np.int64]:
        """First sample of each segment, then the number of samples."""
        edges = [part.start + np.flatnonzero(steps(self.segment, part)) for part in spans(self.size)]
        return np.concatenate([[0], *edges, [self.size]]).astype(np.int64)

    def _steps_inside(self) -> Iterator[Array]:
        for part in spans(self.size):
            yield steps(self.t, part)[~self.begins[part]]

    @classmethod
    def from_arrays(
        cls,
        t: Array,
        output: Array,
        f: Array,
        *,
        scale_factor: float | str,
        kind: str = "angle",
        base_rate: Array | None = None,
        temperature: Array | None = None,
        segment: NDArray[np.int32] | None = None,
        resolution: float = 0.0,
        serial: str = "",
        uncertainty: dict[str, Any] | UncertaintyTable | None = None,
    ) -> Run:
        """Make a run from arrays in memory (SI). Shapes: t, output (n,); f, base_rate (n, 3).

        A stretch begins with each segment and after each gap. A gap is an interval longer than 1.5 times the median
        interval, as in files.

        ``uncertainty`` is the run file's ``[uncertainty]``, e.g. ``{"reference_scale": "10 ppm"}``.

        Raises
        ------
        ArgumentError
            If shapes do not match, a sample is not finite or time does not increase (the message names argument and
            index), or if ``uncertainty`` is not valid.
        """
        from piga.units import to_si

        t, output, f = (np.ascontiguousarray(a, dtype=float) for a in (t, output, f))
        labels_index = np.zeros(t.size, np.int32) if segment is None else np.asarray(segment, dtype=np.int32)
        check_arrays(t, output, f, base_rate, temperature, labels_index, kind)
        names, index = np.unique(labels_index, return_inverse=True)
        try:
            table = msgspec.convert(uncertainty or {}, UncertaintyTable)
        except msgspec.ValidationError as error:
            raise ArgumentError(f"uncertainty: {error}", remedy="e.g. {'reference_scale': '10 ppm'}") from None
        places: NDArray[np.int32] = index.astype(np.int32)
        row = np.arange(1, t.size + 1, dtype=np.int64)
        base = examine_time(t, places, row, Arrays(None))
        return cls(
            serial=serial,
            scale_factor=to_si(scale_factor, "rad/s/g", what="scale_factor"),
            kind=kind,
            t=t,
            output=output,
            f=f,
            base_rate=None if base_rate is None else np.ascontiguousarray(base_rate, dtype=float),
            temperature=None if temperature is None else np.ascontiguousarray(temperature, dtype=float),
            segment=places,
            labels=tuple(str(name) for name in names),
            begins=base.begins,
            phase_group=(0,) * names.size,
            row=row,
            resolution=resolution,
            quality=Quality(rows=t.size, used=t.size, masked=0, events=base.events),
            uncertainty=table,
        )


def check_arrays(
    t: Array,
    output: Array,
    f: Array,
    base_rate: Array | None,
    temperature: Array | None,
    segment: NDArray[np.int32],
    kind: str,
) -> None:
    """Refuse arrays that do not fit together. The message names the argument and the first index."""
    if kind not in ("angle", "rate"):
        raise ArgumentError(
            f"kind: '{kind}' is neither 'angle' nor 'rate'", remedy="turn counts into an angle first"
        )
    if t.ndim != 1 or t.size < 2:
        raise ArgumentError(f"t: shape {t.shape}, needs at least two samples in one dimension")
    shapes: dict[str, tuple[NDArray[Any], tuple[int, ...]]]
    shapes = {"output": (output, (t.size,)), "f": (f, (t.size, 3)), "segment": (segment, (t.size,))}
    if base_rate is not None:
        shapes["base_rate"] = (np.asarray(base_rate), (t.size, 3))
    if temperature is not None:
        shapes["temperature"] = (np.asarray(temperature), (t.size,))
    for name, (array, shape) in shapes.items():
        if array.shape != shape:
            raise ArgumentError(f"{name}: shape {array.shape}, but t has {t.size} samples: {shape} is needed")
    arrays: dict[str, NDArray[Any]] = {"t": t} | {name: pair[0] for name, pair in shapes.items()}
    for name, array in arrays.items():
        finite = np.isfinite(array)
        if not finite.all():
            index = int(np.argwhere(~finite)[0][0])
            raise ArgumentError(f"{name}[{index}] is not finite", remedy="leave such samples out")
    step = np.diff(t)
    same = np.diff(segment) == 0
    if (same & (step <= 0.0)).any():
        index = int(np.argmax(same & (step <= 0.0))) + 1
        raise ArgumentError(
            f"t[{index}] = {t[index]!r} does not come after t[{index - 1}]", remedy="sort by time"
        )


GAP = 1.5
"""A step longer than this many nominal steps is a gap."""


def begins_stretch(step: Array, nominal: float) -> NDArray[np.bool_]:
    """True for a sample that begins a stretch: time repeats, jumps back or leaves a gap before it.

    ``step`` (n,) [s] is the time since the sample before. ``nominal`` [s] is the nominal interval. Files, arrays in
    memory and live streams all use this rule.
    """
    return np.asarray((step <= 0.0) | (step > GAP * nominal))


@dataclass(frozen=True)
class TimeBase:
    """``begins`` marks the used samples that begin a stretch. ``nominal`` is the nominal step [s]. ``events`` lists faults."""

    begins: NDArray[np.bool_]
    nominal: float
    events: tuple[Event, ...]


def drop_repeats(
    t: Array,
    segment: NDArray[np.int32],
    usable: NDArray[np.bool_],
    values: list[Array],
    rows: NDArray[np.int64],
) -> list[Event]:
    """Clear ``usable`` for rows with a repeated time: the second of two identical rows, both of two conflicting rows.

    Parameters
    ----------
    t, segment:
        Time [s] and segment index of every row, shape (n,).
    usable:
        False for rows that were masked before (missing values). This array is changed.
    values:
        All columns, to distinguish identical rows from conflicting ones.
    rows:
        File row of each sample, for the messages.
    """
    counts, first_rows = [0, 0], [0, 0]
    last = np.zeros(0, dtype=np.int64)
    for part in spans(t.size):
        index = np.concatenate((last, part.start + np.flatnonzero(usable[part])))
        last = index[-1:]
        at, places = t[index], segment[index]
        same = (np.diff(at) == 0.0) & (np.diff(places) == 0)
        if not same.any():
            continue
        first, second = index[:-1][same], index[1:][same]
        identical = np.ones(first.size, dtype=bool)
        for column in values:
            identical &= column[first] == column[second]
        usable[second] = False
        usable[first[~identical]] = False
        for kind, repeats in enumerate((second[identical], second[~identical])):
            if repeats.size and not counts[kind]:
                first_rows[kind] = int(rows[repeats[0]])
            counts[kind] += int(repeats.size)
    events = []
    if counts[0]:
        events.append(Event("repeated-row", counts[0], first_rows[0], "the copy is not used"))
    if counts[1]:
        detail = "same time, other values: neither is used"
        events.append(Event("conflicting-row", counts[1], first_rows[1], detail))
    return events


def examine_time(t: Array, segment: NDArray[np.int32], rows: NDArray[np.int64], arrays: Arrays) -> TimeBase:
    """Find backward jumps and gaps between the used samples. The nominal step is the median of all forward steps."""
    nominal = exact_median(lambda: _forward(t, segment))
    begins = arrays.empty(t.size, np.bool_)
    gaps = backs = missing = 0
    first_gap = first_back = None
    longest = 0.0
    for part in spans(t.size):
        step, same = steps(t, part), steps(segment, part) == 0
        gap = step > GAP * nominal
        back = step <= 0.0
        if part.start == 0:
            same[0] = False
        begins[part] = ~same | begins_stretch(step, nominal)
        if not (same & (gap | back)).any():
            continue
        gap &= same
        back &= same
        if back.any():
            backs += int(back.sum())
            first_back = part.start + int(np.argmax(back)) if first_back is None else first_back
        if gap.any():
            gaps += int(gap.sum())
            first_gap = part.start + int(np.argmax(gap)) if first_gap is None else first_gap
            longest = max(longest, float(step[gap].max()))
            missing += int(np.round(step[gap] / nominal - 1.0).sum()) if nominal > 0.0 else 0
    events = []
    if first_back is not None:
        row = int(rows[first_back])
        events.append(Event("time-jump-back", backs, row, "no increment is formed across it"))
    if first_gap is not None:
        detail = f"longest {longest:.6g} s, about {missing} samples missing; no increment is formed across it"
        events.append(Event("gap", gaps, int(rows[first_gap]), detail))
    return TimeBase(begins, nominal, tuple(events))


def _forward(t: Array, segment: NDArray[np.int32]) -> Iterator[Array]:
    """Steps forward inside segments."""
    for part in spans(t.size):
        step = steps(t, part)
        yield step[(steps(segment, part) == 0) & (step > 0.0)]
