"""Tables of a calibration: coefficients, correlation, uncertainty budget, segments, quality, provenance."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np

from piga.records.calibration import Calibration, Coefficient
from piga.records.coverage import TYPE_A_ONLY
from piga.records.terms import shown_unit
from piga.reports.render.numbers import count, fixed, pretty_unit, printed, relative, rounded, short, signed
from piga.reports.render.page import Cell, Column, Judgement, Table
from piga.units import ARCSEC, G0

_SHOWN_SEGMENTS = 60
SHOWN_NAMES = 14
"""Coefficients that a table has columns for."""
_SHOWN_OUTLIERS = 30


MANY = 1_000_000
"""Degrees of freedom beyond which the number tells nothing more."""


def judgement(cal: Calibration, subject: str = "") -> Judgement:
    """The verdict on a calibration as the box of a page; ``subject`` says which, where the page is of something else."""
    found = cal.verdict
    problems = tuple((sentence(doubt.what), doubt.remedy) for doubt in found.doubts)
    return Judgement(found.level, f"{subject}{found.headline}", problems, found.holds)


def sentence(text: str) -> str:
    """Text with a capital letter, unless it begins with the name of a coefficient (``k2``)."""
    name = text.split(maxsplit=1)[0].rstrip(":") if text else ""
    return text if re.search(r"[_\d\[]", name) else f"{text[:1].upper()}{text[1:]}"


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
    scale, unit = shown_unit(coefficient.name, coefficient.unit)
    ends = [rounded(end * scale, covered.half_width * scale).value for end in (covered.low, covered.high)]
    return f"{printed(ends[0])} to {printed(ends[1])} {pretty_unit(unit)}".rstrip()


def _coefficient_row(coefficient: Coefficient) -> tuple[str | Cell, ...]:
    if not coefficient.determined:
        unit = pretty_unit(coefficient.unit)
        return coefficient.key, Cell("not determined", "doubtful"), "–", "–", unit, "–", "–", "–"
    scale, unit = shown_unit(coefficient.name, coefficient.unit)
    value, std = coefficient.value * scale, coefficient.std * scale
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
    return Table(columns, tuple(rows), upright=True)


def _correlation(value: float, diagonal: bool) -> Cell:
    if diagonal:
        return Cell("1", "quiet")
    return Cell(printed(signed(value, 2)), heat=value) if math.isfinite(value) else Cell("–")


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


LABELS = {
    "residual_kind": "Residuals are those of the",
    "samples": "Whitened residuals",
    "variance": "Variance of the whitened residuals",
    "lag1_correlation": "Correlation of neighbours",
    "ljung_box": "Ljung-Box statistic",
    "ljung_box_lags": "Lags of the Ljung-Box test",
    "ljung_box_probability": "Probability of the Ljung-Box test",
    "skewness": "Skewness",
    "excess_kurtosis": "Excess kurtosis",
    "verdict": "Whitened residuals are",
    "segment_scatter_ratio": "Scatter of the segments over what all noise explains",
    "segment_scatter_ratio_without_it": "Scatter of the segments over what the noise of the angle explains",
    "segment_scatter_g": "Scatter of the segments, g",
    "turns": "Whole turns of the output",
    "scatter_of_a_turn": "Scatter of a turn, rad",
    "noise_given": "noise levels given",
    "per_run": "terms of single runs",
}
"""Entries of diagnostics and options in words."""
_RANGES = {
    "a_x": ("axial specific force", "m/s²"),
    "a_t": ("transverse specific force", "m/s²"),
    "temperature": ("temperature", "K"),
}


def _range_row(name: str, ends: Any) -> tuple[str, str]:
    """A range in which the calibration holds."""
    words, unit = _RANGES.get(name, (name, ""))
    low, high = (printed(short(float(end), 4)) for end in ends)
    return f"Range of the {words}", f"{low} to {high} {unit}".rstrip()


def scalars(document: dict[str, Any]) -> list[tuple[str, str]]:
    """Plain entries of a free-form dictionary, for a facts table; nested entries get dotted names."""
    rows: list[tuple[str, str]] = []
    for name, value in document.items():
        key = LABELS.get(name, name)
        if name == "range" and isinstance(value, dict):
            rows += [_range_row(what, ends) for what, ends in value.items()]
        elif isinstance(value, dict):
            rows += [(f"{key}.{inner}", text) for inner, text in scalars(value)]
        elif isinstance(value, float):
            rows.append((key, printed(short(value, 4))))
        elif isinstance(value, (str, int)):
            rows.append((key, str(value)))
        elif isinstance(value, (list, tuple)) and len(value) <= SHOWN_NAMES:
            rows.append((key, ", ".join(str(item) for item in value)))
    return rows
