"""Samples of angle and rate to force and increments, nothing else asked for: one pass over the memory.

The loop reads the caller's columns and writes the caller's results; only what does not fill a tile goes through
the work array. The arithmetic is that of the stages in :mod:`piga._kernels.compensate_record`, to the bit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga._kernels import compensate_layout as at
from piga._kernels.jit import exact, kernel
from piga._kernels.sine_cosine import LIMIT, fast_sine_cosine

Array = NDArray[np.float64]

BLOCK = 4096
"""Samples between the two loops: what the second reads is still in the fast caches."""


@exact
def coupled(factor: float, force: float, offset: float) -> float:
    """``tan_beta u_Y`` [rad/s] with both roundings, as the work array holds it."""
    return factor * force + offset


@kernel
def sample_forces(psi: Array, rate: Array, y: Array, z: Array, p: Array, ax: Array) -> None:
    """``a_x`` [m/s^2] at samples by the effective input axis; whole tiles only."""
    phi, coupling = p[at.P_PHI], p[at.P_K] * p[at.P_TAN_BETA]
    offset_y, offset_z, inverse = p[at.P_OFFSET_Y], p[at.P_OFFSET_Z], 1.0 / p[at.P_K]
    far = 0
    for j in range(ax.size):
        alpha = phi + psi[j]
        sine, cosine = fast_sine_cosine(alpha)
        across = coupled(coupling, y[j], offset_y) * sine - coupled(coupling, z[j], offset_z) * cosine
        ax[j] = (rate[j] - across) * inverse
        far |= abs(alpha) > LIMIT
    if far:
        far_forces(psi, rate, y, z, p, ax)


@kernel
def far_forces(psi: Array, rate: Array, y: Array, z: Array, p: Array, ax: Array) -> None:
    """The same at angles beyond the fast reduction, by the library's functions."""
    coupling, inverse = p[at.P_K] * p[at.P_TAN_BETA], 1.0 / p[at.P_K]
    for j in range(ax.size):
        alpha = p[at.P_PHI] + psi[j]
        if abs(alpha) > LIMIT:
            across_y = coupled(coupling, y[j], p[at.P_OFFSET_Y]) * math.sin(alpha)
            ax[j] = (
                rate[j] - (across_y - coupled(coupling, z[j], p[at.P_OFFSET_Z]) * math.cos(alpha))
            ) * inverse


@exact
def rest_forces(psi: Array, rate: Array, y: Array, z: Array, p: Array, w: Array, ax: Array) -> None:
    """Fewer samples than a tile, the last one repeated: a sample is computed alike wherever it stands."""
    for j in range(at.TILE):
        k = min(j, ax.size - 1)
        w[at.PSI + j], w[at.FIRST + j] = psi[k], rate[k]
        w[at.FORCE_Y + j], w[at.FORCE_Z + j] = y[k], z[k]
    sample_forces(
        w[at.PSI : at.PSI + at.TILE], w[at.FIRST : at.FIRST + at.TILE], w[at.FORCE_Y : at.FORCE_Y + at.TILE],
        w[at.FORCE_Z : at.FORCE_Z + at.TILE], p, w[at.FORCE : at.FORCE + at.TILE],
    )  # fmt: skip
    for j in range(ax.size):
        ax[j] = w[at.FORCE + j]


@exact
def increments(t: Array, ax: Array, begins: NDArray[np.bool_], time: float, force: float, dv: Array) -> None:
    """Increments of samples of a force that is linear between them, ``time, force`` the sample before."""
    dv[0] = 0.5 * (t[0] - time) * (force + ax[0])
    start, stop, before, after, inside = t[:-1], t[1:], ax[:-1], ax[1:], dv[1:]
    for j in range(inside.size):
        inside[j] = 0.5 * (stop[j] - start[j]) * (before[j] + after[j])
    for j in range(begins.size):
        dv[j] = 0.0 if begins[j] else dv[j]


@exact
def compensate_samples(
    t: Array, rate: Array, y: Array, z: Array, begins: NDArray[np.bool_], psi: Array, p: Array, state: Array,
    w: Array, ax: Array, dv: Array,
) -> None:  # fmt: skip
    """Samples (n,) to ``ax`` [m/s^2] and ``dv`` [m/s], without error terms and base rate; state in and out."""
    n = t.size
    for start in range(0, n, BLOCK):
        stop = min(start + BLOCK, n)
        whole = start + (stop - start) // at.TILE * at.TILE
        if whole > start:
            sample_forces(
                psi[start:whole], rate[start:whole], y[start:whole], z[start:whole], p, ax[start:whole]
            )  # fmt: skip
        if stop > whole:
            rest_forces(psi[whole:stop], rate[whole:stop], y[whole:stop], z[whole:stop], p, w, ax[whole:stop])
        time, force = (t[start - 1], ax[start - 1]) if start else (state[at.S_TIME], state[at.S_FORCE])
        increments(t[start:stop], ax[start:stop], begins[start:stop], time, force, dv[start:stop])
    if n == 0:
        return
    if state[at.S_VALID] == 0.0:
        dv[0] = 0.0
    state[at.S_VALID], state[at.S_TIME], state[at.S_PSI] = 1.0, t[n - 1], psi[n - 1]
    state[at.S_FORCE_Y], state[at.S_FORCE_Z], state[at.S_FORCE] = y[n - 1], z[n - 1], ax[n - 1]
    state[at.S_FIRST] = ax[n - 1] * p[at.P_K]
