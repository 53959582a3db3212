"""The administrative part of a certificate (TOML), and the check for items missing by ISO/IEC 17025:2017.

The reader accepts a file without any key. :func:`missing_items` then lists all missing items at once, with the
clauses that demand them.
"""

from __future__ import annotations

import datetime as dt
import itertools
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec

from piga.errors import UnitError
from piga.keys import words_of
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.coefficient import Coefficient
from piga.records.run_file import TomlTable
from piga.records.terms import SERVO_TERMS, term_words
from piga.text_files import read_toml
from piga.units import to_si, written_quantity

Status = Literal["pass", "fail", "conditionalPass", "conditionalFail"]
WORST: tuple[Status, ...] = ("pass", "conditionalPass", "conditionalFail", "fail")
"""Conformity verdicts; the worst is last."""
_RANGES = {
    "a_x": ("axial specific force", "m/s^2"),
    "a_t": ("transverse specific force", "m/s^2"),
    "temperature": ("temperature of the instrument", "K"),
}
"""Name and SI unit of the ranges in which the results are valid."""


class CertificateTable(TomlTable, frozen=True):
    """``[certificate]``: its unique number, date of issue, and what it replaces.

    If ``issued`` is missing, ``piga certificate`` sets today's date. In Python it must be set. With more masked rows than
    ``largest_masked_share`` no certificate is issued.
    """

    number: str = ""
    issued: dt.date | None = None
    title: str = "Calibration certificate"
    replaces: str = ""
    amendment: str = ""
    largest_masked_share: float = 0.05


class PartyTable(TomlTable, frozen=True):
    """``[laboratory]`` and ``[customer]``: name and address; ``country`` is a two-letter ISO 3166-1 code."""

    name: str = ""
    street: str = ""
    post_code: str = ""
    city: str = ""
    country: str = ""
    email: str = ""
    phone: str = ""
    accreditation: str = ""

    @property
    def address(self) -> str:
        """The address in one line."""
        return ", ".join(
            part for part in (self.street, f"{self.post_code} {self.city}".strip(), self.country) if part
        )


class ItemTable(TomlTable, frozen=True):
    """``[item]``: the calibrated item, and its condition at receipt."""

    description: str = ""
    manufacturer: str = ""
    model: str = ""
    serial: str = ""
    customer_id: str = ""
    condition: str = ""
    received: dt.date | None = None


class CalibrationTable(TomlTable, frozen=True):
    """``[calibration]``: dates, place and order of the calibration."""

    begin: dt.date | None = None
    end: dt.date | None = None
    place: Literal["laboratory", "customer", "laboratoryBranch", "customerBranch", "other"] | None = None
    place_detail: str = ""
    order: str = ""


class MethodTable(TomlTable, frozen=True):
    """``[method]``: procedure, deviations from it, sampling, and results from external providers."""

    name: str = ""
    documents: tuple[str, ...] = ()
    description: str = ""
    deviations: str = ""
    sampling: str = "not applicable"
    external_results: str = ""


class ConditionTable(TomlTable, frozen=True):
    """``[[environment]]``: a condition that influences the results, with its value and expanded uncertainty."""

    name: str
    value: str
    uncertainty: str = ""


class StandardTable(TomlTable, frozen=True):
    """``[[traceability.standard]]``: a standard used, with its identification and certificate."""

    name: str
    identification: str = ""
    certificate: str = ""
    realises: str = ""


class TraceabilityTable(TomlTable, frozen=True):
    """``[traceability]``: the statement of traceability, and its standards."""

    statement: str = ""
    standard: tuple[StandardTable, ...] = ()


class PersonTable(TomlTable, frozen=True):
    """A person with a role."""

    name: str = ""
    role: str = ""


class PeopleTable(TomlTable, frozen=True):
    """``[people]``: the person who authorises the certificate, and those who did the work."""

    authorised: PersonTable = PersonTable()
    performed: PersonTable = PersonTable()


class AdjustmentTable(TomlTable, frozen=True):
    """``[adjustment]``: whether the item was adjusted or repaired and, if so, its results before."""

    performed: bool | None = None
    before: str = ""
    description: str = ""


class ConformityTable(TomlTable, frozen=True):
    """``[conformity]``: specification, decision rule, and lower and upper limits of coefficients, with units."""

    specification: str = ""
    rule: Literal["simple", "guarded"] | None = None
    agreed_with_customer: bool = False
    limits: dict[str, tuple[str, str]] = msgspec.field(default_factory=dict)


class StatementsTable(TomlTable, frozen=True):
    """``[statements]``: opinions with their author; a recalibration interval only if the customer agreed to it."""

    opinions: str = ""
    opinions_by: str = ""
    recalibrate: dt.date | None = None
    interval_agreed: bool = False
    remarks: str = ""


class CertificateFile(TomlTable, frozen=True):
    """A whole certificate file."""

    certificate: CertificateTable = CertificateTable()
    laboratory: PartyTable = PartyTable()
    customer: PartyTable = PartyTable()
    item: ItemTable = ItemTable()
    calibration: CalibrationTable = CalibrationTable()
    method: MethodTable = MethodTable()
    environment: tuple[ConditionTable, ...] = ()
    traceability: TraceabilityTable = TraceabilityTable()
    people: PeopleTable = PeopleTable()
    adjustment: AdjustmentTable = AdjustmentTable()
    conformity: ConformityTable | None = None
    statements: StatementsTable = StatementsTable()


def read_certificate_file(path: str | Path, *, content: str | None = None) -> CertificateFile:
    """Read a certificate's administrative data.

    ``content`` is the text of the file, for one that is not on disk. ``path`` is then its name in messages, and where the files
    that it names are looked for.

    Raises
    ------
    RunFileError
        If the file is not TOML, has an unknown key or a value of the wrong type.
    """
    return read_toml(Path(path), CertificateFile, None if content is None else content.encode())


_NEEDED = (
    ("7.8.2.1 b", "laboratory", ("name", "street", "city", "country")),
    ("7.8.2.1 c", "calibration", ("place",)),
    ("7.8.2.1 d", "certificate", ("number",)),
    ("7.8.2.1 e", "customer", ("name", "city", "country")),
    ("7.8.2.1 f", "method", ("name", "documents")),
    ("7.8.2.1 g", "item", ("description", "manufacturer", "model", "serial", "condition")),
    ("7.8.2.1 h", "item", ("received",)),
    ("7.8.2.1 i", "calibration", ("begin", "end")),
    ("7.8.2.1 j", "certificate", ("issued",)),
    ("7.8.2.1 k", "method", ("sampling",)),
    ("7.8.2.1 n", "method", ("deviations",)),
    ("7.8.2.1 p", "method", ("external_results",)),
    ("7.8.4.1 c", "traceability", ("statement", "standard")),
    ("7.8.4.1 d", "adjustment", ("performed",)),
)
"""Clauses of ISO/IEC 17025:2017, and the keys of a table that they demand."""


def missing_items(
    data: CertificateFile, calibration: Calibration, before: Calibration | None = None
) -> list[str]:
    """List everything that prevents a certificate, one sentence each. Empty if it can be issued.

    Parameters
    ----------
    data:
        The administrative part.
    calibration:
        The calibration to certify.
    before:
        The calibration before adjustment, if there is one.
    """
    missing = [
        f"[{table}] {key} ({clause}): {words_of(type(getattr(data, table)), key).sentence}"
        for clause, table, keys in _NEEDED
        for key in keys
        if getattr(getattr(data, table), key) in ("", None, ())
    ]
    missing += [*_entries(data), *_order_of_dates(data, calibration), *_adjustment(data, calibration, before)]
    return [
        *missing,
        *_numbers(data, calibration),
        *_gravity(data, calibration),
        *_conformity(data, calibration),
    ]


def _entries(data: CertificateFile) -> Iterator[str]:
    """What is missing or wrong in the data alone."""
    if not (data.people.authorised.name and data.people.authorised.role):
        yield "[people.authorised] name and role (7.8.2.1 o): who authorises the certificate"
    for table in ("laboratory", "customer"):
        country = getattr(data, table).country
        if country and not re.fullmatch("[A-Z]{2}", country):
            yield f"[{table}] country (7.8.2.1): '{country}' is not a two-letter ISO 3166-1 code"
    if data.certificate.replaces and not data.certificate.amendment:
        yield "[certificate] amendment (7.8.8.1): what was changed against the certificate that is replaced, and why"
    if data.statements.opinions and not data.statements.opinions_by:
        yield "[statements] opinions_by (7.8.7.1): the person who is authorised to give opinions"
    if data.statements.recalibrate and not data.statements.interval_agreed:
        yield "[statements] interval_agreed (7.8.4.3): an interval may stand only where the customer agreed to it"
    if not data.environment:
        yield "[[environment]] (7.8.4.1 b): the conditions that influence the results, e.g. the temperature"
    for condition in data.environment:
        try:
            quantity_text(condition.value)
            quantity_text(condition.uncertainty or condition.value)
        except UnitError as error:
            yield f"[[environment]] {condition.name} (7.8.4.1 b): {error.message}"


def _gravity(data: CertificateFile, calibration: Calibration) -> Iterator[str]:
    """The local gravity of the environment against that of the reference, measured by what the difference does to K."""
    K = next((c for c in calibration.coefficients if c.name == "scale_factor"), None)
    number = calibration.gravity.partition(" m/s^2")[0]
    for condition in data.environment:
        if K is None or not number or "gravity" not in condition.name.lower():
            continue
        try:
            stated, used = to_si(condition.value, "m/s^2", what=condition.name), float(number)
        except UnitError:
            continue
        change, u = 1e6 * abs(used / stated - 1.0), 1e6 * K.std / abs(K.value)
        if change > u:
            yield (
                f"[[environment]] {condition.name} (7.8.4.1 b): {condition.value}, but the reference contains "
                f"{calibration.gravity}: K differs by {change:.3g} ppm, its standard uncertainty is {u:.3g} ppm"
            )


def quantity_text(text: str) -> tuple[float, str]:
    """Number and unit of a quantity such as ``"20.1 degC"`` or ``"45 %"``, as written."""
    number, unit = written_quantity(text)
    to_si(f"{number} {unit or '1'}", unit or "1", what=text)
    return float(number), unit or "1"


def _order_of_dates(data: CertificateFile, calibration: Calibration) -> Iterator[str]:
    issued = data.certificate.issued
    steps = {
        "[item] received": data.item.received,
        "[calibration] begin": data.calibration.begin,
        "[calibration] end": data.calibration.end,
        "[certificate] issued": issued,
    }
    given = ((name, date) for name, date in steps.items() if date is not None)
    for (first, earlier), (second, later) in itertools.pairwise(given):
        if later < earlier:
            yield f"{second} (7.8.2.1): {later} is before {first}, {earlier}"
    created = calibration.provenance.created
    # the record has the evaluation in UTC; local time is at most 12 h behind
    if issued is not None and issued < (dt.datetime.fromisoformat(created) - dt.timedelta(hours=12)).date():
        yield f"[certificate] issued (7.8.2.1 j): {issued} is before the evaluation, {created[:10]}"


def _adjustment(data: CertificateFile, calibration: Calibration, before: Calibration | None) -> Iterator[str]:
    if data.adjustment.performed and before is None:
        yield "[adjustment] before (7.8.4.1 d): the calibration.json of the results before adjustment"
    if before is not None and before.serial != calibration.serial:
        yield f"[adjustment] before (7.8.4.1 d): is of instrument '{before.serial}', not '{calibration.serial}'"
    if before is not None and data.adjustment.performed is False:
        yield "[adjustment] performed (7.8.4.1 d): results before adjustment are given, but no adjustment"


def _numbers(data: CertificateFile, calibration: Calibration) -> Iterator[str]:
    """Items that the calibration itself must have."""
    lost = calibration.quality.lost
    if lost > data.certificate.largest_masked_share:
        yield (
            f"calibration (7.7): {100.0 * lost:.3g} % of the rows are masked, more than [certificate] "
            f"largest_masked_share of {100.0 * data.certificate.largest_masked_share:.3g} %"
        )
    if data.item.serial and data.item.serial != calibration.serial:
        yield f"[item] serial (7.8.2.1 g): '{data.item.serial}', but the calibration is of '{calibration.serial}'"
    for c in calibration.coefficients:
        if not c.degrees_of_freedom >= 1.0:
            yield f"calibration (7.8.4.1 a): too few degrees of freedom for an expanded uncertainty of {c.key}"
        exact = c.std == 0.0 and c.name in SERVO_TERMS  # given by [instrument] servo without an uncertainty
        if not exact and not (c.std > 0.0 and math.isfinite(c.std)):
            yield f"calibration (7.8.4.1 a): {c.key} has no uncertainty"
    if calibration.given:
        yield "calibration (7.8.4.1 a): the coefficients were given, not estimated; calibrate a record"
        return
    if unstated := calibration.verdict.unstated:
        yield (
            f"calibration (7.8.4.1 a, 7.6): {', '.join(unstated)}: neither stated in [uncertainty] of the run file nor "
            "waived there with a reason"
        )
    elif calibration.type_a_only:
        yield "calibration (7.8.4.1 a, 7.6): no source of Type B in the budget; state [uncertainty] in the run file"


def _conformity(data: CertificateFile, calibration: Calibration) -> Iterator[str]:
    rule = data.conformity
    if rule is None:
        return
    if not rule.specification:
        yield "[conformity] specification (7.8.6.2 b): which specification is met or not"
    if rule.rule is None:
        yield '[conformity] rule (7.8.6.2 c): "simple" or "guarded"'
    if not rule.agreed_with_customer:
        yield "[conformity] agreed_with_customer (7.8.6.1): the decision rule must be agreed with the customer"
    if not rule.limits:
        yield "[conformity.limits] (7.8.6.2 a): the limits of at least one coefficient"
    for key, pair in rule.limits.items():
        try:
            low, high = limits_in_file_units(calibration[key].unit, pair)
            wrong = "" if low < high else "the lower limit is not below the upper one"
        except KeyError:
            wrong = "the calibration has no such coefficient"
        except UnitError as error:
            wrong = error.message
        if wrong:
            yield f"[conformity.limits] {key} (7.8.6.2 a): {wrong}"


def limits_in_file_units(unit: str, pair: tuple[str, str]) -> tuple[float, float]:
    """Lower and upper limit of a coefficient in its unit in ``calibration.json``."""
    one = to_si(f"1 {unit}", unit)
    low, high = (to_si(text, unit, what=f"limit '{text}'") / one for text in pair)
    return low, high


def title_of(c: Coefficient) -> str:
    """Heading of a coefficient's result."""
    words = term_words(c.name).meaning
    where = "" if c.segment is None else f", segment {c.segment}"
    return f"{words[:1].upper()}{words[1:]}{where}"


# -- statements ----------------------------------------------------------------------------------------

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


@dataclass(frozen=True)
class Conformity:
    """Conformity of one coefficient. Limits are in its file unit."""

    coefficient: Coefficient
    low: float
    high: float
    status: Status

    @property
    def key(self) -> str:
        """Key of the coefficient."""
        return self.coefficient.key

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
        conformities.append(Conformity(c, low, high, _status(c.value, least, most, low, high)))
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


def statement_facts(data: CertificateFile, calibration: Calibration) -> dict[str, Any]:
    """What the statements of a certificate say of its calibration: ranges (name, low, high, SI unit) and conformity."""
    stated, conformities = calibration.diagnostics.range, verdicts(data, calibration)
    ranges = [
        (name, float(stated[key][0]), float(stated[key][1]), unit)
        for key, (name, unit) in _RANGES.items()
        if key in stated
    ]
    words = (f"{name} {low:.4g} to {high:.4g} {unit}" for name, low, high, unit in ranges)
    worst: Status = max((verdict.status for verdict in conformities), key=WORST.index, default="pass")
    return {
        "ranges": ranges,
        "range_words": "; ".join(words).replace("^2", "²"),
        "verdicts": conformities,
        "rule": decision_rule(data),
        "worst": worst,
        "overall": _WORDS[worst] if worst in ("pass", "fail") else "cannot be decided for every result",
    }
