"""The files that a calibration is computed from, under names that fit together wherever they are laid out."""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath

from piga.errors import DataError, RunFileError
from piga.ledger.store import DraftFile
from piga.ledger.store.blobs import digest_of
from piga.records.run_file import read_run_file
from piga.stand.run_reference import stand_files


def input_files(run: Path, known: dict[str, str]) -> tuple[DraftFile, ...]:
    """Run file, data file, its ``.sha256`` where there is one, and the files of a ``[stand]`` table.

    Names keep their places relative to each other: a data file in ``../data`` moves the run file one folder down.

    Parameters
    ----------
    run:
        Run file.
    known:
        SHA-256 of each input as it was read for the calibration: :attr:`piga.Calibration.provenance`.

    Raises
    ------
    RunFileError
        If a name is absolute: then the record could not be read elsewhere.
    DataError
        If an input is not what the calibration was computed from.
    """
    run_file = read_run_file(run)
    named = [("data", run_file.data.file), *(("stand", name) for name in stand_files(run_file.stand))]
    if Path(f"{run_file.data.file}.sha256").name in known:
        named.append(("sidecar", f"{run_file.data.file}.sha256"))
    for _, name in named:
        if PurePosixPath(name).is_absolute() or Path(name).is_absolute():
            raise RunFileError(
                f"{run}: '{name}' is an absolute path: the record could not be read elsewhere",
                remedy="name the file relative to the run file",
            )
    depth = max(_upwards(name) for _, name in named)
    below = "/".join(["run"] * depth)
    files = [DraftFile("run", _joined(below, run.name), run, known.get(run.name, ""))]
    for role, name in dict.fromkeys(named):
        key = name if role == "stand" else Path(name).name
        files.append(DraftFile(role, _joined(below, name), run.parent / name, known.get(key, "")))
    for file in files:
        if digest_of(file.parts())[0] != file.sha256:
            raise DataError(
                f"{file.name}: is not the file that the calibration was computed from (its SHA-256 differs)",
                remedy="calibrate again, with the files as they are now",
            )
    return tuple(files)


def _upwards(name: str) -> int:
    return os.path.normpath(name).replace(os.sep, "/").split("/").count("..")


def _joined(below: str, name: str) -> str:
    return os.path.normpath(f"{below}/{name}" if below else name).replace(os.sep, "/")
