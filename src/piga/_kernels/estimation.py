"""Kernels of the estimator: regressors of the error model, whitening of their noise, and samples off the path of the output.

Regressors are integrals of the error-model terms over each sample interval.
All inputs are linear between samples. The curvature of a smooth input, its bow (:func:`smooth_bows`), is added to first order.
Row ``i`` of a block is the interval from sample ``lo + i`` to ``lo + i + 1``. Rows that begin a stretch are written as zeros.

Noise of angle increments is whitened as a first-order moving average.
An output angle has white angle noise (variance r) and angle random walk (q per second). The noise of its increment
is ``w_n + e_n - e_(n-1)``. The variance is ``q h_n + 2 r``. The covariance of neighbours is ``-r``.
In units of r, with ``kappa = q/r``, the innovations algorithm is a one-pole recursion:
``v_n = kappa h_n + 2 - 1/v_(n-1)``, ``i_n = d_n + i_(n-1)/v_(n-1)``, variance of ``i_n`` is ``r v_n``.
It restarts where a stretch begins (``h = 0``).

Samples that do not lie on the path of the output are told by one pass with two local-level filters (:func:`scan_samples`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from piga._kernels.arithmetic import (
    bow_inside,
    second_derivatives,
    share_at_end,
)
from piga._kernels.jit import Array, kernel
from piga.terms import Factor


@kernel
def half_angle_moments(x: float) -> tuple[float, float, float]:
    """Moments of ``exp(i x v)`` over v in [-1, 1], halved: of 1, v and 1 - v^2 (times 1, -i, 1).

    ``j0 = sin x / x``, ``j1 = (sin x - x cos x)/x^2`` and ``2 j1/x``: spherical Bessel functions.
    """
    if abs(x) < 0.5:  # series, since the quotients lose digits
        x2 = x * x
        j0 = 1.0 + x2 * (_J0[0] + x2 * (_J0[1] + x2 * (_J0[2] + x2 * (_J0[3] + x2 * (_J0[4] + x2 * _J0[5])))))
        ratio = _J1[0] + x2 * (
            _J1[1] + x2 * (_J1[2] + x2 * (_J1[3] + x2 * (_J1[4] + x2 * (_J1[5] + x2 * _J1[6]))))
        )
        return j0, x * ratio, 2.0 * ratio
    sine, cosine = math.sin(x), math.cos(x)
    j1 = (sine - x * cosine) / (x * x)
    return sine / x, j1, 2.0 * j1 / x


_J0 = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(1, 7))
_J1 = tuple((-1.0) ** k * (2 * k + 2) / math.factorial(2 * k + 3) for k in range(7))
"""Coefficients of the series in x^2 of ``sin x / x`` (from the second on) and of ``(sin x - x cos x)/x^3``."""


@kernel
def coupling_columns(
    psi: Array, y: Array, z: Array, bows: Array, h: Array, bend: Array, order: float, columns: Array
) -> None:
    """Product integrals of ``y(t)``, ``z(t)`` with ``exp(i order psi(t))`` (Filon's rule).

    Writes ``int (y sin - z cos)`` and ``int (y cos + z sin)``.

    Parameters
    ----------
    psi, y, z:
        (n + 1,) samples, psi in rad.
    bows:
        (2, n) bows of y and z: parabolas in the interval, which weigh by the moment of ``1 - v^2``.
    h, bend:
        (n,) intervals [s]; sags [rad] of psi against its chord at mid-interval (from the reference), to first order.
    order:
        Multiple of the angle.
    columns:
        (2, n) results.
    """
    for i in range(h.size):
        # even part j0, odd part j1 and sag of psi turn by +90 deg; the bow of the input does not
        j0, j1, sag = half_angle_moments(0.5 * order * (psi[i + 1] - psi[i]))
        angle = 0.5 * order * (psi[i] + psi[i + 1])
        s, c = math.sin(angle), math.cos(angle)
        ym, yd = 0.5 * (y[i] + y[i + 1]), 0.5 * (y[i + 1] - y[i])
        zm, zd = 0.5 * (z[i] + z[i + 1]), 0.5 * (z[i + 1] - z[i])
        ye, ze, bent = ym * j0 + 1.5 * sag * bows[0, i], zm * j0 + 1.5 * sag * bows[1, i], order * bend[i] * sag
        yo, zo = yd * j1 + ym * bent, zd * j1 + zm * bent
        columns[0, i], columns[1, i] = (
            h[i] * (s * (ye + zo) + c * (yo - ze)),
            h[i] * (c * (ye + zo) - s * (yo - ze)),
        )


def product_at(factors: tuple[Factor, ...], inputs: Mapping[str, Array]) -> Array:
    """Product of inputs (n,) by name, ``factors`` as in :data:`piga.terms.PRODUCTS`."""
    result = np.ones_like(inputs["x"])
    for factor in factors:
        result *= np.abs(inputs["x"]) if factor == "|x|" else inputs[factor]
    return result


def product_column(
    factors: tuple[Factor, ...],
    samples: Mapping[str, Array],
    middles: Mapping[str, Array],
    h: Array,
    out: Array,
) -> None:
    """Integral of a product of inputs over each interval by Simpson's rule: exact for linear inputs, bows to first order.

    ``samples`` (n + 1,) are the inputs at the samples, ``middles`` (n,) in the middle of the intervals. Where ``|x|`` has its
    kink in an interval, both sides of it are integrated.
    """
    ends = product_at(factors, samples)
    out[:] = product_at(factors, middles)
    out *= 4.0
    out += ends[:-1]
    out += ends[1:]
    out /= 6.0
    if "|x|" in factors:
        x = samples["x"]
        kinked = x[:-1] * x[1:] < 0.0
        share = np.where(kinked, x[:-1] / np.where(kinked, x[:-1] - x[1:], 1.0), 0.0)
        both = (share * ends[:-1] + (1.0 - share) * ends[1:]) / (1.0 + len(factors))
        out[kinked] = both[kinked]
    out *= h


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
"""Gauss's rule over [-1, 1]: rounding for turns up to 2 rad an interval, 1e-9 for a whole turn."""


@kernel
def servo_columns(psi: Array, w: Array, y: Array, z: Array, h: Array, bend: Array, out: Array) -> None:
    """Integrals behind the terms of the servo over each interval, all inputs linear between samples, by Gauss's rule.

    Parameters
    ----------
    psi, w, y, z:
        (n + 1,) angle of the output [rad]; ``u_x/K``, ``u_Y/K``, ``u_Z/K`` [m/s^2] at the samples.
    h, bend:
        (n,) intervals [s], 0 where none is formed; sag of psi against its chord [rad].
    out:
        (5, n), written. With ``zeta = y + i z``: integrals of ``w |zeta|^2``, of the real part and less the imaginary part
        of ``w zeta^2 exp(-2 i psi)``, of real and imaginary part of ``w^2 zeta exp(-i psi)``.
    """
    out[:] = 0.0
    for i in range(h.size):
        for node, weight in zip(_NODES, _WEIGHTS):  # noqa: B905 - the compiler knows no strict
            p, q = 0.5 * (1.0 - node), 0.5 * (1.0 + node)
            a, b, c = p * w[i] + q * w[i + 1], p * y[i] + q * y[i + 1], p * z[i] + q * z[i + 1]
            angle = p * psi[i] + q * psi[i + 1] + bend[i] * (1.0 - node * node)
            sine, cosine = math.sin(angle), math.cos(angle)
            along, across = b * cosine + c * sine, c * cosine - b * sine  # zeta exp(-i psi)
            each = 0.5 * weight * h[i] * a
            out[0, i] += each * (b * b + c * c)
            out[1, i] += each * (along * along - across * across)
            out[2, i] -= 2.0 * each * along * across
            out[3, i] += each * a * along
            out[4, i] += each * a * across


@kernel
def smooth_bows(x: Array, h: Array, before: Array, after: Array, share: Array, bend: Array, out: Array) -> None:
    """Bow ``out`` (n,) of a smooth input (n + 1,) over each interval ``h`` (n,): its mean there less that of both ends.

    At the ends of a stretch (where h is 0) from the samples on one side; 0 where a stretch has less than four samples. Weights of
    :func:`piga._kernels.arithmetic.weigh_neighbours`; ``bend`` (n,) is room.
    """
    n = h.size
    second_derivatives(x, before, after, bend)
    for i in range(n):
        out[i] = 0.0
        if h[i] == 0.0:
            continue
        preceded, followed = i > 0 and h[i - 1] != 0.0, i < n - 1 and h[i + 1] != 0.0
        if preceded and followed:
            out[i] = bow_inside(h[i], share[i], bend[i], bend[i + 1])
        elif preceded and i > 1 and h[i - 2] != 0.0:
            out[i] = bow_inside(h[i], share_at_end(h[i], h[i - 1], h[i - 2]), bend[i], bend[i - 1])
        elif followed and i < n - 2 and h[i + 2] != 0.0:
            out[i] = bow_inside(h[i], share_at_end(h[i], h[i + 1], h[i + 2]), bend[i + 1], bend[i + 2])


# -- noise of angle increments ----------------------------------------------------------------------------

LARGE, SMALL = 2.0**300, 2.0**-300
"""Size above which the recurrence of the variances is scaled down, and the scale factor."""


@kernel
def innovation_weights(
    h: Array, white: float, walk: float, previous: float, carry: Array, scale: Array
) -> float:
    """Weights of the recursion for one block.

    ``white`` = r (negative for means of a walk), ``walk`` = q. ``previous`` is the variance of the last innovation before the
    block (0 when a stretch begins). Writes ``carry[i]``: factor on the innovation before row i; ``scale[i]``: one
    over the standard deviation. Rows with ``h = 0`` get zeros; those with ``h < 0`` (samples left out) pass
    the innovation on. Returns the last variance.
    """
    kappa = walk / white if white != 0.0 else 0.0
    old, new = (1.0, previous / white) if previous > 0.0 and white != 0.0 else (0.0, 1.0)
    for i in range(h.size):  # variance of every innovation, and that of the one before (0: none, -1: passed on)
        if h[i] <= 0.0:
            scale[i] = 0.0
            carry[i] = -1.0 if h[i] < 0.0 else 0.0
            if h[i] == 0.0:
                old, new, previous = 0.0, 1.0, 0.0
            continue
        carry[i] = previous
        old, new = new, (kappa * h[i] + 2.0) * new - old
        previous = white * (new / old) if white != 0.0 else walk * h[i]
        scale[i] = previous
        if abs(new) > LARGE:
            old, new = old * SMALL, new * SMALL
    for i in range(h.size):
        before = carry[i]
        carry[i] = white / before if before > 0.0 else -before
        scale[i] = 1.0 / math.sqrt(scale[i]) if scale[i] > 0.0 else 0.0
    return previous


@kernel
def whiten(columns: Array, carry: Array, scale: Array, state: Array, out: Array) -> None:
    """Run the recursion over every row of ``columns`` (m, n); ``state`` (m,) holds the last innovations.

    Each step waits for the step before, so four rows are computed side by side. If fewer than four remain, the last one is
    repeated.
    """
    m, n = columns.shape
    for j in range(0, m, 4):
        k, p, q = min(j + 1, m - 1), min(j + 2, m - 1), min(j + 3, m - 1)
        first, second, third, fourth = state[j], state[k], state[p], state[q]
        for i in range(n):
            first = columns[j, i] + carry[i] * first
            second = columns[k, i] + carry[i] * second
            third = columns[p, i] + carry[i] * third
            fourth = columns[q, i] + carry[i] * fourth
            out[j, i] = first * scale[i]
            out[k, i] = second * scale[i]
            out[p, i] = third * scale[i]
            out[q, i] = fourth * scale[i]
        state[j], state[k], state[p], state[q] = first, second, third, fourth


@kernel
def mean_rows(columns: Array, firsts: NDArray[np.int64], after: Array, out: Array) -> None:
    """Change of the mean of each group of samples against the group before, for columns (m, n) of increments.

    ``firsts`` (G + 1,) are the first rows of the groups and n. ``after`` (m,) holds the part of each column between mean and end
    of the group before; it is updated. ``out`` is (m, G).
    """
    for j in range(columns.shape[0]):
        for g in range(firsts.size - 1):
            stop, whole, within = firsts[g + 1], 0.0, 0.0
            for i in range(firsts[g], stop):
                whole += columns[j, i]
                within += (stop - i) * columns[j, i]
            within /= max(
                stop - firsts[g], 1
            )  # the first group may be the first sample alone, without an increment
            out[j, g] = after[j] + within
            after[j] = whole - within


@kernel
def rate_sums(d: Array, h: Array, edges: NDArray[np.int64], kappa: float, out: Array) -> float:
    """Whiten residual increments ``d`` (n,) and their intervals ``h`` at ``kappa = q/r``, with r = 1, and sum by position.

    Writes ``h'Wh``, ``h'Wd`` and ``d'Wd`` of the rows between ``edges`` (G + 1,) to ``out`` (G, 3). Returns the sum of the
    logarithms of the variances of the innovations.
    """
    logarithm, product = 0.0, 1.0
    variance = unit = miss = 0.0
    for g in range(edges.size - 1):
        hh = hd = dd = 0.0
        for i in range(edges[g], edges[g + 1]):
            if h[i] <= 0.0:
                if h[i] == 0.0:
                    variance = 0.0
                continue
            gain = 1.0 / variance if variance > 0.0 else 0.0
            variance = kappa * h[i] + 2.0 - gain
            unit = h[i] + gain * unit
            miss = d[i] + gain * miss
            weight = 1.0 / variance
            hh += weight * unit * unit
            hd += weight * unit * miss
            dd += weight * miss * miss
            product *= variance
            if product > LARGE:
                logarithm += math.log(product)
                product = 1.0
        out[g, 0], out[g, 1], out[g, 2] = hh, hd, dd
    return logarithm + math.log(product)


_CONFIRM = 8
"""Samples that must agree on another level before it counts as a jump."""
PATIENCE = 2
"""Misses beyond the hits after which a candidate level is dropped."""


@kernel
def scan_samples(
    d: Array, h: Array, white: float, walk: float, limit: float, floor: float, flags: NDArray[np.int8]
) -> None:
    """Mark samples off the path: 1 left out, 2 first sample after a jump.

    ``d`` (n,) are residual increments over intervals ``h`` (0 where a stretch begins). The residual angle
    is a random walk (``walk`` per second) read with white noise (``white``): a Kalman filter of its level
    predicts every sample. One that misses by more than ``limit`` standard deviations, and ``floor`` [rad], is
    left out and does not move the filter. A second filter follows the samples that are left out; when
    CONFIRM of them do, the angle has jumped and the second filter becomes the first. In a stretch shorter than that,
    the majority decides: if more samples agree on the second level than on the first, the first ones are left out. Fewer
    than CONFIRM samples before a jump of a stretch are left out too.
    """
    member = np.zeros(_CONFIRM, dtype=np.int64)
    angle = level = variance = other = other_variance = 0.0
    hits = misses = accepted = begin = 0
    for i in range(d.size):
        flags[i] = 0
        if h[i] == 0.0:
            if i - begin < _CONFIRM and hits > accepted:
                _keep_members(flags, member[:hits], begin, i)
            angle, level, variance = 0.0, 0.0, white
            hits, accepted, begin = 0, 1, i
            continue
        angle += d[i]
        variance += walk * h[i]
        other_variance += walk * h[i]
        miss = angle - level
        expected = variance + white
        if abs(miss) <= max(limit * math.sqrt(expected), floor):
            gain = variance / expected
            level += gain * miss
            variance *= 1.0 - gain
            hits = 0
            accepted += 1
            continue
        flags[i] = 1
        miss = angle - other
        expected = other_variance + white
        if hits > 0 and abs(miss) <= max(limit * math.sqrt(expected), floor):
            gain = other_variance / expected
            other += gain * miss
            other_variance *= 1.0 - gain
            member[hits] = i
            hits += 1
            if hits == _CONFIRM:
                for k in range(_CONFIRM):
                    flags[member[k]] = 0
                if accepted < _CONFIRM:
                    for k in range(begin, member[0]):
                        flags[k] = 1
                flags[member[0]] = 2
                level, variance = other, other_variance
                hits, accepted, begin = 0, _CONFIRM, member[0]
            continue
        misses += 1
        if hits == 0 or misses > hits + PATIENCE:
            other, other_variance = angle, white
            hits, misses = 1, 0
            member[0] = i
    if d.size - begin < _CONFIRM and hits > accepted:
        _keep_members(flags, member[:hits], begin, d.size)


@kernel
def _keep_members(flags: NDArray[np.int8], member: NDArray[np.int64], begin: int, stop: int) -> None:
    """Leave out every sample of a stretch but the members of the level that most samples agree on."""
    for k in range(begin, stop):
        flags[k] = 1
    for k in range(member.size):
        flags[member[k]] = 0


@kernel
def merge_rows(columns: Array, h: Array, left_out: NDArray[np.bool_]) -> None:
    """Add the interval into each sample that is left out to the next one, in place; its own ``h`` becomes -1."""
    m, n = columns.shape
    for i in range(n):
        if not left_out[i] or h[i] == 0.0:
            continue
        onward = i + 1 < n and h[i + 1] > 0.0
        if onward:
            h[i + 1] += h[i]
        h[i] = -1.0
        for j in range(m):
            if onward:
                columns[j, i + 1] += columns[j, i]
            columns[j, i] = 0.0
