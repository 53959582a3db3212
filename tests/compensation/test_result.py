"""Tables of results in pieces, their files, and another rate: nothing depends on the pieces, no velocity is lost."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest

import piga
from piga.compensation import (
    Compensated,
    Resampler,
)
from piga.compensation.model import FLAGS
from piga.compensation.result import write_rows
from piga.formats.columns import nulls_of, numbers_of
from tests.compensation.run_files import CAL, command, write
from tests.compensation.triads import orthogonal
from tests.compensation.twin_data import calibration_of, constant_force, run_of


def test_numbers_of_every_kind_of_column():
    """Whole and broken numbers, nulls, parts of a column: as Arrow's own conversion gives them."""
    for column in (
        pa.array([1.0, None, -0.0, np.nan, np.inf]), pa.array([1, None, 2**60 + 1], pa.int64()),
        pa.array([2**63 + 5, 1], pa.uint64()), pa.array([1.5, None, 2.5], pa.float32()),
        pa.array([1.0, 2.0, None, 4.0]).slice(1, 3), pa.array([], pa.float64()), pa.array([None], pa.int8()),
    ):  # fmt: skip
        expected = column.to_numpy(zero_copy_only=False).astype(float)
        assert numbers_of(column).tobytes() == expected.tobytes() or np.array_equal(
            numbers_of(column), expected, equal_nan=True
        )
        assert nulls_of(column).tolist() == [value is None for value in column.to_pylist()]


def test_flags_are_counted_in_the_rows_that_are_written(tmp_path):
    """At another rate the file has other rows than the record."""
    t = np.concatenate((0.01 * np.arange(250), 9.0 + 0.01 * np.arange(250)))
    result = piga.compensate(run_of(t, constant_force(t, 0.001, 3.0, 1.0), phi=0.3), calibration_of(CAL))
    assert result.flagged("locked").any()
    rows, flagged = write_rows(result, tmp_path / "o.parquet", period=0.037)
    table = pa.parquet.read_table(tmp_path / "o.parquet")
    flags = table.column("flags").to_numpy()
    assert rows == table.num_rows != result.size
    assert flagged == {name: n for name, bit in FLAGS.items() if (n := np.count_nonzero(flags & bit))}


def test_flags_of_all_rows_that_overlap():
    """Rows of 1 s at 2.5 s: a row that reaches into two new ones flags both; in any pieces."""
    t, flags = np.arange(11.0), np.zeros(11, np.int32)
    flags[[1, 3, 8]] = 1, 2, 4
    rows = Compensated(t, t, t, np.zeros(0), flags)
    for cuts in ([0, 11], [0, 1, 3, 4, 8, 9, 11], list(range(12))):
        stream = Resampler(2.5)
        parts = [stream.push_rows(rows.rows(slice(a, b))) for a, b in pairwise(cuts)]
        assert np.concatenate([part["flags"] for part in parts]).tolist() == [3, 2, 4, 4]
        assert np.concatenate([part["t"] for part in parts]).tolist() == [2.5, 5.0, 7.5, 10.0]
        assert np.isnan(np.concatenate([part["ax"] for part in parts])).tolist() == [True, False, False, False]


def rows_of(t: np.ndarray, dv: np.ndarray) -> Compensated:
    return Compensated(t, dv, dv, np.zeros(0), np.zeros(t.size, np.int32))


@pytest.mark.parametrize("period", [0.05, 0.013, 0.003])
def test_resampling_loses_no_velocity(period):
    """What is not given out is the velocity behind the last new time, in proportion to its interval."""
    t, dv = 0.01 * np.arange(500), np.random.default_rng(3).standard_normal(500)
    stream = Resampler(period)
    parts = [stream.push_rows(rows_of(t, dv).rows(slice(i, i + 7))) for i in range(0, 500, 7)]
    new = np.concatenate([part["t"] for part in parts])
    behind = np.clip((t - new[-1]) / 0.01, 0.0, 1.0) @ dv
    assert abs(math.fsum(np.concatenate([part["dv"] for part in parts])) + behind - math.fsum(dv)) < 1e-11
    assert np.allclose(np.diff(new), period)


def test_what_cannot_be_resampled_is_refused():
    with pytest.raises(piga.ArgumentError, match=r"t\[2\]: 0.5 s is not after"):
        Resampler(0.1).push_rows(rows_of(np.array([0.0, 1.0, 0.5]), np.zeros(3)))
    for period in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(piga.ArgumentError, match=r"period: .* is not positive"):
            Resampler(period)
    given = Resampler(0.03).push_rows(rows_of(0.01 * np.arange(8), np.ones(8)))["dv"]
    np.testing.assert_allclose(given, [4.0, 3.0])  # the first sample's goes out with the three behind it


def test_set_at_another_rate_keeps_the_velocity(tmp_path, monkeypatch, capsys):
    text, triad = "", tmp_path / "triad.toml"
    for name, axes in zip("xyz", orthogonal(), strict=True):
        run = write(tmp_path, f"{name}.parquet", axes=axes).name
        text += f'[[triad.instrument]]\nrun = "{run}"\ncalibration = "{name}.json"\naxes = {axes.tolist()}\n'
    triad.write_text(text)
    for name, more in (("a", ()), ("b", ("--rate", "10 Hz"))):
        code, _, text = command(monkeypatch, capsys, triad, "--out", tmp_path / f"{name}.parquet", *more)
        assert code == 0, text
    fine, slow = (pa.parquet.read_table(tmp_path / f"{name}.parquet") for name in "ab")
    assert slow.column_names == ["t", "fx", "fy", "fz", "dvx", "dvy", "dvz", "flags"]
    last = np.searchsorted(fine["t"].to_numpy(), slow["t"].to_numpy()[-1] - 1e-9)
    for axis in ("dvx", "dvy", "dvz"):
        total = np.cumsum(fine[axis].to_numpy())[last]
        assert abs(np.cumsum(slow[axis].to_numpy())[-1] - total) < 1e-12
