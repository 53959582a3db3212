"""The interface of all stands, their imperfections, and the table of specific force and base rate with labelled segments.

A stand has two functions: the plan of its segments, and the motion that an instrument on it feels at any time.
Imperfections have their names in the uncertainty budget. The reference in a lab's log is that of the stand without them. The
instrument feels the stand with them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from itertools import accumulate
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError, DataError, Where
from piga.formats.columns import refusal
from piga.formats.container import columns_stream
from piga.frames import rotation_vector_to_matrix
from piga.records.run_file import Columns, ColumnTable
from piga.results import Array, Result
from piga.units import conversion_factor, to_si

GENERAL = ("reference_scale", "reference_bias", "reference_misalignment", "timing", "temperature")
"""Imperfections that every stand has. They act on its reference, its clock and its thermometer."""


def _entry(unit: str, meaning: str, size: int = 1) -> Any:
    """A field of :class:`Imperfections`: a number, or a vector of ``size`` numbers."""
    default = 0.0 if size == 1 else (0.0,) * size
    return field(default=default, metadata={"unit": unit, "size": size, "meaning": meaning})


@dataclass(frozen=True)
class Imperfections:
    """Imperfections of a stand: true value minus assumed value.

    Fields are SI. Their ``metadata`` holds the unit for reports, the size and the meaning.
    """

    reference_scale: float = _entry("ppm", "relative error of the specific-force reference")
    reference_bias: tuple[float, ...] = _entry(
        "ug", "offset of the specific-force reference, base axes", size=3
    )
    reference_misalignment: tuple[float, ...] = _entry(
        "arcsec", "small turn of the instrument on the stand about X0, Y0, Z0", size=3
    )
    gravity: float = _entry("ug", "local gravity")
    timing: float = _entry("ppm", "relative error of the clock's rate")
    temperature: float = _entry("K", "offset of the thermometer")
    levelling: tuple[float, ...] = _entry("arcsec", "tilt of the stand about its two levelling axes", size=2)
    angle_error: float = _entry("arcsec", "index error of the dividing head")
    angle_harmonics: tuple[tuple[int, float, float], ...] = _entry(
        "arcsec", "dividing errors: order, amplitude, phase", size=0
    )
    settling: float = _entry("arcsec", "angle still to go when a position is reached")
    arm_radius: float = _entry("um", "effective radius of the centrifuge or lever arm on the table")
    arm_stretch: float = _entry("s^2/rad^2", "relative growth of the radius per squared rate")
    rate_error: float = _entry("ppm", "relative error of the centrifuge or table rate")
    rate_ripple: float = _entry("ppm", "relative ripple of the rate once a revolution")
    transverse_motion: float = _entry("ppm", "transverse over axial motion of the vibration table")
    rocking: float = _entry(
        "arcsec", "rotation of the vibration table at peak drive, about the horizontal axis across it"
    )

    def _foreign(self, accepted: Iterable[str]) -> list[str]:
        """Names of those that are not zero, and neither general nor accepted by a stand."""
        names = [entry.name for entry in fields(self) if np.any(np.asarray(getattr(self, entry.name)))]
        return [name for name in names if name not in (*GENERAL, *accepted)]

    def require(self, accepted: Iterable[str], stand: str, where: str = "[imperfections]") -> None:
        """Refuse errors that ``stand`` does not have. ``where`` is the table that states them.

        Raises
        ------
        ArgumentError
            If there is one. The message names it, and those that the stand has.
        """
        for name in self._foreign(accepted):
            raise ArgumentError(
                f"{where} {name} does not exist on a {stand}",
                remedy=f"it has: {', '.join((*GENERAL, *sorted(accepted)))}",
            )

    def of(self, accepted: Iterable[str]) -> Imperfections:
        """Without those that a stand which has ``accepted`` does not have."""
        return replace(self, **{name: getattr(NONE, name) for name in self._foreign(accepted)})

    def felt(self, force: Array, rate: Array) -> tuple[Array, Array]:
        """Force and rate that the instrument feels if the stand makes ``force`` and ``rate``, (n, 3) each."""
        turn = rotation_vector_to_matrix(np.array(self.reference_misalignment))
        true = (1.0 + self.reference_scale) * force + np.array(self.reference_bias)
        return true @ turn, rate @ turn


NONE = Imperfections()
"""A perfect stand, as the lab's reference describes it."""


def imperfections(
    values: Mapping[str, Any], *, rng: np.random.Generator | None = None, where: str = "[imperfections]"
) -> Imperfections:
    """Imperfections from text or numbers as written in a scenario.

    With ``rng`` the values are standard uncertainties, and the imperfections are drawn from normal distributions.
    A single value for a vector then holds for each component.

    Raises
    ------
    ArgumentError, UnitError
        If a value is not valid. The message names the key.
    """

    def number(written: Any) -> float:
        value = to_si(written, unit, what=what)
        return value if rng is None else value * float(rng.standard_normal())

    def harmonic(item: Any) -> tuple[int, float, float]:
        parts = item if isinstance(item, (list, tuple)) else ()
        if len(parts) != 3 or isinstance(parts[0], bool) or not isinstance(parts[0], int):
            raise ArgumentError(
                f"{what}: {item!r} is not a harmonic: order, amplitude and phase are needed",
                remedy="write e.g. [2, '1 arcsec', '0 deg']",
            )
        return parts[0], number(parts[1]), to_si(parts[2], "rad", what=what)

    known = {entry.name: entry.metadata for entry in fields(Imperfections)}
    for name in values:
        if name not in known:
            raise ArgumentError(f"{where}: unknown key '{name}'", remedy=f"known keys: {', '.join(known)}")
    chosen: dict[str, Any] = {}
    for name in (name for name in known if name in values):
        unit, size, what = str(known[name]["unit"]), int(known[name]["size"]), f"{where} {name}"
        written = values[name]
        if size == 1:
            chosen[name] = number(written)
            continue
        if rng is not None and size and not isinstance(written, (list, tuple)):
            written = [written] * size
        if not isinstance(written, (list, tuple)):
            raise ArgumentError(
                f"{what}: a list is needed, got {written!r}", remedy="write e.g. ['1 arcsec', '0 arcsec']"
            )
        if size and len(written) != size:
            raise ArgumentError(
                f"{what}: {len(written)} values given, {size} needed", remedy=f"give a list of {size}"
            )
        chosen[name] = tuple(map(number if size else harmonic, written))
    return Imperfections(**chosen)


# -- the interface ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Segment:
    """A part of a test: ``label``, ``start`` and ``duration`` [s]. Moves between positions are not recorded."""

    label: str
    start: float
    duration: float
    recorded: bool = True

    @property
    def stop(self) -> float:
        """End of the segment [s]."""
        return self.start + self.duration


class Stand(Protocol):
    """Interface of every stand."""

    @property
    def kind(self) -> str:
        """Kind of stand, by its name in scenario files."""
        ...

    @property
    def accepted(self) -> tuple[str, ...]:
        """Names of its stand-specific imperfections."""
        ...

    @property
    def fastest(self) -> float:
        """Step [s] that resolves its fastest motion."""
        ...

    def segments(self) -> tuple[Segment, ...]:
        """Segments in order, without gaps."""
        ...

    def motion(self, t: Array, errors: Imperfections) -> tuple[Array, Array]:
        """Specific force [m/s^2] and inertial base rate [rad/s] at times ``t`` [s], base axes, (n, 3)."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class Profile(Result):
    """A test as a table, one row per sample time.

    ``t`` [s] (n,); ``segment`` (n,) index into ``segments``; ``force`` [m/s^2] and ``base_rate`` [rad/s] (n, 3) are what
    the instrument feels. ``reference`` and ``reference_rate`` (n, 3) are those of the lab's log.
    """

    t: Array
    segment: NDArray[np.int32]
    segments: tuple[Segment, ...]
    force: Array
    base_rate: Array
    reference: Array
    reference_rate: Array

    @property
    def recorded(self) -> NDArray[np.bool_]:
        """True for rows in a recorded segment."""
        return np.array([s.recorded for s in self.segments])[self.segment]


def plan(parts: list[tuple[str, float, bool]]) -> tuple[Segment, ...]:
    """Consecutive segments from (label, duration, recorded). Empty segments are left out."""
    segments, start = [], 0.0
    for label, duration, recorded in parts:
        if duration > 0.0:
            segments.append(Segment(label, start, duration, recorded))
            start += duration
    return tuple(segments)


def plan_holds(count: int, dwell: float, way: str, move: float) -> tuple[Segment, ...]:
    """Positions ``0, 1, ...`` are recorded. The moves between them (``way to 1``, ...) are not."""
    parts = [("0", dwell, True)]
    for k in range(1, count):
        parts += [(f"{way} to {k}", move, False), (str(k), dwell, True)]
    return plan(parts)


def sample_stand(
    stand: Stand, step: float, *, errors: Imperfections = NONE, oversample: int = 1, extra: int = 0
) -> Profile:
    """Sample a stand at every ``step/oversample`` [s], with ``extra`` rows beyond its end.

    The instrument feels the stand with the imperfections ``errors``. The lab's reference is the stand without them.

    Raises
    ------
    ArgumentError
        If the stand does not have an imperfection, or ``step`` does not divide its segments.
    """
    errors.require(stand.accepted, stand.kind)
    segments = stand.segments()
    if not segments:
        raise ArgumentError(f"the {stand.kind} has no segment: it lasts 0 s", remedy="give it a duration")
    for segment in segments:
        ratio = segment.duration / step
        if abs(ratio - round(ratio)) > 1e-6 or round(ratio) < 1:
            raise ArgumentError(
                f"segment '{segment.label}' lasts {segment.duration:g} s, not a multiple of the "
                f"sample interval {step:g} s",
                remedy="change the duration or the sample rate",
            )
    end = round((segments[-1].stop - segments[0].start) / step) * oversample
    t = segments[0].start + np.arange(end + extra + 1) * step / oversample
    # a border belongs to the recorded segment; between two recorded segments, to the later
    starts, recorded = np.array([(s.start, s.recorded) for s in segments]).T
    index = np.clip(np.searchsorted(starts, t + 1e-9, side="right") - 1, 0, len(segments) - 1)
    before = np.maximum(index - 1, 0)
    at_border = np.abs(t - starts[index]) < 1e-9
    place = np.where(at_border & (recorded[index] < recorded[before]), before, index).astype(np.int32)
    felt = errors.felt(*stand.motion(t, errors))
    return Profile(t, place, segments, *felt, *stand.motion(t, NONE))


def force_change(stand: Stand, t: Array, errors: Imperfections) -> Array:
    """Change of a stand's specific force at ``t`` by the imperfections ``errors`` [m/s^2], (n, 3): true minus reference."""
    return errors.felt(*stand.motion(t, errors))[0] - stand.motion(t, NONE)[0]


@dataclass(frozen=True)
class Composite:
    """Several stands in order, with a pause of ``pause`` [s] between them to move the instrument.

    During the pause, force and base rate change linearly from the end of one part to the start of the next. The
    pause is not recorded. Labels are ``part.segment``.
    """

    parts: tuple[Stand, ...]
    pause: float = 60.0

    kind = "composite"

    def __post_init__(self) -> None:
        if not self.parts:
            raise ArgumentError("composite: no parts", remedy="add [[stand.parts]] tables")
        if self.pause <= 0.0:
            raise ArgumentError(
                f"composite: pause {self.pause:g} s must be positive", remedy='e.g. pause = "10 s"'
            )

    @property
    def accepted(self) -> tuple[str, ...]:
        """Imperfections of all parts. Each part uses its own."""
        return tuple(sorted({name for part in self.parts for name in part.accepted}))

    @property
    def fastest(self) -> float:
        """Smallest step of its parts."""
        return min(part.fastest for part in self.parts)

    def segments(self) -> tuple[Segment, ...]:
        """Segments of all parts, and the pauses between them."""
        rows: list[tuple[str, float, bool]] = []
        for k, part in enumerate(self.parts):
            rows += [(f"pause before {k}", self.pause, False)] if k else []
            rows += [(f"{k}.{s.label}", s.duration, s.recorded) for s in part.segments()]
        return plan(rows)

    def motion(self, t: Array, errors: Imperfections) -> tuple[Array, Array]:
        """Specific force and base rate in base axes, (n, 3) each. Each part has its own imperfections."""
        lasting = [part.segments()[-1].stop + self.pause for part in self.parts]
        starts = [0.0, *accumulate(lasting)][:-1]
        force, rate = np.zeros((t.size, 3)), np.zeros((t.size, 3))
        index = np.clip(np.searchsorted(starts, t + 1e-9, side="right") - 1, 0, len(starts) - 1)
        order, edges = np.argsort(index, kind="stable"), np.cumsum(np.bincount(index, minlength=len(starts)))
        for k, part in enumerate(self.parts):
            rows = order[edges[k - 1] if k else 0 : edges[k]]
            if rows.size == 0:
                continue
            local, end = t[rows] - starts[k], part.segments()[-1].stop
            force[rows], rate[rows] = part.motion(np.minimum(local, end), errors.of(part.accepted))
            for other in self.parts[k + 1 : k + 2]:
                share = np.clip((local - end) / self.pause, 0.0, 1.0)[:, None]
                begins = other.motion(np.zeros(1), errors.of(other.accepted))
                force[rows] += share * (begins[0] - force[rows])
                rate[rows] += share * (begins[1] - rate[rows])
        return force, rate


# -- a logged profile ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, repr=False)
class LoggedProfile(Result):
    """Samples of specific force [m/s^2] and base rate [rad/s], (n, 3), at times ``t`` [s]. They are linear between samples."""

    t: Array
    force: Array
    base_rate: Array

    kind = "profile"
    accepted = ()

    def __post_init__(self) -> None:
        if self.t.ndim != 1 or self.t.size < 2 or not self.fastest > 0.0:
            raise ArgumentError(
                "profile: the times are fewer than two, or do not increase", remedy="sort the rows by time"
            )
        for name, array in (("force", self.force), ("base rate", self.base_rate)):
            right = array.shape == (self.t.size, 3)
            if not (right and np.isfinite(array).all()):
                raise ArgumentError(
                    f"profile {name}: does not hold {self.t.size} rows of three finite numbers",
                    remedy="give one row for each time",
                )

    @property
    def fastest(self) -> float:
        """Smallest sample interval [s]."""
        return float(np.diff(self.t).min())

    def segments(self) -> tuple[Segment, ...]:
        """One segment that starts at time zero."""
        return plan([("0", float(self.t[-1] - self.t[0]), True)])

    def motion(self, t: Array, errors: Imperfections) -> tuple[Array, Array]:
        """Specific force and base rate in base axes, (n, 3) each."""
        del errors  # general imperfections act on every stand alike
        columns = (*self.force.T, *self.base_rate.T)
        both = np.column_stack([np.interp(t + self.t[0], self.t, column) for column in columns])
        return both[:, :3], both[:, 3:]


def read_profile(
    path: Path, time: ColumnTable, force: Columns, base_rate: Columns | None = None
) -> LoggedProfile:
    """Read a profile from a file of any format that logs have.

    Raises
    ------
    DataError
        If the file cannot be read, lacks a column, or a column holds text or gaps.
    """
    per_second = conversion_factor(time.unit, "s", what="[stand] time")
    per_force = conversion_factor(force.unit, "m/s^2", what="[stand] force")
    rates, unit = (base_rate.columns, base_rate.unit) if base_rate else ((), "rad/s")
    per_rate = conversion_factor(unit, "rad/s", what="[stand] base_rate")
    _, columns = read_columns(path, [time.column, *force.columns, *rates])
    f = per_force * np.column_stack([columns[name] for name in force.columns])
    rate = per_rate * np.column_stack([columns[name] for name in rates]) if rates else np.zeros(f.shape)
    return LoggedProfile(per_second * columns[time.column], f, rate)


def read_columns(path: Path, wanted: Iterable[str]) -> tuple[NDArray[np.int64], dict[str, Array]]:
    """File rows, and the named columns in the units of the file. A cell without a number is refused."""
    try:
        stream = columns_stream(path, tuple(wanted))
        chunks = list(stream.chunks())
    except DataError as error:
        remedy = "[stand] file: give a file with columns of numbers"
        raise DataError(error.message, remedy=remedy, where=error.where) from None
    for event in stream.events():
        if event.kind == "truncated-last-line":
            raise refusal(path, event.detail, "end the line, or delete it if it was cut off")
    rows = np.concatenate([chunk.rows for chunk in chunks])
    columns = {name: np.concatenate([chunk.numbers[name] for chunk in chunks]) for name in stream.numeric}
    for name, values in columns.items():
        for gap in np.flatnonzero(~np.isfinite(values)):
            where = Where(path, int(rows[gap]), (name,))
            words, remedy = f"row {rows[gap]}, column '{name}' is empty", "repair the profile first"
            raise DataError(f"{path}: {words}", remedy=remedy, where=where)
    return rows, columns
