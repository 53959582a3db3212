"""The calibration certificate by ISO/IEC 17025:2017, 7.8.2 and 7.8.4, as one HTML file for print on A4.

Every printed page shows the unique number (header, and footer with "page n of m"). A line marks the end. If items are
missing, :func:`certificate_html` issues nothing and lists all of them.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import replace

from piga.certificate.certificate_file import (
    CertificateFile,
    Conformity,
    decision_rule,
    missing_items,
    statement_facts,
    verdicts,
)
from piga.data import example_files
from piga.errors import CalibrationError
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.coefficient import Coefficient
from piga.records.terms import shown_unit, term_words
from piga.reports.calibration.tables import (
    DESCRIBED,
    budget_table,
    common_coefficients,
    correlation_table,
    factor,
    freedom,
    monte_carlo_interval,
)
from piga.reports.render.numbers import Rounded, count, pretty_unit, printed, relative, rounded, significant
from piga.reports.render.page import Table, TableOf, resource, template
from piga.units import written_quantity

_ACROSS = 5
"""Most coefficients side by side in a table of the certificate."""


_Part = tuple[str, tuple[str, ...], tuple[Table, ...]]
"""Heading, paragraphs and tables of one part of the certificate."""


def require_complete(
    data: CertificateFile, calibration: Calibration, before: Calibration | None = None
) -> None:
    """Refuse a certificate that lacks an item.

    Raises
    ------
    CalibrationError
        If an item is missing. The message lists all missing items and the clauses that demand them.
    """
    missing = missing_items(data, calibration, before)
    if missing:
        listed = "\n".join(f"  - {item}" for item in missing)
        raise CalibrationError(
            f"the certificate cannot be issued: {len(missing)} item{'s' * (len(missing) > 1)} of ISO/IEC 17025:2017 "
            f"missing or wrong\n{listed}",
            remedy="complete the file given with --data; sources of the stand belong in the run file",
        )


def certificate_html(
    data: CertificateFile,
    calibration: Calibration,
    before: Calibration | None = None,
    *,
    record_sha256: str = "",
) -> str:
    """The certificate as HTML text. The same input always gives the same bytes.

    Raises
    ------
    CalibrationError
        If an item is missing.
    """
    require_complete(data, calibration, before)
    return template("certificate.html.jinja").render(
        data=data,
        draft=is_draft(data),
        css=resource("templates", "certificate.css"),
        number_css=_css_string(data.certificate.number),
        calibration=calibration,
        parts=_parts(data, calibration, before),
        facts=statement_facts(data, calibration),
        record_sha256=record_sha256,
        count=count,
    )


def is_draft(data: CertificateFile) -> bool:
    """Whether laboratory or customer are those of the shipped example, or the number begins with DRAFT: no certificate."""
    example = tomllib.loads(example_files()["certificate.toml"].decode())
    named = (getattr(data, table).name == example[table]["name"] for table in ("laboratory", "customer"))
    return data.certificate.number.startswith("DRAFT") or any(named)


def _css_string(text: str) -> str:
    """Text for a CSS string. Everything except letters, digits and some marks is escaped."""
    return "".join(c if c.isascii() and (c.isalnum() or c in " -_.:") else f"\\{ord(c):x} " for c in text)


def _parts(data: CertificateFile, calibration: Calibration, before: Calibration | None) -> list[_Part]:
    method = data.method
    lines = (f"{method.name} ({', '.join(method.documents)}).", method.description)
    conditions = (
        TableOf(data.environment)
        .text("Condition", lambda c: c.name)
        .number("Value", lambda c: _quantity(c.value))
        .number("Expanded uncertainty (k = 2)", lambda c: _quantity(c.uncertainty) or "–")
        .table()
    )
    standards = (
        TableOf(data.traceability.standard)
        .text("Standard", lambda s: s.name)
        .text("Realises", lambda s: s.realises or "–")
        .text("Identification", lambda s: s.identification or "–")
        .text("Certificate", lambda s: s.certificate or "–")
        .table()
    )
    parts: list[_Part] = [
        ("Method", tuple(line for line in lines if line), ()),
        ("Conditions", (), (conditions,)),
        ("Traceability", (data.traceability.statement,), (standards,)),
        _results(calibration, before),
    ]
    if conformity := verdicts(data, calibration):
        rule = f"Specification: {data.conformity.specification}. " if data.conformity else ""
        rule += f"Decision rule, agreed with the customer: {decision_rule(data)}."
        parts.append(("Conformity", (rule,), (_conformity_table(conformity),)))
    return parts


def _quantity(text: str) -> str:
    """A quantity written by a person, as it is printed."""
    number, unit = written_quantity(text) if text else ("", "")
    return f"{printed(number.lower())} {pretty_unit(unit)}".strip()


def _results(calibration: Calibration, before: Calibration | None) -> _Part:
    text = (
        "U is the expanded uncertainty for a coverage probability of 95 %: the standard uncertainty times the coverage "
        "factor k of Student's t for the effective degrees of freedom ν of the result. It was evaluated by JCGM 100 "
        "from the contributions below and stands in the unit of the value. The unit g is 9.80665 m/s² exactly."
    )
    paragraphs = [text]
    common = common_coefficients(calibration)
    if intervals := [f"{c.key} {monte_carlo_interval(c)}" for c in common if c.interval]:
        paragraphs.append(
            "Shortest 95 % interval by Monte Carlo (JCGM 101), where JCGM 100 does not hold: "
            f"{'; '.join(intervals)}. U is half its width."
        )
    tables = [_result_table(calibration, "Results" if before is None else "Results after adjustment")]
    if before is not None:
        tables.insert(0, _result_table(before, "Results before adjustment"))
    if len(common) < len(calibration.coefficients):
        paragraphs.append(
            "Phases of single segments hold for one power-up of the readout each and are not listed."
        )
    budget = replace(budget_table(calibration), caption="Standard uncertainty of each coefficient by source")
    tables += replace(budget, notes=()).parts(DESCRIBED, _ACROSS)
    correlation = correlation_table(calibration)
    if correlation is not None:
        tables += replace(correlation, caption="Correlation coefficients of the results").parts(1, _ACROSS)
    return "Results", tuple(paragraphs), tuple(tables)


def _result_table(calibration: Calibration, caption: str) -> Table:
    def number(c: Coefficient) -> Rounded:
        scale = shown_unit(c.name, c.unit)[0]
        return rounded(c.value * scale, c.expanded * scale)

    def known(cell: Callable[[Coefficient], str], exact: str = "–") -> Callable[[Coefficient], str]:
        return lambda c: "–" if not c.determined else exact if c.std == 0.0 else cell(c)

    return (
        TableOf(common_coefficients(calibration))
        .text("Coefficient", lambda c: c.name)
        .text("Meaning", lambda c: term_words(c.name).meaning)
        .number("Value", lambda c: number(c).value if c.determined else "not determined")
        .number("U (95 %)", known(lambda c: number(c).uncertainty, "given"))
        .text("Unit", lambda c: pretty_unit(shown_unit(c.name, c.unit)[1] if c.determined else c.unit) or "1")
        .number("U / value", known(lambda c: relative(c.value, c.expanded)))
        .number("ν", known(freedom))
        .number("k", known(factor))
        .table(caption)
    )


def _conformity_table(conformity: tuple[Conformity, ...]) -> Table:
    def shown(one: Conformity, value: float) -> float:
        return value * shown_unit(one.key, one.coefficient.unit)[0]

    def number(one: Conformity) -> Rounded:
        return rounded(shown(one, one.coefficient.value), shown(one, one.coefficient.expanded))

    return (
        TableOf(conformity)
        .text("Coefficient", lambda one: one.key)
        .number("Lower limit", lambda one: significant(shown(one, one.low)))
        .number("Value", lambda one: number(one).value)
        .number("U (95 %)", lambda one: number(one).uncertainty)
        .number("Upper limit", lambda one: significant(shown(one, one.high)))
        .text("Unit", lambda one: pretty_unit(shown_unit(one.key, one.coefficient.unit)[1]) or "1")
        .text("Verdict", lambda one: one.words)
        .table()
    )
