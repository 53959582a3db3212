"""The run file (TOML). It describes one recorded test, its data file and the wanted calibration.

The classes mirror the tables of the file. :func:`read_run_file` checks everything that can be checked without the
data: keys, types, units, names of terms, and options that contradict each other.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, get_args

import msgspec

from piga.errors import DataError, RunFileError, UnitError
from piga.output import check_results
from piga.records.terms import GYRO, check_terms, integral_unit, scale_factor_in
from piga.text_files import check_label, convert_toml, si_unit, toml_document
from piga.units import conversion_factor, parse_unit, to_si

_GRAVITY_NORM = "gravity-norm"
"""Value of ``[data] reference`` in the run file of a set of accelerometers: the size of gravity is its reference."""
ASSUMED_SOURCES = ("earth_rate", "height", "servo")
"""Sources with a size that piga assumes if nobody states it. They can be waived, too."""
_Faults = Iterator[tuple[str, str]]
"""What is wrong, and the remedy."""
Quantity = str | float | int
"""Text with a unit, or a number in SI."""
Shape = Literal["normal", "rectangular", "triangular", "arcsine", "t"]

_DIVISORS = {"rectangular": math.sqrt(3.0), "triangular": math.sqrt(6.0), "arcsine": math.sqrt(2.0)}
"""Half-width divided by standard uncertainty (JCGM 100, 4.3.7 and 4.3.9; JCGM 101, 6.4.6)."""


class Spread(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """``{ half_width = "10 ppm", distribution = "rectangular", degrees_of_freedom = 8 }``.

    ``standard`` is the standard uncertainty of any distribution. ``half_width`` is the half-width of a bounded one.
    ``value`` is the standard uncertainty of a normal or t distribution. A plain string is the standard uncertainty of
    a normal distribution.
    """

    value: Quantity | None = None
    standard: Quantity | None = None
    half_width: Quantity | None = None
    distribution: Shape = "normal"
    degrees_of_freedom: float | None = None


class Given(Spread, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """``{ value = "3000 N m/(rad s)", standard = "60 N m/(rad s)" }``: a value with its uncertainty, as in :class:`Spread`."""

    value: Quantity


@dataclass(frozen=True)
class GivenParameter:
    """A parameter given in a file: SI value and standard uncertainty; ``unit`` and distribution for the budget."""

    name: str
    value: float
    standard: float
    unit: str
    distribution: str = "normal"
    degrees_of_freedom: float = math.inf


def standard_uncertainty(given: Spread | str | float, like: str, what: str) -> tuple[float, str, float]:
    """Standard uncertainty in SI, distribution, and degrees of freedom (infinite if not given).

    An entry that is negative, ambiguous or incomplete is refused. ``what`` names it in messages.
    """
    spread = given if isinstance(given, Spread) else Spread(standard=given)
    names = ("standard", "half_width") if isinstance(spread, Given) else ("value", "standard", "half_width")
    named = [name for name in names if getattr(spread, name) is not None]
    bounded, shape, nu = spread.distribution in _DIVISORS, spread.distribution, spread.degrees_of_freedom

    def refuse(message: str, remedy: str) -> NoReturn:
        raise RunFileError(f"{what}: {message}", remedy=remedy)

    if len(named) != 1:
        refuse("give either standard or half_width", "write exactly one of them")
    if named == ["value"] and bounded:
        why = f"'value' of a {shape} distribution could be half-width or standard uncertainty"
        refuse(why, "write half_width = ... or standard = ...")
    if named == ["half_width"] and not bounded:
        refuse(f"a {shape} distribution has no half-width", "give standard")
    if shape == "t" and not (nu or 0.0) > 2.0:
        refuse("distribution 't' needs more than two degrees_of_freedom", "add degrees_of_freedom")
    if nu is not None and not nu > 0.0:
        refuse("degrees_of_freedom must be positive", "leave it out if infinite")
    size = to_si(getattr(spread, named[0]), like, what=what)
    if size < 0.0:
        refuse(f"'{getattr(spread, named[0])}' is negative", "give a standard uncertainty")
    return size / (_DIVISORS[shape] if named == ["half_width"] else 1.0), shape, math.inf if nu is None else nu


def in_unit(unit: str) -> msgspec.Meta:
    """Mark of a key's type, ``Annotated[Quantity, in_unit("s")]``: its unit for :meth:`TomlTable.in_si`."""
    return msgspec.Meta(extra={"unit": unit})


Seconds = Annotated[Quantity, in_unit("s")]
Radians = Annotated[Quantity, in_unit("rad")]
Hertz = Annotated[Quantity, in_unit("Hz")]
_PartsPerMillion = Annotated[Quantity | Spread, in_unit("ppm")]
_MicroG = Annotated[Quantity | Spread, in_unit("ug")]
_ArcSeconds = Annotated[Quantity | Spread, in_unit("arcsec")]
_Damping = Annotated[Quantity | Given, in_unit("N m s/rad")]

MOST_HEAD_ROWS = 10_000
"""Largest row number of the header or the units in a text file."""
HeadRow = Annotated[int, msgspec.Meta(ge=1, le=MOST_HEAD_ROWS)]
HeadPair = Annotated[tuple[HeadRow, ...], msgspec.Meta(min_length=2, max_length=2)]

Phases = Literal["shared", "per-segment"]
PhaseSource = Literal["output", "input"]
Method = Literal["information", "rate", "published", "revolutions"]  # the last two stand in older files

PHASES, PHASE_SOURCES, METHODS = get_args(Phases), get_args(PhaseSource), get_args(Method)[:2]


class TomlTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Base of all tables: an unknown key is an error."""

    def in_si(self, where: str) -> dict[str, Any]:
        """SI values of the keys with a unit (:func:`in_unit`) and a value: of a list a tuple, of a column the factor of its unit.

        ``where`` stands before the key in messages, e.g. ``"[stand] "``.
        """
        given = {key: (getattr(self, key), unit) for key, unit in units_of(type(self)).items()}
        return {k: self._si(v, unit, f"{where}{k}") for k, (v, unit) in given.items() if v is not None}

    def _si(self, value: Any, unit: str, what: str) -> Any:
        if isinstance(value, (Columns, ColumnTable)):
            return conversion_factor(value.unit, unit, what=what)
        if isinstance(value, tuple):
            return tuple(self._si(v, unit, what) for v in value)
        return to_si(value, unit, what=what)


@cache
def units_of(table: type[TomlTable]) -> dict[str, str]:
    """Unit of each key whose type has one (:func:`in_unit`)."""
    return {entry.name: unit for entry in msgspec.structs.fields(table) if (unit := si_unit(entry.type))}


class ServoTable(TomlTable, frozen=True):
    """``[instrument] servo``: known parameters of the servo and the float, each with an optional uncertainty.

    The term ``servo`` is then a known part of the model. With ``damping`` (of the float), so is ``servo_damping``.
    """

    integral_gain: Annotated[Quantity | Given, in_unit("N m/(rad s)")]
    proportional_gain: Annotated[Quantity | Given, in_unit("N m/rad")] | None = None
    rate_gain: _Damping | None = None
    damping: _Damping | None = None
    pendulosity: Annotated[Quantity | Given, in_unit("kg m")] | None = None
    angular_momentum: Annotated[Quantity | Given, in_unit("kg m^2/s")] | None = None

    def parameters(self) -> tuple[GivenParameter, ...]:
        """The given parameters, in SI. One that is not physical is refused."""
        where, parameters = "[instrument] servo", []
        for name, like in units_of(ServoTable).items():
            given, what = getattr(self, name), f"{where}.{name}"
            if given is None:
                continue
            value = to_si(given.value if isinstance(given, Given) else given, like, what=what)
            least = (
                "positive" if name in ("integral_gain", "pendulosity", "angular_momentum") else "zero or more"
            )
            if value < 0.0 or (least == "positive" and value == 0.0):
                remedy = "correct the value: the terms of the servo need a servo with integral gain"
                raise RunFileError(f"{what}: must be {least}", remedy=remedy)
            uncertain = isinstance(given, Given) and (
                given.standard is not None or given.half_width is not None
            )
            u, shape, nu = standard_uncertainty(given, like, what) if uncertain else (0.0, "normal", math.inf)
            parameters.append(GivenParameter(name, value, u, like, shape, nu))
        if (self.pendulosity is None) == (self.angular_momentum is None):
            raise RunFileError(
                f"{where}: one of pendulosity and angular_momentum is needed",
                remedy="give exactly one: the pendulosity is scale_factor times the angular momentum",
            )
        return tuple(parameters)


class InstrumentTable(TomlTable, frozen=True):
    """``[instrument]``. A ``direct`` instrument has no gimbal: its output is a count, or a rate in any unit."""

    serial: str
    scale_factor: Quantity
    kind: Literal["gyro", "direct"] = "gyro"
    counts_per_revolution: Annotated[float, msgspec.Meta(ge=1e-6, le=1e15)] | None = None
    counter_bits: Annotated[int, msgspec.Meta(ge=1, le=62)] | None = None
    servo: ServoTable | None = None


class ColumnTable(TomlTable, frozen=True):
    """A column with its unit."""

    column: str
    unit: str


class TimeColumn(TomlTable, frozen=True):
    """The time column: numbers with a ``unit``, or time stamps of the form ``stamp``."""

    column: str
    unit: str | None = None
    stamp: str | None = None


class OutputColumn(TomlTable, frozen=True):
    """The output column: a running count, pulses of each sample, an angle or a rate.

    ``wraps_at`` is the value at which a logged angle folds back. ``direction`` is -1 if the output falls where the specific
    force along X0 is positive.
    """

    column: str
    kind: Literal["counts", "pulses", "angle", "rate"]
    unit: str | None = None
    wraps_at: Quantity | None = None
    direction: Literal[1, -1] = 1

    @property
    def counted(self) -> bool:
        """True for counts and pulses."""
        return self.kind in ("counts", "pulses")

    @property
    def fold(self) -> float | None:
        """Angle [rad] at which the output folds back; None if it does not. A plain number has the unit of the column."""
        if self.wraps_at is None:
            return None
        return to_si(self.wraps_at, "rad", what="[data] output.wraps_at", unit=self.unit)


class PositionColumn(TomlTable, frozen=True):
    """The angle or speed of the stand as logged. Each time at which it stands still is a segment; moves and ramps are left out."""

    holds_of: str


class SequenceColumn(TomlTable, frozen=True):
    """A sample number that increases by one. ``wraps_at`` is the value at which it returns to zero."""

    column: str
    wraps_at: Annotated[int, msgspec.Meta(ge=2)] | None = None


class Columns(TomlTable, frozen=True):
    """Three columns X0, Y0, Z0 with one unit."""

    columns: tuple[str, str, str]
    unit: str


class LeftOutTable(TomlTable, frozen=True):
    """Rows of the data file that are not used: the first and the last one, and why."""

    rows: tuple[int, int]
    reason: Annotated[str, msgspec.Meta(min_length=1, max_length=200)]


class DataTable(TomlTable, frozen=True):
    """``[data]``: the file, its columns and, if the file does not show it, its format."""

    file: str
    output: OutputColumn
    reference: Annotated[Columns, in_unit("g")] | None = None
    time: TimeColumn | None = None
    sample_rate: Hertz | None = None
    base_rate: Annotated[Columns, in_unit("rad/s")] | None = None
    temperature: Annotated[ColumnTable, in_unit("K")] | None = None
    vibration: Annotated[ColumnTable, in_unit("m/s^2")] | None = None
    segment: str | PositionColumn | None = None
    settle: Seconds | None = None
    delimiter: str | None = None
    decimal: Literal[".", ","] | None = None
    encoding: str | None = None
    skip_rows: Annotated[int, msgspec.Meta(ge=0, le=MOST_HEAD_ROWS)] = 0
    header_row: HeadRow | bool | HeadPair | None = None
    units_row: HeadRow | bool | None = None
    sheet: str | None = None
    missing: Annotated[tuple[str, ...], msgspec.Meta(max_length=100)] = ()
    damaged_rows: Literal["refuse", "mask"] = "refuse"
    range: dict[str, tuple[float, float]] | None = None
    leave_out: Annotated[tuple[LeftOutTable, ...], msgspec.Meta(max_length=1000)] = ()
    sequence: SequenceColumn | None = None

    def number_columns(self) -> list[str]:
        """Names of the number columns, each once, in reading order."""
        names = [one.column for one in (self.output, self.time, self.temperature, self.vibration) if one]
        names += [name for group in (self.reference, self.base_rate) if group for name in group.columns]
        names += [self.sequence.column] if self.sequence else []
        names += [self.segment.holds_of] if isinstance(self.segment, PositionColumn) else []
        return list(dict.fromkeys(names))

    @property
    def label_column(self) -> str | None:
        """The column that names the segments, if one does."""
        return self.segment if isinstance(self.segment, str) else None


_DEFAULT_TERMS = ("scale_factor", "tan_beta", "k0")


class ModelTable(TomlTable, frozen=True):
    """``[model]``: the terms to estimate, and whether the record has one phase of the output zero or one for each segment.

    ``compare`` lists further sets of terms, which are compared. A result whose K differs from the nominal value by more
    than ``scale_factor_tolerance`` (``"2 %"``; 1 % by default) is marked "do not use".
    """

    terms: tuple[str, ...] = _DEFAULT_TERMS
    compare: tuple[tuple[str, ...], ...] = ()
    phases: Phases = "shared"
    phase_source: PhaseSource = "output"
    temperature_reference: Annotated[Quantity, in_unit("K")] = "20 degC"
    scale_factor_tolerance: Annotated[Quantity, in_unit("%")] = "1 %"

    @property
    def tolerance(self) -> float:
        """Largest relative difference [1] of K from its nominal value with which a result may be used."""
        return to_si(self.scale_factor_tolerance, "%", what="[model] scale_factor_tolerance")

    def of(self, output: str, where: str = "[model] terms") -> ModelTable:
        """The table, checked, for an output rate in this unit: terms that nobody asked for are those of its kind."""
        table = self
        if output != GYRO and self.terms is _DEFAULT_TERMS:
            table = msgspec.structs.replace(self, terms=("scale_factor", "k0"))
        check_terms(table.terms, where=where, output=output)
        return table


class EstimationTable(TomlTable, frozen=True):
    """``[estimation]``: the method and known noise levels.

    ``per_run`` names the terms that may differ between the runs of a joint calibration; None: the bias.
    """

    method: Method = "information"
    per_run: tuple[str, ...] | None = None
    angle_rms: Quantity | None = None
    angle_random_walk: Quantity | None = None
    uncertainty: Literal["gum", "monte-carlo", "auto"] = "auto"


class UncertaintyTable(TomlTable, frozen=True):
    """``[uncertainty]``: Type B standard uncertainties of the reference, the clock and the stand.

    A string is the standard uncertainty of a normal distribution. :class:`Spread` describes other distributions. The entries
    below ``mounting_repeatability`` belong to particular stands and need the ``[stand]`` table. A ``..._repeatability`` has a
    new value in each segment (``angle_``, ``rate_``, ``reference_``, ``direction_``) or run (``mounting_``, ``levelling_``).
    ``reference_id`` names the device that gives the reference. Runs with the same device share its errors.
    ``vibration`` is the bias along X0 by rectification: k2 times the variance of a vibration that the log does not show.
    ``waived`` names sources that are left out on purpose, each with its reason in one line.
    """

    reference_id: str | None = None
    waived: dict[str, str] = {}

    reference_scale: _PartsPerMillion | None = None
    reference_bias: _MicroG | None = None
    reference_misalignment: _ArcSeconds | None = None
    gravity: _MicroG | None = None
    timing: _PartsPerMillion | None = None
    temperature: Annotated[Quantity | Spread, in_unit("K")] | None = None
    vibration: _MicroG | None = None
    reference_repeatability: _PartsPerMillion | None = None
    direction_repeatability: _ArcSeconds | None = None
    mounting_repeatability: _ArcSeconds | None = None
    levelling: Any = None
    angle_error: Any = None
    angle_harmonics: Any = None
    settling: Any = None
    arm_radius: Any = None
    arm_stretch: Any = None
    rate_error: Any = None
    rate_ripple: Any = None
    transverse_motion: Any = None
    rocking: Any = None
    angle_repeatability: Any = None
    rate_repeatability: Any = None
    levelling_repeatability: Any = None

    def _si(self, value: Any, unit: str, what: str) -> float:
        return standard_uncertainty(value, unit, what)[0]

    def of_the_stand(self) -> dict[str, Any]:
        """The stand-specific entries of this table."""
        entries = msgspec.structs.asdict(self)
        general = (*UNCERTAINTY_UNITS, "reference_id", "waived")
        return {name: v for name, v in entries.items() if name not in general and v is not None}


class RunFile(TomlTable, frozen=True):
    """A whole run file."""

    instrument: InstrumentTable
    data: DataTable
    model: ModelTable = ModelTable()
    estimation: EstimationTable = EstimationTable()
    uncertainty: UncertaintyTable = UncertaintyTable()
    stand: dict[str, Any] | None = None

    @property
    def unit(self) -> str:
        """Unit of the output rate: rad/s of a gyro accelerometer, the declared one of a direct instrument."""
        if self.instrument.kind == "gyro":
            return GYRO
        return "count/s" if self.data.output.counted else str(self.data.output.unit)


UNCERTAINTY_UNITS = units_of(UncertaintyTable)
"""Unit in which each Type B entry is reported. ``timing`` is the relative error of the clock's rate."""

Draw = Literal["reference", "run", "segment"]
"""Scope of one value of a Type B source: one reference (runs may share it), one run or one segment."""

REPEATED: dict[str, tuple[str, Draw]] = {
    "reference_repeatability": ("reference_scale", "segment"),
    "direction_repeatability": ("reference_misalignment", "segment"),
    "mounting_repeatability": ("reference_misalignment", "run"),
    "angle_repeatability": ("angle_error", "segment"),
    "rate_repeatability": ("rate_error", "segment"),
    "levelling_repeatability": ("levelling", "run"),
}
"""Repeatability entries: the error that each one repeats, and the scope of one value."""


def drawn_for(name: str) -> Draw:
    """Scope of one value of the entry ``name`` of ``[uncertainty]``."""
    return REPEATED[name][1] if name in REPEATED else "reference"


def is_set(document: dict[str, Any]) -> bool:
    """True for the tables of a run file of a set."""
    data = document.get("data")
    return isinstance(data, dict) and data.get("reference") == _GRAVITY_NORM


def read_run_file(path: str | Path, raw: bytes | None = None) -> RunFile:
    """Read and check a run file. ``raw``: its bytes, if they were read before.

    Raises
    ------
    RunFileError
        With file, table, key, value and remedy.
    """
    path = Path(path)
    check_results(path.parent)
    document = toml_document(path, raw)
    if is_set(document):
        words = f"{path}: the run file of a set of accelerometers ([data] reference = '{_GRAVITY_NORM}')"
        raise RunFileError(words, remedy="give it to 'piga calibrate'; only that command takes a set")
    run_file = convert_toml(path, document, RunFile)
    try:
        return check_run_file(run_file)
    except (DataError, UnitError, RunFileError) as error:
        raise RunFileError(f"{path}: {error.message}", remedy=error.remedy) from None


def check_run_file(run_file: RunFile) -> RunFile:
    """Check units, options that contradict each other, and terms. Returns the file with the terms of its kind of instrument."""
    if run_file.instrument.serial:
        check_label(run_file.instrument.serial, "[instrument] serial")
    refuse(_faults(run_file))
    model = run_file.model.of(run_file.unit)
    for terms in model.compare:
        check_terms(terms, where="[model] compare", output=run_file.unit)
    return msgspec.structs.replace(run_file, model=model)


def refuse(faults: _Faults) -> None:
    """Raise the first fault as a :class:`RunFileError`."""
    for message, remedy in faults:
        raise RunFileError(message, remedy=remedy)


def _faults(run_file: RunFile) -> _Faults:
    """Faults of a run file, those of its output first. Units of a wrong kind raise."""
    data, instrument, model, noise = run_file.data, run_file.instrument, run_file.model, run_file.estimation
    yield from _faults_of_output(run_file)
    yield from _faults_of_columns(data)
    if instrument.servo is not None:
        instrument.servo.parameters()
    run_file.uncertainty.in_si("[uncertainty] ")
    yield from faults_of_waived(run_file.uncertainty)
    model.in_si("[model] ")
    what, timing = "[instrument] scale_factor", data.in_si("[data] ")
    for key, value, remedy in (
        (what, scale_factor_in(instrument.scale_factor, run_file.unit, what), "reverse X0 in the reference"),
        ("[data] sample_rate", timing.get("sample_rate", 1.0), "e.g. '100 Hz'"),
        ("[model] scale_factor_tolerance", model.tolerance, "e.g. '2 %'"),
    ):
        if not value > 0.0:
            yield f"{key}: must be positive", f"use a positive value; {remedy}"
    if timing.get("settle", 0.0) < 0.0:
        yield "[data] settle: must be zero or more", "e.g. '20 s'"
    count, rms, walk = integral_unit(run_file.unit), noise.angle_rms, noise.angle_random_walk
    for name, level, like in (("angle_rms", rms, count), ("angle_random_walk", walk, f"{count}/sqrt(s)")):
        if level is not None and to_si(level, like, what=f"[estimation] {name}") < 0.0:
            yield f"[estimation] {name}: '{level}' is negative", "give a standard deviation"
    if (rms is None) != (walk is None):
        words = "[estimation] angle_rms and angle_random_walk: one of them is missing"
        yield words, "add the other one; write '0 rad' or '0 rad/sqrt(s)' if there is no such noise"
    stated = run_file.uncertainty.of_the_stand()
    if stated and run_file.stand is None:
        words = f"[uncertainty] {next(iter(stated))}: belongs to a stand, but there is no [stand] table"
        yield words, "add [stand] kind = '...', latitude = '...' and its positions or levels"


def _faults_of_columns(data: DataTable) -> _Faults:
    numbers, time = data.number_columns(), data.time
    if (time is None) == (data.sample_rate is None):
        yield "[data] needs either time or sample_rate", "e.g. time = { column = 't_s', unit = 's' }"
    if time is not None and (time.unit is None) == (time.stamp is None):
        remedy = "unit = 's' for numbers, stamp = 'iso' or 'DD.MM.YYYY hh:mm:ss.f' for time stamps"
        yield "[data] time: give either unit or stamp", remedy
    if time is not None and time.unit is not None:
        conversion_factor(time.unit, "s", what="[data] time")
    if data.decimal is not None and data.decimal == data.delimiter:
        yield "[data] decimal and delimiter are the same character", "correct one of them"
    for name, (low, high) in (data.range or {}).items():
        if name not in numbers:
            yield f"[data] range: '{name}' is not a column in use", f"columns are: {', '.join(numbers)}"
        if not low < high:
            yield f"[data] range: '{name}': {low:g} is not below {high:g}", "swap them"
    if data.label_column in numbers:
        words = f"[data] segment: '{data.segment}' is a number column that is in use already"
        yield words, "name another column for the segments"


def _faults_of_output(run_file: RunFile) -> _Faults:
    output, gyro = run_file.data.output, run_file.instrument.kind == "gyro"
    unit = output.unit or ""
    if not gyro:
        yield from _faults_of_direct(run_file)
    elif output.counted and run_file.instrument.counts_per_revolution is None:
        yield "[instrument] counts_per_revolution is missing, but [data] output is in counts", "add it"
    if output.counted and unit not in ("", "count", "counts", "1"):
        words = f"[data] output: unit '{unit}' cannot be used with kind '{output.kind}'"
        yield words, "leave the unit out, or set kind to 'angle' or 'rate'"
    like = "rad" if output.kind == "angle" else "rad/s"
    if not output.counted and not unit:
        yield f"[data] output: kind '{output.kind}' needs a unit", f"add unit = '{like}'"
    if not output.counted and gyro:
        conversion_factor(unit, like, what="[data] output")
    elif not output.counted:
        check_direct_unit(unit, "[data] output")
    if output.wraps_at is not None:
        if output.kind != "angle":
            yield "[data] output: wraps_at is for kind 'angle'", "for counts give [instrument] counter_bits"
        if not (output.fold or 0.0) > 0.0:
            yield "[data] output: wraps_at must be positive", "e.g. '360 deg'"


def _faults_of_direct(run_file: RunFile) -> _Faults:
    data, instrument = run_file.data, run_file.instrument
    given = {
        "[instrument] counts_per_revolution": instrument.counts_per_revolution,
        "[instrument] servo": instrument.servo,
        "[data] base_rate": data.base_rate,
        "[data] output: kind 'angle'": data.output if data.output.kind == "angle" else None,
    }
    for key in (key for key, value in given.items() if value is not None):
        remedy = "kind = 'counts', or 'rate' with its unit" if "output" in key else "leave it out"
        yield f"{key} belongs to a gyro accelerometer, and [instrument] kind is 'direct'", remedy


def check_direct_unit(unit: str, what: str) -> None:
    """Refuse a unit of the output rate that a direct instrument cannot have: an angle is that of a gimbal."""
    if parse_unit(unit).dimension[2] or unit == GYRO:
        remedy = "declare the unit of its output, e.g. 'V', 'mA' or 'Hz'; or leave [instrument] kind out"
        words = f"{what}: unit '{unit}' is that of an angle, and a direct instrument has no gimbal"
        raise RunFileError(words, remedy=remedy)


def faults_of_waived(uncertainty: UncertaintyTable) -> _Faults:
    """A waived source that does not exist, that is stated too, or that has no reason in one line."""
    where, entries = "[uncertainty] waived", msgspec.structs.asdict(uncertainty)
    known = (*(name for name in entries if name not in ("reference_id", "waived")), *ASSUMED_SOURCES)
    for name, reason in uncertainty.waived.items():
        if name not in known:
            yield f"{where}: there is no source '{name}'", f"sources: {', '.join(known)}"
        if entries.get(name) is not None:
            yield f"{where}: '{name}' is stated too", "leave one of the two out"
        if not reason.strip() or len(reason.splitlines()) != 1:
            yield f"{where}: '{name}' needs a reason in one line", f'e.g. waived = {{ {name} = "why" }}'
