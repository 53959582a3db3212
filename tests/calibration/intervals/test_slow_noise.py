"""The quick look at means of bins: it sees a drift, and no noise for one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import piga
from piga.calibration.fit.one_run import Fit, fit_run
from piga.calibration.intervals.slow_noise import _whitened_means, quick_looks
from piga.calibration.model.request import make_request
from piga.calibration.model.solution import KNOTS
from piga.calibration.noise.levels import Noise
from piga.calibration.noise.weighting import DriftBasis
from piga.units import G0
from tests.calibration.made.synthetic import BETA, SCALE


def fit_with(size: int, noise: Noise, stretches: int = 1) -> Fit:
    """A small fit of segments at 10 Hz, with these noise levels."""
    t = 0.1 * np.arange(size)
    f = np.zeros((size, 3))
    f[:, 0] = G0 * (1.0 + 0.1 * np.sin(t))
    segment = (np.arange(size) // (size // stretches)).astype(np.int32)
    run = piga.Run.from_arrays(
        t,
        piga.propagate(piga.Instrument(SCALE, BETA), t, f, between="linear"),
        f,
        scale_factor=SCALE,
        segment=segment,
    )
    return replace(fit_run(run, make_request(run, ["scale_factor"])), noise=noise)


def test_means_of_bins_are_whitened_as_angle_noise_and_random_walk_say() -> None:
    """Against the covariance of every single sample: white noise 4e-10 rad^2 and a walk that is as large within a bin."""
    size, bins = 800, 8
    noise = Noise(4e-8, 1e-10)
    fit, rows = fit_with(size, noise), []
    for k in range(size):  # the map is linear: its columns from unit angles
        d = np.zeros(size)
        d[k] = 1.0
        if k + 1 < size:
            d[k + 1] = -1.0
        (means,) = _whitened_means(replace(fit, d=d), [DriftBasis.of(fit.design.run)], 0, size, bins)
        rows.append(means[:, -1])
    linear = np.array(rows).T
    t = 0.1 * np.arange(size)
    covariance = noise.white * np.eye(size) + noise.walk * np.minimum.outer(t, t)
    np.testing.assert_allclose(linear @ covariance @ linear.T, np.eye(bins - 1), atol=0.02)


def test_the_quick_look_sees_a_drift_and_no_noise_for_one() -> None:
    rng = np.random.default_rng(11)
    size, noise = 4000, Noise(1e-12, 1e-12)
    fit = fit_with(size, noise, 8)

    def gain(drift: float) -> float:
        angle = np.cumsum(np.sqrt(0.1 * noise.walk) * rng.standard_normal(size))
        rate = np.cumsum(np.sqrt(0.1 * drift) * rng.standard_normal(size))
        angle += np.cumsum(0.1 * rate) + np.sqrt(noise.white) * rng.standard_normal(size)
        residual = replace(fit, d=np.diff(angle, prepend=0.0))
        return quick_looks(residual, [DriftBasis.of(fit.design.run)])[0].gain

    assert np.median([gain(0.0) for _ in range(20)]) < 0.3
    assert np.median([gain(1e-15) for _ in range(20)]) > 3.0


def test_a_quick_look_at_few_bins_sees_nothing() -> None:
    """Fewer rows than steps of the drift: whatever the residuals are, they are no evidence."""
    fit = replace(fit_with(KNOTS, Noise(1e-12, 1e-12)), d=np.linspace(0.0, 1.0, KNOTS))
    assert quick_looks(fit, [DriftBasis.of(fit.design.run)])[0].gain == 0.0
