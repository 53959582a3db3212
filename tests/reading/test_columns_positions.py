"""Positions told by the column of the stand: holds, moves, ramps; settling, pulses, direction, counts lost in a gap."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import piga
from piga.errors import DataError
from piga.reading.columns import positions

RATE = 100.0
K = 0.8884
"""Nominal scale factor [rad/s/g]."""


def stand(levels, dwell, move, noise, resolution, seed=0):
    """A column of a stand: holds joined by straight moves; the rows of the true holds."""
    rng = np.random.default_rng(seed)
    parts, spans, at = [], [], 0
    for k, level in enumerate(levels):
        if k and move:
            parts.append(np.linspace(levels[k - 1], level, move + 2)[1:-1])
            at += move
        parts.append(np.full(dwell, level))
        spans.append((at, at + dwell))
        at += dwell
    x = np.concatenate(parts) + noise * rng.standard_normal(at)
    return (np.round(x / resolution) * resolution if resolution else x), spans


@pytest.mark.parametrize("noise", [0.0, 1e-4, 2e-3])
@pytest.mark.parametrize("resolution", [0.0, 1e-3])
@pytest.mark.parametrize("move", [0, 7, 300, 3000])
def test_holds_are_found_and_moves_are_not(noise, resolution, move):
    levels = [0.0, 15.0, 45.0, 180.0, 195.0, 359.0]
    x, spans = stand(levels, 2000, move, noise, resolution)
    found = positions(x)
    assert len(found) == len(levels)
    for (start, stop), (first, end) in zip(found, spans, strict=True):
        assert first <= start < stop <= end, "rows of a move are in a position"
        assert stop - start > 0.97 * (end - first), "rows of a position are lost"


def save(folder: Path, table: np.ndarray, output: str = "%.0f") -> None:
    form = ["%.2f", output, "%.6f"]
    np.savetxt(folder / "log.csv", table, form, ",", header="t,n,angle", comments="")


def load(folder: Path) -> np.ndarray:
    return np.loadtxt(folder / "log.csv", delimiter=",", skiprows=1)


def head_log(folder: Path, *, kind="counts", direction=1, gap=0, lost=0, move=300, noise=1e-4) -> Path:
    """A log of a dividing head with recorded moves and without labels, and its run file."""
    angles = [0.0, 30.0, 60.0, 120.0, 150.0, 180.0, 210.0, 240.0, 300.0, 330.0]
    x, _ = stand(angles, 3000, move, 0.0, 0.0)
    t = np.arange(x.size) / RATE
    rate = K * np.cos(np.radians(x))
    turned = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) / RATE)])
    counts = np.floor(turned / (2 * np.pi) * 36_000)
    pulses = np.diff(counts, prepend=counts[:1])
    keep = np.ones(x.size, bool)
    if gap:
        at = 3000 + move + 1500
        keep[at : at + gap] = False
        counts[at + gap :] -= lost * (counts[at + gap] - counts[at - 1])
    seen = x + noise * np.random.default_rng(1).standard_normal(x.size)
    output = direction * (pulses if kind == "pulses" else counts)
    table = np.column_stack([t, output, seen])[keep]
    save(folder, table)
    (folder / "run.toml").write_text(
        f"""[instrument]
serial = "T-1"
scale_factor = "{K} rad/s/g"
counts_per_revolution = 36000
[data]
file = "log.csv"
output = {{ column = "n", kind = "{kind}", direction = {direction} }}
time = {{ column = "t", unit = "s" }}
segment = {{ holds_of = "angle" }}
[stand]
kind = "dividing-head"
latitude = "0 deg"
gravity = "9.80665 m/s^2"
positions = {[f"{angle} deg" for angle in angles]}
"""
    )
    return folder / "run.toml"


def test_a_log_with_moves_gives_the_positions_alone(tmp_path):
    run = piga.read_run(head_log(tmp_path))
    moving = next(event for event in run.quality.events if event.kind == "moving")
    assert 9 * 300 <= moving.count <= 9 * 300 + 10 * 40
    inside = ~run.begins[1:]
    assert np.abs(np.diff(run.f[:, 0])[inside]).max() == 0.0, "a row of a move is in a position"
    rate = np.diff(run.output) * RATE - K * run.f[1:, 0] / 9.80665
    assert np.abs(rate[inside]).max() < 0.02


@pytest.mark.parametrize("kind", ["counts", "pulses"])
@pytest.mark.parametrize("direction", [1, -1])
def test_pulses_and_falling_outputs_are_the_same_record(tmp_path, kind, direction):
    reference = piga.read_run(head_log(tmp_path))
    (tmp_path / "b").mkdir()
    run = piga.read_run(head_log(tmp_path / "b", kind=kind, direction=direction))
    assert np.allclose(np.diff(run.output), np.diff(reference.output), atol=1e-12)
    assert len(run.labels) == len(reference.labels) == 10
    assert set(run.phase_group) == {0}


@pytest.mark.parametrize(
    ("kind", "lost", "event"),
    [
        ("counts", 0.0, ""),
        ("counts", 1.0, "counts-lost"),
        ("counts", 0.3, "counts-lost"),
        ("pulses", 0.0, "pulses-lost"),
    ],
)
def test_counts_lost_in_a_gap_begin_a_phase_anew(tmp_path, kind, lost, event):
    run = piga.read_run(head_log(tmp_path, kind=kind, gap=500, lost=lost))
    assert {one.kind for one in run.quality.events} & {"counts-lost", "pulses-lost"} == {event} - {""}
    assert len(set(run.phase_group)) == 1 + bool(event)


@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_a_folded_angle_that_lost_its_zero_in_a_gap_begins_anew(tmp_path, lost):
    """Whole turns are not seen; the rest of 0.3 of the 3.4 turns is."""
    path = head_log(tmp_path, gap=500, lost=lost)
    log = load(tmp_path)
    log[:, 1] = log[:, 1] / 100.0 % 360.0
    save(tmp_path, log, "%.6f")
    text = path.read_text().replace("counts_per_revolution = 36000\n", "")
    path.write_text(text.replace('kind = "counts"', 'kind = "angle", unit = "deg", wraps_at = "360 deg"'))
    run = piga.read_run(path)
    assert len(set(run.phase_group)) == 1 + (lost > 0.0)


def test_a_loss_is_seen_where_the_output_turns_slowly(tmp_path):
    path = head_log(tmp_path, gap=500, lost=0.5)
    log = load(tmp_path)
    gap = int(np.argmax(np.diff(log[:, 0]))) + 1
    begin = 3300
    slow = 0.09 * (log[:, 0] - log[begin, 0]) * 36_000 / (2 * np.pi)
    log[begin:, 1] = log[begin, 1] + np.round(slow[begin:])
    log[gap:, 1] -= 0.45 * 36_000 / (2 * np.pi)
    save(tmp_path, log)
    run = piga.read_run(path)
    assert "counts-lost" in {event.kind for event in run.quality.events}
    assert abs(np.ptp(run.output[begin:gap])) < 2 * np.pi


def test_settle_leaves_out_the_beginning_of_each_position(tmp_path):
    path = head_log(tmp_path)
    whole = piga.read_run(path)
    path.write_text(path.read_text().replace("[stand]", 'settle = "2 s"\n[stand]'))
    run = piga.read_run(path)
    (event,) = (event for event in run.quality.events if event.kind == "settling")
    assert event.count == whole.size - run.size == 10 * 200


def test_a_stand_that_never_stands_still_is_refused(tmp_path):
    path = head_log(tmp_path)
    rows = load(tmp_path)
    rows[:, 2] = np.linspace(0.0, 360.0, rows.shape[0])
    save(tmp_path, rows)
    with pytest.raises(DataError, match="nowhere stands still"):
        piga.read_run(path)
