"""The platform scenario: the tree of SI values, and the tables of the TOML file from which it is built."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta
from msgspec import field as table_field

from piga.errors import ArgumentError, RunFileError, UnitError
from piga.records.run_file import Quantity, Radians, Seconds, TomlTable, in_unit
from piga.records.text_files import convert_toml, read_toml
from piga.units import to_si

Model = Literal["none", "A", "B", "C"]
MODELS: tuple[Model, ...] = ("none", "A", "B", "C")
Metres = Annotated[Quantity, in_unit("m")]
Drifts = Annotated[tuple[Quantity, Quantity], in_unit("rad/s")]
Wave = tuple[Quantity, Quantity]
"""Amplitude and period of a sway."""
STILL: Wave = (0.0, "10 s")


@dataclass(frozen=True)
class Place:
    """Start of the run: geodetic latitude and longitude [rad], height [m]."""

    latitude: float
    longitude: float = 0.0
    height: float = 0.0


@dataclass(frozen=True)
class Oscillation:
    """``amplitude sin(2 pi t / period)``: amplitude [rad] or [m], period [s]."""

    amplitude: float
    period: float


@dataclass(frozen=True)
class MotionPlan:
    """Motion of the base: ``kind`` static | turn | sway | track; start attitude [rad]; turn rate [rad/s]."""

    kind: str = "static"
    roll: float = 0.0
    pitch: float = 0.0
    heading: float = 0.0
    turn_rate: float = 0.0
    sway: tuple[Oscillation, ...] = ()
    file: Path | None = None


@dataclass(frozen=True)
class Rotation:
    """Case rotation: ``rate`` [rad/s] (0: cases at rest) and ``turns`` between reversals (0: none)."""

    rate: float
    turns: int = 0


@dataclass(frozen=True)
class Harmonic:
    """One harmonic of the misalignment over a case turn: ``amplitude cos(order c + phase)`` [rad]."""

    order: int
    amplitude: float
    phase: float


@dataclass(frozen=True)
class Gyro:
    """One gyro: misalignment m(c) [rad], phase [rad], and drift [rad/s] that stays or turns with the case."""

    misalignment: float = 0.0
    phase: float = 0.0
    harmonics: tuple[Harmonic, ...] = ()
    drift: tuple[float, float] = (0.0, 0.0)
    case_drift: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class PigaSensors:
    """Three gyro accelerometers: K [(rad/s)/(m/s^2)], tan(beta), start angles [rad], mounting.

    ``mounting`` orthogonal | skewed; ``cone`` [rad] is the angle of skewed input axes to the platform's
    polar axis. ``output`` raw (``alpha'/K``) | triad (effective axes solved per sample).
    ``tan_beta_error`` and ``phase_error`` are the errors of the calibration that the triad solution uses.
    """

    scale_factor: float
    tan_beta: float
    alpha0: tuple[float, float, float] = (0.3, 1.7, 4.1)
    mounting: str = "orthogonal"
    cone: float = 0.6
    output: str = "triad"
    counts_per_revolution: float = 0.0
    tan_beta_error: float = 0.0
    phase_error: float = 0.0


@dataclass(frozen=True)
class Sensors:
    """Readout errors: white noise (1 sigma) and quantisation steps in SI; zero means ideal."""

    gimbal_noise: float = 0.0
    gimbal_quantisation: float = 0.0
    pickoff_noise: float = 0.0
    pickoff_quantisation: float = 0.0
    velocity_random_walk: float = 0.0
    accelerometer_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    increment_quantisation: float = 0.0
    altitude_noise: float = 0.0
    piga: PigaSensors | None = None


@dataclass(frozen=True)
class Compensation:
    """What the navigator removes, and with which numbers.

    ``misalignment`` identified | true; ``redundancy`` pick-off | drift-model; ``orders`` harmonics of
    model C; ``drift`` none | aligned | true: the gyro drift taken out; ``attitude`` aligned | true.
    """

    models: tuple[Model, ...] = MODELS
    misalignment: str = "identified"
    redundancy: str = "pick-off"
    orders: int = 3
    drift: str = "none"
    attitude: str = "aligned"


@dataclass(frozen=True)
class PlatformScenario:
    """A whole platform run in SI units; ``duration`` and ``step`` [s], ``redundancy`` eta at the start [rad].

    ``triad``: rotation vector [rad] that carries inertial axes into the triad G at the start (what
    alignment has to find).
    """

    place: Place
    duration: float
    step: float = 1.0
    seed: int = 1
    motion: MotionPlan = MotionPlan()
    polar_rotation: Rotation = Rotation(0.0)
    equatorial_rotation: Rotation = Rotation(0.0)
    polar: Gyro = Gyro()
    equatorial: Gyro = Gyro()
    redundancy: float = 0.0
    triad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sensors: Sensors = Sensors()
    compensation: Compensation = Compensation()
    calibration_time: float = 7200.0
    damping_time: float = 100.0
    source: str = ""

    @property
    def steps(self) -> int:
        """Number of steps of the run."""
        return round(self.duration / self.step)

    def check(self) -> None:
        """Refuse a scenario that the simulator cannot run.

        Raises
        ------
        ArgumentError
            The message names the key of the scenario file.
        """
        if self.steps < 8:
            raise ArgumentError(
                f"[run] duration holds {self.steps} steps; at least 8 are needed",
                remedy="lengthen the duration or shorten the step",
            )
        if abs(self.steps * self.step - self.duration) > 1e-6 * self.duration:
            raise ArgumentError(
                f"[run] duration is not a whole number of steps of {self.step:g} s",
                remedy=f"write e.g. '{self.steps * self.step:g} s'",
            )
        if abs(self.place.latitude) > 1.5:
            raise ArgumentError(
                "[site] latitude is within 4 deg of a pole, where the gimbals lock",
                remedy="choose a lower latitude: near a pole the azimuth and polar gimbal axes become parallel",
            )
        if max(self.polar_rotation.rate, self.equatorial_rotation.rate) * self.step > 0.8:
            raise ArgumentError(
                f"[run] step {self.step:g} s gives fewer than 8 samples per case turn",
                remedy="shorten the step or lengthen [case_rotation] period",
            )

    def without_errors(self) -> PlatformScenario:
        """The scenario with perfect gyros and sensors: what the navigator alone does."""
        return replace(self, polar=Gyro(), equatorial=Gyro(), sensors=Sensors())


class SiteFile(TomlTable, frozen=True):
    """``[site]``: where the base stands or starts."""

    latitude: Radians
    longitude: Radians = 0.0
    height: Metres = 0.0


class PlatformRunTable(TomlTable, frozen=True):
    """``[run]``: length, interval between readouts, seed of all noise."""

    duration: Seconds
    step: Seconds = "1 s"
    seed: Annotated[int, Meta(ge=0)] = 1


class MotionFile(TomlTable, frozen=True):
    """``[motion]``; sways are ``["amplitude", "period"]``."""

    kind: Literal["static", "turn", "sway", "track"] = "static"
    roll: Radians = 0.0
    pitch: Radians = 0.0
    heading: Radians = 0.0
    turn_rate: Annotated[Quantity, in_unit("rad/s")] = 0.0
    roll_sway: Wave = STILL
    pitch_sway: Wave = STILL
    heading_sway: Wave = STILL
    north_sway: Wave = STILL
    east_sway: Wave = STILL
    down_sway: Wave = STILL
    file: str | None = None

    def build(self, folder: Path) -> MotionPlan:
        """The motion of the base. The file of a track is relative to ``folder``."""
        if self.kind == "track" and not self.file:
            raise ArgumentError("[motion] kind = 'track' needs a file", remedy="add file = 'track.csv'")
        sway = []
        for name, unit in (("roll", "rad"), ("pitch", "rad"), ("heading", "rad"),
                           ("north", "m"), ("east", "m"), ("down", "m")):  # fmt: skip
            key = f"[motion] {name}_sway"
            amplitude, period = getattr(self, f"{name}_sway")
            sway.append(
                Oscillation(to_si(amplitude, unit, what=key), _positive(to_si(period, "s", what=key), key))
            )
        file = folder / self.file if self.file else None
        return MotionPlan(kind=self.kind, sway=tuple(sway), file=file, **self.in_si("[motion] "))


class CaseRotationFile(TomlTable, frozen=True):
    """``[case_rotation]``; ``period = "none"`` leaves the cases at rest."""

    period: Quantity = "8 min"
    equatorial_period: Quantity | None = None
    reversal: str = "none"

    def build(self) -> tuple[Rotation, Rotation]:
        """Rotation of the polar and of the equatorial case."""
        words, turns = self.reversal.split(), 0
        if self.reversal == "each-turn":
            turns = 1
        elif len(words) == 2 and words[1] in {"turn", "turns"} and words[0].isdigit() and int(words[0]) > 0:
            turns = int(words[0])
        elif self.reversal != "none":
            raise ArgumentError(
                f"[case_rotation] reversal = '{self.reversal}' is not known",
                remedy="write 'none', 'each-turn' or e.g. '3 turns'",
            )
        polar, equatorial = (
            0.0 if period == "none" else 2.0 * math.pi / _positive(to_si(period, "s", what=key), key)
            for period, key in (
                (self.period, "[case_rotation] period"),
                (self.equatorial_period or self.period, "[case_rotation] equatorial_period"),
            )
        )
        return Rotation(polar, turns), Rotation(equatorial, turns)


class GyroFile(TomlTable, frozen=True):
    """``[polar]`` and ``[equatorial]``."""

    misalignment: Radians = 0.0
    phase: Radians = 0.0
    harmonics: tuple[tuple[int, Quantity, Quantity], ...] = ()
    drift: Drifts = (0.0, 0.0)
    case_drift: Drifts = (0.0, 0.0)

    def build(self, section: str) -> Gyro:
        """The gyro of ``[section]``."""
        waves = []
        for index, (order, amplitude, phase) in enumerate(self.harmonics):
            key = f"[{section}] harmonics[{index}]"
            if order < 1:
                raise ArgumentError(f"{key}: order {order} is below 1", remedy='e.g. [1, "2 arcsec", "30 deg"]')
            waves.append(Harmonic(order, to_si(amplitude, "rad", what=key), to_si(phase, "rad", what=key)))
        return Gyro(harmonics=tuple(waves), **self.in_si(f"[{section}] "))


class RedundancyFile(TomlTable, frozen=True):
    """``[redundancy]``: by how much the equatorial momentum is off orthogonal at the start."""

    initial: Radians = 0.0


class PlatformTriadTable(TomlTable, frozen=True):
    """``[triad]``: rotation vector from inertial axes to the gyro triad at the start."""

    attitude: Annotated[tuple[Quantity, Quantity, Quantity], in_unit("rad")] = (0.0, 0.0, 0.0)


class PigaFile(TomlTable, frozen=True):
    """``[sensors.piga]``: three gyro accelerometers on the platform."""

    scale_factor: Annotated[Quantity, in_unit("rad/s/g")] = "0.8884 rad/s/g"
    beta: Radians = "74 arcsec"
    mounting: Literal["orthogonal", "skewed"] = "orthogonal"
    cone: Radians = "35 deg"
    output: Literal["raw", "triad"] = "triad"
    counts_per_revolution: Annotated[float, Meta(ge=0)] = 0.0
    tan_beta_error: Annotated[Quantity, in_unit("1")] = 0.0
    phase_error: Radians = 0.0

    def build(self) -> PigaSensors:
        """The instruments."""
        si = self.in_si("[sensors.piga] ")
        for key in ("scale_factor", "cone"):
            _positive(si[key], f"[sensors.piga] {key}")
        return PigaSensors(
            tan_beta=math.tan(si.pop("beta")),
            mounting=self.mounting,
            output=self.output,
            counts_per_revolution=self.counts_per_revolution,
            **si,
        )


class SensorsFile(TomlTable, frozen=True):
    """``[sensors]``: white noise and quantisation of every readout; all zero when left out."""

    accelerometers: Literal["ideal", "piga"] = "ideal"
    gimbal_noise: Radians = 0.0
    gimbal_quantisation: Radians = 0.0
    pickoff_noise: Radians = 0.0
    pickoff_quantisation: Radians = 0.0
    velocity_random_walk: Annotated[Quantity, in_unit("m/s/sqrt(s)")] = 0.0
    accelerometer_bias: Annotated[tuple[Quantity, Quantity, Quantity], in_unit("m/s^2")] = (0.0, 0.0, 0.0)
    increment_quantisation: Annotated[Quantity, in_unit("m/s")] = 0.0
    altitude_noise: Metres = 0.0
    piga: PigaFile = table_field(default_factory=PigaFile)

    def build(self) -> Sensors:
        """The sensors."""
        piga = self.piga.build() if self.accelerometers == "piga" else None
        return Sensors(piga=piga, **self.in_si("[sensors] "))


class CompensationFile(TomlTable, frozen=True):
    """``[compensation]``: the models compared, and where what they know comes from."""

    models: tuple[Model, ...] = MODELS
    misalignment: Literal["identified", "true"] = "identified"
    redundancy: Literal["pick-off", "drift-model"] = "pick-off"
    harmonics: Annotated[int, Meta(ge=1, le=8)] = 3
    drift: Literal["none", "aligned", "true"] = "none"
    attitude: Literal["aligned", "true"] | None = None

    def build(self, *, static: bool) -> Compensation:
        """The compensation for a base that is ``static`` or not."""
        if not self.models:
            raise ArgumentError("[compensation] models is empty", remedy="name one of none, A, B, C")
        attitude = self.attitude or ("aligned" if static else "true")
        if not static and "aligned" in (attitude, self.drift):
            raise ArgumentError(
                "[compensation] attitude or drift = 'aligned' needs a static base",
                remedy="write 'true', or [motion] kind = 'static'",
            )
        models = tuple(dict.fromkeys(self.models))
        return Compensation(models, self.misalignment, self.redundancy, self.harmonics, self.drift, attitude)


class IdentificationFile(TomlTable, frozen=True):
    """``[identification]``: the first stretch of the run, on which identification and alignment work."""

    duration: Seconds = "2 h"


class NavigationFile(TomlTable, frozen=True):
    """``[navigation]``: time constant of the altitude damping of the vertical channel."""

    damping_time: Seconds = "100 s"


class ScenarioFile(TomlTable, frozen=True):
    """The whole file."""

    site: SiteFile
    run: PlatformRunTable
    motion: MotionFile = table_field(default_factory=MotionFile)
    case_rotation: CaseRotationFile = table_field(default_factory=CaseRotationFile)
    polar: GyroFile = table_field(default_factory=GyroFile)
    equatorial: GyroFile = table_field(default_factory=GyroFile)
    redundancy: RedundancyFile = table_field(default_factory=RedundancyFile)
    triad: PlatformTriadTable = table_field(default_factory=PlatformTriadTable)
    sensors: SensorsFile = table_field(default_factory=SensorsFile)
    compensation: CompensationFile = table_field(default_factory=CompensationFile)
    identification: IdentificationFile = table_field(default_factory=IdentificationFile)
    navigation: NavigationFile = table_field(default_factory=NavigationFile)

    def build(self, path: Path) -> PlatformScenario:
        """The scenario of this file, which lies at ``path``."""
        run = self.run.in_si("[run] ")
        times = {
            "[run] duration": run["duration"],
            "[run] step": run["step"],
            "[identification] duration": self.identification.in_si("[identification] ")["duration"],
            "[navigation] damping_time": self.navigation.in_si("[navigation] ")["damping_time"],
        }
        duration, step, calibration, damping = (_positive(value, key) for key, value in times.items())
        polar, equatorial = self.case_rotation.build()
        scenario = PlatformScenario(
            place=Place(**self.site.in_si("[site] ")),
            duration=duration,
            step=step,
            seed=self.run.seed,
            motion=self.motion.build(path.parent),
            polar_rotation=polar,
            equatorial_rotation=equatorial,
            polar=self.polar.build("polar"),
            equatorial=self.equatorial.build("equatorial"),
            redundancy=self.redundancy.in_si("[redundancy] ")["initial"],
            triad=self.triad.in_si("[triad] ")["attitude"],
            sensors=self.sensors.build(),
            compensation=self.compensation.build(static=self.motion.kind == "static"),
            calibration_time=calibration,
            damping_time=damping,
            source=str(path),
        )
        scenario.check()
        return scenario


def _positive(value: float, key: str) -> float:
    """Refuse a value that is not above zero."""
    if value <= 0.0:
        raise ArgumentError(f"{key} must be positive", remedy="give a value above 0")
    return value


def load_scenario(path: str | Path, *, content: str | None = None) -> PlatformScenario:
    """Read a scenario file (TOML).

    ``content`` is the text of the file, for one that is not on disk. ``path`` is then its name in messages, and where the files
    that it names are looked for.

    Raises
    ------
    RunFileError
        If the file cannot be read, is not TOML, or a key is unknown, missing, out of range or of another unit.
    """
    path = Path(path)
    return _built(path, read_toml(path, ScenarioFile, None if content is None else content.encode()))


def scenario_of_document(path: Path, document: dict[str, Any]) -> PlatformScenario:
    """The scenario of a document that was read from ``path``, and perhaps changed since.

    Raises
    ------
    RunFileError
        As :func:`load_scenario`.
    """
    return _built(path, convert_toml(path, document, ScenarioFile))


def _built(path: Path, file: ScenarioFile) -> PlatformScenario:
    try:
        return file.build(path)
    except (ArgumentError, UnitError) as error:
        raise RunFileError(f"{path}: {error.message}", remedy=error.remedy) from None
