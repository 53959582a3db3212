"""Logs of other programs through ``init``: what is read is what was written, and the coefficients are the true ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import piga
from piga.describe import RunFileDraft, describe_log, draft_run_file, try_run_file
from tests.describe import foreign

SCALE = {"instrument.scale_factor": "0.8884 rad/s/g"}


def drafted(folder: Path, name: str, **settings: object) -> tuple[RunFileDraft, piga.Run]:
    foreign.LOGS[name](folder / name)
    draft = draft_run_file(describe_log(folder / name), SCALE | settings, folder=folder)
    assert draft.open == []
    return draft, try_run_file(draft, folder / "run.toml")


@pytest.mark.parametrize("name", foreign.LOGS)
def test_what_is_read_is_what_was_written(tmp_path: Path, name: str) -> None:
    _, run = drafted(tmp_path, name)
    truth = foreign.truth()
    left_out = [50, 51, 700] if name in ("words.csv", "fill.csv", "fill-in-counts.csv") else []
    used = np.delete(np.arange(truth["t"].size), left_out)
    np.testing.assert_allclose(run.t - run.t[0], truth["t"][used] - truth["t"][0], atol=2e-6)
    inside = ~run.begins[1:]
    read = np.diff(run.output)[inside] * 72000 / (2.0 * np.pi)
    np.testing.assert_allclose(read, np.diff(truth["counts"][used])[inside], atol=1e-6)
    np.testing.assert_allclose(run.f / 9.80665, truth["f"][used], atol=3e-8)


def test_times_without_decimals_give_the_rate_of_the_samples(tmp_path: Path) -> None:
    path = tmp_path / "rounded.csv"
    foreign.text(path, f"{foreign.NAMES},position", [
        f"{row},{p}" for row, p in zip(foreign.rows(foreign.rounded), foreign.truth()["position"], strict=True)
    ])  # fmt: skip
    draft = draft_run_file(describe_log(path), SCALE, folder=tmp_path)
    assert draft.document["data"]["sample_rate"] == "10 Hz"
    assert "each stands in 10 rows" in draft.comments["data.sample_rate"][0]
    assert try_run_file(draft, tmp_path / "run.toml").labels == tuple("123456")


def test_moves_of_a_head_are_left_out(tmp_path: Path) -> None:
    d = foreign.truth()
    body, now = [], 0
    for k, (n, angle) in enumerate(zip(d["counts"], d["angle"], strict=True)):
        body.append(f"{now / 10:.1f},{n},{angle:.4f}")
        now += 1
        if k + 1 < d["t"].size and d["angle"][k + 1] != angle:
            steps = np.linspace(angle, d["angle"][k + 1], 51)[1:-1]
            body += [f"{(now + j) / 10:.1f},{n},{x:.4f}" for j, x in enumerate(steps)]
            now += steps.size
    foreign.text(tmp_path / "head.csv", "time [s],counts,table angle [deg]", body)
    draft = draft_run_file(describe_log(tmp_path / "head.csv"), SCALE | {"stand.latitude": "48 deg"})
    assert draft.open == []
    assert draft.document["instrument"]["counts_per_revolution"] == 72000
    positions = [float(text.removesuffix(" deg")) for text in draft.document["stand"]["positions"]]
    assert np.abs(np.array(positions) - foreign.ANGLES).max() < 1e-3
    assert draft.document["data"]["segment"] == {"holds_of": "table angle"}
    run = try_run_file(draft, tmp_path / "run.toml")
    assert len(run.labels) == 6
    assert 0.97 * d["t"].size < run.size <= d["t"].size
    assert "moving" in {event.kind for event in run.quality.events}


def test_pulses_of_each_sample_are_summed(tmp_path: Path) -> None:
    pulses = np.diff(foreign.truth()["counts"], prepend=0)
    foreign.text(tmp_path / "x.csv", foreign.NAMES, foreign.changed(1, lambda k, _: str(pulses[k])))
    draft = draft_run_file(describe_log(tmp_path / "x.csv"), SCALE)
    assert draft.open == []
    assert draft.document["data"]["output"]["kind"] == "pulses"
    assert draft.document["instrument"]["counts_per_revolution"] == 72000
    run = try_run_file(draft, tmp_path / "run.toml")
    assert np.abs(np.diff(run.output)).sum() > 1.0


def test_a_falling_output_is_turned_round(tmp_path: Path) -> None:
    body = foreign.changed(1, lambda _, n: str(-int(n)))
    foreign.text(tmp_path / "x.csv", foreign.NAMES, body)
    draft = draft_run_file(describe_log(tmp_path / "x.csv"), SCALE)
    assert draft.document["data"]["output"]["direction"] == -1
    assert "the output falls where fx is positive" in draft.comments["data.output"][-1]
    run = try_run_file(draft, tmp_path / "run.toml")
    rate = np.diff(run.output)[~run.begins[1:]]
    assert np.corrcoef(rate, run.f[1:, 0][~run.begins[1:]])[0, 1] > 0.99


def test_an_output_that_does_not_follow_the_force_is_named(tmp_path: Path) -> None:
    body = foreign.changed(1, lambda k, _: str(k * k))
    foreign.text(tmp_path / "x.csv", foreign.NAMES, body)
    draft = draft_run_file(
        describe_log(tmp_path / "x.csv"), SCALE | {"instrument.counts_per_revolution": 72000}
    )
    assert any("the output does not follow fx" in line for line in draft.comments["data.reference"])


def test_the_rotation_of_the_earth_is_named_where_no_rate_is_logged(tmp_path: Path) -> None:
    draft, _ = drafted(tmp_path, "letters.csv")
    assert any("rotation of the Earth" in line for line in draft.comments["data.reference"])
    foreign.text(
        tmp_path / "w.csv",
        f"{foreign.NAMES},wx_rad_s,wy_rad_s,wz_rad_s",
        [f"{row},0,0,0" for row in foreign.rows()],
    )
    draft = draft_run_file(describe_log(tmp_path / "w.csv"), SCALE)
    assert draft.document["data"]["base_rate"]["columns"] == ["wx_rad_s", "wy_rad_s", "wz_rad_s"]
    assert not any("Earth" in line for line in draft.comments["data.reference"])


@pytest.mark.long
def test_the_time_of_a_waveform(tmp_path: Path) -> None:
    from nptdms import ChannelObject, TdmsWriter

    first = foreign.truth()["position"] == 1
    with TdmsWriter(tmp_path / "x.tdms") as out:
        out.write_segment([
            ChannelObject("log", name, values[first], {"wf_increment": 0.1})
            for name, values in foreign.columns().items() if name != "time"
        ])  # fmt: skip
    draft = draft_run_file(
        describe_log(tmp_path / "x.tdms"), SCALE | {"instrument.counts_per_revolution": 72000}, folder=tmp_path
    )
    assert draft.document["data"]["time"] == {"column": "log/waveform time", "unit": "s"}
    run = try_run_file(draft, tmp_path / "run.toml")
    np.testing.assert_allclose(np.diff(run.t), 0.1, atol=1e-9)


def test_a_name_that_stands_twice_is_named_with_its_numbers(tmp_path: Path) -> None:
    draft, _ = drafted(tmp_path, "twice.csv")
    assert draft.document["data"]["reference"]["columns"] == ["fx#1", "fy", "fz"]
    draft.document["data"]["reference"]["columns"] = ["fx", "fy", "fz"]
    with pytest.raises(piga.DataError, match="duplicate column name 'fx'") as caught:
        try_run_file(draft, tmp_path / "run.toml")
    assert "'fx#1', 'fx#2'" in str(caught.value.remedy)
