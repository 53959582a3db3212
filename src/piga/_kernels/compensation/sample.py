r"""Compensation of one instrument with a transverse reference, sample by sample. A record is a loop over its samples.

**Angles.** With ``delta`` half the angle turned over an interval and ``alpha_m`` the middle of the two angles read, equation (4)
of the motion says, without approximation,

.. math:: A \cos\delta = 2 q\cot q\,\sin\delta - (Y \sin\alpha_m - Z \cos\alpha_m), \qquad
          q^2 = (A^2 - Y^2 - Z^2)/4 .

``Y, Z`` are known from the reference. The equation is solved for the small ``e = A - 2 delta``, so that no digit of the angle
is lost. Input that is linear between samples is converted to constant increments by the fourth-order Magnus terms. They need
the change of ``u_x``: backward differences of its means give it (three intervals; fewer at the beginning of a stretch).

**Between samples** base rate and reference are smooth. The mean of a smooth input over an interval is the mean of both ends
less ``h^2/12`` of its second derivative in the middle. The second derivative is that of the cubic through the last four
samples. For equal intervals it is the formula of Adams and Moulton:

.. math:: \bar x = \tfrac12 (x_0 + x_1) - \tfrac{h^2}{12} \ddot x, \qquad
          \ddot x = D_0 + \varrho (D_0 - D_1), \quad
          \varrho = \frac{h_0 + 2 h_1}{2 (h_0 + h_1 + h_2)} ,

``D_0`` is the second derivative from the last three samples, ``D_1`` that from one sample earlier. They are limited so that
the result does not ring (:mod:`piga._kernels.arithmetic`). The remaining error is estimated for ``u_ax``.

**Rates.** The force at a sample follows from the rate and the angle there; a missing angle is that of the exact motion.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from piga._kernels.arithmetic import bow_of, limited
from piga._kernels.compensation import data as at
from piga._kernels.compensation.data import Instrument, Past, Row, Sample, Samples, sample_of
from piga._kernels.compensation.terms import (
    STRETCHES,
    add_to_velocity,
    count_standing,
    dead_zone,
    flags_of,
    harmonics,
    invert_terms,
    see_vibration,
    uncertainty,
)
from piga._kernels.jit import Array, inline, lean
from piga._kernels.motion import advance, magnus_increments, unwrapped

_FAR_TURN = 0.25
"""Largest half turn in an interval [rad] for the series of the exact inverse."""
_FAR_PRODUCT = 1e-9
"""Largest ``(Y^2 + Z^2) delta^2`` for which two corrections reach rounding."""
_NEWTON = 60
_EVEN = 2e-4
"""Relative change of the interval up to which differences of higher order are taken (error 1e-8 of the rise)."""
_LIMITED, _NEXT_ORDER = 0.5, 0.15
"""Standard uncertainty of a second derivative, as shares of the part that the limit cut off and of its last term. For
oscillations at seven samples a period and more the mean square of error over uncertainty is 0.1 to 1.1."""
_SERIES = 9.0
"""Largest square of half the angle turned for which a bow is weighted with the angle."""
_BEGUN, _TURNED = 1.0, 7e-4
"""Standard uncertainty of a second derivative times ``h^2`` in the first interval of a stretch. Two samples give no second
derivative. The uncertainty is a share of the change (as if the input began to move at the first sample) and of the mean. The
share of the mean is for a turning point of an oscillation with 170 samples a period, where the change is small: there twice
the uncertainty covers the missing second derivative."""
FADING = 0.6
"""Share of an uncertainty kept for the next interval. During an oscillation the estimate passes through zero, the error does
not."""


class Spacing(NamedTuple):
    """Intervals around a row: ``h`` [s], ``per`` and ``per_before``: 1 over this one and the one before [1/s].

    ``weight``: 2 over the time of both [1/s]. ``ahead``: by how much of its last change a second derivative goes on to the middle
    of the interval. Where no interval lies before, the last three are 0.
    """

    h: float
    per: float
    per_before: float
    weight: float
    ahead: float


@inline
def spacing(h: float, past: Past) -> Spacing:
    """The intervals around a row."""
    h1, h2 = past.h1, past.h2
    if h1 == 0.0:
        return Spacing(h, 1.0 / h, 0.0, 0.0, 0.0)
    ahead = (h + 2.0 * h1) / (2.0 * (h + h1 + h2)) if h2 != 0.0 else 0.0
    return Spacing(h, 1.0 / h, 1.0 / h1, 2.0 / (h + h1), ahead)


@inline
def transverse(p: Instrument, now: Sample) -> tuple[float, float]:
    """Transverse input ``tan_beta u_Y``, ``tan_beta u_Z`` with the first harmonic [rad/s]."""
    return (
        p.coupling * now.a_Y + p.offset_y - p.tan_beta * now.Omega_Y,
        p.coupling * now.a_Z + p.offset_z - p.tan_beta * now.Omega_Z,
    )


@inline
def change_over(u: float, before: tuple[float, float, float], gap: Spacing, past: Past) -> tuple[float, float]:
    """Change of an input over an interval from its mean ``u`` there and the means ``before``, latest first; its possible error.

    ``d + d^2/2 + d^3/4`` of backward differences ``d`` of the means: for input that is linear between samples the series is that
    of ``2 d/(2 - d)``. Near the beginning of a stretch and where intervals differ, fewer differences are used. The last term of
    the series is the possible error. The first interval of a stretch gives no estimate.
    """
    if past.h1 == 0.0:
        return 0.0, 0.0
    u1, u2, u3 = before
    change = u - u1
    value, second = change * gap.h * gap.weight, change - (u1 - u2)
    if past.h2 == 0.0:
        return value, change
    if abs(past.h1 * gap.per - 1.0) > _EVEN:
        return value, 0.5 * second
    if past.h3 == 0.0:
        return value + 0.5 * second, 0.5 * second
    third = 0.25 * (second - ((u1 - u2) - (u2 - u3)))
    return value + 0.5 * second + third, third


@inline
def _solve_small(delta: float, square: float, coupling: float) -> tuple[float, float]:
    """``e = A - 2 delta`` for small turns and ``sin(delta)/delta``, minus its derivative by the coupling.

    Series of ``q cot q`` about ``delta^2``; ``cos(delta) - 2 delta sin(delta) c'(delta^2) = delta/sin(delta)``.
    """
    d = delta * delta
    gain = 1.0 + d * (-1 / 6 + d * (1 / 120 + d * (-1 / 5040 + d * (1 / 362880 - d / 39916800))))
    cosine = 1.0 + d * (-1 / 2 + d * (1 / 24 + d * (-1 / 720 + d * (1 / 40320 - d / 3628800))))
    first = -1 / 3 + d * (-2 / 45 + d * (-6 / 945 + d * (-4 / 4725 + d * (-10 / 93555))))
    second = -1 / 45 + d * (-6 / 945 + d * (-6 / 4725))
    weight = 2.0 * delta * gain
    e = -coupling * gain
    for _ in range(2):
        eta = delta * e + 0.25 * (e * e - square)
        e -= (e * cosine - weight * eta * (first + eta * second) + coupling) * gain
    return e, gain


@lean
def _solve_far(delta: float, square: float, coupling: float) -> float:
    """``e = A - 2 delta`` for any turn and any regime: Newton's method on the equation times ``sin q / q``."""
    sine, cosine = math.sin(delta), math.cos(delta)
    A = 2.0 * delta - coupling * (sine / delta if abs(delta) > 1e-8 else 1.0)
    for _ in range(_NEWTON):
        x = 0.25 * (square - A * A)
        if abs(x) < 1e-3:
            C = 1.0 + x * (1 / 2 + x * (1 / 24 + x * (1 / 720 + x / 40320)))
            S = 1.0 + x * (1 / 6 + x * (1 / 120 + x * (1 / 5040 + x / 362880)))
            slope = 1 / 6 + x * (1 / 60 + x * (1 / 1680 + x / 90720))
        elif x > 0.0:
            root = math.sqrt(x)
            C, S = 1.0, math.tanh(root) / root
            slope = 0.5 * (C - S) / x
        else:
            root = math.sqrt(-x)
            C, S = math.cos(root), math.sin(root) / root
            slope = 0.5 * (C - S) / x
        value = S * (A * cosine + coupling) - 2.0 * C * sine
        derivative = S * cosine - 0.5 * A * (slope * (A * cosine + coupling) - S * sine)
        correction = value / derivative
        A -= correction
        if abs(correction) <= 4e-16 * max(abs(A), abs(delta)):
            break
    return A - 2.0 * delta


@inline
def constant_input(delta: float, Y: float, Z: float, s: float, c: float) -> tuple[float, float]:
    """Integral A of ``u_x`` [rad] over an interval with constant input, and ``sin(delta)/delta``; ``s``, ``c`` in the middle."""
    square, coupling = Y * Y + Z * Z, Y * s - Z * c
    if abs(delta) > _FAR_TURN or square * delta * delta > _FAR_PRODUCT:
        gain = math.sin(delta) / delta if delta != 0.0 else 1.0
        return 2.0 * delta + _solve_far(delta, square, coupling), gain
    e, gain = _solve_small(delta, square, coupling)
    return 2.0 * delta + e, gain


@inline
def _mean_along(past: Past, gap: Spacing, x: Row) -> tuple[float, float, float]:
    """Mean ``u_x`` of an interval, its change, and the mean for constant input [rad/s].

    The Magnus terms of input that is linear in the interval are small compared with its mean. The equation is
    solved for the mean and corrected for these terms to first order (their square is below rounding).
    """
    h, y, z, dy, dz = gap.h, x.base_y, x.base_z, x.rise_y, x.rise_z
    A, gain = constant_input(x.half, h * y, h * z, x.s, x.c)
    a = A * gap.per
    rise, _ = change_over(a, (past.u1, past.u2, past.u3), gap, past)
    cross = h * h * (1.0 / 12.0)
    Y, Z = cross * (a * dz - rise * z), -cross * (a * dy - rise * y)
    bent = Y * x.s - Z * x.c - x.half * (1.0 / 3.0) * h * (y * Y + z * Z)
    return (A - (gain * bent + cross * (y * dz - z * dy))) * gap.per, rise, a


@inline
def bow(gap: Spacing, x0: float, x1: float, x2: float, bend_before: float) -> tuple[float, float, float]:
    """Mean of an input over an interval less the mean of both ends, its standard uncertainty, and its second derivative.

    ``x0, x1, x2`` are the last samples, latest first. Equal samples have no bow.
    """
    if x0 == x1 and x1 == x2 and bend_before == 0.0:
        return 0.0, 0.0, 0.0
    if gap.weight == 0.0:
        started = _BEGUN * abs(x0 - x1) + (0.5 * _TURNED * abs(x0 + x1) if x0 != x1 else 0.0)
        return 0.0, started / 12.0, 0.0
    bend = ((x0 - x1) * gap.per - (x1 - x2) * gap.per_before) * gap.weight
    value = bend + (bend - bend_before) * gap.ahead
    taken = limited(value, bend, bend_before)
    size = _LIMITED * abs(value - taken) + _NEXT_ORDER * abs(bend - bend_before)
    return bow_of(gap.h, taken), gap.h * gap.h * size * (1.0 / 12.0), bend


@inline
def _bow_share(half: float) -> float:
    """Weight of a parabola over the angle: ``3 j_1(x)/x`` with ``x`` half the angle turned (its series, 3e-4 at x = 3)."""
    x = min(half * half, _SERIES)
    return 1.0 - x * (1 / 10 - x * (1 / 280 - x * (1 / 15120 - x / 1330560)))


@inline
def read_interval(p: Instrument, past: Past, now: Sample, gap: Spacing, x: Row) -> tuple[float, float]:
    """The interval that ends at a sample of the angle: its row but for the force. Returns the bows of ``y`` and ``z`` [rad/s]."""
    y, z = transverse(p, now)
    x.h, x.per, x.turn = gap.h, gap.per, now.psi - past.psi
    x.half, x.angle = 0.5 * x.turn, p.phi - past.start + 0.5 * (past.psi + now.psi)
    x.s, x.c = math.sin(x.angle), math.cos(x.angle)
    x.v = x.turn * gap.per * p.per_K
    bow_y, left_y, bend_y = bow(gap, y, past.y, past.y_before, past.bend_y)
    bow_z, left_z, bend_z = bow(gap, z, past.z, past.z_before, past.bend_z)
    bow_x, left_x, bend_x = bow(gap, now.Omega_x, past.Omega_x, past.Omega_x_before, past.bend_x)
    x.left = left_x + left_y * abs(x.s) + left_z * abs(x.c)
    x.base_x, x.rise_x = 0.5 * (past.Omega_x + now.Omega_x) + bow_x, now.Omega_x - past.Omega_x
    x.base_y, x.rise_y = 0.5 * (past.y + y), y - past.y
    x.base_z, x.rise_z = 0.5 * (past.z + z), z - past.z
    x.Omega_Y, x.Omega_Z = 0.5 * (past.Omega_Y + now.Omega_Y), 0.5 * (past.Omega_Z + now.Omega_Z)
    x.a_Y, x.da_Y = 0.5 * (past.a_Y + now.a_Y), now.a_Y - past.a_Y
    x.a_Z, x.da_Z = 0.5 * (past.a_Z + now.a_Z), now.a_Z - past.a_Z
    x.t = 0.5 * (past.t + now.t)
    x.temperature, x.dT = 0.5 * (past.temperature + now.T), now.T - past.temperature
    before, vibration = past.vibration, now.vibration
    x.vibration = (before * (before + vibration) + vibration * vibration) * (1.0 / 3.0)
    x.y, x.z = y, z
    _keep_bends(past, now, y, z, (bend_x, bend_y, bend_z))
    return bow_y, bow_z


@inline
def read_sample(p: Instrument, past: Past, now: Sample, psi: float, angle: float, h: float, x: Row) -> None:
    """A sample of the rate, ``h`` [s] after the last one, with its angle: its row but for the force.

    Changes and half the turn, which only an interval has, stay 0 as they were made.
    """
    y, z = transverse(p, now)
    x.h, x.per = h, 1.0 / (h if h != 0.0 else p.typical)
    x.turn, x.angle = psi - past.psi, angle
    x.s, x.c = math.sin(angle), math.cos(angle)
    x.v = now.rate * p.per_K
    x.base_x, x.base_y, x.base_z, x.y, x.z = now.Omega_x, y, z, y, z
    x.Omega_Y, x.Omega_Z = now.Omega_Y, now.Omega_Z
    x.a_Y, x.a_Z, x.t, x.temperature = now.a_Y, now.a_Z, now.t, now.T
    x.vibration = now.vibration * now.vibration
    _keep_bends(past, now, y, z, (0.0, 0.0, 0.0))


@inline
def _doubt_of_interval(per_K: float, past: Past, force: float, slope: float, x: Row) -> float:
    """Uncertainty of the mean force of an interval by the motion between samples [m/s^2].

    It includes the uncertainties of the bows, and the bend of the angle between samples beyond the change of
    ``u_x`` predicted from earlier intervals. The first interval of a stretch adds nothing to the next one, because the next
    one has a second derivative. It shows no change of ``u_x``. Where the sampled input changes, a change by the mean of
    ``u_x`` is assumed. In the second interval the change itself is used.

    ``force``, ``slope``: indicated force without the base rate, and its change over the interval [m/s^2].
    """
    here, coupling = x.left * per_K, 2.0 * abs(x.base_y * x.c + x.base_z * x.s)
    bend = x.h * coupling * (1.0 / 24.0)
    if past.h1 != 0.0 and past.h2 != 0.0:
        here += bend * abs(slope - past.slope)
    else:
        change = slope if past.h1 != 0.0 else (0.0 if here == 0.0 else force)
        here += min(bend * abs(change), 0.5 * coupling * per_K)
    return max(here, FADING * past.doubt)


@inline
def _indicate_interval(p: Instrument, past: Past, now: Sample, h: float, x: Row) -> tuple[float, float]:
    """Indicated mean force over the interval that ends at a sample of the angle, and ``h^2 u_x'`` [rad]."""
    gap, per_K = spacing(h, past), p.per_K
    bow_y, bow_z = read_interval(p, past, now, gap, x)
    if p.published != 0.0:  # the published formula takes the transverse reference as straight between samples
        u = x.turn * gap.per
        u_x, rise, bow_y, bow_z = u - (x.base_y * x.s - x.base_z * x.c), 0.0, 0.0, 0.0
    else:
        u_x, rise, u = _mean_along(past, gap, x)
    slope = rise * per_K
    x.da_x, x.doubt = slope + x.rise_x * per_K, _doubt_of_interval(per_K, past, u_x * per_K, slope, x)
    force = (u_x + x.base_x - _bow_share(x.half) * (bow_y * x.s - bow_z * x.c)) * per_K
    bend = h * (u_x - past.u_x) if past.h1 != 0.0 else 0.0
    keep_interval(past, h, u, u_x, slope, x.doubt if past.h1 != 0.0 else 0.0)
    return force, bend


@inline
def keep_interval(past: Past, h: float, u: float, u_x: float, slope: float, doubt: float) -> None:
    """Keep what the next interval needs of this one."""
    past.h3, past.h2, past.h1 = past.h2, past.h1, h
    past.u3, past.u2, past.u1 = past.u2, past.u1, u
    past.u_x, past.slope, past.doubt = u_x, slope, doubt


@inline
def _keep_bends(past: Past, now: Sample, y: float, z: float, bends: tuple[float, float, float]) -> None:
    """Keep the inputs of the last two samples and their second derivatives (of Omega_x, y and z)."""
    past.bend_x, past.bend_y, past.bend_z = bends
    past.Omega_x_before, past.y_before, past.z_before = past.Omega_x, past.y, past.z
    past.Omega_x, past.y, past.z = now.Omega_x, y, z


@inline
def keep_sample(past: Past, now: Sample, psi: float, phi: float, a_x: float) -> None:
    """Keep the sample itself and the force."""
    past.seen, past.t, past.phi, past.a_x = 1.0, now.t, phi, a_x
    past.psi = psi
    past.a_Y, past.a_Z, past.temperature = now.a_Y, now.a_Z, now.T
    past.Omega_Y, past.Omega_Z, past.vibration = now.Omega_Y, now.Omega_Z, now.vibration


@lean
def _follow_rate(p: Instrument, past: Past, now: Sample, h: float) -> tuple[float, float]:
    """Turns and rest of the angle of a rate log, by the exact motion over the interval that ends at a sample.

    The input that the rate and the transverse force give at both ends of an interval drives the motion over
    it; the end value depends on the angle there, three rounds settle it.
    """
    turns, rest = past.turns, past.rest
    if past.seen == 0.0:
        return 0.0, p.phi
    if h == 0.0:
        return turns, rest
    y, z = transverse(p, now)
    half = 0.5 * rest
    sine, cosine = math.sin(half), math.cos(half)
    end_turns, end = turns, rest + h * now.rate
    for _ in range(3):
        a = now.rate - (y * math.sin(end) - z * math.cos(end))
        A, Y, Z = magnus_increments(h, past.u_x, past.y, past.z, a, y, z)
        end_turns, end, _, _ = advance(turns, rest, sine, cosine, A, Y, Z)
    return end_turns, end


@inline
def _indicate_sample(
    p: Instrument, past: Past, now: Sample, h: float, recorded: bool, x: Row
) -> tuple[float, float]:
    """Indicated force at a sample of the rate, and psi; ``recorded``: its angle is recorded, too."""
    angle, psi = p.phi + now.psi, now.psi
    if not recorded:
        past.turns, past.rest = _follow_rate(p, past, now, h)
        angle, psi = past.rest, unwrapped(past.turns, past.rest)
    read_sample(p, past, now, psi, angle, h, x)
    u_x = now.rate - (x.y * x.s - x.z * x.c)
    keep_interval(past, h, 0.0, u_x, 0.0, 0.0)
    return (u_x + now.Omega_x) * p.per_K, psi


@inline
def begin_stretch(p: Instrument, past: Past, now: Sample) -> None:
    """Keep the first angle of a stretch; it has no row."""
    y, z = transverse(p, now)
    _keep_bends(past, now, y, z, (0.0, 0.0, 0.0))
    keep_interval(past, 0.0, 0.0, 0.0, 0.0, 0.0)
    keep_sample(past, now, now.psi, p.phi, 0.0)
    past.still = 1.0


@inline
def _compensate_sample(
    p: Instrument, past: Past, now: Sample, h: float, kind: int, warm: bool, wanted: bool, x: Row, sums: Array
) -> tuple[float, float, float, int]:
    """Force [m/s^2], velocity increment [m/s], standard uncertainty of the force [m/s^2] and flags at one sample.

    Of angles means over the interval (nan, 0 and ``NO_INCREMENT`` where a stretch begins), of rates values at the sample.
    ``h``: the interval since the last one [s]; 0 where a stretch begins. ``kind``: ``ANGLE``, ``RATE``, or ``_BOTH``, a rate
    with its recorded angle. ``warm``: the temperature is recorded. ``wanted``: the uncertainty is. ``x``: room for the row.
    ``past`` and ``sums`` are updated.
    """
    if past.seen == 0.0:
        past.start = now.psi if p.published != 0.0 and kind == ANGLE else 0.0
    elif past.phi != p.phi:
        past.rest += p.phi - past.phi  # a new segment of the same stretch has its own zero
    before, psi, bend = past.a_x, now.psi, 0.0
    if kind != ANGLE:
        if h == 0.0:
            past.still = 1.0
        indicated, psi = _indicate_sample(p, past, now, h, kind == _BOTH, x)
    elif h != 0.0:
        indicated, bend = _indicate_interval(p, past, now, h, x)
    else:
        begin_stretch(p, past, now)
        sums[STRETCHES] += 1.0
        return math.nan, 0.0, math.nan, at.NO_INCREMENT
    a, derivative = invert_terms(p, x, indicated - harmonics(p, x, bend))
    x.a_x = a
    see_vibration(p, past, now.a_Y, now.a_Z, past.h1 * past.h2 * past.h3 != 0.0, kind != ANGLE, x)
    u = math.nan
    if wanted:
        dead = dead_zone(p, x)
        u = uncertainty(p, x, derivative, dead)
        add_to_velocity(sums, p, x, derivative, dead)
    flags = flags_of(p, x, warm)
    count_standing(past, now.t, flags)
    keep_sample(past, now, psi, p.phi, a)
    if kind == ANGLE:
        return a, a * h + 0.0, u, flags  # never a negative zero
    return a, 0.5 * h * (before + a) if h != 0.0 else 0.0, u, flags | (at.NO_INCREMENT if h == 0.0 else 0)


ANGLE, RATE, _BOTH = 0, 1, 2


class Rows(NamedTuple):
    """Results (n,): ``ax`` [m/s^2], ``dv`` [m/s], ``u`` [m/s^2] (may be empty) and flags.

    ``sums``: those of :func:`.terms.add_to_velocity`, updated.
    """

    ax: Array
    dv: Array
    u: Array
    flags: NDArray[np.int32]
    sums: Array


@lean
def compensate_record(
    samples: Samples, instrument: Any, base_flag: int, past: Any, row: Any, rows: Rows
) -> None:
    """Compensate the samples of one instrument, one after the other.

    ``instrument``, ``past`` and ``row`` are arrays of one record; the past is updated, the row is room. ``base_flag``: flags for
    all rows.
    """
    p, last, x = instrument[0], past[0], row[0]
    ax, dv, u, flags, sums = rows
    kind = ANGLE if samples.rate.size == 0 else (_BOTH if samples.psi.size else RATE)
    warm, wanted = samples.temperature.size > 0, u.size > 0
    for j in range(samples.t.size):
        now = sample_of(samples, 0, j, p.T_0)
        h = 0.0 if samples.begins[j] or last.seen == 0.0 else now.t - last.t
        ax[j], dv[j], doubt, flag = _compensate_sample(p, last, now, h, kind, warm, wanted, x, sums)
        if wanted:
            u[j] = doubt
        flags[j] = flag if flag == at.NO_INCREMENT and kind == ANGLE else flag | base_flag
