"""Allan deviation: against published tables, against the noise put in, over stretches that are not joined."""

from __future__ import annotations

import numpy as np
import pytest

from piga.errors import ArgumentError
from piga.noise.deviations import allan_deviation, equivalent_degrees

allantools = pytest.importorskip("allantools")

STEP = 0.05
NOISE = {0: 1.0}


def angle(rng: np.random.Generator, samples: int, white: float, walk: float):
    path = np.cumsum(np.sqrt(walk * STEP) * rng.standard_normal(samples))
    return path + np.sqrt(white) * rng.standard_normal(samples)


def one_stretch(samples: int):
    begins = np.zeros(samples, dtype=bool)
    begins[0] = True
    return np.arange(samples) * STEP, begins


ORDER = {"allan": 2, "modified": 2, "hadamard": 3}


@pytest.mark.parametrize("kind", ORDER)
@pytest.mark.parametrize("m", [1, 3, 10, 24])
@pytest.mark.parametrize("exponent", [2, 1, 0, -1, -2, -3, -4])
def test_degrees_of_freedom_as_allantools(m: int, exponent: int, kind: str):
    """Within what the approximations of [Greenhall2003] for long averaging times allow."""
    if exponent < -2 and kind != "hadamard":
        return
    reference = allantools.edf_greenhall(exponent, ORDER[kind], m, 1001, True, kind == "modified", False)
    assert equivalent_degrees(1001, m, ((exponent, 1.0),), kind) == pytest.approx(reference, rel=0.012)


def test_bands_hold_the_model():
    """In 68 % of many records the band holds the deviation of the noise put in, at short and at long times."""
    rng, white, walk = np.random.default_rng(3), 4e-10, 1e-10
    inside = []
    for _ in range(150):
        x = np.concatenate([angle(rng, 400, white, walk) for _ in range(6)])
        t, begins = one_stretch(x.size)
        begins[::400] = True
        deviation = allan_deviation(x, t, begins, noise={2: 3.0 * white, 0: walk})
        true = np.sqrt(3.0 * white / deviation.tau**2 + walk / deviation.tau)
        inside.append((deviation.lower < true) & (true < deviation.upper))
    share = np.mean(inside, axis=0)
    assert share.min() > 0.55
    assert share.max() < 0.82


def test_stretches_are_not_joined():
    """A step between stretches leaves no trace, and each counts by its differences."""
    rng = np.random.default_rng(4)
    parts = [angle(rng, samples, 1e-10, 1e-11) for samples in (500, 1500)]
    x = np.concatenate([parts[0], parts[1] + 1.0])
    t, begins = one_stretch(x.size)
    begins[500] = True
    t[500:] += 100.0
    deviation = allan_deviation(x, t, begins, noise=NOISE)
    alone = [allan_deviation(p, *one_stretch(p.size), noise=NOISE) for p in parts]
    pooled = np.sqrt((498 * alone[0].deviation[0] ** 2 + 1498 * alone[1].deviation[0] ** 2) / 1996)
    assert deviation.deviation[0] == pytest.approx(pooled, rel=1e-12)
    assert deviation.deviation.max() < 1e-3


def test_uneven_sampling_is_read_on_an_even_grid():
    t = np.sort(np.random.default_rng(5).uniform(0.0, 200.0, 4000))
    begins = np.zeros(t.size, dtype=bool)
    deviation = allan_deviation(0.3 * t + 1e-4 * t**2, t, begins, noise=NOISE)
    assert deviation.deviation[-1] == pytest.approx(np.sqrt(2.0) * 1e-4 * deviation.tau[-1], rel=1e-2)


def nist_rates():
    """The 1000 rates of the test suite, by its generator of random numbers ([Riley2008] section 12.4)."""
    numbers = [1234567890]
    for _ in range(999):
        numbers.append(16807 * numbers[-1] % 2147483647)
    return np.array(numbers) / 2147483647.0


@pytest.mark.parametrize(
    ("kind", "published"),
    [
        ("allan", (2.922319e-01, 9.159953e-02, 3.241343e-02)),
        ("modified", (2.922319e-01, 6.172376e-02, 2.170921e-02)),
        ("hadamard", (2.943883e-01, 9.581083e-02, 3.237638e-02)),
    ],
)
def test_suite_of_nist(kind: str, published: tuple[float, ...]):
    """The table of 1000 points, to its last digit."""
    rates = nist_rates()
    x = np.concatenate(([0.0], np.cumsum(rates)))
    begins = np.zeros(x.size, dtype=bool)
    begins[0] = True
    deviation = allan_deviation(
        x, np.arange(x.size, dtype=float), begins, noise=NOISE, kind=kind, factors=[1, 10, 100]
    )
    assert deviation.deviation == pytest.approx(published, rel=2e-7)


def test_too_short_and_unequal():
    t, begins = one_stretch(3)
    assert allan_deviation(np.zeros(3), t, begins, noise=NOISE).tau.size == 0
    with pytest.raises(ArgumentError, match="3, 3 and 2"):
        allan_deviation(np.zeros(3), t, begins[:2], noise=NOISE)
