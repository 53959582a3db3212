"""Doors to upper rooms: what a method of a result imports when it is called, and not before.

Data are made on the lower floors and shown on the upper ones. Methods get this module through :mod:`piga.upper`. A module
that shows a kind of result has ``page(result)`` for the report, ``brief(result)`` for terminal and notebook, and
``figures(result)``: functions by name, each of which makes one figure.
"""

from __future__ import annotations

from types import ModuleType


def shown_calibration() -> ModuleType:
    """Shows a calibration."""
    from piga.reports.calibration import page

    return page


def reduced_runs() -> ModuleType:
    """Reduces a run to its summary."""
    from piga.calibration import joint

    return joint


def shown_record() -> ModuleType:
    """Shows a record before its calibration."""
    from piga.reports import check

    return check


def shown_compensation() -> ModuleType:
    """Shows a compensated record or set."""
    from piga.reports import compensation

    return compensation


def shown_test() -> ModuleType:
    """Shows a simulated test."""
    from piga.reports import stand

    return stand


def shown_plan() -> ModuleType:
    """Shows a planned test."""
    from piga.reports import planning

    return planning


def shown_set() -> ModuleType:
    """Shows the calibration of a set."""
    from piga.reports import gravity_norm

    return gravity_norm


def shown_trend() -> ModuleType:
    """Shows a trend."""
    from piga.reports import trend

    return trend


def shown_noise() -> ModuleType:
    """Shows the noise of a static record."""
    from piga.reports import noise

    return noise


def platform_figures() -> ModuleType:
    """Figures of the platform."""
    from piga.reports import platform

    return platform


def pages() -> ModuleType:
    """Pages as HTML, card and text; shows names and values of any result."""
    from piga.reports.render import page

    return page


def drawing() -> ModuleType:
    """Figures drawn with Matplotlib."""
    from piga.reports.render import axes

    return axes


def parameters() -> ModuleType:
    """Instruments and error models."""
    from piga.instrument import parameters

    return parameters


def run_reference() -> ModuleType:
    """Records from tables and stands."""
    from piga.stand import run_reference

    return run_reference
