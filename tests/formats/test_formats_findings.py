"""Inputs that fuzzing found once: each is refused with a remedy now, the endless ones within the limit."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

import piga
from piga.formats.containers.container import read_container
from piga.formats.containers.parquet_reader import ParquetStream
from piga.formats.text.reader import TextStream
from piga.records.run_file import read_run_file

FOLDER = Path(__file__).parent / "findings"
NAMES = ("t", "n", "fx", "fy", "fz")


def read(path: Path) -> object:
    if path.suffix == ".json":
        return piga.Calibration.from_json(path)
    if path.suffix == ".toml":
        return read_run_file(path)
    if path.suffix == ".csv":
        return list(TextStream(path, NAMES, None).chunks())
    if path.suffix == ".parquet":
        return list(ParquetStream(path, NAMES, None).chunks())
    return read_container(path, path.suffix, NAMES, None)


def paths(*, endless: bool) -> list[Path]:
    return sorted(path for path in FOLDER.iterdir() if path.name.startswith("endless") == endless)


@pytest.mark.parametrize("path", paths(endless=False), ids=lambda path: path.name)
def test_refused_with_a_remedy(path: Path) -> None:
    with pytest.raises(piga.PigaError) as caught:
        read(path)
    assert caught.value.remedy


@pytest.mark.slow
@pytest.mark.parametrize("path", paths(endless=True), ids=lambda path: path.name)
def test_endless_loops_of_a_library_are_ended(path: Path) -> None:
    begun = time.monotonic()
    with pytest.raises(piga.DataError, match="of computing time"):
        read(path)
    assert time.monotonic() - begun < 25.0


def test_ragged_covariance(tmp_path: Path) -> None:
    document = json.loads((FOLDER / "unit.json").read_text(encoding="utf-8"))
    document["covariance"]["matrix"] = [[1.0], [1.0, 2.0]]
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(document))
    with pytest.raises(piga.CalibrationError, match="square matrix"):
        read(path)
