"""The page and the text of a collected campaign: coverage, bias, NEES, worst cases, failures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from piga.campaign.collect import CHANCE, SURE, CampaignCoefficient, Collected, GroupResult
from piga.records.terms import shown_unit
from piga.reports.render.figure import Figure, Plot, Role
from piga.reports.render.numbers import pretty_unit, short, signed
from piga.reports.render.page import ALONE, Cell, Content, Notice, Page, Section, Table, TableOf, Text, Tone

_GROUPS = 60
"""Most groups whose tables are on the page; ``coefficients.csv`` has all."""


def campaign_page(collected: Collected) -> Page:
    """The page of a campaign."""
    judged = [result for result in collected.groups if _has_truth(result)]
    plain = [result for result in collected.groups if result.coefficients and not _has_truth(result)]
    seen = [result for result in collected.groups if result.seen]
    figure: list[Content] = [_LEAD, _coverage_figure(judged)] if judged else []
    sections: list[tuple[str, str, Sequence[Content]]] = [
        ("Judgement", "judgement", judgement(collected)),
        ("Intervals", "intervals", [*figure, *_tables(judged, _interval_table)]),
        ("Results", "results", _tables(plain, _plain_table)),
        ("What the calibrations report", "seen", [_seen_table(seen)] if seen else []),
        ("Worst cases", "worst", [_worst_table(collected)] if collected.worst else []),
        ("Records that failed", "failures", [_failure_table(collected)] if collected.failures else []),
    ]
    return Page(
        title=collected.title,
        subtitle=f"{collected.computed} of {collected.records} records, from {collected.campaign}, seed {collected.seed}.",
        sections=tuple(Section(title, anchor, tuple(blocks)) for title, anchor, blocks in sections if blocks),
        kicker="piga · campaign",
        footer=f"Made by piga {collected.version}. {ALONE}",
    )


def _has_truth(result: GroupResult) -> bool:
    return any(c.coverage is not None for c in result.coefficients)


# --- judgement ---------------------------------------------------------------------------------------


def judgement(collected: Collected) -> list[Content]:
    """What is missing or failed, and every quantity that misses its target."""
    blocks: list[Content] = []
    if collected.missing:
        text = f"{len(collected.missing)} of {collected.shards} shards are not computed. Their records are missing."
        blocks.append(Notice("warning", text))
    if collected.failed:
        text = f"{collected.failed} of {collected.computed} records failed. They are not in the figures below."
        empty = [result.label for result in collected.groups if result.failed and not result.coefficients]
        text += f" Not one record could be computed of: {'; '.join(empty)}." if empty else ""
        blocks.append(Notice("problem" if empty else "warning", text))
    sure = [miss.label for miss in collected.misses if abs(miss.standard_errors) > SURE]
    perhaps = [miss.label for miss in collected.misses if abs(miss.standard_errors) <= SURE]
    if sure:
        blocks.append(Notice("warning", f"Off its target by more than chance explains: {'; '.join(sure)}."))
    if perhaps:
        targets = 2 * sum(c.coverage is not None for r in collected.groups for c in r.coefficients)
        blocks.append(
            Notice(
                "warning" if len(perhaps) > 3 + targets / 10 else "good",
                f"Off its target by more than {CHANCE:g} standard errors: {'; '.join(perhaps)}. "
                f"Of {targets} targets about {max(1, round(targets / 20))} lie so far off by chance.",
            )
        )
    if not blocks:
        blocks.append(Notice("good", "All records are computed, and every quantity meets its target."))
    return blocks


def _tone(c: CampaignCoefficient) -> Tone:
    """Bad if fewer intervals hold than chance explains, doubtful if more hold or the share is at the edge of chance."""
    if c.coverage_off < -SURE:
        return "bad"
    return "doubtful" if abs(c.coverage_off) > CHANCE else ""


# --- tables ------------------------------------------------------------------------------------------

_LEAD = (
    "Coverage is the share of 95 % intervals that hold the true value, with the binomial standard error of a share of 95 %. "
    f"It is marked where it is more than {CHANCE:g} standard errors away from 95 %. Bias is the mean error over the spread of the "
    "errors. NEES is the mean square of the errors over their standard uncertainties. The expected value of Student's t stands "
    "beside it."
)


def _tables(results: list[GroupResult], table: Callable[[GroupResult], Table]) -> list[Content]:
    blocks: list[Content] = [table(result) for result in results[:_GROUPS]]
    if len(results) > _GROUPS:
        blocks.append(Text(f"{len(results) - _GROUPS} more groups are in coefficients.csv."))
    return blocks


def _coefficients(result: GroupResult) -> TableOf[CampaignCoefficient]:
    return (
        TableOf(result.coefficients)
        .text("Quantity", lambda c: c.name)
        .text("Unit", _unit)
        .number("Tests", lambda c: str(c.tests))
    )


def _count(result: GroupResult) -> str:
    return f"{result.records} records, {sum(result.failed.values())} failed."


def _interval_table(result: GroupResult) -> Table:
    note = _count(result)
    if result.nees is not None:
        note += f" NEES of all coefficients together: {result.nees:.3f}; expected {result.nees_expected:.3f}."
    return (
        _coefficients(result)
        .number("Coverage", lambda c: Cell(_with_error(c), _tone(c)), "%")
        .number("Spread of errors", lambda c: _number(c, c.spread))
        .number("Mean error", lambda c: _number(c, c.bias))
        .number("Bias / sigma", lambda c: _or_dash(c.bias_over_sigma, lambda x: signed(x, 3)))
        .number("NEES (expected)", lambda c: _or_dash(c.nees, lambda x: f"{x:.2f} ({c.nees_expected:.2f})"))
        .number("Largest error", lambda c: _or_dash(c.largest_z, "{:.1f}".format), "u")
        .table(result.label, (note,))
    )


def _plain_table(result: GroupResult) -> Table:
    return (
        _coefficients(result)
        .number("Mean", lambda c: _number(c, c.mean))
        .number("Standard deviation", lambda c: _number(c, c.standard_deviation))
        .number("Lowest", lambda c: _number(c, c.lowest))
        .number("Highest", lambda c: _number(c, c.highest))
        .table(result.label, (_count(result),))
    )


def _seen_table(results: list[GroupResult]) -> Table:
    names = sorted(dict.fromkeys(name for result in results for name in result.seen))
    return (
        TableOf(results)
        .text("Group", lambda result: result.label)
        .number("Records", lambda result: str(result.records))
        .across(names, str, lambda result, name: f"{100 * result.seen.get(name, 0.0):.1f}", lambda _: "%")
        .table(notes=("Share of the records with this noise in the result, or this term suggested.",))
    )


def _worst_table(collected: Collected) -> Table:
    return (
        TableOf(collected.worst)
        .text("Group", lambda w: w.group)
        .text("Coefficient", lambda w: w.coefficient)
        .number("Error", lambda w: signed(w.z, 1), "u")
        .text("Repeat it with", lambda w: w.command)
        .table("The largest errors over their standard uncertainties")
    )


def _failure_table(collected: Collected) -> Table:
    return (
        TableOf(collected.failures)
        .text("Class", lambda f: f.error_class)
        .number("Records", lambda f: str(f.records))
        .text("First message", lambda f: f.message[:300])
        .text("Repeat it with", lambda f: f.command)
        .table("A record that fails is a row; the campaign goes on.")
    )


def _or_dash(value: float | None, words: Callable[[float], str]) -> str:
    return "–" if value is None else words(value)


def _with_error(c: CampaignCoefficient) -> str:
    if c.coverage is None or c.coverage_std_error is None:
        return "–"
    return f"{100 * c.coverage:.1f} ± {100 * c.coverage_std_error:.1f}"


def _unit(c: CampaignCoefficient) -> str:
    return pretty_unit(shown_unit(c.name, c.unit)[1]) or "1"


def _number(c: CampaignCoefficient, value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return "–"
    return short(value * shown_unit(c.name, c.unit)[0], 3)


# --- figures -----------------------------------------------------------------------------------------


def _coverage_figure(judged: list[GroupResult]) -> Figure:
    points = [(r, c) for r in judged for c in r.coefficients if c.coverage is not None]
    x = np.arange(1, len(points) + 1, dtype=float)
    share = np.array([100 * (c.coverage or 0.0) for _, c in points])
    error = np.array([100 * CHANCE * (c.coverage_std_error or 0.0) for _, c in points])
    off = np.array([_tone(c) != "" for _, c in points])
    text = np.array([f"{r.label}: {c.name}" for r, c in points])
    plot = Plot(
        "coverage", "Coverage of the 95 % intervals.", "coefficients in the order of the tables", "coverage [%]"
    )
    plot.level([0.5, len(points) + 0.5], 95.0, "95 %")
    kinds: tuple[tuple[str, Role], ...] = (("coefficients", "data"), ("off the target", "warning"))
    for chosen, (name, role) in zip((~off, off), kinds, strict=True):
        if chosen.any():
            names = tuple(text[chosen].tolist())
            plot.points(x[chosen], share[chosen], name, role, error=error[chosen], text=names)
    return plot.caption(
        f"One point for each coefficient of each group, with {CHANCE:g} standard errors. Good: the bars touch the line."
    )
