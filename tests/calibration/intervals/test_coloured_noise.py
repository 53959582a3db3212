"""Coloured noise: its covariance on the slow rates, the restricted likelihood, and intervals that hold it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numba
import numpy as np
import pytest

import piga
from piga.calibration import RunSummary
from piga.calibration.fit.one_run import fit_run, without_slow
from piga.calibration.intervals import coloured_noise
from piga.calibration.intervals.coloured_noise import include_coloured_noise
from piga.calibration.model.request import make_request
from piga.calibration.noise.components import COMPONENTS, RATES, RULES, RateBins, table
from piga.calibration.noise.likelihood import Contrasts, estimate
from piga.calibration.noise.settings import NOISE
from tests.calibration.made.scenarios import Array, Scenario, tumble
from tests.short_record import TERMS as SHORT_TERMS
from tests.short_record import a_run

pytestmark = pytest.mark.compiled

TERMS = ("scale_factor", "tan_beta", "k0", "k2", "m_Y")
HEAD = Scenario(
    "head",
    tumble(24),
    seconds=60.0,
    rate=2.0,
    pause=30.0,
    white=2.5e-5,
    walk=1e-6,
    truth={"k0": 3e-4},
    terms=TERMS,
)
FLICKER = replace(HEAD, flicker=5e-6)
RATES_LOG = replace(HEAD, kind="rate", white=0.0, walk=1e-5, flicker=5e-6)


def fine_covariance(bins: RateBins, kernel: Array, fine: int) -> Array:
    """Means over parts of a covariance at ``fine`` times in each part."""
    size = bins.count
    means: Array = kernel.reshape(size, fine, size, fine).mean(axis=(1, 3))
    return means


def times_in(bins: RateBins, fine: int) -> Array:
    low, width = bins.edges[:, :-1].reshape(-1, 1), bins.widths[:, None]
    return np.asarray(low + width * (np.arange(fine) + 0.5) / fine).ravel()


@pytest.mark.parametrize("time", [0.4, 5.0, 300.0])
def test_markov_covariance_is_the_mean_of_the_exponential(time: float) -> None:
    bins = RateBins(np.array([np.linspace(0.0, 20.0, 5), np.linspace(50.0, 62.0, 5)]))
    t = times_in(bins, 400)
    dense = fine_covariance(bins, np.exp(-np.abs(np.subtract.outer(t, t)) / time), 400)
    assert RATES["markov"](bins, time) == pytest.approx(dense, rel=2e-3, abs=1e-9)


def test_flicker_has_its_variance_in_each_decade_of_time() -> None:
    """A decade more of parts adds the level once: the variance of a mean grows by ln(10) of the spectrum."""
    wide, narrow = (RateBins(np.array([np.linspace(0.0, 1e4, count + 1)])) for count in (10, 100))
    grown = RATES["flicker"](narrow, 0.0)[0, 0] - RATES["flicker"](wide, 0.0)[0, 0]
    assert grown == pytest.approx(1.0, abs=0.05)


def test_levels_are_right_on_average_and_as_uncertain_as_said() -> None:
    """Sixty draws of white noise, walk and flicker: means within four deviations, spread as the information says."""
    bins = RateBins(np.array([np.linspace(90.0 * k, 90.0 * k + 60.0, 5) for k in range(24)]))
    rng, truth = np.random.default_rng(3), np.array([1.0, 30.0, 4.0])
    units = np.array([np.eye(bins.count), RATES["walk"](bins, 0.0), RATES["flicker"](bins, 0.0)])
    factor = np.linalg.cholesky(np.tensordot(truth, units, 1))
    result, said = [], []
    for _ in range(60):
        y, rest = factor @ rng.standard_normal(bins.count), float(rng.chisquare(2000))
        levels = estimate(Contrasts(y, units, rest, 2000, np.eye(bins.count)), np.array([1.0, 0.0, 0.0]))
        assert levels is not None
        result.append(levels.values)
        said.append(np.sqrt(np.diag(levels.covariance)))
    spread = np.std(result, axis=0, ddof=1)
    assert np.abs(np.mean(result, axis=0) - truth).max() < (4.0 * spread / np.sqrt(60)).max()
    assert spread == pytest.approx(np.mean(said, axis=0), rel=0.4)


@pytest.mark.parametrize(
    ("segments", "seconds", "size"),
    [
        (24, 60.0, 4),
        (24, 180.0, 8),
        (40, 60.0, 4),
        (40, 20.0, 2),
        (16, 20.0, 6),
        (2, 900.0, 32),
        (100, 900.0, 2),
    ],
)
def test_long_segments_have_more_parts(segments: int, seconds: float, size: int) -> None:
    """Parts of 15 s if 192 are enough for that, and 96 in any case; 2 to 32 in a segment."""
    held = replace(HEAD, forces=tumble(segments), seconds=seconds, rate=0.5)
    assert RateBins.of(held.record(np.random.default_rng(1))).size == size


def test_a_level_may_be_negative() -> None:
    """Rates that scatter less than the white noise says; no level below what is still a covariance."""
    bins = RateBins(np.array([np.linspace(90.0 * k, 90.0 * k + 60.0, 5) for k in range(24)]))
    units = np.array([np.eye(bins.count), RATES["flicker"](bins, 0.0)])
    y = np.full(bins.count, 0.3) * (-1.0) ** np.arange(bins.count)
    levels = estimate(Contrasts(y, units, 2000.0, 2000, np.eye(bins.count)), np.array([1.0, 0.0]))
    assert levels is not None
    assert levels.values[1] < 0.0
    assert np.linalg.eigvalsh(np.tensordot(levels.values, units, 1)).min() > 0.0


def test_no_levels_where_the_start_is_no_covariance() -> None:
    contrasts = Contrasts(np.ones(3), np.eye(3)[None], 1.0, 5, np.eye(3))
    assert estimate(contrasts, np.array([-1.0])) is None


def fitted(scenario: Scenario, seed: int):
    run = scenario.record(np.random.default_rng([seed, 24]))
    return fit_run(run, make_request(run, scenario.terms))


def test_covariance_of_one_component_is_the_dense_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rates of a rate log are independent rows: ``A^-1 X' V X A^-1`` with the dense V of the parts."""
    monkeypatch.setattr(coloured_noise, "_suspected", lambda *_: True)
    kept = coloured_noise._candidates
    monkeypatch.setattr(coloured_noise, "_candidates", lambda *a: [c for c in kept(*a) if c.name == "flicker"])
    fit = fitted(RATES_LOG, 1)
    result = include_coloured_noise(fit)
    assert result.colour is not None
    assert result.colour.name == "flicker"
    bins = RateBins.of(fit.design.run)
    blocks = list(fit.design.blocks())
    x = np.hstack([block.columns[:-1] for block in blocks])
    parts = np.zeros((bins.count, x.shape[1]))
    for block in blocks:
        rows = slice(block.start, block.stop)
        own = slice(block.segment * bins.size, (block.segment + 1) * bins.size)
        parts[own, rows] = bins.increments(np.asarray(fit.design.run.t[rows]), block.h)
    assert parts.sum() == x.shape[1]
    jacobian = fit.solution.jacobians[0]
    bread = np.linalg.inv(jacobian.T @ x @ x.T @ jacobian)
    rates = result.colour.variance * RATES["flicker"](bins, 0.0)
    meat = jacobian.T @ x @ parts.T @ rates @ parts @ x.T @ jacobian
    coloured = bread @ meat @ bread
    white = np.diag(result.covariance - coloured) / np.diag(bread)
    assert white == pytest.approx(white[0], rel=1e-6)
    assert 0.7 < white[0] / fit.sample_variance < 1.0, "flicker is not white noise as well"


@pytest.mark.only_compiled
@pytest.mark.parametrize("scenario", [FLICKER, RATES_LOG], ids=["angles", "rates"])
def test_intervals_hold_flicker(scenario: Scenario) -> None:
    """Ten records: at least five times wider than by white noise and walk alone, and the truth inside nearly always."""
    seeds = 3 if numba.config.DISABLE_JIT else 10
    inside, wider, said = [], [], 0
    for seed in range(seeds):
        run = scenario.record(np.random.default_rng([seed, 24]))
        result = piga.calibrate(run, scenario.terms)
        inside += list(np.abs(scenario.errors(result)) <= [c.expanded for c in result.coefficients])
        if result.coloured_noise is not None:
            said += any("coloured noise" in doubt.what for doubt in result.verdict.doubts)
            plain = without_slow(include_coloured_noise(fitted(scenario, seed)))
            wider.append(
                result["k0"].std / np.sqrt(np.diag(plain.covariance))[2] * plain.solution.amplitudes[1]
            )
    assert np.mean(inside) > 0.85
    assert said == len(wider) >= 0.6 * seeds


@pytest.mark.only_compiled
def test_white_noise_and_walk_have_no_colour() -> None:
    plain = replace(HEAD, walk=2e-5)
    seeds = 4 if numba.config.DISABLE_JIT else 20
    seen = sum(include_coloured_noise(fitted(plain, seed)).colour is not None for seed in range(seeds))
    assert seen <= 0.25 * seeds


def test_not_with_given_levels_and_in_records_too_short() -> None:
    run = RATES_LOG.record(np.random.default_rng([1, 24]))
    given = replace(
        run,
        estimation=msgspec.structs.replace(
            run.estimation, angle_rms="1e-5 rad", angle_random_walk="1e-5 rad/sqrt(s)"
        ),
    )
    fit = fit_run(given, make_request(given, TERMS))
    assert include_coloured_noise(fit) is fit
    short = fitted(replace(RATES_LOG, rate=0.2), 1)
    assert include_coloured_noise(short) is short


@pytest.mark.only_compiled
def test_long_records_are_looked_at_by_means_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """The quick test sees what the whole sees, and passes over white noise and walk."""
    monkeypatch.setattr(coloured_noise, "NOISE", replace(NOISE, restricted_rows=100))
    assert include_coloured_noise(fitted(FLICKER, 1)).colour is not None
    plain = replace(HEAD, walk=2e-5)
    assert include_coloured_noise(fitted(plain, 1)).colour is None


@pytest.mark.only_compiled
def test_a_joint_run_and_a_stored_one_carry_it(tmp_path) -> None:
    """Two runs together are more certain than one, and as certain from a file."""
    runs = [FLICKER.record(np.random.default_rng([seed, 24])) for seed in (0, 2)]
    alone = piga.calibrate(runs[0], TERMS)
    assert alone.coloured_noise is not None
    RunSummary.of(runs[1], TERMS, name="b").to_json(tmp_path / "b.json")
    together = piga.calibrate(runs, TERMS)
    stored = piga.calibrate([runs[0], RunSummary.from_json(tmp_path / "b.json")], TERMS)
    assert stored["k2"].std == pytest.approx(together["k2"].std, rel=1e-6)
    assert 0.2 < together["k2"].std / alone["k2"].std < 1.0


@pytest.mark.only_compiled
def test_one_run_by_its_summary_has_the_degrees_of_freedom_of_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the likeliest component alone. Its walk and its level are uncertain together: the one is high where the other is low."""
    kept = coloured_noise._candidates
    monkeypatch.setattr(
        coloured_noise, "_candidates", lambda *a: [max(kept(*a), key=lambda candidate: candidate.gain)]
    )
    run = FLICKER.record(np.random.default_rng([0, 24]))
    alone, summary = piga.calibrate(run, TERMS), RunSummary.of(run, TERMS)
    merged = piga.calibrate([summary], TERMS)
    apart = replace(summary, added=tuple(replace(noise, shared=0.0) for noise in summary.added))
    free = piga.calibrate([apart], TERMS)
    for key in ("scale_factor", "k0", "k2", "m_Y"):
        assert merged[key].degrees_of_freedom == pytest.approx(alone[key].degrees_of_freedom, rel=0.01)
    assert merged["tan_beta"].degrees_of_freedom > 2.0 * free["tan_beta"].degrees_of_freedom


@pytest.mark.only_compiled
def test_the_record_keeps_it(tmp_path) -> None:
    result = piga.calibrate(FLICKER.record(np.random.default_rng([0, 24])), TERMS)
    result.to_json(tmp_path / "c.json")
    again = piga.Calibration.from_json(tmp_path / "c.json")
    assert again.coloured_noise == result.coloured_noise
    assert again.verdict == result.verdict


def test_the_page_shows_the_rules_of_the_code() -> None:
    page = (Path(__file__).parents[3] / "docs" / "theory" / "noise.md").read_text(encoding="utf-8")
    shown = page.split("<!-- rules: noise -->\n")[1].split("<!-- end -->")[0]
    assert shown == table(), "run python -m piga.calibration.noise.components"
    assert [rule.component for rule in RULES] == list(COMPONENTS)


def test_the_covariance_is_positive() -> None:
    """A record whose level of the walk comes out negative; a correlation was 1.19."""
    cal = piga.calibrate(a_run(), SHORT_TERMS)
    assert cal.coloured_noise is not None
    size = np.sqrt(np.diag(cal.covariance))
    assert np.linalg.eigvalsh(cal.covariance / np.outer(size, size)).min() > 0.0
