"""Coefficients of one instrument over the years: drift, control chart, forecast, alarms.

>>> from piga.trend import find_trend
>>> find_trend.__name__
'find_trend'
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from piga.trend.history import Chart, CoefficientTrend, Point, Trend, find_trend
    from piga.trend.trend_line import Forecast, TrendModel

_LAZY = {
    "Chart": "history",
    "CoefficientTrend": "history",
    "Forecast": "trend_line",
    "Point": "history",
    "Trend": "history",
    "TrendModel": "trend_line",
    "find_trend": "history",
}

__all__ = ["Chart", "CoefficientTrend", "Forecast", "Point", "Trend", "TrendModel", "find_trend"]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(f"piga.trend.{_LAZY[name]}"), name)
    raise AttributeError(f"module 'piga.trend' has no attribute '{name}'")
