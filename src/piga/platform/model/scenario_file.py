"""Shape of the scenario file: every table and key, as written by people (quantities with units)."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct, field

Quantity = str | float
Pair = tuple[Quantity, Quantity]
Still = ("0 deg", "10 s")
StillMetres = ("0 m", "10 s")


class SiteFile(Struct, forbid_unknown_fields=True, frozen=True):
    """``[site]``: where the base stands or starts."""

    latitude: Quantity
    longitude: Quantity = "0 deg"
    height: Quantity = "0 m"


class RunTable(Struct, forbid_unknown_fields=True, frozen=True):
    """``[run]``: length, interval between readouts, seed of all noise."""

    duration: Quantity
    step: Quantity = "1 s"
    seed: Annotated[int, Meta(ge=0)] = 1


class MotionFile(Struct, forbid_unknown_fields=True, frozen=True):
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


class CaseRotationFile(Struct, forbid_unknown_fields=True, frozen=True):
    """``[case_rotation]``; ``period = "none"`` leaves the cases at rest."""

    period: Quantity = "8 min"
    equatorial_period: Quantity | None = None
    reversal: str = "none"


class GyroFile(Struct, forbid_unknown_fields=True, frozen=True):
    """``[polar]`` and ``[equatorial]``."""

    misalignment: Quantity = "0 arcmin"
    phase: Quantity = "0 deg"
    harmonics: tuple[tuple[int, Quantity, Quantity], ...] = ()
    drift: Pair = ("0 deg/h", "0 deg/h")
    case_drift: Pair = ("0 deg/h", "0 deg/h")


class RedundancyFile(Struct, forbid_unknown_fields=True, frozen=True):
    """``[redundancy]``: by how much the equatorial momentum is off orthogonal at the start."""

    initial: Quantity = "0 deg"


class TriadFile(Struct, forbid_unknown_fields=True, frozen=True):
    """``[triad]``: rotation vector from inertial axes to the gyro triad at the start."""

    attitude: tuple[Quantity, Quantity, Quantity] = ("0 deg", "0 deg", "0 deg")


class PigaFile(Struct, forbid_unknown_fields=True, frozen=True):
    """``[sensors.piga]``: three gyro accelerometers on the platform."""

    scale_factor: Quantity = "0.8884 rad/s/g"
    beta: Quantity = "74 arcsec"
    mounting: Literal["orthogonal", "skewed"] = "orthogonal"
    cone: Quantity = "35 deg"
    output: Literal["raw", "triad"] = "triad"
    counts_per_revolution: Annotated[float, Meta(ge=0)] = 0.0
    tan_beta_error: Quantity = 0.0
    phase_error: Quantity = "0 deg"


class SensorsFile(Struct, forbid_unknown_fields=True, frozen=True):
    """``[sensors]``: white noise and quantisation of every readout; all zero when left out."""

    accelerometers: Literal["ideal", "piga"] = "ideal"
    gimbal_noise: Quantity = "0 arcsec"
    gimbal_quantisation: Quantity = "0 arcsec"
    pickoff_noise: Quantity = "0 arcsec"
    pickoff_quantisation: Quantity = "0 arcsec"
    velocity_random_walk: Quantity = "0 m/s/sqrt(s)"
    accelerometer_bias: tuple[Quantity, Quantity, Quantity] = ("0 ug", "0 ug", "0 ug")
    increment_quantisation: Quantity = "0 m/s"
    altitude_noise: Quantity = "0 m"
    piga: PigaFile = field(default_factory=PigaFile)


class CompensationFile(Struct, forbid_unknown_fields=True, frozen=True):
    """``[compensation]``: the models compared, and where what they know comes from."""

    models: tuple[Literal["none", "A", "B", "C"], ...] = ("none", "A", "B", "C")
    misalignment: Literal["identified", "true"] = "identified"
    redundancy: Literal["pick-off", "drift-model"] = "pick-off"
    harmonics: Annotated[int, Meta(ge=1, le=8)] = 3
    drift: Literal["none", "aligned", "true"] = "none"
    attitude: Literal["aligned", "true"] | None = None


class IdentificationFile(Struct, forbid_unknown_fields=True, frozen=True):
    """``[identification]``: the first stretch of the run, on which identification and alignment work."""

    duration: Quantity = "2 h"


class NavigationFile(Struct, forbid_unknown_fields=True, frozen=True):
    """``[navigation]``: time constant of the altitude damping of the vertical channel."""

    damping_time: Quantity = "100 s"


class ScenarioFile(Struct, forbid_unknown_fields=True, frozen=True):
    """The whole file."""

    site: SiteFile
    run: RunTable
    motion: MotionFile = field(default_factory=MotionFile)
    case_rotation: CaseRotationFile = field(default_factory=CaseRotationFile)
    polar: GyroFile = field(default_factory=GyroFile)
    equatorial: GyroFile = field(default_factory=GyroFile)
    redundancy: RedundancyFile = field(default_factory=RedundancyFile)
    triad: TriadFile = field(default_factory=TriadFile)
    sensors: SensorsFile = field(default_factory=SensorsFile)
    compensation: CompensationFile = field(default_factory=CompensationFile)
    identification: IdentificationFile = field(default_factory=IdentificationFile)
    navigation: NavigationFile = field(default_factory=NavigationFile)
