"""Write files of compensated rows chunk by chunk in bounded memory."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from piga.compensation.model import FLAGS, MEANING
from piga.errors import ArgumentError
from piga.formats.parquet_writer import number_column
from piga.records.calibration.coverage import TYPE_A_ONLY

WRITTEN_UNITS = {"t": "s", "residual": "m/s^2", "flags": "1"}
"""Unit of each column that is neither a force nor an increment."""

FORMATS = {".parquet": "parquet", ".pq": "parquet", ".csv": "csv"}
"""Kind of file by suffix."""

GROUP_ROWS = 1 << 16
"""Rows per row group of a Parquet file, whatever the size of the chunks."""


Inputs = Sequence[tuple[str, str]]
"""Input files of a result: name, and SHA-256 of what was read."""


def inputs_listed(inputs: Inputs) -> list[dict[str, str]]:
    """Inputs for JSON."""
    return [{"file": name, "sha256": digest} for name, digest in inputs]


def unit_of_column(name: str) -> str:
    """Unit of a column: forces in m/s^2, increments (``dv...``) in m/s."""
    if name in WRITTEN_UNITS:
        return WRITTEN_UNITS[name]
    return "m/s" if name.startswith("dv") else "m/s^2"


def format_of(path: Path) -> str:
    """``parquet`` or ``csv``, by the suffix.

    Raises
    ------
    ArgumentError
        For any other suffix.
    """
    file_format = FORMATS.get(path.suffix.lower())
    if file_format is None:
        raise ArgumentError(
            f"{path}: piga does not write files of kind '{path.suffix}'",
            remedy="use a name that ends in .parquet or .csv",
        )
    return file_format


def schema_of(
    columns: Mapping[str, NDArray],
    empty_cells: bool = False,
    notes: tuple[str, ...] = (),
    inputs: Inputs = (),
) -> Any:
    """Arrow schema: types, a unit per column, the meaning of the flag bits, notes and inputs.

    ``empty_cells``: True if cells may be empty.
    """
    import pyarrow as pa

    fields = [
        pa.field(
            name, pa.int32() if name == "flags" else pa.float64(), empty_cells, {"unit": unit_of_column(name)}
        )
        for name in columns
    ]
    metadata = {
        "piga.flags": json.dumps(FLAGS),
        "piga.flag_meanings": json.dumps(MEANING),
        "piga.units": json.dumps({name: unit_of_column(name) for name in columns}),
    }
    metadata |= {"piga.notes": json.dumps(notes)} if notes else {}
    metadata |= {"piga.inputs": json.dumps(inputs_listed(inputs))} if inputs else {}
    return pa.schema(fields, metadata=metadata)


class TableWriter:
    """Write rows to a Parquet or CSV file; a context manager.

    CSV columns are named ``name [unit]``. A missing value is an empty cell in CSV and nan in Parquet. ``notes`` come
    from :func:`piga.compensation.result.notes_on`. Parquet stores them as metadata; in CSV the uncertainties are named
    ``u_ax (Type A only) [m/s^2]``. ``inputs`` are stored in the metadata of Parquet only.
    """

    def __init__(
        self, path: Path, kind: str | None = None, notes: tuple[str, ...] = (), inputs: Inputs = ()
    ) -> None:
        self._path, self._notes, self._inputs = path, notes, tuple(inputs)
        self._kind = kind or format_of(path)
        self._writer: Any = None
        self._schema: Any = None
        self._held: Any = None
        self.rows = 0

    def write(self, columns: Mapping[str, NDArray]) -> None:
        """Append rows; every call must have the same columns."""
        import pyarrow as pa

        if self._writer is None:
            self._open(columns)
        arrays = [number_column(column, empty_cells=self._kind == "csv") for column in columns.values()]
        table = pa.Table.from_arrays(arrays, schema=self._schema)
        self.rows += table.num_rows
        self._held = table if self._held is None else pa.concat_tables((self._held, table))
        whole = self._held.num_rows // GROUP_ROWS * GROUP_ROWS
        if whole:
            self._writer.write_table(self._held.slice(0, whole), GROUP_ROWS)
            self._held = self._held.slice(whole)

    def _open(self, columns: Mapping[str, NDArray]) -> None:
        import pyarrow as pa
        from pyarrow import csv, parquet

        schema = schema_of(columns, self._kind == "csv", self._notes, self._inputs)
        if self._kind == "csv":
            names = [self._heading(name) for name in columns]
            self._schema = pa.schema([field.with_name(name) for field, name in zip(schema, names, strict=True)])
            options = csv.WriteOptions(quoting_style="none", quoting_header="none")
            self._writer = csv.CSVWriter(str(self._path), self._schema, write_options=options)
        else:
            self._schema = schema
            self._writer = parquet.ParquetWriter(
                str(self._path), schema, compression="none", use_dictionary=False, write_statistics=False
            )

    def _heading(self, name: str) -> str:
        """Name of a CSV column."""
        if name == "flags":
            return name
        short = TYPE_A_ONLY.partition(";")[0]
        said = f" ({short})" if name.startswith("u_") and any(TYPE_A_ONLY in n for n in self._notes) else ""
        return f"{name}{said} [{unit_of_column(name)}]"

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            if self._held.num_rows or self.rows == 0:
                self._writer.write_table(self._held, GROUP_ROWS)
            self._writer.close()
            self._writer = self._held = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        elif self._writer is not None:
            with suppress(Exception):  # the error that ended the writing is the one to be told
                self._writer.close()
            self._writer = self._held = None


def write_table(path: Path, columns: Mapping[str, NDArray], kind: str, notes: tuple[str, ...] = ()) -> None:
    """Write whole columns at once."""
    with TableWriter(path, kind, notes) as writer:
        rows = len(next(iter(columns.values())))
        for start in range(0, max(rows, 1), GROUP_ROWS):
            writer.write(
                {name: np.asarray(column)[start : start + GROUP_ROWS] for name, column in columns.items()}
            )
