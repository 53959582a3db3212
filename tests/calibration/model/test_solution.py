"""There is no first guess: each of ten thousand problems has one optimum (slow). A coupling has one sign."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

import piga
from piga.calibration.model import solution
from piga.calibration.model.reduction import Reduction, triangle
from piga.calibration.model.solution import (
    Estimate,
    Layout,
    _best_phases,
    name_parameters,
    solve_parts,
)
from piga.records.run_file import EstimationTable
from piga.units import G0
from tests.calibration.made.independent import Bench, K
from tests.calibration.made.synthetic import at_rest, layout_of

PROBLEMS = 10_000
REACHED = 6.0
"""Errors below this many standard uncertainties are noise; one in 10^8 coefficients exceeds it."""


def problem(seed: int) -> tuple[piga.Run, dict[str, float]]:
    """Random coefficients, random plan of moving forces; 400 samples, noise levels known."""
    rng = np.random.default_rng([seed, 71])
    truth = {
        "tan_beta": 10.0 ** rng.uniform(-3.5, -2.0),
        "phi": rng.uniform(-np.pi, np.pi),
        "k0": rng.normal(0.0, 1e-3),
    }
    t = np.arange(400) * 0.04
    a = rng.uniform(0.3, 2.0, 3) * rng.choice([-1.0, 1.0], 3)
    w, p = rng.uniform(0.05, 0.8, 3), rng.uniform(0.0, 2.0 * np.pi, 3)
    f = np.column_stack(
        [a[0] + 0.5 * np.sin(w[0] * t + p[0]), *(3.0 * a[i] * np.sin(w[i] * t + p[i]) for i in (1, 2))]
    )
    f *= G0
    inst = piga.Instrument(
        scale_factor="0.8884 rad/s/g", beta=float(np.arctan(truth["tan_beta"])), alpha0=truth["phi"]
    )
    alpha = piga.propagate(inst, t, f + np.array([truth["k0"] * G0, 0.0, 0.0]))
    output = alpha - truth["phi"] + 2e-5 * rng.standard_normal(t.size)
    run = piga.Run.from_arrays(t, output, f, uncertainty=at_rest(), scale_factor="0.8884 rad/s/g", units="SI")
    known = EstimationTable(angle_rms="2e-5 rad", angle_random_walk="1e-8 rad/sqrt(s)")
    return replace(run, estimation=known), truth


def solved(run: piga.Run, truth: dict[str, float]) -> tuple[bool, float, float]:
    """Whether every coefficient is the truth within noise, the normalised squared error, and the one expected."""
    calibration = piga.calibrate(run, ["tan_beta", "k0"])
    error = np.array([c.value - truth[c.name] for c in calibration.coefficients])
    at = [c.name for c in calibration.coefficients].index("phi")
    error[at] = np.angle(np.exp(1j * error[at]))
    freedom = np.array([c.degrees_of_freedom for c in calibration.coefficients])
    std = np.array([c.std for c in calibration.coefficients])
    return (
        bool((np.abs(error) < REACHED * std).all()),
        float(error @ np.linalg.solve(calibration.covariance, error)),
        float(np.sum(freedom / (freedom - 2.0))),
    )


@pytest.mark.slow
def test_truth_in_ten_thousand_of_ten_thousand() -> None:
    """The squared errors in their covariance have the mean of Student's t: ``nu/(nu - 2)`` for each coefficient."""
    reached, squares, expected = zip(*(solved(*problem(seed)) for seed in range(PROBLEMS)), strict=True)
    assert sum(reached) == PROBLEMS
    assert abs(np.mean(squares) - np.mean(expected)) < 4.0 * np.std(squares) / np.sqrt(PROBLEMS)


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


@pytest.mark.parametrize("given", [(), (("servo_damping", 0.2),)])
def test_the_derivative_of_a_layout_with_a_servo(given: tuple[tuple[str, float], ...]) -> None:
    """Derivatives of the column coefficients by amplitudes and phases are those of finite differences."""
    layout = Layout(True, (2,), (("k0", None),), (np.array([0]),) * 2, ("servo",), given)
    values, step = np.array([1.3, 0.1, -0.2, 0.3, 0.7, 0.4, -2.0]), 1e-6

    def coefficients(x: np.ndarray) -> np.ndarray:
        return np.array([layout.linear(x[: layout.size], x[layout.size + g], g) for g in range(2)])

    exact = layout.derivative(values[: layout.size], values[layout.size :])
    for k, row in enumerate(step * np.eye(values.size)):
        moved = (coefficients(values + row) - coefficients(values - row)) / (2.0 * step)
        assert moved == pytest.approx(exact[:, :, k], abs=1e-8)
    one = replace(layout, tails=layout.tails[:1])
    assert one.from_linear(coefficients(values)[0], 0.4) == pytest.approx(values[: layout.size], abs=1e-12)


GROUPS = 5


def grouped(seed: int, orders: tuple[int, ...], uneven: float) -> tuple[Layout, list[np.ndarray], np.ndarray]:
    """Layout, factors and true amplitudes; groups show one direction up to ``10**uneven`` times as well as the other."""
    rng = np.random.default_rng(seed)
    layout = layout_of(True, orders, ("scale_factor", "k0"), GROUPS)
    size, factors = layout.local + 3, []
    truth = rng.standard_normal(layout.size)
    truth[: layout.head] = np.append(1.0, 0.05 * truth[1 : layout.head])
    for group in range(GROUPS):
        factor = np.triu(rng.standard_normal((size, size)), 1) + np.diag(rng.uniform(1.0, 2.0, size))
        factor[0] *= 10.0 ** rng.uniform(0.0, uneven)
        factor[:-1, -1] = factor[:-1, :-1] @ layout.linear(truth, rng.uniform(-3.0, 3.0), group)
        factor[:-1, -1] += 0.02 * rng.standard_normal(size - 1)
        factors.append(factor)
    return layout, factors, truth


def test_a_servo_with_own_phases_has_the_least_sum_of_squares() -> None:
    """A damping of the other sign is often another minimum."""
    keys = (("scale_factor", None), ("k0", None))
    layout = Layout(True, (), keys, (np.arange(2),) * 3, ("servo", "servo_damping"))
    for seed in range(20):
        rng, parts = np.random.default_rng(seed), []
        truth = np.array([1.0, 0.2, rng.choice([-0.3, 0.3]), 1.0, 0.1])
        for group in range(3):
            size = len(layout.columns) + 1
            factor = np.triu(rng.standard_normal((size, size)), 1) + np.diag(rng.uniform(0.5, 2.0, size))
            factor[:-1, -1] = factor[:-1, :-1] @ layout.linear(truth, rng.uniform(-3.0, 3.0), group)
            factor[:-1, -1] += 1e-3 * rng.standard_normal(size - 1)
            parts.append(Reduction(layout.columns, factor, 100))
        rest = sum(part.factor[-1, -1] ** 2 for part in parts)
        assert solve_parts(layout, parts).cost - rest < 1e-4, seed


@pytest.mark.parametrize("orders", [(), (1,), (1, 2)])
def test_the_best_phase_is_that_of_a_fine_grid(orders: tuple[int, ...]) -> None:
    """The cost has several minima, as narrow as a hundredth of a radian."""
    grid = np.linspace(-np.pi, np.pi, 20_001)
    for seed in range(4):
        layout, factors, _ = grouped(seed, orders, 3.0)
        amplitudes = np.random.default_rng(100 + seed).standard_normal(layout.size)
        best = _best_phases(layout, amplitudes, layout.stacked(factors))
        for group, factor in enumerate(factors):
            tried = [layout.linear(amplitudes, phase, group) for phase in (*grid[::20], best[group])]
            cost = np.sum((factor[:-1, -1] - np.array(tried) @ factor[:-1, :-1].T) ** 2, axis=1)
            near = grid[20 * int(np.argmin(cost[:-1])) :][:1] + np.linspace(-0.01, 0.01, 401)
            fine = np.array([layout.linear(amplitudes, phase, group) for phase in near])
            least = np.min(np.sum((factor[:-1, -1] - fine @ factor[:-1, :-1].T) ** 2, axis=1))
            assert cost[-1] <= least * (1.0 + 1e-9)


@pytest.mark.parametrize(("orders", "uneven"), [((), 0.5), ((2,), 0.5), ((), 3.0), ((2,), 3.0)])
def test_common_amplitudes_have_the_least_sum_of_squares(
    orders: tuple[int, ...], uneven: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SciPy stays where it is; where both directions show, it finds nothing better from the truth.

    The phases are fitted here, not integrated out.
    """
    monkeypatch.setattr(
        solution, "_fitted_noise", lambda _fitted, _curvatures, covariance, _variance: np.zeros(len(covariance))
    )
    for seed in range(12):
        layout, factors, truth = grouped(seed, orders, uneven)
        names = layout.columns
        parts = [Reduction(names, triangle(factor), 100) for factor in factors]
        estimate = solve_parts(layout, parts)

        def residual(x: np.ndarray, layout: Layout = layout, factors: list[np.ndarray] = factors) -> np.ndarray:
            rows = [
                factor[:-1, -1] - factor[:-1, :-1] @ layout.linear(x[: layout.size], x[layout.size + g], g)
                for g, factor in enumerate(factors)
            ]
            return np.concatenate(rows)

        reached = np.append(estimate.amplitudes, estimate.phases)
        if uneven < 1.0:
            start = np.append(truth, estimate.phases)
            other = least_squares(residual, start, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-12)
            assert np.sum(residual(reached) ** 2) <= 2.0 * other.cost * (1.0 + 1e-9)
        moved = least_squares(residual, reached, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-12).x - reached
        assert np.abs(moved / np.sqrt(np.diag(estimate.covariance))).max() < 1e-4


@pytest.mark.parametrize(("size", "mean", "covered"), [(0.0, 0.6, 0.93), (0.5, 0.25, 0.95), (2.0, 0.25, 0.95)])
def test_phases_of_groups_do_not_make_the_coupling_larger(size: float, mean: float, covered: float) -> None:
    """Twelve groups that each show the coupling with a noise of one in both directions, ``size`` times that noise.

    Each phase fits noise. Without a correction the mean error is 4.2, 2.7 and 0.8 standard uncertainties.
    """
    rng = np.random.default_rng(11)
    groups, records, rows = 12, 150, 50
    layout = layout_of(True, (), ("k0",), groups)
    errors = []
    for _ in range(records):
        parts = []
        for phase in rng.uniform(-np.pi, np.pi, groups):
            factor = np.zeros((4, 4))
            factor[:3, :3] = np.eye(3)
            factor[:3, 3] = np.append(
                size * np.array([np.cos(phase), np.sin(phase)]), 1.0
            ) + rng.standard_normal(3)
            factor[3, 3] = np.sqrt(rng.chisquare(rows))
            parts.append(Reduction(("p", "q", "k0"), triangle(factor), rows + 3))
        estimate = solve_parts(layout, parts)
        errors.append((estimate.amplitudes[0] - size) / np.sqrt(estimate.covariance[0, 0]))
    assert abs(np.mean(errors)) < mean
    assert np.mean(np.abs(errors) < 1.96) > covered


def errors(tangent: float, records: int) -> dict[str, np.ndarray]:
    """Errors in expanded uncertainties; the counter starts anew at each of 12 to 16 positions."""
    terms = {"scale_factor": K, "tan_beta": tangent, "k0": 1e-4, "m_Y": 0.0}
    result: dict[str, list[float]] = {name: [] for name in terms}
    for seed in range(records):
        rng = np.random.default_rng(seed)
        angle = np.linspace(0.1, np.pi - 0.1, int(rng.integers(12, 17)))
        side = np.sin(angle) * rng.choice([-1.0, 1.0], angle.size)
        forces = np.stack([np.cos(angle), side, np.zeros(angle.size)], axis=1)
        bench = Bench(forces=forces, seconds=30.0, rate=10.0, walk=2e-5, tan_beta=tangent, k0=terms["k0"])
        run = bench.run(bench.angles(rng) + rng.uniform(-50.0, 50.0, angle.size)[:, None])
        calibration = piga.calibrate(run, list(terms), phases="per-segment")
        for name, truth in terms.items():
            result[name].append((calibration[name].value - truth) / calibration[name].expanded)
    return {name: np.array(one) for name, one in result.items()}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::piga.CalibrationWarning")
@pytest.mark.parametrize("tangent", [0.0, 1e-5, 3e-5, 1e-3])
def test_intervals_with_a_phase_in_each_segment(tangent: float) -> None:
    """Not even a coupling that is not there is found: its interval contains the truth. Its u is some 3e-6 at known phases."""
    found = errors(tangent, 150)
    held = {name: np.mean(np.abs(one) < 1.0) for name, one in found.items()}
    assert min(held.values()) > 0.89  # 0.95 of 150 records less three standard deviations
    assert abs(np.mean(found["tan_beta"])) < 0.3
