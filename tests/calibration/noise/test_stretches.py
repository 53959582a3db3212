"""Counts of a log, and the projection of coarsely counted stretches: against the sums written out, whatever the blocks."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import piga
from piga._kernels.estimation.noise import WAVES, add_waves
from piga.calibration.fit.one_run import fit_run, refine_counted
from piga.calibration.model import design as design_module
from piga.calibration.model.design import DESIGN, Design
from piga.calibration.model.request import Request
from piga.calibration.noise.counted import count_of
from piga.calibration.noise.stretches import (
    SawTooth,
    empty_stretches,
    find_stretches,
    follow,
    looks_white,
    residual_blocks,
)
from piga.records.run import Run
from piga.units import G0
from tests.calibration.made.scenarios import SCENARIOS
from tests.calibration.made.synthetic import SCALE


def test_waves_are_powers_of_the_first() -> None:
    """Sums over bins of ``exp(2 pi i m x)`` written out, begun in the middle of a bin."""
    rng = np.random.default_rng(2)
    turned = 1e5 * rng.random(50)
    edges = np.array([0, 13, 20, 41, 60])
    cosines, sines = np.zeros((8, 4)), np.zeros((8, 4))
    work = np.empty((4, WAVES))
    add_waves(turned[:20], 7, edges, work, cosines, sines)
    add_waves(turned[20:], 27, edges, work, cosines, sines)
    wave = np.exp(2j * math.pi * np.outer(np.arange(1, 9), turned))
    bins = np.searchsorted(edges, np.arange(7, 57), side="right") - 1
    expected = np.stack([wave[:, bins == k].sum(axis=1) for k in range(4)], axis=1)
    np.testing.assert_allclose(cosines + 1j * sines, expected, atol=1e-8)


@pytest.mark.parametrize("bad", [0.0, 0.2])
@pytest.mark.parametrize("size", [1 << 16, 61, 8])
def test_sums_do_not_depend_on_the_blocks(size: int, bad: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Mean angle of every bin by its definition, over the good samples."""
    scenario = SCENARIOS["coarse"]
    run = scenario.record(np.random.default_rng(4))
    left_out = (np.random.default_rng(5).random(run.size) < bad) & ~run.begins
    run = replace(run, left_out=left_out if bad else None)
    monkeypatch.setattr(design_module, "DESIGN", replace(DESIGN, chunk=size))
    design = Design(
        run,
        Request(("scale_factor", "k0"), "shared", "output", "information", None, None, 293.15),
        run.scale_factor,
    )
    assert len(list(design.blocks())) >= 0.9 * (run.size // size)
    stretches = find_stretches(design, 24)
    assert [(s.start, s.stop) for s in stretches] == [
        (201 * k, 201 * (k + 1)) for k in range(len(scenario.forces))
    ]
    for stretch in stretches:
        rows = stretch.start + np.flatnonzero(~left_out[stretch.start : stretch.stop])
        assert stretch.size == rows.size
        bins = np.searchsorted(stretch.edges, np.arange(stretch.size), side="right") - 1
        turned = run.output[rows] - run.output[stretch.start]
        mean = [turned[bins == k].mean() for k in range(stretch.edges.size - 1)]
        time = [run.t[rows][bins == k].mean() for k in range(stretch.edges.size - 1)]
        np.testing.assert_allclose(stretch.mean(stretch.angle)[-1], mean, atol=1e-10)
        np.testing.assert_allclose(stretch.mean(stretch.time), time, rtol=1e-14)
        assert stretch.limits == (run.t[stretch.start], run.t[stretch.stop - 1])
        assert stretch.span == np.ptp(run.output[stretch.start : stretch.stop])
        assert stretch.end[-1] == pytest.approx(turned[-1], abs=1e-10)


def scanned(rate: float, swing: float, noise: float = 0.05) -> tuple[Design, np.ndarray]:
    """100 000 samples of a path of ``rate`` counts a sample, swinging by ``swing`` of it, read in whole counts."""
    count, n = 1e-4, 100_000
    t = 0.01 * np.arange(n)
    f = np.zeros((n, 3))
    f[:, 0] = rate * count / 0.01 * (1.0 + swing * np.sin(0.1 * t))
    rng = np.random.default_rng(5)
    increments = 0.005 * (f[1:, 0] + f[:-1, 0])
    alpha = np.append(0.0, np.cumsum(increments)) + noise * count * rng.standard_normal(n)
    run = Run.from_arrays(t, count * np.round(alpha / count), f, scale_factor=1.0, resolution=count)
    request = Request(("scale_factor",), "shared", "output", "information", None, None, 293.15)
    return Design(run, request, 1.0), np.array([[1.0]])


@pytest.mark.only_compiled
@pytest.mark.parametrize(
    ("rate", "swing", "white"),
    [(50.3, 0.5, True), (0.004, 0.5, False), (50.0, 0.0, False), (50.5, 1e-6, False)],
)
def test_counts_look_white_where_the_path_runs_through_them(rate: float, swing: float, white: bool) -> None:
    """Not where it stands among few counts, nor where the samples fall on the same part of a count again and again."""
    design, values = scanned(rate, swing)
    stretches = empty_stretches(design.run, 60, 0)
    teeth = follow(design.run, stretches, design.run.resolution, residual_blocks(design, values))
    assert looks_white(teeth) is white
    fit = refine_counted(fit_run(design.run, design.request))
    assert (fit.counted is None) is white


@pytest.mark.only_compiled
def test_power_over_white_is_one_for_white_noise() -> None:
    """Waves at random phases have the power that white noise has, in every contrast."""
    stretch = empty_stretches(scanned(50.3, 0.5)[0].run, 40, 0)[0]
    rng = np.random.default_rng(7)
    over = []
    for _ in range(250):
        tooth = SawTooth.of(stretch, 1e-4)
        add_waves(rng.random(stretch.size), 0, stretch.edges, np.empty((4, WAVES)), tooth.cosines, tooth.sines)
        over.append(tooth.over_white())
    np.testing.assert_allclose(np.mean(over, axis=0), 1.0, atol=0.3)
    assert np.mean(over) == pytest.approx(1.0, abs=0.04)


@pytest.mark.only_compiled
def test_one_line_is_not_white() -> None:
    """A single contrast with twenty times the power of white noise."""
    stretch = empty_stretches(scanned(50.3, 0.5)[0].run, 160, 0)[0]
    tooth = SawTooth.of(stretch, 1e-4)
    add_waves(
        np.random.default_rng(7).random(stretch.size),
        0,
        stretch.edges,
        np.empty((4, WAVES)),
        tooth.cosines,
        tooth.sines,
    )
    assert looks_white([tooth])
    power = (stretch.contrasts**2 / np.diff(stretch.edges)).sum(axis=1)[20] * tooth.power.sum() / tooth.power[0]
    tooth.cosines[0] += math.sqrt(20.0 * power) * stretch.contrasts[20] * np.diff(stretch.edges)
    assert tooth.over_white()[20] > 12.0
    assert not looks_white([tooth])


ARCSECOND = math.pi / 648000.0


def log_of_angles(output: np.ndarray, resolution: float = 0.0) -> piga.Run:
    t = 0.1 * np.arange(output.size)
    f = np.tile([G0, 0.0, 0.0], (output.size, 1))
    return piga.Run.from_arrays(t, output, f, scale_factor=SCALE, resolution=resolution, serial="angles")


def test_the_count_of_a_log_that_does_not_state_it() -> None:
    count = 20.0 * ARCSECOND
    t = 0.1 * np.arange(900)
    turn = 0.003 * t + 1e-4 * np.sin(0.4 * t)
    assert count_of(log_of_angles(np.round(turn / count) * count)) == pytest.approx(count, rel=1e-6)
    assert count_of(log_of_angles(turn)) == 0.0  # no two steps alike
    assert count_of(log_of_angles(0.003 * t)) == 0.0  # one step only: a steady turn says nothing
    steps = np.random.default_rng(2).choice([1.0, 1.7, 2.0], t.size) * count
    assert count_of(log_of_angles(np.cumsum(steps))) == 0.0  # few steps, but no multiples of one
    assert count_of(log_of_angles(turn, resolution=5e-5)) == 5e-5  # what is stated counts
