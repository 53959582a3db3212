"""What a record does: a stand, a platform, an archive; and that it is what a user gets by hand."""

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import piga
from piga.campaign import collect, document, open_campaign, plan_campaign, read_campaign
from piga.campaign.manifest import Archive
from piga.campaign.shard import run_shard
from piga.campaign.subjects import NOISE_DOUBTED, compute, of_calibration, seed_of
from piga.cli.main import app
from tests.calibration.made.coloured_truth import LOG
from tests.calibration.made.independent import head
from tests.campaign.small import ROOT, collected, computed, rows, written

EXAMPLES = ROOT / "examples" / "campaigns"
STAND = """
[instrument]
serial = "s"
scale_factor = "0.8884 rad/s/g"
[truth]
beta = "74 arcsec"
alpha0 = "0.8 rad"
k0 = "3e-4 g"
[electronics]
sample_rate = "10 Hz"
output = "angle"
angle_noise = "5 arcsec"
angle_random_walk = "4 arcsec/sqrt(s)"
[stand]
kind = "dividing-head"
latitude = "40 deg"
positions = "0:360:60 deg"
dwell = "6 s"
move = "2 s"
settling_time = "0.5 s"
[model]
terms = ["scale_factor", "tan_beta", "k0"]
"""
CAMPAIGN = """
scenario = "stand.toml"
[campaign]
seed = 3
repeats = 3
bounds = 1
records_per_shard = 2
[grid]
"truth.k0" = ["1e-4 g", "3e-4 g"]
"""


@pytest.mark.parametrize(
    "name", sorted(path.name for path in EXAMPLES.glob("*.toml") if path.stem != "servo-centrifuge")
)
def test_examples_are_valid(name):
    plan = read_campaign(EXAMPLES / name)
    expected = {"fleet.toml": 320, "platform.toml": 48, "sensitivity.toml": 36, "archive.toml": 0}
    assert plan.records == expected.get(name, plan.records)
    assert plan.file.campaign.title


def test_every_row_of_the_accuracy_page_has_its_scenario():
    page = json.loads((ROOT / "docs" / "measured" / "intervals.json").read_text(encoding="utf-8"))
    plan = read_campaign(EXAMPLES / "coverage.toml")
    records = {group.name: group.records for group in plan.groups}
    shown = {f["scenario"]: f["value"] for f in page["figures"] if f["column"] == "tests"}
    assert set(shown) <= set(records)


@pytest.mark.only_compiled
def test_a_record_of_a_stand_is_simulate_and_calibrate(tmp_path, capsys):
    """``piga simulate`` and ``piga calibrate``, with the seed of the record, give the same bits."""
    written(tmp_path, STAND, "stand.toml")
    path = written(tmp_path, CAMPAIGN)
    computed(path, tmp_path / "out")
    row = rows(tmp_path / "out")[4]
    assert (row["case"], row["repeat"]) == (1, 1)
    plan = read_campaign(path)
    seed = seed_of(plan, plan.find(1, 1))
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
    words = ["campaign", "repeat", str(path), "--case", "1", "--repeat", "1", "--out", str(where), "--json"]
    app(words, standalone_mode=False)
    again = json.loads(capsys.readouterr().out)
    assert [c["value"] for c in again["coefficients"]] == row["value"]
    app(["simulate", str(where / "scenario.toml"), "--out", str(tmp_path / "sim2")], standalone_mode=False)
    twice = piga.calibrate(piga.read_run(tmp_path / "sim2" / "run.toml"))
    assert [c.value for c in twice.coefficients] == row["value"]


@pytest.mark.only_compiled
def test_bound_of_a_stand_is_that_of_known_noise(tmp_path):
    """The bound is there for the first repeat only, and close to the standard uncertainty that the record itself gives."""
    written(tmp_path, STAND.replace('dwell = "6 s"', 'dwell = "30 s"'), "stand.toml")
    plan = read_campaign(written(tmp_path, CAMPAIGN))
    first, second = (compute(plan, plan.find(0, k)) for k in (0, 1))
    assert np.isnan(second.bound).all()
    assert first.bound == pytest.approx(first.u, rel=0.25)
    written(tmp_path, STAND + "[uncertainty]\nreference_scale = '1 ppm'\n", "stand.toml")
    assert np.isnan(compute(read_campaign(tmp_path / "small.toml"), plan.find(0, 0)).bound).all(), (
        "Type B has no such bound"
    )


NOISY = """
[campaign]
repeats = 1
[[case]]
name = "scatter"
[case.constant_force]
tumble = { positions = 8, levels = [0.5, 1.0] }
seconds = "10 s"
rate = "4 Hz"
white = "2.5e-5 rad"
scatter = "1e-4 rad/s"
truth = { k0 = 1.6e-3, m_Y = 5e-3 }
terms = ["scale_factor", "tan_beta", "k0"]
"""


def reported(folder, text):
    """What the first record of a campaign reports."""
    plan = read_campaign(written(folder, text))
    return compute(plan, plan.find(0, 0)).seen


@pytest.mark.only_compiled
def test_what_a_calibration_reports_is_counted(tmp_path):
    """Kinds of noise, and terms that are suggested."""

    seen = partial(reported, tmp_path)
    quiet = NOISY.replace('scatter = "1e-4 rad/s"\n', "")
    whole = ('"k0"]', '"k0", "m_Y"]')
    assert seen(quiet.replace(*whole)) == ()
    assert "scatter of the segments" in seen(NOISY.replace(*whole))
    assert "suggested: m_Y" in seen(quiet)


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
    figures = document(collect(open_campaign(tmp_path / "out")))
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


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """Three run files, of which two are in a store; a fourth that cannot be read."""
    folder = tmp_path_factory.mktemp("archive")
    written(folder, STAND, "stand.toml")
    for k in range(3):
        words = [
            "simulate",
            str(folder / "stand.toml"),
            "--out",
            str(folder / "runs" / f"r{k}"),
            "--seed",
            str(k),
        ]
        app(words, standalone_mode=False)
        if k < 2:
            store = ["--store", str(folder / "records.sqlite")]
            words = [
                "records",
                "add",
                str(folder / "runs" / f"r{k}" / "run.toml"),
                "--operator",
                "o",
                "--reason",
                "r",
                *store,
            ]
            app(words, standalone_mode=False)
    (folder / "runs" / "bad").mkdir()
    (folder / "runs" / "bad" / "run.toml").write_text("[data\n")
    return folder


TEXT = '[campaign]\nrecords_per_shard = 2\n[archive]\nruns = "runs/*/run.toml"\nstore = "records.sqlite"\n'


@pytest.mark.only_compiled
def test_archive_against_the_store(archive, tmp_path):
    computed(written(archive, TEXT), tmp_path / "out")
    figures = document(collect(open_campaign(tmp_path / "out")))
    assert (figures["computed"], figures["failed"]) == (4, 1)
    assert figures["failures"][0]["error_class"] == "RunFileError"
    assert "not valid TOML" in figures["failures"][0]["message"]
    assert figures["failures"][0]["command"] == "piga calibrate runs/bad/run.toml"
    group = figures["groups"][0]
    assert group["compared_with_store"] == {"identical": 2}
    scale = group["coefficients"][0]
    assert (scale["name"], scale["tests"], scale["bias"], scale["largest_z"]) == ("scale_factor", 3, 0.0, 0.0)
    assert scale["coverage"] is None
    page = collected(tmp_path / "out")["page"].decode()
    assert "identical" in page
    assert "1 records are not in the store" in page


RATES = replace(LOG, forces=head(12), seconds=20.0, pause=10.0)
LOGGED = """
[campaign]
repeats = 1
[[case]]
name = "rates"
[case.constant_force]
tumble = { positions = 12 }
seconds = "20 s"
pause = "10 s"
rate = "5 Hz"
kind = "rate"
walk = "2e-5 rad/sqrt(s)"
truth = { k0 = 3e-4 }
terms = ["scale_factor", "tan_beta", "k0"]
"""


@pytest.mark.only_compiled
def test_seen_has_what_the_record_says_of_its_noise(tmp_path):
    """A loud rate log has the doubt about the noise, a sound one does not."""
    seen = partial(reported, tmp_path)
    assert NOISE_DOUBTED not in seen(LOGGED)
    quiet = piga.calibrate(RATES.record(2), RATES.terms)
    doubted = replace(quiet, notes=(*quiet.notes, "the residuals are not white"))
    assert NOISE_DOUBTED in of_calibration(doubted, np.full(len(quiet), np.nan)).seen
    loud = seen(LOGGED.replace("truth =", 'flicker = "6e-5 rad/s"\ntruth ='))
    assert NOISE_DOUBTED in loud
    angles = LOGGED.replace('kind = "rate"', 'white = "2.5e-5 rad"').replace("2e-5 rad/sqrt", "1e-6 rad/sqrt")
    assert NOISE_DOUBTED not in seen(angles)


@pytest.mark.only_compiled
def test_archive_that_changed(archive, tmp_path):
    """A stored value that differs is seen, and so is a run file that changes after the plan."""
    path = written(archive, TEXT)
    campaign = plan_campaign(path, tmp_path / "out")
    plan, listed = campaign.plan, campaign.archive
    record = next(n for n, file in enumerate(listed.files) if file.run == "runs/r0/run.toml")
    other = next(file.stored for file in listed.files if file.run == "runs/r1/run.toml")
    wrong = [file._replace(stored=other) if n == record else file for n, file in enumerate(listed.files)]
    outcome = compute(plan, plan.record(record), Archive(listed.folder, tuple(wrong), listed.store))
    assert outcome.verdict == "other inputs"
    assert np.abs(outcome.error).max() > 0.0
    run = archive / "runs" / "r2" / "run.toml"
    before = run.read_bytes()
    try:
        run.write_bytes(before + b"\n# changed\n")
        for shard in range(campaign.shards):
            run_shard(str(tmp_path / "out"), shard)
    finally:
        run.write_bytes(before)
    figures = document(collect(open_campaign(tmp_path / "out")))
    assert {f["error_class"]: f["records"] for f in figures["failures"]} == {"DataError": 1, "RunFileError": 1}
    assert any("changed since the campaign was planned" in f["message"] for f in figures["failures"])


@pytest.mark.only_compiled
def test_terms_of_an_archive(archive, tmp_path):
    computed(written(archive, TEXT + 'terms = ["scale_factor", "k0"]\n'), tmp_path / "out")
    figures = document(collect(open_campaign(tmp_path / "out")))["groups"][0]
    assert [c["name"] for c in figures["coefficients"]] == ["scale_factor", "k0"]
    assert figures["compared_with_store"] == {"different": 2}
    assert math.isfinite(figures["coefficients"][1]["largest_z"])


@pytest.mark.only_compiled
def test_store_that_is_missing(archive, tmp_path):
    from piga.errors import PigaError

    with pytest.raises(PigaError, match=r"gone\.sqlite"):
        plan_campaign(written(archive, TEXT.replace("records.sqlite", "gone.sqlite")), tmp_path / "out")
    assert not Path(archive / "gone.sqlite").exists()
