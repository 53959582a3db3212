"""The statements of a certificate, with the clauses of ISO/IEC 17025:2017 that demand them."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator
from dataclasses import dataclass

from piga.certificate.certificate_file import (
    WORST,
    CertificateFile,
    Status,
    limits_in_file_units,
    overall,
    range_sentence,
    validity_ranges,
)
from piga.records.calibration import Calibration

_WORDS: dict[Status, str] = {
    "pass": "conforms",
    "fail": "does not conform",
    "conditionalPass": "inside the limits, by less than the expanded uncertainty",
    "conditionalFail": "outside the limits, by less than the expanded uncertainty",
}
_RULES = {
    "simple": "simple acceptance: a result conforms when it lies inside the limits, whatever its uncertainty",
    "guarded": "guarded acceptance (guard band of one expanded uncertainty): a result conforms when the interval of "
    "its expanded uncertainty lies inside the limits, and does not when the interval lies outside",
}
TRACEABILITY = "basic_traceability"
"""``ref_type`` of the statement of traceability. The page has a section for it."""


@dataclass(frozen=True)
class _Statement:
    """One statement. ``ranges`` are (name, low, high, SI unit). ``ref_type`` identifies it in a DCC."""

    title: str
    text: str
    clause: str
    ref_type: str = ""
    conformity: str = ""
    date: dt.date | None = None
    ranges: tuple[tuple[str, float, float, str], ...] = ()


@dataclass(frozen=True)
class Conformity:
    """Conformity of one coefficient. Limits and values are in its file unit."""

    key: str
    unit: str
    low: float
    high: float
    value: float
    expanded: float
    status: Status

    @property
    def words(self) -> str:
        """The verdict in words."""
        return _WORDS[self.status]


def verdicts(data: CertificateFile, calibration: Calibration) -> tuple[Conformity, ...]:
    """Conformity of each coefficient that has limits, by the agreed decision rule (JCGM 106, 8.2 and 8.3.2)."""
    rule = data.conformity
    if rule is None:
        return ()
    conformities = []
    for key, pair in rule.limits.items():
        c = calibration[key]
        low, high = limits_in_file_units(c.unit, pair)
        least, most = c.limits if rule.rule == "guarded" else (c.value, c.value)
        status = _status(c.value, least, most, low, high)
        conformities.append(Conformity(key, c.unit, low, high, c.value, c.expanded, status))
    return tuple(conformities)


def _status(value: float, least: float, most: float, low: float, high: float) -> Status:
    """Verdict on the interval ``least`` to ``most`` of a value, for the limits ``low`` and ``high``."""
    if low <= least and most <= high:
        return "pass"
    if most < low or least > high:
        return "fail"
    return "conditionalPass" if low <= value <= high else "conditionalFail"


def decision_rule(data: CertificateFile) -> str:
    """The decision rule in words."""
    return "" if data.conformity is None or data.conformity.rule is None else _RULES[data.conformity.rule]


def statements(data: CertificateFile, calibration: Calibration) -> tuple[_Statement, ...]:
    """All applicable statements, in the order of the standard."""
    return tuple(_statements(data, calibration))


def _statements(data: CertificateFile, calibration: Calibration) -> Iterator[_Statement]:
    method, say, traceability = data.method, data.statements, data.traceability.statement
    text = "The results relate only to the item described here, in the state in which it was calibrated."
    yield _Statement("Scope of the results", text, "7.8.2.1 l")
    text = "This certificate shall not be reproduced except in full without approval of the laboratory."
    yield _Statement("Reproduction", text, "7.8.2.1")
    yield _Statement("Sampling", f"Sampling plan: {method.sampling}.", "7.8.2.1 k")
    text = f"Additions, deviations and exclusions from the method: {method.deviations}."
    yield _Statement("Method", text, "7.8.2.1 n")
    text = f"Results from external providers: {method.external_results}."
    yield _Statement("External providers", text, "7.8.2.1 p")
    text = "The item was neither adjusted nor repaired; the results are those of the item as received."
    if data.adjustment.performed:
        how = f": {data.adjustment.description}" if data.adjustment.description else ""
        text = f"The item was adjusted or repaired{how}. Results before and after are given."
    yield _Statement("Adjustment", text, "7.8.4.1 d")
    yield _Statement("Traceability", traceability, "7.8.4.1 c", ref_type=TRACEABILITY)
    if ranges := validity_ranges(calibration):
        text = range_sentence(ranges)
        yield _Statement("Range", text, "7.8.4.1 b", ref_type="basic_validityRange", ranges=ranges)
    if data.conformity is not None:
        conformities = verdicts(data, calibration)
        worst = max((verdict.status for verdict in conformities), key=WORST.index)
        names = ", ".join(verdict.key for verdict in conformities)
        text = f"Specification: {data.conformity.specification}. Decision rule: {decision_rule(data)}."
        text += f" Applies to: {names}. Overall: {overall(worst)}."
        yield _Statement("Conformity", text, "7.8.6.2", ref_type="basic_conformity", conformity=worst)
    if say.opinions:
        text = f"{say.opinions} (Opinion of {say.opinions_by}.)"
        yield _Statement("Opinions and interpretations", text, "7.8.7")
    if say.recalibrate and say.interval_agreed:
        text, when = (
            "As agreed with the customer, the item is to be recalibrated by this date.",
            say.recalibrate,
        )
        yield _Statement("Recalibration", text, "7.8.4.3", ref_type="basic_recalibration", date=when)
    if data.certificate.replaces:
        text = (
            f"This certificate replaces certificate {data.certificate.replaces}. {data.certificate.amendment}"
        )
        yield _Statement("Amendment", text, "7.8.8")
    if say.remarks:
        yield _Statement("Remarks", say.remarks, "7.8.2")
