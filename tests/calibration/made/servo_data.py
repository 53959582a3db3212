"""Records of an instrument with a finite servo, from SciPy on the quasi-steady equation with its servo terms."""

from dataclasses import replace

import numpy as np
from scipy.integrate import solve_ivp

from piga.records.run import Run
from piga.records.run_file import EstimationTable
from piga.units import G0

K = 0.8885 / G0
TANGENT, PHI = 3.6e-4, 0.7
K0, K2, M_Y = 1.6e-3 * G0, 2e-7 / G0, 2.4e-4
STIFFNESS, DAMPING = 1.3e-5 / G0**2, 4e-5 / G0**2
TERMS = ["scale_factor", "tan_beta", "k0", "k2", "m_Y", "servo", "servo_damping"]
TRUTH = {
    "scale_factor": 0.8885, "tan_beta": TANGENT, "phi": PHI, "k0": 1.6e-3, "k2": 2e-7, "m_Y": M_Y, "servo": 1.3e-5,
    "servo_damping": 4e-5,
}  # fmt: skip


def rate(alpha, f, base, s=STIFFNESS, d=DAMPING):
    """alpha' of the equation, with the terms of the error model."""
    x, y, z = f
    u, v, w = x - base[0] / K, y - base[1] / K, z - base[2] / K
    across, along = v * np.sin(alpha) - w * np.cos(alpha), v * np.cos(alpha) + w * np.sin(alpha)
    shift = TANGENT * across + K0 + K2 * x**2 + M_Y * y - 2.0 * s * u * across**2 - d * u**2 * along
    return K * (u + shift)


def recorded(
    forces, seconds=12.0, step=0.25, base=None, phases=None, noise=0.0, seed=1, s=STIFFNESS, d=DAMPING
):
    """A run: constant forces (segments, 3) [m/s^2], the gimbal going on through them; base rates (segments, 3) [rad/s].

    With ``phases`` every segment has its own zero of the output.
    """
    rng = np.random.default_rng(seed)
    base = np.zeros((len(forces), 3)) if base is None else base
    times = np.arange(0.0, seconds + 0.5 * step, step)
    t, psi, f, omega, segment, alpha = [], [], [], [], [], PHI
    for index, (force, turn) in enumerate(zip(forces, base, strict=True)):
        path = solve_ivp(
            lambda _, a, force=force, turn=turn: rate(a, force, turn, s, d), (0.0, seconds), [alpha], t_eval=times,
            method="DOP853", rtol=1e-12, atol=1e-12,
        ).y[0]  # fmt: skip
        alpha = path[-1]
        psi.append(path - (PHI if phases is None else phases[index]))
        t.append(times + index * (seconds + 5.0))
        f.append(np.tile(force, (times.size, 1)))
        omega.append(np.tile(turn, (times.size, 1)))
        segment.append(np.full(times.size, index, dtype=np.int32))
    output = np.concatenate(psi)
    output = output + noise * rng.standard_normal(output.size)
    return Run.from_arrays(
        np.concatenate(t), output, np.vstack(f),
        uncertainty={"waived": {"earth_rate": "simulated at rest"}}, scale_factor=0.8884 / G0, segment=np.concatenate(segment),
        base_rate=np.vstack(omega) if np.any(base) else None, units="SI",
    )  # fmt: skip


def head(positions=12, offset=0.06):
    """Forces of a one-plane tumble at 1 g."""
    x = offset + 2.0 * np.pi * np.arange(positions) / positions
    return G0 * np.column_stack([np.cos(x), -np.sin(x), np.zeros_like(x)])


def levels(sizes=(-10.0, -8.0, 8.0, 10.0), across=1.0):
    """Forces of a centrifuge: levels along X0 [g], gravity across."""
    return G0 * np.array([[size, 0.0, across] for size in sizes])


UNNAMED = "servo that is not named"
SERVO_LEFT = "servo terms that the model lacks"
"""Rows of a budget."""


def half_width(result, source, key="scale_factor"):
    """What a row of the budget holds on either side of a coefficient."""
    (row,) = (row for row in result.budget if row.source == source)
    return abs(row.contributions[key]) * np.sqrt(3.0)


def known_noise(run, angle="1e-6 rad", walk="1e-9 rad/sqrt(s)"):
    """The record with its noise levels given."""
    return replace(run, estimation=EstimationTable(angle_rms=angle, angle_random_walk=walk))
