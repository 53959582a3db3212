r"""What the known inputs do between samples: base rate and reference, smooth through the samples there and before.

The mean of a smooth input over an interval is that of both ends less ``h^2/12`` of its second derivative in the
middle. The last four samples give it, causally, as the cubic through them has it (exact for a cubic, whatever the
intervals; the formula of Adams and Moulton where they are even):

.. math:: \bar x = \tfrac12 (x_0 + x_1) - \tfrac{h^2}{12} \ddot x, \qquad
          \ddot x = D_0 + \varrho (D_0 - D_1), \quad
          \varrho = \frac{h_0 + 2 h_1}{2 (h_0 + h_1 + h_2)} ,

with ``D_0``, ``D_1`` the second derivatives by three samples, the latest and those one sample before, limited so that
nothing rings (:mod:`piga._kernels.arithmetic.smooth`). What that leaves is estimated, too, for ``u_ax``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piga._kernels.arithmetic.smooth import bow_of, limited
from piga._kernels.compensation import layout as at
from piga._kernels.jit import exact, inline

Array = NDArray[np.float64]

LIMITED, NEXT_ORDER = 0.5, 0.15
"""Standard uncertainty of a second derivative, as parts of what the limit took and of its last term: oscillations at seven
samples a period and more come back with mean squares of error over uncertainty of 0.1 to 1.1."""
SERIES = 9.0
"""Square of half the angle turned up to which a bow is weighed with the angle."""
BEGUN, TURNED = 1.0, 7e-4
"""Standard uncertainty of a second derivative times ``h^2`` in the first interval of a stretch, where two samples tell none:
as parts of the change (the input began to move at the first sample) and of the mean (at a turning point of an
oscillation with 170 samples a period, where the change is small, twice the uncertainty holds what is missing)."""
FADING = 0.6
"""Part of a doubt that stands for the next interval: an oscillation's estimate passes through zero, its error not with it."""


@exact
def find_weights(n: int, w: Array) -> None:
    """What the second derivatives of all inputs need of the intervals."""
    for j in range(n + 1):
        h0, h1, h2 = w[at.STEP + j], w[at.STEP + j - 1], w[at.STEP + j - 2]
        some = (h0 != 0.0) & (h1 != 0.0)
        whole = some & (h2 != 0.0)
        w[at.WEIGHT_CURVED + j] = 2.0 / (h0 + h1) if some else 0.0
        w[at.AHEAD + j] = (h0 + 2.0 * h1) / (2.0 * (h0 + h1 + h2)) if whole else 0.0


@exact
def find_bow(n: int, row: int, bow: int, left: int, w: Array) -> None:
    """Mean of an input over every interval less that of both ends, and the standard uncertainty of it."""
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
    """The same for the first interval of a stretch; an input that does not change has none."""
    return (BEGUN * abs(x0 - x1) + (0.5 * TURNED * abs(x0 + x1) if x0 != x1 else 0.0)) * (1.0 / 12.0)


@exact
def find_bows(n: int, turning: bool, state: Array, w: Array) -> None:
    """Bows of the transverse input of every interval and, where the base is ``turning``, of its rate about X0.

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
    for k in range(2):
        state[at.S_OMEGA_X_BEFORE + k] = w[at.OMEGA_X + n - 1 - k]
        state[at.S_RATE_Y_BEFORE + k] = w[at.RATE_Y + n - 1 - k]
        state[at.S_RATE_Z_BEFORE + k] = w[at.RATE_Z + n - 1 - k]


@exact
def straighten(n: int, w: Array) -> None:
    """The published formula takes the transverse reference as straight between samples."""
    for j in range(1, n + 1):
        w[at.BOW_Y + j] = w[at.BOW_Z + j] = 0.0


@exact
def add_bows(n: int, K: float, w: Array) -> None:
    """Take the bows of the transverse input out of the indicated mean force, and add the base rate about X0 to it.

    ``alpha' + Omega_x = K a_x + ...``. A parabola weighs with the angle by ``3 j_1(x)/x``, ``x`` half the angle turned, here
    by its series (3e-4 at x = 3, where the interval is called coarse). What the change of ``a_x`` over the interval has
    of the base rate's is added, too.
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
    """What the samples do not tell of the mean force of every interval [m/s^2]; before the base rate is added.

    The uncertainties of the bows, and what the angle bends between the samples beyond the change of ``u_x`` that earlier
    intervals let expect. The first interval of a stretch hands nothing on: its neighbour knows a second derivative.
    """
    inverse, before, slope = 1.0 / K, state[at.S_DOUBT], state[at.S_SLOPE]
    for j in range(1, n + 1):
        settled = (w[at.STEP + j - 1] != 0.0) & (w[at.STEP + j - 2] != 0.0)
        bend = w[at.STEP + j] * abs(w[at.ACROSS + j - 1] + w[at.ACROSS + j]) * (1.0 / 24.0 if settled else 0.0)
        across = w[at.LEFT_Y + j] * abs(w[at.SINE + j]) + w[at.LEFT_Z + j] * abs(w[at.COSINE + j])
        here = (w[at.LEFT_X + j] + across) * inverse + bend * abs(w[at.SLOPE + j] - slope)
        w[at.DOUBT + j] = max(here, FADING * before) if w[at.STEP + j] != 0.0 else 0.0
        before = w[at.DOUBT + j] if w[at.STEP + j - 1] != 0.0 else 0.0
        slope = w[at.SLOPE + j]
    state[at.S_DOUBT], state[at.S_SLOPE] = before, slope


@exact
def find_set_doubt(n: int, K: float, tangent: float, bend: Array, state: Array, w: Array) -> None:
    """The same for an instrument of a set, whose transverse force is solved for.

    ``bend`` (3, rows) is what the change of the force over an interval may be off by, in the instrument's axes [m/s^2].
    The rows RATE hold all of the transverse input.
    """
    before = state[at.S_DOUBT]
    for j in range(1, n + 1):
        sine, cosine = w[at.SINE + j], w[at.COSINE + j]
        left = w[at.LEFT_X + j] + w[at.LEFT_Y + j] * abs(sine) + w[at.LEFT_Z + j] * abs(cosine)
        across = w[at.RATE_Y + j] * cosine + w[at.RATE_Z + j] * sine
        turn = tangent * (w[at.PSI + j] - w[at.PSI + j - 1])
        force = w[at.STEP + j] * across * bend[0, j] - turn * (bend[1, j] * cosine + bend[2, j] * sine)
        here = left / K + abs(force) * (1.0 / 12.0)
        w[at.DOUBT + j] = max(here, FADING * before) if w[at.STEP + j] != 0.0 else 0.0
        before = w[at.DOUBT + j] if w[at.STEP + j - 1] != 0.0 else 0.0
    state[at.S_DOUBT] = before


@exact
def no_doubt(n: int, w: Array) -> None:
    """At samples nothing lies in between."""
    for j in range(1, n + 1):
        w[at.DOUBT + j] = 0.0
