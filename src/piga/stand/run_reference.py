"""The stand of a recorded test: its reference, if the log has none, and the effect of its errors.

A run file's ``[stand]`` table has the same keys as in a scenario. Static stands (dividing head, centrifuge and
rate table at constant rate) are matched to the record segment by segment: by label, if the labels of the
record are those of the stand, else in order. A vibration table, a logged profile and a composite are
matched by time.

A table in memory becomes a run here, too: with the same reading, checks and stands as a file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from piga.data import EXAMPLE, copy_example
from piga.errors import ArgumentError, PigaError, RunFileError, UnitError, needed
from piga.formats.columns import TableStream, is_time
from piga.reading.assemble import read_record, read_stream
from piga.reading.columns import file_digest, stand_files
from piga.records.arrays import empty, spans
from piga.records.run import Run
from piga.records.run_file import (
    REPEATED,
    Draw,
    RunFile,
    Spread,
    check_run_file,
    drawn_for,
    standard_uncertainty,
)
from piga.records.terms import GYRO
from piga.results import Array, Result
from piga.stand.profile import GENERAL, NONE, Imperfections, Segment, Stand, force_change, imperfections
from piga.stand.scenario import CompositeTable, SimpleStand
from piga.text_files import convert_table, converted, explained
from piga.units import from_si

_MOST_NAMED = 24
"""Most segments that a message names."""
_TIMED = ("vibration-table", "profile", "composite")
"""Stands that are matched to a record by time."""


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


def read_run(path: str | Path, *, need_reference: bool = True, content: bytes | None = None) -> Run:
    """Read a recorded test.

    ``path`` is the run file (TOML). Its data file must lie beside it. Without reference columns the reference is computed
    from its ``[stand]`` table. With ``need_reference`` false a record with neither is read too, with ``f`` nan: instruments
    compensated together need no reference. ``content`` holds bytes of the run file, in place of those on disk.

    Raises
    ------
    RunFileError
        If the run file is not valid.
    DataError
        If the data file does not hold what the run file says. The message names file, row, column and remedy.
    """
    try:
        return read_record(Path(path), need_reference=need_reference, content=content)
    except (ArgumentError, UnitError) as error:
        raise RunFileError(f"{path}: {error.message}", remedy=error.remedy) from None


def _check_unchanged(run: Run) -> None:
    """Refuse a stand whose files changed since the record was read."""
    for name in stand_files(run.stand):
        digest = run.input_sha256.get(name)
        if digest is not None and digest != file_digest(Path(run.source).parent / name):
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
    stand, names = _build(table, folder)
    if stand.kind == "vibration-table":
        raise ArgumentError(
            "[stand] kind 'vibration-table': the phase of the drive is not known to the run file",
            remedy="log the reference and give [data] reference",
        )
    times = plan_times(stand, names, labels, t, segment)
    force, rate = (empty((3, t.size)).T for _ in range(2))
    for part in spans(t.size):
        force[part], rate[part] = stand.motion(times[part], NONE)
    return force, rate


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
        t = plan_times(stand, names, run.labels, run.t, run.segment_index)
        for name, written in named.items():
            error = REPEATED[name][0] if name in REPEATED else name
            if name != error and error not in (*GENERAL, *stand.accepted):
                has = [one for one, (of, _) in REPEATED.items() if of in (*GENERAL, *stand.accepted)]
                raise ArgumentError(
                    f"[uncertainty] {name} does not exist on a {stand.kind}", remedy=f"it has: {', '.join(has)}"
                )
            standard, shape = _standard(name, error, written)
            for suffix, value, part in _components(error, standard):
                if float(str(value).partition(" ")[0]) < 0.0:
                    raise ArgumentError(
                        f"[uncertainty] {name}: '{value}' is negative", remedy="give a standard uncertainty"
                    )
                errors = imperfections({error: part}, where="[uncertainty]")
                errors.require(stand.accepted, stand.kind, "[uncertainty]")
                change = partial(_change, stand, t, errors)
                yield StandChange(f"{name}{suffix}", str(value), change, *shape, drawn_for(name))
    except PigaError as error_:
        raise RunFileError(f"{run.source}: {error_.message}", remedy=error_.remedy) from None


def _change(stand: Stand, t: Array, errors: Imperfections, part: slice) -> Array:
    """Change of f [m/s^2] in a slice of rows, (n, 3)."""
    return force_change(stand, t[part], errors)


def _standard(name: str, error: str, written: Any) -> tuple[Any, tuple[str, float]]:
    """Standard uncertainty as written, or from a table with a distribution. The latter holds for each component."""
    if not isinstance(written, dict):
        return written, ("normal", math.inf)
    where = f"[uncertainty] {name}"
    if name == "angle_harmonics":
        raise ArgumentError(f"{where}: a list is needed", remedy="write e.g. [[2, '1 arcsec']]")
    try:
        spread: Spread = convert_table(name, written, Spread)
    except ArgumentError as invalid:
        remedy = "write e.g. { half_width = '1 arcsec', distribution = 'rectangular' }"
        raise ArgumentError(f"[uncertainty.{invalid.message[1:]}", remedy=remedy) from None
    unit = next(str(e.metadata["unit"]) for e in fields(Imperfections) if e.name == error)
    standard, distribution, degrees = standard_uncertainty(spread, unit, where)
    return f"{from_si(standard, unit):.9g} {unit}", (distribution, degrees)


def _components(error: str, written: Any) -> Iterator[tuple[str, Any, Any]]:
    """Suffix of the name, value as written, and value of the imperfection, of each component of one entry."""
    if error == "angle_harmonics":
        for order, amplitude, *phase in written:
            for at, wave in ((phase[0], ""),) if phase else (("0 deg", " (sine)"), ("90 deg", " (cosine)")):
                yield f" order {order}{wave}", amplitude, [[order, amplitude, at]]
    elif error == "levelling":
        for axis, value in enumerate(written if isinstance(written, (list, tuple)) else (written, written)):
            yield f" axis {axis + 1}", value, ["0 rad"] * axis + [value] + ["0 rad"] * (1 - axis)
    else:
        yield "", written, written


def _build(table: dict[str, Any], folder: Path) -> tuple[Stand, tuple[str, ...] | None]:
    """The stand, and the labels of its positions if they have names."""
    positions = table.get("positions")
    names = None
    if isinstance(positions, dict):
        names = tuple(positions)
        table = table | {"positions": list(positions.values())}
    return convert_table("stand", table, SimpleStand | CompositeTable).build(folder), names


def plan_times(
    stand: Stand,
    names: tuple[str, ...] | None,
    labels: tuple[str, ...],
    t: Array,
    segment: NDArray[np.int32],
) -> Array:
    """Time on the stand's plan [s] of every sample, (n,): from the first sample of its segment, no further than the dwell.

    ``names`` are the labels of the positions, if they have names. A stand that is matched by time has the times ``t`` itself.
    """
    if stand.kind in _TIMED:
        return t
    planned = [part for part in stand.segments() if part.recorded]
    by_name = dict(zip(names or tuple(part.label for part in planned), planned, strict=True))
    names_of_parts = [label.split("/")[0] for label in labels]
    parts = [by_name.get(label) for label in names_of_parts]
    if None in parts or (
        names is None and len(set(names_of_parts)) != len(planned)
    ):  # numbers alone match by chance
        parts = _in_order(planned, labels, segment)
    starts, durations = np.array([(part.start, part.duration) for part in parts if part is not None]).T
    first, times = np.zeros(len(labels)), empty(t.size)
    first[segment[::-1]] = t[::-1]  # of the samples of a segment, the first is written last
    for rows in spans(t.size):
        place = segment[rows]
        times[rows] = starts[place] + np.clip(t[rows] - first[place], 0.0, durations[place])
    return times


def _in_order(
    planned: list[Segment], labels: tuple[str, ...], segment: NDArray[np.int32]
) -> list[Segment | None]:
    """The planned part of each segment, in order. Segments whose rows are all left out may be absent from the plan."""
    used = np.flatnonzero(np.bincount(segment, minlength=len(labels)))
    if len(planned) == used.size < len(labels):
        order = dict(zip(used.tolist(), planned, strict=True))
        return [order.get(k, planned[0]) for k in range(len(labels))]
    if len(planned) != len(labels):
        more = ", ..." if len(labels) > _MOST_NAMED else ""
        raise ArgumentError(
            f"[stand] has {len(planned)} positions or levels, the record has {len(labels)} segments "
            f"({', '.join(labels[:_MOST_NAMED])}{more})",
            remedy="give them in order, positions = ['0 deg', ...], or by name, positions = { 'label' = 'angle', ... }; "
            "or correct [instrument] counts_per_revolution or scale_factor: if they are wrong, a count looks lost",
        )
    return list(planned)


WHERE = Path("table")
"""Name of a table in memory, in messages."""


def _as_arrow(table: object) -> Any:
    """Any table as a ``pyarrow.Table``."""
    pa = needed("pyarrow")
    try:
        if isinstance(table, np.ndarray) and table.dtype.names:
            table = {name: table[name] for name in table.dtype.names}
        if isinstance(table, Mapping):
            return pa.table({name: np.asarray(column) for name, column in table.items()})
        return pa.table(table)
    except (TypeError, ValueError, pa.ArrowException) as error:
        raise ArgumentError(
            f"table: a {type(table).__name__} does not give Arrow columns ({str(error).splitlines()[0]})",
            remedy="pass a table of pandas, polars (a lazy one after collect()) or pyarrow, or a dict of arrays",
        ) from None


def run_from_table(
    table: object, described: dict[str, Any], units: dict[str, str], unit: str, *, si: bool
) -> Run:
    """A run from a table: :meth:`piga.Run.from_dataframe`.

    ``described`` holds the tables of a run file; the columns of ``[data]`` have no units yet. ``units`` are those of columns,
    ``unit`` is that of the output rate. ``si``: columns without a unit are SI.

    Raises
    ------
    ArgumentError
        If the description is not valid. The message names the table and key of the run file.
    DataError
        If the columns do not hold what the description says.
    """
    arrow = _as_arrow(table)
    names, data = arrow.schema.names, described["data"]
    for name in units:
        if name not in names:
            raise ArgumentError(
                f"units: there is no column '{name}'", remedy=f"the columns are: {', '.join(names)}"
            )
    time: str = (data["time"] or {}).get("column", "")
    if time in names and is_time(arrow.schema.field(time).type):
        if units.get(time, "s") != "s":
            raise ArgumentError(f"units: column '{time}' holds dates or durations", remedy="leave its unit out")
        units |= {time: "s"}
    own = {field.name: (field.metadata or {}).get(b"unit", b"").decode() for field in arrow.schema}
    attached = attributes.get("units") if isinstance(attributes := getattr(table, "attrs", {}), dict) else None
    if isinstance(attached, dict):  # of a pandas data frame, by to_dataframe
        own |= {str(name): str(unit) for name, unit in attached.items()}
    units = {name: unit for name, unit in own.items() if unit} | units
    try:
        _add_units(data, unit, units, () if si else names)
        run_file = check_run_file(converted(described, RunFile))
        columns = run_file.data.number_columns(), run_file.data.label_column
        stream = TableStream(WHERE, arrow, *columns)
        stream.units |= {name: unit for name, unit in units.items() if name in stream.units}
        return read_stream(WHERE, run_file, stream)
    except msgspec.ValidationError as error:
        text, remedy = explained(str(error), RunFile, described)
        raise ArgumentError(f"{WHERE}: {text}", remedy=remedy) from None
    except (RunFileError, UnitError) as error:
        raise ArgumentError(f"{WHERE}: {error.message}", remedy=error.remedy) from None


def _add_units(data: dict[str, Any], output: str, units: dict[str, str], stated: Sequence[str]) -> None:
    """Give the columns of a ``[data]`` table their units. Those of the columns ``stated`` must be in ``units``; others are SI."""
    kind = data["output"]["kind"]
    likes = {"output": "rad/s" if kind == "rate" else "rad", "time": "s", "temperature": "K", "segment": ""}
    likes |= {"reference": "m/s^2", "base_rate": "rad/s"}
    for role, like in likes.items():
        entry, three = data[role], role in ("reference", "base_rate")
        if entry is None:
            continue
        names = entry["columns" if three else "column"] if isinstance(entry, dict) else entry
        listed = list(names) if three and not isinstance(names, str) else [names]
        if role == "segment" or (role == "output" and kind == "counts"):
            continue
        if role == "output" and output != GYRO:
            entry["unit"] = units.get(names, output)
            continue
        for name in listed:
            if name in stated and name not in units and like != "s":
                raise ArgumentError(
                    f"units: that of column '{name}' is not stated",
                    remedy=f"add units={{'{name}': '{like}'}}, or units='SI' if all columns are in SI",
                )
        several = {units.get(name, like) for name in listed}
        if len(several) > 1:
            raise ArgumentError(
                f"{role}: its columns have several units: {', '.join(sorted(several))}", remedy="use one unit"
            )
        entry["unit"] = several.pop()


def example_run() -> Run:
    """The shipped record: a dividing-head test of 24 positions, with its run file. ``piga demo`` calibrates it.

    Examples
    --------
    >>> import piga
    >>> run = piga.example_run()
    >>> run.serial, run.size, len(run.labels)
    ('tumble-a', 28824, 24)
    """
    with TemporaryDirectory() as folder:
        run = read_run(copy_example(Path(folder)))
    return replace(run, source=f"{EXAMPLE}.toml")
