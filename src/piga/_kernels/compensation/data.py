"""Data of the compensation kernels: an instrument, what is kept of earlier samples, one sample, and a row of an instrument.

Instrument, past and row are records of an array (:func:`records`), so that a set of N instruments is an array of N records.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import Array, config, inline
from piga.terms import ERROR_TERMS

TERMS = ERROR_TERMS
"""Terms of the error model in the order of their codes; SI."""
SCALE_FACTOR, TAN_BETA, PHI = range(len(TERMS), len(TERMS) + 3)
"""Codes behind those of the terms."""
HARMONIC = 100
"""Codes of the harmonics of order n of the output angle: 100 + 2 n sine, 101 + 2 n cosine."""
MOST_TERMS = 40
"""Most uncertain coefficients of an instrument, and most orders of its harmonics."""

NO_INCREMENT, LOCKED, NEAR_CRITICAL, OUT_OF_RANGE, TEMPERATURE, AGE, COARSE, FAULT = 1, 2, 4, 8, 16, 32, 64, 256
VIBRATION = 512
"""Bits of the flags."""


class Instrument(Protocol):
    """Coefficients of an instrument, SI, and their covariance ``factor' factor``; ``factor`` is upper triangular."""

    K: float
    per_K: float  # 1/K
    coupling: float  # K tan(beta)
    tan_beta: float
    phi: float
    offset_y: float  # K s1 of the first harmonic [rad/s]
    offset_z: float  # -K c1
    t_0: float  # reference of the drift
    T_0: float  # reference of the temperature
    white: float  # variance of the angle noise [rad^2]
    walk: float  # that of its random walk [rad^2/s]
    k0: float
    k1: float
    k2: float
    k3: float
    k2o: float
    k1a: float
    m_Y: float
    m_Z: float
    k_XY: float
    k_XZ: float
    k_YY: float
    k_ZZ: float
    k_YZ: float
    k0_t: float
    k0_T: float
    k1_T: float
    k2v: float
    servo: float
    servo_damping: float
    low: float  # calibrated range of a_x [m/s^2]
    high: float
    most: float  # largest a_t [m/s^2]
    cold: float  # range of the temperature above T_0 [K]
    hot: float
    has_terms: float
    published: float  # 1: the published formula
    typical: float  # time that a rate sample stands for at the start of a stretch [s]
    axes: Array  # (3, 3): rows X0, Y0, Z0 in the common frame of a set
    waves: float  # number of harmonics of order 2 and more
    orders: Array
    sines: Array
    cosines: Array
    uncertain: float  # number of uncertain coefficients
    codes: NDArray[np.int64]
    factor: Array  # (uncertain, uncertain)


class Past(Protocol):
    """What the next sample needs of the samples before it; ``..._before``: one sample earlier."""

    seen: float  # 1 once there is a sample
    t: float  # [s]
    psi: float  # [rad]
    a_Y: float  # [m/s^2]
    a_Z: float
    temperature: float  # above T_0 [K]
    vibration: float  # rms [m/s^2]
    Omega_x: float  # base rate [rad/s]
    Omega_Y: float
    Omega_Z: float
    Omega_x_before: float
    y: float  # transverse input tan_beta u [rad/s]
    z: float
    y_before: float
    z_before: float
    h1: float  # the last intervals, latest first [s]
    h2: float
    h3: float
    u1: float  # mean u_x of these intervals if it were constant [rad/s]
    u2: float
    u3: float
    bend_x: float  # second derivatives of Omega_x, y and z by the last three samples
    bend_y: float
    bend_z: float
    u_x: float  # mean of u_x, or its value [rad/s]
    a_x: float  # the last result
    slope: float  # change of a_x over the last interval without the base's part [m/s^2]
    doubt: float  # uncertainty between samples [m/s^2]
    turns: float  # angle of a rate log
    rest: float
    start: float  # psi of the first sample (published formula)
    phi: float  # phase used
    nominal: float  # interval to detect gaps [s]; 0 until known
    force_x: float  # last force in the axes of the instrument [m/s^2], to see vibration (terms.see_vibration)
    force_Y: float
    force_Z: float
    step_x: float  # its last difference
    step_Y: float
    step_Z: float
    first_x: float  # running mean squares of first and second differences, along X0 and across [m^2/s^4]
    second_x: float
    first_t: float
    second_t: float
    shaken: float  # time with such a vibration [s]
    shaken_square: float  # its variance times time [m^2/s^3]
    rectified: float  # its possible velocity [m/s]
    still: float  # 1 while the output has stood still since the start of its stretch
    stood: float  # number of such rows
    stood_from: float  # time of the first one [s]


class Row(Protocol):
    """What one instrument says of an interval, as means, or of a sample."""

    h: float  # [s]; 0 where a stretch begins
    per: float  # 1 over the time that the row stands for in the noise [1/s]
    turn: float  # angle turned [rad]
    half: float  # half of it; 0 for a sample
    angle: float  # in the middle, with its sine and cosine
    s: float
    c: float
    v: float  # output rate over K [m/s^2]
    base_x: float  # what base rate, first harmonic and reference add to u_x and to the transverse input [rad/s]
    base_y: float
    base_z: float
    rise_x: float  # its change over the interval
    rise_y: float
    rise_z: float
    left: float  # its uncertainty between samples
    y: float  # the whole transverse input [rad/s]
    z: float
    Omega_Y: float
    Omega_Z: float
    t: float  # [s]
    temperature: float  # above T_0 [K]
    dT: float  # its change
    vibration: float  # mean square [m^2/s^4]
    a_x: float  # the force and its change [m/s^2]
    a_Y: float
    a_Z: float
    da_x: float
    da_Y: float
    da_Z: float
    doubt: float  # uncertainty by the motion between samples [m/s^2]
    hidden: float  # uncertainty by rectification [m/s^2]
    shaken: float  # 1 in a vibration that is flagged
    axis_x: float  # of a set: effective axis in the common frame
    axis_y: float
    axis_z: float
    gain: float  # sin(half)/half
    harmonics: float  # second and higher ones [m/s^2]
    error: float  # error model at the force, and its change [m/s^2]
    derror: float
    misfit: float  # [m/s^2]
    weight: float  # [s^4/m^2]
    work: Array  # derivatives of the indicated force by the uncertain coefficients


_SHAPES: dict[str, tuple[int, ...]] = {"axes": (3, 3), "factor": (MOST_TERMS, MOST_TERMS)}
_SHAPES |= dict.fromkeys(("orders", "sines", "cosines", "codes", "work"), (MOST_TERMS,))
INSTRUMENT, PAST, ROW = (
    np.dtype(
        [
            (name, np.int64 if name == "codes" else np.float64, _SHAPES.get(name, ()))
            for name in kind.__annotations__
        ]
    )
    for kind in (Instrument, Past, Row)
)


def records(count: int, fields: np.dtype[Any]) -> Any:
    """``count`` records, all zero. Without the compiler their fields are attributes, too."""
    made = np.zeros(count, fields)
    return made.view(np.recarray) if config.DISABLE_JIT else made


class Sample(NamedTuple):
    """One sample."""

    t: float  # [s]
    psi: float  # [rad]
    rate: float  # [rad/s]
    a_Y: float  # [m/s^2]
    a_Z: float
    Omega_x: float  # base rate [rad/s]
    Omega_Y: float
    Omega_Z: float
    T: float  # above T_0 [K]
    vibration: float  # root mean square along X0 [m/s^2]; 0 if none is recorded


class Samples(NamedTuple):
    """Columns of N instruments: times [s] and stretches (n,); the others (N, n), or (N, 0) if they are not recorded.

    ``psi`` [rad], ``rate`` [rad/s]: one of them, or both. Transverse force ``y``, ``z`` [m/s^2] (not of a set). ``base_rate``
    (N, n, 3) or (N, 0, 3) [rad/s]; ``temperature`` [K]; ``vibration`` [m/s^2].
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


@inline
def sample_of(samples: Samples, i: int, j: int, T_0: float) -> Sample:
    """Sample ``j`` of instrument ``i``; what is not recorded is 0."""
    t, psi, rate, y, z, _, base_rate, temperature, vibration = samples
    turning = base_rate.shape[1] > 0
    return Sample(
        t[j],
        psi[i, j] if psi.shape[1] else 0.0,
        rate[i, j] if rate.shape[1] else 0.0,
        y[i, j] if y.shape[1] else 0.0,
        z[i, j] if z.shape[1] else 0.0,
        base_rate[i, j, 0] if turning else 0.0,
        base_rate[i, j, 1] if turning else 0.0,
        base_rate[i, j, 2] if turning else 0.0,
        temperature[i, j] - T_0 if temperature.shape[1] else 0.0,
        vibration[i, j] if vibration.shape[1] else 0.0,
    )
