"""The triad file (TOML): which instruments are solved together, and how they are mounted."""

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec
import numpy as np

from piga.compensation.model import Phase
from piga.compensation.mounting import Mounted
from piga.errors import RunFileError
from piga.records import Calibration, read_toml
from piga.records.calibration_json import read_with_digest
from piga.records.run_file import Quantity
from piga.records.text_files import toml_bytes, toml_document
from piga.units import to_si

Row = tuple[float, float, float]


class TriadInstrument(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """``[[triad.instrument]]``: run, calibration and axes (rows X0, Y0, Z0 in the common frame)."""

    run: str
    calibration: str
    axes: tuple[Row, Row, Row]
    phase: Quantity | None = None


class TriadTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """``[triad]``."""

    instrument: tuple[TriadInstrument, ...]


class TriadFile(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A whole triad file."""

    triad: TriadTable


def is_triad_file(path: Path) -> bool:
    """True when a TOML file has a table ``[triad]`` (a file that cannot be read is told by its reader)."""
    try:
        return "triad" in toml_document(path)
    except RunFileError:
        return False


def read_triad(path: Path) -> tuple[list[Path], list[Mounted], list[tuple[str, str]]]:
    """Run files and mounted instruments of a triad file; file names are relative to it.

    Last come the triad file and the calibrations: name, and SHA-256 of what was read.

    Raises
    ------
    RunFileError
        If the file is not valid.
    CalibrationError
        If a calibration it names cannot be read.
    """
    raw = toml_bytes(path)
    file = read_toml(path, TriadFile, raw)
    items = file.triad.instrument
    if len(items) < 3:
        raise RunFileError(
            f"{path}: [[triad.instrument]] stands {len(items)} times", remedy="three or more are needed"
        )
    read = [read_with_digest(path.parent / item.calibration) for item in items]
    mounted = [
        Mounted(
            calibration,
            np.array(item.axes),
            None if item.phase is None else Phase(to_si(item.phase, "rad", what=f"{path}: phase")),
        )
        for item, (calibration, _) in zip(items, read, strict=True)
    ]
    named = [Path(item.calibration).name for item in items]
    inputs = [(path.name, hashlib.sha256(raw).hexdigest()), *zip(named, (d for _, d in read), strict=True)]
    return [path.parent / item.run for item in items], mounted, inputs


def orthogonal_triad(calibrations: list[Calibration]) -> list[Mounted]:
    """Three instruments whose input axes are x, y and z of the common frame, in this order.

    The transverse axes follow in cyclic order: the second has ``X0 = y, Y0 = z, Z0 = x``.
    """
    return [Mounted(c, np.roll(np.eye(3), -i, axis=0)) for i, c in enumerate(calibrations)]
