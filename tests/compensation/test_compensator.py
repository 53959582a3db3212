"""Known force comes back from whole records, with its uncertainty and flags; the published case."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest

import piga
from piga._kernels.compensation.data import TERMS
from piga.compensation import FLAGS, Phase
from piga.units import G0
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, constant_force, mean_force, run_of

PHI = np.pi / 4
TOLERANCE_RAMPS = 1e-11
TOLERANCE_ERRORS = 2e-7
CAL = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": PHI})


@pytest.mark.interpreted
@pytest.mark.parametrize("a_x", [1.0, -1.0, 0.01, 0.0, 5 * TAN_BETA, 0.03])
def test_constant_force_comes_back_to_rounding_of_the_angle(a_x):
    """All four regimes and the critical line; the angle's own rounding is 4 eps alpha / (K h)."""
    t = np.arange(0.0, 5.0, 0.01)
    f = constant_force(t, a_x, 4.0, 3.0)
    run = run_of(t, f, phi=PHI)
    compensated = piga.compensate(run, CAL)
    rounding = 4 * np.finfo(float).eps * max(1.0, np.abs(run.output).max()) / (run.scale_factor * 0.01)
    assert np.abs(compensated.ax[1:] - mean_force(f)).max() < max(rounding, 1e-14)


@pytest.mark.interpreted
def test_rate_samples_come_back_to_1e12_g():
    t = np.arange(0.0, 5.0, 0.01)
    f = constant_force(t, 1.0, 5.0)
    f *= (1.0 + 0.3 * np.sin(3.0 * t))[:, None]
    compensated = piga.compensate(run_of(t, f, phi=PHI, kind="rate"), CAL)
    assert np.abs(compensated.ax - f[:, 0]).max() < 1e-12 * G0


ERRORS = {
    "k0": 1.6e-3, "k1": -2.4e-3, "k2": 2e-3, "k3": 1e-4, "k2o": 3e-4, "k1a": 2e-4, "m_Y": 2e-4, "m_Z": -1e-4, "k_XY": 1e-4,
    "k_XZ": -2e-4, "k_YY": 3e-5, "k_ZZ": 2e-5, "k_YZ": -1e-5, "k0_T": 1e-5, "k1_T": 2e-5,
    "s1": 1e-5, "c1": 3e-5,
}  # fmt: skip


@pytest.mark.interpreted
@pytest.mark.parametrize("kind", ["angle", "rate"])
def test_full_error_model_is_inverted_to_rounding(kind):
    t = np.arange(0.0, 3.0, 0.01)
    f = constant_force(t, -1.3, 2.0, -0.7)
    temperature = np.full(t.size, 301.0)
    run = run_of(t, f, phi=PHI, kind=kind, errors=ERRORS, temperature=temperature)
    cal = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": PHI, **ERRORS})
    compensated = piga.compensate(run, cal)
    assert np.abs(compensated.ax[1:] - f[1:, 0]).max() < 1e-12 * G0


def test_missing_phase_names_the_segment():
    t = np.arange(0.0, 1.0, 0.1)
    run = run_of(t, constant_force(t, 1.0, 1.0))
    cal = calibration_of({"tan_beta": 1e-3, "phi[3]": 0.1})
    with pytest.raises(piga.CalibrationError, match=r"segment '0'.*per-segment phases: 3"):
        piga.compensate(run, cal)
    assert piga.compensate(run, cal, phase=Phase(0.1)).size == t.size


def test_other_serial_is_refused_unless_forced():
    t = np.arange(0.0, 1.0, 0.1)
    run = run_of(t, constant_force(t, 1.0, 1.0), serial="A")
    cal = calibration_of({"k0": 0.0}, serial="B")
    with pytest.raises(piga.CalibrationError, match="instrument 'A', the calibration of 'B'"):
        piga.compensate(run, cal)
    assert piga.compensate(run, cal, force=True).serial == "A"


def test_flags_tell_locked_near_critical_and_starts():
    t = np.arange(0.0, 1.0, 0.1)
    for a_x, name in ((0.5, "locked"), (1.1, "near_critical")):
        run = run_of(t, constant_force(t, a_x * 5.0 * TAN_BETA, 5.0), phi=PHI)
        compensated = piga.compensate(run, CAL)
        assert compensated.flagged(name)[1:].all()
        assert compensated.flags[0] == FLAGS["no_increment"]
        assert np.isnan(compensated.ax[0])
        assert compensated.dv[0] == 0.0


@pytest.mark.interpreted
@pytest.mark.parametrize("step", [0.3, 1.0, 6.0])
@pytest.mark.parametrize("a_x", [1.0, -1.0, 0.02])
def test_constant_force_comes_back_whatever_the_output_turns_in_an_interval(step, a_x):
    """The inverse is that of the exact motion: up to several radians and, flagged as coarse, beyond a turn."""
    t = step * np.arange(30)
    compensated = piga.compensate(run_of(t, constant_force(t, a_x, 4.0, 3.0), phi=PHI), CAL)
    assert np.abs(compensated.ax[1:] - a_x * G0).max() < 1e-13 * G0
    turned = np.abs(np.diff(run_of(t, constant_force(t, a_x, 4.0, 3.0), phi=PHI).output)) > 1.0
    assert (compensated.flagged("coarse")[1:] == turned).all()


def ramps(t):
    """Three forces with slopes of their own [m/s^2]."""
    return G0 * np.stack([1.0 + 0.1 * t, 2.0 - 0.3 * t, -1.0 + 0.25 * t], axis=1)


@pytest.mark.interpreted
def test_independent_ramps_come_back_to_the_fourth_order():
    """From the second interval on the slope is known: 1e-12 g at 20 Hz; a wrong Magnus term leaves 1e-6 g."""
    t = np.arange(0.0, 5.0, 0.05)
    compensated = piga.compensate(run_of(t, ramps(t), phi=PHI), CAL)
    assert np.abs(compensated.ax[2:] - mean_force(ramps(t))[1:]).max() < TOLERANCE_RAMPS * G0


@pytest.mark.interpreted
def test_error_model_is_integrated_over_the_slope():
    """What is left comes from the curvature that exaggerated coefficients give the input: 7e-8 g."""
    t = np.arange(0.0, 5.0, 0.05)
    errors = {"k2": 5e-2, "k3": 1e-2, "k_XY": 2e-2, "k_XZ": 3e-2, "k_YY": 1e-2, "k_YZ": 2e-2}
    cal = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": PHI, **errors})
    compensated = piga.compensate(run_of(t, ramps(t), phi=PHI, errors=errors), cal)
    assert np.abs(compensated.ax[2:] - mean_force(ramps(t))[1:]).max() < TOLERANCE_ERRORS * G0


PLAIN = {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.4}


@pytest.mark.interpreted
@pytest.mark.parametrize("kind", ["angle", "rate"])
@pytest.mark.parametrize(
    "name", [*TERMS, "s1", "c1", "s2", "c2", "s7", "c7", "scale_factor", "tan_beta", "phi"]
)
def test_of_one_coefficient(name: str, kind: str) -> None:
    t = 0.01 * np.arange(120)
    f = G0 * np.column_stack((1.0 + 0.5 * np.sin(3.0 * t), 2.0 + np.cos(2.0 * t), -1.0 + 0.3 * t))
    warm = 293.15 + 4.0 * np.cos(t)
    run = replace(run_of(t, f, phi=0.4, kind=kind, temperature=warm), vibration=G0 * (2.0 + np.sin(t)))
    std = 1e-5 * abs(PLAIN.get(name, 1.0))
    order = name[1:] if name[0] in "sc" and name[1:].isdigit() else ""
    values = {**PLAIN, **({f"s{order}": 0.0, f"c{order}": 0.0} if order else {}), name: PLAIN.get(name, 0.0)}
    uncertainty = piga.compensate(run, calibration_of(values, {name: std})).u_ax[1:]
    up, down = (
        piga.compensate(run, calibration_of({**values, name: values[name] + d})).ax[1:] for d in (std, -std)
    )
    change = np.abs(up - down) / 2.0
    assert change.max() > 0.0
    settled = slice(16, None)  # before that u_ax holds the reference's bow at the beginning of the stretch
    np.testing.assert_allclose(uncertainty[settled], change[settled], rtol=2e-2, atol=2e-2 * change.max())


def drifting(seconds: float = 40.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An instrument whose bias drifts by 1e-5 g/s; the input is the same before and after."""
    t = 100.0 + np.arange(0.0, seconds, 0.01)
    f = G0 * np.column_stack([1.0 + 0.3 * np.sin(0.5 * t), 0.5 * np.cos(0.3 * t), 0.0 * t])
    drift = np.zeros_like(f)
    drift[:, 0] = 1e-5 * G0 * (t - 100.0)
    inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="200 arcsec")
    every = slice(None, None, 10)  # a smooth force between the samples of the record
    return t[every], f[every], piga.propagate(inst, t, f + drift, between="linear")[every]


@pytest.mark.interpreted
def test_a_part_of_the_record_is_compensated_at_its_own_time(tmp_path: Path) -> None:
    t, f, alpha = drifting()
    whole = piga.Run.from_arrays(t, alpha, f, scale_factor="0.8884 rad/s/g", units="SI")
    path = tmp_path / "c.json"
    piga.calibrate(whole, ["scale_factor", "tan_beta", "k0", "k0_t"]).to_json(path)
    calibration = piga.Calibration.from_json(path)
    assert calibration["k0_t"].value == pytest.approx(1e-5, rel=1e-3)
    late = slice(300, None)
    part = piga.Run.from_arrays(t[late], alpha[late], f[late], scale_factor="0.8884 rad/s/g", units="SI")
    compensated = piga.compensate(part, calibration)
    velocity = G0 * (t - 0.6 * np.cos(0.5 * t))
    middle = np.diff(velocity[late]) / 0.1
    np.testing.assert_allclose(compensated.ax[2:], middle[1:], atol=2e-6 * G0)


@pytest.mark.interpreted
def test_rows_outside_the_calibrated_range_are_flagged() -> None:
    t, f, alpha = drifting(20.0)
    calibration = piga.calibrate(
        piga.Run.from_arrays(t, alpha, f, scale_factor="0.8884 rad/s/g", units="SI"),
        ["scale_factor", "tan_beta", "k0"],
    )
    low, high = calibration.diagnostics.range["a_x"]
    assert (low, high) == (f[:, 0].min(), f[:, 0].max())
    strong = f * [2.0, 1.0, 1.0]
    inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="200 arcsec")
    run = piga.Run.from_arrays(
        t, piga.propagate(inst, t, strong, between="linear"), strong, scale_factor="0.8884 rad/s/g", units="SI"
    )
    flagged = piga.compensate(run, calibration).flagged("out_of_range")
    assert flagged[1:].mean() > 0.5


RATE = 20.0 if numba.config.DISABLE_JIT else 100.0
PUBLISHED = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": np.pi / 4})


def published_record(kind: str):
    """a_x from 0 to 2.06 g in 100 s, a_Y = 5 a_x [Wei2024]."""
    t = np.arange(0.0, 100.0, 1.0 / RATE)
    f = np.outer(2.06 * G0 * t / 100.0, [1.0, 5.0, 0.0])
    return run_of(t, f, phi=np.pi / 4, kind=kind)


@pytest.mark.interpreted
def test_published_error_of_005_g_goes_below_1e9_g():
    """Rates exactly; angles to the error of a slope known to first order at the two first intervals."""
    rate = published_record("rate")
    before = rate.output / rate.scale_factor - rate.f[:, 0]
    assert 0.04 * G0 < np.abs(before).max() < 0.055 * G0
    assert np.abs(piga.compensate(rate, PUBLISHED).ax - rate.f[:, 0]).max() < 1e-12 * G0
    angle = published_record("angle")
    assert np.abs(piga.compensate(angle, PUBLISHED).ax[1:] - mean_force(angle.f)).max() < 1e-9 * G0


@pytest.mark.interpreted
def test_published_formula_leaves_about_1e3_g():
    """With the phase 0.8026 rad to which the published calibration converges."""
    record = published_record("angle")
    cal = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.8026})
    left = piga.compensate(record, cal, method="published").ax[1:] - mean_force(record.f)
    assert 3e-4 * G0 < np.abs(left).max() < 2e-3 * G0


@pytest.mark.parametrize("kind", ["angle", "rate"])
def test_locked_start_is_named(kind):
    """The force leaves the dead zone after 1 s; the same with a turning start says nothing."""
    t = np.arange(0.0, 3.0, 0.01)
    for still, size in ((0.5, 1), (3.0, 0)):
        f = constant_force(t, 1.0, 5.0)
        f[:100, 0] = still * TAN_BETA * 5.0 * G0
        compensated = piga.compensate(run_of(t, f, phi=PHI, kind=kind), CAL)
        assert len(compensated.notes) == 1 + size  # that of Type A is always there
        if size:
            first = 2 if kind == "angle" else 1
            assert f"in {101 - first} rows, the first at t = {t[first - 1]:.9g} s" in compensated.notes[1]
            assert compensated.flagged("locked")[first - 1 : 100].all()


def smooth(t: np.ndarray) -> np.ndarray:
    """A force that sways along X0 and goes linearly across, where smooth samples mean a smooth force [m/s^2]."""
    a = 1.0 + 0.3 * np.sin(np.pi * t)
    return G0 * np.stack([a, 5.0 + 0.05 * t, 0.4 - 0.03 * t], axis=1)


@pytest.mark.interpreted
@pytest.mark.parametrize("rate", [50.0, 100.0, 400.0])
def test_smooth_force_comes_back_to_1e12_g(rate):
    """From the fourth interval on, plus the rounding of the angle; 3e-11 g at 50 Hz."""
    t = np.arange(0.0, (4.0 if numba.config.DISABLE_JIT else 20.0), 1.0 / rate)
    run = run_of(t, smooth(t), phi=PHI)
    rounding = 2 * np.finfo(float).eps * np.abs(run.output).max() * rate / run.scale_factor
    left = np.abs(piga.compensate(run, CAL).ax[1:] - mean_force(smooth(t)))[3:]
    assert left.max() < (4e-11 if rate < 100.0 else 2e-12) * G0 + 2.0 * rounding


@pytest.mark.interpreted
def test_uneven_intervals_cost_the_higher_differences_only():
    rng = np.random.default_rng(3)
    t = np.cumsum(0.01 * (1.0 + 0.2 * rng.random(500)))
    left = np.abs(piga.compensate(run_of(t, smooth(t), phi=PHI), CAL).ax[1:] - mean_force(smooth(t)))[3:]
    assert left.max() < 1e-8 * G0
