"""Tables of a calibration: coefficients, correlation, uncertainty budget, segments, quality, provenance."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np

from piga.records.calibration import Calibration, Coefficient
from piga.records.coverage import TYPE_A_ONLY
from piga.reports.numbers import (
    count,
    fixed,
    friendly,
    pretty_unit,
    printed,
    relative,
    rounded,
    short,
)
from piga.reports.page import Cell, Column, Judgement, Table
from piga.units import ARCSEC, G0

_MEANING = {
    "scale_factor": "scale factor ml/H",
    "tan_beta": "cross-coupling, tilt β of the rotor axis",
    "phi": "phase of the output zero",
    "k0": "bias",
    "k1": "scale-factor error",
    "k2": "second-order nonlinearity",
    "k3": "third-order nonlinearity",
    "k2o": "odd second-order nonlinearity (a_x |a_x|)",
    "m_Y": "misalignment towards Y0",
    "m_Z": "misalignment towards Z0",
    "k_XY": "cross term a_x a_Y",
    "k_XZ": "cross term a_x a_Z",
    "k_YY": "cross term a_Y²",
    "k_ZZ": "cross term a_Z²",
    "k_YZ": "cross term a_Y a_Z",
    "k0_t": "bias drift with time",
    "k0_T": "bias with temperature",
    "k1_T": "scale factor with temperature",
    "servo": "stiffness of the servo (a_x a_t²)",
    "servo_damping": "float damping under the servo (a_x² a_t)",
}
_SHOWN_SEGMENTS = 60
SHOWN_NAMES = 14
"""Coefficients that a table has columns for."""
_SHOWN_OUTLIERS = 30


MANY = 1_000_000
"""Degrees of freedom beyond which the number tells nothing more."""


def meaning(name: str) -> str:
    """A coefficient's meaning in words."""
    harmonic = re.fullmatch(r"([sc])(\d+)", name)
    if harmonic:
        return f"{'sine' if harmonic[1] == 's' else 'cosine'} harmonic of the output, order {harmonic[2]}"
    return _MEANING.get(name, name)


def judgement(cal: Calibration, subject: str = "") -> Judgement:
    """The verdict on a calibration as the box of a page; ``subject`` says which, where the page is of something else."""
    found = cal.verdict
    problems = tuple((sentence(doubt.what), doubt.remedy) for doubt in found.doubts)
    return Judgement(found.level, f"{subject}{found.headline}", problems, found.holds)


def sentence(text: str) -> str:
    """Text with a capital letter."""
    return f"{text[:1].upper()}{text[1:]}"


def common_coefficients(cal: Calibration) -> list[Coefficient]:
    """Coefficients of the instrument and of whole runs (phases of single segments stand in the segment table)."""
    return [coefficient for coefficient in cal.coefficients if coefficient.segment is None]


def coefficient_table(cal: Calibration) -> Table:
    """Coefficients with standard and expanded uncertainty."""
    rows = [_coefficient_row(coefficient) for coefficient in common_coefficients(cal)]
    columns = (
        Column("Coefficient", align="text"),
        Column("Value"),
        Column("Standard uncertainty u"),
        Column("k u for 95 %, Type A only" if cal.type_a_only else "Expanded uncertainty U"),
        Column("Unit", align="text"),
        Column("u / value"),
        Column("ν"),
        Column("k"),
    )
    return Table(columns, tuple(rows), notes=_coefficient_notes(cal))


def freedom(coefficient: Coefficient) -> str:
    """Effective degrees of freedom in words."""
    nu = coefficient.degrees_of_freedom
    if math.isnan(nu):
        return "–"
    if MANY < nu < math.inf:
        return f"> {count(MANY)}"
    return "∞" if math.isinf(nu) else count(round(nu)) if nu >= 100.0 else f"{nu:.3g}"


def factor(coefficient: Coefficient) -> str:
    """Coverage factor as printed; a dash where a Monte Carlo interval holds."""
    k = coefficient.coverage.factor
    return "–" if math.isnan(k) else f"{k:.2f}"


def monte_carlo_interval(coefficient: Coefficient) -> str:
    """Limits of the interval that holds, rounded by their width, with their unit: ``299.1 to 300.7 µg``."""
    covered = coefficient.coverage
    _, scale, unit = friendly(coefficient.value, 1.0, coefficient.unit)
    ends = [rounded(end * scale, covered.half_width * scale).value for end in (covered.low, covered.high)]
    return f"{printed(ends[0])} to {printed(ends[1])} {pretty_unit(unit)}".rstrip()


def _coefficient_row(coefficient: Coefficient) -> tuple[str | Cell, ...]:
    if not coefficient.determined:
        unit = pretty_unit(coefficient.unit)
        return coefficient.key, Cell("not determined", "doubtful"), "–", "–", unit, "–", "–", "–"
    value, std, unit = friendly(coefficient.value, coefficient.std, coefficient.unit)
    scale = std / coefficient.std if coefficient.std else 1.0
    number, wide = rounded(value, std), rounded(value, coefficient.expanded * scale)
    small = std > abs(value)
    return (
        coefficient.key,
        printed(number.value),
        printed(number.uncertainty),
        printed(wide.uncertainty),
        pretty_unit(unit),
        Cell(relative(value, std), "doubtful" if small else ""),
        freedom(coefficient),
        factor(coefficient),
    )


def _coefficient_notes(cal: Calibration) -> tuple[str, ...]:
    basis = "k from Student's t with the effective degrees of freedom ν of each coefficient (JCGM 100, G.4)"
    notes = [
        f"{'' if cal.type_a_only else 'U = '}k u is for 95 % coverage, {basis}. The unit g is 9.80665 m/s² exactly."
    ]
    if cal.type_a_only:
        notes.insert(0, f"{TYPE_A_ONLY}.")
    half = "k u" if cal.type_a_only else "U"
    for coefficient in common_coefficients(cal):
        if coefficient.name == "tan_beta":
            beta = math.atan(coefficient.value) / ARCSEC
            text = rounded(beta, coefficient.std / ARCSEC / (1.0 + coefficient.value**2)).concise
            notes.append(f"tan_beta corresponds to β = {printed(text)}″.")
        if coefficient.interval is not None:
            notes.append(
                f"{coefficient.name}: shortest 95 % interval {monte_carlo_interval(coefficient)} by Monte Carlo (JCGM "
                f"101); {half} is its half-width."
            )
        if coefficient.std > abs(coefficient.value):
            notes.append(
                f"{coefficient.key} is smaller than its own uncertainty: this record does not show it."
            )
    return tuple(notes)


def correlation_table(cal: Calibration) -> Table | None:
    """Correlation matrix of the common coefficients, or None when there is but one."""
    common = [row for row, coefficient in enumerate(cal.coefficients) if coefficient.segment is None]
    index = common[:SHOWN_NAMES]
    if len(index) < 2:
        return None
    covariance = np.asarray(cal.covariance, dtype=float)[np.ix_(index, index)]
    std = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        matrix = covariance / np.outer(std, std)
    names = [cal.coefficients[row].key for row in index]
    rows: list[tuple[str | Cell, ...]] = []
    for i, name in enumerate(names):
        rows.append((name, *(_correlation(matrix[i, j], i == j) for j in range(len(names)))))
    columns = (Column("", align="text"), *(Column(name) for name in names))
    return Table(columns, tuple(rows))


def _correlation(value: float, diagonal: bool) -> Cell:
    if diagonal:
        return Cell("1", "quiet")
    return Cell(printed(f"{value:+.2f}"), heat=value) if math.isfinite(value) else Cell("–")


def residual_quantity(cal: Calibration) -> tuple[str, str]:
    """What the residuals are, and their unit in reports: an angle, or a rate for a log of rates."""
    rate = cal.diagnostics.get("residual_kind") == "rate"
    return ("residual rate", "arcsec/s") if rate else ("residual angle", "arcsec")


def segment_table(cal: Calibration) -> Table:
    """One row per segment; of very many the ones with the largest residuals."""
    shown = list(cal.segments)
    notes: tuple[str, ...] = ()
    if len(shown) > _SHOWN_SEGMENTS:
        worst = sorted(range(len(shown)), key=lambda row: -shown[row].rms)[:_SHOWN_SEGMENTS]
        shown = [shown[row] for row in sorted(worst)]
        notes = (f"The {_SHOWN_SEGMENTS} of {len(cal.segments)} segments with the largest residuals.",)
    unit = residual_quantity(cal)[1]
    phases = {c.owner: c for c in cal.coefficients if c.name == "phi" and c.segment is not None}
    typical = float(np.median([segment.rms for segment in shown])) if shown else 0.0
    columns = [
        Column("Segment", align="text"),
        Column("Samples"),
        Column("Duration", "s"),
        Column("Mean a_x", "g"),
        Column("Turns", "rev"),
        Column("rms before", unit),
        Column("rms after", unit),
        Column("Largest after", unit),
    ]
    rows: list[tuple[str | Cell, ...]] = []
    for segment in shown:
        row: list[str | Cell] = [
            segment.label,
            count(segment.rows),
            f"{segment.duration:.1f}",
            printed(fixed(segment.mean_a_x / G0, 5)),
            printed(fixed(segment.turns, 2)),
            short(segment.rms_before / ARCSEC),
            Cell(short(segment.rms / ARCSEC), "doubtful" if segment.rms > 3.0 * typical else ""),
            short(segment.max_after / ARCSEC),
        ]
        if phases:
            phase = phases.get(segment.label)
            row.append(phase_shown(phase) if phase else "–")
        rows.append(tuple(row))
    if phases:
        columns.append(Column("Phase φ", "rad"))
    return Table(tuple(columns), tuple(rows), notes=notes)


def phase_shown(phase: Coefficient) -> str:
    """The phase of a segment with its standard uncertainty in brackets, or that it is not determined."""
    return printed(rounded(phase.value, phase.std).concise) if phase.determined else "not determined"


def runs_table(cal: Calibration) -> Table:
    """One row per run of a joint calibration."""
    unit = residual_quantity(cal)[1]
    columns = (
        Column("Run", align="text"),
        Column("Stand", align="text"),
        Column("Increments"),
        Column("White noise", "arcsec"),
        Column("Random walk", "arcsec/√s"),
        Column("rms before", unit),
        Column("rms after", unit),
        Column("Alone it cannot separate", align="text"),
    )
    rows = tuple(
        (
            run.name if run.raw else f"{run.name} (summary)",
            run.stand or "–",
            count(run.rows),
            short(run.angle_rms / ARCSEC),
            short(run.angle_random_walk / ARCSEC),
            short(run.residual_rms_before / ARCSEC),
            short(run.residual_rms / ARCSEC),
            ", ".join(run.undetermined) or "–",
        )
        for run in cal.runs
    )
    return Table(columns, rows)


def outlier_table(cal: Calibration) -> Table:
    """Samples that were left out, with their times: jumps and stuck readings, then spikes; of many the first."""
    listed = sorted(cal.outliers, key=lambda outlier: outlier.kind == "spike")
    unit = "arcsec/s" if cal.diagnostics.get("residual_kind") == "rate" else "arcsec"
    named = any(outlier.run for outlier in cal.outliers)
    columns = [
        Column("Kind", align="text"),
        Column("Time", "s"),
        Column("Row"),
        Column("Samples left out"),
        Column("Miss", unit),
    ]
    rows = []
    for outlier in listed[:_SHOWN_OUTLIERS]:
        row: list[str | Cell] = [
            outlier.kind,
            f"{outlier.time:.3f}",
            count(outlier.row),
            count(outlier.samples),
            printed(short(outlier.size / ARCSEC)),
        ]
        rows.append(tuple([outlier.run or "–", *row] if named else row))
    if named:
        columns.insert(0, Column("Run", align="text"))
    more = len(cal.outliers) - _SHOWN_OUTLIERS
    notes = (f"The first {_SHOWN_OUTLIERS} of {count(len(cal.outliers))} findings.",) if more > 0 else ()
    return Table(tuple(columns), tuple(rows), notes=notes)


def quality_table(cal: Calibration) -> Table:
    """What was found in the data."""
    columns = (
        Column("Finding", align="text"),
        Column("Count"),
        Column("First row"),
        Column("Detail", align="text"),
    )
    rows = tuple(
        (
            event.kind,
            count(event.count),
            "–" if event.first_row is None else count(event.first_row),
            event.detail,
        )
        for event in cal.quality.events
    )
    return Table(columns, rows)


def facts_table(rows: list[tuple[str, str]], *, code: bool = False) -> Table:
    """Two columns: what, and which."""
    return Table((Column("Item", align="text"), Column("Value", align="text")), tuple(rows), code=code)


def scalars(document: dict[str, Any]) -> list[tuple[str, str]]:
    """Plain entries of a free-form dictionary, for a facts table; nested entries get dotted names."""
    rows: list[tuple[str, str]] = []
    for key, value in document.items():
        if isinstance(value, dict):
            rows += [(f"{key}.{name}", text) for name, text in scalars(value)]
        elif isinstance(value, float):
            rows.append((key, printed(short(value, 4))))
        elif isinstance(value, (str, int)):
            rows.append((key, str(value)))
        elif isinstance(value, (list, tuple)) and len(value) <= SHOWN_NAMES:
            rows.append((key, ", ".join(str(item) for item in value)))
    return rows
