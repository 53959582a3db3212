"""The calibration record. Calibration writes it, compensation reads it. It is data only."""

from __future__ import annotations

import datetime as dt
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike

from piga._version import __version__
from piga.errors import ArgumentError, CalibrationError
from piga.records.calibration.coefficient import (
    NO_REFERENCE,
    OF_THE_MODEL,
    BudgetTable,
    Coefficient,
    Level,
    Number,
    StandSource,
    rounded,
)
from piga.records.calibration.diagnostics import (
    Count,
    Diagnostics,
    Outlier,
    Quality,
    Residuals,
    SegmentSummary,
    Verdict,
    verdict,
)
from piga.records.run_file import check_direct_unit
from piga.records.terms import GYRO, check_name, integral_unit, scale_factor_in, unit_of
from piga.results import Array, ByValue, Reported, Result, drawn, first_lines, repr_of
from piga.tables import Column, Tabular, columns_of
from piga.units import from_si, numbers_are_si, to_si
from piga.upper import doors

if TYPE_CHECKING:
    from types import ModuleType

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from piga.instrument.parameters import ErrorModel, Instrument


class At(NamedTuple):
    """Place of a field in ``calibration.json``: its section (None: not in the file), key if not its name, and unit.

    Where there is a unit, the file states value and unit.
    """

    section: str | None = ""
    key: str = ""
    unit: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class RunRecord(Result):
    """One run of a joint calibration: its identity, noise, residuals, quality and inputs.

    ``raw`` is False if only the summary of the run was available. Its residual figures are then those of its own fit.
    ``undetermined`` names the terms that this run alone cannot determine.
    """

    name: str
    source: str
    stand: str | None
    phases: str
    raw: bool
    rows: Count
    angle_rms: Level
    angle_random_walk: Level
    residual_rms: Level
    residual_rms_before: Level
    residual_max_before: Level
    residual_max_after: Level
    quality: Quality
    undetermined: tuple[str, ...] = ()
    input_sha256: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, repr=False)
class Provenance(Result):
    """Origin of the numbers: software, method and inputs."""

    input_sha256: dict[str, str]
    software: str
    created: str
    options: dict[str, Any] = field(default_factory=dict)


def _figure(name: str, words: str) -> Callable[..., Figure]:
    def draw(self: CalibrationPlots, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        return drawn(doors().shown_calibration().figures(self.calibration)[name](), ax)

    draw.__name__, draw.__doc__ = name, words
    return draw


@dataclass(frozen=True)
class CalibrationPlots:
    """Figures of a calibration. See :func:`piga.results.drawn` for ``ax``.

    Raises
    ------
    CalibrationError
        If the calibration has no data for the figure, for instance no residuals after reading calibration.json.
    """

    calibration: Calibration

    residuals = _figure("residuals", "Residuals against time, before and after calibration: two panels.")
    orders = _figure("orders", "Ripple that the residuals show, against revolution order.")
    ripple = _figure("ripple", "Ripple around the turn of the output: two panels.")
    segments = _figure("segments", "Residuals of each segment.")
    allan = _figure("allan", "Allan deviation of the residual rate, with the noise of the model.")
    whiteness = _figure("whiteness", "Tests of the whitened residual.")


@dataclass(frozen=True, repr=False, eq=False, kw_only=True)
class Calibration(ByValue, Reported, Tabular, Mapping[str, Coefficient]):
    """Result of a calibration: coefficients with covariance, noise, residual figures and doubts.

    It is a mapping of coefficients in their order: ``cal["tan_beta"].value``; per-segment phases are ``cal["phi[3]"]``.
    ``in``, iteration, ``len``, ``keys``, ``values`` and ``items`` work as those of a dict. Coefficients are in the units
    of calibration.json; ``cal["k0"].value_si`` is SI, and so is everything else.
    Two calibrations are equal if they state the same. ``residuals`` do not count.
    ``notes`` are doubts, one sentence each. ``remarks`` are information, not doubts.
    ``surplus_observations`` is the number of observations (increments of the angle, rates, positions) minus the number
    of coefficients. It is not the degrees of freedom of an uncertainty: each coefficient has its own effective ones.
    ``segment_scatter`` [rad/s] is the scatter of the rates of the positions in the weights, 0 if none was detected.
    ``sources`` are the sources of Type B of the stand, stated or not; empty if they are not known. ``gravity`` says which
    local gravity the reference contains, empty if it is not known. ``unit`` is that of the output rate: ``rad/s``, or that of
    a direct instrument. Its residuals and noise are in this unit, or in the unit of its count.
    """

    serial: Annotated[str, At("instrument")]
    scale_factor_nominal: Annotated[Level, At("instrument", unit="{output}/g")]
    scale_factor_tolerance: Annotated[Level, At("instrument")] = 0.01
    terms: Annotated[tuple[str, ...], At("model")]
    method: Annotated[str, At("model")]
    phases: Annotated[str, At("model", "phase")] = "shared"
    phase_source: Annotated[str, At("model")] = "output"
    temperature_reference: Annotated[Level, At("model", unit="K")] = 293.15
    time_reference: Annotated[Number, At("model", unit="s")] = 0.0
    coefficients: tuple[Coefficient, ...]
    covariance: Array
    angle_rms: Annotated[Level, At("noise", unit="{count}")]
    angle_random_walk: Annotated[Level, At("noise", unit="{count}/sqrt(s)")]
    segment_scatter: Annotated[Level, At("noise", unit="{output}")] = 0.0
    residual_rms: Annotated[Level, At("residual", "rms", "{residual}")]
    residual_rms_before: Annotated[Level, At("residual", "rms_before", "{residual}")]
    residual_max_before: Annotated[Level, At("residual", "max_before", "{residual}")]
    residual_max_after: Annotated[Level, At("residual", "max_after", "{residual}")]
    surplus_observations: Level
    quality: Quality
    condition: Annotated[float, Meta(ge=1.0), At("identifiability")]
    notes: Annotated[tuple[str, ...], At("identifiability")] = ()
    remarks: Annotated[tuple[str, ...], At("identifiability")] = ()
    diagnostics: Diagnostics = field(default_factory=Diagnostics)
    segments: tuple[SegmentSummary, ...] = ()
    budget: Annotated[BudgetTable, At(key="uncertainty_budget")] = field(default_factory=BudgetTable)
    sources: Annotated[tuple[StandSource, ...], At(key="sources_of_the_stand")] = ()
    gravity: str = ""
    provenance: Provenance
    runs: tuple[RunRecord, ...] = ()
    outliers: tuple[Outlier, ...] = ()
    residuals: Annotated[Residuals | None, At(None)] = field(default=None, compare=False)
    unit: Annotated[str, At(None)] = GYRO

    def __post_init__(self) -> None:
        object.__setattr__(self, "budget", BudgetTable(tuple(self.budget)))

    @property
    def phase(self) -> str:
        """Former name of ``phases``."""
        return self.phases

    @property
    def direct(self) -> bool:
        """True for a direct instrument: one without a gimbal."""
        return self.unit != GYRO

    @property
    def residual_unit(self) -> str:
        """Unit of the residuals: rad, rad/s, count, or the unit of a direct instrument."""
        return self.unit if self.diagnostics.residual_kind == "rate" else integral_unit(self.unit)

    @property
    def type_a_only(self) -> bool:
        """True if the budget has no Type B source of the reference. The reference then counts as exact."""
        b = (row.source for row in self.budget if row.type == "B")
        return not self.given and all(source.startswith(OF_THE_MODEL) for source in b)

    @property
    def given(self) -> bool:
        """True if the coefficients were given (:meth:`from_coefficients`), not estimated from a record."""
        return self.quality.rows == 0 and not self.segments and not self.runs

    @property
    def verdict(self) -> Verdict:
        """The verdict of :func:`piga.records.calibration.diagnostics.verdict`: grade, reason, doubts, tests and sources."""
        return verdict(self)

    def __repr__(self) -> str:
        made = "given coefficients" if self.given else f"method {self.method}"
        named = f"<Calibration of {self.serial or 'an instrument'} by {made}, standard uncertainties"
        rows = [f"{c.key} = {rounded(c)} +- {c.std:.2g} {c.unit}" for c in self.coefficients]
        doubts = [f"  doubt: {doubt.words}" for doubt in self.verdict.doubts]
        judged = f"verdict: {self.verdict.headline}"
        return repr_of([named, *first_lines(rows, 5), judged, *first_lines(doubts, 3, ": summary()")])

    def _subject(self) -> ModuleType:
        return doors().shown_calibration()

    @property
    def plot(self) -> CalibrationPlots:
        """The report's figures, drawn with Matplotlib: ``cal.plot.residuals()``."""
        return CalibrationPlots(self)

    def table_columns(self) -> dict[str, Column]:
        """The coefficients as a table: one row each, in its own unit and in SI. Segment and run are empty where none is named."""
        units = dict.fromkeys(("value", "std", "expanded", "low", "high"), "as in column unit")
        units |= dict.fromkeys(("value_si", "std_si"), "as in column unit_si")
        rows = [
            {
                "coefficient": c.key,
                "name": c.name,
                "segment": c.segment or "",
                "run": c.run or "",
                "unit": c.unit,
            }
            | {"unit_si": c.unit_si, "value": c.value, "std": c.std, "expanded": c.expanded}
            | {"low": c.limits[0], "high": c.limits[1], "degrees_of_freedom": c.degrees_of_freedom}
            | {"value_si": c.value_si, "std_si": c.std_si}
            for c in self.coefficients
        ]
        return columns_of(rows, units)

    def table_notes(self) -> tuple[str, ...]:
        """The remark that the reference's uncertainty was not given, where it holds."""
        return (NO_REFERENCE,) if self.type_a_only else ()

    def __getitem__(self, key: str) -> Coefficient:
        for coefficient in self.coefficients:
            if coefficient.key == key:
                return coefficient
        raise KeyError(f"no coefficient '{key}'; there are: {', '.join(c.key for c in self.coefficients)}")

    def __iter__(self) -> Iterator[str]:
        return (coefficient.key for coefficient in self.coefficients)

    def __len__(self) -> int:
        return len(self.coefficients)

    def _ipython_key_completions_(self) -> list[str]:
        return list(self)

    def instrument(self, alpha0: float | str = 0.0) -> Instrument:
        """The calibrated instrument (SI): its scale factor, and ``beta`` from ``tan_beta``.

        A scale factor that was not estimated is the nominal one. ``alpha0`` [rad] is the gimbal angle at the start. It belongs
        to a run, so a calibration does not know it.
        """
        return doors().parameters().instrument_of(self, alpha0)

    def error_model(self) -> ErrorModel:
        """The other coefficients as an error model (SI), to propagate or simulate with.

        Warns
        -----
        PigaWarning
            If a coefficient has no place in the exact motion and is left out: a harmonic from the second on, or a term of
            the servo. The message names it.
        """
        return doors().parameters().error_model_of(self)

    @classmethod
    def from_coefficients(
        cls,
        coefficients: Mapping[str, Given],
        *,
        covariance: ArrayLike | None = None,
        serial: str = "",
        scale_factor_nominal: float | str | None = None,
        phase_source: str = "output",
        unit: str = GYRO,
    ) -> Calibration:
        """Make a calibration without a run, for instance from a data sheet.

        Parameters
        ----------
        coefficients:
            Value by name. A number is in the unit of calibration.json (``scale_factor`` rad/s/g, ``k0`` g); text carries
            its unit. A pair is value and standard uncertainty. A :class:`Coefficient` stands for itself.
            Phases of segments are named ``phi[3]``.
        covariance:
            Covariance (n, n) of the coefficients in their order and units. None: uncorrelated.
        serial, scale_factor_nominal, phase_source:
            As in a run file; the nominal scale factor is in SI or carries its unit. None: that of ``coefficients``.
        unit:
            Unit of the output rate of a direct instrument, e.g. ``"V"``: ``scale_factor`` is then in V/g.

        Raises
        ------
        ArgumentError
            If a name or unit is not known, or the covariance contradicts the uncertainties.

        Examples
        --------
        >>> import piga
        >>> cal = piga.Calibration.from_coefficients({"scale_factor": 0.8884, "tan_beta": (4.8e-3, 1e-6), "phi": 0.3})
        >>> cal["tan_beta"].std, list(cal)
        (1e-06, ['scale_factor', 'tan_beta', 'phi'])
        """
        from piga.records.calibration.document import calibration_from_bytes, calibration_to_bytes

        if unit != GYRO:
            check_direct_unit(unit, f"{_GIVEN} unit")
        named = [_given(key, value, unit) for key, value in coefficients.items()]
        matrix = (
            np.diag([c.std**2 for c in named]) if covariance is None else np.asarray(covariance, dtype=float)
        )
        if matrix.shape != (len(named), len(named)) or not np.isfinite(matrix).all():
            words = f"covariance: shape {matrix.shape}, but there are {len(named)} coefficients"
            raise _refusal(words, "give one row and one column of finite numbers for each, in their order")
        nominal = next((c.value_si for c in named if c.name == "scale_factor"), 0.0)
        if scale_factor_nominal is not None:
            with numbers_are_si(True):
                nominal = scale_factor_in(scale_factor_nominal, unit, f"{_GIVEN} scale_factor_nominal")
        if nominal <= 0.0:
            remedy = "add 'scale_factor' or scale_factor_nominal; if it is negative, reverse the input axis"
            raise _refusal("there is no positive scale factor", remedy)
        std = np.sqrt(np.maximum(np.diag(matrix), 0.0)).tolist()
        levels: dict[str, Any] = dict.fromkeys(_LEVELS, 0.0)
        made = cls(
            serial=serial,
            scale_factor_nominal=nominal,
            terms=tuple(c.name for c in named if c.name != "phi"),
            phases="per-segment" if any(c.segment is not None for c in named) else "shared",
            phase_source=phase_source,
            method="information",
            coefficients=tuple(
                replace(c, std=c.std or u, run=None, interval=None) for c, u in zip(named, std, strict=True)
            ),
            covariance=matrix,
            **levels,
            quality=Quality(0, 0, 0),
            condition=math.inf,
            notes=("the coefficients were given, not estimated from a record: no test was made",),
            provenance=Provenance(
                {}, f"piga {__version__}", dt.datetime.now(dt.UTC).isoformat(timespec="seconds")
            ),
            unit=unit,
        )
        try:  # the checks of a record that is read from a file
            return calibration_from_bytes(calibration_to_bytes(made), Path(_GIVEN))
        except CalibrationError as error:
            raise ArgumentError(error.message, remedy="correct the coefficients") from None

    def require_gimbal(self, what: str) -> None:
        """Refuse a direct instrument where a gimbal is needed. The message begins with ``what``."""
        if self.direct:
            raise CalibrationError(
                f"{what}: only for a gyro accelerometer, and the output of '{self.serial}' is in {self.unit}",
                remedy="use the coefficients by themselves: they are those of a plain polynomial",
            )

    def for_run(self, name: str) -> Calibration:
        """One run of a joint calibration as a calibration: the common coefficients and those of the run, under plain names.

        Raises
        ------
        CalibrationError
            If there is no such run.
        """
        record = next((run for run in self.runs if run.name == name), None)
        if record is None:
            known = ", ".join(run.name for run in self.runs) or "none: it is a calibration of one run"
            raise CalibrationError(f"the calibration has no run '{name}'", remedy=f"runs: {known}")
        chosen = [i for i, c in enumerate(self.coefficients) if c.run in (None, name)]
        plain = tuple(replace(self.coefficients[i], run=None) for i in chosen)
        names = {self.coefficients[i].key: c.key for i, c in zip(chosen, plain, strict=True)}
        return replace(
            self,
            coefficients=plain,
            covariance=self.covariance[np.ix_(chosen, chosen)],
            phases=record.phases,
            angle_rms=record.angle_rms,
            angle_random_walk=record.angle_random_walk,
            budget=BudgetTable(tuple(row.renamed(names) for row in self.budget)),
            residuals=None,
            runs=(),
        )

    def to_json(self, path: str | Path) -> None:
        """Write ``calibration.json`` (schema ``piga.calibration/1``)."""
        from piga.records.calibration.document import calibration_to_bytes

        Path(path).write_bytes(calibration_to_bytes(self))

    @staticmethod
    def from_json(path: str | Path) -> Calibration:
        """Read ``calibration.json``.

        Raises
        ------
        CalibrationError
            If the file is not a calibration record of a known schema.
        """
        from piga.records.calibration.document import read_with_digest

        return read_with_digest(Path(path))[0]


Given = float | str | tuple[float | str, float | str] | Coefficient
"""A coefficient as :meth:`Calibration.from_coefficients` takes it."""

_GIVEN = "Calibration.from_coefficients"
_LEVELS = (
    "angle_rms", "angle_random_walk", "residual_rms", "residual_rms_before", "residual_max_before", "residual_max_after",
    "surplus_observations",
)  # fmt: skip


def _refusal(message: str, remedy: str) -> ArgumentError:
    return ArgumentError(f"{_GIVEN}: {message}", remedy=remedy)


def _given(key: str, given: Given, output: str) -> Coefficient:
    parts = re.fullmatch(r"([^\[\]]+)(?:\[(.+)\])?", key)
    name, segment = parts.groups() if parts else (key, None)
    if not check_name(name):
        raise _refusal(f"unknown coefficient '{key}'", "e.g. scale_factor, tan_beta, phi, k0")
    if isinstance(given, Coefficient):
        if given.key != key:
            raise _refusal(f"'{key}' is the coefficient '{given.key}'", "use its own name")
        return given
    unit, what = unit_of(name, output), f"{_GIVEN} {key}"
    value, std = (
        from_si(to_si(number, unit, what=what), unit)
        if isinstance(number, str)
        else to_si(number, "1", what=what)
        for number in (given if isinstance(given, tuple) else (given, 0.0))
    )
    return Coefficient(name, value, std, unit, segment)
