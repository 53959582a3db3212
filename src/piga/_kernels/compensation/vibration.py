"""Vibration near the Nyquist frequency: what an interval hides of it, and what the error model makes of that.

The output gives the mean force of an interval. The mean of ``f^2`` is larger than the square of the mean by the variance within
the interval. Where the force is smooth, its change over the interval gives this variance. Of a vibration near the Nyquist
frequency no sample shows it [own choice, docs/theory/compensation].
"""

from __future__ import annotations

import math

from piga._kernels.compensation.data import Instrument, Past
from piga._kernels.jit import inline_exact

_SHARE = 1.0 / 32.0
"""Share of a row in the running mean squares."""
FAST = 1.0
"""Mean square of second over that of first differences of an oscillation of six samples a period (half of Nyquist: 2, white: 3)."""
FULL = 3.0
"""The same from which all of the variance counts: that of white samples."""
_ABOVE_NOISE = 4.0
"""Least mean square of the second differences, over that of the noise that the calibration states."""
WHITE = 1.0 / 6.0
"""Variance of white samples over the mean square of their second differences."""
_BEYOND = 3.0
"""Standard uncertainty of the hidden variance over the variance seen (docs/theory/compensation)."""
SAMPLED = 0.5
"""The same for a reference: its samples show all of the variance, and a third or two thirds of it is hidden."""
_ORDINARY = 1e-6
"""Quadratic coefficient at which a vibration is flagged where the calibration has a smaller one or none [s^2/m]."""
LEAST = 1e-6
"""Change of the mean from which a vibration is flagged [m/s^2]."""


@inline_exact
def near_nyquist(first: float, second: float, noise: float) -> float:
    """Variance of a vibration near the Nyquist frequency [m^2/s^4]; 0 where there is none, or noise alone.

    Of a white vibration all of it counts, of one of six samples a period nothing.
    """
    if second <= FAST * first or second <= _ABOVE_NOISE * noise:
        return 0.0
    if second >= FULL * first:
        return WHITE * second
    return WHITE * (second / first - FAST) / (FULL - FAST) * second


@inline_exact
def rectified(
    p: Instrument, past: Past, force: tuple[float, float, float], h: float, steady: bool, sampled: bool
) -> tuple[float, bool]:
    """Possible change of the mean by a vibration that the interval hides [m/s^2], and whether the row is flagged.

    ``force``: along X0, Y0, Z0 [m/s^2]. ``steady``: three intervals of the stretch are there. ``sampled``: the force is a value
    at a sample, which hides nothing.
    """
    a_x, a_Y, a_Z = force
    x, y, z = a_x - past.force_x, a_Y - past.force_Y, a_Z - past.force_Z
    if steady:
        bend_x, bend_y, bend_z = x - past.step_x, y - past.step_Y, z - past.step_Z
        past.first_x += _SHARE * (x * x - past.first_x)
        past.second_x += _SHARE * (bend_x * bend_x - past.second_x)
        past.first_t += _SHARE * (y * y + z * z - past.first_t)
        past.second_t += _SHARE * (bend_y * bend_y + bend_z * bend_z - past.second_t)
    past.force_x, past.force_Y, past.force_Z = a_x, a_Y, a_Z
    past.step_x, past.step_Y, past.step_Z = x, y, z
    fast = past.second_x > FAST * past.first_x or past.second_t > FAST * past.first_t
    if h == 0.0 or not fast:
        return 0.0, False
    noise = (20.0 * p.white / h + 6.0 * p.walk) / (h * p.K * p.K)
    along, across = (
        near_nyquist(past.first_x, past.second_x, noise),
        near_nyquist(past.first_t, past.second_t, 0.0),
    )
    bent = abs(p.k2 + math.copysign(p.k2o, a_x) + 3.0 * p.k3 * a_x)
    bent_t = max(abs(p.k_YY), abs(p.k_ZZ))
    if max(bent, _ORDINARY) * along + max(bent_t, _ORDINARY) * across <= LEAST:
        return 0.0, False
    size = 0.0
    if not sampled:
        size = _BEYOND * bent * along + SAMPLED * bent_t * across
        size += max(abs(p.k_XY), abs(p.k_XZ)) * math.sqrt(along * across)
    past.shaken += h
    past.shaken_square += (along + across) * h
    past.rectified += size * h
    return size, True
