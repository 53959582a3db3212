"""The uncertainty of each single coefficient against the change of the result when that coefficient is changed."""

from __future__ import annotations

import numpy as np
import pytest

import piga
from piga._kernels.arithmetic import LIMIT
from piga._kernels.compensation.layout import TERMS
from piga.units import G0
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, run_of

PLAIN = {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.4}


@pytest.mark.compiled
@pytest.mark.parametrize("kind", ["angle", "rate"])
@pytest.mark.parametrize(
    "name", [*TERMS, "s1", "c1", "s2", "c2", "s7", "c7", "scale_factor", "tan_beta", "phi"]
)
def test_of_one_coefficient(name: str, kind: str) -> None:
    t = 0.01 * np.arange(120)
    f = G0 * np.column_stack((1.0 + 0.5 * np.sin(3.0 * t), 2.0 + np.cos(2.0 * t), -1.0 + 0.3 * t))
    warm = 293.15 + 4.0 * np.cos(t)
    run = run_of(t, f, phi=0.4, kind=kind, temperature=warm)
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


@pytest.mark.compiled
@pytest.mark.parametrize("whole", [254_647, 300_000])
def test_far_angles_are_those_near_zero(whole: int) -> None:
    """An output angle that passes the border of the fast reduction, and one beyond it, less whole turns: the same force."""
    t = 0.01 * np.arange(700)
    f = G0 * np.column_stack((1.0 + 0.2 * np.sin(3.0 * t), 2.0 + np.cos(2.0 * t), -1.0 + 0.3 * t))
    near = run_of(t, f, phi=0.4)
    turns = 2.0 * np.pi * whole
    assert (turns < LIMIT) == (whole == 254_647)
    assert turns + np.ptp(near.output) > LIMIT
    far = piga.Run.from_arrays(t, near.output + turns, f, scale_factor=K_G / G0)
    cal = calibration_of(PLAIN, {"phi": 1e-4})
    a, b = piga.compensate(near, cal), piga.compensate(far, cal)
    assert np.abs(a.ax[1:] - b.ax[1:]).max() < 4.0 * np.spacing(turns) / (
        K_G / G0 * 0.01
    )  # rounding of the angle
    np.testing.assert_allclose(b.u_ax[1:], a.u_ax[1:], rtol=1e-4)
