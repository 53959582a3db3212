"""Coefficients of one instrument over the years: drift, control chart, forecast, alarms.

>>> from piga.trend import find_trend
>>> find_trend.__name__
'find_trend'
"""

from piga.trend.history import Chart, CoefficientTrend, Point, Trend, find_trend
from piga.trend.trend_line import Forecast, Outlook, Step, TrendModel

__all__ = [
    "Chart",
    "CoefficientTrend",
    "Forecast",
    "Outlook",
    "Point",
    "Step",
    "Trend",
    "TrendModel",
    "find_trend",
]
