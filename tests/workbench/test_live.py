"""The stream of the page Live against the compensation of the whole record."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

import piga
from piga.units import G0
from piga.workbench.live import KEPT, Live

ROWS = 2000


def record() -> piga.Run:
    inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec")
    t = np.arange(ROWS) / 50.0
    f = np.column_stack((G0 * (0.8 + 0.2 * np.sin(t)), np.full(ROWS, 0.6 * G0), np.zeros(ROWS)))
    return piga.Run.from_arrays(t, piga.propagate(inst, t, f), f, scale_factor=inst.scale_factor, serial="L")


def lines(run: piga.Run) -> str:
    rows = [
        f"{t!r},{o!r},{x!r},{y!r},{z!r}"
        for t, o, (x, y, z) in zip(run.t.tolist(), run.output.tolist(), run.f.tolist(), strict=True)
    ]
    return "t,output,fx,fy,fz\n" + "\n".join(rows) + "\n"


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("live") / "calibration.json"
    piga.calibrate(record(), terms=["tan_beta", "k0"]).to_json(path)
    return path


@pytest.mark.only_compiled
def test_a_stream_shows_what_the_whole_record_gives(calibration: Path) -> None:
    run = record()
    live = Live(calibration)
    live.read(io.StringIO(lines(run)))
    assert (live.state, live.message, live.rows, live.serial) == ("ended", "", ROWS, "L")
    whole = piga.compensate(run, piga.Calibration.from_json(calibration))
    rows = live.latest(1e9, 10**6)
    assert np.array_equal(rows[1:, 3], whole.ax[1:])
    assert np.array_equal(rows[:, 5], whole.u_ax, equal_nan=True)
    indicated = np.diff(run.output) / np.diff(run.t) / run.scale_factor
    assert rows[1:, 1] == pytest.approx(indicated, rel=1e-12)
    assert np.abs(indicated - 0.5 * (run.f[1:, 0] + run.f[:-1, 0])).max() > 1e-3  # the cross-coupling shows
    assert np.abs(rows[1:, 3] - 0.5 * (run.f[1:, 0] + run.f[:-1, 0])).max() < 1e-4


@pytest.mark.only_compiled
def test_thinning_keeps_the_extremes(calibration: Path) -> None:
    live = Live(calibration)
    live.read(io.StringIO(lines(record())))
    whole, thin = live.latest(1e9, 10**6), live.latest(1e9, 100)
    assert len(thin) <= 101
    for column, pick in ((1, np.nanmin), (2, np.nanmax), (3, np.nanmin), (4, np.nanmax), (5, np.nanmax)):
        assert pick(thin[:, column]) == pick(whole[:, column])
    assert live.latest(10.0, 10**6)[0, 0] >= record().t[-1] - 10.0


@pytest.mark.only_compiled
def test_a_long_stream_keeps_its_latest_rows(calibration: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("piga.workbench.live.KEPT", 300)
    live = Live(calibration)
    live.read(io.StringIO(lines(record())))
    rows = live.latest(1e9, 10**6)
    assert rows[:, 0] == pytest.approx(record().t[-300:])
    assert KEPT > 300


def test_a_wrong_line_ends_it_with_its_number_and_what_came_before_stays(calibration: Path) -> None:
    text = lines(record()).splitlines(keepends=True)
    live = Live(calibration)
    live.read(io.StringIO("".join([*text[:11], "1,2,<b>,4,5\n"])))
    assert live.state == "stopped"
    assert "line 12" in live.message
    assert live.rows == 10


def test_flags_become_alarms(calibration: Path) -> None:
    run = record()
    text = lines(run).splitlines(keepends=True)
    far = [
        f"{t!r},{o!r},{x!r},{9.0 * y!r},{z!r}\n"
        for t, o, (x, y, z) in zip(run.t.tolist(), run.output.tolist(), run.f.tolist(), strict=True)
    ]
    live = Live(calibration)
    live.read(io.StringIO("".join([*text[:501], *far[500:600]])))
    alarms = {alarm.flag: alarm for alarm in live.alarms()}
    assert alarms["out_of_range"].rows == pytest.approx(100, abs=1)
    assert alarms["out_of_range"].first == pytest.approx(run.t[500], abs=0.03)
    assert alarms["out_of_range"].last == run.t[599]
