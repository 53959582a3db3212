"""The comparison of term sets as tables."""

from __future__ import annotations

from typing import Any

from piga.records.calibration import Calibration
from piga.records.terms import shown_unit
from piga.reports.render.numbers import count, pretty_unit, rounded, short, signed
from piga.reports.render.page import Cell, Section, Table, TableOf, Text
from piga.units import MICRO_G

_NUMBERED = tuple[int, dict[str, Any]]
"""A set with its number in the table."""


def comparison_sections(cal: Calibration) -> tuple[Section, ...]:
    """The section of the report, if term sets were compared."""
    document: Any = cal.diagnostics.model_comparison
    if not document:
        return ()
    lead = (
        "Which terms the record asks for. Sets are compared with the same noise weights; every part of the record is "
        "also predicted from the others. A term that the record needs lowers BIC and prediction error by much; one "
        "that it does not need raises both a little."
    )
    shown = (comparison_table(document), _shift_table(document))
    return (Section("Model choice", "model-choice", (lead, Text(comparison_words(document)), *shown)),)


def comparison_words(document: dict[str, Any]) -> str:
    """Result of the comparison, in words."""
    if document["best"] is None:
        return "The record determines none of the sets."
    words = f"Least BIC: {', '.join(document['best'])}."
    if document["best_prediction"] is None:
        return words + " Parts of the record cannot be predicted from the others."
    parts = {"segment": "segments", "block": "blocks"}[document["parted_by"]]
    notes = "".join(f" {note[0].upper()}{note[1:]}." for note in document.get("notes", ()))
    return (
        f"{words} Fewest coefficients within one standard error of the best prediction "
        f"({count(document['folds'])} folds over {count(document['parts'])} {parts}): "
        f"{', '.join(document['best_prediction'])}.{notes}"
    )


def comparison_table(document: dict[str, Any]) -> Table:
    """One row per set, the least BIC first."""
    numbered: list[_NUMBERED] = sorted(
        enumerate(document["sets"], start=1), key=lambda item: (item[1].get("bic", float("inf")), item[0])
    )

    def number(key: str, scale: float = 1.0, digits: int = 3) -> Any:
        return lambda item: short(item[1][key] * scale, digits) if key in item[1] else "–"

    return (
        TableOf(numbered)
        .number("set", lambda item: str(item[0]))
        .text("terms", lambda item: ", ".join(item[1]["terms"]))
        .number("coefficients", lambda item: str(item[1]["parameters"]) if "bic" in item[1] else "–")
        .number("chi²/dof", number("chi_square_per_degree", digits=4))
        .number("BIC above best", number("bic_above_best"))
        .number("weight", lambda item: "0" if item[1].get("weight", 1.0) <= 1e-6 else number("weight")(item))
        .number("prediction above best", lambda item: _above(item[1]))
        .number("missed", number("prediction_force_error", 1.0 / MICRO_G), "µg")
        .text("remark", lambda item: _remark(item[1], document))
        .table(
            "Term sets compared",
            (
                f"Noise weights of all sets: those found with {', '.join(document['noise_terms'])}.",
                f"{count(document['observations'])} observations.",
                "Prediction: chi-square of the parts left out, with the standard error of the difference.",
                "Missed: rms over the parts of the mean error of prediction, as specific force.",
            ),
        )
    )


def _above(candidate: dict[str, Any]) -> str:
    """Prediction above the best one, with the standard error of the difference."""
    if "prediction_chi_square" not in candidate:
        return "–"
    error = candidate["prediction_standard_error"]
    if error <= 1e-6 * candidate["prediction_chi_square"]:
        return "0"
    return f"{short(candidate['prediction_above_best'])} ± {short(error, 2)}"


def _remark(candidate: dict[str, Any], document: dict[str, Any]) -> str | Cell:
    if "bic" not in candidate:
        return str(candidate["reason"])
    remarks = ["least BIC"] if candidate["terms"] == document["best"] else []
    remarks += ["predicts as well as any"] if candidate["terms"] == document["best_prediction"] else []
    return Cell(", ".join(remarks), "good") if remarks else ""


def _determined(document: dict[str, Any]) -> list[_NUMBERED]:
    """The sets that the record determines, with their numbers in the table."""
    return [(number, one) for number, one in enumerate(document["sets"], start=1) if "bic" in one]


def _shift_table(document: dict[str, Any]) -> Table | None:
    sets = _determined(document)
    if len(sets) < 2:
        return None
    known = {number: {c["key"]: c for c in one["coefficients"] if "[" not in c["key"]} for number, one in sets}
    units = {key: shown_unit(key, c["unit"]) for of_set in known.values() for key, c in of_set.items()}
    note = "Type A. In brackets behind: distance from the set of least BIC, in standard uncertainties of that."
    return (
        TableOf(units)
        .text("coefficient", str)
        .text("unit", lambda key: pretty_unit(units[key][1]) or "1")
        .across(
            known, lambda number: f"set {number}", lambda key, n: _shifted(known[n].get(key), units[key][0])
        )
        .table("Coefficients in every set", (note,))
    )


def _shifted(c: dict[str, Any] | None, scale: float) -> str:
    if c is None:
        return "–"
    change = "" if c["change"] in (None, 0.0) else f" ({signed(c['change'], 1)})"
    return rounded(c["value"] * scale, c["std"] * scale).concise + change
