"""The stand of a recorded test: its reference, if the log has none, and the effect of its errors.

A run file's ``[stand]`` table has the same keys as in a scenario. Static stands (dividing head, centrifuge and
rate table at constant rate) are matched to the record segment by segment: by label, if the labels of the
record are those of the stand, else in order. A vibration table, a logged profile and a composite are
matched by time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError, PigaError, RunFileError, UnitError
from piga.reading.raw_columns import SteadyFile, file_digest
from piga.reading.read_run import read_record
from piga.records.distribution import Spread, shape_of, standard_uncertainty
from piga.records.run import Run
from piga.records.run_file import REPEATED, Draw, drawn_for
from piga.records.spool import arrays_like, spans
from piga.results import Result
from piga.stand.imperfections import GENERAL, Imperfections, imperfections
from piga.stand.profile import Segment, Stand, force_change
from piga.stand.scenario import CompositeTable, SimpleStand
from piga.units import from_si

Array = NDArray[np.float64]

TIMED = ("vibration-table", "profile", "composite")
"""Stands that are matched to a record by time."""


@dataclass
class FollowedStand:
    """The motion of a stand along a record: rows in order, in pieces of any size. The size does not affect the result.

    ``starts`` and ``durations`` [s] (m,) locate each segment of the record on the stand's plan. None: the stand is
    matched by time.
    """

    stand: Stand
    starts: Array | None = None
    durations: Array | None = None

    def __post_init__(self) -> None:
        self._first = np.full(0 if self.starts is None else self.starts.size, np.nan)

    def times(self, t: Array, segment: NDArray[np.int32]) -> Array:
        """Time on the stand's plan [s] of the next samples, given their ``t`` [s] (n,) and segments (n,)."""
        if self.starts is None or self.durations is None:
            return t
        met, at = np.unique(segment, return_index=True)
        self._first[met] = np.where(np.isnan(self._first[met]), t[at], self._first[met])
        return self.starts[segment] + np.clip(t - self._first[segment], 0.0, self.durations[segment])

    def motion(self, t: Array, segment: NDArray[np.int32]) -> tuple[Array, Array]:
        """Specific force [m/s^2] and base rate [rad/s] of the perfect stand at the next samples, (n, 3) each."""
        return self.stand.motion(self.times(t, segment), Imperfections())


@dataclass(frozen=True, eq=False, repr=False)
class StandChange(Result):
    """One component of a stand's uncertainty: name and standard uncertainty as written.

    ``change`` gives, for a slice of rows, the change of f [m/s^2] there, (n, 3).
    """

    name: str
    written: str
    change: Callable[[slice], Array]
    distribution: str = "normal"
    degrees_of_freedom: float = math.inf
    draw: Draw = "reference"


def read_run(
    path: str | Path, *, need_reference: bool = True, held: int | None = None, content: bytes | None = None
) -> Run:
    """Read a recorded test.

    Parameters
    ----------
    path:
        Run file (TOML). Its data file must lie beside it. Without reference columns the reference is
        computed from its ``[stand]`` table.
    need_reference:
        False: a record with neither is read too, with ``f`` nan. Instruments compensated together need no reference.
    held:
        Most rows whose arrays lie in memory; longer records lie on disk. None: 4 194 304. It does not affect the result.
    content:
        Bytes of the run file, in place of those on disk.

    Raises
    ------
    RunFileError
        If the run file is not valid.
    DataError
        If the data file does not hold what the run file says. The message names file, row, column and remedy.
    """
    read: dict[str, str] = {}

    def reference(
        table: dict[str, Any], folder: Path, t: Array, segment: NDArray[np.int32], labels: tuple[str, ...]
    ) -> tuple[Array, Array]:
        files = {
            name: SteadyFile(folder / name, "[stand] file is relative to the run file")
            for name in stand_files(table)
        }
        result = stand_reference(table, folder, t, segment, labels)
        read.update({name: file_digest(file.path) for name, file in files.items()})
        for file in files.values():
            file.check()
        return result

    try:
        run = read_record(path, reference, need_reference=need_reference, held=held, content=content)
        for name in stand_files(run.stand):
            run.input_sha256[name] = read.get(name) or file_digest(Path(path).parent / name)
        return run
    except (ArgumentError, UnitError) as error:
        raise RunFileError(f"{path}: {error.message}", remedy=error.remedy) from None


def stand_files(table: Any) -> list[str]:
    """Names of all files in a ``[stand]`` table and its inner tables, as written."""
    if isinstance(table, dict):
        own = [value for key, value in table.items() if key == "file" and isinstance(value, str)]
        return list(dict.fromkeys(own + [name for value in table.values() for name in stand_files(value)]))
    if isinstance(table, list):
        return list(dict.fromkeys(name for value in table for name in stand_files(value)))
    return []


def _check_unchanged(run: Run) -> None:
    """Refuse a stand whose files changed since the record was read."""
    for name in stand_files(run.stand):
        known = run.input_sha256.get(name)
        if known is not None and known != file_digest(Path(run.source).parent / name):
            raise RunFileError(f"[stand] file '{name}' changed after it was read", remedy="read the run again")


def stand_reference(
    table: dict[str, Any], folder: Path, t: Array, segment: NDArray[np.int32], labels: tuple[str, ...]
) -> tuple[Array, Array]:
    """Specific force [m/s^2] and base rate [rad/s] of the perfect stand at the samples, (n, 3) each.

    Raises
    ------
    ArgumentError
        If the table is not valid or does not fit the record. The message names the key.
    """
    followed, arrays = _known(table, folder, lambda: labels, segment), arrays_like(t)
    force, rate = (arrays.empty((3, t.size)).T for _ in range(2))
    for part in spans(t.size):
        force[part], rate[part] = followed.motion(t[part], segment[part])
    return force, rate


def _known(
    table: dict[str, Any],
    folder: Path,
    labels: Callable[[], tuple[str, ...]],
    segment: NDArray[np.int32] | None = None,
) -> FollowedStand:
    """A stand whose motion is known. A vibration table is refused: the phase of its drive is unknown."""
    stand, names = _build(table, folder)
    if stand.kind == "vibration-table":
        raise ArgumentError(
            "[stand] kind 'vibration-table': the phase of the drive is not known to the run file",
            remedy="log the reference and give [data] reference",
        )
    return _followed(stand, names, labels, segment)


def stand_changes(run: Run) -> Iterator[StandChange]:
    """Change of f for each stand-specific entry of the run file's ``[uncertainty]``, component by component.

    Raises
    ------
    RunFileError
        If an entry does not exist on the stand or is not valid.
    """
    named = run.uncertainty.of_the_stand()
    if not named:
        return
    try:
        stand, names = _build(run.stand or {}, Path(run.source).parent)
        _check_unchanged(run)
        t = _all_times(_followed(stand, names, lambda: run.labels), run)
        for name, written in named.items():
            standard, shape = _standard(name, written)
            for text, errors in _components(name, standard):
                if name in REPEATED and REPEATED[name][0] not in stand.accepted:
                    raise ArgumentError(
                        f"[uncertainty] {name} does not exist on a {stand.kind}", remedy=_repeatable(stand)
                    )
                errors.require(stand.accepted, stand.kind)
                change = partial(_change, stand, t, errors)
                yield StandChange(f"{name}{text[0]}", text[1], change, *shape, drawn_for(name))
    except PigaError as error:
        raise RunFileError(f"{run.source}: {error.message}", remedy=error.remedy) from None


def _repeated(name: str) -> str:
    """The imperfection to which an entry belongs."""
    return REPEATED[name][0] if name in REPEATED else name


def _repeatable(stand: Stand) -> str:
    """Remedy of an error message: the repeatability entries that a stand has."""
    names = [name for name, (error, _) in REPEATED.items() if error in stand.accepted or error in GENERAL]
    return f"it has: {', '.join(names)}"


def _change(stand: Stand, t: Array, errors: Imperfections, part: slice) -> Array:
    """Change of f [m/s^2] in a slice of rows, (n, 3)."""
    return force_change(stand, t[part], errors)


def _build(table: dict[str, Any], folder: Path) -> tuple[Stand, tuple[str, ...] | None]:
    """The stand, and the labels of its positions if they have names."""
    positions = table.get("positions")
    names = None
    if isinstance(positions, dict):
        names = tuple(positions)
        table = table | {"positions": list(positions.values())}
    try:
        built = msgspec.convert(table, SimpleStand | CompositeTable)
    except msgspec.ValidationError as error:
        raise ArgumentError(
            f"[stand]: {str(error).lower()}",
            remedy="write the table as in a scenario; the reference lists its keys",
        ) from None
    return built.build(folder), names


def _followed(
    stand: Stand,
    names: tuple[str, ...] | None,
    labels: Callable[[], tuple[str, ...]],
    segment: NDArray[np.int32] | None = None,
) -> FollowedStand:
    """The stand, with the time of every segment of the record on its plan."""
    if stand.kind in TIMED:
        return FollowedStand(stand)
    planned = [part for part in stand.segments() if part.recorded]
    by_name = dict(zip(names or tuple(part.label for part in planned), planned, strict=True))
    recorded = labels()
    parts = [by_name.get(label.split("/")[0]) for label in recorded]
    if None in parts:
        parts = _in_order(planned, recorded, segment)
    starts, durations = np.array([(part.start, part.duration) for part in parts if part is not None]).T
    return FollowedStand(stand, starts, durations)


def _all_times(followed: FollowedStand, run: Run) -> Array:
    """Time on the stand's plan [s] of all samples, (n,)."""
    times = arrays_like(run.t).empty(run.size)
    for rows in spans(run.size):
        times[rows] = followed.times(run.t[rows], run.segment_index[rows])
    return times


def _in_order(
    planned: list[Segment], labels: tuple[str, ...], segment: NDArray[np.int32] | None
) -> list[Segment | None]:
    """The planned part of each segment, in order. Segments whose rows are all left out may be absent from the plan."""
    used = (
        np.arange(len(labels))
        if segment is None
        else np.unique(np.concatenate([np.unique(segment[part]) for part in spans(segment.size)]))
    )
    if len(planned) == used.size < len(labels):
        order = dict(zip(used.tolist(), planned, strict=True))
        return [order.get(k, planned[0]) for k in range(len(labels))]
    if len(planned) != len(labels):
        raise ArgumentError(
            f"[stand] has {len(planned)} positions or levels, the record has {len(labels)} segments",
            remedy="name them: positions = { 'label' = 'angle', ... }",
        )
    return list(planned)


def _standard(name: str, written: Any) -> tuple[Any, tuple[str, float]]:
    """Standard uncertainty as written, or from a table with a distribution. The latter holds for each component."""
    if not isinstance(written, dict):
        return written, ("normal", math.inf)
    where = f"[uncertainty] {name}"
    if name == "angle_harmonics":
        raise ArgumentError(f"{where}: a list is needed", remedy="write e.g. [[2, '1 arcsec']]")
    try:
        spread = msgspec.convert(written, Spread)
    except msgspec.ValidationError as error:
        raise ArgumentError(
            f"{where}: {str(error).lower()}",
            remedy="write e.g. { half_width = '1 arcsec', distribution = 'rectangular' }",
        ) from None
    unit = next(str(e.metadata["unit"]) for e in fields(Imperfections) if e.name == _repeated(name))
    size = from_si(standard_uncertainty(spread, unit, where), unit)
    return f"{size:.9g} {unit}", shape_of(spread)


def _components(name: str, written: Any) -> Iterator[tuple[tuple[str, str], Imperfections]]:
    """``((suffix, value as written), imperfections with one component)`` for one entry."""
    where = "[uncertainty]"
    error = _repeated(name)
    if error == "angle_harmonics":
        for order, amplitude, *phase in written:
            for at in phase or ("0 deg", "90 deg"):
                suffix = f" order {order}" + ("" if phase else f" ({'sine' if at == '0 deg' else 'cosine'})")
                yield (suffix, str(amplitude)), imperfections({error: [[order, amplitude, at]]}, where=where)
    elif error == "levelling":
        values = written if isinstance(written, (list, tuple)) else (written, written)
        for axis, value in enumerate(values):
            pair = ["0 rad", "0 rad"]
            pair[axis] = value
            yield (f" axis {axis + 1}", str(value)), imperfections({error: pair}, where=where)
    else:
        yield ("", str(written)), imperfections({error: written}, where=where)
