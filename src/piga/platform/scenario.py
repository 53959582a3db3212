"""The platform scenario: a TOML file with units, its tables, and the tree of frozen SI values made from it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta
from msgspec import field as table_field

from piga.errors import RunFileError
from piga.records.run_file import TomlTable
from piga.records.text_files import convert_toml, read_toml
from piga.units import to_si

Quantity = str | float
Model = Literal["none", "A", "B", "C"]
MODELS: tuple[Model, ...] = ("none", "A", "B", "C")
Pair = tuple[Quantity, Quantity]
Three = tuple[Quantity, Quantity, Quantity]
Still = ("0 deg", "10 s")
StillMetres = ("0 m", "10 s")


class SiteFile(TomlTable, frozen=True):
    """``[site]``: where the base stands or starts."""

    latitude: Quantity
    longitude: Quantity = "0 deg"
    height: Quantity = "0 m"


class PlatformRunTable(TomlTable, frozen=True):
    """``[run]``: length, interval between readouts, seed of all noise."""

    duration: Quantity
    step: Quantity = "1 s"
    seed: Annotated[int, Meta(ge=0)] = 1


class MotionFile(TomlTable, frozen=True):
    """``[motion]``; sways are ``["amplitude", "period"]``."""

    kind: Literal["static", "turn", "sway", "track"] = "static"
    roll: Quantity = "0 deg"
    pitch: Quantity = "0 deg"
    heading: Quantity = "0 deg"
    turn_rate: Quantity = "0 deg/s"
    roll_sway: Pair = Still
    pitch_sway: Pair = Still
    heading_sway: Pair = Still
    north_sway: Pair = StillMetres
    east_sway: Pair = StillMetres
    down_sway: Pair = StillMetres
    file: str | None = None


class CaseRotationFile(TomlTable, frozen=True):
    """``[case_rotation]``; ``period = "none"`` leaves the cases at rest."""

    period: Quantity = "8 min"
    equatorial_period: Quantity | None = None
    reversal: str = "none"


class GyroFile(TomlTable, frozen=True):
    """``[polar]`` and ``[equatorial]``."""

    misalignment: Quantity = "0 arcmin"
    phase: Quantity = "0 deg"
    harmonics: tuple[tuple[int, Quantity, Quantity], ...] = ()
    drift: Pair = ("0 deg/h", "0 deg/h")
    case_drift: Pair = ("0 deg/h", "0 deg/h")


class RedundancyFile(TomlTable, frozen=True):
    """``[redundancy]``: by how much the equatorial momentum is off orthogonal at the start."""

    initial: Quantity = "0 deg"


class PlatformTriadTable(TomlTable, frozen=True):
    """``[triad]``: rotation vector from inertial axes to the gyro triad at the start."""

    attitude: Three = ("0 deg", "0 deg", "0 deg")


class PigaFile(TomlTable, frozen=True):
    """``[sensors.piga]``: three gyro accelerometers on the platform."""

    scale_factor: Quantity = "0.8884 rad/s/g"
    beta: Quantity = "74 arcsec"
    mounting: Literal["orthogonal", "skewed"] = "orthogonal"
    cone: Quantity = "35 deg"
    output: Literal["raw", "triad"] = "triad"
    counts_per_revolution: Annotated[float, Meta(ge=0)] = 0.0
    tan_beta_error: Quantity = 0.0
    phase_error: Quantity = "0 deg"


class SensorsFile(TomlTable, frozen=True):
    """``[sensors]``: white noise and quantisation of every readout; all zero when left out."""

    accelerometers: Literal["ideal", "piga"] = "ideal"
    gimbal_noise: Quantity = "0 arcsec"
    gimbal_quantisation: Quantity = "0 arcsec"
    pickoff_noise: Quantity = "0 arcsec"
    pickoff_quantisation: Quantity = "0 arcsec"
    velocity_random_walk: Quantity = "0 m/s/sqrt(s)"
    accelerometer_bias: Three = ("0 ug", "0 ug", "0 ug")
    increment_quantisation: Quantity = "0 m/s"
    altitude_noise: Quantity = "0 m"
    piga: PigaFile = table_field(default_factory=PigaFile)


class CompensationFile(TomlTable, frozen=True):
    """``[compensation]``: the models compared, and where what they know comes from."""

    models: tuple[Model, ...] = MODELS
    misalignment: Literal["identified", "true"] = "identified"
    redundancy: Literal["pick-off", "drift-model"] = "pick-off"
    harmonics: Annotated[int, Meta(ge=1, le=8)] = 3
    drift: Literal["none", "aligned", "true"] = "none"
    attitude: Literal["aligned", "true"] | None = None


class IdentificationFile(TomlTable, frozen=True):
    """``[identification]``: the first stretch of the run, on which identification and alignment work."""

    duration: Quantity = "2 h"


class NavigationFile(TomlTable, frozen=True):
    """``[navigation]``: time constant of the altitude damping of the vertical channel."""

    damping_time: Quantity = "100 s"


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

    def without_errors(self) -> PlatformScenario:
        """The scenario with perfect gyros and sensors: what the navigator alone does."""
        return replace(self, polar=Gyro(), equatorial=Gyro(), sensors=Sensors())


def load_scenario(path: str | Path, *, content: str | None = None) -> PlatformScenario:
    """Read a scenario file (TOML).

    ``content`` is the text of the file, for one that is not on disk. ``path`` is then its name in messages, and where the files
    that it names are looked for.

    Raises
    ------
    RunFileError
        If the file cannot be read, is not TOML, or a key is unknown, missing or out of range.
    UnitError
        If a quantity lacks its unit or has one of another kind.
    """
    path = Path(path)
    raw = None if content is None else content.encode()
    return _Reader(path).scenario(read_toml(path, ScenarioFile, raw))


def scenario_of_document(path: Path, document: dict[str, Any]) -> PlatformScenario:
    """The scenario of a document that was read from ``path``, and perhaps changed since.

    Raises
    ------
    RunFileError, UnitError
        As :func:`load_scenario`.
    """
    return _Reader(path).scenario(convert_toml(path, document, ScenarioFile))


_SENSOR_UNITS = {
    **dict.fromkeys(("gimbal_noise", "gimbal_quantisation", "pickoff_noise", "pickoff_quantisation"), "rad"),
    "velocity_random_walk": "m/s/sqrt(s)",
    "increment_quantisation": "m/s",
    "altitude_noise": "m",
}
"""SI units of the readout errors."""


class _Reader:
    """Turns the parsed file into SI values, naming file and key in every message."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def si(self, value: Quantity, unit: str, key: str) -> float:
        return to_si(value, unit, what=f"{self.path}: {key}")

    def each(self, table: TomlTable, section: str, units: dict[str, str]) -> dict[str, float]:
        """SI values of a table by key; ``units`` has the unit of each."""
        return {name: self.si(getattr(table, name), unit, f"{section} {name}") for name, unit in units.items()}

    def pair(self, values: Pair, unit: str, key: str) -> tuple[float, float]:
        first, second = (self.si(value, unit, key) for value in values)
        return first, second

    def three(self, values: Three, unit: str, key: str) -> tuple[float, float, float]:
        x, y, z = (self.si(value, unit, key) for value in values)
        return x, y, z

    def positive(self, value: Quantity, unit: str, key: str) -> float:
        number = self.si(value, unit, key)
        if number <= 0.0:
            raise RunFileError(
                f"{self.path}: {key} = {value!r} must be positive", remedy="give a value above 0"
            )
        return number

    def scenario(self, f: ScenarioFile) -> PlatformScenario:
        polar, equatorial = self.rotations(f)
        scenario = PlatformScenario(
            place=Place(**self.each(f.site, "[site]", {"latitude": "rad", "longitude": "rad", "height": "m"})),
            duration=self.positive(f.run.duration, "s", "[run] duration"),
            step=self.positive(f.run.step, "s", "[run] step"),
            seed=f.run.seed,
            motion=self.motion(f),
            polar_rotation=polar,
            equatorial_rotation=equatorial,
            polar=self.gyro(f.polar, "polar"),
            equatorial=self.gyro(f.equatorial, "equatorial"),
            redundancy=self.si(f.redundancy.initial, "rad", "[redundancy] initial"),
            triad=self.three(f.triad.attitude, "rad", "[triad] attitude"),
            sensors=self.sensors(f),
            compensation=self.compensation(f),
            calibration_time=self.positive(f.identification.duration, "s", "[identification] duration"),
            damping_time=self.positive(f.navigation.damping_time, "s", "[navigation] damping_time"),
            source=str(self.path),
        )
        self.check(scenario)
        return scenario

    def check(self, s: PlatformScenario) -> None:
        if s.steps < 8:
            raise RunFileError(
                f"{self.path}: [run] duration holds {s.steps} steps; at least 8 are needed",
                remedy="lengthen the duration or shorten the step",
            )
        if abs(s.steps * s.step - s.duration) > 1e-6 * s.step * s.steps:
            raise RunFileError(
                f"{self.path}: [run] duration is not a whole number of steps of {s.step:g} s",
                remedy=f"write e.g. '{s.steps * s.step:g} s'",
            )
        if abs(s.place.latitude) > 1.5:
            raise RunFileError(
                f"{self.path}: [site] latitude is within 4 deg of a pole, where the gimbals lock",
                remedy="choose a lower latitude: near a pole the azimuth and polar gimbal axes become parallel",
            )
        fastest = max(s.polar_rotation.rate, s.equatorial_rotation.rate)
        if fastest * s.step > 0.8:
            raise RunFileError(
                f"{self.path}: [run] step {s.step:g} s gives fewer than 8 samples per case turn",
                remedy="shorten the step or lengthen [case_rotation] period",
            )

    def rotations(self, f: ScenarioFile) -> tuple[Rotation, Rotation]:
        c, turns = f.case_rotation, 0
        words = c.reversal.split()
        if c.reversal == "each-turn":
            turns = 1
        elif len(words) == 2 and words[1] in {"turn", "turns"} and words[0].isdigit() and int(words[0]) > 0:
            turns = int(words[0])
        elif c.reversal != "none":
            raise RunFileError(
                f"{self.path}: [case_rotation] reversal = '{c.reversal}' is not known",
                remedy="write 'none', 'each-turn' or e.g. '3 turns'",
            )
        rates = []
        for period, key in ((c.period, "period"), (c.equatorial_period or c.period, "equatorial_period")):
            at_rest = period == "none"
            rates.append(
                0.0 if at_rest else 2.0 * math.pi / self.positive(period, "s", f"[case_rotation] {key}")
            )
        return Rotation(rates[0], turns), Rotation(rates[1], turns)

    def gyro(self, g: GyroFile, name: str) -> Gyro:
        harmonics = []
        for index, entry in enumerate(g.harmonics):
            key = f"[{name}] harmonics[{index}]"
            if entry[0] < 1:
                raise RunFileError(
                    f"{self.path}: {key}: order {entry[0]} is below 1", remedy='e.g. [1, "2 arcsec", "30 deg"]'
                )
            harmonics.append(Harmonic(entry[0], self.si(entry[1], "rad", key), self.si(entry[2], "rad", key)))
        key = f"[{name}]"
        return Gyro(
            misalignment=self.si(g.misalignment, "rad", f"{key} misalignment"),
            phase=self.si(g.phase, "rad", f"{key} phase"),
            harmonics=tuple(harmonics),
            drift=self.pair(g.drift, "rad/s", f"{key} drift"),
            case_drift=self.pair(g.case_drift, "rad/s", f"{key} case_drift"),
        )

    def motion(self, f: ScenarioFile) -> MotionPlan:
        m = f.motion
        sway = []
        for name, unit in (("roll_sway", "rad"), ("pitch_sway", "rad"), ("heading_sway", "rad"),
                           ("north_sway", "m"), ("east_sway", "m"), ("down_sway", "m")):  # fmt: skip
            amplitude, period = getattr(m, name)
            key = f"[motion] {name}"
            sway.append(Oscillation(self.si(amplitude, unit, key), self.positive(period, "s", key)))
        if m.kind == "track" and not m.file:
            raise RunFileError(
                f"{self.path}: [motion] kind = 'track' needs a file", remedy="add file = 'track.csv'"
            )
        return MotionPlan(
            kind=m.kind,
            **self.each(m, "[motion]", {"roll": "rad", "pitch": "rad", "heading": "rad", "turn_rate": "rad/s"}),
            sway=tuple(sway),
            file=self.path.parent / m.file if m.file else None,
        )

    def sensors(self, f: ScenarioFile) -> Sensors:
        s, key = f.sensors, "[sensors]"
        return Sensors(
            **self.each(s, key, _SENSOR_UNITS),
            accelerometer_bias=self.three(s.accelerometer_bias, "m/s^2", f"{key} accelerometer_bias"),
            piga=self.piga(f) if s.accelerometers == "piga" else None,
        )

    def piga(self, f: ScenarioFile) -> PigaSensors:
        p, key = f.sensors.piga, "[sensors.piga]"
        return PigaSensors(
            scale_factor=self.positive(p.scale_factor, "rad/s/g", f"{key} scale_factor"),
            tan_beta=math.tan(self.si(p.beta, "rad", f"{key} beta")),
            mounting=p.mounting,
            cone=self.positive(p.cone, "rad", f"{key} cone"),
            output=p.output,
            counts_per_revolution=p.counts_per_revolution,
            tan_beta_error=self.si(p.tan_beta_error, "1", f"{key} tan_beta_error"),
            phase_error=self.si(p.phase_error, "rad", f"{key} phase_error"),
        )

    def compensation(self, f: ScenarioFile) -> Compensation:
        c = f.compensation
        if not c.models:
            raise RunFileError(
                f"{self.path}: [compensation] models is empty", remedy="name one of none, A, B, C"
            )
        static = f.motion.kind == "static"
        attitude = c.attitude or ("aligned" if static else "true")
        if not static and (attitude == "aligned" or c.drift == "aligned"):
            raise RunFileError(
                f"{self.path}: [compensation] attitude or drift = 'aligned' needs a static base",
                remedy="write 'true', or [motion] kind = 'static'",
            )
        return Compensation(
            models=tuple(dict.fromkeys(c.models)),
            misalignment=c.misalignment,
            redundancy=c.redundancy,
            orders=c.harmonics,
            drift=c.drift,
            attitude=attitude,
        )
