"""The calibration record: what calibration writes and compensation reads. Data only.

JSON schema ``piga.calibration/1`` (``records/schema/calibration-1.json``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from piga.records.coverage import Coverage, coverage, is_of_reference
from piga.records.verdict import Verdict, verdict

Array = NDArray[np.float64]

_SHOWN = 20
"""Coefficients that ``repr`` shows."""
Count = Annotated[int, Meta(ge=0)]
"""A number of rows or findings; the limit is checked where a record is read."""


LOOSE_PHASE = 0.5
"""Standard uncertainty [rad] of a phase above which it is called not determined."""


@dataclass(frozen=True)
class Coefficient:
    """One coefficient: value and standard uncertainty in ``unit`` (the unit of calibration.json).

    ``segment`` and ``run`` say whose it is; None where it serves all of them. ``degrees_of_freedom`` are the
    effective ones of the standard uncertainty (JCGM 100, G.4); ``interval`` is the shortest 95 % interval of a
    Monte Carlo propagation (JCGM 101) where that applies.
    """

    name: str
    value: float
    std: float
    unit: str
    segment: str | None = None
    run: str | None = None
    degrees_of_freedom: float = math.inf
    interval: tuple[float, float] | None = None

    @property
    def owner(self) -> str | None:
        """``segment``, ``run`` or ``run:segment``; None for a coefficient of the instrument."""
        parts = [part for part in (self.run, self.segment) if part is not None]
        return ":".join(parts) if parts else None

    @property
    def key(self) -> str:
        """``name`` or ``name[owner]``: the name used in the covariance."""
        return self.name if self.owner is None else f"{self.name}[{self.owner}]"

    @property
    def value_si(self) -> float:
        """Value in SI: ``cal["scale_factor"].value_si`` compares with ``Run.scale_factor`` [(rad/s)/(m/s^2)]."""
        from piga.records.terms import si_factor

        return self.value * si_factor(self.name)

    @property
    def coverage(self) -> Coverage:
        """Coverage factor, half-width and limits for 95 %: :func:`piga.records.coverage.coverage`."""
        return coverage(self)

    @property
    def determined(self) -> bool:
        """False for a phase whose standard uncertainty is above ``LOOSE_PHASE``: any angle would do as well."""
        return self.name != "phi" or self.std <= LOOSE_PHASE

    @property
    def coverage_factor(self) -> float:
        """Coverage factor for 95 %; nan where a Monte Carlo interval holds."""
        return self.coverage.factor

    @property
    def expanded(self) -> float:
        """Half-width of the 95 % interval: the expanded uncertainty U where the budget is complete."""
        return self.coverage.half_width

    @property
    def limits(self) -> tuple[float, float]:
        """Ends of the 95 % coverage interval."""
        return self.coverage.low, self.coverage.high


@dataclass(frozen=True)
class Event:
    """One kind of finding in the data: what, how often, first data row (1-based), detail in words."""

    kind: str
    count: Count
    first_row: int | None = None
    detail: str = ""


@dataclass(frozen=True)
class Quality:
    """Rows read, used and masked, and everything that was found or repaired on the way."""

    rows: Count
    used: Count
    masked: Count
    events: tuple[Event, ...] = ()


@dataclass(frozen=True)
class Outlier:
    """Samples of the output that do not lie on its path: ``kind`` spike, stuck or jump.

    ``time`` [s] and ``row`` (file row) of the first, ``samples`` left out (0 for a jump), ``size`` [rad, rad/s for
    a rate log] of the largest miss, ``run`` in a joint calibration.
    """

    kind: str
    time: float
    row: int
    samples: int
    size: float
    run: str | None = None


@dataclass(frozen=True)
class SegmentSummary:
    """Residual figures of one segment: rows, duration [s], mean a_x [m/s^2], turns [rev], rms [rad]."""

    label: str
    rows: int
    duration: float
    mean_a_x: float
    turns: float
    rms: float
    rms_before: float
    max_after: float


@dataclass(frozen=True)
class Residuals:
    """Residual angle per used sample (not stored in the JSON; ``residuals.parquet`` holds it).

    ``row`` is the 1-based file row, ``t`` [s], ``psi`` [rad] the output angle (for a rate log: its integral),
    ``a_x`` [m/s^2] the reference. ``before`` [rad] is the angle less the nominal uncoupled instrument,
    ``after`` [rad] less the fitted model; each stretch from its own mean (rates [rad/s] for a rate log).
    ``innovation`` [1] is the whitened residual: unit variance and white when model and noise levels are
    right. ``segment`` is the segment index of each sample, ``run`` that of its run in a joint calibration.
    """

    row: NDArray[np.int64]
    t: Array
    psi: Array
    a_x: Array
    before: Array
    after: Array
    innovation: Array
    segment: NDArray[np.int32]
    run: NDArray[np.int32] | None = None


@dataclass(frozen=True)
class RunRecord:
    """One run of a joint calibration: what it is, its own noise, residuals, quality and inputs.

    ``raw`` is False when only its summary was at hand: its residual figures are then those of its own fit.
    ``undetermined`` names the terms that this run alone cannot determine.
    """

    name: str
    source: str
    stand: str | None
    phase: str
    raw: bool
    rows: int
    angle_rms: float
    angle_random_walk: float
    residual_rms: float
    residual_rms_before: float
    residual_max_before: float
    residual_max_after: float
    quality: Quality
    undetermined: tuple[str, ...] = ()
    input_sha256: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Provenance:
    """Where the numbers come from."""

    input_sha256: dict[str, str]
    software: str
    created: str
    options: dict[str, Any] = field(default_factory=dict)


class TypeB(NamedTuple):
    """A source of Type B: what it contributes to each coefficient, in its unit, and its degrees of freedom."""

    source: str
    degrees_of_freedom: float
    contributions: dict[str, float]


@dataclass(frozen=True)
class CalibrationFigures:
    """What a history of an instrument needs of a calibration: a small part, so that thousands fit into memory."""

    serial: str
    terms: tuple[str, ...]
    coefficients: tuple[Coefficient, ...]
    type_b: tuple[TypeB, ...]
    has_budget: bool


def _budget_of(budget: tuple[dict[str, Any], ...], chosen: list[Coefficient]) -> tuple[dict[str, Any], ...]:
    """The budget of some coefficients, under the names they have without their run."""
    names = {c.key: replace(c, run=None).key for c in chosen}
    tables = ("contributions", "sensitivities")
    return tuple(
        {
            key: {names[k]: v for k, v in value.items() if k in names} if key in tables else value
            for key, value in row.items()
        }
        for row in budget
    )


@dataclass(frozen=True, repr=False)
class Calibration:
    """Result of a calibration: coefficients with covariance, noise, residual figures and doubts.

    Index by coefficient name: ``cal["tan_beta"].value``; per-segment phases by ``cal["phi[3]"]``.
    ``notes`` are doubts, one sentence each; ``remarks`` are worth knowing and no doubts.
    ``surplus_observations`` counts observations (increments of the angle, rates, positions) less coefficients; it is
    no degrees of freedom of an uncertainty, each coefficient has its own effective ones.
    ``bias_drift`` [rad/s/sqrt(s)] or ``segment_scatter`` [rad/s] is the slow noise of the rate that was found, 0 where none was.
    """

    serial: str
    scale_factor_nominal: float
    terms: tuple[str, ...]
    phase: str
    phase_source: str
    method: str
    coefficients: tuple[Coefficient, ...]
    covariance: Array
    surplus_observations: float
    angle_rms: float
    angle_random_walk: float
    residual_rms: float
    residual_rms_before: float
    residual_max_before: float
    residual_max_after: float
    quality: Quality
    condition: float
    notes: tuple[str, ...]
    budget: tuple[dict[str, Any], ...]
    diagnostics: dict[str, Any]
    segments: tuple[SegmentSummary, ...]
    provenance: Provenance
    temperature_reference: float = 293.15
    time_reference: float = 0.0
    residuals: Residuals | None = None
    history: dict[str, Array] | None = None
    runs: tuple[RunRecord, ...] = ()
    outliers: tuple[Outlier, ...] = ()
    bias_drift: float = 0.0
    segment_scatter: float = 0.0
    remarks: tuple[str, ...] = ()

    @property
    def type_a_only(self) -> bool:
        """True when the budget has no source of Type B of the reference: it then counts as exact."""
        return not any(row.get("type") == "B" and is_of_reference(str(row["source"])) for row in self.budget)

    @property
    def verdict(self) -> Verdict:
        """What holds, what does not, what to do: :func:`piga.records.verdict.verdict`."""
        return verdict(self)

    def __repr__(self) -> str:
        rows = [f"  {c.key} = {_rounded(c)} +- {c.std:.2g} {c.unit}" for c in self.coefficients[:_SHOWN]]
        more = len(self.coefficients) - _SHOWN
        rows += [f"  and {more} more"] if more > 0 else []
        head = (
            f"<Calibration of {self.serial or 'an instrument'} by method {self.method}, standard uncertainties"
        )
        return "\n".join([head, *rows, *(f"  {line}" for line in self.verdict.lines())]) + ">"

    def __getitem__(self, key: str) -> Coefficient:
        for coefficient in self.coefficients:
            if coefficient.key == key:
                return coefficient
        raise KeyError(f"no coefficient '{key}'; there are: {', '.join(c.key for c in self.coefficients)}")

    def figures(self) -> CalibrationFigures:
        """What a history of the instrument needs of it."""
        type_b = tuple(
            TypeB(str(row["source"]), row.get("degrees_of_freedom") or math.inf, row.get("contributions", {}))
            for row in self.budget
            if row.get("type") == "B"
        )
        return CalibrationFigures(self.serial, self.terms, self.coefficients, type_b, bool(self.budget))

    def for_run(self, name: str) -> Calibration:
        """The calibration as one run of a joint one sees it: common coefficients and its own, under plain names.

        Raises
        ------
        CalibrationError
            If there is no such run.
        """
        from piga.errors import CalibrationError

        record = next((run for run in self.runs if run.name == name), None)
        if record is None:
            known = ", ".join(run.name for run in self.runs) or "none: it is a calibration of one run"
            raise CalibrationError(f"the calibration has no run '{name}'", remedy=f"runs: {known}")
        chosen = [i for i, c in enumerate(self.coefficients) if c.run in (None, name)]
        return replace(
            self,
            coefficients=tuple(replace(self.coefficients[i], run=None) for i in chosen),
            covariance=self.covariance[np.ix_(chosen, chosen)],
            phase=record.phase,
            angle_rms=record.angle_rms,
            angle_random_walk=record.angle_random_walk,
            budget=_budget_of(self.budget, [self.coefficients[i] for i in chosen]),
            residuals=None,
            runs=(),
        )

    def to_json(self, path: str | Path) -> None:
        """Write ``calibration.json`` (schema ``piga.calibration/1``)."""
        from piga.records.calibration_json import write_calibration

        write_calibration(self, Path(path))

    @staticmethod
    def from_json(path: str | Path) -> Calibration:
        """Read ``calibration.json``.

        Raises
        ------
        CalibrationError
            If the file is no calibration record of a known schema.
        """
        from piga.records.calibration_json import read_calibration

        return read_calibration(Path(path))


def _rounded(c: Coefficient) -> str:
    """The value without digits beyond those of its uncertainty."""
    if not (math.isfinite(c.std) and c.std > 0.0):
        return f"{c.value:.9g}"
    return f"{round(c.value, 1 - math.floor(math.log10(c.std))) + 0.0:.12g}"
