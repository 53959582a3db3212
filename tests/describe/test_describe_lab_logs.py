"""Logs as other programs write them: a run file is drafted, the log is read and calibrated, and the numbers are right."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

import piga
from piga.describe import describe_log, draft_run_file, try_run_file
from piga.earth import Site

LOGS = Path(__file__).resolve().parent.parent / "data" / "logs"
SCALE = {"instrument.scale_factor": "0.8884 rad/s/g"}
STAND = {
    "centrifuge.csv": {
        "stand.latitude": "48 deg",
        "stand.radius": "1 m",
        "instrument.counts_per_revolution": 72000,
    }
}


def drafted(folder: Path, name: str) -> tuple[Path, piga.Run]:
    shutil.copy(LOGS / name, folder)
    target = folder / "run.toml"
    draft = draft_run_file(describe_log(folder / name), SCALE | STAND.get(name, {}), folder=folder)
    assert draft.open == []
    run = try_run_file(draft, target)
    target.write_text(draft.text(), encoding="utf-8")
    return target, run


GUESSED = {
    "german.csv": {
        "serial": "G-0417", "encoding": "cp1252", "decimal": ",", "header_row": 6, "units_row": 7,
        "time": {"column": "Zeitstempel", "stamp": "DD.MM.YYYY hh:mm:ss.f"},
        "temperature": {"column": "Temperatur", "unit": "°C"},
    },
    "labview.lvm": {"header_row": 20, "delimiter": "\t", "output": {"column": "Counter", "kind": "counts"}},
    "chinese.csv": {"serial": "BY-07", "encoding": "gb18030", "segment": "位置号"},
    "french.csv": {"serial": "A-12", "time": {"column": "Temps", "unit": "ms"}, "header_row": 2},
    "iso.csv": {"serial": "iso", "time": {"column": "timestamp", "stamp": "iso"}},
    "folded.tsv": {"serial": "T-9", "header_row": 5, "units_row": 6},
    "head-angle.csv": {"segment": {"holds_of": "Teilkopfwinkel"}},
    "centrifuge.csv": {"segment": "level"},
}  # fmt: skip


@pytest.mark.parametrize("name", GUESSED)
def test_what_is_guessed(name: str) -> None:
    document = draft_run_file(describe_log(LOGS / name)).document
    found = document["data"] | {"serial": document["instrument"]["serial"]}
    assert {key: found[key] for key in GUESSED[name]} == GUESSED[name]


def test_a_counter_that_folds_and_a_gap(tmp_path: Path) -> None:
    path, run = drafted(tmp_path, "folded.tsv")
    document = tomllib.loads(path.read_text(encoding="utf-8"))
    assert document["instrument"]["counter_bits"] == 16
    assert document["model"]["phases"] == "per-segment"
    assert "tan_beta" in document["model"]["terms"]
    kinds = {event.kind: event.count for event in run.quality.events}
    assert kinds["gap"] == 1
    assert kinds["counter-roll-over"] == 6
    steps = np.diff(run.output)[~run.begins[1:]] * 72000 / (2.0 * np.pi)
    assert np.abs(steps).max() < 1100


@pytest.mark.long
def test_the_angle_of_a_head_gives_the_reference(tmp_path: Path) -> None:
    path, run = drafted(tmp_path, "head-angle.csv")
    assert "azimuth = '90 deg'" in path.read_text(encoding="utf-8")
    stand = tomllib.loads(path.read_text(encoding="utf-8"))["stand"]
    assert stand["kind"] == "dividing-head"
    assert stand["positions"][:3] == ["0 Grad", "30 Grad", "60 Grad"]
    assert stand["latitude"] == "48 Grad"
    np.testing.assert_allclose(
        np.unique(run.f[:, 0].round(6)).max(), Site(np.deg2rad(48.0)).local_gravity, atol=1e-6
    )
    result = piga.calibrate(run)
    assert abs(result["scale_factor"].value / 0.8884 - 1.0) < 1e-5
    assert abs(result["k0"].value * 1e6 - 300.0) < 5.0 * result["k0"].std * 1e6


def test_a_stand_that_is_said_keeps_its_positions() -> None:
    log = describe_log(LOGS / "head-angle.csv")
    alone, said = (draft_run_file(log, settings).document for settings in ({}, {"stand.kind": "dividing-head"}))
    assert said["stand"]["positions"] == alone["stand"]["positions"]
    assert "positions" not in draft_run_file(log, {"stand.kind": "centrifuge"}).document["stand"]


def test_the_speed_of_a_centrifuge_gives_the_reference(tmp_path: Path) -> None:
    path, run = drafted(tmp_path, "centrifuge.csv")
    stand = tomllib.loads(path.read_text(encoding="utf-8"))["stand"]
    assert stand["kind"] == "centrifuge"
    assert stand["rates"] == [f"{rate} rpm" for rate in (30, 60, 90, 120, 90, 60, 30)]
    assert run.f[:, 0].max() == pytest.approx((120.0 * 2.0 * np.pi / 60.0) ** 2, rel=1e-3)


def test_counts_of_a_revolution_from_the_log(tmp_path: Path) -> None:
    """The log of LabVIEW does not say them: output over specific force and the nominal scale factor do."""
    path, _ = drafted(tmp_path, "labview.lvm")
    assert "# from the log: 7" in path.read_text(encoding="utf-8")
    draft = draft_run_file(describe_log(LOGS / "labview.lvm"), {"instrument.counts_per_revolution": 72000})
    assert draft.document["instrument"]["scale_factor"].startswith("0.888")


def test_what_the_log_does_not_say_is_asked() -> None:
    draft = draft_run_file(describe_log(LOGS / "labview.lvm"))
    assert [one.key for one in draft.open] == ["instrument.scale_factor"]
    draft = draft_run_file(describe_log(LOGS / "centrifuge.csv"), SCALE)
    assert [one.key for one in draft.open] == [
        "instrument.counts_per_revolution",
        "stand.latitude",
        "stand.radius",
    ]


def test_a_stand_is_given_for_a_log_without_force(tmp_path: Path) -> None:
    """Also key by key: the kind first, as a page or a command line gives it."""
    log = tmp_path / "log.csv"
    log.write_text("t,counts,position\n" + "".join(f"{t},{7 * t},{t // 10}\n" for t in range(40)))
    stand = {"stand.kind": "dividing-head", "stand.latitude": "40 deg", "stand.positions": "0:360:90 deg"}
    described = describe_log(log)
    draft = draft_run_file(described, SCALE | {"stand.kind": "dividing-head"})
    assert [one.key for one in draft.open] == ["instrument.counts_per_revolution", "stand.latitude"]
    draft = draft_run_file(described, SCALE | stand | {"instrument.counts_per_revolution": 72000})
    assert draft.open == []
    assert draft.document["stand"] == {key.partition(".")[2]: value for key, value in stand.items()}
    angles = ["0 deg", "90 deg", "180 deg", "270 deg"]
    named = dict(zip("abcd", angles, strict=True))
    for positions in ("0:360:90 deg", angles, named):
        settings = SCALE | stand | {"stand.positions": positions, "instrument.counts_per_revolution": 72000}
        terms = draft_run_file(described, settings).document["model"]["terms"]
        assert terms == ["scale_factor", "tan_beta", "k0", "m_Y"]


def test_rows_of_the_moving_head_are_no_positions(tmp_path: Path) -> None:
    """Up and down alone cannot tell the bias along Z0, though the force turns through it on the way."""
    angle = np.concatenate([np.zeros(200), np.linspace(0.0, np.pi, 20), np.full(200, np.pi)])
    rate = np.round(np.cumsum(1000.0 * np.cos(angle) + 10.0))
    rows = [
        f"{k / 20},{n:.0f},{np.cos(a):.6f},0,{np.sin(a):.6f}"
        for k, (n, a) in enumerate(zip(rate, angle, strict=True))
    ]
    log = tmp_path / "log.csv"
    log.write_text("\n".join(["t [s],counts,fx [g],fy [g],fz [g]", *rows]))
    draft = draft_run_file(describe_log(log), SCALE)
    assert draft.document["model"]["terms"] == ["scale_factor", "k0"]
    assert draft.comments["model.terms"] == [
        "terms that the 2 positions of this log can tell; more: piga terms"
    ]
