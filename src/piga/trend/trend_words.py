"""Alarms and remarks of a trend, in sentences."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from piga.records.coverage import TYPE_A_ONLY, is_of_reference
from piga.records.terms import shown_unit
from piga.trend.trend_line import DOUBT

if TYPE_CHECKING:
    from piga.records.calibration import CalibrationFigures
    from piga.trend.history import CoefficientTrend

SHORT = 0.25
"""Years of history below which a drift per year is an extrapolation worth a remark."""


def alarms_in_words(
    trends: Sequence[CoefficientTrend], names: Sequence[str], times: Sequence[dt.datetime]
) -> tuple[str, ...]:
    """What is out of control: records beyond their forecast, and shifts that the moving average shows."""
    found: list[str] = []
    for trend in trends:
        for point, time in zip(trend.points, times, strict=True):
            if point.outside and point.forecast is not None:
                found.append(
                    _outside(trend, point.record, time, point.value, point.forecast.value, point.score)
                )
        shifted = np.flatnonzero(trend.chart.shifted)
        if shifted.size:
            first = next(i for i, point in enumerate(trend.points) if point.day == shifted[0])
            side = "above" if trend.chart.average[shifted[0]] > 0.0 else "below"
            found.append(
                f"{trend.key}: from {times[first]:%Y-%m-%d} (record {names[first]}) the values stay {side} what "
                "earlier records let expect: the moving average of their deviations passed its control limit."
            )
    return tuple(found)


def _outside(
    trend: CoefficientTrend, name: str, time: dt.datetime, value: float, expected: float, score: float
) -> str:
    scale, unit = shown_unit(trend.key, trend.unit)
    shown = "" if unit == "1" else f" {unit}"
    return (
        f"{trend.key}: record {name} of {time:%Y-%m-%d} shows {value * scale:.7g}{shown}, {abs(score):.1f} standard "
        f"deviations {'above' if score > 0.0 else 'below'} the {expected * scale:.7g}{shown} that earlier records let "
        "expect (limit 3)."
    )


def remarks_in_words(
    trends: Sequence[CoefficientTrend],
    calibrations: Sequence[CalibrationFigures],
    days: NDArray[np.int64],
    span: float,
) -> tuple[str, ...]:
    """What a reader must know to judge the figures."""
    found = [*_drifts(trends), *_scatter(trends)]
    count = int(days[-1]) + 1
    if count < 3:
        found.append(
            f"The records are of {count} day{'s' * (count > 1)}: drift and forecast need three days or more."
        )
    elif span < SHORT:
        found.append(f"The records span {span * 365.25:.0f} days only: a drift per year is an extrapolation.")
    if len({calibration.terms for calibration in calibrations}) > 1:
        found.append(
            "The records were calibrated with different terms: a coefficient may have taken over what another "
            "record left to a term of its own."
        )
    alone = sum(
        not any(is_of_reference(row.source) for row in calibration.type_b) for calibration in calibrations
    )
    if alone:
        found.append(f"{alone} of {len(calibrations)} records: {TYPE_A_ONLY}.")
    without = sum(not calibration.has_budget for calibration in calibrations)
    if without:
        found.append(
            f"{without} of {len(calibrations)} records have no uncertainty budget: their whole uncertainty counts as "
            "their own, although a part may be shared."
        )
    return tuple(found)


def _drifts(trends: Sequence[CoefficientTrend]) -> list[str]:
    found = []
    for trend in trends:
        drift = trend.drift
        if drift is not None and abs(drift.value) > drift.half_width():
            scale, unit = shown_unit(trend.key, trend.unit)
            value, half = drift.value * scale, drift.half_width() * scale
            shown = f"{unit} per year".removeprefix("1 ")
            found.append(
                f"{trend.key} drifts by {value:.3g} {shown} (95 %: {value - half:.3g} to {value + half:.3g})."
            )
    return found


def _scatter(trends: Sequence[CoefficientTrend]) -> list[str]:
    """Where the scatter of the days contradicts the stated uncertainties, by chi-square."""
    from scipy.special import chdtr, chdtrc

    found = []
    for trend in trends:
        line = trend.model.line
        if line is None:
            continue
        freedom = line.degrees_of_freedom
        if chdtrc(freedom, line.chi2) < DOUBT:
            ratio = (line.chi2 / freedom) ** 0.5
            found.append(
                f"{trend.key}: days scatter {ratio:.1f} times as much as the records' own uncertainties let expect; the "
                "excess is taken as day-to-day instability."
            )
        elif chdtr(freedom, line.chi2) < DOUBT:
            found.append(
                f"{trend.key}: days scatter less than the records' own uncertainties let expect: these are stated too "
                "large, or contain a part that the records share."
            )
    return found
