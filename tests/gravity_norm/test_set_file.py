"""Run files of sets: the published Xsens record, refusals, and ``piga calibrate`` as a user runs it."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from piga.errors import RunFileError
from piga.gravity_norm import calibrate_set_file, is_set_file
from tests.cli.runner import outcome
from tests.gravity_norm.simulated import G, directions, record

DATA = Path(__file__).parents[2] / "validation" / "data"


def test_the_published_record_of_an_xsens():
    """All nine parameters of imu_tk's published run (38 spells, lower triangle) within 2 u; its offsets, LSB/(m/s^2), skews."""
    digest = hashlib.sha256((DATA / "xsens-acc.csv.gz").read_bytes()).hexdigest()
    assert digest in (DATA / "README.md").read_text()
    cal = calibrate_set_file(DATA / "xsens.toml")
    assert 36 <= len(cal.spells) <= 42
    skews = np.eye(3)
    skews[1, 0], skews[2, 0], skews[2, 1] = -0.0035492, -0.0089041, -0.0213032
    m = np.linalg.inv(skews)
    published = [33124.2, 33275.2, 32364.4, 414.478, 412.102, 414.538, m[1, 0], m[2, 0], m[2, 1]]
    off = [(term.value - value) / term.std for term, value in zip(cal.terms, published, strict=True)]
    assert np.abs(off).max() < 2.0
    assert np.array([term.std for term in cal.terms]) == pytest.approx(
        [0.25, 0.14, 0.16, 0.027, 0.014, 0.017, 1e-4, 5e-4, 1e-4], rel=0.5
    )


@pytest.fixture
def folder(tmp_path):
    rng = np.random.default_rng(61)
    t, outputs = record(rng, directions(rng, 15))
    rows = np.column_stack((t, outputs, 0.5 * outputs.sum(axis=1)))
    np.savetxt(tmp_path / "set.csv", rows, delimiter=",", header="t,x,y,z,w", comments="", fmt="%.9g")
    (tmp_path / "set.toml").write_text(
        f'[instrument]\nserial = "S"\ngravity = "{G} m/s^2"\ngravity_uncertainty = "0.001 m/s^2"\n[data]\n'
        'file = "set.csv"\nreference = "gravity-norm"\ntime = { column = "t", unit = "s" }\n'
        'outputs = { columns = ["x", "y", "z"], unit = "mV" }\n'
    )
    return tmp_path


def test_calibrate_writes_page_and_json(folder, capsys):
    code, out, err = outcome(capsys, "calibrate", folder / "set.toml", "--out", folder / "out")
    assert code == 0, err
    assert "scale_factor[x]" in out
    assert "Convention upper" in out
    document = json.loads((folder / "out" / "set-calibration.json").read_text())
    assert document["terms"]["bias[y]"]["unit"] == "mV"
    assert document["gravity_std"] == pytest.approx(0.001)
    assert set(document["input_sha256"]) == {"set.toml", "set.csv"}
    page = (folder / "out" / "report.html").read_text()
    assert "Size of the force less gravity" in page
    code, out, _ = outcome(capsys, "calibrate", folder / "set.toml", "--json", "--out", folder / "again")
    assert json.loads(out)["terms"] == document["terms"]


@pytest.mark.parametrize(
    "command", [("check",), ("records", "add", "--operator", "A", "--reason", "B", "--store", "a.sqlite")]
)
def test_other_commands_say_that_it_is_a_set(folder, capsys, command):
    code, _, err = outcome(capsys, *command, folder / "set.toml")
    assert code == 2
    assert "the run file of a set of accelerometers" in err
    assert "remedy: give it to 'piga calibrate'" in err


def test_refusals(folder, capsys):
    assert is_set_file(folder / "set.toml")
    code, _, err = outcome(capsys, "calibrate", folder / "set.toml", "--terms", "k0")
    assert code == 2
    assert "is calibrated alone" in err
    text = (folder / "set.toml").read_text()
    (folder / "time.toml").write_text(text.replace("time = {", "#"))
    with pytest.raises(RunFileError, match="either time or sample_rate"):
        calibrate_set_file(folder / "time.toml")
    (folder / "two.toml").write_text(text.replace('"y", "z"', '"y"'))
    with pytest.raises(RunFileError, match="columns"):
        calibrate_set_file(folder / "two.toml")
    shutil.copy(folder / "set.toml", folder / "key.toml")
    (folder / "key.toml").write_text(text + '[model]\nconvention = "middle"\n')
    with pytest.raises(RunFileError, match="convention"):
        calibrate_set_file(folder / "key.toml")
