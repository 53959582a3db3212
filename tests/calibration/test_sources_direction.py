"""The direction of a logged reference errs anew at each attitude: its uncertainty is the scatter of such calibrations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import piga
from piga.frames import rotation_vector_to_matrix
from piga.records.run_file import UncertaintyTable
from piga.results import Array
from piga.units import ARCSEC
from tests.calibration.direct import G
from tests.chance import RARE, assert_variance

pytestmark = pytest.mark.filterwarnings("ignore::piga.errors.CalibrationWarning")
KEY, TURN, DRAWS = "direction_repeatability", 60.0, 40
ATTITUDES, SAMPLES = 24, 10
TRUE = {"scale_factor": 0.6, "k0": 0.02, "m_Y": 0.05, "m_Z": -0.04, "k_YY": 0.01}
SEGMENT = np.repeat(np.arange(ATTITUDES), SAMPLES)


def record(rng: np.random.Generator, turn: float = TURN, **stated: str) -> piga.Run:
    """A direct instrument in many attitudes, whose logged reference is turned by a random ``turn`` [arcsec] in each."""
    v = np.random.default_rng(40).standard_normal((ATTITUDES, 3))
    f = v / np.linalg.norm(v, axis=1)[:, None]
    logged = np.einsum(
        "nij,nj->ni", rotation_vector_to_matrix(turn * ARCSEC * rng.standard_normal((ATTITUDES, 3))), f
    )
    x, y, z = f.T
    output = 0.6 * (x + TRUE["k0"] + TRUE["m_Y"] * y + TRUE["m_Z"] * z + TRUE["k_YY"] * y**2)
    noise = 1e-5 * rng.standard_normal(SEGMENT.size)
    run = piga.Run.from_arrays(
        0.1 * np.arange(SEGMENT.size) + 5.0 * SEGMENT, output[SEGMENT] + noise, G * logged[SEGMENT],
        scale_factor="0.6 mA/g", kind="rate", unit="mA", segment=SEGMENT, model={"terms": list(TRUE)}, units="SI",
    )  # fmt: skip
    waived = dict.fromkeys(("reference_scale", "reference_bias", "timing", "vibration"), "none")
    return replace(run, uncertainty=UncertaintyTable(waived=waived, **stated))


def test_uncertainty_is_the_scatter_of_turned_references() -> None:
    """Variances by chi-square, intervals by the binomial distribution. The weights took the scatter for noise before."""
    rng = np.random.default_rng(42)
    still = piga.calibrate(record(rng, turn=0.0, **{KEY: f"{TURN} arcsec"}))
    rows = [list(row.contributions.values()) for row in still.budget if row.source.startswith(KEY)]
    assert len(rows) == 3
    draws = [piga.calibrate(record(rng, **{KEY: f"{TURN} arcsec"})) for _ in range(DRAWS)]
    allowed = stats.binom.ppf([0.5 * RARE, 1.0 - 0.5 * RARE], DRAWS, 0.95)
    for k, (name, true) in enumerate(TRUE.items()):
        values = np.array([each[name].value for each in draws])
        assert_variance(np.var(values, ddof=1) / np.linalg.norm(np.array(rows)[:, k]) ** 2, DRAWS - 1, name)
        held = sum(low <= true <= high for low, high in (each[name].limits for each in draws))
        assert allowed[0] <= held <= allowed[1], name


def test_what_is_stated_is_not_taken_for_noise() -> None:
    """Of a rate log, too: the noise is that within the attitudes, and nothing is found beside what is stated."""
    told = piga.calibrate(record(np.random.default_rng(1), **{KEY: f"{TURN} arcsec"}))
    assert told.segment_scatter == 0.0
    silent: Array = np.array([c.std for c in piga.calibrate(record(np.random.default_rng(1))).coefficients])
    assert (np.array([c.std for c in told.coefficients]) < 1.5 * silent).all()
