"""Data of the compensation kernels: an instrument, what is kept of earlier samples, one sample, and a row of an instrument.

Instrument, past and row are records of an array (:func:`records`), so that a set of N instruments is an array of N records.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import Array, config
from piga.terms import ERROR_TERMS

TERMS = ERROR_TERMS
"""Terms of the error model in the order of their codes; SI."""
SCALE_FACTOR, TAN_BETA, PHI = range(len(TERMS), len(TERMS) + 3)
"""Codes behind those of the terms."""
HARMONIC = 100
"""Codes of the harmonics of order n of the output angle: 100 + 2 n sine, 101 + 2 n cosine."""
MOST_TERMS = 40
"""Most uncertain coefficients of an instrument."""

NO_INCREMENT, LOCKED, NEAR_CRITICAL, OUT_OF_RANGE, TEMPERATURE, AGE, COARSE, FAULT = 1, 2, 4, 8, 16, 32, 64, 256
VIBRATION = 512
"""Bits of the flags."""


class Instrument(Protocol):
    """Coefficients of an instrument, SI.

    ``per_K``: 1/K; ``coupling``: K tan(beta). ``offset_y``, ``offset_z``: ``K s1`` and ``-K c1`` [rad/s] of the first harmonic.
    ``t_0``, ``T_0``: references of drift and temperature. ``white``, ``walk``: variance of the angle noise [rad^2] and of its
    random walk [rad^2/s]. ``low``, ``high``: calibrated range of a_x; ``most``: largest a_t [m/s^2]; ``cold``, ``hot``: range of
    the temperature above T_0 [K].
    ``published``: 1 for the published formula. ``typical``: time that a rate sample stands for at the start of a stretch [s].
    """

    K: float
    per_K: float
    coupling: float
    tan_beta: float
    phi: float
    offset_y: float
    offset_z: float
    t_0: float
    T_0: float
    white: float
    walk: float
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
    low: float
    high: float
    most: float
    cold: float
    hot: float
    has_terms: float
    published: float
    typical: float


class Past(Protocol):
    """What the next sample needs of the samples before it.

    ``seen``: 1 once there is a sample. ``t`` [s], ``psi`` [rad], ``a_Y``, ``a_Z`` [m/s^2], ``temperature`` above T_0 [K],
    ``vibration`` (rms) [m/s^2] and base rate ``Omega`` [rad/s] of the last sample; ``y``, ``z``: its transverse input
    ``tan_beta u`` [rad/s]. ``..._before``: one sample earlier. ``h1, h2, h3``: the last intervals, latest first [s]; ``u1, u2,
    u3``: mean ``u_x`` of these intervals if it were constant [rad/s]. ``bend_x``, ``bend_y``, ``bend_z``: second derivatives
    of Omega_x, y and z by the last three samples. ``u_x``: mean of ``u_x`` (or its value) [rad/s]; ``a_x``: the last result;
    ``slope``: change of ``a_x`` over the last interval without the base's part [m/s^2]; ``doubt``: uncertainty between samples
    [m/s^2]. ``turns``, ``rest``: angle of a rate log. ``start``: psi of the first sample (published formula). ``phi``: phase
    used. ``nominal``: interval to detect gaps [s]; 0 until known.

    To see vibration near the Nyquist frequency (:func:`.terms.see_vibration`): ``force_...``: last force in the axes of the
    instrument, ``step_...``: its last difference [m/s^2]. ``first_...``, ``second_...``: running mean squares of first and
    second differences, along X0 and across [m^2/s^4]. Sums over the rows with such a vibration: ``shaken`` [s],
    ``shaken_square``: its variance times time [m^2/s^3], ``rectified``: its possible velocity [m/s].
    """

    seen: float
    t: float
    psi: float
    a_Y: float
    a_Z: float
    temperature: float
    vibration: float
    Omega_x: float
    Omega_Y: float
    Omega_Z: float
    Omega_x_before: float
    y: float
    z: float
    y_before: float
    z_before: float
    h1: float
    h2: float
    h3: float
    u1: float
    u2: float
    u3: float
    bend_x: float
    bend_y: float
    bend_z: float
    u_x: float
    a_x: float
    slope: float
    doubt: float
    turns: float
    rest: float
    start: float
    phi: float
    nominal: float
    force_x: float
    force_Y: float
    force_Z: float
    step_x: float
    step_Y: float
    step_Z: float
    first_x: float
    second_x: float
    first_t: float
    second_t: float
    shaken: float
    shaken_square: float
    rectified: float


class Row(Protocol):
    """What one instrument says of an interval, as means, or of a sample.

    ``h`` [s], 0 where a stretch begins; ``per``: 1 over the time that the row stands for in the noise [1/s]. ``turn``: angle
    turned [rad]; ``half``: half of it, 0 for a sample. ``angle``, ``s``, ``c``: angle in the middle, sine and cosine. ``v``:
    output rate over K [m/s^2]. ``base_x``, ``base_y``, ``base_z``: what base rate, first harmonic and reference add to ``u_x``
    and to the transverse input, with their changes ``rise_...`` over the interval, and ``left``: their uncertainty between
    samples [rad/s]. ``y``, ``z``: the whole transverse input; ``Omega_Y``, ``Omega_Z`` [rad/s]. ``t`` [s], ``temperature``
    above T_0 [K] and its change ``dT``. ``vibration``: its mean square [m^2/s^4]. ``a_x, a_Y, a_Z`` and changes ``da_...``: the
    force [m/s^2].
    ``doubt``: uncertainty by the motion between samples, ``hidden``: by rectification [m/s^2]; ``shaken``: 1 in a vibration
    that is flagged. Of a set: ``axis_...``: effective axis in the common frame; ``gain``: sin(half)/half; ``harmonics``: second
    and higher ones, ``error``: error model, with its change ``derror``, ``misfit`` [m/s^2]; ``weight`` [s^4/m^2].
    """

    h: float
    per: float
    turn: float
    half: float
    angle: float
    s: float
    c: float
    v: float
    base_x: float
    base_y: float
    base_z: float
    rise_x: float
    rise_y: float
    rise_z: float
    left: float
    y: float
    z: float
    Omega_Y: float
    Omega_Z: float
    t: float
    temperature: float
    dT: float
    vibration: float
    a_x: float
    a_Y: float
    a_Z: float
    da_x: float
    da_Y: float
    da_Z: float
    doubt: float
    hidden: float
    shaken: float
    axis_x: float
    axis_y: float
    axis_z: float
    gain: float
    harmonics: float
    error: float
    derror: float
    misfit: float
    weight: float


INSTRUMENT, PAST, ROW = (
    np.dtype([(name, np.float64) for name in kind.__annotations__]) for kind in (Instrument, Past, Row)
)


class _PlainRecord(SimpleNamespace):
    """A record without the compiler."""

    def __getitem__(self, name: str) -> float:
        return float(getattr(self, name))


class PlainRecords:
    """An array of records without the compiler: the fields of NumPy's records take ten times as long to read."""

    def __init__(self, rows: list[_PlainRecord]) -> None:
        self.rows, self.size = rows, len(rows)

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, str):
            return np.array([getattr(row, key) for row in self.rows])
        return PlainRecords(self.rows[key]) if isinstance(key, slice) else self.rows[key]

    def __setitem__(self, key: Any, value: Any) -> None:
        if isinstance(key, str):
            for row in self.rows:
                setattr(row, key, float(value))
        else:
            vars(self.rows[key]).update(vars(value))

    def copy(self) -> PlainRecords:
        """Records of their own."""
        return PlainRecords([_PlainRecord(**vars(row)) for row in self.rows])


def records(count: int, fields: np.dtype[Any]) -> Any:
    """``count`` records, all zero."""
    if config.DISABLE_JIT:
        return PlainRecords([_PlainRecord(**dict.fromkeys(fields.names or (), 0.0)) for _ in range(count)])
    return np.zeros(count, fields)


class Covariance(NamedTuple):
    """Harmonics of order 2 and more, and the covariance ``factor' factor`` of the coefficients ``codes``.

    ``factor`` (rank, coefficients) is upper triangular.
    """

    orders: Array
    sines: Array
    cosines: Array
    codes: NDArray[np.int64]
    factor: Array


class Sample(NamedTuple):
    """One sample: time [s], angle psi [rad], rate [rad/s], transverse force [m/s^2], base rate [rad/s], T above T_0 [K].

    ``vibration``: root mean square of the vibration along X0 [m/s^2], 0 if none is recorded.
    """

    t: float
    psi: float
    rate: float
    a_Y: float
    a_Z: float
    Omega_x: float
    Omega_Y: float
    Omega_Z: float
    T: float
    vibration: float
