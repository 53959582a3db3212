"""Calibration of a set by the size of gravity shown: terms, residuals of the spells, spells in time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from piga._version import __version__
from piga.gravity_norm import SetCalibration
from piga.reports.render.figure import Figure, Plot
from piga.reports.render.numbers import fixed, pretty_unit, rounded, short
from piga.reports.render.page import Notice, Page, Section, Table, TableOf, Text, Tile, origin
from piga.results import plain
from piga.units import MICRO_G


def figures(cal: SetCalibration) -> dict[str, Callable[[], Figure]]:
    """The figure of the residuals."""
    return {"residuals": partial(residual_figure, cal)}


def residual_figure(cal: SetCalibration) -> Figure:
    """Size of the force less gravity in each spell."""
    middle = np.array([0.5 * (one.begin + one.end) for one in cal.spells])
    off = np.array([one.residual for one in cal.spells]) / MICRO_G
    plot = Plot(
        "residuals", "Size of the force less gravity.", "middle of the spell [s]", "|f| − g [µg]", height=3.2
    )
    plot.points(middle, off, "spells", "after", text=tuple(f"{one.begin:.6g} s" for one in cal.spells))
    plot.level(middle, 0.0, "gravity")
    return plot.caption(
        "Residual of each static spell. Good: points scatter around zero without order. A trend in time is a drift of the "
        "bias or of gravity's support; one spell far off was not at rest."
    )


def _terms_table(cal: SetCalibration) -> Table:
    return (
        TableOf(cal.terms)
        .text("term", lambda term: term.key)
        .number("value", lambda term: rounded(term.value, term.std).value)
        .number("u", lambda term: rounded(term.value, term.std).uncertainty)
        .number("U, 95 %", lambda term: rounded(term.value, term.expanded).uncertainty)
        .number("degrees of freedom", lambda term: short(term.degrees_of_freedom))
        .text("unit", lambda term: pretty_unit(term.unit))
        .table()
    )


def page(cal: SetCalibration) -> Page:
    """Terms, residuals and spells."""
    keeps = "Z of the third accelerometer" if cal.convention == "upper" else "X of the first accelerometer"
    words = f"Convention {cal.convention}: the axes of the set keep {keeps}. Scale factors depend on the convention."
    notices = [Notice("warning", remark) for remark in cal.remarks]
    spells = (
        TableOf(cal.spells)
        .number("begin", lambda one: fixed(one.begin, 2), "s")
        .number("end", lambda one: fixed(one.end, 2), "s")
        .number("samples", lambda one: str(one.samples))
        .number("|f| − g", lambda one: fixed(one.residual / MICRO_G, 1), "µg")
        .table()
    )
    return Page(
        f"Set {cal.serial}",
        f"{len(cal.names)} accelerometers, gravity {cal.gravity:.9g} m/s² as the reference.",
        (
            Tile(
                "Static spells",
                str(len(cal.spells)),
                "",
                f"threshold {cal.threshold:g} times the quiet variance",
            ),
            Tile("Residual", short(cal.residual_rms / MICRO_G), "µg", "root mean square by degrees of freedom"),
        ),
        (
            Section("Terms", "terms", (Text(words), _terms_table(cal), *notices)),
            Section("Residuals", "of-spells", (partial(residual_figure, cal),)),
            Section("Static spells", "spells", (spells,)),
            origin(cal.input_sha256),
        ),
        kicker="piga calibrate",
    )


def brief(cal: SetCalibration) -> Page:
    """Terms and remarks for terminal and notebook."""
    return page(cal).only("terms", "of-spells")


def set_document(cal: SetCalibration) -> dict[str, Any]:
    """The result as plain data for JSON."""
    values = plain(cal)
    terms = {term.key: plain(term) | {"expanded": term.expanded} for term in cal.terms}
    matrix = {"sensitivities": values.pop("matrix")}
    head = {"schema": "piga.set-calibration/1", "software": f"piga {__version__}"}
    return head | values | matrix | {"terms": terms}
