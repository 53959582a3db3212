r"""Compensation of a set of instruments: specific force from their effective input axes alone.

Over an interval every instrument gives one equation, nearly linear in the mean force [own derivation,
docs/theory/compensation], with ``g = sin(delta)/delta`` to leading order:

.. math:: a_x + e(f) + g \tan\beta (a_Y \sin\alpha_m - a_Z \cos\alpha_m) = \text{known} ,

At a sample with recorded rate the equation is the same with ``g = 1``. The effective axes form a normal matrix. The exact
(nonlinear) equations are satisfied by iteration with that matrix, so its condition costs no digits.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from piga._kernels.compensation import data as at
from piga._kernels.compensation.data import Covariance, Instrument, Past, Row, Sample
from piga._kernels.compensation.sample import (
    FADING,
    Spacing,
    change_over,
    constant_input,
    keep_bends,
    keep_interval,
    keep_sample,
    read_interval,
    read_sample,
    spacing,
    transverse,
)
from piga._kernels.compensation.terms import (
    TWELFTH,
    add_to_velocity,
    count_standing,
    dead_zone,
    error_without_powers,
    flags_of,
    harmonics,
    see_vibration,
    size_mean,
    uncertainty,
)
from piga._kernels.jit import Array, lean

_EXACT_ROUNDS = 4
"""Rounds of intervals, the linear one first; each reduces the misfit by more than 1e4."""
_TERM_ROUNDS = 8
"""The same with an error model; each round leaves about ``2 k2 a_x`` of the misfit (0.4 % for 2e-3 per g at 1 g)."""
_SAMPLE_ROUNDS = 2
_SMALLEST_U = 1e-9
"""Least uncertainty of an instrument in the weights [m/s^2]: 0.1 ng; an instrument without uncertainty has a weight, too."""
_PLAIN, _WEIGHTED = 0, 1
"""The solution with equal weights, from which the weights follow, and the one with weights."""


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


class Instruments(NamedTuple):
    """Constants of N instruments: an array of records, and the fields of :class:`.data.Covariance` padded to one size.

    ``axes`` (N, 3, 3): rows X0, Y0, Z0 of each in the common frame.
    """

    each: Any
    orders: Array
    sines: Array
    cosines: Array
    codes: NDArray[np.int64]
    factors: Array
    axes: Array


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
    squared misfits, plain and weighted. ``rows`` (N,): records of the row; ``regressors`` (N, MOST_TERMS).
    """

    f: Array
    df: Array
    bend: Array
    inverse: Array
    sums: Array
    rows: Any
    regressors: Array


def empty_solution(count: int) -> Solution:
    """Room for the solution of a set of ``count`` instruments."""
    rows, regressors = at.records(count, at.ROW), np.empty((count, at.MOST_TERMS))
    return Solution(np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros(2), rows, regressors)


@lean
def _covariance_of(of: Instruments, i: int) -> Covariance:
    """Harmonics and covariance factor of one instrument."""
    return Covariance(of.orders[i], of.sines[i], of.cosines[i], of.codes[i], of.factors[i])


@lean
def _read_row(of: Instruments, i: int, past: Past, now: Sample, h: float, sampled: bool, x: Row) -> None:
    """The row of an instrument without the force, its effective axis and its harmonics."""
    p, axes = of.each[i], of.axes[i]
    if sampled:
        x.gain = 1.0
        read_sample(p, past, now, now.psi, p.phi + now.psi, h, x)
    else:
        bow_y, bow_z = read_interval(p, past, now, spacing(h, past), x)
        x.base_y, x.base_z = x.base_y + bow_y, x.base_z + bow_z
        d = x.half * x.half
        x.gain = 1.0 + d * (-1 / 6 + d * (1 / 120 + d * (-1 / 5040 + d * (1 / 362880 - d / 39916800))))
    x.weight = 1.0
    along, y, z = 1.0 + p.k1, p.tan_beta * x.gain * x.s + p.m_Y, p.m_Z - p.tan_beta * x.gain * x.c
    x.axis_x = along * axes[0, 0] + y * axes[1, 0] + z * axes[2, 0]
    x.axis_y = along * axes[0, 1] + y * axes[1, 1] + z * axes[2, 1]
    x.axis_z = along * axes[0, 2] + y * axes[1, 2] + z * axes[2, 2]
    x.harmonics = harmonics(_covariance_of(of, i), x, 0.0) if of.orders.shape[1] else 0.0


@lean
def _turned(axes: Array, v: Array) -> tuple[float, float, float]:
    """A vector of the common frame in the axes of an instrument."""
    return (
        axes[0, 0] * v[0] + axes[0, 1] * v[1] + axes[0, 2] * v[2],
        axes[1, 0] * v[0] + axes[1, 1] * v[1] + axes[1, 2] * v[2],
        axes[2, 0] * v[0] + axes[2, 1] * v[1] + axes[2, 2] * v[2],
    )


@lean
def _take_force(p: Instrument, axes: Array, solution: Solution, x: Row) -> None:
    """Force, its change over the interval and the transverse input of an instrument, from the solution."""
    x.a_x, x.a_Y, x.a_Z = _turned(axes, solution.f)
    x.da_x, x.da_Y, x.da_Z = _turned(axes, solution.df)
    x.y, x.z = p.coupling * x.a_Y + x.base_y, p.coupling * x.a_Z + x.base_z


@lean
def _model_error(p: Instrument, x: Row) -> None:
    """Error model at the force, the difference of the indicated force and ``a_x``, and its change over the interval."""
    x.error, x.derror = x.harmonics, 0.0
    if p.has_terms == 0.0:
        return
    a, y, z, da, dy, dz = x.a_x, x.a_Y, x.a_Z, x.da_x, x.da_Y, x.da_Z
    apart, gain = error_without_powers(p, x)
    square, spread = a * a, da * da * TWELFTH
    x.error += apart + gain * a + p.k2 * (square + spread) + p.k3 * a * (square + 3.0 * spread)
    x.error += p.k2o * a * abs(a) + p.k1a * size_mean(a, da)
    rise = (gain + 2.0 * (p.k2 * a + p.k2o * abs(a)) + 3.0 * p.k3 * square + math.copysign(p.k1a, a)) * da
    rise += (p.m_Y + p.k_XY * a + 2.0 * p.k_YY * y + p.k_YZ * z) * dy
    rise += (p.m_Z + p.k_XZ * a + 2.0 * p.k_ZZ * z + p.k_YZ * y) * dz
    x.derror = rise + p.k0_t * x.h + (p.k0_T + p.k1_T * a) * x.dT


@lean
def _misfit_of(p: Instrument, x: Row, sampled: bool, linear: bool) -> float:
    """Misfit of the exact equation of an interval, or of a sample [m/s^2]; ``linear``: that of an interval at zero force."""
    if linear:
        return x.v + (x.base_x - x.gain * (x.base_y * x.s - x.base_z * x.c)) * p.per_K - p.k0
    if sampled:
        return x.v + (x.base_x - (x.y * x.s - x.z * x.c)) * p.per_K - (x.a_x + x.error)
    h = x.h
    a, da = p.K * (x.a_x + x.error) - x.base_x, p.K * (x.da_x + x.derror) - x.rise_x
    y, z, dy, dz = x.y, x.z, p.coupling * x.da_Y + x.rise_y, p.coupling * x.da_Z + x.rise_z
    cross = h * h / 12.0
    Y, Z = h * y + cross * (a * dz - z * da), h * z - cross * (a * dy - y * da)
    A, _ = constant_input(x.half, Y, Z, x.s, x.c)
    return (A - (h * a + cross * (y * dz - z * dy))) * x.per * p.per_K


@lean
def _invert_normal(rows: Any, n: Array) -> None:
    """The inverse ``n`` of the weighted normal matrix of the effective axes."""
    xx = xy = xz = yy = yz = zz = 0.0
    for i in range(rows.size):
        m = rows[i]
        x, y, z, weight = m.axis_x, m.axis_y, m.axis_z, m.weight
        xx, xy, xz = xx + weight * x * x, xy + weight * x * y, xz + weight * x * z
        yy, yz, zz = yy + weight * y * y, yz + weight * y * z, zz + weight * z * z
    a, b, d = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    per = 1.0 / (xx * a + xy * b + xz * d)
    n[0, 0], n[1, 1], n[2, 2] = a * per, (xx * zz - xz * xz) * per, (xx * yy - xy * xy) * per
    n[0, 1] = n[1, 0] = b * per
    n[0, 2] = n[2, 0] = d * per
    n[1, 2] = n[2, 1] = (xy * xz - xx * yz) * per


@lean
def _solve_row(
    of: Instruments, gap: Spacing, sampled: bool, past: Past, early: Array, solution: Solution
) -> None:
    """Force of the row by rounds of least squares on the exact equations. ``early`` (3, 3) is updated."""
    rows, n, f = solution.rows, solution.inverse, solution.f
    _invert_normal(rows, n)
    rounds = _SAMPLE_ROUNDS if sampled else _EXACT_ROUNDS
    for i in range(rows.size):
        if of.each[i].has_terms != 0.0:
            rounds = _TERM_ROUNDS
    f[:] = 0.0
    solution.df[:] = 0.0
    for k in range(rounds):
        x = y = z = solution.sums[0] = solution.sums[1] = 0.0
        for i in range(rows.size):
            p, m = of.each[i], rows[i]
            _take_force(p, of.axes[i], solution, m)
            _model_error(p, m)
            m.misfit = _misfit_of(p, m, sampled, k == 0 and not sampled)
            pull = m.weight * m.misfit
            x, y, z = x + pull * m.axis_x, y + pull * m.axis_y, z + pull * m.axis_z
            solution.sums[0] += m.misfit * m.misfit
            solution.sums[1] += pull * m.misfit
        for axis in range(3):
            f[axis] += n[axis, 0] * x + n[axis, 1] * y + n[axis, 2] * z
        if k == rounds // 2 - 1 and not sampled:  # the estimate for a change of zero
            for axis in range(3):
                before = (early[0, axis], early[1, axis], early[2, axis])
                solution.df[axis], solution.bend[axis] = change_over(f[axis], before, gap, past)
                early[0, axis], early[1, axis], early[2, axis] = f[axis], before[0], before[1]
    for i in range(rows.size):
        _take_force(of.each[i], of.axes[i], solution, rows[i])


@lean
def _doubt_of(p: Instrument, axes: Array, past: Past, solution: Solution, x: Row) -> float:
    """Uncertainty of an instrument's equation by the motion between samples [m/s^2], as that of one instrument.

    The transverse force is an unknown of the solution. The bend of the solution (3,) is the possible error of the change of the
    force over the interval. In the first interval of a stretch no sample shows a change: twice the uncertainty covers a change
    as large as the force itself, in any direction. In the second interval the sizes of the parts of the bend are added.
    """
    across, turn = x.h * (x.y * x.c + x.z * x.s), p.tan_beta * x.turn
    bend_x, bend_Y, bend_Z = _turned(axes, solution.bend)
    along, aside = across * bend_x, turn * (bend_Y * x.c + bend_Z * x.s)
    if past.h1 == 0.0:
        size = math.sqrt(x.a_x * x.a_x + x.a_Y * x.a_Y + x.a_Z * x.a_Z)
        force = min((abs(across) + abs(turn)) * (1.0 / 24.0), 2.0 * p.tan_beta) * size
    elif past.h2 == 0.0:
        force = (abs(along) + abs(aside)) * TWELFTH
    else:
        force = abs(along - aside) * TWELFTH
    return max(x.left * p.per_K + force, FADING * past.doubt)


@lean
def compensate_set(
    samples: SetSamples,
    of: Instruments,
    base_flag: int,
    threshold: float,
    last: SetPast,
    rows: SetRows,
    solution: Solution,
) -> None:
    """Specific force and velocity increments of a set in the common frame, row by row.

    A fault is flagged where the weighted sum of squared misfits exceeds ``threshold``.
    """
    count, sampled, warm = of.each.size, samples.rate.shape[1] > 0, samples.temperature.shape[1] > 0
    turning, wanted, first = samples.base_rate.shape[1] > 0, rows.u.shape[0] > 0, last.past[0]
    for j in range(samples.t.size):
        h = 0.0 if samples.begins[j] or first.seen == 0.0 else samples.t[j] - first.t
        solved = sampled or h != 0.0
        gap = spacing(h, first) if h != 0.0 else Spacing(0.0, 0.0, 0.0, 0.0, 0.0)
        for i in range(count):
            p, past = of.each[i], last.past[i]
            now = Sample(
                samples.t[j], samples.psi[i, j], samples.rate[i, j] if sampled else 0.0, 0.0, 0.0,
                samples.base_rate[i, j, 0] if turning else 0.0, samples.base_rate[i, j, 1] if turning else 0.0,
                samples.base_rate[i, j, 2] if turning else 0.0,
                samples.temperature[i, j] - p.T_0 if warm else 0.0, 0.0,
            )  # fmt: skip
            if solved:
                _read_row(of, i, past, now, h, sampled, solution.rows[i])
            else:
                y, z = transverse(p, now)
                keep_bends(past, now, y, z, (0.0, 0.0, 0.0))
            keep_sample(past, now, now.psi, p.phi, 0.0)
        if solved:
            _solve_row(of, gap, sampled, first, last.early[_PLAIN], solution)
            _weigh(of, sampled, wanted or count > 3, last.past, solution)
            if count > 3:
                _solve_row(of, gap, sampled, first, last.early[_WEIGHTED], solution)
            elif wanted:
                _invert_normal(solution.rows, solution.inverse)
            if wanted:
                _add_velocities(of, solution, rows.sums)
        _write_row(j, h, solved, sampled, solution, last.force, rows)
        if solved and wanted and h == 0.0 and math.isnan(of.each[0].typical):
            rows.u[j, :] = math.nan
        if rows.flags.size:
            _flag_row(j, h, samples.t[j], solved, base_flag, threshold, warm, of, last.past, solution, rows)
        for i in range(count):
            past = last.past[i]
            kept = solution.rows[i].doubt if h != 0.0 and past.h1 != 0.0 else 0.0
            keep_interval(past, h, 0.0, 0.0, 0.0, kept)


@lean
def _weigh(of: Instruments, sampled: bool, wanted: bool, pasts: Any, solution: Solution) -> None:
    """Weight ``1/u^2`` of each instrument from the uncertainty of its indication, dead zone included; 1 if u is not known."""
    for i in range(of.each.size):
        p, past, x = of.each[i], pasts[i], solution.rows[i]
        see_vibration(p, past, x.a_Y, x.a_Z, x.h * past.h1 * past.h2 != 0.0, sampled, x)
        if not wanted:
            continue
        if not sampled:
            x.doubt = _doubt_of(p, of.axes[i], past, solution, x)
        u = uncertainty(p, _covariance_of(of, i), x, 1.0, dead_zone(p, x), solution.regressors[i])
        x.weight = 1.0 if math.isnan(u) else 1.0 / max(u, _SMALLEST_U) ** 2


@lean
def _add_velocities(of: Instruments, solution: Solution, sums: Array) -> None:
    """Add the row to the sums of each instrument and component; the gain is how its indication moves the component."""
    for i in range(of.each.size):
        x = solution.rows[i]
        dead = dead_zone(of.each[i], x)
        for axis in range(3):
            n = solution.inverse[axis]
            gain = x.weight * (n[0] * x.axis_x + n[1] * x.axis_y + n[2] * x.axis_z)
            add_to_velocity(sums[i, axis], of.codes.shape[1], solution.regressors[i], x, gain, abs(gain) * dead)


@lean
def _write_row(
    j: int, h: float, solved: bool, sampled: bool, solution: Solution, before: Array, rows: SetRows
) -> None:
    """Force, increment, uncertainty and residual of a row; ``before`` is the force of the last row, updated."""
    for axis in range(3):
        f = solution.f[axis]
        mean = 0.5 * (before[axis] + f) if sampled else f
        rows.force[j, axis] = f if solved else math.nan
        rows.dv[j, axis] = mean * h if h != 0.0 else 0.0
        if rows.u.shape[0]:
            rows.u[j, axis] = math.sqrt(max(solution.inverse[axis, axis], 0.0)) if solved else math.nan
        before[axis] = f if solved else 0.0
    rows.residual[j] = math.sqrt(solution.sums[0]) if solved else math.nan


@lean
def _flag_row(
    j: int, h: float, t: float, solved: bool, base_flag: int, threshold: float, warm: bool, of: Instruments, pasts: Any,
    solution: Solution, rows: SetRows,
) -> None:  # fmt: skip
    """Flags of the row: those of each instrument at the force found, a fault, and rows without an increment."""
    none, together = at.NO_INCREMENT if h == 0.0 else 0, 0
    for i in range(of.each.size):
        x = solution.rows[i]
        if h == 0.0:
            pasts[i].still = 1.0
        flag = base_flag | flags_of(of.each[i], x, warm) if solved else 0
        if solved:
            count_standing(pasts[i], t, flag)
        together |= flag
        if rows.each.shape[1]:
            rows.misfits[i, j] = x.misfit if solved else math.nan
            rows.each[i, j] = flag | none
    if solved and of.each.size > 3 and solution.sums[1] > threshold:
        together |= at.FAULT
    rows.flags[j] = together | none
