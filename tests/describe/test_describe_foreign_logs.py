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
