"""The files that a calibration is computed from, under names that fit together wherever they are laid out."""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath
from typing import Any

from piga.errors import RunFileError
from piga.records.run_file import read_run_file
from piga.records.store import DraftFile


def input_files(run: Path) -> tuple[DraftFile, ...]:
    """Run file, data file, its ``.sha256`` where there is one, and the files of a ``[stand]`` table.

    Names keep their places relative to each other: a data file in ``../data`` moves the run file one folder down.

    Raises
    ------
    RunFileError
        If a name is absolute: then the record could not be read elsewhere.
    """
    run_file = read_run_file(run)
    named = [("data", run_file.data.file), *(("stand", name) for name in _stand_files(run_file.stand))]
    sidecar = run.parent / f"{run_file.data.file}.sha256"
    if sidecar.is_file():
        named.append(("sidecar", f"{run_file.data.file}.sha256"))
    for _, name in named:
        if PurePosixPath(name).is_absolute() or Path(name).is_absolute():
            raise RunFileError(
                f"{run}: '{name}' is an absolute path: the record could not be read elsewhere",
                remedy="name the file relative to the run file",
            )
    depth = max(_upwards(name) for _, name in named)
    below = "/".join(["run"] * depth)
    files = [DraftFile("run", _joined(below, run.name), run)]
    files += [DraftFile(role, _joined(below, name), run.parent / name) for role, name in dict.fromkeys(named)]
    return tuple(files)


def _stand_files(stand: Any) -> list[str]:
    """Every ``file = "..."`` in a ``[stand]`` table, at any depth."""
    if isinstance(stand, dict):
        own = [value for key, value in stand.items() if key == "file" and isinstance(value, str)]
        return own + [name for value in stand.values() for name in _stand_files(value)]
    if isinstance(stand, list):
        return [name for value in stand for name in _stand_files(value)]
    return []


def _upwards(name: str) -> int:
    return os.path.normpath(name).replace(os.sep, "/").split("/").count("..")


def _joined(below: str, name: str) -> str:
    return os.path.normpath(f"{below}/{name}" if below else name).replace(os.sep, "/")
