"""Simulate an instrument on a stand: the motion of the gimbal, and the log of the lab."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from piga.errors import ArgumentError
from piga.instrument import ErrorModel, Instrument, propagate
from piga.instrument.electronics import (
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
from piga.instrument.twin import (
    Start,
    TwinMotion,
    TwinParameters,
    loop_poles,
    require_stable,
    run_twin,
    servo_force,
)
from piga.progress import Progress, Steps
from piga.records.run import Run
from piga.records.run_file import ModelTable
from piga.records.terms import GYRO
from piga.results import Array, Plotted, Reported, Result
from piga.stand.machines import turned
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
        """The twin with this instrument's K, beta and alpha0; an ArgumentError if no twin is given."""
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
class SimulatedTest(Reported, Plotted, Result):
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
        log, kind, direct = self.log, self.electronics.kind, self.specimen.direct
        columns: dict[str, NDArray] = {"t": log.t, "output": log.output, "temperature": log.temperature}
        columns |= {f"f{axis}": log.reference[:, i] for i, axis in enumerate("xyz")}
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
    """Simulate a test of a ``specimen`` (the instrument) on a ``stand``, logged by ``electronics``.

    ``imperfections`` are deviations of the stand from its reference. ``vibration`` is the root mean square of the vibration
    along X0 in each segment [m/s^2], in order and again from the first. ``temperature`` is that of the instrument; None:
    constant 20 degC. ``model`` is ``quasi-steady`` (the cross-coupled instrument) or ``twin`` (rotor, float and servo). The
    same ``seed`` of all noise gives the same log to the bit. ``step`` [s] is that of the grid on which the stand's motion is
    sampled, rounded down to divide the sample interval; None: chosen for the stand's fastest motion. With ``force`` an
    unstable servo loop is simulated, too: it has no slow manifold, so it starts with its transient. ``progress`` is called as
    ``progress(done, total, what)`` before each step; it returns False to stop (:mod:`piga.progress`).

    Raises
    ------
    ArgumentError
        If the parts do not fit each other. :class:`UnstableDesignError` for an unstable loop.
    """
    steps = Steps(progress, 3)
    steps("motion of the stand")
    oversample = _oversample(stand, specimen, electronics, model, step)
    grid = electronics.interval / oversample
    end = max((segment.stop for segment in stand.segments()), default=0.0)
    late = (
        max(0.0, end * imperfections.timing)
        + max(0.0, electronics.clock_offset)
        + 6.0 * electronics.clock_jitter
    )
    profile = sample_stand(
        stand, electronics.interval, errors=imperfections, oversample=oversample, extra=math.ceil(late / grid)
    )
    steps("motion of the gimbal")
    streams = np.random.default_rng(seed).spawn(5)
    kelvin = (temperature or Temperature()).at(profile.t)
    felt, motion = _Felt(specimen, electronics, profile, kelvin, grid, streams), None
    if specimen.direct:
        if model == "twin":
            raise ArgumentError(
                "model 'twin' is that of a gyro accelerometer, and the instrument is direct",
                remedy='use model "quasi-steady"',
            )
        recorded = np.array([part.recorded for part in profile.segments])
        number = np.where(recorded, np.cumsum(recorded) - 1, -1).astype(np.int32)
        alpha, rate = felt.direct(_vibration_of(number[profile.segment], vibration))
    elif model == "twin":
        motion = felt.twin(force=force)
        alpha, rate = motion.alpha, motion.rate
    else:
        alpha, rate = felt.quasi_steady()
    steps("reading the output")
    log, phases = felt.log(alpha, rate, oversample, imperfections)
    if vibration:
        log = replace(log, vibration=_vibration_of(log.segment, vibration))
    return SimulatedTest(
        model, specimen, electronics, imperfections, stand, seed, profile, alpha, rate, motion, phases, log
    )


def _oversample(
    stand: Stand, specimen: Specimen, electronics: Electronics, model: Model, step: float | None
) -> int:
    """Points of the grid in a sample interval."""
    wanted = step if step is not None else min(stand.fastest, 0.05)
    if step is None and model == "quasi-steady" and (specimen.servo or specimen.servo_damping):
        profile, K = sample_stand(stand, electronics.interval), specimen.instrument.scale_factor
        rate = np.abs(K * profile.force[:, 0] - profile.base_rate[:, 0])
        wanted = min(wanted, _WAVE_STEP / float(np.max(rate, initial=0.1 * K * G0)))
    if step is None and model == "twin":
        p = specimen.design
        if p.pick_off_noise or p.torque_noise or electronics.angle_random_walk:
            wanted = min(wanted, 5e-3)
    if wanted <= 0.0:
        raise ArgumentError(f"step: {wanted:g} s is not positive", remedy="e.g. '1 ms'")
    return max(1, math.ceil(electronics.interval / wanted - 1e-9))


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
        specimen, t, kelvin, walk = self.specimen, self.profile.t, self.kelvin, self.walk()
        inst, model = specimen.instrument, specimen.error_model
        true_force, true_rate = self.profile.force.copy(), self.profile.base_rate
        force, base_rate = straightened(true_force), straightened(true_rate)
        wander = self.wander()
        true_force[:, 0] += wander
        force[:, 0] += wander
        # turned about X0: the machines turn about the third axis
        walked = [np.roll(turned(np.roll(v.T, -1, 0), walk), 1, 1) for v in (force, base_rate)]
        own_rate, still = np.zeros(t.size), walked[1][:, 0].copy()
        for _ in range(20):
            walked[1][:, 0] = still - own_rate
            alpha, rate = propagate(
                inst, t, *walked, with_rate=True, error_model=model, temperature=kelvin, between="linear"
            )
            alpha = alpha + walk
            own, own_rate = own_rate, inst.scale_factor * _forces_of_angle(specimen, alpha, force, base_rate)
            if np.max(np.abs(own_rate - own)) < 1e-15:
                more = inst.scale_factor * (true_force - force) - (true_rate - base_rate)
                true, smooth = (model.specific_force(t, felt, kelvin) for felt in (true_force, force))
                across = more[:, 1] * np.sin(alpha) - more[:, 2] * np.cos(alpha)
                return alpha, rate + more[:, 0] + inst.scale_factor * (true - smooth) + inst.tan_beta * across
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
        p, terms = specimen.design, specimen.error_model
        if not force:
            require_stable(p)
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
        unstable = force and np.max(loop_poles(p).real) >= 0.0
        start = "transient" if unstable else specimen.start
        return run_twin(p, profile.t, felt, straightened(profile.base_rate), noise=noise, start=start)

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
        reference, kelvin = (profile.reference[rows], profile.reference_rate[rows]), self.kelvin[rows]
        log = Log(t, segment, labels, output, *reference, kelvin - errors.temperature)
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
    second, fourth = np.zeros_like(values), np.zeros_like(values)
    second[1:-1] = values[2:] - 2.0 * values[1:-1] + values[:-2]
    fourth[2:-2] = second[3:-1] - 2.0 * second[2:-2] + second[1:-3]
    near = [sliding_window_view(np.abs(x), 5, axis=0).max(axis=-1) for x in (second, fourth)]
    inner = slice(2, -2)
    change = -second[inner] / 12.0 + 11.0 / 720.0 * fourth[inner]
    straight[inner] += np.where(near[1] <= _SMOOTH * near[0], change, 0.0)
    return straight


def _forces_of_angle(specimen: Specimen, alpha: Array, force: Array, base_rate: Array) -> Array:
    """Specific force [m/s^2] of harmonics and servo at gimbal angle ``alpha`` [rad], (n,)."""
    total = np.zeros(alpha.size)
    for order, (sine, cosine) in specimen.harmonics.items():
        total += sine * np.sin(order * alpha) + cosine * np.cos(order * alpha)
    if specimen.servo or specimen.servo_damping:
        K = specimen.instrument.scale_factor
        total += servo_force(specimen.servo, specimen.servo_damping, K, alpha, force, base_rate)
    return total
