"""The shipped dividing-head record: a rigid-body instrument with known coefficients (issue: the main job)."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import piga
from piga.data import copy_example

pytestmark = pytest.mark.long

SERVO = 0.5 * 0.888506608**2 * 0.1 / 3000.0
"""``K ml/(2 k_i)`` [g/g^3] with H = 0.1 kg m^2/s and k_i = 3000 N m/(rad s); ``c K^2/k_i`` with c = 0.05 is the same."""
TRUTH = {"scale_factor": 0.888506608, "tan_beta": 3.587621e-4, "k0": 1.6e-3, "m_Y": 2.4e-4, "servo": SERVO}
TOLERANCE = {
    "scale_factor": 1e-7 * 0.8885,
    "tan_beta": 1e-3 * 3.5876e-4,
    "k0": 3e-7,
    "m_Y": 5e-6,
    "servo": 5e-7,
}
WITHOUT = ["scale_factor", "tan_beta", "k0", "k2", "m_Y"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shipped")
    copy_example(folder)
    return folder


def check(calibration: piga.Calibration) -> None:
    for name, value in TRUTH.items():
        assert calibration[name].value == pytest.approx(value, abs=TOLERANCE[name]), name


def test_known_coefficients(folder: Path) -> None:
    """The terms of the run file: K to 0.1 ppm, every true value in its interval, phi (truth 0) within 3 u."""
    calibration = piga.calibrate(piga.read_run(folder / "tumble-a.toml"))
    check(calibration)
    for name, value in (TRUTH | {"servo_damping": SERVO, "phi": 0.0}).items():
        assert abs(calibration[name].value - value) < calibration[name].expanded, name
    assert calibration["scale_factor"].std < 0.6e-6
    assert calibration["phi"].std < 1e-3
    assert calibration.quality.masked == 0
    assert not any("signature of a missing term" in note or "scatter" in note for note in calibration.notes)


def test_known_coefficients_with_a_phase_for_each_segment(folder: Path) -> None:
    """The damping turns nothing then that the phases do not; the stiffness is told."""
    run = piga.read_run(folder / "tumble-a.toml")
    check(piga.calibrate(run, [*WITHOUT, "servo"], phases="per-segment"))
    with pytest.raises(piga.IdentifiabilityError, match="servo_damping"):
        piga.calibrate(run, phases="per-segment")


def test_without_the_terms_of_the_servo_the_interval_of_k_holds_both_meanings(folder: Path) -> None:
    """K is 3.2 ppm low. What it is under `servo` and under `k3` lies in its interval, and both are named."""
    calibration = piga.calibrate(piga.read_run(folder / "tumble-a.toml"), WITHOUT)
    scale = calibration["scale_factor"]
    assert scale.value / TRUTH["scale_factor"] - 1.0 == pytest.approx(-3.2e-6, abs=0.7e-6)
    for name in (*WITHOUT[:3], "m_Y"):
        assert abs(calibration[name].value - TRUTH[name]) < calibration[name].expanded, name
    words = calibration.verdict.reason
    assert "the residuals show servo = " in words
    assert "servo_damping = " in words
    by_servo, by_k3 = (
        float(re.search(rf"{where} (0\.\d+)", words)[1]) for where in ("scale_factor", "of servo:")
    )
    assert by_servo == pytest.approx(TRUTH["scale_factor"], rel=1e-6)
    assert all(abs(value - scale.value) < scale.expanded for value in (by_servo, by_k3))
    phi = calibration["phi"]
    assert abs(phi.value) < phi.expanded < 2.0 * abs(phi.value)
    assert calibration.diagnostics.segment_scatter_ratio_without_it > 2.0
