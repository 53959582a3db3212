"""Output electronics: from the true gimbal angle to the values in the log.

Encoder counts with quantisation, counter width and roll-over; the sampling clock with offset, rate error
and jitter; angle random walk and bias drift; the thermometer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError
from piga.results import Array

Kind = Literal["counts", "angle", "rate"]


@dataclass(frozen=True)
class Electronics:
    """The readout of an instrument, SI.

    Parameters
    ----------
    sample_rate:
        Samples per second of the log's clock [Hz].
    kind:
        ``counts``, ``angle`` or ``rate``.
    counts_per_revolution:
        Encoder counts in one turn of the outer gimbal; used with ``counts``.
    counter_bits:
        Width of the counter. It shows the count modulo ``2^bits``. None: it does not wrap.
    zero:
        Gimbal angle at which the encoder reads zero [rad]: the unknown phase of a calibration.
    angle_noise:
        Standard deviation of the encoder's white noise [rad].
    angle_random_walk:
        White rate noise of the instrument [rad/sqrt(s)].
    bias_random_walk:
        Random walk of the bias [m/s^2/sqrt(s)].
    bias_flicker:
        Flicker noise of the bias: standard deviation in one decade of frequency [m/s^2].
    bias_markov, bias_markov_time:
        First-order Markov noise of the bias: standard deviation [m/s^2] and correlation time [s].
    clock_offset, clock_jitter:
        Offset and standard deviation of the sampling instants [s]. The relative error of the clock's rate
        is the stand imperfection ``timing``.
    """

    sample_rate: float = 100.0
    kind: Kind = "counts"
    counts_per_revolution: float = 72000.0
    counter_bits: int | None = None
    zero: float = 0.0
    angle_noise: float = 0.0
    angle_random_walk: float = 0.0
    bias_random_walk: float = 0.0
    bias_flicker: float = 0.0
    bias_markov: float = 0.0
    bias_markov_time: float = 0.0
    clock_offset: float = 0.0
    clock_jitter: float = 0.0

    def __post_init__(self) -> None:
        if self.sample_rate <= 0.0 or self.counts_per_revolution <= 0.0:
            raise ArgumentError(
                "electronics sample_rate and counts_per_revolution must be positive",
                remedy="use positive values",
            )
        if self.counter_bits is not None and not 1 <= self.counter_bits <= 62:
            raise ArgumentError(
                f"electronics counter_bits: {self.counter_bits} is outside 1 to 62",
                remedy="leave it out if the counter never wraps",
            )
        places = {
            name: f"electronics {name}" for name in ("angle_noise", "angle_random_walk", "bias_random_walk")
        }
        places |= {f"bias_{key}": f"[noise] {key}" for key in ("flicker", "markov", "markov_time")}
        for name, place in {**places, "clock_jitter": "electronics clock_jitter"}.items():
            if getattr(self, name) < 0.0:
                raise ArgumentError(f"{place}: {getattr(self, name):g} is negative", remedy="use zero or more")
        if self.bias_markov > 0.0 and self.bias_markov_time == 0.0:
            raise ArgumentError(
                "[noise] markov: its correlation time is missing", remedy='set [noise] markov_time, e.g. "5 s"'
            )

    @property
    def interval(self) -> float:
        """Interval between samples [s]."""
        return 1.0 / self.sample_rate


@dataclass(frozen=True)
class Temperature:
    """Temperature: ``start`` [K], linear ``drift`` [K/s], a ``swing`` [K] of ``period`` [s]."""

    start: float = 293.15
    drift: float = 0.0
    swing: float = 0.0
    period: float = 86400.0

    def at(self, t: Array) -> Array:
        """Temperature [K] at times ``t`` [s], (n,)."""
        return self.start + self.drift * t + self.swing * np.sin(2.0 * math.pi * t / self.period)


def random_walk(rng: np.random.Generator, size: int, step: float, density: float) -> Array:
    """Wiener process from zero, standard deviation ``density sqrt(t)``, at nodes ``step`` [s] apart."""
    if density == 0.0 or size < 2:
        return np.zeros(size)
    increments = density * math.sqrt(step) * rng.standard_normal(size - 1)
    return np.concatenate([[0.0], np.cumsum(increments)])


def wandering_bias(
    e: Electronics, rng: np.random.Generator, colour: np.random.Generator, size: int, step: float
) -> Array:
    """Bias [m/s^2] at nodes ``step`` [s] apart: random walk from ``rng``, flicker and Markov noise from ``colour``."""
    return (
        random_walk(rng, size, step, e.bias_random_walk)
        + flicker_noise(colour, size, e.bias_flicker)
        + markov_noise(colour, size, step, e.bias_markov, e.bias_markov_time)
    )


def flicker_noise(rng: np.random.Generator, size: int, level: float) -> Array:
    """Noise of the one-sided spectrum ``level^2/(ln(10) f)`` at equidistant nodes, from half a period in the record up.

    Each decade of frequency has the variance ``level^2``.
    """
    if level == 0.0 or size < 2:
        return np.zeros(size)
    count = 1 << math.ceil(math.log2(2 * size))
    order = np.arange(1, count // 2 + 1)
    waves = rng.standard_normal((2, order.size))
    spectrum = np.append(0.0, (waves[0] + 1j * waves[1]) * np.sqrt(1.0 / order))
    scale = level * count / (2.0 * math.sqrt(math.log(10.0)))
    return np.asarray(scale * np.fft.irfft(spectrum, count)[:size])


def markov_noise(rng: np.random.Generator, size: int, step: float, level: float, time: float) -> Array:
    """Stationary first-order Markov process at nodes ``step`` [s] apart: ``level^2 exp(-lag/time)`` is its covariance."""
    if level == 0.0 or size < 1:
        return np.zeros(size)
    from scipy.signal import lfilter

    kept = math.exp(-step / time)
    drawn = rng.standard_normal(size)
    drawn[1:] *= math.sqrt(-math.expm1(-2.0 * step / time))
    return np.asarray(level * lfilter([1.0], [1.0, -kept], drawn))


def held_noise(rng: np.random.Generator, size: int, step: float, density: float) -> Array:
    """White noise of one-sided ``density`` [unit sqrt(s)], held for ``step`` [s], (size,)."""
    return np.zeros(size) if density == 0.0 else density / math.sqrt(2.0 * step) * rng.standard_normal(size)


def sampling_times(e: Electronics, t: Array, timing: float, rng: np.random.Generator) -> Array:
    """True times [s] of the samples that the log's clock stamps ``t`` [s], (n,)."""
    jitter = e.clock_jitter * rng.standard_normal(t.size) if e.clock_jitter else 0.0
    return t * (1.0 + timing) + e.clock_offset + jitter


def interpolate(t: Array, start: float, step: float, value: Array, slope: Array) -> Array:
    """Cubic Hermite interpolation at ``t`` of a function known with its slope at equidistant nodes."""
    position = (t - start) / step
    i = np.clip(np.floor(position + 1e-9).astype(np.int64), 0, value.size - 2)
    s = position - i
    s = np.where(np.abs(s) < 1e-9, 0.0, s)
    rise = value[i + 1] - value[i]
    first, last = step * slope[i] - rise, step * slope[i + 1] - rise
    return np.asarray(value[i] + s * (rise + (1.0 - s) * ((1.0 - s) * first - s * last)))


def read_output(e: Electronics, alpha: Array, rate: Array, rng: np.random.Generator) -> NDArray:
    """Logged output for the true angle [rad] and rate [rad/s] at the sampling instants, (n,).

    Counts are 64-bit integers, rounded to the nearest and wrapped to the counter's width; angles [rad]
    count from ``zero``; rates [rad/s] carry the random walk as white noise.
    """
    if e.kind == "rate":
        noise = e.angle_random_walk * math.sqrt(e.sample_rate)
        return rate + noise * rng.standard_normal(rate.size) if noise else rate
    angle = alpha - e.zero
    if e.angle_noise:
        angle = angle + e.angle_noise * rng.standard_normal(angle.size)
    if e.kind == "angle":
        return angle
    counts = np.floor(angle * (e.counts_per_revolution / (2.0 * math.pi)) + 0.5).astype(np.int64)
    return counts if e.counter_bits is None else counts & ((1 << e.counter_bits) - 1)


def output_phases(
    e: Electronics, alpha: Array, output: NDArray, segment: NDArray[np.int32]
) -> tuple[float, ...]:
    """Phase ``phi = alpha - psi`` [rad] in (-pi, pi] of the output zero in each segment.

    If a counter wraps unseen in a gap, its zero is new after the gap.
    """
    starts = np.flatnonzero(np.diff(segment, prepend=-1))
    if e.kind != "counts" or e.counter_bits is None:
        zero = 0.0 if e.kind == "rate" else e.zero
        return (math.remainder(zero, 2.0 * math.pi),) * starts.size
    scale, span = 2.0 * math.pi / e.counts_per_revolution, float(1 << e.counter_bits)
    reading = np.unwrap(output, period=1 << e.counter_bits)[starts]
    folds = np.round(((alpha[starts] - e.zero) / scale - reading) / span)
    return tuple(math.remainder(e.zero + fold * span * scale, 2.0 * math.pi) for fold in folds)
