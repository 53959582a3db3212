"""calibration.json: valid by its schema, read back to the same record, damaged files refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import piga
from piga.records.calibration.document import calibration_to_bytes
from tests.calibration.made.synthetic import TERMS, record


@pytest.fixture(scope="module")
def calibration() -> piga.Calibration:
    run = record(np.random.default_rng(1), seconds=5.0, rate=4.0, count=6)
    return piga.calibrate(run, [*TERMS, "s2", "c2"], phases="per-segment")


@pytest.fixture
def document(calibration: piga.Calibration) -> dict:
    """A valid record as JSON values, to be changed."""
    return json.loads(calibration_to_bytes(calibration))


def test_schema_and_round_trip(calibration: piga.Calibration, tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    calibration.to_json(path)
    document = json.loads(path.read_text())
    result = piga.Calibration.from_json(path)
    assert result.coefficients == calibration.coefficients
    np.testing.assert_array_equal(result.covariance, calibration.covariance)
    assert result.segments == calibration.segments
    assert result.notes == calibration.notes
    assert result.quality == calibration.quality
    assert result.scale_factor_nominal == pytest.approx(calibration.scale_factor_nominal, rel=1e-15)
    assert result.residuals is None
    result.to_json(tmp_path / "again.json")
    assert json.loads((tmp_path / "again.json").read_text()).keys() == document.keys()


def _coefficient(document: dict, name: str) -> dict:
    return next(c for c in document["coefficients"] if c["name"] == name)


def _emptied(document: dict) -> None:
    document["covariance"] = {"names": [], "matrix": []}


def _scaled(document: dict, row: int, factor: float) -> None:
    """One row and column of the covariance times a factor, its diagonal by the square of it."""
    matrix = document["covariance"]["matrix"]
    for i in range(len(matrix)):
        matrix[row][i] *= factor
        matrix[i][row] *= factor


def _second_scale_factor(document: dict) -> None:
    """The attack that compensated with 1.78 times the acceleration: the later of two entries won."""
    names, matrix = document["covariance"]["names"], document["covariance"]["matrix"]
    at = names.index("scale_factor")
    document["coefficients"].append(document["coefficients"][at] | {"value": 0.5})
    names.append("scale_factor")
    matrix.append(list(matrix[at]))
    for row in matrix:
        row.append(row[at])


def _correlated(document: dict) -> None:
    """A correlation of 1.2 between the first two coefficients."""
    matrix = document["covariance"]["matrix"]
    matrix[0][1] = matrix[1][0] = 1.2 * (matrix[0][0] * matrix[1][1]) ** 0.5


IMPOSSIBLE = [
    (lambda d: d.update(schema="piga.calibration/2"), "not known to this version"),
    (lambda d: d.update(schema="other"), "not a calibration record"),
    (lambda d: d.pop("noise"), "missing required field `noise`"),
    (lambda d: d["coefficients"][0].update(unit="furlong"), "'rad/s/g' is needed"),
    (lambda d: d["coefficients"][0].update(name="k99"), "unknown coefficient 'k99'"),
    (lambda d: d["covariance"]["names"].reverse(), "not a square matrix of the coefficients"),
    (lambda d: d["covariance"]["matrix"].pop(), "not a square matrix of the coefficients"),
    (lambda d: d["covariance"]["matrix"][0].__setitem__(1, 1.0), "not symmetric"),
    (_second_scale_factor, "the coefficient 'scale_factor' occurs twice"),
    (lambda d: _coefficient(d, "scale_factor").update(value=0.0), "scale_factor.*must be positive"),
    (lambda d: (d["coefficients"].clear(), d["model"]["terms"].clear(), _emptied(d)), "not those of the coeff"),
    (lambda d: _coefficient(d, "tan_beta").update(value=-1e-3), "tan_beta.*must not be negative"),
    (lambda d: d["instrument"]["scale_factor_nominal"].update(value=0.0), "scale_factor_nominal"),
    (lambda d: d["instrument"]["scale_factor_nominal"].update(unit="furlong"), "unknown unit 'furlong'"),
    (lambda d: d["covariance"]["matrix"][0].__setitem__(0, -1e-12), "but the covariance gives 0"),
    (_correlated, "not positive semi-definite"),
    (lambda d: _scaled(d, 0, 1e3), "uncertainty of 'scale_factor'.*covariance"),
    (lambda d: _coefficient(d, "scale_factor").update(std=1e-30), "uncertainty of 'scale_factor'.*covariance"),
    (lambda d: d["model"].update(phase="sometimes"), "Invalid enum value 'sometimes'.*model.phase"),
    (lambda d: d["model"].update(phase="shared"), "'phi.*not if the phase is 'shared'"),
    (lambda d: d["model"]["terms"].remove("k0"), "not those of the coefficients"),
    (lambda d: d["noise"]["angle_rms"].update(value=-1.0), "noise.angle_rms"),
    (lambda d: d["quality"].update(rows=-1), "quality.rows"),
    (lambda d: d["identifiability"].update(condition=0.5), "identifiability.condition"),
    (lambda d: d["coefficients"][0].update(interval=[2.0, 1.0]), "ends of the interval of 'scale_factor'"),
    (lambda d: d["coefficients"][0].update(degrees_of_freedom=0.0), "freedom of 'scale_factor'.*too few"),
    (lambda d: _coefficient(d, "k0").update(run="b"), "'k0.b.': there is no run 'b'"),
    (lambda d: d["coefficients"][0].update(segment="3"), "'scale_factor.3.'.*only a phase"),
    (lambda d: d["instrument"].update(serial="G-1\nG-2"), "serial.*control character"),
    (lambda d: d["instrument"].update(serial="G" * 300), "serial.*300 characters"),
    (lambda d: d["provenance"].update(created="yesterday"), "created.*'yesterday' is not a time"),
    (lambda d: d["diagnostics"].update(ljung_box_probability=7.0), "diagnostics.ljung_box_probability"),
    (lambda d: d["segments"][0].update(mean_a_x=1e200), "segments.*mean_a_x"),
    (lambda d: d.pop("surplus_observations"), "surplus_observations"),
    (
        lambda d: d["uncertainty_budget"][0]["contributions"].update(k9=1.0),
        "acts on 'k9', which is not a coeff",
    ),
]


@pytest.mark.parametrize("number", ["NaN", "1e999", "-1e999", "Infinity"])
@pytest.mark.parametrize("key", ["variance", "value"])
def test_numbers_beyond_json(document: dict, tmp_path: Path, key: str, number: str) -> None:
    path = tmp_path / "calibration.json"
    document["diagnostics"]["variance"] = document["coefficients"][0]["value"] = 123.25
    path.write_text(json.dumps(document).replace(f'"{key}": 123.25', f'"{key}": {number}'))
    with pytest.raises(piga.CalibrationError, match="not a valid calibration record"):
        piga.Calibration.from_json(path)


@pytest.mark.parametrize(("change", "message"), IMPOSSIBLE)
def test_impossible_records(document: dict, tmp_path: Path, change, message: str) -> None:
    """What no calibration can say is refused at the door, with the file and what is wrong."""
    path = tmp_path / "calibration.json"
    change(document)
    path.write_text(json.dumps(document))
    with pytest.raises(piga.CalibrationError, match=message) as caught:
        piga.Calibration.from_json(path)
    assert str(path) in str(caught.value)
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ('"serial":', '"serial": "G-2", "serial":'),
        ('"method":', '"method": "rate", "method":'),
        ('"unit": "rad/s/g"', '"unit": "rad/s/g", "value": 7.0'),
        ('"diagnostics":', '"diagnostics": {"a": 1, "a": 2}, "extra":'),
    ],
)
def test_duplicate_keys(document: dict, tmp_path: Path, before: str, after: str) -> None:
    path = tmp_path / "calibration.json"
    text = json.dumps(document)
    assert before in text
    path.write_text(text.replace(before, after, 1))
    with pytest.raises(piga.CalibrationError, match="occurs twice in one object"):
        piga.Calibration.from_json(path)


@pytest.mark.long
@pytest.mark.parametrize("method", ["information", "rate"])
def test_every_method_writes_what_can_be_read(tmp_path: Path, method: str) -> None:
    """The consistency that the reader asks for is what each method gives."""
    run = record(np.random.default_rng(2), seconds=40.0, rate=4.0, count=6)
    calibration = piga.calibrate(run, ["scale_factor", "tan_beta", "k0"], method)
    calibration.to_json(tmp_path / "calibration.json")
    again = piga.Calibration.from_json(tmp_path / "calibration.json")
    assert again.coefficients == calibration.coefficients
