"""The plan file (TOML): a scenario whose stand lists the candidates, and the wishes for the test.

It may contain every table of a scenario. ``[truth]`` gives the expected instrument, ``[stand]`` the candidate
positions or levels, ``[electronics]`` the noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec

from piga.calibration.model.request import Request, check_servo, with_phase
from piga.errors import PigaError, RunFileError, UnitError
from piga.records.run_file import ModelTable, Quantity, Seconds, TomlTable, UncertaintyTable
from piga.records.terms import GYRO, check_terms, scale_factor_in, si_factor, unit_of
from piga.results import Result
from piga.stand.scenario import (
    CentrifugeTable,
    CompositeTable,
    DividingHeadTable,
    NoiseTable,
    ProfileTable,
    RateTableTable,
    Scenario,
    ScenarioTable,
    SimpleStand,
    output_unit,
    scenario_of,
)
from piga.terms import LOGGED_TERMS
from piga.text_files import convert_table, read_toml
from piga.units import to_si

_PlannedStand = DividingHeadTable | CentrifugeTable | RateTableTable
"""Stands whose positions or levels can be chosen one by one."""
_TIMELY = ("k0_t", *LOGGED_TERMS)
"""Terms whose information depends on the time of a visit, not only on its duration."""


class PlanSettings(TomlTable, frozen=True):
    """``[plan]``: time, limits and criterion.

    ``criterion`` D: least volume of the uncertainty ellipsoid of ``coefficients``; A: least mean variance,
    each over its ``wanted`` (or equal-time) variance; c: least variance of ``combination``; wanted: least
    largest ratio to ``wanted``.
    """

    duration: Seconds
    criterion: Literal["D", "A", "c", "wanted"] = "D"
    coefficients: tuple[str, ...] | None = None
    combination: dict[str, float] = msgspec.field(default_factory=dict)
    wanted: dict[str, Quantity] = msgspec.field(default_factory=dict)
    move: Seconds | None = None
    minimum_dwell: Seconds = "30 s"
    longest_dwell: Seconds = "600 s"
    margin: float = 2.0
    whole_revolutions: bool = True
    shuffle: bool = True


class MountingTable(TomlTable, frozen=True):
    """``[mounting]``: a profile of the platform, and the skew angles to try."""

    profile: ProfileTable | _PlannedStand
    skew: str = "0:91:1 deg"
    clock: str = "0:360:15 deg"
    step: Seconds = "0.1 s"
    margin: float = 2.0


class PlanTable(ScenarioTable, frozen=True, kw_only=True):
    """A whole plan file."""

    plan: PlanSettings
    mounting: MountingTable | None = None


@dataclass(frozen=True, eq=False, repr=False)
class PlanRequest(Result):
    """A plan file in SI; times in s, ``wanted`` by coefficient key in file units."""

    path: Path
    table: PlanTable
    scenario: Scenario
    model: ModelTable
    uncertainty: UncertaintyTable
    duration: float
    move: float
    minimum_dwell: float
    longest_dwell: float
    wanted: dict[str, float]

    @property
    def settings(self) -> PlanSettings:
        """``[plan]`` as written."""
        return self.table.plan

    @property
    def unit(self) -> str:
        """Unit of the output rate."""
        return self.scenario.specimen.unit

    @property
    def direct(self) -> bool:
        """True for a direct instrument: it has no lock zone and no revolutions."""
        return self.scenario.specimen.direct

    @property
    def stands(self) -> tuple[SimpleStand, ...]:
        """The parts of the stand, one unless it is a composite."""
        return _parts(self.table)


def read_plan(path: str | Path, *, content: str | None = None) -> PlanRequest:
    """Read a plan file.

    ``content`` is the text of the file, for one that is not on disk. ``path`` is then its name in messages, and where the files
    that it names are looked for.

    Raises
    ------
    RunFileError
        For an unknown key, a wrong unit or a request that cannot be planned; names file and key.
    """
    path = Path(path)
    table = read_toml(path, PlanTable, None if content is None else content.encode())
    try:
        model: ModelTable = convert_table("model", table.model, ModelTable)
        uncertainty: UncertaintyTable = convert_table("uncertainty", table.uncertainty, UncertaintyTable)
        unit = output_unit(table)
        check_terms(model.terms, where="[model] terms", output=unit)
        _check(table, model)
        return _request(path, table, model, uncertainty)
    except (PigaError, UnitError) as error:
        if error.message.startswith(f"{path}:"):
            raise
        raise RunFileError(f"{path}: {error.message}", remedy=error.remedy) from None


def request_of(model: ModelTable) -> Request:
    """The request that the calibration of the test will make."""
    return Request(tuple(model.terms), model.phases, model.phase_source, "information", None, None, 293.15)


def _check(table: PlanTable, model: ModelTable) -> None:
    """Refuse requests that the information of single positions cannot answer."""
    timely = ", ".join(name for name in model.terms if name in _TIMELY)
    fixed = ", ".join(
        str(stand.__struct_config__.tag) for stand in _parts(table) if not isinstance(stand, _PlannedStand)
    )
    electronics, phase, plan = table.electronics, "tan_beta" in model.terms, table.plan
    known = [*model.terms, *(["phi"] if phase and model.phases == "shared" else [])]
    wished = {"coefficients": plan.coefficients or (), "combination": plan.combination, "wanted": plan.wanted}
    no_rate = electronics.output == "rate" and model.phases == "shared" and with_phase(model.terms)
    for refused, words, remedy in (
        (output_unit(table) != GYRO and table.mounting is not None,
         "[mounting] belongs to a gyro accelerometer, and the instrument is direct", "leave it out"),
        (timely, f"[model] terms: '{timely}' depends on when a position is taken and cannot be planned",
         "leave it out of the plan; it can still be estimated from the test"),
        (phase and not {"beta", "tan_beta"} & {*table.truth},
         "[truth] lacks beta: the uncertainty of its phase depends on the size of tan_beta",
         'add the expected size, e.g. beta = "20 arcsec"'),
        (no_rate, "[model] phases = 'shared': a log of rates does not tell how far the output turned in a move",
         "set phases = 'per-segment', or plan with output = 'counts' or 'angle'"),
        (electronics.bias_random_walk != 0.0, "[electronics] bias_random_walk is not part of the noise model of the estimator",
         "leave it out of the plan"),
        (table.noise != NoiseTable(), "[noise] is not part of the noise model of a plan: white noise and random walk are",
         "leave [noise] out of the plan"),
        (fixed, f"[stand] kind '{fixed}' has no positions or levels to choose from",
         "plan with a dividing head, centrifuge, rate table, or a composite of these"),
        *((name not in known, f"[plan] {key}: '{name}' is not estimated", f"estimated are: {', '.join(known)}")
          for key, names in wished.items() for name in names),
        *((plan.criterion == kind and not wished[key], f"[plan] criterion '{kind}' needs {key}",
           f"add {key} = {{ k0 = ... }}") for kind, key in (("c", "combination"), ("wanted", "wanted"))),
    ):  # fmt: skip
        if refused:
            raise RunFileError(words, remedy=remedy)
    check_servo(request_of(model))


def _parts(table: PlanTable) -> tuple[SimpleStand, ...]:
    """The parts of the stand, one unless it is a composite."""
    return table.stand.parts if isinstance(table.stand, CompositeTable) else (table.stand,)


def _request(path: Path, table: PlanTable, model: ModelTable, uncertainty: UncertaintyTable) -> PlanRequest:
    plan = table.plan
    times = plan.in_si("[plan] ")
    times.setdefault("move", _longest_move(table))
    for key, seconds in times.items():
        if not seconds > 0.0:
            raise RunFileError(f"[plan] {key}: {seconds:g} s is not positive", remedy="give a time above 0 s")
    if times["longest_dwell"] < times["minimum_dwell"]:
        raise RunFileError(
            "[plan] longest_dwell is below minimum_dwell", remedy="make longest_dwell at least as long"
        )
    wanted, output = {}, output_unit(table)
    for name, value in plan.wanted.items():
        what = f"[plan] wanted.{name}"
        scale = name == "scale_factor"
        si = scale_factor_in(value, output, what) if scale else to_si(value, unit_of(name), what=what)
        wanted[name] = si / si_factor(name)
        if not wanted[name] > 0.0:
            raise RunFileError(f"[plan] wanted.{name}: must be positive", remedy="give a standard uncertainty")
    return PlanRequest(path, table, scenario_of(path, table), model, uncertainty, wanted=wanted, **times)


def _longest_move(table: PlanTable) -> float:
    """The longest time that a part of the stand needs between two positions, or a composite between two parts [s]."""
    tables = (table.stand, *_parts(table))
    times = [one.in_si("[stand] ") for one in tables]
    return max(si[key] for si in times for key in ("move", "ramp", "pause") if key in si)
