"""Compensation models against the published case and the closed-form theory."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from piga.platform import compare, compensator, errors, simulate, true_knowledge
from piga.platform.chain import fitted_lines
from piga.platform.scenario import Compensation, MotionPlan, Sensors
from tests.platform.conftest import ARCMIN, ARCSEC, DEG, long, navigated, published, wobbling

pytestmark = pytest.mark.interpreted


@pytest.fixture(scope="module")
def ten_days():
    return compare(published())


@pytest.fixture(scope="module")
def ten_days_with_wobble():
    return compare(wobbling())


@long
def test_model_a_leaves_what_the_theory_says(ten_days):
    run = ten_days.models["A"]
    for channel in ("east_velocity", "heading", "roll"):
        ratio = run.lines.amplitude[channel] / run.theory.amplitude[channel]
        assert np.all(np.abs(ratio - 1.0) < 0.003), channel
        assert np.all(np.abs(ratio[2:] - 1.0) < 0.001), channel
    north = run.lines.amplitude["north_velocity"] / run.theory.amplitude["north_velocity"]
    assert np.all(np.abs(north[2:] - 1.0) < 0.002), "by the Coriolis coupling"


@long
def test_model_a_also_leaves_the_secant_term(ten_days):
    """The published d_r = m1 cos(c1) (tan eta - tan eta0) lacks m2 sin(c2) (sec eta - sec eta0)."""
    eta, m = 2.28 * DEG, 4.0 * ARCMIN
    first = -np.exp(1j * 20 * DEG) * np.tan(eta)
    second = -1j * np.exp(1j * 75 * DEG) * (1.0 / np.cos(eta) - 1.0)
    schuler = 1.0 / (1.0 - (1.2394e-3 * 480 / (2 * np.pi)) ** 2)
    result = ten_days.models["A"].lines.amplitude["heading"][-1] / (m * np.sin(40 * DEG) * schuler)
    assert result == pytest.approx(abs(first + second), rel=1e-3)
    assert abs(result / abs(first) - 1.0) > 0.01


@long
def test_model_b_leaves_under_one_percent_of_model_a(ten_days):
    a, b = ten_days.models["A"].lines.amplitude, ten_days.models["B"].lines.amplitude
    for channel in ("east_velocity", "heading", "roll"):
        assert b[channel][-1] < 0.001 * a[channel][-1]


@long
def test_the_theory_knows_the_wobble(ten_days_with_wobble):
    for model in ("A", "B"):
        run = ten_days_with_wobble.models[model]
        ratio = run.lines.amplitude["east_velocity"] / run.theory.amplitude["east_velocity"]
        assert np.all(np.abs(ratio - 1.0) < 0.005)


@long
def test_the_second_order_remainder_is_a_step_and_lines_at_twice_the_rate():
    """Model B, truth known: what stays is the second order of the small-angle matrices."""
    s = published(duration=86400.0, redundancy=1.0 * DEG)

    def left(scale):
        scaled = replace(
            s,
            polar=msgspec.structs.replace(s.polar, misalignment=4.0 * ARCMIN * scale),
            equatorial=msgspec.structs.replace(s.equatorial, misalignment=4.0 * ARCMIN * scale),
        )
        run, shown = navigated(scaled, "B")
        e = errors(shown, run.truth, run.readouts)
        rate = s.polar_rotation
        at = [
            fitted_lines(e.times, e.velocity[:, 1:2], (k * rate,), s.place.latitude)[0, 0] for k in (1.0, 2.0)
        ]
        return np.abs(e.velocity[:, :2]).max(), *at

    whole, half = left(1.0), left(0.5)
    assert 3.8 < whole[0] / half[0] < 4.2
    assert 3.8 < whole[2] / half[2] < 4.2
    assert whole[0] < 8e-3
    assert whole[1] < 2e-5


def test_the_redundancy_angle_is_followed_without_lag():
    s = published(duration=9600.0, step=8.0, redundancy=0.02)
    run = simulate(s)
    made = compensator("B", true_knowledge(s), run.readouts)
    assert np.abs(made.eta - run.truth.eta).max() < 2e-6
    drifting = compensator("B", true_knowledge(s), run.readouts, redundancy="drift-model")
    assert np.abs(drifting.eta - run.truth.eta).max() < 1e-9
    ignorant = replace(true_knowledge(s), eta_rate=0.0)
    late = compensator("B", ignorant, run.readouts).eta - run.truth.eta
    assert abs(late[-1]) < 0.2 * np.abs(late).max()


@long
@pytest.mark.parametrize("kind", ["reversal", "unequal", "at rest", "moving"])
def test_the_chain_runs_for_other_schedules_and_bases(kind):
    noise = Sensors(gimbal_noise=ARCSEC, pickoff_noise=ARCSEC, velocity_random_walk=1e-5)
    rate = 2.0 * np.pi / 480.0
    changes = {
        "reversal": {"reversal": 2},
        "unequal": {"equatorial_rotation": 0.8 * rate},
        "at rest": {"polar_rotation": 0.0, "equatorial_rotation": 0.0},
        "moving": {"motion": MotionPlan("turn", turn_rate=0.01), "compensation": Compensation(attitude="true")},
    }[kind]
    comparison = compare(published(duration=21600.0, sensors=noise, **changes))
    none, b = comparison.models["none"].errors, comparison.models["B"].errors
    if kind == "at rest":
        assert "at rest" in comparison.preparation.notes[0]
    else:
        assert b.horizontal.max() < 0.15 * none.horizontal.max()
    assert set(comparison.document()["models"]) == {"none", "A", "B", "C"}
