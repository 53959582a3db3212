"""Columns of a data file, chunk by chunk; conversion of Arrow arrays to NumPy; Parquet in and out.

What piga writes as Parquet has a checksum for each page. A checksum that a file has is compared when the page is read.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from piga.errors import CalibrationError, DataError, Fix, Where
from piga.records.calibration.diagnostics import Event
from piga.tables import arrow_table
from piga.text_files import first_line, open_regular, toml_text

if TYPE_CHECKING:
    import pyarrow as pa

    from piga.records.calibration.calibration import Calibration
    from piga.records.run import Run

_CHUNK_ROWS = 1 << 16
"""Rows per chunk of a Parquet file or a container."""
MOST_LISTED = 60
"""Most columns that a message lists."""
GROUP_ROWS = 1 << 20
"""Rows of a row group of Parquet that is written."""
REMEDIES = ("correct the name of the column", "store it as double or integer")
"""Remedies for a column that is not there, and for one that holds no numbers."""
_PER_SECOND = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}


@dataclass(frozen=True)
class FileChunk:
    """Consecutive rows of a file.

    ``numbers`` holds values (n,) by column in the unit of the file; a missing value is nan. ``codes`` is the segment column as
    indices into the stream's ``label_names`` (-1: no label), or None. ``rows`` are 1-based file rows.
    """

    numbers: dict[str, NDArray[np.float64]]
    codes: NDArray[np.int32] | None
    rows: NDArray[np.int64]


class RecordStream:
    """A data file being read: base of all readers. Each refuses a file that it cannot read as requested.

    ``path`` is the name of the file in messages, ``numeric`` and ``label`` name the number columns and the segment column.
    ``units`` holds the unit of each number column for which the file states one.
    """

    def __init__(self, path: Path, numeric: Iterable[str], label: str | None) -> None:
        self.path, self.numeric, self.label = path, tuple(dict.fromkeys(numeric)), label
        self.wanted = list(dict.fromkeys([*self.numeric, *([] if label is None else [label])]))
        self.units: dict[str, str] = {}
        self._codes: dict[str, int] = {}
        self._missing: dict[str, tuple[int, int]] = {}
        self._first_days: dict[str, int] = {}

    @property
    def label_names(self) -> list[str]:
        """Segment labels so far, in order of appearance."""
        return list(self._codes)

    def take_schema(self, schema: Any) -> None:
        """Check the wanted columns of an Arrow schema, and take their units: those that fields state, seconds for times."""
        import pyarrow as pa

        for name in self.wanted:
            if name not in schema.names:
                raise no_column(self.path, name, schema.names, remedy=REMEDIES[0])
            if schema.names.count(name) > 1:
                raise refusal(self.path, f"duplicate column name '{name}'", "rename one of them", name)
            kind, metadata = schema.field(name).type, schema.field(name).metadata or {}
            if name not in self.numeric:
                continue
            if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or is_time(kind)):
                raise refusal(self.path, f"column '{name}' holds {kind}, not numbers", REMEDIES[1], name)
            unit = "s" if is_time(kind) else metadata.get(b"unit", b"").decode("utf-8", errors="replace")
            self.units |= {name: unit} if unit else {}

    def batches(self) -> Iterator[tuple[Any, NDArray[np.int64]]]:
        """Record batches of Arrow, and the file rows (n,) of each."""
        raise NotImplementedError

    def chunks(self) -> Iterator[FileChunk]:
        """The rows in order, once."""
        return (self._chunk(batch, rows) for batch, rows in self.batches())

    def events(self) -> list[Event]:
        """Faults and omissions; complete after the last chunk."""
        missing = [(name, *self._missing[name]) for name in self.numeric if name in self._missing]
        return [Event("missing-value", count, first, f"column '{name}'") for name, count, first in missing]

    def _chunk(self, batch: Any, rows: NDArray[np.int64]) -> FileChunk:
        """A batch as a chunk. Missing values are counted."""
        numbers = {}
        for name in self.numeric:
            column = batch.column(name)
            if column.null_count:
                count, first = self._missing.get(name, (0, int(rows[np.argmax(nulls_of(column))])))
                self._missing[name] = count + column.null_count, first
            numbers[name] = self._seconds(name, column) if is_time(column.type) else numbers_of(column)
        codes = None if self.label is None else self._codes_of(batch.column(self.label))
        return FileChunk(numbers, codes, rows)

    def _codes_of(self, column: Any) -> NDArray[np.int32]:
        """Codes of label cells; -1 where a cell is empty. A label has the same code in all chunks."""
        import pyarrow as pa

        coded = pa.types.is_dictionary(column.type)
        encoded = column if coded else column.cast(pa.string()).dictionary_encode()
        indices = encoded.indices.cast(pa.int32())
        index, words = _plain_values(indices, np.int32).copy(), encoded.dictionary.cast(pa.string())
        index[nulls_of(indices)] = len(words)
        table = np.full(len(words) + 1, -1, dtype=np.int32)
        first = np.sort(np.unique(index, return_index=True)[1])
        for place in index[first][index[first] < len(words)].tolist():
            word = (words[place].as_py() or "").strip()
            if word:
                table[place] = self._codes.setdefault(word, len(self._codes))
        return table[index]

    def _seconds(self, name: str, column: Any) -> NDArray[np.float64]:
        """Times of an Arrow array in seconds since the midnight before the first one. Null entries are nan."""
        import pyarrow as pa

        per_second = _PER_SECOND[column.type.unit]
        ticks = _plain_values(column, np.int32 if column.type.bit_width == 32 else np.int64).astype(np.int64)
        empty = nulls_of(column)
        if pa.types.is_timestamp(column.type) and not empty.all():
            day = 86400 * per_second
            ticks -= self._first_days.setdefault(name, int(ticks[~empty][0] // day)) * day
        seconds: NDArray[np.float64] = ticks / per_second
        seconds[empty] = np.nan
        return seconds


class TableStream(RecordStream):
    """A table in memory: an Arrow ``table``."""

    def __init__(self, path: Path, table: Any, numeric: Iterable[str], label: str | None) -> None:
        super().__init__(path, numeric, label)
        self.take_schema(table.schema)
        self.table, self.rows = table, np.arange(1, 1 + table.num_rows)

    def batches(self) -> Iterator[tuple[Any, NDArray[np.int64]]]:
        """Record batches, and the file rows of each."""
        return with_rows(self.table.select(self.wanted).to_batches(max_chunksize=_CHUNK_ROWS), self.rows)


def with_rows(batches: Iterable[Any], rows: NDArray[np.int64]) -> Iterator[tuple[Any, NDArray[np.int64]]]:
    """Record batches, and the file rows of each; ``rows`` are those of all."""
    start = 0
    for batch in batches:
        yield batch, rows[start : start + batch.num_rows]
        start += batch.num_rows


def is_time(kind: Any) -> bool:
    """True for the Arrow types of time stamps, times of day and durations. They are read as seconds."""
    import pyarrow as pa

    return bool(pa.types.is_timestamp(kind) or pa.types.is_time(kind) or pa.types.is_duration(kind))


def column_letter(index: int) -> str:
    """Spreadsheet letter of a 0-based column index: 0 is A, 26 is AA."""
    before, rest = divmod(index, 26)
    return (column_letter(before - 1) if before else "") + chr(ord("A") + rest)


def _plain_values(column: Any, kind: type[np.generic]) -> NDArray[Any]:
    """The memory of an Arrow array, read-only. Null entries have arbitrary values. Arrow's ``to_numpy`` would load pandas."""
    values = np.frombuffer(column.buffers()[1] or b"", dtype=kind, count=column.offset + len(column))
    return values[column.offset :]


def numbers_of(column: Any) -> NDArray[np.float64]:
    """Values of an Arrow array of numbers as float64; null becomes nan. Read-only where they are the memory of the array."""
    import pyarrow as pa

    kind = column.type
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        column = column.cast(pa.float64(), safe=False)
    # NumPy converts plain numbers: Arrow's cast loads its compute functions, which takes a tenth of a second.
    values = _plain_values(column, column.type.to_pandas_dtype()).astype(np.float64, copy=column.null_count > 0)
    if column.null_count:
        values[nulls_of(column)] = np.nan
    return values


def nulls_of(column: Any) -> NDArray[np.bool_]:
    """True for null entries of an Arrow array."""
    bitmap = column.buffers()[0]
    if bitmap is None:
        return np.zeros(len(column), dtype=np.bool_)
    bits = np.unpackbits(np.frombuffer(bitmap, dtype=np.uint8), bitorder="little")
    return bits[column.offset : column.offset + len(column)] == 0


def no_column(
    path: Path,
    name: str | Sequence[str],
    present: Iterable[str],
    row: int | None = None,
    remedy: str = REMEDIES[0],
    fixes: Sequence[Fix] = (),
) -> DataError:
    """The error for columns that are not in the file. It lists the columns of the file, whose names stand in ``row``."""
    names, missing = tuple(present), (name,) if isinstance(name, str) else tuple(name)
    more = f" and {len(names) - MOST_LISTED} more" if len(names) > MOST_LISTED else ""
    listed, shown = ", ".join(f"'{one}'" for one in missing), ", ".join(names[:MOST_LISTED]) + more
    place = "" if row is None else f"row {row}: "
    words = f"{path}: {place}no column {listed}; the columns are: {shown or 'none'}"
    return DataError(words, remedy=remedy, where=Where(path, row, missing), columns=names, fixes=fixes)


def refusal(
    path: Path, words: str, remedy: str, *columns: str, row: int | None = None, fixes: Sequence[Fix] = ()
) -> DataError:
    """The error of a file, of a row in it, or of columns. ``fixes`` are keys of the run file that resolve it."""
    place = "" if row is None else f"row {row}: "
    return DataError(f"{path}: {place}{words}", remedy=remedy, where=Where(path, row, columns), fixes=fixes)


# -- Parquet -------------------------------------------------------------------------------------------


class ParquetStream(RecordStream):
    """The named columns of a Parquet file."""

    def __init__(self, path: Path, numeric: tuple[str, ...], label: str | None) -> None:
        super().__init__(path, numeric, label)
        with _open(path) as source:
            self.take_schema(source.schema_arrow)
            if source.metadata.num_rows == 0:
                raise refusal(path, "no data row", "check that the logger wrote data")

    def batches(self) -> Iterator[tuple[Any, NDArray[np.int64]]]:
        """Record batches, and the file rows of each."""
        row = 1
        with _open(self.path, [name for name in self.wanted if name not in self.numeric]) as source:
            for batch in source.iter_batches(_CHUNK_ROWS, columns=self.wanted):
                yield batch, np.arange(row, row + batch.num_rows)
                row += batch.num_rows


@contextmanager
def _open(path: Path, labels: Sequence[str] = ()) -> Iterator[Any]:
    import pyarrow as pa
    from pyarrow import parquet

    try:
        with (
            open_regular(path, wanted="the data file in [data] file") as stream,
            parquet.ParquetFile(
                stream,
                pre_buffer=False,
                buffer_size=1 << 18,
                read_dictionary=list(labels),
                page_checksum_verification=True,
            ) as source,
        ):
            yield source
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        words = f"not a readable Parquet file ({first_line(error)})"
        raise refusal(path, words, "the file is damaged or was altered: export it again") from None


def write_run_parquet(run: Run, path: Path) -> None:
    """Write the used samples of a run.

    The field of every column has ``unit``. The schema holds ``serial``, ``source``, ``input_sha256`` and
    ``quality`` (all detected and repaired faults, as JSON).
    """
    metadata = {
        "serial": run.serial,
        "source": Path(run.source).name,
        "input_sha256": json.dumps(run.input_sha256),
        "quality": json.dumps(msgspec.to_builtins(run.quality)),
    }
    _write(arrow_table(run.table_columns(), metadata), path)


def _write(table: pa.Table, path: Path) -> None:
    """Write a table, packed, with a checksum for each page. A dictionary of measured numbers would take time and space."""
    import pyarrow as pa
    from pyarrow import parquet

    texts = [f.name for f in table.schema if not (pa.types.is_floating(f.type) or pa.types.is_integer(f.type))]
    options: dict[str, Any] = {"compression": "zstd", "use_dictionary": texts, "write_page_checksum": True}
    parquet.write_table(table, path, GROUP_ROWS, **options)


def data_table(run: Run, file: str) -> str:
    """The ``[data]`` table of a run file that reads the Parquet back."""
    output = {"column": "output", "kind": run.quantity.replace("count", "counts")}
    data = {
        "file": file,
        "time": {"column": "t", "unit": "s"},
        "output": output if run.quantity == "count" else output | {"unit": run.output_unit},
        "reference": {"columns": ["fx", "fy", "fz"], "unit": "m/s^2"},
        "base_rate": {"columns": ["wx", "wy", "wz"], "unit": "rad/s"},
        "temperature": {"column": "temperature", "unit": "K"},
        "segment": "segment",
    }
    without = {name for name in ("base_rate", "temperature") if getattr(run, name) is None}
    return toml_text({"data": {key: value for key, value in data.items() if key not in without}}).rstrip("\n")


def write_residuals(calibration: Calibration, path: Path) -> None:
    """Write the residuals of a fresh calibration: the columns of :class:`piga.Residuals`."""
    residuals = calibration.residuals
    if residuals is None:
        words = "this calibration was read from a file and holds no residuals"
        raise CalibrationError(words, remedy="calibrate again")
    columns = residuals.table_columns()
    columns["segment"] = columns["segment"]._replace(labels=[one.label for one in calibration.segments])
    if "run" in columns:
        columns["run"] = columns["run"]._replace(labels=[run.name for run in calibration.runs])
    metadata = {"serial": calibration.serial, "software": calibration.provenance.software}
    _write(arrow_table(columns, metadata), path)
