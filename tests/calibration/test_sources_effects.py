"""Effects of sources that nobody stated against those of a fit of the moved record."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import piga
from piga.calibration import RunSummary
from piga.calibration.fit import Fit
from piga.calibration.joint import JointFit, fit_alone, sources_of_stand, with_all_sources
from piga.calibration.model.design import given_servo
from piga.calibration.model.request import make_request
from piga.calibration.sources import units_of
from piga.calibration.summary import MergedRuns
from piga.calibration.weights import reduce_positions
from piga.progress import SILENT
from piga.records.calibration.coefficient import changes
from piga.records.run import Run
from piga.records.run_file import GivenParameter
from tests.calibration.made.servo_data import head, levels, recorded
from tests.calibration.made.synthetic import at_rest, record


def fit_of(run: Run, terms: str, phases: str) -> JointFit:
    request = make_request(run, [name.strip() for name in terms.split(",")], None, phases, None, None)
    return with_all_sources(fit_alone(run, request, SILENT), SILENT)


def check_effects(run: Run, terms: str, phases: str) -> Fit:
    """Each effect is that of the moved record to 2e-5 of it and 5e-4 of the standard uncertainty of the coefficient.

    A moved column meets the residuals too: a change of this size, which one pass does not contain. The phase of a segment
    is not linear in the increments: 1 %.
    """
    whole = fit_of(run, terms, phases)
    assert whole.only is not None
    fit, named = whole.only, whole.named(whole.estimate, whole.estimate.covariance)[0]

    def estimate(moved: Run) -> np.ndarray:
        design = fit.design.of(moved)
        triangles = RunSummary.of_rows(design, fit.noise, reduce_positions(design, fit.noise))
        runs = MergedRuns.of([triangles], fit.runs.terms)
        found = runs.solved()[1]
        return np.array([c.value for c in runs.named(found, found.covariance)[0]])

    expected = {}
    for plus in units_of(fit.design.run):
        minus = replace(plus, change=partial(np.negative, plus.change()))
        expected[plus.summary.name] = 0.5 * changes(named, estimate(minus.moved), estimate(plus.moved))
    effects = {name: change for source in sources_of_stand(whole) for name, change in source.effects.items()}
    assert effects.keys() == expected.keys() - {"servo"}
    for name, moved in effects.items():
        for c, change in zip(named, expected[name], strict=True):
            difference = moved.get(c.key, 0.0) - change
            share = 2e-5 if c.segment is None else 1e-2
            assert abs(difference) < share * abs(change) + 5e-4 * c.std, (name, c.key, difference / c.std)
    return fit


@pytest.mark.parametrize(
    ("terms", "phases"),
    [
        ("scale_factor, tan_beta, k0, k2, m_Y", "shared"),
        ("scale_factor, tan_beta, k0, s1, c1, k_XY, k0_t", "per-segment"),
        ("k0, k1, k2o", "shared"),
    ],
)
def test_one_pass_agrees_with_the_moved_record(terms: str, phases: str) -> None:
    run = record(np.random.default_rng(3), white=1e-6, seconds=10.0, rate=5.0)
    check_effects(run, terms, phases)


def test_one_pass_contains_the_servo_and_the_scatter_of_the_positions() -> None:
    run = record(np.random.default_rng(4), white=1e-6, seconds=4.0, rate=2.0)
    output = run.output + 1e-4 * np.random.default_rng(5).standard_normal(24)[run.segment_index] * run.t
    fit = check_effects(
        replace(run, output=output), "scale_factor, tan_beta, k0, servo, servo_damping", "shared"
    )
    assert fit.noise.scatter > 0.0


@pytest.mark.parametrize("own", ["scale_factor, k0", "scale_factor, tan_beta, k0, servo, servo_damping"])
def test_a_given_servo_moves_stored_summaries_as_the_runs(own: str) -> None:
    """The fit of a summary may lack the phase, or estimate the servo: its sources act as in the joint fit all the same."""
    given = (
        GivenParameter("integral_gain", 3000.0, 60.0, "N m/(rad s)"),
        GivenParameter("damping", 0.1, 0.03, "N m s/rad"),
        GivenParameter("angular_momentum", 0.1, 0.0, "kg m^2/s"),
    )
    true = given_servo(replace(recorded(head(), seconds=1.0), servo=given))
    runs = [
        replace(recorded(forces, noise=1e-5, s=true["servo"], d=true["servo_damping"]), servo=given)
        for forces in (head(), levels((-8, -4, 4, 8)))
    ]
    terms = "scale_factor, tan_beta, k0"
    stored = [RunSummary.of(run, own, name=f"run {k}") for k, run in enumerate(runs, start=1)]
    result = piga.calibrate(stored, terms)
    rows = [row for row in result.budget if row.source.startswith("servo integral")]
    assert rows
    number = [source.name for source in stored[0].sources].index("servo integral gain")
    moved = piga.calibrate([replace(s, known_servo=s.sources[number].known_servo) for s in stored], terms)
    for row in rows:
        for c, other in zip(result.coefficients, moved.coefficients, strict=True):
            expected = other.value - c.value
            difference = row.contributions[c.key] - expected
            assert abs(difference) < 0.06 * abs(expected) + 2e-3 * c.std, (c.key, difference, expected, c.std)


@pytest.mark.parametrize("own", ["scale_factor, k0", "scale_factor, k0, k0_T"])
def test_a_thermometer_moves_stored_summaries_by_the_terms_of_the_joint_fit(own: str) -> None:
    """Each run has one temperature, so that its own fit has no k0_T."""
    runs = []
    for seed, warmth in enumerate((0.0, 4.0, 9.0)):
        run = record(np.random.default_rng(seed), seconds=10.0, rate=5.0)
        output = run.output + 8.7e-3 / 9.8 * 1e-4 * warmth * run.t
        held = {"temperature": np.full(run.size, 293.15 + warmth), "uncertainty": at_rest(temperature="0.5 K")}
        runs.append(replace(run, output=output, **held))
    stored = [RunSummary.of(run, own, name=f"run {k}") for k, run in enumerate(runs, start=1)]
    result = piga.calibrate(stored, "scale_factor, tan_beta, k0, k2, m_Y, k0_T, k1_T", per_run=[])
    row = next(e.contributions for e in result.budget if e.source.startswith("temperature"))
    for name, by in (("k0", "k0_T"), ("scale_factor", "k1_T")):
        factor = result["scale_factor"].value if by == "k1_T" else 1.0
        assert row[name] == pytest.approx(-0.5 * result[by].value * factor, rel=1e-2), name
