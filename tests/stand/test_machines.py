"""Stands of every kind: rows do not depend on each other, composites, logged profiles, what is assumed and felt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import csv, parquet

from piga.errors import ArgumentError, DataError
from piga.records.run_file import Columns, ColumnTable
from piga.stand import (
    Centrifuge,
    Composite,
    Imperfections,
    LoggedProfile,
    force_change,
    sample_stand,
)
from piga.stand.profile import NONE, read_profile
from piga.units import G0
from tests.stand.stands import HEAD, SITE, SPIN


def test_composite_is_its_parts_in_order():
    stand = Composite((replace(HEAD, positions=(0.0, 1.0)), Centrifuge(SITE, 1.0, SPIN)), pause=10.0)
    labels = [s.label for s in stand.segments()]
    assert labels[:4] == ["0.0", "0.move to 1", "0.1", "pause before 1"]
    f, _ = stand.motion(np.array([120.0, 165.0, 161.0]), NONE)
    first, _ = HEAD.motion(np.array([30.0]), NONE)
    second, _ = Centrifuge(SITE, 1.0, SPIN).motion(np.array([1.0]), NONE)
    assert f[2] == pytest.approx(second[0])
    assert np.linalg.norm(first) == pytest.approx(9.80166)
    start, _ = stand.motion(np.array([150.0, 155.0, 160.0]), NONE)
    assert start[1] == pytest.approx(0.5 * (start[0] + start[2]))
    assert {"arm_radius", "angle_error"} <= set(stand.accepted)
    only_arm = force_change(stand, np.array([30.0, 161.0]), Imperfections(arm_radius=1e-3))
    assert np.all(only_arm[0] == 0.0)
    assert only_arm[1, 0] == pytest.approx(1e-3, rel=1e-2)


FORCE = Columns(("fx", "fy", "fz"), "g")


def test_logged_profile_is_linear_between_samples(tmp_path):
    path = tmp_path / "profile.csv"
    path.write_text("t,fx,fy,fz,wx,wy,wz\n0,1,0,0,0,0,0\n1000,2,0,1,0.1,0,0\n3000,0,0,0,0,0,0\n")
    stand = read_profile(path, ColumnTable("t", "ms"), FORCE, Columns(("wx", "wy", "wz"), "rad/s"))
    f, omega = stand.motion(np.array([0.5, 2.0]), NONE)
    assert f / G0 == pytest.approx(np.array([[1.5, 0, 0.5], [1, 0, 0.5]]))
    assert omega[:, 0] == pytest.approx([0.05, 0.05])
    with pytest.raises(DataError, match="no column 'fq'"):
        read_profile(path, ColumnTable("t", "s"), Columns(("fq", "fy", "fz"), "g"))
    with pytest.raises(DataError, match="No such file"):
        read_profile(tmp_path / "none.csv", ColumnTable("t", "s"), FORCE)
    path.write_text("t,fx,fy,fz\n0,1,0,0\n1,,0,1\n")
    with pytest.raises(DataError, match="row 3, column 'fx' is empty"):
        read_profile(path, ColumnTable("t", "s"), FORCE)
    path.write_text("t,fx,fy,fz\n0,1,0,0\n1,0,0,1\n2,0,0,1")
    with pytest.raises(DataError, match="row 4 has no line end"):
        read_profile(path, ColumnTable("t", "s"), FORCE)
    with pytest.raises(ArgumentError, match="fewer than two, or do not increase"):
        LoggedProfile(np.array([0.0, 0.0]), np.zeros((2, 3)), np.zeros((2, 3)))


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_profile_is_read_from_both_formats(tmp_path, kind):
    """Times before the first and behind the last sample, on samples and between them; whole numbers before others."""
    t = np.cumsum(np.random.default_rng(1).uniform(0.5, 1.5, 3000))
    table = pa.table({"t": t, "x": np.sin(t), "y": np.arange(3000), "z": 0.1 * t, "note": ["-"] * 3000})
    path = tmp_path / f"profile.{kind}"
    (csv.write_csv if kind == "csv" else parquet.write_table)(table, path)
    read = read_profile(
        path, ColumnTable("t", "s"), Columns(("x", "y", "z"), "g"), Columns(("z", "z", "x"), "deg/s")
    )
    times = np.concatenate([t[[2999, 0, 1, 1700]] - t[0], [-5.0, 1e9, 7.7, 800.1]])
    force, rate = read.motion(times, NONE)
    assert force[:, 0] == pytest.approx(np.interp(times + t[0], t, np.sin(t)) * G0, abs=1e-12)
    assert rate[:, 1] == pytest.approx(np.radians(np.interp(times + t[0], t, 0.1 * t)), abs=1e-12)


def test_table_says_what_the_lab_assumes_and_what_is_felt():
    errors = Imperfections(reference_scale=1e-3, gravity=1e-3)
    profile = sample_stand(HEAD, 1.0, errors=errors)
    assert profile.reference[0] == pytest.approx([9.80166, 0, 0])
    assert profile.force[0, 0] == pytest.approx((9.80166 + 1e-3) * 1.001)
    fine = sample_stand(HEAD, 1.0, oversample=4, extra=3)
    assert fine.t[4] == 1.0
    assert fine.t.size == 4 * (profile.t.size - 1) + 1 + 3
    with pytest.raises(ArgumentError, match="not a multiple"):
        sample_stand(HEAD, 0.7)
    with pytest.raises(ArgumentError, match=r"\[imperfections\] arm_radius does not exist on a dividing-head"):
        sample_stand(HEAD, 1.0, errors=Imperfections(arm_radius=1e-3))


def test_bad_parts() -> None:
    with pytest.raises(ArgumentError, match="radius"):
        Centrifuge(SITE, 0.0, SPIN)
    with pytest.raises(ArgumentError, match="no parts"):
        Composite(())
    with pytest.raises(ArgumentError, match="pause"):
        Composite((HEAD,), pause=0.0)
    with pytest.raises(ArgumentError, match="2 rows of three finite numbers"):
        LoggedProfile(np.array([0.0, 1.0]), np.zeros((2, 3)), np.full((2, 3), np.nan))
