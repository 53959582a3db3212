"""The comparison of term sets: table and figure of the report, rows for the terminal."""

from __future__ import annotations

from textwrap import wrap
from typing import Any

from piga.records.calibration import Calibration
from piga.records.terms import shown_unit
from piga.reports.render.figure import Axis, Figure, Panel, Series
from piga.reports.render.numbers import aligned, ascii_text, count, printed, rounded, short, signed
from piga.reports.render.page import Cell, FigureBlock, Section, Table, TableColumn, Text
from piga.units import MICRO_G

HEADS = (
    "",
    "terms",
    "coefficients",
    "chi²/dof",
    "BIC above best",
    "weight",
    "prediction above best",
    "missed [µg]",
    "remark",
)


def comparison_sections(cal: Calibration) -> tuple[Section, ...]:
    """The section of the report, if term sets were compared."""
    document = cal.diagnostics.model_comparison
    if not document:
        return ()
    lead = (
        "Which terms the record asks for. Sets are compared with the same noise weights; every part of the record is "
        "also predicted from the others. A term that the record needs lowers BIC and prediction error by much; one "
        "that it does not need raises both a little. " + comparison_words(document)
    )
    blocks = (
        Text(lead, lead=True),
        comparison_table(document),
        comparison_figure(document),
        shift_table(document),
    )
    shown = tuple(
        FigureBlock(block) if isinstance(block, Figure) else block for block in blocks if block is not None
    )
    return (Section("Model choice", "model-choice", shown),)


def comparison_words(document: dict[str, Any]) -> str:
    """Result of the comparison, in words."""
    if document["best"] is None:
        return "The record determines none of the sets."
    words = f"Least BIC: {_terms(document['best'])}."
    if document["best_prediction"] is None:
        return words + " Parts of the record cannot be predicted from the others."
    parts = {"segment": "segments", "block": "blocks"}[document["parted_by"]]
    return (
        f"{words} Fewest coefficients within one standard error of the best prediction "
        f"({count(document['folds'])} folds over {count(document['parts'])} {parts}): "
        f"{_terms(document['best_prediction'])}."
    ) + "".join(f" {note[0].upper()}{note[1:]}." for note in document.get("notes", ()))


def _terms(names: list[str]) -> str:
    return ", ".join(names)


def comparison_rows(document: dict[str, Any]) -> list[tuple[str, ...]]:
    """Rows below :data:`HEADS`, the least BIC first."""
    order = sorted(
        enumerate(document["sets"], start=1), key=lambda item: (item[1].get("bic", float("inf")), item[0])
    )
    return [_row(number, candidate, document) for number, candidate in order]


def _row(number: int, candidate: dict[str, Any], document: dict[str, Any]) -> tuple[str, ...]:
    head = (str(number), _terms(candidate["terms"]))
    if "bic" not in candidate:
        return (*head, *("–",) * (len(HEADS) - 3), candidate["reason"])
    figures: tuple[str, ...] = (str(candidate["parameters"]), _plain(candidate["chi_square_per_degree"], 4))
    figures += (
        _plain(candidate["bic_above_best"]),
        _plain(candidate["weight"]) if candidate["weight"] > 1e-6 else "0",
    )
    if "prediction_chi_square" not in candidate:
        return (*head, *figures, "–", "–", _remark(candidate, document))
    above, error = candidate["prediction_above_best"], candidate["prediction_standard_error"]
    spread = f" ± {_plain(error, 2)}" if error > 1e-6 * candidate["prediction_chi_square"] else ""
    excess = f"{_plain(above)}{spread}" if spread else "0"
    return (
        *head,
        *figures,
        excess,
        _plain(candidate["prediction_force_error"] / MICRO_G),
        _remark(candidate, document),
    )


def _remark(candidate: dict[str, Any], document: dict[str, Any]) -> str:
    remarks = ["least BIC"] if candidate["terms"] == document["best"] else []
    remarks += ["predicts as well as any"] if candidate["terms"] == document["best_prediction"] else []
    return ", ".join(remarks)


def _plain(value: float, digits: int = 3) -> str:
    return printed(short(value, digits))


def comparison_text(document: dict[str, Any]) -> list[str]:
    """The comparison for a terminal of 80 columns: figures by number of the set, then what the sets hold."""
    heads = ("set", "coeffs", "chi2/dof", "BIC above", "weight", "prediction above", "missed [ug]")
    order = comparison_rows(document)
    rows = [tuple(map(ascii_text, (row[0], *row[2:-1]))) for row in order if row[2] != "–"]
    lines = ["Term sets compared, the best first"]
    lines += [f"  {line}" for line in aligned((heads, *rows))] if rows else []
    for number, terms, *_, remark in order:
        text = f"{number}: {terms}" + (f" ({remark})" if remark else "")
        lines += wrap(text, 78, initial_indent="  ", subsequent_indent="     ")
    return [*lines, *wrap(comparison_words(document), 78, initial_indent="  ", subsequent_indent="  ")]


def comparison_table(document: dict[str, Any]) -> Table:
    """One row per set, the least BIC first."""
    textual = {"terms", "remark"}
    columns = tuple(
        TableColumn(
            head.removesuffix(" [µg]"),
            "µg" if head.endswith("[µg]") else "",
            "text" if head in textual else "number",
        )
        for head in HEADS
    )
    noise = _terms(document["noise_terms"])
    cells = tuple(
        tuple(
            Cell(text, "good") if text and i == len(row) - 1 and row[2] != "–" else text
            for i, text in enumerate(row)
        )
        for row in comparison_rows(document)
    )
    return Table(
        columns,
        cells,
        caption="Term sets compared",
        notes=(
            f"Noise weights of all sets: those found with {noise}. {count(document['observations'])} observations.",
            "Prediction: chi-square of the parts left out, with the standard error of the difference.",
            "Missed: rms over the parts of the mean error of prediction, as specific force.",
        ),
    )


def comparison_figure(document: dict[str, Any]) -> Figure | None:
    """BIC and error of prediction of every set."""
    sets = _determined(document)
    if not sets:
        return None
    axis = Axis("set (number of the table)", "1", limits=(0.5, len(document["sets"]) + 0.5))
    names = tuple(_terms(candidate["terms"]) for _, candidate in sets)
    numbers = [float(number) for number, _ in sets]
    above = Series(
        numbers,
        [candidate["bic_above_best"] + 1.0 for _, candidate in sets],
        "BIC",
        "points",
        "model",
        text=names,
    )
    panels = [Panel(axis, Axis("BIC above the best + 1", "1", log=True), (above,), title="Likelihood")]
    predicted = [(n, f) for n, f in sets if "prediction_force_error" in f]
    if predicted:
        missed = [candidate["prediction_force_error"] / MICRO_G for _, candidate in predicted]
        series = Series([float(n) for n, _ in predicted], missed, "missed", "points", "after", text=names)
        panels.append(Panel(axis, Axis("error of prediction", "µg", log=True), (series,), title="Prediction"))
    return Figure(
        key="term-sets",
        title="Term sets: likelihood and prediction.",
        panels=tuple(panels),
        caption="Left: how far BIC lies above that of the best set (at 1). Right: rms error of the mean specific force "
        "in parts of the record predicted from the others. Good: the set in use is among the lowest of both.",
        columns=2,
        height=2.4,
    )


def _determined(document: dict[str, Any]) -> list[tuple[int, dict[str, Any]]]:
    """The sets that the record determines, with their numbers in the table."""
    return [(number, one) for number, one in enumerate(document["sets"], start=1) if "bic" in one]


def shift_table(document: dict[str, Any]) -> Table | None:
    """Every coefficient in every set that is determined."""
    sets = _determined(document)
    keys = list(
        dict.fromkeys(
            c["key"] for _, candidate in sets for c in candidate["coefficients"] if "[" not in c["key"]
        )
    )
    if len(sets) < 2:
        return None
    rows = []
    for key in keys:
        cells: list[str | Cell] = [key, ""]
        for _, candidate in sets:
            c = next((c for c in candidate["coefficients"] if c["key"] == key), None)
            if c is None:
                cells.append("–")
                continue
            scale, unit = shown_unit(key, c["unit"])
            value, std, cells[1] = c["value"] * scale, c["std"] * scale, unit
            change = "" if c["change"] in (None, 0.0) else f" ({signed(c['change'], 1)})"
            cells.append(printed(rounded(value, std).concise) + change)
        rows.append(tuple(cells))
    columns = (
        TableColumn("coefficient", "", "text"),
        TableColumn("unit", "", "text"),
        *(TableColumn(f"set {n}") for n, _ in sets),
    )
    note = "Type A. In brackets behind: distance from the set of least BIC, in standard uncertainties of that."
    return Table(columns, tuple(rows), caption="Coefficients in every set", notes=(note,))
