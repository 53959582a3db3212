"""Servo of finite stiffness: records of rigid bodies by SciPy come back to the noise."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import piga
from piga.compensation import Mounted, PhaseFinder, SetCompensator
from piga.units import G0
from tests.compensation.triads import orthogonal
from tests.compensation.twin_data import calibration_of
from tests.instrument.servo_truth import Design, motion

DESIGN = Design(beta=1e-3)
SERVO = DESIGN.K * DESIGN.ml / (2.0 * DESIGN.k_i) * G0**2
DAMPING = DESIGN.c * DESIGN.K**2 / DESIGN.k_i * G0**2
BASIC = {"scale_factor": DESIGN.K * G0, "tan_beta": np.tan(DESIGN.beta), "phi": 0.0}
WHOLE = {**BASIC, "servo": SERVO, "servo_damping": DAMPING}
RATE, SECONDS = 20.0, 7.6


@cache
def record(
    *force: float, turn: tuple[float, float, float] = (0.0, 0.0, 0.0), inertia: float = DESIGN.J_y
) -> dict[str, np.ndarray]:
    """A stationary force [g] under the servo, settled: about a revolution of angle and rate."""
    t = np.concatenate(([0.0], 1.0 + np.arange(0.0, SECONDS, 1.0 / RATE)))
    result = motion(replace(DESIGN, J_y=inertia), np.array(force) * G0, turn, 0.3, t)[1:]
    rows = np.ones((t.size - 1, 1))
    return {
        "t": t[1:], "output": result[:, 0], "rate": result[:, 2], "f": rows * np.array(force) * G0, "base_rate": rows * turn,
    }  # fmt: skip


def error(columns: dict[str, np.ndarray], values: dict[str, float], kind: str = "angle") -> np.ndarray:
    """Of the compensated force in g, row by row."""
    given = {name: columns[name] for name in ("t", "output", "f", "base_rate")}
    if kind == "rate":
        given |= {"output": columns["rate"], "angle": columns["output"]}
    rows = piga.Compensator(calibration_of(values), kind=kind).push(given)
    return (rows.ax[1:] - columns["f"][1:, 0]) / G0


@pytest.mark.parametrize("kind", ["angle", "rate"])
@pytest.mark.parametrize(
    ("force", "most"), [((1.0, 5.0, 0.0), 4e-6), ((-1.0, 5.0, 1.0), 4e-6), ((2.0, 3.0, -4.0), 16e-6)]
)
def test_a_twin_across_returns(force, most, kind):
    """5 g across turned 340 micro-g of mean, 660 at most, into 0.2 and 3; the rest is twice around, ``k_p w/k_i`` of it."""
    before, after = error(record(*force), BASIC, kind), error(record(*force), WHOLE, kind)
    assert abs(before.mean()) > 300e-6
    assert abs(after.mean()) < 0.6e-6
    assert np.abs(after).max() < most
    assert np.abs(error(record(*force), {**BASIC, "servo": SERVO}, kind)).max() > 10.0 * most


def test_a_base_that_turns():
    """The load of the servo is that of ``u = K f - Omega``; of a light rotor, whose own inertia the base does not turn."""
    columns = record(1.0, 2.0, 0.0, turn=(0.0, 0.0, 0.2), inertia=2e-7)
    assert np.abs(error(columns, BASIC)).max() > 100e-6
    assert np.abs(error(columns, WHOLE)).max() < 2e-6


def test_noise_is_what_is_left():
    """Angle noise of 2e-6 rad: squared errors over variance are 1 with the terms."""
    columns = dict(record(1.0, 5.0, 0.0))
    columns["output"] = columns["output"] + 2e-6 * np.random.default_rng(1).standard_normal(columns["t"].size)
    given = {name: columns[name] for name in ("t", "output", "f")}
    mean = {}
    for values in (BASIC, WHOLE):
        std = {name: 0.01 * values[name] for name in ("servo", "servo_damping") if name in values}
        rows = piga.Compensator(calibration_of(values, std, angle_rms=2e-6)).push(given)
        z = (rows.ax[1:] - G0) / rows.u_ax[1:]
        mean[len(values)] = float(np.mean(z**2))
    assert mean[len(BASIC)] > 30.0
    assert 0.8 < mean[len(WHOLE)] < 1.2


@pytest.mark.interpreted
def test_a_set():
    force = np.array([1.0, 2.0, -1.5])
    axes = orthogonal()
    columns = [record(*(matrix @ force)) for matrix in axes]
    left = {}
    for name, values in (("without", BASIC), ("with", WHOLE)):
        mounted = [Mounted(calibration_of(values), matrix) for matrix in axes]
        for sampled in (False, True) if name == "with" else (False,):
            stream = SetCompensator(mounted, sampled=sampled)
            rates = [c["rate"] for c in columns] if sampled else None
            rows = stream.push(columns[0]["t"], [c["output"] for c in columns], rate=rates)
            left[name, sampled] = np.abs(rows.f[1:] / G0 - force).max()
    assert left["without", False] > 100e-6
    assert max(left["with", False], left["with", True]) < 6e-6


@pytest.mark.parametrize("force", [(1.0, 1.0, 0.0), (-1.0, 5.0, 1.0), (2.0, 3.0, -4.0)])
def test_phase_at_power_up(force: tuple[float, float, float]) -> None:
    """Without the servo terms the phase is wrong by 10 to 50 mrad: the damping turns it by ``d v^2/tan_beta``."""
    columns = record(*force)
    phase = {}
    for name, values in (("without", BASIC), ("with", WHOLE)):
        finder = PhaseFinder(calibration_of(values, angle_rms=1e-6))
        output = columns["output"] - 0.7
        phase[name] = finder.push(columns["t"], output, columns["f"][:, 1], columns["f"][:, 2]).value - 0.7
    assert abs(phase["without"]) > 0.01
    assert abs(phase["with"]) < 3e-4
