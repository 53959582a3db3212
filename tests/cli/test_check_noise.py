"""``piga noise`` as a user runs it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.cli.runner import outcome


@pytest.fixture
def log(tmp_path):
    rng, n, step = np.random.default_rng(31), 5000, 0.1
    rate = 2.5 + 5e-4 / np.sqrt(step) * rng.standard_normal(n)
    rows = np.column_stack((step * np.arange(n), rate))
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="t [s],U [V]", comments="", fmt="%.9g")
    return tmp_path / "log.csv"


def test_text_page_and_json(log, tmp_path, capsys):
    code, out, err = outcome(capsys, "noise", log, "--out", tmp_path / "noise")
    assert code == 0, err
    assert "random walk N" in out
    assert "not seen" in out
    assert "V/sqrt(Hz)" in out
    page = (tmp_path / "noise" / "noise.html").read_text()
    assert "Deviations of the rate" in page
    assert "Spectrum of the rate" in page
    document = json.loads((tmp_path / "noise" / "noise.json").read_text())
    code, out, err = outcome(capsys, "noise", log, "--json")
    assert json.loads(out) == document
    walk = document["levels"]["random_walk"]
    assert walk["unit"] == "V/sqrt(Hz)"
    assert walk["interval_95"][0] < 5e-4 < walk["interval_95"][1]
    assert list(document["deviations"]) == ["allan", "modified", "hadamard"]
    assert document["deviations"]["allan"]["tau_s"][0] == pytest.approx(0.1)


def test_an_integral_has_a_rate_per_second(log, capsys):
    code, out, _ = outcome(
        capsys, "noise", log, "--column", "U", "--kind", "angle", "--unit", "count", "--json"
    )
    assert code == 0
    assert json.loads(out)["unit"] == "count/s"


def test_a_column_that_is_not_there(log, capsys):
    code, _, err = outcome(capsys, "noise", log, "--column", "I")
    assert code == 2
    assert "no column 'I'; the columns are: t, U" in err
    assert "--column" in err
