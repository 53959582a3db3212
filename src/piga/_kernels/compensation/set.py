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
from piga._kernels.compensation.data import Instrument, Past, Row, Sample, Samples, sample_of
from piga._kernels.compensation.sample import (
    FADING,
    Spacing,
    begin_stretch,
    change_over,
    constant_input,
    keep_interval,
    keep_sample,
    read_interval,
    read_sample,
    spacing,
)
from piga._kernels.compensation.terms import (
    STRETCHES,
    TWELFTH,
    add_to_velocity,
    count_standing,
    dead_zone,
    error_without_powers,
    flags_of,
    harmonics,
    powers,
    see_vibration,
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


class SetState(NamedTuple):
    """What is kept of earlier rows of a set, and room for the solution of a row.

    ``past``, ``rows`` (N,): records of the instruments. ``force`` (3,): the last one. ``early[way, lag, axis]``: the last three
    estimates for a change of zero, of the plain and of the weighted solution. Force ``f``, its change ``df`` over the interval and
    the change's uncertainty ``bend``, (3,) [m/s^2]. ``inverse`` (3, 3): the inverse normal matrix, with weights ``1/u^2`` the
    covariance of the force. ``sums`` (2,): sums of squared misfits, plain and weighted.
    """

    past: Any
    rows: Any
    force: Array
    early: Array
    f: Array
    df: Array
    bend: Array
    inverse: Array
    sums: Array


def empty_state(count: int) -> SetState:
    """The state of ``count`` instruments before the first row."""
    past, rows = at.records(count, at.PAST), at.records(count, at.ROW)
    vectors = (np.zeros(shape) for shape in (3, (2, 3, 3), 3, 3, 3, (3, 3), 2))
    return SetState(past, rows, *vectors)


class SetRows(NamedTuple):
    """Results: ``force`` [m/s^2], ``dv`` [m/s], (n, 3); ``u`` (n, 3) or (0, 3): not wanted; ``flags`` (n,).

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


@lean
def _read_row(p: Instrument, past: Past, now: Sample, h: float, sampled: bool, x: Row) -> None:
    """The row of an instrument without the force, its effective axis and its harmonics."""
    if sampled:
        x.gain = 1.0
        read_sample(p, past, now, now.psi, p.phi + now.psi, h, x)
    else:
        bow_y, bow_z = read_interval(p, past, now, spacing(h, past), x)
        x.base_y, x.base_z = x.base_y + bow_y, x.base_z + bow_z
        d = x.half * x.half
        x.gain = 1.0 + d * (-1 / 6 + d * (1 / 120 + d * (-1 / 5040 + d * (1 / 362880 - d / 39916800))))
    x.weight, axes = 1.0, p.axes
    along, y, z = 1.0 + p.k1, p.tan_beta * x.gain * x.s + p.m_Y, p.m_Z - p.tan_beta * x.gain * x.c
    x.axis_x = along * axes[0, 0] + y * axes[1, 0] + z * axes[2, 0]
    x.axis_y = along * axes[0, 1] + y * axes[1, 1] + z * axes[2, 1]
    x.axis_z = along * axes[0, 2] + y * axes[1, 2] + z * axes[2, 2]
    x.harmonics = harmonics(p, x, 0.0)


@lean
def _turned(axes: Array, v: Array) -> tuple[float, float, float]:
    """A vector of the common frame in the axes of an instrument."""
    return (
        axes[0, 0] * v[0] + axes[0, 1] * v[1] + axes[0, 2] * v[2],
        axes[1, 0] * v[0] + axes[1, 1] * v[1] + axes[1, 2] * v[2],
        axes[2, 0] * v[0] + axes[2, 1] * v[1] + axes[2, 2] * v[2],
    )


@lean
def _take_force(p: Instrument, state: SetState, x: Row) -> None:
    """Force, its change over the interval and the transverse input of an instrument, from the solution."""
    x.a_x, x.a_Y, x.a_Z = _turned(p.axes, state.f)
    x.da_x, x.da_Y, x.da_Z = _turned(p.axes, state.df)
    x.y, x.z = p.coupling * x.a_Y + x.base_y, p.coupling * x.a_Z + x.base_z


@lean
def _model_error(p: Instrument, x: Row) -> None:
    """Error model at the force, the difference of the indicated force and ``a_x``, and its change over the interval."""
    x.error, x.derror = x.harmonics, 0.0
    if p.has_terms == 0.0:
        return
    a, y, z, da = x.a_x, x.a_Y, x.a_Z, x.da_x
    apart, gain = error_without_powers(p, x)
    value, slope = powers(p, a, da, gain)
    x.error += apart + value
    rise = slope * da + (p.m_Y + p.k_XY * a + 2.0 * p.k_YY * y + p.k_YZ * z) * x.da_Y
    rise += (p.m_Z + p.k_XZ * a + 2.0 * p.k_ZZ * z + p.k_YZ * y) * x.da_Z
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
def _solve_row(each: Any, gap: Spacing, sampled: bool, past: Past, early: Array, state: SetState) -> None:
    """Force of the row by rounds of least squares on the exact equations. ``early`` (3, 3) is updated."""
    rows, n, f = state.rows, state.inverse, state.f
    _invert_normal(rows, n)
    rounds = _SAMPLE_ROUNDS if sampled else _EXACT_ROUNDS
    for i in range(rows.size):
        if each[i].has_terms != 0.0:
            rounds = _TERM_ROUNDS
    f[:] = 0.0
    state.df[:] = 0.0
    for k in range(rounds):
        x = y = z = state.sums[0] = state.sums[1] = 0.0
        for i in range(rows.size):
            p, m = each[i], rows[i]
            _take_force(p, state, m)
            _model_error(p, m)
            m.misfit = _misfit_of(p, m, sampled, k == 0 and not sampled)
            pull = m.weight * m.misfit
            x, y, z = x + pull * m.axis_x, y + pull * m.axis_y, z + pull * m.axis_z
            state.sums[0] += m.misfit * m.misfit
            state.sums[1] += pull * m.misfit
        for axis in range(3):
            f[axis] += n[axis, 0] * x + n[axis, 1] * y + n[axis, 2] * z
        if k == rounds // 2 - 1 and not sampled:  # the estimate for a change of zero
            for axis in range(3):
                before = (early[0, axis], early[1, axis], early[2, axis])
                state.df[axis], state.bend[axis] = change_over(f[axis], before, gap, past)
                early[0, axis], early[1, axis], early[2, axis] = f[axis], before[0], before[1]
    for i in range(rows.size):
        _take_force(each[i], state, rows[i])


@lean
def _doubt_of(p: Instrument, past: Past, state: SetState, x: Row) -> float:
    """Uncertainty of an instrument's equation by the motion between samples [m/s^2], as that of one instrument.

    The transverse force is an unknown of the solution. The bend of the solution (3,) is the possible error of the change of the
    force over the interval. In the first interval of a stretch no sample shows a change: twice the uncertainty covers a change
    as large as the force itself, in any direction. In the second interval the sizes of the parts of the bend are added.
    """
    across, turn = x.h * (x.y * x.c + x.z * x.s), p.tan_beta * x.turn
    bend_x, bend_Y, bend_Z = _turned(p.axes, state.bend)
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
    samples: Samples, each: Any, base_flag: int, threshold: float, state: SetState, rows: SetRows
) -> None:
    """Specific force and velocity increments of a set in the common frame, row by row.

    ``each`` (N,): records of the instruments. A fault is flagged where the weighted sum of squared misfits exceeds ``threshold``.
    """
    count, sampled, wanted, first = each.size, samples.rate.shape[1] > 0, rows.u.shape[0] > 0, state.past[0]
    warm = samples.temperature.shape[1] > 0
    gap = Spacing(0.0, 0.0, 0.0, 0.0, 0.0)
    for j in range(samples.t.size):
        h = 0.0 if samples.begins[j] or first.seen == 0.0 else samples.t[j] - first.t
        if h == 0.0 and not sampled:
            _begin_stretch(j, samples, each, state, rows)
            continue
        if h != 0.0:
            gap = spacing(h, first)
        for i in range(count):
            p, past = each[i], state.past[i]
            now = sample_of(samples, i, j, p.T_0)
            _read_row(p, past, now, h, sampled, state.rows[i])
            keep_sample(past, now, now.psi, p.phi, 0.0)
        _solve_row(each, gap, sampled, first, state.early[_PLAIN], state)
        _weigh(each, sampled, wanted or count > 3, state)
        if count > 3:
            _solve_row(each, gap, sampled, first, state.early[_WEIGHTED], state)
        elif wanted:
            _invert_normal(state.rows, state.inverse)
        if wanted:
            _add_velocities(each, state, rows.sums)
        known = h != 0.0 or not math.isnan(each[0].typical)
        for axis in range(3):
            f, before = state.f[axis], state.force[axis]
            rows.force[j, axis] = state.force[axis] = f
            rows.dv[j, axis] = h * (0.5 * (before + f) if sampled else f)
            if wanted:
                rows.u[j, axis] = math.sqrt(max(state.inverse[axis, axis], 0.0)) if known else math.nan
        rows.residual[j] = math.sqrt(state.sums[0])
        none, together = at.NO_INCREMENT if h == 0.0 else 0, 0
        for i in range(count):
            past, x = state.past[i], state.rows[i]
            if h == 0.0:
                past.still = 1.0
            flag = base_flag | flags_of(each[i], x, warm)
            count_standing(past, samples.t[j], flag)
            together |= flag
            if rows.each.shape[1]:
                rows.misfits[i, j], rows.each[i, j] = x.misfit, flag | none
            keep_interval(past, h, 0.0, 0.0, 0.0, x.doubt if h != 0.0 and past.h1 != 0.0 else 0.0)
        fault = count > 3 and state.sums[1] > threshold
        rows.flags[j] = together | none | (at.FAULT if fault else 0)


@lean
def _begin_stretch(j: int, samples: Samples, each: Any, state: SetState, rows: SetRows) -> None:
    """The first angles of a stretch: a row without force."""
    for i in range(each.size):
        p = each[i]
        begin_stretch(p, state.past[i], sample_of(samples, i, j, p.T_0))
        if rows.each.shape[1]:
            rows.misfits[i, j], rows.each[i, j] = math.nan, at.NO_INCREMENT
        for axis in range(3):
            rows.sums[i, axis, STRETCHES] += 1.0
    for axis in range(3):
        rows.force[j, axis], rows.dv[j, axis] = math.nan, 0.0
        if rows.u.shape[0]:
            rows.u[j, axis] = math.nan
    rows.residual[j], rows.flags[j] = math.nan, at.NO_INCREMENT


@lean
def _weigh(each: Any, sampled: bool, wanted: bool, state: SetState) -> None:
    """Weight ``1/u^2`` of each instrument from the uncertainty of its indication, dead zone included; 1 if u is not known."""
    for i in range(each.size):
        p, past, x = each[i], state.past[i], state.rows[i]
        see_vibration(p, past, x.a_Y, x.a_Z, x.h * past.h1 * past.h2 != 0.0, sampled, x)
        if not wanted:
            continue
        if not sampled:
            x.doubt = _doubt_of(p, past, state, x)
        u = uncertainty(p, x, 1.0, dead_zone(p, x))
        x.weight = 1.0 if math.isnan(u) else 1.0 / max(u, _SMALLEST_U) ** 2


@lean
def _add_velocities(each: Any, state: SetState, sums: Array) -> None:
    """Add the row to the sums of each instrument and component; the gain is how its indication moves the component."""
    for i in range(each.size):
        x = state.rows[i]
        dead = dead_zone(each[i], x)
        for axis in range(3):
            n = state.inverse[axis]
            gain = x.weight * (n[0] * x.axis_x + n[1] * x.axis_y + n[2] * x.axis_z)
            add_to_velocity(sums[i, axis], each[i], x, gain, abs(gain) * dead)
