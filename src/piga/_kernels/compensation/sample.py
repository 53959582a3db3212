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

from piga._kernels.arithmetic import bow_of, limited, sine_cosine
from piga._kernels.compensation import data as at
from piga._kernels.compensation.data import Covariance, Inputs, Instrument, Past, Sample
from piga._kernels.compensation.terms import (
    STRETCHES,
    add_to_velocity,
    dead_zone,
    flags_of,
    harmonics,
    invert_terms,
    uncertainty,
    variance_by_coefficients,
)
from piga._kernels.compensation.vibration import rectified
from piga._kernels.jit import Array, exact, inline_exact
from piga._kernels.motion.step import advance, magnus_increments, unwrapped

_FAR_TURN = 0.25
"""Largest half turn in an interval [rad] for the series of the exact inverse."""
_FAR_PRODUCT = 1e-9
"""Largest ``(Y^2 + Z^2) delta^2`` for which two corrections reach rounding."""
_NEWTON = 60
EVEN = 1e-4
"""Half the relative change of the interval up to which a series replaces a division (error 1e-8 of the rise)."""
LIMITED, _NEXT_ORDER = 0.5, 0.15
"""Standard uncertainty of a second derivative, as shares of the part that the limit cut off and of its last term. For
oscillations at seven samples a period and more the mean square of error over uncertainty is 0.1 to 1.1."""
_SERIES = 9.0
"""Largest square of half the angle turned for which a bow is weighted with the angle."""
_BEGUN, TURNED = 1.0, 7e-4
"""Standard uncertainty of a second derivative times ``h^2`` in the first interval of a stretch. Two samples give no second
derivative. The uncertainty is a share of the change (as if the input began to move at the first sample) and of the mean. The
share of the mean is for a turning point of an oscillation with 170 samples a period, where the change is small: there twice
the uncertainty covers the missing second derivative."""
FADING = 0.6
"""Share of an uncertainty kept for the next interval. During an oscillation the estimate passes through zero, the error does
not."""


class Indication(NamedTuple):
    """Mean specific force along X0 that the output indicates [m/s^2], the inputs of its interval, and ``h^2 u_x'`` [rad].

    ``psi``: the angle at the end [rad].
    """

    force: float
    inputs: Inputs
    bend: float
    psi: float


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


@inline_exact
def spacing(h: float, past: Past) -> Spacing:
    """The intervals around a row."""
    h1, h2 = past.h1, past.h2
    if h1 == 0.0:
        return Spacing(h, 1.0 / h, 0.0, 0.0, 0.0)
    ahead = (h + 2.0 * h1) / (2.0 * (h + h1 + h2)) if h2 != 0.0 else 0.0
    return Spacing(h, 1.0 / h, 1.0 / h1, 2.0 / (h + h1), ahead)


@inline_exact
def transverse(p: Instrument, now: Sample) -> tuple[float, float]:
    """Transverse input ``tan_beta u_Y``, ``tan_beta u_Z`` with the first harmonic [rad/s]."""
    coupling = p.K * p.tan_beta
    return (
        coupling * now.a_Y + p.offset_y - p.tan_beta * now.Omega_Y,
        coupling * now.a_Z + p.offset_z - p.tan_beta * now.Omega_Z,
    )


@inline_exact
def change_of_mean(u: float, gap: Spacing, past: Past) -> float:
    """Change of ``u_x`` over an interval [rad/s] from its mean ``u`` there and the means before.

    ``d + d^2/2 + d^3/4`` of backward differences ``d`` of the means: for input that is linear between samples the series is that
    of ``2 d/(2 - d)``. Near the beginning of a stretch and where intervals differ, fewer differences are used.
    """
    if past.h1 == 0.0:
        return 0.0
    change, before = u - past.u1, past.u1 - past.u2
    x = 0.5 * (past.h1 * gap.per - 1.0)
    even = abs(x) <= EVEN and past.h2 != 0.0
    if even and past.h3 != 0.0:
        second = change - before
        return change - change * x + 0.5 * second + 0.25 * (second - (before - (past.u2 - past.u3)))
    return change * gap.h * gap.weight + (0.5 * (change - before) if even else 0.0)


@inline_exact
def solve_small(delta: float, square: float, coupling: float) -> tuple[float, float]:
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


@exact
def solve_far(delta: float, square: float, coupling: float) -> float:
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


@inline_exact
def constant_input(delta: float, Y: float, Z: float, s: float, c: float) -> tuple[float, float]:
    """Integral A of ``u_x`` [rad] over an interval with constant input, and ``sin(delta)/delta``; ``s``, ``c`` in the middle."""
    square, coupling = Y * Y + Z * Z, Y * s - Z * c
    if abs(delta) > _FAR_TURN or square * delta * delta > _FAR_PRODUCT:
        gain = math.sin(delta) / delta if delta != 0.0 else 1.0
        return 2.0 * delta + solve_far(delta, square, coupling), gain
    e, gain = solve_small(delta, square, coupling)
    return 2.0 * delta + e, gain


@inline_exact
def _mean_along(
    past: Past, gap: Spacing, turn: float, y: float, z: float, s: float, c: float
) -> tuple[float, float, float]:
    """Mean ``u_x`` of an interval, its change, and the mean for constant input [rad/s]; ``s``, ``c`` in the middle.

    The Magnus terms of input that is linear in the interval are small compared with its mean. The equation is
    solved for the mean and corrected for these terms to first order (their square is below rounding).
    """
    h, delta, y0, z0 = gap.h, 0.5 * turn, past.y, past.z
    mean_y, mean_z = 0.5 * (y0 + y), 0.5 * (z0 + z)
    A, gain = constant_input(delta, h * mean_y, h * mean_z, s, c)
    a = A * gap.per
    rise = change_of_mean(a, gap, past)
    cross = h * h * (1.0 / 12.0)
    Y = cross * (a * (z - z0) - rise * mean_z)
    Z = -cross * (a * (y - y0) - rise * mean_y)
    bent = Y * s - Z * c - delta * (1.0 / 3.0) * h * (mean_y * Y + mean_z * Z)
    return (A - (gain * bent + cross * (y0 * z - z0 * y))) * gap.per, rise, a


@inline_exact
def bow(gap: Spacing, x0: float, x1: float, x2: float, bend_before: float) -> tuple[float, float, float]:
    """Mean of an input over an interval less the mean of both ends, its standard uncertainty, and its second derivative.

    ``x0, x1, x2`` are the last samples, latest first.
    """
    if gap.weight == 0.0:
        started = _BEGUN * abs(x0 - x1) + (0.5 * TURNED * abs(x0 + x1) if x0 != x1 else 0.0)
        return 0.0, started / 12.0, 0.0
    bend = ((x0 - x1) * gap.per - (x1 - x2) * gap.per_before) * gap.weight
    value = bend + (bend - bend_before) * gap.ahead
    taken = limited(value, bend, bend_before)
    size = LIMITED * abs(value - taken) + _NEXT_ORDER * abs(bend - bend_before)
    return bow_of(gap.h, taken), gap.h * gap.h * size * (1.0 / 12.0), bend


@inline_exact
def _bow_share(half: float) -> float:
    """Weight of a parabola over the angle: ``3 j_1(x)/x`` with ``x`` half the angle turned (its series, 3e-4 at x = 3)."""
    x = min(half * half, _SERIES)
    return 1.0 - x * (1 / 10 - x * (1 / 280 - x * (1 / 15120 - x / 1330560)))


@inline_exact
def doubt_of_interval(
    per_K: float, past: Past, seen: tuple[float, float, float], h: float, across: float, left: float
) -> float:
    """Uncertainty of the mean force of an interval by the motion between samples [m/s^2].

    It includes the uncertainties ``left`` of the bows [rad/s], and the bend of the angle between samples beyond the change of
    ``u_x`` predicted from earlier intervals. The first interval of a stretch adds nothing to the next one, because the next
    one has a second derivative. It shows no change of ``u_x``. Where the sampled input changes, a change by the mean of
    ``u_x`` is assumed. In the second interval the change itself is used.

    ``seen``: indicated force without the base rate, its change, and its change over the interval before [m/s^2].
    ``across``: twice ``tan_beta (u_Y cos + u_Z sin)`` in the middle [rad/s].
    """
    force, slope, slope_before = seen
    here, coupling = left * per_K, abs(across)
    bend = h * coupling * (1.0 / 24.0)
    if past.h1 != 0.0 and past.h2 != 0.0:
        here += bend * abs(slope - slope_before)
    else:
        change = slope if past.h1 != 0.0 else (0.0 if here == 0.0 else force)
        here += min(bend * abs(change), 0.5 * coupling * per_K)
    return max(here, FADING * past.doubt)


@inline_exact
def _begin_stretch(p: Instrument, past: Past, now: Sample) -> None:
    """A sample of the angle with no interval before it: only its inputs are kept."""
    y, z = transverse(p, now)
    keep_bends(past, now, y, z, (0.0, 0.0, 0.0))
    keep_interval(past, 0.0, 0.0, 0.0, 0.0, 0.0)


@inline_exact
def _indicate_interval(p: Instrument, past: Past, now: Sample, h: float) -> Indication:
    """Indicated mean force over the interval that ends at a sample of the angle; the past is updated but for the force."""
    y, z = transverse(p, now)
    turn, middle = now.psi - past.psi, p.phi - past.start + 0.5 * (past.psi + now.psi)
    s, c = sine_cosine(middle)
    gap, per_K = spacing(h, past), 1.0 / p.K
    rate = turn * gap.per
    if p.published != 0.0:
        u_x, rise, u = rate - 0.5 * ((past.y + y) * s - (past.z + z) * c), 0.0, rate
    else:
        u_x, rise, u = _mean_along(past, gap, turn, y, z, s, c)
    slope = rise * per_K
    bow_y, left_y, bend_y = bow(gap, y, past.y, past.y_before, past.bend_y)
    bow_z, left_z, bend_z = bow(gap, z, past.z, past.z_before, past.bend_z)
    bow_x, left_x, bend_x = bow(gap, now.Omega_x, past.Omega_x, past.Omega_x_before, past.bend_x)
    left = left_x + left_y * abs(s) + left_z * abs(c)
    across = (past.y + y) * c + (past.z + z) * s
    doubt = doubt_of_interval(per_K, past, (u_x * per_K, slope, past.slope), h, across, left)
    if p.published != 0.0:
        bow_y = bow_z = 0.0  # the published formula takes the transverse reference as straight between samples
    base = 0.5 * (past.Omega_x + now.Omega_x) + bow_x
    force = (u_x + base - _bow_share(0.5 * turn) * (bow_y * s - bow_z * c)) * per_K
    bend = h * (u_x - past.u_x) if past.h1 != 0.0 else 0.0
    inputs = Inputs(
        h, gap.per, turn, 0.5 * turn, middle, s, c, rate * per_K,
        base, 0.5 * (past.Omega_Y + now.Omega_Y), 0.5 * (past.Omega_Z + now.Omega_Z), y, z,
        0.5 * (past.t + now.t), 0.5 * (past.a_Y + now.a_Y), 0.5 * (past.a_Z + now.a_Z),
        now.a_Y - past.a_Y, now.a_Z - past.a_Z, 0.5 * (past.temperature + now.T), now.T - past.temperature,
        slope + (now.Omega_x - past.Omega_x) * per_K, doubt,
        (past.vibration * (past.vibration + now.vibration) + now.vibration * now.vibration) / 3.0,
    )  # fmt: skip
    kept = doubt if past.h1 != 0.0 else 0.0
    keep_bends(past, now, y, z, (bend_x, bend_y, bend_z))
    keep_interval(past, h, u, u_x, slope, kept)
    return Indication(force, inputs, bend, now.psi)


@inline_exact
def keep_interval(past: Past, h: float, u: float, u_x: float, slope: float, doubt: float) -> None:
    """Keep what the next interval needs of this one."""
    past.h3, past.h2, past.h1 = past.h2, past.h1, h
    past.u3, past.u2, past.u1 = past.u2, past.u1, u
    past.u_x, past.slope, past.doubt = u_x, slope, doubt


@inline_exact
def keep_bends(past: Past, now: Sample, y: float, z: float, bends: tuple[float, float, float]) -> None:
    """Keep the inputs of the last two samples and their second derivatives (of Omega_x, y and z)."""
    past.bend_x, past.bend_y, past.bend_z = bends
    past.Omega_x_before, past.y_before, past.z_before = past.Omega_x, past.y, past.z
    past.Omega_x, past.y, past.z = now.Omega_x, y, z


@inline_exact
def keep_sample(past: Past, now: Sample, psi: float, phi: float, a_x: float) -> None:
    """Keep the sample itself and the force."""
    past.seen, past.t, past.phi, past.a_x = 1.0, now.t, phi, a_x
    past.psi = psi
    past.a_Y, past.a_Z, past.temperature = now.a_Y, now.a_Z, now.T
    past.Omega_Y, past.Omega_Z, past.vibration = now.Omega_Y, now.Omega_Z, now.vibration


@exact
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


@inline_exact
def _indicate_sample(p: Instrument, past: Past, now: Sample, h: float, recorded: bool) -> Indication:
    """Indicated force at a sample of the rate; ``recorded``: its angle is recorded, too. The past is updated but for the force."""
    angle = p.phi + now.psi
    if not recorded:
        past.turns, past.rest = _follow_rate(p, past, now, h)
        angle = past.rest
    psi = now.psi if recorded else unwrapped(past.turns, past.rest)
    y, z = transverse(p, now)
    s, c = sine_cosine(angle)
    u_x = now.rate - (y * s - z * c)
    per = 1.0 / (h if h != 0.0 else p.typical)
    inputs = Inputs(
        h, per, psi - past.psi, 0.0, angle, s, c, now.rate / p.K, now.Omega_x, now.Omega_Y, now.Omega_Z,
        y, z, now.t, now.a_Y, now.a_Z, 0.0, 0.0, now.T, 0.0, 0.0, 0.0, now.vibration * now.vibration,
    )  # fmt: skip
    keep_bends(past, now, y, z, (0.0, 0.0, 0.0))
    keep_interval(past, h, 0.0, u_x, 0.0, 0.0)
    return Indication((u_x + now.Omega_x) / p.K, inputs, 0.0, psi)


@inline_exact
def _compensate_sample(
    p: Instrument,
    more: Covariance,
    past: Past,
    now: Sample,
    h: float,
    kind: int,
    warm: bool,
    work: Array,
    sums: Array,
) -> tuple[float, float, float, int]:
    """Force [m/s^2], velocity increment [m/s], standard uncertainty of the force [m/s^2] and flags at one sample.

    Parameters
    ----------
    p, more:
        The instrument.
    past:
        The samples before; updated.
    now, h:
        The sample, and the interval since the last one [s]; 0 where a stretch begins.
    kind:
        ``ANGLE``, ``RATE``, or ``_BOTH``: a rate with its recorded angle.
    warm:
        The temperature is recorded.
    work:
        Room for the regressors; empty: no uncertainty is wanted.
    sums:
        Sums for the uncertainty of the velocity; updated.

    Returns
    -------
    ax, dv, u, flags:
        Angles: means over the interval; nan, 0 and ``NO_INCREMENT`` where a stretch begins. Rates: values at the sample.
    """
    if past.seen == 0.0:
        past.start = now.psi if p.published != 0.0 and kind == ANGLE else 0.0
    elif past.phi != p.phi:
        past.rest += p.phi - past.phi  # a new segment of the same stretch has its own zero
    before = past.a_x
    if kind != ANGLE:
        seen = _indicate_sample(p, past, now, h, kind == _BOTH)
    elif h != 0.0:
        seen = _indicate_interval(p, past, now, h)
    else:
        _begin_stretch(p, past, now)
        keep_sample(past, now, now.psi, p.phi, 0.0)
        sums[STRETCHES] += 1.0
        return math.nan, 0.0, math.nan, at.NO_INCREMENT
    x, indicated = seen.inputs, seen.force
    if more.orders.size:
        indicated -= harmonics(more, x, seen.bend)
    a, derivative = invert_terms(p, x, indicated)
    steady = past.h1 * past.h2 * past.h3 != 0.0
    hidden, shaken = rectified(p, past, (a, now.a_Y, now.a_Z), h, steady, kind != ANGLE)
    u = math.nan
    if work.size:
        variance = variance_by_coefficients(more, p, x, a, work) + hidden * hidden
        dead = dead_zone(p, x.a_Y, x.a_Z, a)
        u = uncertainty(p, x, variance, derivative, dead)
        add_to_velocity(sums, more.codes.size, work, h, derivative, x.doubt, hidden, dead)
    flags = flags_of(p, x, a, warm) | (at.VIBRATION if shaken else 0)
    keep_sample(past, now, seen.psi, p.phi, a)
    if kind == ANGLE:
        return a, a * h + 0.0, u, flags  # never a negative zero
    return a, 0.5 * h * (before + a) if h != 0.0 else 0.0, u, flags | (at.NO_INCREMENT if h == 0.0 else 0)


ANGLE, RATE, _BOTH = 0, 1, 2


class Samples(NamedTuple):
    """Columns of a record: time [s], transverse force [m/s^2], stretches, base rate (n, 3) [rad/s], temperature [K].

    ``psi`` [rad], ``rate`` [rad/s]: one of them, or both. Base rate, temperature and vibration [m/s^2] may be empty.
    """

    t: Array
    psi: Array
    rate: Array
    y: Array
    z: Array
    begins: NDArray[np.bool_]
    base_rate: Array
    temperature: Array
    vibration: Array


class Rows(NamedTuple):
    """Results (n,): ``ax`` [m/s^2], ``dv`` [m/s], ``u`` [m/s^2] and flags; the last two may be empty.

    ``sums``: those of :func:`.terms.add_to_velocity`, updated.
    """

    ax: Array
    dv: Array
    u: Array
    flags: NDArray[np.int32]
    sums: Array


@exact
def compensate_record(
    samples: Samples, instrument: Any, more: Covariance, base_flag: int, past: Any, rows: Rows, work: Array
) -> None:
    """Compensate samples one after the other.

    ``instrument`` and ``past`` are arrays of one record; the past is updated. ``base_flag``: flags for all rows.
    ``work``: room for the regressors; empty if no uncertainty is wanted.
    """
    p, last = instrument[0], past[0]
    t, psi, rate, y, z, begins, base_rate, temperature, vibration = samples
    ax, dv, u, flags, sums = rows
    turning, warm, shaken = base_rate.shape[0] > 0, temperature.size > 0, vibration.size > 0
    kind = ANGLE if rate.size == 0 else (_BOTH if psi.size else RATE)
    for j in range(t.size):
        now = Sample(
            t[j],
            psi[j] if kind != RATE else 0.0,
            rate[j] if kind != ANGLE else 0.0,
            y[j],
            z[j],
            base_rate[j, 0] if turning else 0.0,
            base_rate[j, 1] if turning else 0.0,
            base_rate[j, 2] if turning else 0.0,
            temperature[j] - p.T_0 if warm else 0.0,
            vibration[j] if shaken else 0.0,
        )
        h = 0.0 if begins[j] or last.seen == 0.0 else now.t - last.t
        ax[j], dv[j], doubt, flag = _compensate_sample(p, more, last, now, h, kind, warm, work, sums)
        if u.size:
            u[j] = doubt
        if flags.size:
            flags[j] = flag if flag == at.NO_INCREMENT and kind == ANGLE else flag | base_flag
