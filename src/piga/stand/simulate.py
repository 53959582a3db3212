"""Simulate an instrument on a stand: the motion of the gimbal, and the log of the lab."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError
from piga.instrument import ErrorModel, Instrument, propagate
from piga.instrument.twin.electronics import (
    Electronics,
    Temperature,
    held_noise,
    interpolate,
    output_phases,
    random_walk,
    read_output,
    sampling_times,
    wandering_bias,
)
from piga.instrument.twin.linear import analyse_loop, require_stable, servo_force
from piga.instrument.twin.parameters import TwinParameters
from piga.instrument.twin.run import Start, TwinMotion, run_twin
from piga.progress import Progress, Steps
from piga.records.run import Run
from piga.records.run_file import ModelTable
from piga.records.terms import GYRO
from piga.results import Array, Plotted, Reported, Result
from piga.stand.profile import NONE, Imperfections, Profile, Stand, sample_stand
from piga.units import G0
from piga.upper import doors

if TYPE_CHECKING:
    from types import ModuleType


Model = Literal["quasi-steady", "twin"]
Harmonics = Mapping[int, tuple[float, float]]
_WAVE_STEP = 0.05
"""Largest gimbal rotation per step [rad] if servo waves are simulated. With straight lines between samples the waves are
too small by this squared over 12."""
_SMOOTH = 0.25
"""A motion is smooth where its fourth differences are below this share of its second differences (12 steps a period)."""


@dataclass(frozen=True)
class Specimen:
    """The instrument under test, true values in SI.

    ``error_model`` holds the polynomial and drift terms; ``harmonics`` maps an order to the amplitudes
    [m/s^2] of sine and cosine of that multiple of the *true* gimbal angle. ``servo`` and ``servo_damping``
    [1/(m/s^2)^2] are the coefficients of the servo's terms, ``k2v`` [1/(m/s^2)] is the vibration
    rectification. ``twin`` adds rotor, float and servo for the model
    ``twin``. Then K, beta and alpha0 of ``instrument`` replace those of the twin, and its motion contains the
    servo's terms. ``unit`` is that of the output rate: another one than ``rad/s`` makes it a direct instrument, with K in this
    unit per m/s^2.
    """

    instrument: Instrument
    error_model: ErrorModel = field(default_factory=ErrorModel)
    harmonics: Harmonics = field(default_factory=dict)
    servo: float = 0.0
    servo_damping: float = 0.0
    k2v: float = 0.0
    twin: TwinParameters | None = None
    start: Start = "slow-manifold"
    unit: str = GYRO

    @property
    def direct(self) -> bool:
        """True for a direct instrument: its ``unit`` is not that of a gyro accelerometer."""
        return self.unit != GYRO

    @property
    def design(self) -> TwinParameters:
        """The twin with this instrument's K, beta and alpha0.

        Raises
        ------
        ArgumentError
            If no twin is given.
        """
        if self.twin is None:
            raise ArgumentError("the model 'twin' needs [twin] parameters", remedy='e.g. preset = "example"')
        instrument = self.instrument
        twin = self.twin.with_scale_factor(instrument.scale_factor)
        return replace(twin, pick_off_null=instrument.beta, alpha0=instrument.alpha0)


@dataclass(frozen=True, eq=False, repr=False)
class Log(Result):
    """The lab's log, per row.

    Time [s], segment index and names, output, reference [m/s^2], base rate [rad/s], temperature [K],
    root mean square of the vibration [m/s^2].
    """

    t: Array
    segment: NDArray[np.int32]
    labels: tuple[str, ...]
    output: NDArray
    reference: Array
    base_rate: Array
    temperature: Array
    vibration: Array | None = None


@dataclass(frozen=True, eq=False, repr=False)
class SimulatedTest(Result, Plotted, Reported):
    """A simulated test: the log, and the truth on the fine grid of the simulation.

    ``plot()`` shows specific force and base rate of the reference: two panels.

    ``alpha`` [rad] and ``rate`` [rad/s] are at ``profile.t``; those of a direct instrument are its count and rate. ``motion`` is
    that of the twin, else None. ``phases`` [rad] are the phases of the output zero, one per segment of the log.
    """

    model: Model
    specimen: Specimen
    electronics: Electronics
    imperfections: Imperfections
    stand: Stand
    seed: int
    profile: Profile
    alpha: Array
    rate: Array
    motion: TwinMotion | None
    phases: tuple[float, ...]
    log: Log

    def _subject(self) -> ModuleType:
        return doors().shown_test()

    def to_run(self, serial: str = "simulated", *, model: ModelTable | dict[str, object] | None = None) -> Run:
        """The log as a run, for :func:`piga.calibrate`. The nominal scale factor is the true one.

        ``model`` is the run file's ``[model]``.
        """
        log, kind = self.log, self.electronics.kind
        columns: dict[str, NDArray] = {"t": log.t, "output": log.output, "temperature": log.temperature}
        columns |= {f"f{axis}": log.reference[:, i] for i, axis in enumerate("xyz")}
        direct = self.specimen.direct
        columns |= {} if direct else {f"w{axis}": log.base_rate[:, i] for i, axis in enumerate("xyz")}
        columns["segment"] = np.array(log.labels, dtype=object)[log.segment]
        counts = kind == "counts"
        return Run.from_dataframe(
            columns,
            scale_factor=self.specimen.instrument.scale_factor,
            units="SI",
            output="output",
            kind=kind,
            base_rate=None if direct else ("wx", "wy", "wz"),
            temperature="temperature",
            segment="segment",
            serial=serial,
            counts_per_revolution=self.electronics.counts_per_revolution if counts and not direct else None,
            unit=self.specimen.unit,
            counter_bits=self.electronics.counter_bits if counts else None,
            model=model,
        )


def simulate_test(
    stand: Stand,
    specimen: Specimen,
    electronics: Electronics,
    *,
    imperfections: Imperfections = NONE,
    temperature: Temperature | None = None,
    vibration: Sequence[float] = (),
    model: Model = "quasi-steady",
    seed: int = 1,
    step: float | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> SimulatedTest:
    """Simulate a test.

    Parameters
    ----------
    stand, specimen, electronics:
        The stand, the instrument under test, and its readout.
    imperfections:
        Deviations of the stand from its reference.
    vibration:
        Root mean square of the vibration along X0 in each segment [m/s^2], in order and again from the first.
    temperature:
        Temperature of the instrument; None: constant 20 degC.
    model:
        ``quasi-steady`` (the cross-coupled instrument) or ``twin`` (rotor, float and servo).
    seed:
        Seed of all noise; the same seed gives the same log to the bit.
    step:
        Step of the grid on which the stand's motion is sampled [s]. It is rounded down to divide the sample
        interval. None: chosen for the stand's fastest motion.
    force:
        Simulate an unstable servo loop, too. It has no slow manifold, so it starts with its transient.
    progress:
        Called as ``progress(done, total, what)`` before each step; it returns False to stop (:mod:`piga.progress`).

    Raises
    ------
    ArgumentError
        If the parts do not fit each other. :class:`UnstableDesignError` for an unstable loop.
    """
    steps = Steps(progress, 3)
    steps("motion of the stand")
    oversample = _oversample(stand, specimen, electronics, model, step)
    grid = electronics.interval / oversample
    profile = sample_stand(
        stand,
        electronics.interval,
        errors=imperfections,
        oversample=oversample,
        extra=_overshoot(stand, electronics, imperfections, grid),
    )
    steps("motion of the gimbal")
    streams = np.random.default_rng(seed).spawn(5)
    kelvin = (temperature or Temperature()).at(profile.t)
    test, motion = _Felt(specimen, electronics, profile, kelvin, grid, streams), None
    if specimen.direct:
        if model == "twin":
            raise ArgumentError(
                "model 'twin' is that of a gyro accelerometer, and the instrument is direct",
                remedy='use model "quasi-steady"',
            )
        recorded = np.array([part.recorded for part in profile.segments])
        number = np.where(recorded, np.cumsum(recorded) - 1, -1).astype(np.int32)
        alpha, rate = test.direct(_vibration_of(number[profile.segment], vibration))
    elif model == "twin":
        motion = test.twin(force=force)
        alpha, rate = motion.alpha, motion.rate
    else:
        alpha, rate = test.quasi_steady()
    steps("reading the output")
    log, phases = test.log(alpha, rate, oversample, imperfections)
    if vibration:
        log = replace(log, vibration=_vibration_of(log.segment, vibration))
    return SimulatedTest(
        model=model,
        specimen=specimen,
        electronics=electronics,
        imperfections=imperfections,
        stand=stand,
        seed=seed,
        profile=profile,
        alpha=alpha,
        rate=rate,
        motion=motion,
        phases=phases,
        log=log,
    )


def _oversample(
    stand: Stand, specimen: Specimen, electronics: Electronics, model: Model, step: float | None
) -> int:
    wanted = step if step is not None else min(stand.fastest, 0.05)
    if step is None and model == "quasi-steady" and (specimen.servo or specimen.servo_damping):
        wanted = min(wanted, _WAVE_STEP / _fastest_turn(stand, specimen, electronics.interval))
    if step is None and model == "twin":
        p = specimen.design
        noisy = p.pick_off_noise or p.torque_noise or electronics.angle_random_walk
        wanted = min(wanted, 5e-3) if noisy else wanted
    if wanted <= 0.0:
        raise ArgumentError(f"step: {wanted:g} s is not positive", remedy="e.g. '1 ms'")
    return max(1, math.ceil(electronics.interval / wanted - 1e-9))


def _fastest_turn(stand: Stand, specimen: Specimen, interval: float) -> float:
    """Largest output rate of the test [rad/s], at least that of 0.1 g."""
    profile, K = sample_stand(stand, interval), specimen.instrument.scale_factor
    return float(np.max(np.abs(K * profile.force[:, 0] - profile.base_rate[:, 0]), initial=0.1 * K * G0))


def _overshoot(stand: Stand, e: Electronics, errors: Imperfections, grid: float) -> int:
    """Rows needed after the end, for late samples."""
    end = stand.segments()[-1].stop
    late = max(0.0, end * errors.timing) + max(0.0, e.clock_offset) + 6.0 * e.clock_jitter
    return math.ceil(late / grid) if late > 0.0 else 0


def _vibration_of(segment: NDArray[np.int32], levels: Sequence[float]) -> Array:
    """Root mean square of the vibration [m/s^2] in each row: the levels by segment, again and again; 0 outside of segments."""
    if not levels:
        return np.zeros(segment.size)
    return np.where(segment < 0, 0.0, np.array(levels)[segment % len(levels)])


@dataclass(frozen=True)
class _Felt:
    """What an instrument feels on the stand, on the grid of the simulation [s]. Its motion and its log are computed from it."""

    specimen: Specimen
    electronics: Electronics
    profile: Profile
    kelvin: Array
    grid: float
    streams: list[np.random.Generator]

    def walk(self) -> Array:
        """Random walk of the output, (n,); a rate has none."""
        e = self.electronics
        density = 0.0 if e.kind == "rate" else e.angle_random_walk
        return random_walk(self.streams[0], self.profile.t.size, self.grid, density)

    def wander(self) -> Array:
        """Wandering bias along X0 [m/s^2], (n,)."""
        return wandering_bias(
            self.electronics, self.streams[1], self.streams[4], self.profile.t.size, self.grid
        )

    def quasi_steady(self) -> tuple[Array, Array]:
        """Exact motion. The random walk is exact, too: the transverse inputs are turned back by its angle."""
        specimen, profile, kelvin, walk = self.specimen, self.profile, self.kelvin, self.walk()
        force, base_rate = straightened(profile.force), straightened(profile.base_rate)
        wander = self.wander()
        force[:, 0] += wander
        felt = (force, base_rate)
        true_force = profile.force.copy()
        true_force[:, 0] += wander
        if walk.any():
            force, base_rate = _walked(force, walk), _walked(base_rate, walk)
        harmonic_rate = np.zeros(profile.t.size)
        for _ in range(20):
            shifted = base_rate.copy()
            shifted[:, 0] -= harmonic_rate
            alpha, rate = propagate(
                specimen.instrument,
                profile.t,
                force,
                shifted,
                with_rate=True,
                error_model=specimen.error_model,
                temperature=kelvin,
                between="linear",
            )
            alpha = alpha + walk
            new_rate = specimen.instrument.scale_factor * _forces_of_angle(specimen, alpha, *felt)
            if np.max(np.abs(new_rate - harmonic_rate)) < 1e-15:
                inst, model = specimen.instrument, specimen.error_model
                more = inst.scale_factor * (true_force - felt[0]) - (profile.base_rate - felt[1])
                polynomial = model.specific_force(profile.t, true_force, kelvin) - model.specific_force(
                    profile.t, felt[0], kelvin
                )
                return alpha, rate + more[:, 0] + inst.scale_factor * polynomial + inst.tan_beta * (
                    more[:, 1] * np.sin(alpha) - more[:, 2] * np.cos(alpha)
                )
            harmonic_rate = new_rate
        raise ArgumentError(
            "harmonics or servo terms: too large to be simulated",
            remedy="they are small corrections, e.g. 1e-5 g",
        )

    def direct(self, shaking: Array) -> tuple[Array, Array]:
        """Running count and rate of a direct instrument [its unit], (n,) each."""
        specimen, felt = self.specimen, self.profile.force.copy()
        felt[:, 0] += self.wander()
        force = felt[:, 0] + specimen.error_model.specific_force(self.profile.t, felt, self.kelvin)
        force += specimen.k2v * shaking**2
        rate = specimen.instrument.scale_factor * force
        straight = straightened(rate[:, None])[:, 0]
        count = np.concatenate(([0.0], np.cumsum(0.5 * self.grid * (straight[1:] + straight[:-1]))))
        return count + self.walk(), rate

    def twin(self, *, force: bool) -> TwinMotion:
        """Motion of rotor, float and servo."""
        specimen, profile, size, step = self.specimen, self.profile, self.profile.t.size, self.grid
        p = specimen.design
        stable = force and analyse_loop(p).stable
        if not force:
            require_stable(p)
            stable = True
        terms = specimen.error_model
        if specimen.servo or specimen.servo_damping:
            raise ArgumentError(
                "the terms servo and servo_damping cannot be prescribed to the twin: its servo makes them",
                remedy='set integral_gain and damping in [twin], or use model "quasi-steady"',
            )
        if specimen.harmonics or terms.s1 or terms.c1:
            raise ArgumentError(
                "harmonics of the gimbal angle cannot be prescribed to the twin: it makes its own",
                remedy='use model "quasi-steady", or leave s1, c1, s2, ... out',
            )
        felt = profile.force.copy()
        felt[:, 0] += terms.specific_force(profile.t, profile.force, self.kelvin)
        felt = straightened(felt)
        felt[:, 0] += self.wander()
        noise = np.zeros((size, 3))
        noise[:, 0] = held_noise(self.streams[2], size, step, p.torque_noise)
        noise[:-1, 1] = -p.angular_momentum * np.diff(self.walk()) / step
        noise[:, 2] = held_noise(self.streams[2], size, step, p.pick_off_noise)
        return run_twin(
            p,
            profile.t,
            felt,
            straightened(profile.base_rate),
            noise=noise,
            start=specimen.start if stable else "transient",
        )

    def log(
        self, alpha: Array, rate: Array, oversample: int, errors: Imperfections
    ) -> tuple[Log, tuple[float, ...]]:
        """The log, and the phase of its output zero per segment."""
        e, profile = self.electronics, self.profile
        start = float(profile.t[0])
        last = round((profile.segments[-1].stop - start) / e.interval)
        rows = np.arange(last + 1) * oversample
        rows = rows[profile.recorded[rows]]
        t = profile.t[rows]
        instants = sampling_times(e, t - start, errors.timing, self.streams[3]) + start
        slope = np.gradient(rate, self.grid)
        angle = interpolate(instants, start, self.grid, alpha, rate)
        output = read_output(e, angle, interpolate(instants, start, self.grid, rate, slope), self.streams[3])
        used, place = np.unique(profile.segment[rows], return_inverse=True)
        segment, labels = place.astype(np.int32), tuple(profile.segments[int(k)].label for k in used)
        log = Log(
            t,
            segment,
            labels,
            output,
            profile.reference[rows],
            profile.reference_rate[rows],
            self.kelvin[rows] - errors.temperature,
        )
        return log, output_phases(e, angle, output, segment)


def straightened(values: Array) -> Array:
    """Samples (n, k) whose linear interpolation has the integral of the smooth curve through ``values``.

    Linear interpolation of a wave with ``theta`` radian per step keeps ``(theta/2) cot(theta/2)`` of its integral. The
    samples are divided by this factor, up to fourth differences. Samples beside a step or kink of the motion are not
    changed: there the motion is linear between samples.
    """
    straight = values.copy()
    if len(values) < 5:
        return straight
    second = np.zeros_like(values)
    second[1:-1] = values[2:] - 2.0 * values[1:-1] + values[:-2]
    fourth = np.zeros_like(values)
    fourth[2:-2] = second[3:-1] - 2.0 * second[2:-2] + second[1:-3]
    near = [
        np.lib.stride_tricks.sliding_window_view(np.abs(x), 5, axis=0).max(axis=-1) for x in (second, fourth)
    ]
    inner = slice(2, -2)
    change = -second[inner] / 12.0 + 11.0 / 720.0 * fourth[inner]
    straight[inner] += np.where(near[1] <= _SMOOTH * near[0], change, 0.0)
    return straight


def _forces_of_angle(specimen: Specimen, alpha: Array, force: Array, base_rate: Array) -> Array:
    """Specific force [m/s^2] of harmonics and servo at gimbal angle ``alpha`` [rad], (n,)."""
    total = _harmonic_force(specimen.harmonics, alpha)
    if specimen.servo or specimen.servo_damping:
        K = specimen.instrument.scale_factor
        total += servo_force(specimen.servo, specimen.servo_damping, K, alpha, force, base_rate)
    return total


def _walked(vectors: Array, angle: Array) -> Array:
    """Transverse components in axes turned by ``angle`` about X0."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.column_stack([x, c * y + s * z, c * z - s * y])


def _harmonic_force(harmonics: Harmonics, alpha: Array) -> Array:
    """Specific force [m/s^2] that the harmonics add at gimbal angle ``alpha`` [rad], (n,)."""
    total = np.zeros(alpha.size)
    for order, (sine, cosine) in harmonics.items():
        total += sine * np.sin(order * alpha) + cosine * np.cos(order * alpha)
    return total
