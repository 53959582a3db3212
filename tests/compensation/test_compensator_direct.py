"""Compensation of direct instruments: the inverse of a polynomial."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import piga
from piga.compensation import Mounted, identify_phase
from piga.compensation.model import FLAGS
from tests.calibration.direct import G, Tumble

pytestmark = pytest.mark.filterwarnings("ignore::piga.errors.CalibrationWarning")
TRUTH = {"k0": 2e-3, "k2": 20e-6, "k3": 5e-6, "m_Y": 3e-4}


def given(unit: str, K: float, u: float = 0.0) -> piga.Calibration:
    """The true coefficients; K with the standard uncertainty ``u``."""
    return piga.Calibration.from_coefficients({"scale_factor": (K, u)} | dict(TRUTH), serial="QA-1", unit=unit)


@pytest.mark.parametrize(
    ("kind", "unit", "K"), [("rate", "mA", 0.6), ("counts", "count/s", 5e6), ("rate", "LSB", 4e6)]
)
def test_force_is_the_true_one(tmp_path: Path, kind: str, unit: str, K: float) -> None:
    tumble = Tumble(K=K, noise=0.0)
    declared = "" if kind == "counts" else unit
    run = piga.read_run(tumble.write(tmp_path, kind, declared, f"{K:g} {unit}/g"))
    result = piga.compensate(run, given(unit, K, 1e-6 * K))
    truth = tumble.force()[2][:, 0]
    seen = np.isfinite(result.ax) & (np.arange(run.size) % 100 > 2)
    tolerance = 4e-12 if kind == "rate" else 3.0 / (K * tumble.step)
    assert np.abs(result.ax[seen] / G - truth[seen]).max() < tolerance
    assert not (result.flags[seen] & FLAGS["coarse"]).any()
    assert result.u_ax[seen] == pytest.approx(1e-6 * G * np.abs(truth[seen] + TRUTH["k0"]), rel=1e-2, abs=1e-8)


@pytest.mark.parametrize("name", ["k1a", "k2o"])
def test_an_interval_in_which_the_force_passes_zero(name: str) -> None:
    """Counts by the antiderivative of the model; the mean force of each interval comes back."""
    t = np.arange(40) * 0.1
    x = -1.03 + 0.5 * t
    integral = x**2 / 2.0 + 1e-3 * (x * np.abs(x) / 2.0 if name == "k1a" else np.abs(x) ** 3 / 3.0)
    truth = piga.Calibration.from_coefficients({"scale_factor": 5e9, name: 1e-3}, unit="count/s")
    force = G * np.stack((x, 0.0 * x, 0.0 * x), axis=1)
    run = piga.Run.from_arrays(
        t, 5e9 * (integral - integral[0]) / 0.5, force, scale_factor="5e9 count/s/g", unit="count/s", units="SI"
    )
    error = piga.compensate(run, truth).ax[3:] / G - 0.5 * (x[3:] + x[2:-1])
    assert np.abs(error).max() < 2e-8


def test_what_needs_a_gimbal_is_refused(tmp_path: Path) -> None:
    run = piga.read_run(Tumble().write(tmp_path, "rate", "mA", "0.6 mA/g"))
    own, other = given("mA", 0.6), given("V", 0.6)
    with pytest.raises(piga.PigaError, match="record is in mA, that of the calibration in V"):
        piga.compensate(run, other)
    with pytest.raises(piga.PigaError, match=r"phase at power-up: only for a gyro accelerometer"):
        identify_phase(run, own, 10.0)
    with pytest.raises(piga.PigaError, match="motion of an instrument: only for a gyro"):
        own.instrument()


AXES = [
    np.roll(np.eye(3), -i, axis=0) @ np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    for i in range(3)
]
SCALES = {"mA": 0.6, "V": 2.5, "LSB": 4e6}


def members(t: np.ndarray, force: np.ndarray) -> tuple[list[piga.Run], list[Mounted]]:
    """Direct instruments in turned axes, with what each of them logs [file units] of a specific force [g]."""
    runs, mounted = [], []
    for (unit, K), axes in zip(SCALES.items(), AXES, strict=True):
        x, y, _ = axes @ force.T
        c = TRUTH
        output = K * (x + c["k0"] + c["k2"] * x**2 + c["k3"] * x**3 + c["m_Y"] * y)
        runs.append(
            piga.Run.from_arrays(
                t, output, G * force, kind="rate", scale_factor=f"{K:g} {unit}/g", unit=unit, units="SI"
            )
        )
        mounted.append(Mounted(given(unit, K, 1e-6 * K), axes))
    return runs, mounted


def test_a_set_gives_the_force_in_all_axes() -> None:
    t = 0.01 * np.arange(500)
    force = np.stack((np.cos(3.0 * t), 0.7 * np.sin(2.0 * t), 0.4 - 0.2 * t), axis=1)
    runs, mounted = members(t, force)
    result = piga.compensate_set(runs, mounted)
    assert np.abs(result.f / G - force).max() < 1e-12
    along = np.array([axes[0] for axes in AXES])
    u = 1e-6 * G * np.abs(force @ along.T + TRUTH["k0"])
    assert result.u_f == pytest.approx(np.sqrt(u**2 @ along**2), rel=2e-3, abs=2e-9)


def test_a_gyro_accelerometer_and_direct_ones_make_a_set() -> None:
    t = 0.01 * np.arange(500)
    force = np.stack((0.2 + 0.1 * np.cos(3.0 * t), np.cos(t), 0.5 * np.sin(2.0 * t)), axis=1)
    runs, mounted = members(t, force)
    K = 2.0
    gyro = piga.Calibration.from_coefficients({"scale_factor": K, "k0": 1e-3}, unit="rad/s")
    rate = K * (AXES[0][0] @ force.T + 1e-3)
    runs[0] = piga.Run.from_arrays(t, rate, G * force, kind="rate", scale_factor=f"{K:g} rad/s/g", units="SI")
    mounted[0] = Mounted(gyro, AXES[0])
    result = piga.compensate_set(runs, mounted)
    assert np.abs(result.f / G - force).max() < 1e-9
    assert (
        np.abs(result.u_f[:, 0]).max() < 3e-6 * G
    )  # that of the direct ones; the first sample of rates has one, too
