"""A long record lies in files without a name: the same record, or a clear word about the room; the angle from a rate."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np
import pytest

import piga
from piga.records import arrays
from tests.records.files import lines, write_log, write_run


@pytest.fixture
def run_file(tmp_path: Path) -> Path:
    rows = lines(900)
    rows[300] = rows[300].replace("1.0", "NaN")
    write_log(tmp_path, rows)
    return write_run(tmp_path)


def is_mapped(values: np.ndarray) -> bool:
    owner = values
    while isinstance(owner, np.ndarray) and not isinstance(owner, np.memmap):
        owner = owner.base
    return isinstance(owner, np.memmap)


@pytest.mark.parametrize("fallocate", [True, False])
def test_the_same_record(run_file: Path, monkeypatch: pytest.MonkeyPatch, fallocate: bool) -> None:
    """In memory, and with every array above some size in a file, of which nothing is left."""
    plain = piga.read_run(run_file)
    if not fallocate:
        monkeypatch.delattr(os, "posix_fallocate")
    for most in (0, 7192):  # 899 numbers of 8 bytes are used
        monkeypatch.setattr(arrays, "LARGE_BYTES", most)
        run = piga.read_run(run_file)
        assert is_mapped(run.output) == (most < 7192)
        assert not is_mapped(plain.output)
        for name in ("t", "output", "f", "segment_index", "row", "begins"):
            np.testing.assert_array_equal(getattr(run, name), getattr(plain, name))
        assert run.quality == plain.quality
    assert sorted(path.name for path in run_file.parent.iterdir()) == ["run.csv", "run.toml"]


def test_no_room_for_the_columns(run_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(arrays, "LARGE_BYTES", 0)
    for place, name in ((os, "posix_fallocate"), (tempfile, "TemporaryFile")):
        with monkeypatch.context() as patch:
            patch.setattr(place, name, full)
            with pytest.raises(piga.DataError, match=r"no room for the columns.*No space left(?s:.*)TMPDIR"):
                piga.read_run(run_file)


@pytest.mark.parametrize("start", [0.0, 0.7, 2.0])
def test_angle_from_rate_is_the_integral_from_the_first_sample(start: float) -> None:
    """Two stretches of a sine: ``h^3/24`` of the second derivative at both ends. Without slopes at the ends it is 8e-6 rad."""
    t = start + 0.01 * np.arange(400.0)
    begins = np.isin(np.arange(400), [0, 230])
    angle = arrays.integrated_rate(t, np.sin(t), begins)
    for part in (slice(0, 230), slice(230, 400)):
        turned = angle[part] - angle[part][0]
        assert turned == pytest.approx(np.cos(t[part][0]) - np.cos(t[part]), abs=1e-7)
