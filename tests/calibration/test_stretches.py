"""Projection of coarsely counted stretches: against the sums written out, whatever the blocks."""

from __future__ import annotations

import math

import numpy as np
import pytest

from piga._kernels.counting import add_waves
from piga.calibration import design as design_module
from piga.calibration.design import Design
from piga.calibration.request import Request
from piga.calibration.stretches import find_stretches
from tests.calibration.scenarios import SCENARIOS


def test_waves_are_powers_of_the_first() -> None:
    """Sums over bins of ``exp(2 pi i m x)`` written out, begun in the middle of a bin."""
    rng = np.random.default_rng(2)
    turned = 1e5 * rng.random(50)
    edges = np.array([0, 13, 20, 41, 60])
    cosines, sines = np.zeros((8, 4)), np.zeros((8, 4))
    add_waves(turned[:20], 7, edges, cosines, sines)
    add_waves(turned[20:], 27, edges, cosines, sines)
    wave = np.exp(2j * math.pi * np.outer(np.arange(1, 9), turned))
    bins = np.searchsorted(edges, np.arange(7, 57), side="right") - 1
    expected = np.stack([wave[:, bins == k].sum(axis=1) for k in range(4)], axis=1)
    np.testing.assert_allclose(cosines + 1j * sines, expected, atol=1e-8)


@pytest.mark.parametrize("size", [1 << 16, 61, 8])
def test_sums_do_not_depend_on_the_blocks(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Mean angle of every bin by its definition."""
    scenario = SCENARIOS["coarse"]
    run = scenario.record(np.random.default_rng(4))
    monkeypatch.setattr(design_module, "CHUNK", size)
    design = Design(
        run,
        Request(("scale_factor", "k0"), "shared", "output", "information", None, None, 293.15),
        run.scale_factor,
    )
    assert len(list(design.blocks())) >= run.size // size
    found = find_stretches(design, 24)
    assert [(s.start, s.stop) for s in found] == [(201 * k, 201 * (k + 1)) for k in range(len(scenario.forces))]
    for stretch in found:
        rows = slice(stretch.start, stretch.stop)
        bins = np.searchsorted(stretch.edges, np.arange(stretch.size), side="right") - 1
        turned = run.output[rows] - run.output[stretch.start]
        mean = [turned[bins == k].mean() for k in range(stretch.edges.size - 1)]
        time = [run.t[rows][bins == k].mean() for k in range(stretch.edges.size - 1)]
        np.testing.assert_allclose(stretch.mean(stretch.angle)[-1], mean, atol=1e-10)
        np.testing.assert_allclose(stretch.mean(stretch.time), time, rtol=1e-14)
        assert stretch.limits.tolist() == [run.t[rows][0], run.t[rows][-1]]
        assert stretch.end[-1] == pytest.approx(turned[-1], abs=1e-10)
