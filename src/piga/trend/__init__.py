"""Coefficients of one instrument over the years: drift, control chart, forecast, alarms.

>>> from piga.trend import find_trend
>>> find_trend.__name__
'find_trend'
"""

from typing import TYPE_CHECKING

from piga.results import lazy

if TYPE_CHECKING:
    from piga.trend.history import Chart, CoefficientTrend, Point, Trend, find_trend
    from piga.trend.trend_line import Forecast, TrendModel


__all__ = ["Chart", "CoefficientTrend", "Forecast", "Point", "Trend", "TrendModel", "find_trend"]

__getattr__ = lazy(
    "piga.trend",
    {
        "history": "Chart CoefficientTrend Point Trend find_trend",
        "trend_line": "Forecast TrendModel",
    },
)
