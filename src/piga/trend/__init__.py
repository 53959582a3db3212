"""Coefficients of one instrument over the years: drift, control chart, forecast, alarms.

>>> from piga.trend import find_trend
>>> find_trend.__name__
'find_trend'
"""

from piga.trend.history import CoefficientTrend, Point, Trend, find_trend
from piga.trend.trend_line import Forecast, Line, Outlook, Step

__all__ = [
    "CoefficientTrend",
    "Forecast",
    "Line",
    "Outlook",
    "Point",
    "Step",
    "Trend",
    "find_trend",
]
