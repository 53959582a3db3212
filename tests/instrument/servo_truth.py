"""Head and centrifuge records of a PIGA with its servo, from SciPy alone: nothing of ``piga`` is imported.

Rigid rotor, float and outer gimbal with integrating servo, ``w = alpha'``, ``v = beta'``::

    J_x (w' + Omega_x') + H cos(beta) (v + Omega_Y1) = ml cos(beta) (a_Y cos(alpha) + a_Z sin(alpha)) + M
    J_y (v' + Omega_Y1') + c v + k_r beta - H (cos(beta) (w + Omega_x) - sin(beta) Omega_Z1)
        = -ml (a_x cos(beta) + sin(beta) (a_Y sin(alpha) - a_Z cos(alpha)))
    M = -(k_p e + k_i z + k_d v),    z' = e = beta - beta_null

``Omega_Y1 = Omega_Y cos(alpha) + Omega_Z sin(alpha)``, ``Omega_Z1 = -Omega_Y sin(alpha) + Omega_Z cos(alpha)``.
The outside authority of the servo's tests: quantities are SI, g is 9.80665 m/s^2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.integrate import odeint

G = 9.80665
EARTH = 7.292115e-5


@dataclass(frozen=True)
class Design:
    """A PIGA; the figures are those of the project's reference case of the servo."""

    K: float = 0.8885 / G
    H: float = 0.1
    J_x: float = 1e-4
    J_y: float = 5e-5
    c: float = 0.05
    k_r: float = 0.0
    k_p: float = 30.0
    k_i: float = 3000.0
    k_d: float = 0.0
    beta: float = 0.0
    errors: dict[str, float] = field(default_factory=dict)
    """Bias ``k0`` [m/s^2] and ``k2`` [1/(m/s^2)] felt on top of a_x."""

    @property
    def ml(self):
        return self.K * self.H

    def felt(self, a_x):
        """Force along the input axis with the instrument's own errors."""
        return a_x + self.errors.get("k0", 0.0) + self.errors.get("k2", 0.0) * a_x**2


def motion(p, f, omega, alpha, t, rtol=1e-10, atol=1e-12):
    """States ``(alpha, beta, w, v, z)`` at times ``t`` [s], (n, 5), under constant force and base rate.

    ``alpha`` is the angle at ``t[0]``.

    It starts at rest in tilt, and the servo's transient dies within some 0.3 s. LSODA: after a minute it differs by
    1e-10 rad from ``solve_ivp`` with DOP853 and a tolerance of 1e-12, in a thirtieth of its time.
    """
    (a_x, a_Y, a_Z), (o_x, o_Y, o_Z) = (tuple(map(float, v)) for v in (f, omega))
    a_x = float(p.felt(a_x))
    sin, cos = math.sin, math.cos

    def rhs(_, x):
        alpha, beta, w, v, z = x.tolist()
        sa, ca, sb, cb = sin(alpha), cos(alpha), sin(beta), cos(beta)
        q, r = o_Y * ca + o_Z * sa, o_Z * ca - o_Y * sa
        e = beta - p.beta
        motor = -(p.k_p * e + p.k_i * z + p.k_d * v)
        w_dot = (p.ml * cb * (a_Y * ca + a_Z * sa) + motor - p.H * cb * (v + q)) / p.J_x
        along = a_x * cb + sb * (a_Y * sa - a_Z * ca)
        v_dot = (p.H * (cb * (w + o_x) - sb * r) - p.ml * along - p.c * v - p.k_r * beta) / p.J_y - w * r
        return (w, v, w_dot, v_dot, e)

    load = p.ml * (a_Y * cos(alpha) + a_Z * sin(alpha)) - p.H * (o_Y * cos(alpha) + o_Z * sin(alpha))
    start = [alpha, p.beta, p.K * a_x - o_x, 0.0, load / p.k_i]
    return odeint(rhs, start, t, tfirst=True, rtol=rtol, atol=atol, mxstep=100_000)


def mean_rate(p, f, turns=1, settle=1.0):
    """Mean output rate [rad/s] over whole turns, after the start has died out; the base is at rest."""
    w = p.K * float(p.felt(f[0]))
    end = settle + 2.0 * math.pi * turns / abs(w)
    near = end * (1.0 + np.linspace(-2e-3, 2e-3, 9))
    alpha = motion(p, f, (0.0, 0.0, 0.0), 0.3, np.concatenate([[0.0, settle], near]))[:, 0]
    goal = alpha[1] + math.copysign(2.0 * math.pi * turns, w)
    inverse = np.polynomial.Polynomial.fit(alpha[2:] - goal, near - settle, 6)
    return (goal - alpha[1]) / float(inverse(0.0))


def waves(p, f, omega=(0.0, 0.0, 0.0), settle=1.0):
    """What turns with the gimbal in its rate [rad/s]: mean, sine and cosine of ``theta``, of ``2 theta``.

    ``theta`` is the angle from the transverse ``u = K f - Omega``; the first number is the mean over theta less
    ``u_x``.
    """
    u = p.K * np.array([p.felt(f[0]), f[1], f[2]]) - np.asarray(omega)
    t = settle + np.linspace(0.0, 1.02 * 2.0 * math.pi / abs(u[0]), 2000)
    states = motion(p, f, omega, 0.3, np.concatenate([[0.0], t]))[1:]
    theta = states[:, 0] - math.atan2(u[2], u[1])
    basis = [np.ones(t.size)]
    for order in (1, 2, 3, 4):
        basis += [np.sin(order * theta), np.cos(order * theta)]
    return np.linalg.lstsq(np.column_stack(basis), states[:, 2] - u[0])[0][:5]


@dataclass(frozen=True)
class Record:
    """A log without noise: ``t`` (n,), ``segment`` (n,), ``alpha`` (n,), ``force`` and ``base_rate`` (n, 3)."""

    t: np.ndarray
    segment: np.ndarray
    alpha: np.ndarray
    force: np.ndarray
    base_rate: np.ndarray


def record(p, forces, rates, *, dwell, pause=30.0, sampling=0.05, settle=1.0, seed=0):
    """Segments of constant force; each begins at a gimbal angle of its own, settled."""
    forces, rates = np.asarray(forces, dtype=float), np.asarray(rates, dtype=float)
    count, size = round(dwell / sampling) + 1, len(forces)
    within = np.arange(count) * sampling
    start = np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi, size)
    times = np.concatenate([[0.0], settle + within])
    alpha = [motion(p, f, o, a, times)[1:, 0] for f, o, a in zip(forces, rates, start, strict=True)]
    segment = np.repeat(np.arange(size), count)
    t = np.tile(within, size) + segment * (dwell + pause)
    return Record(t, segment.astype(np.int32), np.concatenate(alpha), forces[segment], rates[segment])


def head_record(p, angles, *, dwell=60.0, gravity=9.8, latitude=0.7, **options):
    """A dividing head: ``f = g (cos x, -sin x, 0)``, its axis Z0 to the north."""
    forces = [(gravity * math.cos(x), -gravity * math.sin(x), 0.0) for x in angles]
    up, north = EARTH * math.sin(latitude), EARTH * math.cos(latitude)
    rates = [(up * math.cos(x), -up * math.sin(x), north) for x in angles]
    return record(p, forces, rates, dwell=dwell, **options)


def centrifuge_record(p, levels, *, dwell=20.0, gravity=9.8, **options):
    """A centrifuge whose platform keeps its direction: ``f = (level, 0, g)`` and no base rate."""
    forces = [(level, 0.0, gravity) for level in levels]
    return record(p, forces, [(0.0, 0.0, 0.0)] * len(forces), dwell=dwell, **options)
