"""Coloured noise that a record does not exclude: its limit, what it does to an interval, and when it is remarked."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import pytest
from scipy.optimize import minimize, minimize_scalar

import piga
from piga.calibration.fit.one_run import Fit, fit_run
from piga.calibration.intervals.coloured_noise import contrasts_of
from piga.calibration.intervals.slow_noise import moved_by, slow_factor
from piga.calibration.model.design import Design
from piga.calibration.model.request import make_request
from piga.calibration.noise.components import RATES, RateBins
from piga.calibration.noise.likelihood import Contrasts, ProfileLikelihood, UpperLimit
from piga.calibration.remarks import unseen_noise
from piga.calibration.remarks.slow_changes import joined_factor
from piga.calibration.remarks.unseen_noise import NOT_EXCLUDED, UNSEEN
from tests.calibration.made.coloured_truth import HEAD, LOG, Array, Coloured
from tests.calibration.made.independent import K, head

SMALL = replace(LOG, forces=head(12), seconds=20.0, pause=10.0)
BINS = RateBins(np.array([np.linspace(30.0 * k, 30.0 * k + 20.0, 5) for k in range(12)]))
FLICKER, WALK = RATES["flicker"](BINS, 0.0), RATES["walk"](BINS, 0.0)


@dataclass(frozen=True)
class Drifting(Coloured):
    """A test whose rate is a random walk with the standard deviation ``drift`` [rad/s] over the test, from its middle."""

    drift: float = 0.0

    def noise(self, rng: np.random.Generator) -> Array:
        """Mean rate of every interval (positions, intervals) [rad/s]."""
        steps, period = round(self.seconds * self.rate), round((self.seconds + self.pause) * self.rate)
        size = len(self.forces) * period
        path = np.cumsum(rng.standard_normal(size))
        path *= self.drift / math.sqrt(0.25 * size)
        means: Array = (path - path[size // 2]).reshape(-1, period)[:, :steps]
        return means


def fitted(test: Coloured, seed: int) -> Fit:
    run = test.record(seed)
    return fit_run(run, make_request(run, test.terms))


def remarks_of(calibration: piga.Calibration) -> list[str]:
    return [remark for remark in calibration.remarks if remark.startswith(NOT_EXCLUDED)]


def drawn(rng: np.random.Generator, level: float, walk: float = 0.0) -> Contrasts:
    """Slow values of unit white noise and flicker noise; the walk is part of the white noise."""
    size = BINS.count
    covariance = np.eye(size) - walk * WALK + level * FLICKER
    y = np.linalg.cholesky(covariance) @ rng.standard_normal(size)
    return Contrasts(y, np.eye(size)[None], float(rng.chisquare(2000)), 2000, np.eye(size))


def dense(contrasts: Contrasts, white: float, level: float, walk: float) -> float:
    """Minus twice the log-likelihood, by the whole covariance."""
    covariance = white * (np.eye(BINS.count) - walk * WALK) + level * FLICKER
    square = contrasts.y @ np.linalg.solve(covariance, contrasts.y) + contrasts.rest / white
    return float(np.linalg.slogdet(covariance)[1] + contrasts.fast * np.log(white) + square)


@pytest.mark.parametrize("walk", [0.0, 3.0])
def test_the_likelihood_falls_by_as_much_as_the_quantile_says(walk: float) -> None:
    """At the limit it is 2.706 above its least (95 %, one-sided), over white noise, level and what is left of the walk."""
    for seed in range(4):
        found = drawn(np.random.default_rng(seed), 0.3 * seed, 0.4 * walk)
        profile = ProfileLikelihood.of(found, walk * WALK if walk else None)
        limit = profile.limit(FLICKER, 0.95)
        shares = (0.0, 0.5 * walk, 0.9 * walk) if walk else (0.0,)

        def best(share: float, contrasts: Contrasts = found) -> float:
            free = minimize(
                lambda x: dense(contrasts, math.exp(x[0]), math.exp(x[1]), share),
                [0.0, 0.0],
                method="Nelder-Mead",
            )
            return float(min(free.fun, dense(contrasts, 1.0, 0.0, share)))

        def at_the_limit(share: float, contrasts: Contrasts = found, level: float = limit.level) -> float:
            found = minimize_scalar(lambda x: dense(contrasts, math.exp(x), level, share), bounds=(-0.5, 0.5))
            return float(found.fun)

        least = min(best(share) for share in shares)
        there = [at_the_limit(share) for share in shares]
        assert min(there) - least == pytest.approx(2.706, abs=0.12)
        assert limit.replaced == pytest.approx((0.0, 0.5, 0.9)[int(np.argmin(there))])
        assert not profile.excludes(FLICKER, 0.9 * limit.level, 0.95)
        if seed == 0 and not walk:
            assert profile.excludes(FLICKER, 1.2 * limit.level, 0.95)


def test_the_limit_is_above_the_true_level_in_95_per_cent() -> None:
    """300 draws of a level that is seen: 95 % within four binomial deviations. Of one near zero: at least as many."""
    for level, most in ((0.05, 1.0), (3.0, 0.99)):
        rng = np.random.default_rng(7)
        limits = [ProfileLikelihood.of(drawn(rng, level), None).limit(FLICKER, 0.95).level for _ in range(300)]
        assert 0.90 <= np.mean(np.array(limits) > level) <= most


def test_no_level_is_excluded_where_nothing_is_left() -> None:
    """Slow values that the component does not reach."""
    contrasts = Contrasts(np.ones(2), np.eye(2)[None], 1000.0, 1000, np.eye(2))
    assert math.isinf(
        ProfileLikelihood.of(contrasts, None).limit(np.diag([1e-30, 1.0]) * 1e-12, 1.0 - 1e-9).level
    )


@pytest.mark.parametrize(
    "test", [SMALL, replace(HEAD, forces=head(12), seconds=20.0, rate=20.0, walk=2e-5)], ids=["rates", "angles"]
)
def test_joined_rows_have_the_slow_values_of_all_rows(test: Coloured, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without joining they are the same; three rows joined to one change the effect of flicker noise by a few per cent."""
    fit = fitted(test, 1)
    bins = RateBins.of(fit.design.run, coarse=True)
    whole, parameters = (
        slow_factor(fit, fit.noise, bins),
        len(fit.solution.amplitudes) + len(fit.solution.phases),
    )
    rates = RATES["flicker"](bins, 0.0)

    def seen(factor: Array, rows: int) -> tuple[Array, float]:
        moved, contrasts = moved_by(factor, bins, parameters), contrasts_of(fit, factor, rows, bins)
        assert moved is not None
        assert contrasts is not None
        return np.diag(moved @ rates @ moved.T), ProfileLikelihood.of(contrasts, None).limit(
            contrasts.turned(rates), 0.95
        ).level

    share, level = seen(whole, fit.design.rows)
    fit.design.forget()
    monkeypatch.setattr(Design, "join", 1)
    same_share, same_level = seen(*joined_factor(fit, bins))
    assert same_share == pytest.approx(share, rel=1e-6)
    assert same_level == pytest.approx(level, rel=1e-6)
    fit.design.forget()
    monkeypatch.setattr(Design, "join", 3)
    factor, rows = joined_factor(fit, bins)
    assert rows < 0.36 * fit.design.rows
    near_share, near_level = seen(factor, rows)
    assert near_share == pytest.approx(share, rel=0.08)
    assert near_level == pytest.approx(level, rel=0.1)


def test_a_sound_short_record_has_the_remark_and_a_loud_one_the_doubt() -> None:
    quiet = piga.calibrate(SMALL.record(2), SMALL.terms)
    (remark,) = remarks_of(quiet)
    assert not quiet.verdict.warns_of_noise
    assert all(remark not in doubt.what for doubt in quiet.verdict.doubts)
    assert "in a shuffled order of the same positions" in remark
    loud = piga.calibrate(replace(SMALL, flicker=6e-5).record(2), SMALL.terms)
    assert loud.verdict.warns_of_noise
    assert remarks_of(loud) == []


def test_the_remark_changes_no_number(monkeypatch: pytest.MonkeyPatch) -> None:
    run = SMALL.record(2)
    with_it = piga.calibrate(run, SMALL.terms)
    monkeypatch.setattr(unseen_noise, "UNSEEN", replace(UNSEEN, growth=math.inf))
    without = piga.calibrate(run, SMALL.terms)
    assert remarks_of(with_it) != remarks_of(without) == []
    assert with_it.coefficients == without.coefficients
    assert np.array_equal(with_it.covariance, without.covariance)


@pytest.mark.only_compiled
def test_a_drift_of_that_size_makes_the_errors_as_large_as_said() -> None:
    """The largest drift is put into 60 records: the errors of the coefficient scatter as the remark says (three deviations)."""
    (remark,) = remarks_of(piga.calibrate(SMALL.record(2), SMALL.terms))
    size, name, growth = re.findall(
        r"drift \(random walk\) up to (\S+) ug over.* uncertainty of (\w+) (\S+) times", remark
    )[0]
    drifting = Drifting(**(vars(SMALL) | {"drift": float(size) * 1e-6 * K}))
    quiet = piga.calibrate(SMALL.record(2), SMALL.terms)[name]
    errors = []
    for seed in range(60):
        fit = fitted(drifting, seed)
        errors.append(
            piga.calibration.model.solution.name_coefficients(fit.design, fit.solution, fit.covariance)[0]
        )
    values = [next(c.value for c in found if c.name == name) - drifting.true(name) for found in errors]
    spread = math.sqrt(float(np.mean(np.square(values)))) / (quiet.expanded / 1.96)
    assert spread == pytest.approx(float(growth), rel=3.0 / math.sqrt(120.0))


@pytest.mark.only_compiled
def test_the_length_that_is_said_is_the_one_that_excludes() -> None:
    """Positions half as long again as six sound records say: half of such records have no remark, or more."""
    said = [remarks_of(piga.calibrate(SMALL.record(seed), SMALL.terms))[0] for seed in range(6)]
    needed = np.median([float(re.search(r"about (\S+) s instead of 20 s", remark)[1]) for remark in said])
    long = replace(SMALL, seconds=float(round(1.5 * needed)), pause=float(round(0.75 * needed)), rate=1.0)
    had = [bool(remarks_of(piga.calibrate(long.record(seed), long.terms))) for seed in range(6)]
    assert sum(had) <= 3


@pytest.mark.only_compiled
def test_the_quick_exclusion_only_saves_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without it the same records have the same remark: an angle log, whose limits are far below 3 ug, and rate logs."""
    angles = replace(HEAD, forces=head(12), seconds=20.0, rate=10.0, walk=1e-6)
    runs = [(angles.record(1), angles.terms), (SMALL.record(1), SMALL.terms), (SMALL.record(3), SMALL.terms)]
    before = [remarks_of(piga.calibrate(*one)) for one in runs]
    monkeypatch.setattr(ProfileLikelihood, "excludes", lambda *_: False)
    assert [remarks_of(piga.calibrate(*one)) for one in runs] == before
    assert [len(remarks) for remarks in before] == [0, 1, 1]


@pytest.mark.only_compiled
def test_where_it_is_not_needed() -> None:
    """Not where other uncertainties are larger, the levels are given, or the noise would be far too small to matter."""
    run = SMALL.record(2)
    known = msgspec.structs.replace(run.estimation, angle_rms="1e-9 rad", angle_random_walk="2e-5 rad/sqrt(s)")
    assert remarks_of(piga.calibrate(replace(run, estimation=known), SMALL.terms)) == []
    angles = replace(HEAD, forces=head(12), seconds=60.0, walk=1e-6)
    assert remarks_of(piga.calibrate(angles.record(1), angles.terms)) == []
    assert remarks_of(piga.calibrate(run, SMALL.terms, "rate" if run.kind == "angle" else "recursive")) == []
    fit = fitted(SMALL, 2)
    coefficients = piga.calibrate(run, SMALL.terms).coefficients
    alone = unseen_noise.unseen_noise(unseen_noise.slow_rates(fit, fit), coefficients)
    assert alone is not None
    twice = unseen_noise.unseen_noise(
        unseen_noise.slow_rates(fit, fit), tuple(replace(c, std=2.0 * c.std) for c in coefficients)
    )
    assert twice is not None
    assert twice.growth == pytest.approx(math.sqrt(3.0 + alone.growth**2) / 2.0, rel=1e-3), (
        "as much again of Type B"
    )
    vague = tuple(replace(c, std=20.0 * c.std) for c in coefficients)
    assert unseen_noise.unseen_noise(unseen_noise.slow_rates(fit, fit), vague) is None


@pytest.mark.only_compiled
def test_a_drift_in_the_uncertainties_needs_no_remark() -> None:
    angles = replace(HEAD, forces=head(12), seconds=60.0)
    drifting = Drifting(**(vars(angles) | {"drift": 2e-5}))
    calibration = piga.calibrate(drifting.record(1), angles.terms)
    assert calibration.bias_drift > 0.0
    assert remarks_of(calibration) == []


@pytest.mark.only_compiled
def test_what_the_noise_takes_the_place_of_is_subtracted(monkeypatch: pytest.MonkeyPatch) -> None:
    """An angle log whose noise is all walk: 90 % of the walk is 90 % of the squared standard uncertainty."""
    angles = replace(HEAD, forces=head(12), seconds=20.0, white=1e-7, walk=2e-5)
    fit, coefficients = fitted(angles, 1), piga.calibrate(angles.record(1), angles.terms).coefficients
    grown = []
    for share in (0.0, 0.9):
        limit = UpperLimit(1e-10, share)
        monkeypatch.setattr(ProfileLikelihood, "limit", lambda *_, limit=limit: limit)
        monkeypatch.setattr(ProfileLikelihood, "excludes", lambda *_: False)
        found = unseen_noise.unseen_noise(unseen_noise.slow_rates(fit, fit), coefficients)
        assert found is not None
        grown.append(found.growth)
    assert grown[0] ** 2 - grown[1] ** 2 == pytest.approx(0.9, rel=0.1)


def test_words_of_every_kind() -> None:
    one = unseen_noise.UnseenNoise("flicker", 0.0, 4.2e-6, "k0", 2.13, 1.2, 60.0, 1.96, 24)
    assert "1/f noise up to 4.2 ug in a decade of frequency (95 %)" in one.words
    assert "expanded uncertainty of k0 2.1 times as large" in one.words
    assert "positions of about 120 s instead of 60 s" in one.words
    assert "shuffled order of the same positions it would be 1.2 times" in one.words
    assert "shuffled" not in replace(one, shuffled=1.9).words
    alone = replace(one, positions=1, longer=math.nan).words
    assert alone.endswith("record more revolutions")
    assert "a record of about 120 s" in replace(one, positions=1).words
    markov = replace(one, kind="markov", time=15.0, longer=math.nan).words
    assert "first-order Markov noise of about 15 s up to 4.2 ug" in markov
    assert "record longer at each position" in markov
    assert "any size" in replace(one, size=math.inf, longer=math.inf).words
    assert UNSEEN.size == pytest.approx(3e-6, rel=1e-9)
