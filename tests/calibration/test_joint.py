"""Several runs calibrated together: what one cannot separate, two do; summaries merge without raw data."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

import piga
from piga.calibration.summary import RunSummary
from tests.calibration.made.scenarios import SCENARIOS
from tests.calibration.made.scenarios_joint import TERMS, joint_test, scores
from tests.chance import assert_variance

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def runs() -> list[piga.Run]:
    return joint_test(np.random.default_rng(3))[0]


@pytest.fixture(scope="module")
def together(runs: list[piga.Run]) -> piga.Calibration:
    return piga.calibrate(runs, TERMS, per_run=[])


def test_two_runs_separate_what_one_cannot(runs: list[piga.Run], together: piga.Calibration) -> None:
    with pytest.raises(piga.IdentifiabilityError, match="cannot separate k0, k2, k_YY") as caught:
        piga.calibrate(runs[0], TERMS)
    assert (
        str(caught.value).count("a centrifuge or a vibration table")
        == str(caught.value).count("centrifuge")
        == 1
    )
    with pytest.raises(piga.IdentifiabilityError, match=r"cannot separate k0, (m_Y, k_YY|k_YY, m_Y)") as caught:
        piga.calibrate(runs[1], TERMS)
    assert "dividing head" in str(caught.value)
    assert together.condition < 10.0
    assert any("run 1" in remark and "alone" in remark for remark in together.remarks)


def test_truth_within_uncertainty_over_repeats() -> None:
    """Squared errors of 6 joint tests average to one; a right program is outside the band once in 1000 draws of seeds."""
    squares = []
    for seed in range(6):
        runs, truth = joint_test(np.random.default_rng([seed, 5]), seconds=10.0)
        calibration = piga.calibrate(runs, TERMS, per_run=[])
        z = scores(calibration, truth)
        error = np.array([z[c.key] * c.std for c in calibration.coefficients])
        squares.append(error @ np.linalg.solve(calibration.covariance, error))
    assert_variance(np.mean(squares) / 8.0, 6 * 8, "squared error over variance")


def test_joint_of_split_record_is_the_record() -> None:
    """Two halves of one record with given noise and a phase per segment give what the whole gives."""
    runs, _ = joint_test(np.random.default_rng(4))
    given = msgspec.structs.replace(
        runs[0].estimation, angle_rms="2.5e-5 rad", angle_random_walk="1e-5 rad/sqrt(s)"
    )
    whole = replace(runs[0], estimation=given)
    part = whole.segment_index < 6
    halves = [_rows(whole, part), _rows(whole, ~part)]
    terms = ["scale_factor", "tan_beta", "k0", "m_Y"]
    split = piga.calibrate(halves, terms, phases="per-segment", per_run=[])
    once = piga.calibrate(whole, terms, phases="per-segment")
    for name in terms:
        assert split[name].value == pytest.approx(once[name].value, abs=1e-5 * once[name].std)
        assert split[name].std == pytest.approx(once[name].std, rel=0.3), "a slow change does not cross runs"


def _rows(run: piga.Run, mask: np.ndarray) -> piga.Run:
    made = piga.Run.from_arrays(
        run.t[mask],
        run.output[mask],
        run.f[mask],
        uncertainty={"waived": {"earth_rate": "simulated at rest", "servo": "simulated without"}},
        scale_factor=run.scale_factor,
        segment=run.segment_index[mask],
        serial=run.serial,
        units="SI",
    )
    return replace(made, estimation=run.estimation)


@pytest.mark.parametrize("name", ["static", "coarse-slow"])
def test_by_its_summary_as_the_run_alone(tmp_path: Path, name: str) -> None:
    """One run by its summary is that run."""
    scenario = SCENARIOS[name]
    run = scenario.record(np.random.default_rng(5))
    RunSummary.of(run, scenario.terms).to_json(tmp_path / "s.json")
    alone, merged = (
        scenario.calibrate(run),
        piga.calibrate([RunSummary.from_json(tmp_path / "s.json")], scenario.terms),
    )
    for a, b in zip(alone.coefficients, merged.coefficients, strict=True):
        assert (b.value - a.value) / a.std == pytest.approx(0.0, abs=1e-3)
        assert b.std == pytest.approx(a.std, rel=1e-3)
        assert b.degrees_of_freedom == pytest.approx(a.degrees_of_freedom, rel=1e-3)
