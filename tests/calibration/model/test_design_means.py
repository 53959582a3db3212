"""Means of neighbouring samples: a long record is reduced from them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import piga
from piga.calibration.model import design as design_module
from piga.calibration.model.design import Design, MeanDesign
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.request import make_request
from piga.calibration.weights import RATE, Noise, reduce_positions
from piga.units import G0
from tests.calibration.made.synthetic import SCALE, TERMS, TRUTH, record


@pytest.fixture
def short(monkeypatch):
    """Records above 300 rows count as long."""
    monkeypatch.setattr(design_module, "_MEANS", 300)
    monkeypatch.setattr(design_module, "_SHARED", 4)


def fine(seed: int, **options: float) -> piga.Run:
    return record(np.random.default_rng(seed), seconds=10.0, rate=40.0, levels=(0.5,), **options)


def test_nothing_is_approximated(short):
    """Without noise the coefficients of the exact propagator come back, and the means are used."""
    run = fine(1, white=0.0)
    design = Design(run, make_request(run, TERMS, "information"), run.scale_factor).means
    assert isinstance(design, MeanDesign)
    assert design.every > 4
    result = piga.calibrate(run, TERMS)
    assert result["scale_factor"].value == pytest.approx(0.8884, rel=1e-9)
    for name in ("tan_beta", "k0", "k2", "m_Y"):
        assert result[name].value == pytest.approx(TRUTH[name], abs=2e-9)


@pytest.mark.long
def test_samples_left_out_and_gaps(short):
    """A wrong reading is left out before the means, and no mean reaches across a gap."""
    run = fine(3)
    output, t = np.array(run.output), np.array(run.t)
    output[1000] += 0.2
    t[700:] += 3.0
    broken = replace(run, output=output, t=t, begins=run.begins | (np.arange(run.size) == 700))
    result, sound = piga.calibrate(broken, TERMS), piga.calibrate(run, TERMS)
    assert [outlier.row for outlier in result.outliers] == [1001]
    assert result["scale_factor"].value == pytest.approx(
        sound["scale_factor"].value, abs=sound["scale_factor"].std
    )


def test_a_fast_force_is_not_averaged(short):
    """The change of the force within a mean would be lost information."""
    t = np.arange(4001) / 100.0
    f = G0 * np.column_stack([1.0 + 0.3 * np.sin(40.0 * t), 0.2 * np.cos(40.0 * t), 0.0 * t])
    output = piga.propagate(piga.Instrument(scale_factor=SCALE, beta=1e-3), t, f, between="linear")
    run = piga.Run.from_arrays(t, output, f, scale_factor=SCALE, units="SI")
    design = Design(run, make_request(run, ["scale_factor", "k0"]), run.scale_factor)
    assert design.means is design


@pytest.mark.parametrize(("kind", "white"), [("angle", 1e-6), ("angle", 1e-4), ("rate", 0.0)])
def test_rows_have_unit_variance(short, kind, white):
    """White noise and walk of the means are weighted as they are: the residuals of the triangles have the size one."""
    run, rng = fine(4, white=0.0), np.random.default_rng(2)
    step = 1.0 / 40.0
    if kind == "angle":
        noise = Noise(white**2, (1e-5) ** 2)
        walk = np.cumsum(1e-5 * np.sqrt(step) * rng.standard_normal(run.size))
        noisy = replace(run, output=run.output + walk + white * rng.standard_normal(run.size))
    else:
        noise = Noise(0.0, (1e-5) ** 2 * step)
        rates = 0.8884 * run.f[:, 0] / G0 + 1e-5 * rng.standard_normal(run.size)
        noisy = replace(run, output=rates, kind="rate", f=run.f * np.array([1.0, 0.0, 0.0]))
    terms = TERMS if kind == "angle" else ["scale_factor", "k0"]
    design = Design(noisy, make_request(noisy, terms, "information"), run.scale_factor)
    assert isinstance(design.means, MeanDesign)
    total = Reduction.stacked(reduce_positions(design, noise))
    free = total.without((RATE,))
    assert total.count < 400
    assert free.factor[-1, -1] ** 2 / (total.count - len(terms) - 2) == pytest.approx(1.0, abs=0.25)


def test_a_moved_record_has_the_same_means(short):
    """A source of the budget moves the record; other means would add their noise to the effect of the source."""
    run = fine(5)
    f = run.f.copy()
    f[::2, 1] += 0.5 * G0
    moved, request = replace(run, f=f), make_request(run, TERMS, "information")
    design = Design(run, request, run.scale_factor)
    assert Design(moved, request, run.scale_factor).mean_size == 1
    assert design.of(moved).means.every == design.means.every > 4


@pytest.mark.parametrize("fault", ["interval", "pieces"])
def test_uneven_samples_are_not_averaged(short, fault):
    """Means of other lengths would have other correlations; a piece of one mean would lose its rows."""
    run = fine(3)
    t, begins, (first, last) = np.array(run.t), np.array(run.begins), run.segment_edges()[1:3]
    if fault == "interval":
        t[first:last] = t[first] + 0.5 * (t[first:last] - t[first])
    else:
        begins[first:last:3] = True
    uneven = replace(run, t=t, begins=begins)
    design = Design(uneven, make_request(uneven, TERMS, "information"), run.scale_factor)
    assert design.means is design


def test_the_first_mean_may_hold_the_first_sample_alone(monkeypatch):
    """Means of two of a stretch with an odd number of samples; the record of means was not a number, and had no result."""
    run = fine(1)
    odd = run.without(run.row[:2])  # 401 samples of the first position become 399
    first = np.flatnonzero(odd.begins)[1]
    assert first % 4 == 3
    monkeypatch.setattr(design_module, "_MEANS", odd.size // 2)
    monkeypatch.setattr(design_module, "_SHARED", 4)
    design = Design(odd, make_request(odd, TERMS, "information"), odd.scale_factor).means
    assert isinstance(design, MeanDesign)
    assert design.firsts[1] == 1
    assert np.isfinite(piga.calibrate(odd, TERMS)["scale_factor"].std)
