"""A joint calibration as a record: what is written is read back, and each run is seen by itself."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from piga.errors import CalibrationError
from piga.formats.columns import write_residuals
from piga.records.calibration.calibration import Calibration, RunRecord
from piga.records.calibration.coefficient import Coefficient, coverage_factor
from piga.records.calibration.diagnostics import Outlier, Quality, Residuals
from tests.reports.example import calibration


def run_record(name: str, phase: str, rms: float) -> RunRecord:
    return RunRecord(
        name, f"{name}.csv", "dividing-head", phase, True, 600, rms, 0.5 * rms, rms, 2.0 * rms, 5.0 * rms, 3.0 * rms,
        Quality(600, 598, 2), input_sha256={f"{name}.csv": "0" * 64},
    )  # fmt: skip


@pytest.fixture
def joint() -> Calibration:
    """Two runs with a common scale factor and a bias of their own."""
    return replace(
        calibration(with_residuals=False),
        terms=("scale_factor", "k0"),
        phases="per-segment",
        coefficients=(
            Coefficient("scale_factor", 0.8885, 1e-6, "rad/s/g", interval=(0.888497, 0.888505)),
            Coefficient("k0", 1.6e-3, 1e-6, "g", run="east", degrees_of_freedom=11.0),
            Coefficient("k0", 1.7e-3, 2e-6, "g", run="west"),
            Coefficient("phi", 0.4, 1e-3, "rad", segment="up", run="west"),
        ),
        covariance=np.diag([1e-12, 1e-12, 4e-12, 1e-6]) + 1e-14 * (1.0 - np.eye(4)),
        runs=(run_record("east", "shared", 1e-5), run_record("west", "per-segment", 2e-5)),
        outliers=(Outlier("spike", 12.5, 251, 1, 3e-4, "east"), Outlier("jump", 30.0, 600, 4, -2e-4)),
    )


def test_back_from_the_file(joint: Calibration, tmp_path: Path) -> None:
    joint.to_json(tmp_path / "c.json")
    written = json.loads((tmp_path / "c.json").read_text(encoding="utf-8"))
    assert [run["phase"] for run in written["runs"]] == [run.phases for run in joint.runs]
    assert written["model"]["phase"] == joint.phases
    result = Calibration.from_json(tmp_path / "c.json")
    assert result.coefficients == joint.coefficients
    assert result.runs == joint.runs
    assert result.outliers == joint.outliers
    np.testing.assert_array_equal(result.covariance, joint.covariance)
    result.to_json(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "c.json").read_bytes()


def test_one_run_of_it(joint: Calibration) -> None:
    west = joint.for_run("west")
    assert [c.key for c in west.coefficients] == ["scale_factor", "k0", "phi[up]"]
    assert west["k0"].value == 1.7e-3
    assert (west.phases, west.angle_rms, west.runs) == ("per-segment", 2e-5, ())
    np.testing.assert_array_equal(west.covariance, joint.covariance[np.ix_([0, 2, 3], [0, 2, 3])])
    assert joint.for_run("east")["k0"].value == 1.6e-3
    with pytest.raises(CalibrationError, match=r"no run 'south'(?s:.*)runs: east, west"):
        joint.for_run("south")
    with pytest.raises(CalibrationError, match="none: it is a calibration of one run"):
        west.for_run("west")
    with pytest.raises(KeyError, match=r"no coefficient 'k0'; there are: scale_factor, k0\[east\]"):
        _ = joint["k0"]


def test_student_factors_of_the_gum_table() -> None:
    """JCGM 100, table G.2, column 95 %."""
    for freedom, factor in {1: 12.71, 2: 4.30, 5: 2.57, 20: 2.09, math.inf: 1.960}.items():
        assert coverage_factor(freedom) == pytest.approx(factor, abs=0.0051)
    assert math.isnan(coverage_factor(0.0))
    assert math.isnan(coverage_factor(math.nan))


def test_residuals_name_their_run(joint: Calibration, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="holds no residuals"):
        write_residuals(joint, tmp_path / "r.parquet")
    assert not (tmp_path / "r.parquet").exists()
    numbers = np.arange(4.0)
    residuals = Residuals(
        np.arange(4), numbers, numbers, numbers, numbers, numbers, numbers,
        np.zeros(4, np.int32), np.array([0, 0, 1, 1], np.int32),
    )  # fmt: skip
    write_residuals(replace(joint, residuals=residuals), tmp_path / "r.parquet")
    table = pq.read_table(tmp_path / "r.parquet")
    assert table.column("run").to_pylist() == ["east", "east", "west", "west"]
    assert table.schema.field("before").metadata == {b"unit": b"rad"}
