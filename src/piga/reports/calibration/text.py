"""The summary of a calibration for the terminal."""

from __future__ import annotations

import textwrap

from piga.records.calibration import Calibration
from piga.records.terms import shown_unit
from piga.reports.calibration.budget import budget_text
from piga.reports.calibration.extent import files_in_words, period_in_words, segments_in_words, total_duration
from piga.reports.calibration.tables import factor, freedom, residual_quantity
from piga.reports.render.numbers import printed, rounded, short
from piga.units import ARCSEC, G0


def calibration_text(cal: Calibration) -> str:
    """Summary for the terminal: aligned plain ASCII text, one coefficient a line."""
    used = f"{cal.quality.used} of {cal.quality.rows}"
    head = [
        *_wrapped(cal.verdict.lines()),
        "",
        f"Calibration of {cal.serial} from {files_in_words(cal)}",
        f"  {segments_in_words(cal)}, {period_in_words(total_duration(cal))}, {used} rows used",
        f"  method {cal.method}, phase {cal.phase}, terms {' '.join(cal.terms)}",
        "",
    ]
    return "\n".join(
        [
            *[*head, *_text_table(cal), "", *_text_figures(cal)],
            *budget_text(cal),
            *_wrapped([f"remark: {remark}" for remark in cal.remarks]),
        ]
    )


def _wrapped(lines: list[str]) -> list[str]:
    """Lines of at most 100 letters, their continuations indented."""
    return [
        part
        for line in lines
        for part in textwrap.wrap(line, 100, subsequent_indent=" " * (len(line) - len(line.lstrip()) + 4))
    ]


def drift_found(cal: Calibration) -> str:
    """Random walk of the rate, or that there is none to be seen."""
    if cal.bias_drift == 0.0:
        return "none seen"
    shown = short(cal.bias_drift / cal.scale_factor_nominal / G0 * 1e6)
    return f"{shown} µg/√s ({printed(short(cal.bias_drift))} rad/s/√s)"


def scatter_found(cal: Calibration) -> str:
    """Scatter of the rate from segment to segment, or that there is none to be seen."""
    if cal.segment_scatter == 0.0:
        return "none seen"
    shown = short(cal.segment_scatter / cal.scale_factor_nominal / G0 * 1e6)
    return f"{shown} µg ({printed(short(cal.segment_scatter))} rad/s)"


def _text_table(cal: Calibration) -> list[str]:
    half = "k u (95 %)" if cal.type_a_only else "U (95 %)"
    lines = [("coefficient", "value", "u", half, "unit", "dof", "k")]
    for coefficient in cal.coefficients:
        if not coefficient.determined:
            lines.append((coefficient.key, "not determined", "-", "-", coefficient.unit, "-", "-"))
            continue
        scale, unit = shown_unit(coefficient.name, coefficient.unit)
        value, std = coefficient.value * scale, coefficient.std * scale
        number, wide = rounded(value, std), rounded(value, coefficient.expanded * scale)
        line = (
            number.value,
            number.uncertainty,
            wide.uncertainty,
            unit,
            freedom(coefficient),
            factor(coefficient),
        )
        lines.append((coefficient.key, *line))
    width = [max(len(line[column]) for line in lines) for column in range(7)]
    return [
        f"  {name:<{width[0]}}  {value:>{width[1]}}  {u:>{width[2]}}  {wide:>{width[3]}}  {unit:<{width[4]}}  "
        f"{nu:>{width[5]}}  {k:>{width[6]}}"
        for name, value, u, wide, unit, nu, k in ((_ascii(cell) for cell in line) for line in lines)
    ]


def _ascii(text: str) -> str:
    """A cell of a table for any terminal."""
    return text.replace("–", "-").replace("∞", "inf").replace("\u202f", "")


def _text_figures(cal: Calibration) -> list[str]:
    unit = residual_quantity(cal)[1]

    def angle(before: float, after: float) -> str:
        return f"{short(before / ARCSEC)} -> {short(after / ARCSEC)} {unit} (before -> after)"

    white, walk = short(cal.angle_rms / ARCSEC), short(cal.angle_random_walk / ARCSEC)
    noise = f"{white} arcsec white, {walk} arcsec/sqrt(s) walk"
    rows = [
        ("residual rms", angle(cal.residual_rms_before, cal.residual_rms)),
        ("residual largest", angle(cal.residual_max_before, cal.residual_max_after)),
        ("noise of the angle", noise),
        *(
            [("bias drift", drift_found(cal).replace("µ", "u").replace("√s", "sqrt(s)"))]
            if cal.bias_drift > 0.0
            else []
        ),
        *([("scatter of segments", scatter_found(cal).replace("µ", "u"))] if cal.segment_scatter > 0.0 else []),
        ("condition number", short(cal.condition)),
    ]
    rows += [(f"data: {event.kind}", f"{event.count} {event.detail}".strip()) for event in cal.quality.events]
    rows += [
        (
            f"noise of run {run.name}",
            f"{short(run.angle_rms / ARCSEC)} arcsec white, {short(run.angle_random_walk / ARCSEC)} arcsec/sqrt(s) walk",
        )
        for run in cal.runs
    ]
    wide = max(len(name) for name, _ in rows)
    return [f"  {name:<{wide}}  {text}".replace("\u202f", "").replace("–", "-") for name, text in rows]
