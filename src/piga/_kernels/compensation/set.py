r"""Compensation of a set of instruments: specific force from their effective input axes alone.

Over an interval every instrument gives one equation, nearly linear in the mean force [own derivation,
docs/theory/compensation], with ``g = sin(delta)/delta`` to leading order:

.. math:: a_x + e(f) + g \tan\beta (a_Y \sin\alpha_m - a_Z \cos\alpha_m) = \text{known} ,

At a sample with recorded rate the equation is the same with ``g = 1``. The effective axes form a normal matrix. The exact
(nonlinear) equations are satisfied by iteration with that matrix, so its condition costs no digits.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from piga._kernels.arithmetic import sine_cosine
from piga._kernels.compensation import data as at
from piga._kernels.compensation.data import Covariance, Inputs, Instrument, Past, Sample
from piga._kernels.compensation.sample import (
    EVEN,
    FADING,
    bow,
    constant_input,
    keep_bends,
    keep_interval,
    keep_sample,
    spacing,
    transverse,
)
from piga._kernels.compensation.terms import (
    TWELFTH,
    add_to_velocity,
    dead_zone,
    flags_of,
    harmonics,
    servo_error,
    size_mean,
    uncertainty,
    variance_by_coefficients,
)
from piga._kernels.compensation.vibration import rectified
from piga._kernels.jit import Array, exact

_EXACT_ROUNDS = 4
"""Rounds of intervals, the linear one first; each reduces the misfit by more than 1e4."""
_TERM_ROUNDS = 8
"""The same with an error model; each round leaves about ``2 k2 a_x`` of the misfit (0.4 % for 2e-3 per g at 1 g)."""
_SAMPLE_ROUNDS = 2
_SMALLEST_U = 1e-9
"""Least uncertainty of an instrument in the weights [m/s^2]: 0.1 ng; an instrument without uncertainty has a weight, too."""
PLAIN, _WEIGHTED = 0, 1
"""The solution with equal weights, from which the weights follow, and the one with weights."""


class _Member(Protocol):
    """What one instrument says of the row that is solved.

    ``angle``, ``s``, ``c``: angle in the middle. ``turn``, ``delta``: angle turned and half of it [rad]. ``gain``:
    sin(delta)/delta. ``rate`` [rad/s]: the output rate. ``base_x``, ``base_y``, ``base_z``: what base rate and first harmonic
    add to ``u_x`` and to the transverse input [rad/s], as means, with their changes ``rise_...``. ``left_...``: uncertainty of
    these means. ``axis_...``: effective axis in the common frame. ``harmonics``: second and higher ones [m/s^2]. ``weight``
    [s^4/m^2], ``misfit`` [m/s^2]. ``hidden``: possible rectification [m/s^2], ``shaken``: 1 in a vibration that is flagged.
    ``a_x, a_Y, a_Z`` and changes ``da_...``: the force in the instrument's axes [m/s^2].
    ``error`` and ``derror``: error model there. ``v``: output rate over K [m/s^2]. ``t`` [s]. ``temperature``, ``dT`` [K].
    ``Omega_Y``, ``Omega_Z`` [rad/s].
    """

    angle: float
    s: float
    c: float
    turn: float
    delta: float
    gain: float
    rate: float
    base_x: float
    base_y: float
    base_z: float
    rise_x: float
    rise_y: float
    rise_z: float
    left_x: float
    left_y: float
    left_z: float
    axis_x: float
    axis_y: float
    axis_z: float
    harmonics: float
    weight: float
    misfit: float
    hidden: float
    shaken: float
    a_x: float
    a_Y: float
    a_Z: float
    da_x: float
    da_Y: float
    da_Z: float
    error: float
    derror: float
    v: float
    t: float
    temperature: float
    dT: float
    Omega_Y: float
    Omega_Z: float


MEMBER = np.dtype([(name, np.float64) for name in _Member.__annotations__])


class SetSamples(NamedTuple):
    """Samples of N instruments: ``t``, ``begins`` (n,); ``psi`` (N, n); ``rate`` (N, n), or (N, 0): angles only.

    ``base_rate`` (N, n or 0, 3), ``temperature`` (N, n or 0).
    """

    t: Array
    begins: NDArray[np.bool_]
    psi: Array
    rate: Array
    base_rate: Array
    temperature: Array


class SetCovariance(NamedTuple):
    """Harmonics and covariance factors of all instruments, padded to one size; see :class:`.data.Covariance`."""

    orders: Array
    sines: Array
    cosines: Array
    codes: NDArray[np.int64]
    factors: Array


class SetPast(NamedTuple):
    """Earlier rows: ``past`` (N,) records; last ``force`` (3,); the last three estimates ``early`` (2, 3, 3) [m/s^2].

    ``early[way, lag, axis]`` is the force for a change of zero, of the plain and of the weighted solution.
    """

    past: Any
    force: Array
    early: Array


class SetRows(NamedTuple):
    """Results: ``force`` [m/s^2], ``dv`` [m/s], (n, 3); ``u`` (n, 3) or (0, 3): not wanted, empty ``flags`` alike.

    ``residual`` (n,) is the root of the sum of squared misfits [m/s^2]. ``misfits`` [m/s^2] and flags ``each`` of the
    single instruments, (N, n) or (N, 0): not wanted. ``sums`` (N, 3, SUMS): those of :func:`.terms.add_to_velocity` for each
    instrument and component, updated.
    """

    force: Array
    dv: Array
    u: Array
    residual: Array
    flags: NDArray[np.int32]
    misfits: Array
    each: NDArray[np.int32]
    sums: Array


class Solution(NamedTuple):
    """Force ``f``, its change ``df`` over the interval and the change's uncertainty ``bend``, (3,) [m/s^2].

    ``inverse`` (3, 3): the inverse normal matrix, with weights ``1/u^2`` the covariance of the force. ``sums`` (2,): sums of
    squared misfits, plain and weighted. ``regressors`` (N, MOST_TERMS) and ``doubts`` (N,) [m/s^2] of the instruments.
    """

    f: Array
    df: Array
    bend: Array
    inverse: Array
    sums: Array
    regressors: Array
    doubts: Array


def empty_solution(count: int) -> Solution:
    """Room for the solution of a set of ``count`` instruments."""
    work = np.empty((count, at.MOST_TERMS))
    return Solution(np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros(2), work, np.zeros(count))


@exact
def read_member(
    p: Instrument, more: Covariance, axes: Array, past: Past, now: Sample, h: float, sampled: bool, m: _Member
) -> None:
    """Angle, base rate, effective axis and harmonics of an instrument in the row that is solved."""
    y, z = transverse(p, now)
    m.turn = now.psi - past.psi
    if sampled:
        m.angle, m.delta, m.gain, m.rate = p.phi + now.psi, 0.0, 1.0, now.rate
        m.base_x, m.base_y, m.base_z = now.Omega_x, y, z
        m.rise_x = m.rise_y = m.rise_z = m.left_x = m.left_y = m.left_z = m.dT = 0.0
        m.t, m.temperature, m.Omega_Y, m.Omega_Z = now.t, now.T, now.Omega_Y, now.Omega_Z
        keep_bends(past, now, y, z, (0.0, 0.0, 0.0))
    else:
        gap = spacing(h, past)
        m.angle, m.delta, m.rate = p.phi + 0.5 * (past.psi + now.psi), 0.5 * m.turn, m.turn / h
        d = m.delta * m.delta
        m.gain = 1.0 + d * (-1 / 6 + d * (1 / 120 + d * (-1 / 5040 + d * (1 / 362880 - d / 39916800))))
        bow_x, m.left_x, bend_x = bow(gap, now.Omega_x, past.Omega_x, past.Omega_x_before, past.bend_x)
        bow_y, m.left_y, bend_y = bow(gap, y, past.y, past.y_before, past.bend_y)
        bow_z, m.left_z, bend_z = bow(gap, z, past.z, past.z_before, past.bend_z)
        m.base_x = 0.5 * (past.Omega_x + now.Omega_x) + bow_x
        m.base_y, m.base_z = 0.5 * (past.y + y) + bow_y, 0.5 * (past.z + z) + bow_z
        m.rise_x, m.rise_y, m.rise_z = now.Omega_x - past.Omega_x, y - past.y, z - past.z
        m.t, m.temperature, m.dT = (
            0.5 * (past.t + now.t),
            0.5 * (past.temperature + now.T),
            now.T - past.temperature,
        )
        m.Omega_Y, m.Omega_Z = 0.5 * (past.Omega_Y + now.Omega_Y), 0.5 * (past.Omega_Z + now.Omega_Z)
        keep_bends(past, now, y, z, (bend_x, bend_y, bend_z))
    m.s, m.c = sine_cosine(m.angle)
    m.v, m.weight = m.rate / p.K, 1.0
    x, y = 1.0 + p.k1, p.tan_beta * m.gain * m.s + p.m_Y
    z = p.m_Z - p.tan_beta * m.gain * m.c
    m.axis_x = x * axes[0, 0] + y * axes[1, 0] + z * axes[2, 0]
    m.axis_y = x * axes[0, 1] + y * axes[1, 1] + z * axes[2, 1]
    m.axis_z = x * axes[0, 2] + y * axes[1, 2] + z * axes[2, 2]
    m.harmonics = harmonics(more, _inputs_of(p, m, h, 0.0), 0.0) if more.orders.size else 0.0


@exact
def _inputs_of(p: Instrument, m: _Member, h: float, doubt: float) -> Inputs:
    """The inputs of the row, with all of the transverse input, for error model and uncertainty."""
    coupling = p.K * p.tan_beta
    per = 1.0 / (h if h != 0.0 else p.typical)
    return Inputs(
        h, per, m.turn, m.delta, m.angle, m.s, m.c, m.v, m.base_x, m.Omega_Y, m.Omega_Z,
        coupling * m.a_Y + m.base_y, coupling * m.a_Z + m.base_z, m.t, m.a_Y, m.a_Z, m.da_Y, m.da_Z, m.temperature, m.dT,
        m.da_x, doubt, 0.0,
    )  # fmt: skip


@exact
def _turn_force(axes: Array, solution: Solution, m: _Member) -> None:
    """Force and its change over the interval in the axes of an instrument."""
    f, d = solution.f, solution.df
    m.a_x = axes[0, 0] * f[0] + axes[0, 1] * f[1] + axes[0, 2] * f[2]
    m.a_Y = axes[1, 0] * f[0] + axes[1, 1] * f[1] + axes[1, 2] * f[2]
    m.a_Z = axes[2, 0] * f[0] + axes[2, 1] * f[1] + axes[2, 2] * f[2]
    m.da_x = axes[0, 0] * d[0] + axes[0, 1] * d[1] + axes[0, 2] * d[2]
    m.da_Y = axes[1, 0] * d[0] + axes[1, 1] * d[1] + axes[1, 2] * d[2]
    m.da_Z = axes[2, 0] * d[0] + axes[2, 1] * d[1] + axes[2, 2] * d[2]


@exact
def model_error(p: Instrument, m: _Member, h: float) -> None:
    """Error model at the force, the difference of the indicated force and ``a_x``, and its change over the interval."""
    m.error, m.derror = m.harmonics, 0.0
    if p.has_terms == 0.0:
        return
    a, y, z, da, dy, dz = m.a_x, m.a_Y, m.a_Z, m.da_x, m.da_Y, m.da_Z
    spread = da * da * TWELFTH
    value = (
        p.k0 + a * p.k1 + p.m_Y * y + p.m_Z * z + p.k2 * (a * a + spread) + p.k3 * a * (a * a + 3.0 * spread)
    )
    value += p.k2o * a * abs(a) + p.k1a * size_mean(a, da)
    value += p.k_XY * (a * y + da * dy * TWELFTH) + p.k_XZ * (a * z + da * dz * TWELFTH)
    value += p.k_YY * (y * y + dy * dy * TWELFTH) + p.k_ZZ * (z * z + dz * dz * TWELFTH)
    value += p.k_YZ * (y * z + dy * dz * TWELFTH)
    value += p.k0_t * (m.t - p.t_0) + (p.k0_T + p.k1_T * a) * m.temperature
    m.error += value
    rise = (p.k1 + 2.0 * (p.k2 * a + p.k2o * abs(a)) + 3.0 * p.k3 * a * a) * da
    rise += math.copysign(p.k1a, a) * da + p.m_Y * dy + p.m_Z * dz + 2.0 * (p.k_YY * y * dy + p.k_ZZ * z * dz)
    rise += p.k_XY * (a * dy + y * da) + p.k_XZ * (a * dz + z * da) + p.k_YZ * (y * dz + z * dy)
    rise += p.k0_t * h + (p.k0_T + p.k1_T * a) * m.dT + p.k1_T * m.temperature * da
    m.derror = rise
    if p.servo != 0.0 or p.servo_damping != 0.0:
        m.error += servo_error(p, _inputs_of(p, m, h, 0.0))


@exact
def _misfit_of_sample(p: Instrument, m: _Member) -> float:
    """Misfit of the effective-axis equation at a sample [m/s^2]."""
    y, z = p.tan_beta * m.a_Y + m.base_y / p.K, p.tan_beta * m.a_Z + m.base_z / p.K
    return (m.rate + m.base_x) / p.K - (y * m.s - z * m.c) - (m.a_x + m.error)


@exact
def _misfit_of_interval(p: Instrument, m: _Member, h: float) -> float:
    """Misfit of the exact equation of an interval [m/s^2]."""
    coupling = p.K * p.tan_beta
    a = p.K * (m.a_x + m.error) - m.base_x
    y, z = coupling * m.a_Y + m.base_y, coupling * m.a_Z + m.base_z
    da = p.K * (m.da_x + m.derror) - m.rise_x
    dy, dz = coupling * m.da_Y + m.rise_y, coupling * m.da_Z + m.rise_z
    cross = h * h / 12.0
    Y, Z = h * y + cross * (a * dz - z * da), h * z - cross * (a * dy - y * da)
    A, _ = constant_input(m.delta, Y, Z, m.s, m.c)
    return (A - (h * a + cross * (y * dz - z * dy))) / (p.K * h)


@exact
def _misfit_at_zero(p: Instrument, m: _Member) -> float:
    """Linear misfit of an interval at zero force [m/s^2]: the first round."""
    return (m.rate + m.base_x - m.gain * (m.base_y * m.s - m.base_z * m.c)) / p.K - p.k0


@exact
def _invert_normal(members: Any, solution: Solution) -> None:
    """The inverse of the weighted normal matrix of the effective axes."""
    xx = xy = xz = yy = yz = zz = 0.0
    for i in range(members.size):
        m = members[i]
        xx += m.weight * m.axis_x * m.axis_x
        xy += m.weight * m.axis_x * m.axis_y
        xz += m.weight * m.axis_x * m.axis_z
        yy += m.weight * m.axis_y * m.axis_y
        yz += m.weight * m.axis_y * m.axis_z
        zz += m.weight * m.axis_z * m.axis_z
    a, b, d = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    per = 1.0 / (xx * a + xy * b + xz * d)
    n = solution.inverse
    n[0, 0], n[1, 1], n[2, 2] = a * per, (xx * zz - xz * xz) * per, (xx * yy - xy * xy) * per
    n[0, 1] = n[1, 0] = b * per
    n[0, 2] = n[2, 0] = d * per
    n[1, 2] = n[2, 1] = (xy * xz - xx * yz) * per


@exact
def _change_of_force(h: float, past: Past, f: float, early: Array, axis: int) -> tuple[float, float]:
    """Change of a component of the force over an interval and its possible error, from its estimates there and before.

    ``d + d^2/2 + d^3/4`` of backward differences ``d``, as for one instrument (:func:`.sample.change_of_mean`). Near the
    beginning of a stretch the differences that exist are used. Where intervals differ, only the first difference is used. The
    last term of this series is the possible error. The first interval of a stretch gives no estimate.
    """
    if past.h1 == 0.0:
        return 0.0, 0.0
    u1, u2, u3 = early[0, axis], early[1, axis], early[2, axis]
    even = abs(past.h1 / h - 1.0) <= 2.0 * EVEN and past.h2 != 0.0
    change, second = f - u1, (f - u1) - (u1 - u2)
    third = second - ((u1 - u2) - (u2 - u3))
    value = change * (2.0 * h / (h + past.h1))
    if not even:
        return value, 0.5 * second if past.h2 != 0.0 else change
    if past.h3 == 0.0:
        return value + 0.5 * second, 0.5 * second
    return value + 0.5 * second + 0.25 * third, 0.25 * third


@exact
def _solve_row(
    instruments: Any,
    axes: Array,
    members: Any,
    past: Past,
    h: float,
    sampled: bool,
    early: Array,
    solution: Solution,
) -> None:
    """Force of the row by rounds of least squares on the exact equations. ``early`` (3, 3) is updated."""
    _invert_normal(members, solution)
    rounds = _SAMPLE_ROUNDS if sampled else _EXACT_ROUNDS
    for i in range(instruments.size):
        if instruments[i].has_terms != 0.0:
            rounds = _TERM_ROUNDS
    solution.f[:] = 0.0
    solution.df[:] = 0.0
    n = solution.inverse
    for k in range(rounds):
        x = y = z = solution.sums[0] = solution.sums[1] = 0.0
        for i in range(members.size):
            p, m = instruments[i], members[i]
            _turn_force(axes[i], solution, m)
            model_error(p, m, h)
            if sampled:
                m.misfit = _misfit_of_sample(p, m)
            else:
                m.misfit = _misfit_at_zero(p, m) if k == 0 else _misfit_of_interval(p, m, h)
            pull = m.weight * m.misfit
            x, y, z = x + pull * m.axis_x, y + pull * m.axis_y, z + pull * m.axis_z
            solution.sums[0] += m.misfit * m.misfit
            solution.sums[1] += pull * m.misfit
        for axis in range(3):
            solution.f[axis] += n[axis, 0] * x + n[axis, 1] * y + n[axis, 2] * z
        if k == rounds // 2 - 1 and not sampled:  # the estimate for a change of zero
            for axis in range(3):
                f = solution.f[axis]
                solution.df[axis], solution.bend[axis] = _change_of_force(h, past, f, early, axis)
                early[2, axis], early[1, axis], early[0, axis] = early[1, axis], early[0, axis], f


@exact
def _doubt_of_member(p: Instrument, axes: Array, past: Past, h: float, solution: Solution, m: _Member) -> float:
    """Uncertainty of an instrument's equation by the motion between samples [m/s^2], as :func:`.sample.doubt_of_interval`.

    The transverse force is an unknown of the solution. The bend of the solution (3,) is the possible error of the change of the
    force over the interval. In the first interval of a stretch no sample shows a change: twice the uncertainty covers a change
    as large as the force itself, in any direction. In the second interval the sizes of the parts of the bend are added.
    """
    left = m.left_x + m.left_y * abs(m.s) + m.left_z * abs(m.c)
    x = _inputs_of(p, m, h, 0.0)
    across, turn = x.y * m.c + x.z * m.s, p.tan_beta * m.turn
    bend = solution.bend
    bend_x = axes[0, 0] * bend[0] + axes[0, 1] * bend[1] + axes[0, 2] * bend[2]
    bend_Y = axes[1, 0] * bend[0] + axes[1, 1] * bend[1] + axes[1, 2] * bend[2]
    bend_Z = axes[2, 0] * bend[0] + axes[2, 1] * bend[1] + axes[2, 2] * bend[2]
    along, aside = h * across * bend_x, turn * (bend_Y * m.c + bend_Z * m.s)
    if past.h1 == 0.0:
        size = math.sqrt(m.a_x * m.a_x + m.a_Y * m.a_Y + m.a_Z * m.a_Z)
        force = min((abs(h * across) + abs(turn)) * (1.0 / 24.0), 2.0 * p.tan_beta) * size
    elif past.h2 == 0.0:
        force = (abs(along) + abs(aside)) * TWELFTH
    else:
        force = abs(along - aside) * TWELFTH
    return max(left / p.K + force, FADING * past.doubt)


@exact
def weigh(p: Instrument, more: Covariance, x: Inputs, m: _Member, work: Array) -> float:
    """Weight ``1/u^2`` of an instrument from the uncertainty of its indication, dead zone included; 1 if u is not known."""
    variance = variance_by_coefficients(more, p, x, m.a_x, work) + m.hidden * m.hidden
    u = uncertainty(p, x, variance, 1.0, dead_zone(p, x.a_Y, x.a_Z, m.a_x))
    return 1.0 if math.isnan(u) else 1.0 / max(u, _SMALLEST_U) ** 2


@exact
def compensate_set(
    samples: SetSamples, instruments: Any, all_of: SetCovariance, axes: Array, base_flag: int, threshold: float,
    last: SetPast, members: Any, rows: SetRows, solution: Solution,
) -> None:  # fmt: skip
    """Specific force and velocity increments of a set in the common frame, row by row.

    ``instruments``, ``members``: arrays of N records; ``axes`` (N, 3, 3). A fault is flagged where the weighted sum of
    squared misfits exceeds ``threshold``.
    """
    count, sampled, warm = instruments.size, samples.rate.shape[1] > 0, samples.temperature.shape[1] > 0
    turning, detailed, wanted = samples.base_rate.shape[1] > 0, rows.each.shape[1] > 0, rows.u.shape[0] > 0
    work, doubts = solution.regressors, solution.doubts
    for j in range(samples.t.size):
        first = last.past[0]
        h = 0.0 if samples.begins[j] or first.seen == 0.0 else samples.t[j] - first.t
        solved = sampled or h != 0.0
        for i in range(count):
            p, past = instruments[i], last.past[i]
            now = Sample(
                samples.t[j], samples.psi[i, j], samples.rate[i, j] if sampled else 0.0, 0.0, 0.0,
                samples.base_rate[i, j, 0] if turning else 0.0, samples.base_rate[i, j, 1] if turning else 0.0,
                samples.base_rate[i, j, 2] if turning else 0.0,
                samples.temperature[i, j] - p.T_0 if warm else 0.0, 0.0,
            )  # fmt: skip
            if solved:
                read_member(p, _covariance_of(all_of, i), axes[i], past, now, h, sampled, members[i])
            else:
                y, z = transverse(p, now)
                keep_bends(past, now, y, z, (0.0, 0.0, 0.0))
            keep_sample(past, now, now.psi, p.phi, 0.0)
        if solved:
            _solve_row(instruments, axes, members, first, h, sampled, last.early[PLAIN], solution)
            for i in range(count):
                p, past, m = instruments[i], last.past[i], members[i]
                _turn_force(axes[i], solution, m)
                steady, force = h * past.h1 * past.h2 != 0.0, (m.a_x, m.a_Y, m.a_Z)
                m.hidden, shaken = rectified(p, past, force, h, steady, sampled)
                m.shaken = 1.0 if shaken else 0.0
                if wanted or count > 3:
                    if not sampled:
                        doubts[i] = _doubt_of_member(p, axes[i], last.past[i], h, solution, m)
                    m.weight = weigh(p, _covariance_of(all_of, i), _inputs_of(p, m, h, doubts[i]), m, work[i])
            if count > 3:
                _solve_row(instruments, axes, members, first, h, sampled, last.early[_WEIGHTED], solution)
            elif wanted:
                _invert_normal(members, solution)
            if wanted:
                _add_velocities(instruments, all_of, members, h, doubts, work, solution.inverse, rows.sums)
        known = h != 0.0 or not math.isnan(instruments[0].typical)
        _write_row(j, h, sampled, known, solution, last.force, rows)
        _flag_row(
            j, h, sampled, base_flag, warm, instruments, axes, members, solution, threshold, detailed, rows
        )
        for i in range(count):
            kept = doubts[i] if h != 0.0 and last.past[i].h1 != 0.0 else 0.0
            keep_interval(last.past[i], h, 0.0, 0.0, 0.0, kept)


@exact
def _add_velocities(
    instruments: Any,
    all_of: SetCovariance,
    members: Any,
    h: float,
    doubts: Array,
    work: Array,
    inverse: Array,
    sums: Array,
) -> None:
    """Add the row to the sums of each instrument and component; the gain is how its indication moves the component."""
    for i in range(instruments.size):
        p, m = instruments[i], members[i]
        dead = dead_zone(p, m.a_Y, m.a_Z, m.a_x)
        for axis in range(3):
            n = inverse[axis]
            gain = m.weight * (n[0] * m.axis_x + n[1] * m.axis_y + n[2] * m.axis_z)
            add_to_velocity(
                sums[i, axis], all_of.codes.shape[1], work[i], h, gain, doubts[i], m.hidden, abs(gain) * dead
            )


@exact
def _covariance_of(all_of: SetCovariance, i: int) -> Covariance:
    """Harmonics and covariance factor of one instrument."""
    return Covariance(all_of.orders[i], all_of.sines[i], all_of.cosines[i], all_of.codes[i], all_of.factors[i])


@exact
def _write_row(
    j: int, h: float, sampled: bool, known: bool, solution: Solution, before: Array, rows: SetRows
) -> None:
    """Force, increment, uncertainty if ``known``, and residual; ``before`` is the force of the last row, updated."""
    solved = sampled or h != 0.0
    for axis in range(3):
        f = solution.f[axis]
        mean = 0.5 * (before[axis] + f) if sampled else f
        rows.force[j, axis] = f if solved else math.nan
        rows.dv[j, axis] = mean * h if h != 0.0 else 0.0
        if rows.u.shape[0]:
            rows.u[j, axis] = (
                math.sqrt(max(solution.inverse[axis, axis], 0.0)) if solved and known else math.nan
            )
        before[axis] = f if solved else 0.0
    rows.residual[j] = math.sqrt(solution.sums[0]) if solved else math.nan


@exact
def _flag_row(
    j: int, h: float, sampled: bool, base_flag: int, warm: bool, instruments: Any, axes: Array, members: Any,
    solution: Solution, threshold: float, detailed: bool, rows: SetRows,
) -> None:  # fmt: skip
    """Flags of the row: those of each instrument at the force found, a fault, and rows without an increment."""
    if rows.flags.size == 0:
        return
    none, solved = at.NO_INCREMENT if h == 0.0 else 0, sampled or h != 0.0
    together = 0
    for i in range(instruments.size):
        p, m, flag = instruments[i], members[i], 0
        if solved:
            _turn_force(axes[i], solution, m)
            flag = base_flag | flags_of(p, _inputs_of(p, m, h, 0.0), m.a_x, warm)
            flag |= at.VIBRATION if m.shaken != 0.0 else 0
        together |= flag
        if detailed:
            rows.misfits[i, j] = m.misfit if solved else math.nan
            rows.each[i, j] = flag | none
    if solved and instruments.size > 3 and solution.sums[1] > threshold:
        together |= at.FAULT
    rows.flags[j] = together | none
