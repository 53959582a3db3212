"""Whole-revolution averaging: right where it applies, less certain than the whole angle, honest about the rest."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import piga
from piga.data import copy_example
from piga.records.run_file import UncertaintyTable
from piga.studies import whole_turns
from piga.units import G0
from tests.calibration.made.synthetic import SCALE, TERMS, at_rest, errors, record

MEAN = ["scale_factor", "k0", "k2", "m_Y"]


@pytest.mark.long
def test_same_truth_with_larger_uncertainty() -> None:
    squares = []
    for seed in range(4):
        run = record(np.random.default_rng([seed, 51]), white=5e-5, walk=1e-6, seconds=60.0)
        turns, whole = piga.calibrate(whole_turns(run), MEAN), piga.calibrate(run, TERMS)
        z = errors(turns)
        assert all(abs(value) < 4.5 for value in z.values()), z
        squares += [value**2 for value in z.values()]
        for name in ("scale_factor", "k0", "k2", "m_Y"):
            assert 1.2 * whole[name].std < turns[name].std < 30.0 * whole[name].std
    assert np.mean(squares) < 1.3


NEAR = (-2.5, -1.8, -1.4, -1.15, 1.15, 1.4, 1.8, 2.5)
"""Ratios a/b of positions near lock."""


def near_lock(rng: np.random.Generator, records: int, walk: float, white: float) -> list[piga.Run]:
    """Records of eight positions near lock under 5 g across and six of a head, by Heun's method in NumPy.

    tan_beta 0.02, k0 1e-3 g; a random walk [rad/sqrt(s)] moves the gimbal, white noise [rad] is read.
    """
    ratio, turned = np.array(NEAR), 0.13 + 2.0 * np.pi * np.arange(6) / 6
    near = np.stack([0.1 * ratio, 5.0 * np.cos(np.arange(8.0)), 5.0 * np.sin(np.arange(8.0))], axis=1)
    forces = np.vstack([near, np.stack([np.cos(turned), -np.sin(turned), 0.02 + 0.0 * turned], axis=1)])
    a, y, z = forces.T
    h, inner, samples = 0.02, 12, 1250

    def rate(alpha: np.ndarray) -> np.ndarray:
        return 0.8884 * (a + 1e-3 + 0.02 * (y * np.sin(alpha) - z * np.cos(alpha)))

    alpha = rng.uniform(-np.pi, np.pi, (records, a.size))
    read = [alpha]
    for _ in range(samples):
        for _ in range(inner):
            pushed = walk * np.sqrt(h) * rng.standard_normal(alpha.shape)
            first = rate(alpha)
            alpha = alpha + 0.5 * h * (first + rate(alpha + h * first + pushed)) + pushed
        read.append(alpha)
    output = np.moveaxis(np.array(read), 0, 2)
    output = output + white * rng.standard_normal(output.shape)
    t = np.add.outer(310.0 * np.arange(a.size), inner * h * np.arange(samples + 1))
    segment = np.repeat(np.arange(a.size, dtype=np.int32), samples + 1)
    force = np.repeat(forces * G0, samples + 1, axis=0)
    return [
        piga.Run.from_arrays(t.ravel(), one.ravel(), force, scale_factor=SCALE, segment=segment, units="SI")
        for one in output
    ]


def missed(result: piga.Calibration) -> dict[str, tuple[float, bool]]:
    """Error over standard uncertainty, and whether the 95 % interval holds the truth."""
    truth = {"scale_factor": 0.8884, "k0": 1e-3}
    return {
        c.name: ((c.value - truth[c.name]) / c.std, c.limits[0] <= truth[c.name] <= c.limits[1])
        for c in result.coefficients
    }


@pytest.mark.long
@pytest.mark.parametrize(("walk", "white"), [(1e-4, 0.0), (5e-5, 1e-4), (0.0, 1e-4)])
def test_near_lock_the_truth_is_in_reach(walk: float, white: float) -> None:
    run = near_lock(np.random.default_rng([3, 61]), 1, walk, white)[0]
    calibration = piga.calibrate(whole_turns(run), ("scale_factor", "k0"))
    assert all(abs(z) < 4.0 for z, _ in missed(calibration).values()), missed(calibration)
    assert len(calibration.segments) == 12, "two positions have their lock zone at 0.87 of the drive"


def turning(seed: int, **options: Any) -> piga.Run:
    return record(
        np.random.default_rng(seed), **({"seconds": 45.0, "rate": 1.5, "count": 6, "levels": (1.0,)} | options)
    )


@pytest.mark.interpreted
@pytest.mark.long
def test_whole_turns_of_a_small_record() -> None:
    rest = at_rest()
    stated = UncertaintyTable(waived=rest.waived, reference_scale="20 ppm")
    calibration = piga.calibrate(whole_turns(replace(turning(31), uncertainty=stated)), MEAN)
    (scale,) = [row.contributions["scale_factor"] for row in calibration.budget if row.type == "B"]
    assert abs(scale) == pytest.approx(20e-6 * 0.8884, rel=1e-3)
    assert calibration["scale_factor"].std > abs(scale)
    apart = piga.calibrate(whole_turns(replace(turning(31), uncertainty=rest)), MEAN)
    assert all(abs(z) < 4.5 for z in errors(apart).values()), errors(apart)
    assert calibration["scale_factor"].std == pytest.approx(
        np.hypot(apart["scale_factor"].std, scale), rel=1e-6
    )


def test_a_run_file_that_asks_for_the_former_method_names_the_study(tmp_path: Path) -> None:
    path = copy_example(tmp_path)
    path.write_text(path.read_text("utf-8") + '\n[estimation]\nmethod = "revolutions"\n', encoding="utf-8")
    with pytest.raises(piga.ArgumentError, match=r"'revolutions'[\s\S]*whole_turns"):
        piga.calibrate(piga.read_run(path))


@pytest.mark.interpreted
def test_positions_without_a_whole_turn() -> None:
    turns = whole_turns(turning(32, seconds=16.0, count=14))
    (event,) = [event for event in turns.quality.events if event.kind == "position-left-out"]
    assert "does not turn once" in event.detail
    assert 0 < event.count == 14 - len(turns.labels)
    with pytest.raises(piga.CalibrationError, match="whole turns"):
        whole_turns(turning(33, seconds=5.0))


@pytest.mark.interpreted
@pytest.mark.long
def test_whole_turns_need_steady_positions() -> None:
    run = record(np.random.default_rng(53), seconds=45.0, rate=1.0, count=6, levels=(1.0,))
    f = run.f.copy()
    f[run.segment_index == 2] *= (1.0 + 0.2 * np.sin(run.t[run.segment_index == 2]))[:, None]
    assert "2" not in whole_turns(replace(run, f=f)).labels
    assert "2" in whole_turns(run).labels
