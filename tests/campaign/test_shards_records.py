"""What a record does: a stand, a platform; and that it is what a user gets by hand."""

import json
from dataclasses import replace

import msgspec
import pytest

import piga
from piga.campaign import collect, open_campaign, read_campaign
from piga.campaign.shards import _seen, compute
from piga.cli.main import app
from tests.campaign.small import ROOT, STAND, collected, computed, find, rows, written
from tests.reports.example import calibration

EXAMPLES = ROOT / "examples" / "campaigns"
CAMPAIGN = """
scenario = "stand.toml"
[campaign]
seed = 3
repeats = 3
records_per_shard = 2
[grid]
"truth.k0" = ["1e-4 g", "3e-4 g"]
"""


@pytest.mark.parametrize(
    "name", sorted(path.name for path in EXAMPLES.glob("*.toml") if path.stem != "servo-centrifuge")
)
def test_examples_are_valid(name):
    plan = read_campaign(EXAMPLES / name)
    expected = {"fleet.toml": 320, "platform.toml": 48, "sensitivity.toml": 36}
    assert plan.records == expected[name]
    assert plan.file.campaign.title


@pytest.mark.long
def test_a_record_of_a_stand_is_simulate_and_calibrate(tmp_path, capsys):
    """``piga simulate`` and ``piga calibrate``, with the seed of the record, give the same bits."""
    written(tmp_path, STAND, "stand.toml")
    path = written(tmp_path, CAMPAIGN)
    computed(path, tmp_path / "out")
    row = rows(tmp_path / "out")[4]
    assert (row["case"], row["repeat"]) == (1, 1)
    plan = read_campaign(path)
    seed = plan.seed_of(find(plan, 1, 1))
    app(
        ["simulate", str(tmp_path / "stand.toml"), "--out", str(tmp_path / "sim"), "--seed", str(seed)],
        standalone_mode=False,
    )
    calibration = piga.calibrate(piga.read_run(tmp_path / "sim" / "run.toml"))
    assert [c.value for c in calibration.coefficients] == row["value"]
    assert [c.std for c in calibration.coefficients] == row["u"]
    truth = {
        c["name"]: c["value"] for c in json.loads((tmp_path / "sim" / "truth.json").read_text())["coefficients"]
    }
    assert row["truth"] == [truth[name] for name in row["name"]]
    capsys.readouterr()
    where = tmp_path / "again"
    words = ["campaign", "repeat", str(path), "--record", "4", "--out", str(where), "--json"]
    app(words, standalone_mode=False)
    command = json.loads(capsys.readouterr().out)["commands"].partition(";")[0]
    assert command == f"piga simulate {where / 'scenario.toml'} --out DIR"
    app(["simulate", str(where / "scenario.toml"), "--out", str(tmp_path / "sim2")], standalone_mode=False)
    twice = piga.calibrate(piga.read_run(tmp_path / "sim2" / "run.toml"))
    assert [c.value for c in twice.coefficients] == row["value"]


@pytest.mark.long
def test_what_a_calibration_reports_is_counted(tmp_path):
    """Kinds of noise, and terms that are suggested."""
    written(tmp_path, STAND.replace('k0 = "3e-4 g"', 'k0 = "3e-4 g"\nm_Y = "1000 arcsec"'), "stand.toml")
    plan = read_campaign(written(tmp_path, CAMPAIGN))
    seen = compute(plan, find(plan, 0, 0)).seen
    assert "random walk" in seen
    assert any(name.startswith("suggested: ") for name in seen)


@pytest.mark.parametrize(
    ("change", "doubted"),
    [
        ({}, False),
        ({"notes": ("the residuals show a bias drift (k0_t); the scatter of the segments may be the same",)}, False),
        ({"diagnostics": {"segment_scatter_ratio": 2.5}}, True),
        ({"diagnostics": {"verdict": "not white", "ljung_box_probability": 1e-9, "variance": 1.0, "lag1_correlation": 0.6}}, True),
    ],
)  # fmt: skip
def test_a_doubt_about_the_noise_is_known_by_its_data(change, doubted):
    """The words of a doubt about a missing term are not read."""
    cal = calibration(phases="per-segment", with_residuals=False)
    changed = {
        name: replace(cal.diagnostics, **part) if name == "diagnostics" else part
        for name, part in change.items()
    }
    assert ("doubt about the noise" in _seen(replace(cal, **changed))) == doubted


def test_seeds_of_the_platform_scatter_with_the_noise(tmp_path):
    text = (ROOT / "examples" / "platform-published.toml").read_text(encoding="utf-8")
    written(tmp_path, text.replace('"10 d"', '"2 h"').replace('step = "1 s"', 'step = "20 s"'), "platform.toml")
    campaign = """
scenario = "platform.toml"
[campaign]
repeats = 2
records_per_shard = 4
[grid]
"equatorial.drift.0" = ["0 deg/h", "0.02 deg/h"]
[[case]]
name = "p"
set = { "sensors.gimbal_noise" = "5 arcsec", "compensation.models" = ["A", "B"], "identification.duration" = "1 h" }
"""
    computed(written(tmp_path, campaign), tmp_path / "out")
    figures = msgspec.to_builtins(collect(open_campaign(tmp_path / "out")))
    assert figures["failed"] == 0, figures["failures"]
    assert [group["set"] for group in figures["groups"]] == [
        {"equatorial.drift.0": v} for v in ("0 deg/h", "0.02 deg/h")
    ]
    for group in figures["groups"]:
        names = [c["name"] for c in group["coefficients"]]
        assert "position_error[A]" in names
        assert "east_velocity_line[B]" in names
        position = next(c for c in group["coefficients"] if c["name"] == "position_error[A]")
        assert position["lowest"] < position["highest"]
        assert position["coverage"] is None
    assert "position_error[A]" in collected(tmp_path / "out")["page"].decode()
