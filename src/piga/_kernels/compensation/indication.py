r"""Mean specific force of every interval (or force at every sample) indicated by the output.

**Angles.** Compensation of angle records: the exact inverse of the motion over each sample interval.

With ``delta`` half the angle turned and ``alpha_m`` the middle of the two angles read, equation (4) of the
motion [own derivation, docs/theory/compensation] says, without approximation,

.. math:: A \cos\delta = 2 q\cot q\,\sin\delta - (Y \sin\alpha_m - Z \cos\alpha_m), \qquad
          q^2 = (A^2 - Y^2 - Z^2)/4 .

``Y, Z`` are known from the reference. ``A`` is the unknown. The equation is solved for the small ``e = A - 2 delta``, so
that no digit of the angle is lost. Input that is linear between samples is converted to constant increments by the
fourth-order Magnus terms. The slope of ``a_x`` is taken from earlier intervals.

**Near.** Angle records that turn little between samples: the coupling integrated from its values at the samples.

Over an interval the mean of ``u_x`` is the output rate less the mean of the coupling
``g = tan_beta (u_Y sin(alpha) - u_Z cos(alpha))``. The angle is known at both ends. The values and derivatives of g at the
ends give the integral of g (Euler-Maclaurin [own derivation, docs/theory/compensation]):

.. math:: \bar g = \tfrac12 (g_0 + g_1) + \tfrac{h}{12} (g_0' - g_1') - \tfrac{h^3}{720} (g_0''' - g_1''') .

Transverse input is linear between samples. ``u_x`` is linear, too. Backward differences of its means give its change
(three intervals; fewer at the beginning of a stretch). The derivatives contain ``u_x`` itself, and the equation is
linear in it. No angle between samples is needed, so one sine and cosine per sample is enough.

**Between.** Motion of the known inputs between samples: base rate and reference, smooth through these and earlier samples.

The mean of a smooth input over an interval is the mean of both ends less ``h^2/12`` of its second derivative in the
middle. The second derivative is that of the cubic through the last four samples. It is causal, and exact for a cubic with
any intervals. For equal intervals it is the formula of Adams and Moulton:

.. math:: \bar x = \tfrac12 (x_0 + x_1) - \tfrac{h^2}{12} \ddot x, \qquad
          \ddot x = D_0 + \varrho (D_0 - D_1), \quad
          \varrho = \frac{h_0 + 2 h_1}{2 (h_0 + h_1 + h_2)} ,

``D_0`` is the second derivative from the last three samples, ``D_1`` that from one sample earlier. They are limited so that
the result does not ring (:mod:`piga._kernels.arithmetic`). The remaining error is estimated for ``u_ax``.
"""

from __future__ import annotations

import math

from piga._kernels.arithmetic import LIMIT, bow_of, fast_sine_cosine, limited
from piga._kernels.compensation import layout as at
from piga._kernels.jit import Array, exact, inline, kernel

FAR_TURN = 0.25
"""Largest half turn in an interval [rad] for the series."""
FAR_PRODUCT = 1e-9
"""Largest ``(Y^2 + Z^2) delta^2`` for which two corrections reach rounding."""
NEWTON = 60
NEAR_TURN = 0.03
"""Largest turn in an interval [rad] for the formula."""
NEAR_COUPLING = 1e-3
"""Largest angle in an interval [rad] by the transverse input for the formula."""
EVEN = 1e-4
"""Half the relative change of the interval up to which a series replaces a division (error 1e-8 of the rise)."""
LIMITED, NEXT_ORDER = 0.5, 0.15
"""Standard uncertainty of a second derivative, as shares of the part that the limit cut off and of its last term. For
oscillations at seven samples a period and more the mean square of error over uncertainty is 0.1 to 1.1."""
SERIES = 9.0
"""Largest square of half the angle turned for which a bow is weighted with the angle."""
BEGUN, TURNED = 1.0, 7e-4
"""Standard uncertainty of a second derivative times ``h^2`` in the first interval of a stretch. Two samples give no second
derivative. The uncertainty is a share of the change (as if the input began to move at the first sample) and of the mean. The
share of the mean is for a turning point of an oscillation with 170 samples a period, where the change is small: there twice
the uncertainty covers the missing second derivative."""
FADING = 0.6
"""Share of an uncertainty kept for the next interval. During an oscillation the estimate passes through zero, the error does
not."""


@exact
def padded(n: int) -> int:
    """``n`` rounded up to a whole number of tiles."""
    return (n + at.TILE - 1) // at.TILE * at.TILE


@exact
def indicate_intervals(n: int, published: bool, phi: float, K: float, w: Array) -> None:
    """Indicated mean force of every interval for inputs that are linear in it, and the angle in the middle."""
    if published:
        find_nodes(padded(n + 1), phi, w)
        find_angles(padded(n) + 1, phi, w)
        find_early(n + 1, w)
        published_formula(n, K, w)
        return
    stop = padded(n) + 1
    find_nodes(padded(n + 1), phi, w)
    far = find_early(stop, w)
    if far:
        find_angles(padded(n + 1), phi, w)
        estimate_first(padded(n + 1), w)
        invert_motion(stop, K, w)
    invert_near(stop, K, w)
    if far:
        take_far(stop, w)
    middle_angles(n, phi, w)


@kernel
def find_nodes(stop: int, phi: float, w: Array) -> None:
    """Sine and cosine of the angles read, and the coupling there, from the last sample before the block on."""
    far = 0
    for j in range(stop):
        alpha = phi + w[at.PSI + j]
        sine, cosine = fast_sine_cosine(alpha)
        y, z = w[at.RATE_Y + j], w[at.RATE_Z + j]
        w[at.NODE_SINE + j], w[at.NODE_COSINE + j] = sine, cosine
        w[at.COUPLING + j] = y * sine - z * cosine
        w[at.ACROSS + j] = y * cosine + z * sine
        far |= abs(alpha) > LIMIT
    if far:
        far_nodes(stop, phi, w)


@exact
def far_nodes(stop: int, phi: float, w: Array) -> None:
    """Like :func:`find_nodes`, at angles beyond the fast reduction."""
    for j in range(stop):
        alpha = phi + w[at.PSI + j]
        if abs(alpha) > LIMIT:
            sine, cosine = math.sin(alpha), math.cos(alpha)
            y, z = w[at.RATE_Y + j], w[at.RATE_Z + j]
            w[at.NODE_SINE + j], w[at.NODE_COSINE + j] = sine, cosine
            w[at.COUPLING + j] = y * sine - z * cosine
            w[at.ACROSS + j] = y * cosine + z * sine


@inline
def is_near(turn: float, h: float, y: float, z: float) -> bool:
    """True if the formula is valid for an interval."""
    return (abs(turn) <= NEAR_TURN) & (abs(h) * (abs(y) + abs(z)) <= NEAR_COUPLING)


@kernel
def find_early(stop: int, w: Array) -> bool:
    """Mean ``u_x`` of every interval if it is constant there; True where an interval turns far."""
    far = 0
    for j in range(1, stop):
        h, turn = w[at.STEP + j], w[at.PSI + j] - w[at.PSI + j - 1]
        y0, y1, z0, z1 = w[at.RATE_Y + j - 1], w[at.RATE_Y + j], w[at.RATE_Z + j - 1], w[at.RATE_Z + j]
        g0, g1, q0, q1 = w[at.COUPLING + j - 1], w[at.COUPLING + j], w[at.ACROSS + j - 1], w[at.ACROSS + j]
        ds = w[at.NODE_SINE + j - 1] - w[at.NODE_SINE + j]
        dc = w[at.NODE_COSINE + j - 1] - w[at.NODE_COSINE + j]
        inverse = 1.0 / h if h != 0.0 else 0.0
        mean = turn * inverse - 0.5 * (g0 + g1)
        ends = (y1 - y0) * ds - (z1 - z0) * dc + h * ((mean + g0) * q0 - (mean + g1) * q1)
        w[at.EARLY + j] = mean - ends * (1 / 12 + turn * turn * (1 / 720) - (1 / 144) * (h * (q0 - q1)))
        w[at.INVERSE + j] = inverse
        far |= (not is_near(turn, h, y1, z1)) & (h != 0.0)
    return far != 0


@kernel
def invert_near(stop: int, K: float, w: Array) -> None:
    """Indicated mean specific force of every interval [m/s^2], by the formula for those that turn little.

    The change of ``u_x`` over an interval is ``d + d^2/2 + d^3/4`` of backward differences ``d`` of the means: for
    input that is linear between samples the series is that of ``2 d/(2 - d)``. The first difference is scaled for
    unequal intervals.
    """
    inverse_K = 1.0 / K
    odd = 0
    for j in range(1, stop):
        h, u0, u1, u2 = w[at.STEP + j], w[at.EARLY + j], w[at.EARLY + j - 1], w[at.EARLY + j - 2]
        x = 0.5 * (w[at.STEP + j - 1] * w[at.INVERSE + j] - 1.0)
        change, before = u0 - u1, u1 - u2
        second = change - before
        rise = change - change * x + 0.5 * second + 0.25 * (second - (before - (u2 - w[at.EARLY + j - 3])))
        odd |= abs(x) > EVEN
        mean = u0 + curved(h * rise, j, w)
        w[at.INPUT + j] = mean * inverse_K
        w[at.FIRST + j] = mean
        w[at.SLOPE + j] = rise * inverse_K
    if odd or w[at.STEP - 1] == 0.0 or w[at.STEP - 2] == 0.0:
        invert_odd(stop, K, w)


@inline
def curved(bend: float, j: int, w: Array) -> float:
    """Addition to the mean of ``u_x`` by a change ``bend`` of ``h u_x`` over interval ``j``."""
    g0, g1, q0, q1 = w[at.COUPLING + j - 1], w[at.COUPLING + j], w[at.ACROSS + j - 1], w[at.ACROSS + j]
    turn = w[at.PSI + j] - w[at.PSI + j - 1]
    share = (q0 + q1) * (1 / 24 + (1 / 240) * (turn * turn))
    return bend * (share + (1 / 480) * bend * (g0 + g1))


@exact
def is_odd(j: int, w: Array) -> bool:
    """True for an interval that differs from the one before, or is near the beginning of a stretch."""
    x = 0.5 * (w[at.STEP + j - 1] * w[at.INVERSE + j] - 1.0)
    return abs(x) > EVEN or w[at.STEP + j - 2] == 0.0 or w[at.STEP + j - 3] == 0.0


@exact
def invert_odd(stop: int, K: float, w: Array) -> None:
    """Like :func:`invert_near`, near the beginning of a stretch and where intervals differ, with fewer differences."""
    for j in range(1, stop):
        s0, s1, s2 = w[at.STEP + j], w[at.STEP + j - 1], w[at.STEP + j - 2]
        x = 0.5 * (s1 * w[at.INVERSE + j] - 1.0)
        uneven = abs(x) > EVEN
        if s0 == 0.0 or not is_odd(j, w):
            continue
        u0, u1, u2 = w[at.EARLY + j], w[at.EARLY + j - 1], w[at.EARLY + j - 2]
        rise = (u0 - u1) * 2.0 * s0 / (s0 + s1) if s1 != 0.0 else 0.0
        rise += 0.5 * ((u0 - u1) - (u1 - u2)) if s2 != 0.0 and not uneven else 0.0
        mean = u0 + curved(s0 * rise, j, w)
        w[at.INPUT + j], w[at.FIRST + j], w[at.SLOPE + j] = mean / K, mean, rise / K


@exact
def take_far(stop: int, w: Array) -> None:
    """Insert the exact inverse where an interval turns far."""
    for j in range(1, stop):
        turn, h = w[at.PSI + j] - w[at.PSI + j - 1], w[at.STEP + j]
        if not is_near(turn, h, w[at.RATE_Y + j], w[at.RATE_Z + j]):
            w[at.INPUT + j], w[at.FIRST + j] = w[at.FAR_INPUT + j], w[at.CONSTANT + j]
            w[at.SLOPE + j] = w[at.FAR_SLOPE + j]


@exact
def middle_angles(n: int, phi: float, w: Array) -> None:
    """Angle in the middle of the near intervals, sine and cosine to the digits that the uncertainty needs."""
    for j in range(1, n + 1):
        turn = w[at.PSI + j] - w[at.PSI + j - 1]
        near = is_near(turn, w[at.STEP + j], w[at.RATE_Y + j], w[at.RATE_Z + j])
        sine, cosine = (
            w[at.NODE_SINE + j - 1] + w[at.NODE_SINE + j],
            w[at.NODE_COSINE + j - 1] + w[at.NODE_COSINE + j],
        )
        w[at.SINE + j] = 0.5 * sine if near else w[at.SINE + j]
        w[at.COSINE + j] = 0.5 * cosine if near else w[at.COSINE + j]
        w[at.ANGLE + j] = phi + 0.5 * (w[at.PSI + j - 1] + w[at.PSI + j])


@kernel
def find_angles(stop: int, phi: float, w: Array) -> None:
    """Effective angle of every interval (the middle of the angles read), its sine and cosine."""
    far = 0
    for j in range(stop):
        angle = phi + 0.5 * (w[at.PSI + j - 1] + w[at.PSI + j])
        w[at.ANGLE + j] = angle
        sine, cosine = fast_sine_cosine(angle)
        w[at.SINE + j] = sine
        w[at.COSINE + j] = cosine
        far |= abs(angle) > LIMIT
    if far:
        library_angles(stop, w)


@exact
def library_angles(stop: int, w: Array) -> None:
    """Sine and cosine of angles beyond the fast reduction."""
    for j in range(stop):
        angle = w[at.ANGLE + j]
        if abs(angle) > LIMIT:
            w[at.SINE + j] = math.sin(angle)
            w[at.COSINE + j] = math.cos(angle)


@kernel
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


@kernel
def estimate_first(stop: int, w: Array) -> None:
    """Mean ``u_x`` of every interval for input that is constant in it: exact then."""
    far = 0
    for j in range(stop):
        step = w[at.STEP + j]
        delta = 0.5 * (w[at.PSI + j] - w[at.PSI + j - 1])
        Y = 0.5 * step * (w[at.RATE_Y + j - 1] + w[at.RATE_Y + j])
        Z = 0.5 * step * (w[at.RATE_Z + j - 1] + w[at.RATE_Z + j])
        square = Y * Y + Z * Z
        e, gain = solve_small(delta, square, Y * w[at.SINE + j] - Z * w[at.COSINE + j])
        w[at.CONSTANT + j] = (2.0 * delta + e) * w[at.INVERSE + j]
        w[at.GAIN + j] = gain
        w[at.ANGLE_TURNED + j] = 2.0 * delta + e
        far |= (abs(delta) > FAR_TURN) | (square * delta * delta > FAR_PRODUCT)
    if far:
        estimate_far(stop, w)


@exact
def estimate_far(stop: int, w: Array) -> None:
    """The intervals that turn too far for the series."""
    for j in range(stop):
        step = w[at.STEP + j]
        delta = 0.5 * (w[at.PSI + j] - w[at.PSI + j - 1])
        Y = 0.5 * step * (w[at.RATE_Y + j - 1] + w[at.RATE_Y + j])
        Z = 0.5 * step * (w[at.RATE_Z + j - 1] + w[at.RATE_Z + j])
        square = Y * Y + Z * Z
        if step != 0.0 and (abs(delta) > FAR_TURN or square * delta * delta > FAR_PRODUCT):
            e = solve_far(delta, square, Y * w[at.SINE + j] - Z * w[at.COSINE + j])
            w[at.GAIN + j] = math.sin(delta) / delta if delta != 0.0 else 1.0
            w[at.ANGLE_TURNED + j] = 2.0 * delta + e
            w[at.CONSTANT + j] = w[at.ANGLE_TURNED + j] / step


@exact
def solve_far(delta: float, square: float, coupling: float) -> float:
    """``e = A - 2 delta`` for any turn and any regime: Newton's method on the equation times ``sin q / q``."""
    sine, cosine = math.sin(delta), math.cos(delta)
    A = 2.0 * delta - coupling * (sine / delta if abs(delta) > 1e-8 else 1.0)
    for _ in range(NEWTON):
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


@kernel
def invert_motion(stop: int, K: float, w: Array) -> None:
    """Indicated mean specific force along X0 of every interval [m/s^2], and the slope used.

    The Magnus terms of input that is linear in the interval are small compared with its mean. The equation is
    solved for the mean and corrected for these terms to first order (their square is below rounding).
    """
    inverse_K = 1.0 / K
    for j in range(1, stop):
        step, before = w[at.STEP + j], w[at.STEP + j - 1]
        y0, y1, z0, z1 = w[at.RATE_Y + j - 1], w[at.RATE_Y + j], w[at.RATE_Z + j - 1], w[at.RATE_Z + j]
        mean_y, mean_z = 0.5 * (y0 + y1), 0.5 * (z0 + z1)
        a = w[at.CONSTANT + j]
        joined = (step != 0.0) & (before != 0.0)
        rise = (a - w[at.CONSTANT + j - 1]) * 2.0 * step / (step + before if joined else 1.0)
        rise = rise if joined else 0.0
        cross = step * step / 12.0
        Y = cross * (a * (z1 - z0) - rise * mean_z)
        Z = -cross * (a * (y1 - y0) - rise * mean_y)
        delta = 0.5 * (w[at.PSI + j] - w[at.PSI + j - 1])
        bent = Y * w[at.SINE + j] - Z * w[at.COSINE + j] - delta / 3.0 * step * (mean_y * Y + mean_z * Z)
        turned = w[at.ANGLE_TURNED + j] - (w[at.GAIN + j] * bent + cross * (y0 * z1 - z0 * y1))
        w[at.FAR_INPUT + j] = turned * w[at.INVERSE + j] * inverse_K
        w[at.FAR_SLOPE + j] = rise * inverse_K


@exact
def published_formula(n: int, K: float, w: Array) -> None:
    """The published compensation: output rate less the coupling at the phase [Wei2024, eq. 20]."""
    for j in range(1, n + 1):
        rate = (w[at.PSI + j] - w[at.PSI + j - 1]) * w[at.INVERSE + j]
        y, z = 0.5 * (w[at.RATE_Y + j - 1] + w[at.RATE_Y + j]), 0.5 * (w[at.RATE_Z + j - 1] + w[at.RATE_Z + j])
        w[at.INPUT + j] = (rate - (y * w[at.SINE + j] - z * w[at.COSINE + j])) / K
        w[at.SLOPE + j] = 0.0
        w[at.FIRST + j] = w[at.EARLY + j]


@exact
def find_weights(n: int, w: Array) -> None:
    """Weights of the second derivatives of all inputs, from the intervals."""
    for j in range(n + 1):
        h0, h1, h2 = w[at.STEP + j], w[at.STEP + j - 1], w[at.STEP + j - 2]
        some = (h0 != 0.0) & (h1 != 0.0)
        whole = some & (h2 != 0.0)
        w[at.WEIGHT_CURVED + j] = 2.0 / (h0 + h1) if some else 0.0
        w[at.AHEAD + j] = (h0 + 2.0 * h1) / (2.0 * (h0 + h1 + h2)) if whole else 0.0


@exact
def find_bow(n: int, row: int, bow: int, left: int, w: Array) -> None:
    """Mean of an input over every interval less the mean of both ends, and its standard uncertainty."""
    for j in range(n + 1):
        x0, x1, x2 = w[row + j], w[row + j - 1], w[row + j - 2]
        change = (x0 - x1) * w[at.INVERSE + j] - (x1 - x2) * w[at.INVERSE + j - 1]
        w[at.CURVED + j] = change * w[at.WEIGHT_CURVED + j]
    for j in range(1, n + 1):
        first, second, h = w[at.CURVED + j], w[at.CURVED + j - 1], w[at.STEP + j]
        value = first + (first - second) * w[at.AHEAD + j]
        taken = limited(value, first, second)
        w[bow + j] = bow_of(h, taken)
        size = LIMITED * abs(value - taken) + NEXT_ORDER * abs(first - second)
        w[left + j] = h * h * (1.0 / 12.0) * size
        if (h != 0.0) & (w[at.STEP + j - 1] == 0.0):
            w[left + j] = begun(w[row + j], w[row + j - 1])


@inline
def begun(x0: float, x1: float) -> float:
    """Standard uncertainty in the first interval of a stretch; 0 for an input that does not change."""
    return (BEGUN * abs(x0 - x1) + (0.5 * TURNED * abs(x0 + x1) if x0 != x1 else 0.0)) * (1.0 / 12.0)


@exact
def find_bows(n: int, turning: bool, straight: bool, state: Array, w: Array) -> None:
    """Bows of the transverse input of every interval and, where the base is ``turning``, of its rate about X0.

    ``straight``: the published formula takes the transverse reference as straight between samples.

    Keeps the samples that the next block needs.
    """
    find_weights(n, w)
    find_bow(n, at.RATE_Y, at.BOW_Y, at.LEFT_Y, w)
    find_bow(n, at.RATE_Z, at.BOW_Z, at.LEFT_Z, w)
    if turning:
        find_bow(n, at.OMEGA_X, at.BOW_X, at.LEFT_X, w)
    else:
        for j in range(1, n + 1):
            w[at.BOW_X + j] = w[at.LEFT_X + j] = 0.0
    if straight:
        for j in range(1, n + 1):
            w[at.BOW_Y + j] = w[at.BOW_Z + j] = 0.0
    for k in range(2):
        state[at.S_OMEGA_X_BEFORE + k] = w[at.OMEGA_X + n - 1 - k]
        state[at.S_RATE_Y_BEFORE + k] = w[at.RATE_Y + n - 1 - k]
        state[at.S_RATE_Z_BEFORE + k] = w[at.RATE_Z + n - 1 - k]


@exact
def add_bows(n: int, K: float, w: Array) -> None:
    """Subtract the bows of the transverse input from the indicated mean force, and add the base rate about X0.

    ``alpha' + Omega_x = K a_x + ...``. Over the angle a parabola has the weight ``3 j_1(x)/x``, with ``x`` half the angle turned.
    The series of this weight is used (3e-4 at x = 3, where the interval is called coarse). The part of the change of ``a_x``
    over the interval that comes from the base rate is added, too.
    """
    inverse = 1.0 / K
    for j in range(1, n + 1):
        half = 0.5 * (w[at.PSI + j] - w[at.PSI + j - 1])
        x = min(half * half, SERIES)
        share = 1.0 - x * (1 / 10 - x * (1 / 280 - x * (1 / 15120 - x / 1330560)))
        across = w[at.BOW_Y + j] * w[at.SINE + j] - w[at.BOW_Z + j] * w[at.COSINE + j]
        base = 0.5 * (w[at.OMEGA_X + j - 1] + w[at.OMEGA_X + j]) + w[at.BOW_X + j]
        w[at.BASE_X + j] = base
        w[at.INPUT + j] += (base - share * across) * inverse
        w[at.SLOPE + j] += (w[at.OMEGA_X + j] - w[at.OMEGA_X + j - 1]) * inverse


@exact
def find_doubt(n: int, K: float, state: Array, w: Array) -> None:
    """Uncertainty of the mean force of every interval by the motion between samples [m/s^2], without the base rate.

    It includes the uncertainties of the bows, and the bend of the angle between samples beyond the change of ``u_x``
    predicted from earlier intervals. The first interval of a stretch adds nothing to the next one, because the next one has a
    second derivative. It shows no change of ``u_x``. Where the sampled input changes, a change by the mean of ``u_x`` is
    assumed. In the second interval the change itself is used.
    """
    inverse, before, slope = 1.0 / K, state[at.S_DOUBT], state[at.S_SLOPE]
    for j in range(1, n + 1):
        joined = w[at.STEP + j - 1] != 0.0
        settled = joined & (w[at.STEP + j - 2] != 0.0)
        coupling = abs(w[at.ACROSS + j - 1] + w[at.ACROSS + j])
        bend = w[at.STEP + j] * coupling * (1.0 / 24.0)
        across = w[at.LEFT_Y + j] * abs(w[at.SINE + j]) + w[at.LEFT_Z + j] * abs(w[at.COSINE + j])
        here = (w[at.LEFT_X + j] + across) * inverse
        if settled:
            here += bend * abs(w[at.SLOPE + j] - slope)
        else:
            still = here == 0.0
            change = w[at.SLOPE + j] if joined else (0.0 if still else w[at.INPUT + j])
            here += min(bend * abs(change), 0.5 * coupling * inverse)
        w[at.DOUBT + j] = max(here, FADING * before) if w[at.STEP + j] != 0.0 else 0.0
        before = w[at.DOUBT + j] if w[at.STEP + j - 1] != 0.0 else 0.0
        slope = w[at.SLOPE + j]
    state[at.S_DOUBT], state[at.S_SLOPE] = before, slope


@exact
def find_set_doubt(n: int, K: float, tangent: float, bend: Array, state: Array, w: Array) -> None:
    """Like :func:`find_doubt`, for an instrument of a set. Its transverse force is an unknown of the solution.

    ``bend`` (3, rows) is the possible error of the change of the force over an interval, in the instrument's axes [m/s^2].
    The rows RATE contain all of the transverse input. In the first interval of a stretch no sample shows a change: twice the
    uncertainty covers a change as large as the force itself, in any direction. In the second interval the sizes of the parts
    of the bend are added.
    """
    before = state[at.S_DOUBT]
    for j in range(1, n + 1):
        sine, cosine = w[at.SINE + j], w[at.COSINE + j]
        left = w[at.LEFT_X + j] + w[at.LEFT_Y + j] * abs(sine) + w[at.LEFT_Z + j] * abs(cosine)
        across = w[at.RATE_Y + j] * cosine + w[at.RATE_Z + j] * sine
        turn = tangent * (w[at.PSI + j] - w[at.PSI + j - 1])
        joined = w[at.STEP + j - 1] != 0.0
        along, beside = w[at.STEP + j] * across * bend[0, j], turn * (bend[1, j] * cosine + bend[2, j] * sine)
        if joined & (w[at.STEP + j - 2] != 0.0):
            force = abs(along - beside) * (1.0 / 12.0)
        elif joined:
            force = (abs(along) + abs(beside)) * (1.0 / 12.0)
        else:
            x, y, z = w[at.FORCE + j], w[at.MEAN_Y + j], w[at.MEAN_Z + j]
            size = math.sqrt(x * x + y * y + z * z)
            reach = abs(w[at.STEP + j] * across) + abs(turn)
            force = min(reach * (1.0 / 24.0), 2.0 * tangent) * size
        here = left / K + force
        w[at.DOUBT + j] = max(here, FADING * before) if w[at.STEP + j] != 0.0 else 0.0
        before = w[at.DOUBT + j] if w[at.STEP + j - 1] != 0.0 else 0.0
    state[at.S_DOUBT] = before


@kernel
def find_samples(rows: int, phi: float, w: Array) -> None:
    """Angle, its sine and cosine, and ``u_x`` at samples whose angle and rate are both recorded.

    The angle is in the row PSI, the rate in FIRST.
    """
    far = 0
    for j in range(1, rows + 1):
        alpha = phi + w[at.PSI + j]
        w[at.ANGLE + j] = alpha
        sine, cosine = fast_sine_cosine(alpha)
        w[at.SINE + j], w[at.COSINE + j] = sine, cosine
        far |= abs(alpha) > LIMIT
    if far:
        library_angles(rows + 1, w)
    for j in range(1, rows + 1):
        w[at.FIRST + j] -= w[at.RATE_Y + j] * w[at.SINE + j] - w[at.RATE_Z + j] * w[at.COSINE + j]


@exact
def indicate_samples(n: int, K: float, w: Array) -> None:
    """Indicated specific force at the samples [m/s^2]; it has no uncertainty by motion between samples."""
    inverse = 1.0 / K
    for j in range(1, n + 1):
        w[at.DOUBT + j] = 0.0
        w[at.BASE_X + j] = w[at.OMEGA_X + j]
        w[at.INPUT + j] = (w[at.FIRST + j] + w[at.OMEGA_X + j]) * inverse
