"""Parts of a calibration that whole records seldom reach: each against its definition, with the JIT off."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

import piga
from piga.calibration.budget.monte_carlo import standard_draws
from piga.calibration.choice.cross_validation import predict
from piga.calibration.fit.one_run import Fit, fit_run
from piga.calibration.intervals import degrees_of_freedom
from piga.calibration.intervals.slow_noise import _whitened_means, quick_look
from piga.calibration.model.design import Design
from piga.calibration.model.identifiability import _aligned, notes_in_words, refuse_useless, remarks_in_words
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.request import make_request
from piga.calibration.model.solution import KNOTS, Estimate, Layout, name_parameters
from piga.calibration.noise.counted import count_of
from piga.calibration.noise.levels import Noise
from piga.calibration.noise.settings import NOISE
from piga.calibration.noise.slow_bases import DriftBasis
from piga.calibration.remarks.advice import with_advice
from piga.errors import ArgumentError, CalibrationError, IdentifiabilityError
from piga.planning.candidates import _without_phase, coefficient_names, model_request, run_of
from piga.planning.mounting import plan_mounting
from piga.records.calibration import Coefficient, SegmentScatter
from piga.trend.history import Forecast
from piga.units import G0
from tests.calibration.made.synthetic import BETA, SCALE, TERMS, record
from tests.planning.cases import request
from tests.planning.test_plan import mounting_request

ARCSECOND = math.pi / 648000.0


def test_a_negative_coupling_is_a_positive_one_half_a_turn_away() -> None:
    """The columns behind the coefficients, hence all that was measured, stay as they were; odd harmonics turn, too."""
    layout = Layout(True, (1, 2), (("scale_factor", None), ("k0", None)), (np.array([0, 1]),))
    amplitudes = np.array([-0.3e-3, 2e-5, -3e-5, 1e-5, 4e-5, 0.0906, 1.4e-4])
    phases = np.array([2.9])
    spread = np.random.default_rng(7).standard_normal((8, 8))
    estimate = Estimate(amplitudes, phases, 1e-12 * spread @ spread.T, 0.0, ())
    coefficients, covariance = name_parameters(
        layout, estimate, estimate.covariance, 0.0906, ("scale_factor", "tan_beta", "s1", "c1", "s2", "c2", "k0"),
        [(None, None)],
    )  # fmt: skip
    result = {c.name: c.value for c in coefficients}
    assert result["tan_beta"] > 0.0
    assert -math.pi < result["phi"] <= math.pi
    K = amplitudes[5]
    unit = {c.name: c.unit for c in coefficients}
    assert unit["k0"] == "g"
    same = np.array([K * result["tan_beta"], *amplitudes[1:5], *amplitudes[5:]])
    same[1:5] = [K * result[name] * (G0 if unit[name] == "g" else 1.0) for name in ("s1", "c1", "s2", "c2")]
    before = layout.linear(amplitudes, phases[0], 0)
    np.testing.assert_allclose(layout.linear(same, result["phi"], 0), before, rtol=1e-12, atol=1e-18)
    names = [c.name for c in coefficients]
    plain = estimate.covariance
    at = names.index("tan_beta"), names.index("phi")
    # d tan_beta = -(d A - tan dK)/K: the sign of its covariance with the phase turns with its own
    tangent = amplitudes[0] / K
    assert covariance[at] == pytest.approx(-(plain[0, 7] - tangent * plain[5, 7]) / K, rel=1e-9)


def coefficient(
    name: str, value: float, std: float, unit: str = "1", segment: str | None = None
) -> Coefficient:
    return Coefficient(name, value, std, unit, segment)


def notes(coefficients: list[Coefficient], correlation: float = 0.0, **options: object) -> str:
    std = np.array([c.std for c in coefficients])
    covariance = np.outer(std, std) * (correlation + (1.0 - correlation) * np.eye(std.size))
    return "\n".join(
        notes_in_words(tuple(coefficients), covariance, **({"scatter": SegmentScatter()} | options))
    )


def test_doubts_are_said_when_there_are_and_only_then() -> None:
    sure = [
        coefficient("scale_factor", 0.9, 1e-6),
        coefficient("tan_beta", 1e-3, 1e-6),
        coefficient("k0", 1.0, 0.1),
    ]
    assert notes(sure) == ""
    assert notes(sure, 0.97).count("\n") == 0, "one sentence for the group, not one for each pair"
    assert "scale_factor, tan_beta and k0 are hard to tell apart" in notes(sure, 0.97)
    assert "scale_factor and k0 are hard to tell apart" in notes([sure[0], sure[2]], -0.97)
    assert "largest correlation 0.970 in size" in notes([sure[0], sure[2]], -0.97)
    small = [*sure[:2], coefficient("k0", 0.19, 0.1), coefficient("k2", 0.1, 0.1)]
    assert notes(small) == ""
    assert remarks_in_words(tuple(small), "shared") == (
        "k0, k2 are smaller than twice their standard uncertainty: the record does not need them",
    )
    assert "tan_beta is not well above" in notes([coefficient("tan_beta", 3.9e-6, 1e-6)])
    assert "scatter 2.1 times" in notes(sure, scatter=SegmentScatter(2.1, 1e-6))
    assert "scatter" not in notes(sure, scatter=SegmentScatter(1.9, 1e-6))
    drift = SegmentScatter(1.0, 1e-6, 3.1)
    assert "scatter 3.1 times more than the noise of the angle" in notes(sure, scatter=drift)
    assert "scatter" not in notes(sure, scatter=SegmentScatter(1.0, 1e-6, 1.9))
    loose = [*sure, coefficient("phi", 0.1, 0.6, "rad", "7"), coefficient("phi", 0.1, 0.01, "rad", "8")]
    assert "phi is not determined in segment 7:" in notes(loose)
    assert remarks_in_words(tuple(loose), "per-segment") == ()
    assert "has its own phase" in remarks_in_words((*sure, loose[-1]), "per-segment")[0]


@pytest.mark.parametrize(
    ("name", "largest", "unit_error"),
    [
        ("scale_factor", 4.0, 1.0 / 0.9),  # relative
        ("k0", 4.0, 0.25),  # of 4 g
        ("k0_t", 4.0, 0.5 * 600.0 / 4.0),  # at the ends of 600 s, zero in the middle
        ("k0_T", 4.0, 0.5 * 8.0 / 4.0),
        ("k1_T", 4.0, 0.5 * 8.0),
        ("k2", 4.0, 4.0),  # g^2 per g
        ("k3", 4.0, 16.0),
        ("k_YY", 4.0, 4.0),
        ("m_Y", 4.0, 1.0),
        ("s2", 4.0, 0.25),
    ],
)
def test_an_estimate_is_useless_from_a_twentieth_of_the_largest_force(
    name: str, largest: float, unit_error: float
) -> None:
    limit = 0.05 / unit_error
    refuse_useless((coefficient(name, 0.9, 0.99 * limit),), largest * G0, 600.0, 8.0)
    with pytest.raises(IdentifiabilityError, match=f"does not determine {name}: {name} = 0.9"):
        refuse_useless((coefficient(name, 0.9, 1.01 * limit),), largest * G0, 600.0, 8.0)
    refuse_useless((coefficient("phi", 0.9, 100.0),), largest * G0, 600.0, 8.0)


@pytest.mark.parametrize(
    ("distribution", "fourth", "largest"),
    [
        ("normal", 3.0, math.inf),
        ("rectangular", 1.8, math.sqrt(3.0)),
        ("triangular", 2.4, math.sqrt(6.0)),
        ("arcsine", 1.5, math.sqrt(2.0)),
    ],
)
def test_draws_have_unit_variance_and_the_kurtosis_of_their_distribution(
    distribution: str, fourth: float, largest: float
) -> None:
    x = standard_draws(distribution, math.inf, 40_000, np.random.default_rng(3))
    assert abs(x.mean()) < 0.025
    assert np.mean(x**2) == pytest.approx(1.0, abs=0.035)
    assert np.mean(x**4) == pytest.approx(fourth, rel=0.08)
    assert np.abs(x).max() <= largest


def test_draws_of_students_t_have_its_wider_spread() -> None:
    x = standard_draws("t", 10.0, 40_000, np.random.default_rng(4))
    assert np.mean(x**2) == pytest.approx(10.0 / 8.0, rel=0.04)


def fit_with(size: int, noise: Noise, stretches: int = 1) -> Fit:
    """A small fit of segments at 10 Hz, with these noise levels."""
    t = 0.1 * np.arange(size)
    f = np.zeros((size, 3))
    f[:, 0] = G0 * (1.0 + 0.1 * np.sin(t))
    segment = (np.arange(size) // (size // stretches)).astype(np.int32)
    run = piga.Run.from_arrays(
        t, piga.propagate(piga.Instrument(SCALE, BETA), t, f), f, scale_factor=SCALE, segment=segment
    )
    return replace(fit_run(run, make_request(run, ["scale_factor"], None, None, None)), noise=noise)


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
        rows.append(_whitened_means(replace(fit, d=d), DriftBasis.of(fit.design.run), 0, size, bins)[:, -1])
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
        return quick_look(residual, DriftBasis.of(fit.design.run)).gain

    assert np.median([gain(0.0) for _ in range(20)]) < 0.3
    assert np.median([gain(1e-15) for _ in range(20)]) > 3.0


def test_a_quick_look_at_few_bins_sees_nothing() -> None:
    """Fewer rows than steps of the drift: whatever the residuals are, they are no evidence."""
    fit = replace(fit_with(KNOTS, Noise(1e-12, 1e-12)), d=np.linspace(0.0, 1.0, KNOTS))
    assert quick_look(fit, DriftBasis.of(fit.design.run)).gain == 0.0


def test_spikes_of_a_log_of_rates() -> None:
    """Each sample of a rate stands for itself: exactly the spoilt ones go, and the rest decides."""
    t = 0.1 * np.arange(600)
    f = G0 * np.column_stack([1.0 + np.sin(0.3 * t), 3.0 * np.cos(0.2 * t), 0.5 + 0.0 * t])
    _, rate = piga.propagate(piga.Instrument(scale_factor=SCALE, beta=BETA), t, f, with_rate=True)
    rate += 1e-5 * np.random.default_rng(21).standard_normal(t.size)
    terms = ["scale_factor", "tan_beta", "k0"]

    def result(output: np.ndarray) -> piga.Calibration:
        return piga.calibrate(piga.Run.from_arrays(t, output, f, scale_factor=SCALE, kind="rate"), terms)

    spoilt = rate.copy()
    spoilt[[17, 18, 101, 333]] += [0.5, -0.4, 0.9, -0.7]
    with_spikes, without = result(spoilt), result(rate)
    assert not without.outliers
    assert [outlier.samples for outlier in with_spikes.outliers] == [2, 1, 1]
    assert [outlier.time for outlier in with_spikes.outliers] == pytest.approx([1.7, 10.1, 33.3])
    assert [outlier.size for outlier in with_spikes.outliers] == pytest.approx([0.5, 0.9, 0.7], rel=1e-3)
    assert with_spikes.quality.used == 596
    for name in terms:
        assert with_spikes[name].value == pytest.approx(without[name].value, abs=0.5 * without[name].std)
        assert with_spikes[name].std == pytest.approx(without[name].std, rel=0.05)


def part_of(rows: np.ndarray) -> Reduction:
    part = Reduction.empty(("a", "b"))
    part.absorb(np.ascontiguousarray(rows.T))
    return part


def test_what_cannot_be_predicted_from_the_rest_is_not() -> None:
    rng = np.random.default_rng(5)
    rows = [np.column_stack([x := rng.standard_normal((6, 2)), x @ [2.0, 3.0] + 0.1]) for _ in range(3)]
    parts, probe = [part_of(r) for r in rows], (0, 1.0)
    assert predict(parts[:1], [0, 1], probe, None) is None
    whole = predict(parts, [0, 1], probe, None)
    assert whole is not None
    expected = 0.0
    for k in range(3):
        rest = np.vstack([r for i, r in enumerate(rows) if i != k])
        x = np.linalg.lstsq(rest[:, :2], rest[:, 2], rcond=None)[0]
        expected += float(np.sum((rows[k][:, 2] - rows[k][:, :2] @ x) ** 2))
    assert whole.chi_square == pytest.approx(expected, rel=1e-9)
    only_here = [part_of(r * [1.0, float(k == 0), 1.0]) for k, r in enumerate(rows)]
    assert predict(only_here, [0, 1], probe, None) is None  # b is seen in the first part alone
    twice = [part_of(np.column_stack([r[:, 0], 2.0 * r[:, 0], r[:, 2]])) for r in rows]
    assert predict(twice, [0, 1], probe, None) is None


def test_the_score_of_a_value_is_the_normal_number_of_its_probability() -> None:
    forecast = Forecast(0.0, 10.0, 2.0, math.inf)
    assert forecast.score(14.0) == 2.0
    few = Forecast(0.0, 10.0, 2.0, 4.0)
    # Student, 4 degrees: 2.776 at 97.5 %; normal: 1.960
    assert few.score(10.0 + 2.0 * 2.776445) == pytest.approx(1.959964, abs=1e-5)
    assert few.score(10.0 - 2.0 * 2.776445) == pytest.approx(-1.959964, abs=1e-5)
    assert few.half_width() == pytest.approx(2.0 * 2.776445, rel=1e-6)


def test_advice_goes_behind_the_remedy_of_an_error() -> None:
    error = with_advice(
        CalibrationError("no result", remedy="change this"), ("swap Y0 and Z0", "halve the unit")
    )
    assert error.message == "no result"
    assert error.remedy == "change this; or swap Y0 and Z0; or halve the unit"
    assert with_advice(CalibrationError("no result", remedy="change this"), ()).remedy == "change this"


def log_of_angles(output: np.ndarray, resolution: float = 0.0) -> piga.Run:
    t = 0.1 * np.arange(output.size)
    f = np.tile([G0, 0.0, 0.0], (output.size, 1))
    return piga.Run.from_arrays(t, output, f, scale_factor=SCALE, resolution=resolution, serial="angles")


def test_the_count_of_a_log_that_does_not_state_it() -> None:
    count = 20.0 * ARCSECOND
    t = 0.1 * np.arange(900)
    turn = 0.003 * t + 1e-4 * np.sin(0.4 * t)
    assert count_of(log_of_angles(np.round(turn / count) * count)) == pytest.approx(count, rel=1e-6)
    assert count_of(log_of_angles(turn)) == 0.0  # no two steps alike
    assert count_of(log_of_angles(0.003 * t)) == 0.0  # one step only: a steady turn says nothing
    steps = np.random.default_rng(2).choice([1.0, 1.7, 2.0], t.size) * count
    assert count_of(log_of_angles(np.cumsum(steps))) == 0.0  # few steps, but no multiples of one
    assert count_of(log_of_angles(turn, resolution=5e-5)) == 5e-5  # what is stated counts


def test_long_records_have_the_fewest_degrees_of_freedom_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    run = record(np.random.default_rng(8), walk=2e-5, seconds=10.0, rate=2.0, count=4)
    exact = [c.degrees_of_freedom for c in piga.calibrate(run, TERMS).coefficients]
    monkeypatch.setattr(degrees_of_freedom, "NOISE", replace(NOISE, degrees_large=100))
    least = {c.degrees_of_freedom for c in piga.calibrate(run, TERMS).coefficients}
    assert len(least) == 1
    assert 0.3 * min(exact) < min(least) <= 1.01 * min(exact)


def test_a_mounting_that_cannot_be_planned(tmp_path: Path) -> None:
    wish = mounting_request(tmp_path, '"0 deg", "80 deg"')
    table = wish.table.mounting
    assert table is not None

    def planned(**changes: object) -> None:
        changed = msgspec.structs.replace(table, **changes)
        plan_mounting(replace(wish, table=msgspec.structs.replace(wish.table, mounting=changed)))

    with pytest.raises(ArgumentError, match=r"\[mounting\] step: must be positive"):
        planned(step="0 s")
    with pytest.raises(ArgumentError, match=r"\[mounting\] skew: '0:90 deg' is not a range(?s:.*)0:91:1 deg"):
        planned(skew="0:90 deg")
    scenario = wish.scenario
    straight = replace(scenario.specimen, instrument=piga.Instrument(scale_factor=SCALE, beta=0.0))
    with pytest.raises(CalibrationError, match=r"without it there is no lock zone"):
        plan_mounting(replace(wish, scenario=replace(scenario, specimen=straight)))


def test_groups_are_turned_to_their_own_phases() -> None:
    """Exact data of one coupling at two phases: turned, both have it in the first column and nothing in the second."""
    rng = np.random.default_rng(14)
    layout = Layout(True, (), (), (np.zeros(0, dtype=np.int64),) * 2)
    parts = []
    for phase in (0.4, -2.1):
        x = rng.standard_normal((40, 2)) @ np.array([[1.0, 0.8], [0.0, 0.5]])  # columns that are correlated
        part = Reduction.empty(("p", "q"))
        part.absorb(
            np.ascontiguousarray(np.column_stack([x, x @ [0.7 * math.cos(phase), 0.7 * math.sin(phase)]]).T)
        )
        parts.append(part)
    factor = _aligned(layout, parts).factor
    np.testing.assert_allclose(np.linalg.solve(factor[:2, :2], factor[:2, 2]), [0.7, 0.0], atol=1e-12)


@pytest.mark.parametrize("phase", ["shared", "per-segment"])
def test_a_phase_of_its_own_costs_information(tmp_path: Path, phase: str) -> None:
    """What is known of the others is the inverse of their part of the covariance, a phase that is shared among them."""
    wish = request(tmp_path, phases=phase)
    names = coefficient_names(wish)
    size = len([name for name in names if name != "phi"]) + 1
    spread = np.random.default_rng(6).standard_normal((3, size, size + 3))
    information = spread @ spread.swapaxes(1, 2)
    t, f = np.arange(3.0), np.full((3, 3), G0)
    run = run_of(wish, t, t, f, np.zeros((3, 3)), np.zeros(3, np.int32))
    result = _without_phase(information, wish, Design(run, model_request(wish), run.scale_factor))
    covariance = np.linalg.inv(information)
    order = [name for name in names if name != "phi"] + ["phi"]
    kept = [order.index(name) for name in names]
    np.testing.assert_allclose(result, np.linalg.inv(covariance[:, kept][:, :, kept]), rtol=1e-9, atol=1e-9)


def test_a_phase_that_no_sample_shows_is_not_determined_and_spoils_nothing() -> None:
    """A position along gravity has no coupling to show its phase; a segment of one sample has no increment."""
    inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="100 arcsec")
    generator = np.random.default_rng(3)
    t, f, psi, segment = [], [], [], []
    for number, angle in enumerate((0.0, 30.0, 60.0, 90.0, 90.0, 120.0, 150.0)):
        count = 1 if number == 4 else 200
        time = 0.1 * np.arange(count) + 100.0 * number
        force = np.tile(9.8 * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0]), (count, 1))
        force[np.abs(force) < 1e-12] = 0.0
        turned = piga.propagate(inst, time - time[0], force) if count > 1 else np.zeros(1)
        t.append(time), f.append(force), segment.append(np.full(count, number, np.int32))
        psi.append(turned + 1e-5 * generator.standard_normal(count))
    run = piga.Run.from_arrays(
        np.concatenate(t), np.concatenate(psi), np.concatenate(f), scale_factor=inst.scale_factor,
        segment=np.concatenate(segment), serial="P",
    )  # fmt: skip
    cal = piga.calibrate(run, ["scale_factor", "tan_beta", "k0"], phases="per-segment")
    assert np.isfinite(cal.covariance).all()
    phases = [c for c in cal.coefficients if c.name == "phi"]
    assert [c.std == pytest.approx(np.pi / np.sqrt(3.0)) for c in phases] == [
        True,
        False,
        False,
        False,
        True,
        False,
        False,
    ]
    for name, truth in (("scale_factor", 0.8884), ("tan_beta", inst.tan_beta), ("k0", 0.0)):
        assert abs(cal[name].value - truth) < 4.0 * cal[name].std, name
    assert cal["scale_factor"].std < 1e-4
