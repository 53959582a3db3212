"""calibration.json: valid by its schema, read back to the same record, damaged files refused."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path

import jsonschema
import numpy as np
import pytest

import piga
from tests.calibration.synthetic import TERMS, record


@pytest.fixture(scope="module")
def calibration() -> piga.Calibration:
    run = record(np.random.default_rng(1), seconds=5.0, rate=4.0, count=6, per_segment=True)
    return piga.calibrate(run, [*TERMS, "s2", "c2"], phase="per-segment")


def test_schema_and_round_trip(calibration: piga.Calibration, tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    calibration.to_json(path)
    schema = json.loads(files("piga.records.schema").joinpath("calibration-1.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    document = json.loads(path.read_text())
    jsonschema.Draft202012Validator(schema).validate(document)
    found = piga.Calibration.from_json(path)
    assert found.coefficients == calibration.coefficients
    np.testing.assert_array_equal(found.covariance, calibration.covariance)
    assert found.segments == calibration.segments
    assert found.notes == calibration.notes
    assert found.quality == calibration.quality
    assert found.scale_factor_nominal == pytest.approx(calibration.scale_factor_nominal, rel=1e-15)
    assert found.residuals is None
    found.to_json(tmp_path / "again.json")
    assert json.loads((tmp_path / "again.json").read_text()).keys() == document.keys()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(schema="piga.calibration/2"), "not known to this version"),
        (lambda d: d.update(schema="other"), "no calibration record"),
        (lambda d: d.pop("noise"), "missing required field `noise`"),
        (lambda d: d["coefficients"][0].update(unit="furlong"), "'rad/s/g' is needed"),
        (lambda d: d["coefficients"][0].update(name="k99"), "unknown coefficient 'k99'"),
        (lambda d: d["coefficients"][0].update(std=-1.0), "no valid number"),
        (lambda d: d["covariance"]["names"].reverse(), "covariance names differ"),
        (lambda d: d["covariance"]["matrix"].pop(), "not a full square"),
        (lambda d: d["covariance"]["matrix"][0].__setitem__(1, 1.0), "not symmetric"),
    ],
)
def test_damaged_records(calibration: piga.Calibration, tmp_path: Path, change, message: str) -> None:
    path = tmp_path / "calibration.json"
    calibration.to_json(path)
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    with pytest.raises(piga.CalibrationError, match=message) as caught:
        piga.Calibration.from_json(path)
    assert str(path) in str(caught.value)


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(piga.CalibrationError, match="cannot be read"):
        piga.Calibration.from_json(tmp_path / "none.json")
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(piga.CalibrationError, match="not a valid calibration record"):
        piga.Calibration.from_json(tmp_path / "bad.json")
