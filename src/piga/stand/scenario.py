"""Scenario files: their tables, conversion to stand and instrument, and the simulated test."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from piga.earth import Site
from piga.errors import ArgumentError, PigaError, RunFileError, UnitError
from piga.instrument import ErrorModel, Instrument
from piga.instrument.electronics import Electronics, Temperature
from piga.instrument.twin import twin_parameters
from piga.progress import Progress
from piga.records.run_file import (
    Columns,
    ColumnTable,
    Hertz,
    InstrumentTable,
    Quantity,
    Radians,
    Seconds,
    TomlTable,
    check_direct_unit,
    in_unit,
)
from piga.records.terms import (
    GYRO,
    UNITS,
    check_name,
    harmonic,
    integral_unit,
    level_in,
    scale_factor_in,
    turns,
    unit_of,
)
from piga.stand import machines
from piga.stand.profile import Composite, Imperfections, Stand, imperfections, read_profile
from piga.stand.simulate import Model, SimulatedTest, Specimen, simulate_test
from piga.text_files import read_toml
from piga.units import to_si

_Metres = Annotated[Quantity, in_unit("m")]
Acceleration = Annotated[Quantity, in_unit("m/s^2")]
_Kelvins = Annotated[Quantity, in_unit("K")]
_Gravities = Annotated[Quantity, in_unit("g")]


class SpecimenTable(InstrumentTable, frozen=True):
    """``[instrument]``, as in a run file: nominal parameters and known servo parameters."""

    counts_per_revolution: float = 72000.0


class ElectronicsTable(TomlTable, frozen=True):
    """``[electronics]``: readout, clock and noise. ``unit`` is that of the rate of a direct instrument."""

    sample_rate: Hertz
    output: Literal["counts", "angle", "rate"] = "counts"
    unit: str | None = None
    zero: Radians = 0.0
    angle_noise: Quantity = 0.0
    angle_random_walk: Quantity = 0.0
    bias_random_walk: Annotated[Quantity, in_unit("g/sqrt(s)")] = 0.0
    clock_offset: Seconds = 0.0
    clock_jitter: Seconds = 0.0


class NoiseTable(TomlTable, frozen=True):
    """``[noise]``: coloured noise of the bias along X0; none without this table.

    ``flicker`` is the standard deviation in one decade of frequency (1/f noise). ``markov`` is the standard deviation of a
    first-order Markov process with the correlation time ``markov_time``.
    """

    flicker: _Gravities = 0.0
    markov: _Gravities = 0.0
    markov_time: Seconds = 0.0


class TemperatureTable(TomlTable, frozen=True):
    """``[temperature]`` of the instrument; constant 20 degC without this table."""

    start: _Kelvins = "20 degC"
    drift: Annotated[Quantity, in_unit("K/s")] = 0.0
    swing: _Kelvins = "0 K"
    period: Seconds = "1 d"


class RunTable(TomlTable, frozen=True):
    """``[run]``: how the test is simulated and written."""

    model: Literal["quasi-steady", "twin"] = "quasi-steady"
    seed: int = 1
    start: Literal["slow-manifold", "transient"] = "slow-manifold"
    step: Seconds | None = None
    format: Literal["parquet", "csv"] = "parquet"
    imperfections: Literal["fixed", "drawn"] = "fixed"
    vibration: tuple[Quantity, ...] = ()


class SiteTable(TomlTable, frozen=True):
    """Place and gravity. All stands have these keys."""

    latitude: Radians
    longitude: Radians = 0.0
    height: _Metres = 0.0
    gravity: Acceleration | None = None

    def at_site(self) -> tuple[Site, dict[str, float]]:
        """The site, and the other quantities of the stand by key, in SI."""
        si = self.in_si("[stand] ")
        return Site(si.pop("latitude"), si.pop("longitude"), si.pop("height"), si.pop("gravity", None)), si


def _each(values: Sequence[Quantity], unit: str, key: str) -> tuple[float, ...]:
    return tuple(to_si(value, unit, what=f"[stand] {key}[{k}]") for k, value in enumerate(values))


class DividingHeadTable(SiteTable, frozen=True, tag_field="kind", tag="dividing-head"):
    """``[stand] kind = "dividing-head"``."""

    positions: str | tuple[Quantity, ...] = "0:360:15 deg"
    dwell: Seconds = "60 s"
    move: Seconds = "30 s"
    roll: Radians = 0.0
    azimuth: Radians = 0.0
    settling_time: Seconds = "5 s"

    def build(self, _folder: Path) -> Stand:
        """The stand."""
        site, si = self.at_site()
        return machines.DividingHead(site, head_positions(self.positions), **si)


def head_positions(value: str | Sequence[Quantity]) -> tuple[float, ...]:
    """Angles [rad] of a dividing head, from ``"start:stop:step unit"`` or a list of angles."""
    if not isinstance(value, str):
        return _each(value, "rad", "positions")
    return machines.angles_of_range(value, "[stand] positions", "0:360:15 deg")


class CentrifugeTable(SiteTable, frozen=True, tag_field="kind", tag="centrifuge"):
    """``[stand] kind = "centrifuge"``: ``levels`` of specific force, or ``rates``."""

    radius: _Metres = "1 m"
    levels: tuple[Quantity, ...] | None = None
    rates: tuple[Quantity, ...] | None = None
    down: bool = True
    dwell: Seconds = "60 s"
    ramp: Seconds = "60 s"
    stretch: Annotated[Quantity, in_unit("s^2/rad^2")] = 0.0
    counter_rotating: bool = False
    outward: bool = False
    roll: Radians = 0.0

    def build(self, _folder: Path) -> Stand:
        """The stand. With ``down`` the levels are run up and then down."""
        site, si = self.at_site()
        radius = si["radius"]
        if radius <= 0.0:
            raise ArgumentError(f"[stand] radius: {radius:g} m is not positive", remedy="e.g. '2.5 m'")
        if (self.levels is None) == (self.rates is None):
            raise ArgumentError("[stand] needs either levels or rates", remedy='e.g. levels = ["1 g", "2 g"]')
        rates = _each(self.rates or (), "rad/s", "rates")
        if self.levels is not None:
            rates = machines.rates_for_levels(_each(self.levels, "m/s^2", "levels"), radius, si["stretch"])
        spin = machines.SpinPlan(rates + rates[-2::-1] if self.down else rates, si.pop("dwell"), si.pop("ramp"))
        return machines.Centrifuge(
            site, spin=spin, counter_rotating=self.counter_rotating, outward=self.outward, **si
        )


class RateTableTable(SiteTable, frozen=True, tag_field="kind", tag="rate-table"):
    """``[stand] kind = "rate-table"``."""

    rates: tuple[Quantity, ...] = ("0 deg/s",)
    dwell: Seconds = "60 s"
    ramp: Seconds = "10 s"
    along: str = "X0"
    axis: Literal["vertical", "horizontal"] = "vertical"
    azimuth: Radians = 0.0
    offset: _Metres = 0.0

    def build(self, _folder: Path) -> Stand:
        """The stand."""
        site, si = self.at_site()
        spin = machines.SpinPlan(_each(self.rates, "rad/s", "rates"), si.pop("dwell"), si.pop("ramp"))
        return machines.RateTable(site, spin, self.along, self.axis == "horizontal", **si)


class DriveTable(TomlTable, frozen=True):
    """``[[stand.drives]]`` of a vibration table."""

    shape: Literal["rest", "sine", "sweep", "random"]
    duration: Seconds
    frequency: Hertz = "1 Hz"
    last_frequency: Hertz | None = None
    amplitude: Acceleration = 0.0
    taper: Seconds = "0.5 s"
    seed: int = 1

    def drive(self) -> machines.Drive:
        """The drive in SI."""
        si = self.in_si("[stand] drives.")
        return machines.Drive(self.shape, seed=self.seed, **({"last_frequency": si["frequency"]} | si))


class VibrationTableTable(SiteTable, frozen=True, tag_field="kind", tag="vibration-table"):
    """``[stand] kind = "vibration-table"``."""

    drives: tuple[DriveTable, ...] = ()
    axis: str = "X0"
    up: str = "X0"

    def build(self, _folder: Path) -> Stand:
        """The stand."""
        drives = tuple(drive.drive() for drive in self.drives)
        return machines.VibrationTable(self.at_site()[0], drives, self.axis, self.up)


class ProfileTable(TomlTable, frozen=True, tag_field="kind", tag="profile"):
    """``[stand] kind = "profile"``: a logged profile. The file is relative to the scenario."""

    file: str
    time: ColumnTable
    force: Columns
    base_rate: Columns | None = None

    def build(self, folder: Path) -> Stand:
        """The stand."""
        return read_profile(folder / self.file, self.time, self.force, self.base_rate)


SimpleStand = DividingHeadTable | CentrifugeTable | RateTableTable | VibrationTableTable | ProfileTable


class CompositeTable(TomlTable, frozen=True, tag_field="kind", tag="composite"):
    """``[stand] kind = "composite"``: the stands in ``[[stand.parts]]``, in order."""

    parts: tuple[SimpleStand, ...]
    pause: Seconds = "60 s"

    def build(self, folder: Path) -> Stand:
        """The stand."""
        return Composite(tuple(part.build(folder) for part in self.parts), **self.in_si("[stand] "))


class ScenarioTable(TomlTable, frozen=True):
    """A whole scenario file.

    ``truth``: true values by coefficient name, with ``beta`` (or ``tan_beta``) and ``alpha0``. ``twin``: parameters
    of the servo twin. ``imperfections``: by name. ``model``, ``estimation`` and ``uncertainty`` are copied into
    the run file.
    """

    instrument: SpecimenTable
    electronics: ElectronicsTable
    stand: SimpleStand | CompositeTable
    run: RunTable = RunTable()
    truth: dict[str, Quantity] = msgspec.field(default_factory=dict)
    twin: dict[str, Quantity] = msgspec.field(default_factory=dict)
    noise: NoiseTable = NoiseTable()
    temperature: TemperatureTable | None = None
    imperfections: dict[str, Any] = msgspec.field(default_factory=dict)
    model: dict[str, Any] = msgspec.field(default_factory=dict)
    estimation: dict[str, Any] = msgspec.field(default_factory=dict)
    uncertainty: dict[str, Any] = msgspec.field(default_factory=dict)


_APART = ("servo", "servo_damping", "k2v")
"""Terms that are no part of the error model of the exact motion."""
_MOTION = ("scale_factor", "beta", "tan_beta", "alpha0", "T_ref")


@dataclass(frozen=True)
class Scenario:
    """A scenario in SI, ready to run. ``table`` is the file as read."""

    path: Path
    table: ScenarioTable
    stand: Stand
    specimen: Specimen
    electronics: Electronics
    temperature: Temperature | None

    def imperfections(self, seed: int) -> Imperfections:
        """The imperfections, as given or drawn with ``seed``."""
        drawn = self.table.run.imperfections == "drawn"
        rng = np.random.default_rng([seed, 1]) if drawn else None
        return imperfections(self.table.imperfections, rng=rng)


def read_scenario(path: str | Path, *, content: str | None = None) -> Scenario:
    """Read a scenario file.

    ``content`` is the text of the file, for one that is not on disk. ``path`` is then its name in messages, and where the files
    that it names are looked for.

    Raises
    ------
    RunFileError
        For an unknown or missing key, a wrong unit or an implausible value. The message names file and key.
    """
    path = Path(path)
    raw = None if content is None else content.encode()
    return scenario_of(path, read_toml(path, ScenarioTable, raw))


def scenario_of(path: Path, table: ScenarioTable) -> Scenario:
    """The scenario of a table that was read from ``path``. Errors as in :func:`read_scenario`."""
    try:
        if table.instrument.servo is not None:
            table.instrument.servo.parameters()
        stand, warmth = table.stand.build(path.parent), table.temperature
        temperature = None if warmth is None else Temperature(**warmth.in_si("[temperature] "))
        scenario = Scenario(path, table, stand, _specimen(table), _electronics(table), temperature)
        scenario.imperfections(table.run.seed).require(stand.accepted, stand.kind)
    except (ArgumentError, RunFileError, UnitError) as error:
        raise RunFileError(f"{path}: {error.message}", remedy=error.remedy) from None
    return scenario


def run_scenario(
    scenario: Scenario,
    *,
    model: Model | None = None,
    seed: int | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> SimulatedTest:
    """Simulate a scenario. ``model`` and ``seed`` override the file. ``force`` and ``progress`` as in :func:`simulate_test`.

    Raises
    ------
    PigaError
        If its parts do not fit each other, or the servo loop is unstable without ``force``. The message names the file.
    """
    run = scenario.table.run
    chosen = run.seed if seed is None else seed
    try:
        return simulate_test(
            scenario.stand,
            scenario.specimen,
            scenario.electronics,
            imperfections=scenario.imperfections(chosen),
            temperature=scenario.temperature,
            vibration=[to_si(level, "g", what="[run] vibration") for level in run.vibration],
            model=model or run.model,
            seed=chosen,
            step=run.in_si("[run] ").get("step"),
            force=force,
            progress=progress,
        )
    except PigaError as error:
        raise type(error)(f"{scenario.path}: {error.message}", remedy=error.remedy) from None


def output_unit(table: ScenarioTable) -> str:
    """Unit of the output rate: rad/s, or that of a direct instrument.

    Raises
    ------
    RunFileError
        If the unit or a table belongs to the other kind of instrument.
    """
    unit, direct = table.electronics.unit, table.instrument.kind == "direct"
    if direct and unit is not None and table.electronics.output == "rate":
        check_direct_unit(unit, "[electronics] unit")
        return unit
    if unit is not None or (direct and table.electronics.output != "counts"):
        remedy = "use output = 'rate' with a unit, or 'counts' without one" if direct else "leave the unit out"
        has = "needs" if direct else "has no"
        raise RunFileError(f"[electronics] output '{table.electronics.output}' {has} unit", remedy=remedy)
    return "count/s" if direct else GYRO


def _specimen(table: ScenarioTable) -> Specimen:
    """The instrument, with the terms and harmonics of ``[truth]``."""
    truth, unit = table.truth, output_unit(table)
    for name in truth:
        if unit != GYRO and (name in ("beta", "alpha0") or turns(name)):
            raise ArgumentError(
                f"[truth]: '{name}' belongs to the gimbal of a gyro accelerometer, and the instrument is direct",
                remedy="leave it out",
            )
        if name not in _MOTION and (name == "phi" or not check_name(name)):
            keys = dict.fromkeys([*_MOTION, *UNITS, "s1", "c1", "s2", "..."])
            listed = ", ".join(key for key in keys if key != "phi")
            raise ArgumentError(f"[truth]: unknown key '{name}'", remedy=f"known keys: {listed}")
    if "beta" in truth and "tan_beta" in truth:
        raise ArgumentError("[truth]: beta and tan_beta are the same thing", remedy="leave one out")

    def si(name: str, like: str, value: Quantity = 0.0) -> float:
        return to_si(truth.get(name, value), like, what=f"[truth] {name}")

    tangent = si("tan_beta", "1")
    instrument = Instrument(
        scale_factor_in(truth.get("scale_factor", table.instrument.scale_factor), unit, "[truth] scale_factor"),
        si("beta", "rad") if "beta" in truth else math.atan(tangent),
        si("alpha0", "rad"),
    )
    servo, damping, k2v = (si(name, unit_of(name)) for name in _APART)
    if unit == GYRO and k2v:
        raise ArgumentError("[truth]: 'k2v' is simulated for a direct instrument only", remedy="leave it out")
    terms: dict[str, float] = {}
    harmonics: dict[int, tuple[float, float]] = {}
    for name in truth:
        wave = harmonic(name)
        if wave is not None:
            sine, cosine = harmonics.get(wave[1], (0.0, 0.0))
            harmonics[wave[1]] = (si(name, "g"), cosine) if wave[0] == "s" else (sine, si(name, "g"))
        elif name not in (*_MOTION, *_APART):
            terms[name] = si(name, unit_of(name))
    reference = si("T_ref", "K", table.model.get("temperature_reference", "20 degC"))
    model = ErrorModel(**terms | {"T_ref": reference})
    twin = twin_parameters(table.twin) if table.twin or table.run.model == "twin" else None
    return Specimen(instrument, model, harmonics, servo, damping, k2v, twin, table.run.start, unit)


def _electronics(table: ScenarioTable) -> Electronics:
    kind, unit = table.electronics.output, output_unit(table)
    noise = {
        name: level_in(
            getattr(table.electronics, name), f"{integral_unit(unit)}{like}", f"[electronics] {name}"
        )
        for name, like in (("angle_noise", ""), ("angle_random_walk", "/sqrt(s)"))
    }
    coloured = {f"bias_{name}": value for name, value in table.noise.in_si("[noise] ").items()}
    return Electronics(
        kind=kind,
        counts_per_revolution=table.instrument.counts_per_revolution if unit == GYRO else 2.0 * math.pi,
        counter_bits=table.instrument.counter_bits if kind == "counts" else None,
        **coloured,
        **noise,
        **table.electronics.in_si("[electronics] "),
    )
