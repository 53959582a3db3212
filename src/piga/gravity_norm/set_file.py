"""Run file of a set of accelerometers whose reference is the size of gravity."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from piga.errors import RunFileError
from piga.gravity_norm.estimate import Convention, SetCalibration, calibrate_set
from piga.reading.columns import read_series
from piga.records.run_file import (
    MOST_HEAD_ROWS,
    Columns,
    DataTable,
    HeadPair,
    HeadRow,
    OutputColumn,
    Quantity,
    Seconds,
    TimeColumn,
    TomlTable,
    in_unit,
    is_set,
)
from piga.records.text_files import read_toml, toml_bytes, toml_document


class SetInstrument(TomlTable, frozen=True):
    """``[instrument]``: identity of the set, and the size of gravity."""

    serial: str
    gravity: Annotated[Quantity, in_unit("m/s^2")]
    gravity_uncertainty: Annotated[Quantity, in_unit("m/s^2")] = "0 m/s^2"


class SetOutputs(TomlTable, frozen=True):
    """Columns of three or more accelerometers, with one unit."""

    columns: Annotated[tuple[str, ...], msgspec.Meta(min_length=3)]
    unit: str


class SetData(TomlTable, frozen=True):
    """``[data]``: the file, its columns and, if the file does not show it, its format."""

    file: str
    reference: Literal["gravity-norm"]
    outputs: SetOutputs
    time: TimeColumn | None = None
    sample_rate: Quantity | None = None
    delimiter: str | None = None
    decimal: Literal[".", ","] | None = None
    skip_rows: Annotated[int, msgspec.Meta(ge=0, le=MOST_HEAD_ROWS)] = 0
    header_row: HeadRow | bool | HeadPair | None = None

    def table(self) -> DataTable:
        """The table of a run file that reads all columns."""
        columns = Columns(self.outputs.columns, "1")  # type: ignore[arg-type]
        return DataTable(
            self.file, OutputColumn(self.outputs.columns[0], "counts"), columns, self.time, self.sample_rate,
            delimiter=self.delimiter, decimal=self.decimal, skip_rows=self.skip_rows, header_row=self.header_row,
        )  # fmt: skip


class SetModel(TomlTable, frozen=True):
    """``[model]``: convention of the axes, and window for the static spells."""

    convention: Convention = "upper"
    window: Seconds = "1 s"


class SetFile(TomlTable, frozen=True):
    """A whole run file of a set."""

    instrument: SetInstrument
    data: SetData
    model: SetModel = SetModel()


def is_set_file(path: Path) -> bool:
    """Whether a run file is one of a set: its ``[data] reference`` is ``"gravity-norm"``."""
    return path.suffix == ".toml" and is_set(toml_document(path))


def calibrate_set_file(path: str | Path) -> SetCalibration:
    """Calibrate a set by its run file.

    Raises
    ------
    RunFileError, DataError, IdentifiabilityError
        As :func:`calibrate_set`. The message names file, key, row or column.
    """
    path = Path(path)
    content = toml_bytes(path)
    file = read_toml(path, SetFile, content)
    data, outputs = file.data, file.data.outputs
    if (data.time is None) == (data.sample_rate is None):
        raise RunFileError(f"{path}: [data] needs either time or sample_rate", remedy="give one of the two")
    values, t, digests = read_series(path.parent, data.table(), outputs.columns)
    given, model = file.instrument.in_si("[instrument] "), file.model.in_si("[model] ")
    result = calibrate_set(
        t, values, given["gravity"], gravity_std=given["gravity_uncertainty"], window=model["window"],
        convention=file.model.convention, unit=outputs.unit, names=outputs.columns, serial=file.instrument.serial,
    )  # fmt: skip
    return replace(result, input_sha256={path.name: hashlib.sha256(content).hexdigest()} | digests)
