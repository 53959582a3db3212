"""What a result shows by itself: a card in a notebook, a summary, a page, a figure. All come from the report's functions.

Methods of results call these functions by name (:mod:`piga.results`). Each kind of result has one entry in a table.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from piga.errors import ArgumentError, CalibrationError
from piga.output import write_whole
from piga.reports.render.figure import Figure
from piga.reports.render.page import Card, Table, TableOf, card_html, named_values, write_page

MOST_ROWS = 40
"""Rows of a table in a notebook."""


def html_of(result: Any) -> str:
    """The card of a result as HTML."""
    make = CARDS.get(type(result).__name__)
    return card_html(make(result) if make else _facts_card(result, drawn=False))


def summary_of(result: Any) -> str:
    """The summary that the command prints."""
    text: str = SUMMARIES[type(result).__name__](result)
    return text


def write_report(result: Any, path: str | Path) -> Path:
    """Write the page of a result, whole or not at all.

    Raises
    ------
    ArgumentError
        If the name does not end in .html.
    """
    target = Path(path)
    if target.suffix != ".html":
        raise ArgumentError(f"report {target}: the name must end in .html", remedy="e.g. report.html")
    write = REPORTS[type(result).__name__]
    return write_whole(target, lambda part: write(result, part), remedy="choose another path")


def figure_of(result: Any, name: str = "") -> Figure:
    """The figure of a result with this name; a result with one figure has no name for it."""
    return FIGURES[type(result).__name__](result, name)


def _of(module: str, name: str, *more: Any) -> Callable[..., Any]:
    """A function of a report, imported when it is called; ``more`` are its further arguments."""

    def call(result: Any) -> Any:
        return getattr(import_module(f"piga.reports.{module}"), name)(result, *more)

    return call


# -- cards ---------------------------------------------------------------------------------------------


def facts_of(rows: list[tuple[str, str]]) -> Table:
    """Names and values as a table."""
    return named_values("", "", rows[:MOST_ROWS])


def _facts_card(result: Any, title: str = "", *, drawn: bool = True) -> Card:
    """What a result says of itself in brief, and its figure."""
    figure = figure_of(result) if drawn else None
    return Card(title or type(result).__name__, tables=(facts_of(result.in_brief()),), figure=figure)


def _calibration(cal: Any) -> Card:
    from piga.reports.calibration.page import files_in_words, segments_in_words
    from piga.reports.calibration.tables import coefficient_table, judgement

    drawn = cal.residuals is not None and cal.residuals.t.size
    return Card(
        f"Calibration of {cal.serial or 'an instrument'}",
        f"{files_in_words(cal)}: {segments_in_words(cal)}, method {cal.method}" if not cal.given else "",
        judgement(cal),
        (coefficient_table(cal),),
        calibration_figure(cal, "residuals") if drawn else None,
    )


def _coefficient(c: Any) -> Card:
    from piga.records.terms import meaning_of
    from piga.reports.render.numbers import pretty_unit

    low, high = c.limits
    rows = [
        ("value", f"{c.value:.9g} {pretty_unit(c.unit)}"),
        ("standard uncertainty", f"{c.std:.3g} {pretty_unit(c.unit)}"),
        ("95 % interval", f"{low:.9g} to {high:.9g} {pretty_unit(c.unit)}"),
        ("in SI", repr(c.si)),
    ]
    return Card(f"{c.key}: {meaning_of(c.name)}", tables=(facts_of(rows),))


def _budget(budget: Any) -> Card:
    from piga.reports.calibration.budget import source_in_words

    table = (
        TableOf(list(budget)[:MOST_ROWS])
        .text("Source", lambda entry: source_in_words(entry.source))
        .text("Type", lambda entry: entry.type)
        .text("Distribution", lambda entry: entry.distribution)
        .number("Coefficients", lambda entry: str(len(entry.contributions)))
        .table()
    )
    return Card("Uncertainty budget", tables=(table,))


def _plan(plan: Any) -> Card:
    from piga.reports.planning import uncertainty_table, visit_table

    return Card("Planned test", tables=(visit_table(plan), uncertainty_table(plan)), figure=figure_of(plan))


def _trend(trend: Any) -> Card:
    from piga.reports.trend import summary_table

    return Card(f"Trend of {trend.serial}", tables=(summary_table(trend),), figure=figure_of(trend))


CARDS: dict[str, Callable[[Any], Card]] = {
    "Calibration": _calibration,
    "Coefficient": _coefficient,
    "BudgetTable": _budget,
    "Run": lambda run: _facts_card(run, f"Record of {run.serial or 'an instrument'}"),
    "Compensated": lambda result: _facts_card(result, "Compensated record"),
    "CompensatedSet": lambda result: _facts_card(result, "Compensated record"),
    "Plan": _plan,
    "Trend": _trend,
    "Figure": lambda figure: Card(figure.title, figure=figure),
    "SimulatedTest": _facts_card,
    "AllanDeviation": _facts_card,
    "PlatformRun": _facts_card,
    "Identification": lambda result: _facts_card(result, drawn=False),
    "GrowingIdentification": _facts_card,
    "ModelComparisonRun": _facts_card,
}


# -- summaries and pages -------------------------------------------------------------------------------


SUMMARIES: dict[str, Callable[[Any], str]] = {
    "Calibration": _of("calibration.page", "calibration_text"),
    "Run": _of("check", "check_text"),
    "Plan": _of("planning", "plan_text", None),
    "Trend": _of("trend", "trend_text"),
    "SimulatedTest": _of("stand", "simulation_text"),
    "Compensated": lambda result: "\n".join(f"{name}: {text}" for name, text in result.in_brief()),
}


def _page_of_compensation(result: Any, path: Path) -> object:
    from piga.reports.compensation.page import CompensationFacts, write_compensation_report

    run, calibration = _origin(result, "report")
    files = (
        ("record", ""),
        (Path(run.source).name or "arrays in memory", next(iter(run.input_sha256.values()), "")),
    )
    facts = CompensationFacts(calibration, files, {"method": result.method})
    return write_compensation_report(_outline(result), facts, path, (run, result))


def _page(page: Callable[..., Any]) -> Callable[[Any, Path], object]:
    """Writes the page that ``page`` makes of a result."""
    return lambda result, path: write_page(page(result), path)


REPORTS: dict[str, Callable[[Any, Path], object]] = {
    "Calibration": _page(_of("calibration.page", "calibration_page")),
    "Run": _page(_of("check", "check_page")),
    "Compensated": _page_of_compensation,
    "Plan": _page(_of("planning", "plan_page", None)),
    "Trend": _page(_of("trend", "trend_page")),
    "SimulatedTest": _page(_of("stand", "simulation_page", "simulated")),
}


def _origin(result: Any, what: str) -> tuple[Any, Any]:
    """Record and calibration of a compensation."""
    if result.made_from is None:
        raise CalibrationError(
            f"{what}: this compensation was read or copied without its record and calibration",
            remedy="compensate again: piga.compensate(run, cal)",
        )
    run, calibration = result.made_from
    return run, calibration


def _outline(result: Any) -> Any:
    from piga.reports.compensation.outline import outline_of

    run, calibration = _origin(result, "plot")
    outline = outline_of(run.kind, calibration)
    outline.record(run, result)
    return outline


# -- figures -------------------------------------------------------------------------------------------


NO_FIGURE = {
    "segments": "calibrate a record: these coefficients have no segments",
    "budget": "calibrate a record, or read a calibration.json that has a budget",
    "convergence": "calibrate in this process with method='recursive'",
}
"""What to do where a calibration lacks the data of a figure. All other figures need residuals."""


def calibration_figure(cal: Any, name: str) -> Figure:
    """A figure of the calibration report.

    Raises
    ------
    CalibrationError
        If the calibration has no data for it.
    """
    from piga.reports.calibration import figures as drawn

    figure = None
    if name == "segments":
        figure = drawn.segment_figure(cal) if cal.segments else None
    elif name == "budget":
        figure = drawn.budget_figure(cal) if cal.budget else None
    elif name == "convergence":
        figure = drawn.convergence_figure(cal) if cal.history is not None else None
    elif cal.residuals is not None and cal.residuals.t.size:
        key = {"residuals": "residual-time", "orders": "residual-order", "ripple": "ripple-polar"}.get(
            name, name
        )
        figure = next((f for f in drawn.calibration_figures(cal) if f.key.startswith(key)), None)
    if figure is None:
        raise CalibrationError(
            f"plot.{name}: this calibration has no data for the figure",
            remedy=NO_FIGURE.get(name, "calibrate a record that has what the figure shows")
            if cal.given or name in NO_FIGURE or cal.residuals is not None
            else "calibrate the record in this process: calibration.json and pickles hold no residuals",
        )
    return figure


def _residual_figure(residuals: Any, _: str) -> Figure:
    from piga.reports.calibration.figures import residual_figure
    from piga.reports.render.decimate import outline

    return residual_figure(outline(residuals))


def _compensated_figure(result: Any, _: str) -> Figure:
    from piga.reports.compensation.figures import force_figure, plain_force_figure

    return plain_force_figure(result) if result.made_from is None else force_figure(_outline(result))


def _plan_figure(plan: Any, name: str) -> Figure:
    from piga.reports import planning as drawn

    return {"": drawn.dwell_figure, "uncertainty": drawn.uncertainty_figure, "duration": drawn.duration_figure}[
        name
    ](plan)


def _trend_figure(trend: Any, name: str) -> Figure:
    from piga.reports.trend import trend_figure

    return trend_figure(trend, trend[name or trend.coefficients[0].key], None)


def _drawn_by(module: str, function: str) -> Callable[[Any, str], Figure]:
    """The one figure of a result, by a function of a report."""
    draw = _of(module, function)
    return lambda result, _: draw(result)


FIGURES: dict[str, Callable[[Any, str], Figure]] = {
    "Calibration": calibration_figure,
    "Run": _drawn_by("check", "record_figure"),
    "Residuals": _residual_figure,
    "Compensated": _compensated_figure,
    "CompensatedSet": _drawn_by("compensation.figures", "plain_set_figure"),
    "Plan": _plan_figure,
    "Trend": _trend_figure,
    "AllanDeviation": _drawn_by("calibration.figures", "deviation_figure"),
    "SimulatedTest": _drawn_by("stand", "stand_figure"),
    "PlatformRun": _drawn_by("platform.figures", "readouts_figure"),
    "GrowingIdentification": _drawn_by("platform.figures", "convergence_figure"),
    "ModelComparisonRun": _drawn_by("platform.figures", "lines_figure"),
}
