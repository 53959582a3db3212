"""The platform scenario: tables of the TOML file in SI, and the scenario that they make.

The quantities of a document are brought to SI (:func:`in_si`) before it is converted into the tables.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta

from piga.errors import ArgumentError, RunFileError, UnitError
from piga.records.run_file import TomlTable, in_unit
from piga.text_files import convert_toml, toml_document
from piga.units import ARCSEC, G0, to_si

Model = Literal["none", "A", "B", "C"]
_MODELS: tuple[Model, ...] = ("none", "A", "B", "C")
Angle = Annotated[float, in_unit("rad")]
_TurnRate = Annotated[float, in_unit("rad/s")]
Length = Annotated[float, in_unit("m")]
Acceleration = Annotated[float, in_unit("m/s^2")]
Time = Annotated[float, Meta(gt=0, extra={"unit": "s"})]


class Place(TomlTable, frozen=True):
    """``[site]``: start of the run: geodetic latitude and longitude [rad], height [m]."""

    latitude: Angle
    longitude: Angle = 0.0
    height: Length = 0.0


class MotionPlan(TomlTable, frozen=True):
    """``[motion]`` of the base: start attitude [rad], turn rate [rad/s]; sways ``amplitude sin(2 pi t / period)``.

    A sway is ``["amplitude", "period"]`` [rad] or [m], [s].
    """

    kind: Literal["static", "turn", "sway", "track"] = "static"
    roll: Angle = 0.0
    pitch: Angle = 0.0
    heading: Angle = 0.0
    turn_rate: _TurnRate = 0.0
    roll_sway: tuple[Angle, Time] = (0.0, 10.0)
    pitch_sway: tuple[Angle, Time] = (0.0, 10.0)
    heading_sway: tuple[Angle, Time] = (0.0, 10.0)
    north_sway: tuple[Length, Time] = (0.0, 10.0)
    east_sway: tuple[Length, Time] = (0.0, 10.0)
    down_sway: tuple[Length, Time] = (0.0, 10.0)
    file: str | None = None


class Harmonic(NamedTuple):
    """One harmonic of the misalignment over a case turn: ``amplitude cos(order c + phase)`` [rad]."""

    order: Annotated[int, Meta(ge=1)]
    amplitude: Angle
    phase: Angle


class Gyro(TomlTable, frozen=True):
    """``[polar]``, ``[equatorial]``: misalignment m(c) [rad], its phase [rad], and drift [rad/s].

    ``drift`` stays, ``case_drift`` turns with the case.
    """

    misalignment: Angle = 0.0
    phase: Angle = 0.0
    harmonics: tuple[Harmonic, ...] = ()
    drift: tuple[_TurnRate, _TurnRate] = (0.0, 0.0)
    case_drift: tuple[_TurnRate, _TurnRate] = (0.0, 0.0)


class PigaSensors(TomlTable, frozen=True):
    """``[sensors.piga]``: three gyro accelerometers: K [(rad/s)/(m/s^2)], beta and start angles [rad], mounting.

    ``cone`` [rad] is the angle of skewed input axes to the platform's polar axis. ``output`` raw (``alpha'/K``) | triad
    (effective axes solved per sample). ``tan_beta_error`` and ``phase_error`` are the errors of the calibration that
    the triad solution uses.
    """

    scale_factor: Annotated[float, Meta(gt=0, extra={"unit": "rad/s/(m/s^2)"})] = 0.8884 / G0
    beta: Angle = 74.0 * ARCSEC
    alpha0: tuple[Angle, Angle, Angle] = (0.3, 1.7, 4.1)
    mounting: Literal["orthogonal", "skewed"] = "orthogonal"
    cone: Annotated[float, Meta(gt=0, extra={"unit": "rad"})] = math.radians(35.0)
    output: Literal["raw", "triad"] = "triad"
    counts_per_revolution: Annotated[float, Meta(ge=0)] = 0.0
    tan_beta_error: Annotated[float, in_unit("1")] = 0.0
    phase_error: Angle = 0.0

    @property
    def tan_beta(self) -> float:
        """tan(beta)."""
        return math.tan(self.beta)


class Sensors(TomlTable, frozen=True):
    """``[sensors]``: white noise (1 sigma) and quantisation steps of the readouts in SI; zero means ideal.

    ``piga`` counts if ``accelerometers`` says so.
    """

    accelerometers: Literal["ideal", "piga"] = "ideal"
    gimbal_noise: Angle = 0.0
    gimbal_quantisation: Angle = 0.0
    pickoff_noise: Angle = 0.0
    pickoff_quantisation: Angle = 0.0
    velocity_random_walk: Annotated[float, in_unit("m/s/sqrt(s)")] = 0.0
    accelerometer_bias: tuple[Acceleration, Acceleration, Acceleration] = (0.0, 0.0, 0.0)
    increment_quantisation: Annotated[float, in_unit("m/s")] = 0.0
    altitude_noise: Length = 0.0
    piga: PigaSensors = PigaSensors()

    @property
    def pigas(self) -> PigaSensors | None:
        """The gyro accelerometers, None with ideal ones."""
        return self.piga if self.accelerometers == "piga" else None


class Compensation(TomlTable, frozen=True):
    """``[compensation]``: the models compared, and with which numbers.

    ``misalignment`` identified | true; ``redundancy`` pick-off | drift-model; ``orders`` harmonics of
    model C; ``drift`` none | aligned | true: the gyro drift taken out; ``attitude`` aligned | true, None: by the motion.
    """

    models: tuple[Model, ...] = _MODELS
    misalignment: Literal["identified", "true"] = "identified"
    redundancy: Literal["pick-off", "drift-model"] = "pick-off"
    orders: Annotated[int, Meta(ge=1, le=8)] = msgspec.field(default=3, name="harmonics")
    drift: Literal["none", "aligned", "true"] = "none"
    attitude: Literal["aligned", "true"] | None = None


@dataclass(frozen=True)
class PlatformScenario:
    """A whole platform run in SI units; ``duration`` and ``step`` [s], ``redundancy`` eta at the start [rad].

    ``polar_rotation`` and ``equatorial_rotation`` are the rates of the cases [rad/s] (0: cases at rest), ``reversal`` the number
    of turns after which each turns back (0: never).
    ``triad``: rotation vector [rad] that carries inertial axes into the triad G at the start (what
    alignment has to find).
    """

    place: Place
    duration: float
    step: float = 1.0
    seed: int = 1
    motion: MotionPlan = field(default_factory=MotionPlan)
    polar_rotation: float = 0.0
    equatorial_rotation: float = 0.0
    reversal: int = 0
    polar: Gyro = field(default_factory=Gyro)
    equatorial: Gyro = field(default_factory=Gyro)
    redundancy: float = 0.0
    triad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sensors: Sensors = field(default_factory=Sensors)
    compensation: Compensation = field(default_factory=Compensation)
    calibration_time: float = 7200.0
    damping_time: float = 100.0
    source: str = ""

    @property
    def steps(self) -> int:
        """Number of steps of the run."""
        return round(self.duration / self.step)


class PlatformRunTable(TomlTable, frozen=True):
    """``[run]``: length, interval between readouts, seed of all noise."""

    duration: Time
    step: Time = 1.0
    seed: Annotated[int, Meta(ge=0)] = 1


class CaseRotationFile(TomlTable, frozen=True):
    """``[case_rotation]``; ``period = "none"`` leaves the cases at rest."""

    period: Literal["none"] | Time = 480.0
    equatorial_period: Literal["none"] | Time | None = None
    reversal: str = "none"


class RedundancyFile(TomlTable, frozen=True):
    """``[redundancy]``: by how much the equatorial momentum is off orthogonal at the start."""

    initial: Angle = 0.0


class PlatformTriadTable(TomlTable, frozen=True):
    """``[triad]``: rotation vector from inertial axes to the gyro triad at the start."""

    attitude: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)


class IdentificationFile(TomlTable, frozen=True):
    """``[identification]``: the first stretch of the run, on which identification and alignment work."""

    duration: Time = 7200.0


class NavigationFile(TomlTable, frozen=True):
    """``[navigation]``: time constant of the altitude damping of the vertical channel."""

    damping_time: Time = 100.0


class ScenarioFile(TomlTable, frozen=True):
    """The whole file."""

    site: Place
    run: PlatformRunTable
    motion: MotionPlan = MotionPlan()
    case_rotation: CaseRotationFile = CaseRotationFile()
    polar: Gyro = Gyro()
    equatorial: Gyro = Gyro()
    redundancy: RedundancyFile = RedundancyFile()
    triad: PlatformTriadTable = PlatformTriadTable()
    sensors: Sensors = Sensors()
    compensation: Compensation = Compensation()
    identification: IdentificationFile = IdentificationFile()
    navigation: NavigationFile = NavigationFile()

    def build(self, path: Path) -> PlatformScenario:
        """The scenario of this file, which lies at ``path``. Refuses what cannot be simulated by its key."""
        motion, cases, c, step = self.motion, self.case_rotation, self.compensation, self.run.step
        periods = (cases.period, cases.equatorial_period or cases.period)
        rates = [0.0 if isinstance(period, str) else 2.0 * math.pi / period for period in periods]
        reverses = re.fullmatch(r"none|each-turn|([1-9]\d*) turns?", cases.reversal)
        file = None if motion.file is None else str(path.parent / motion.file)
        scenario = PlatformScenario(
            place=self.site,
            duration=self.run.duration,
            step=step,
            seed=self.run.seed,
            motion=msgspec.structs.replace(motion, file=file),
            polar_rotation=rates[0],
            equatorial_rotation=rates[1],
            reversal=int(reverses[1] or cases.reversal == "each-turn") if reverses else 0,
            polar=self.polar,
            equatorial=self.equatorial,
            redundancy=self.redundancy.initial,
            triad=self.triad.attitude,
            sensors=self.sensors,
            compensation=msgspec.structs.replace(c, models=tuple(dict.fromkeys(c.models))),
            calibration_time=self.identification.duration,
            damping_time=self.navigation.damping_time,
            source=str(path),
        )
        steps, fastest = scenario.steps, max(rates)
        for wrong, message, remedy in (
            (motion.kind == "track" and not motion.file,
             "[motion] kind = 'track' needs a file", "add file = 'track.csv'"),
            (not reverses, f"[case_rotation] reversal = '{cases.reversal}' is not known",
             "write 'none', 'each-turn' or e.g. '3 turns'"),
            (not c.models, "[compensation] models is empty", "name one of none, A, B, C"),
            (motion.kind != "static" and "aligned" in (c.attitude, c.drift),
             "[compensation] attitude or drift = 'aligned' needs a static base",
             "write 'true', or [motion] kind = 'static'"),
            (steps < 8, f"[run] duration holds {steps} steps; at least 8 are needed",
             "lengthen the duration or shorten the step"),
            (abs(steps * step - scenario.duration) > 1e-6 * scenario.duration,
             f"[run] duration is not a whole number of steps of {step:g} s", f"write e.g. '{steps * step:g} s'"),
            (abs(self.site.latitude) > 1.5, "[site] latitude is within 4 deg of a pole, where the gimbals lock",
             "choose a lower latitude: near a pole the azimuth and polar gimbal axes become parallel"),
            (fastest * step > 0.8, f"[run] step {step:g} s gives fewer than 8 samples per case turn",
             "shorten the step or lengthen [case_rotation] period"),
        ):  # fmt: skip
            if wrong:
                raise ArgumentError(message, remedy=remedy)
        return scenario


def in_si(value: Any, kind: Any, path: tuple[str, ...] = ()) -> Any:
    """A value of a document with its quantities as numbers in SI, by the units in its type ``kind``; ``path``: its keys."""
    unit = next((note.extra["unit"] for note in getattr(kind, "__metadata__", ()) if note.extra), "")
    if unit:
        number = isinstance(value, str | int | float) and not isinstance(value, bool)
        return to_si(value, unit, what=f"[{'.'.join(path[:-1])}] {path[-1]}") if number else value
    fields = get_type_hints(kind, include_extras=True) if isinstance(kind, type) else {}
    parts = [part for part in get_args(kind) if part is not ...]
    if isinstance(value, dict):
        return {key: in_si(inner, fields.get(key), (*path, key)) for key, inner in value.items()}
    if isinstance(value, list):
        kinds = [*fields.values(), *parts] or [None]
        kinds += kinds[-1:] * len(value)
        return [in_si(v, kinds[i], (*path[:-1], f"{path[-1]}[{i}]")) for i, v in enumerate(value)]
    words = [word for part in parts if get_origin(part) is Literal for word in get_args(part)]
    quantity = next((part for part in parts if hasattr(part, "__metadata__")), None)
    return value if quantity is None or value in words else in_si(value, quantity, path)


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
    return scenario_of_document(path, toml_document(path, None if content is None else content.encode()))


def scenario_of_document(path: Path, document: dict[str, Any]) -> PlatformScenario:
    """The scenario of a document that was read from ``path``, and perhaps changed since."""
    try:
        return convert_toml(path, in_si(document, ScenarioFile), ScenarioFile).build(path)
    except (ArgumentError, UnitError) as error:
        raise RunFileError(f"{path}: {error.message}", remedy=error.remedy) from None
