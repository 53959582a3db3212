"""Read a Digital Calibration Certificate (DCC 3.x) made by piga back into a calibration.

The file comes from outside, so it is read with limits. Everything that it states twice must agree: values, units, U,
k, limits, covariance, serial, nominal scale factor, ranges, dates, conformity and the attached record. The signature
is checked separately (:mod:`piga.certificate.dcc.xml_signature`).
"""

from __future__ import annotations

import base64
import binascii
import datetime as dt
import itertools
import warnings
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote

import numpy as np

from piga.certificate.certificate_file import (
    WORST,
    first_day_of_issue,
    overall,
    range_sentence,
    title_of,
    validity_ranges,
)
from piga.certificate.dcc.layout import (
    AGAIN,
    BEFORE,
    DCC,
    JOINT,
    MEASURED,
    NAMES,
    RECORD,
    check_layout,
    content,
    contradiction,
    dsi_unit,
    from_dsi,
    number,
    only_element,
    power_of_g,
    quantities,
    significant_digit,
    to_dsi,
)
from piga.certificate.dcc.xml_signature import read_xml
from piga.errors import DataError, PigaWarning
from piga.records.calibration import Calibration, Coefficient
from piga.records.calibration.coefficient import PROBABILITY, coverage_factor, joint_factor
from piga.records.calibration.document import calibration_from_bytes
from piga.records.terms import check_name, unit_of

if TYPE_CHECKING:
    from lxml import etree

MOST_COEFFICIENTS = 4096
_DIGITS = Decimal("1e-6")
_SLACK = 1e-6
"""Tolerance relative to U. Coverage factors are stated with six decimals, and libraries differ in the last digits."""


def read_dcc(path: str | Path) -> Calibration:
    """Read a certificate in XML back into a calibration.

    Raises
    ------
    DataError
        If the file is not a DCC, was not made by piga, is damaged, or contradicts itself.
    """
    path = Path(path)
    return calibration_of(read_xml(path)[1], path)


def calibration_of(root: etree._Element, path: Path) -> Calibration:
    """The calibration in a certificate. Messages name ``path``. Errors as in :func:`read_dcc`."""
    if root.tag != f"{{{DCC}}}digitalCalibrationCertificate":
        raise DataError(f"{path}: is not a Digital Calibration Certificate", remedy="name a certificate in XML")
    version = root.get("schemaVersion", "")
    if not version.startswith("3."):
        raise DataError(f"{path}: DCC version '{version[:20]}' is not known", remedy="update piga")
    record = _attached(root, path)
    coefficients, covariance = _joint(root, path)
    _compare(path, record, coefficients, covariance)
    check_layout(path, root)
    _compare_results(path, root, record)
    _compare_administration(path, root, record)
    return record


def date_of_issue(root: etree._Element, path: Path) -> dt.date:
    """The date of issue of a certificate. Messages name ``path``.

    Raises
    ------
    DataError
        If it states no date of issue, or several.
    """
    return _date(root, "issueDate", path)


def _date(root: etree._Element, name: str, path: Path) -> dt.date:
    element = only_element(root, f"dcc:administrativeData/dcc:coreData/dcc:{name}", path, name)
    try:
        return dt.date.fromisoformat(element.text or "")
    except ValueError:
        raise DataError(f"{path}: {name} '{(element.text or '')[:40]}' is not a date", remedy=AGAIN) from None


def _attached(root: etree._Element, path: Path) -> Calibration:
    data = only_element(root, f".//dcc:byteData[@refType='{RECORD}']", path, "calibration record")
    text = data.findtext("dcc:dataBase64", "", NAMES)
    try:
        raw = base64.b64decode("".join(text.split()), validate=True)
    except (binascii.Error, ValueError):
        raise DataError(f"{path}: the attached record is damaged", remedy="get the file again") from None
    return calibration_from_bytes(raw, path)


def _joint(root: etree._Element, path: Path) -> tuple[tuple[Coefficient, ...], np.ndarray]:
    """Coefficients and covariance in file units, from the quantity in SI."""
    base = only_element(root, f".//dcc:quantity[@refType='{JOINT}']/si:realListXMLList", path, "joint result")
    keys = [unquote(label) for label in base.findtext("si:labelXMLList", "", NAMES).split()]
    if not 0 < len(keys) <= MOST_COEFFICIENTS or len(set(keys)) != len(keys):
        raise DataError(
            f"{path}: {len(keys)} coefficients: some may be there twice", remedy="get the file again"
        )
    parts = [key.removesuffix("]").split("[", 1) if key.endswith("]") else [key] for key in keys]
    for name, *_ in parts:
        if not check_name(name):
            raise DataError(f"{path}: unknown coefficient '{name[:40]}'", remedy="update piga")
    units = [unit_of(name) for name, *_ in parts]
    values = _numbers(base, "si:valueXMLList", "si:unitXMLList", [(unit,) for unit in units], path)
    spread = base.findtext(
        "si:measurementUncertaintyUnivariateXMLList/si:standardMUXMLList/si:valueStandardMUXMLList", "", NAMES
    )
    stds = _converted(spread.split(), [(unit,) for unit in units], path)
    columns = base.findall(".//si:columnXMLList", NAMES)
    if len(columns) != len(keys):
        raise DataError(
            f"{path}: {len(columns)} columns of covariance for {len(keys)} coefficients", remedy=AGAIN
        )
    matrix = [
        _numbers(
            column,
            "si:covarianceXMLList/si:valueXMLList",
            "si:covarianceXMLList/si:unitXMLList",
            [(row, unit) for row in units],
            path,
        )
        for column, unit in zip(columns, units, strict=True)
    ]
    coefficients = tuple(
        Coefficient(part[0], value, std, unit, part[1] if len(part) > 1 else None)
        for part, value, std, unit in zip(parts, values, stds, units, strict=True)
    )
    return coefficients, np.array(matrix).T.copy()


def _numbers(
    element: etree._Element, values: str, units: str, expected: list[tuple[str, ...]], path: Path
) -> list[float]:
    """Numbers of a list. Its units must be the expected products."""
    given = element.findtext(units, "", NAMES).split()
    wanted = [dsi_unit(*product) for product in expected]
    if given != wanted:
        raise DataError(
            f"{path}: units {' '.join(given)[:80]} where {' '.join(wanted)[:80]} are needed", remedy=AGAIN
        )
    return _converted(element.findtext(values, "", NAMES).split(), expected, path)


def _converted(texts: list[str], units: list[tuple[str, ...]], path: Path) -> list[float]:
    if len(texts) != len(units):
        raise DataError(
            f"{path}: {len(texts)} numbers where {len(units)} are needed", remedy="get the file again"
        )
    try:
        return [
            from_dsi(text, sum(power_of_g(unit) for unit in product))
            for text, product in zip(texts, units, strict=True)
        ]
    except DataError as error:
        raise DataError(f"{path}: {error.message}", remedy="get the file again") from None


def _compare(
    path: Path, record: Calibration, coefficients: tuple[Coefficient, ...], covariance: np.ndarray
) -> None:
    """Check that the certificate agrees with the attached record."""
    if [c.key for c in record.coefficients] != [c.key for c in coefficients]:
        raise DataError(f"{path}: the attached record holds other coefficients", remedy="do not use the file")
    for stated, kept in zip(coefficients, record.coefficients, strict=True):
        if (stated.value, stated.std) != (kept.value, kept.std):
            raise contradiction(
                path,
                f"{stated.key} is stated as {stated.value!r} (u {stated.std!r}), the attached record has {kept.value!r} "
                f"(u {kept.std!r})",
            )
    if not np.array_equal(covariance, record.covariance):
        raise DataError(
            f"{path}: contradicts itself: the covariance differs from the attached record's", remedy=AGAIN
        )


def _compare_results(path: Path, root: etree._Element, record: Calibration) -> None:
    """Check that the single coefficients and the joint region agree with the record.

    Certificates of piga 0.1 used one coverage factor for all coefficients, from the number of rows. They are
    read with a warning.
    """
    measured = quantities(root, MEASURED)
    labels = [quantity.findtext("si:real/si:label", "", NAMES) for quantity in measured]
    keys = [c.key for c in record.coefficients]
    if labels != keys:
        odd = next((a for a, b in itertools.zip_longest(labels, keys) if a != b), None)
        raise contradiction(path, f"the coefficients stated one by one are not the record's: '{str(odd)[:60]}'")
    by_rows = coverage_factor(record.surplus_observations)
    outdated = []
    for quantity, c in zip(measured, record.coefficients, strict=True):
        real = only_element(quantity, "si:real", path, "values")
        value = number(real.findtext("si:value", "", NAMES), power_of_g(c.unit), path, c.key)
        if value != c.value:
            raise contradiction(
                path, f"{c.key} is stated as {value!r} {c.unit}, the attached record has {c.value!r}"
            )
        _check_form(path, quantity, c)
        if not _agrees(path, real, c, c.coverage.factor, c.limits):
            half = by_rows * c.std
            if c.coverage.monte_carlo or not _agrees(path, real, c, by_rows, (c.value - half, c.value + half)):
                low, high = _limits(real, c, path)
                raise contradiction(
                    path,
                    f"{c.key} is stated with 95 % limits {low:.9g} and {high:.9g}, k "
                    f"{real.findtext('.//si:coverageFactor', 'none', NAMES)[:20]}; the attached record has "
                    f"{c.limits[0]:.9g} and {c.limits[1]:.9g}, k {c.coverage.factor:.6f}",
                )
            outdated.append(f"{c.key} {half:.2g} for {c.expanded:.2g} {c.unit}")
    _check_joint(path, root, record, outdated=bool(outdated))
    _check_before(path, root)
    if outdated:
        warnings.warn(
            f"{path}: made by an earlier piga, which took k = {by_rows:.3f} from the number of rows; the expanded "
            f"uncertainties stated and those by the effective degrees of freedom: {', '.join(outdated)}. "
            "The record that is read back holds the latter",
            PigaWarning,
            stacklevel=3,
        )


def _check_form(path: Path, quantity: etree._Element, c: Coefficient) -> None:
    """Check name, unit, probability, distribution and significant digit of a single coefficient."""
    name, unit = content(quantity, "dcc:name"), quantity.findtext("si:real/si:unit", "", NAMES)
    if name != " ".join(title_of(c).split()):
        raise contradiction(path, f"{c.key} is called '{name[:60]}', but is '{title_of(c)}'")
    if unit != dsi_unit(c.unit):
        raise contradiction(path, f"{c.key} is stated in {unit[:60]}, but has the unit {dsi_unit(c.unit)}")
    probability = quantity.findtext(".//si:coverageProbability", "", NAMES)
    if number(probability, 0, path, c.key) != PROBABILITY:
        raise contradiction(
            path, f"{c.key} is stated for a probability of {probability[:20]}, not {PROBABILITY}"
        )
    distribution = quantity.findtext(".//si:distribution", "t", NAMES)
    if distribution != "t":
        raise contradiction(path, f"{c.key} is stated with a distribution '{distribution[:20]}', not 't'")
    low, high = (to_dsi(part, power_of_g(c.unit)) for part in _limits(quantity, c, path))
    half = (
        Decimal(quantity.findtext(".//si:valueExpandedMU", "", NAMES) or 0)
        or (Decimal(high) - Decimal(low)) / 2
    )
    digit = quantity.findtext("si:real/si:significantDigit", "", NAMES)
    value = Decimal(to_dsi(c.value, power_of_g(c.unit)))
    near = {str(significant_digit(half * part, value)) for part in (1 - _DIGITS, 1, 1 + _DIGITS)}
    if digit not in near:
        raise contradiction(path, f"{c.key} has the significant digit {digit[:20]}, its uncertainty {half:.3g}")


def _agrees(
    path: Path, real: etree._Element, c: Coefficient, factor: float, limits: tuple[float, float]
) -> bool:
    """True if the stated U, k, standard uncertainty and limits equal these, to the stated decimals."""
    slack = _SLACK * 0.5 * (limits[1] - limits[0])
    if any(abs(a - b) > slack for a, b in zip(_limits(real, c, path), limits, strict=True)):
        return False
    stated = real.findtext(".//si:coverageFactor", None, NAMES)
    spread = real.findtext(".//si:valueStandardMU", None, NAMES)
    if (stated is None) != c.coverage.monte_carlo:
        return False
    if spread is not None and number(spread, power_of_g(c.unit), path, c.key) != c.std:
        return False
    return stated is None or abs(number(stated, 0, path, c.key) - factor) <= _SLACK * max(1.0, factor)


def _check_joint(path: Path, root: etree._Element, record: Calibration, *, outdated: bool) -> None:
    """Check factor and probability of the joint region."""
    region = only_element(
        root, f".//dcc:quantity[@refType='{JOINT}']//si:ellipsoidalRegionMUXMLList", path, "regions"
    )
    stated = number(region.findtext("si:coverageFactorXMLList", "", NAMES), 0, path, "joint result")
    used = record.coefficients
    if outdated:
        used = tuple(replace(c, degrees_of_freedom=record.surplus_observations) for c in used)
    if not abs(stated - joint_factor(used)) <= _SLACK * max(1.0, stated):
        raise contradiction(
            path, f"the joint result has k {stated:.6f}, by the attached record {joint_factor(used):.6f}"
        )
    probability = region.findtext("si:coverageProbabilityXMLList", "", NAMES)
    if number(probability, 0, path, "joint result") != PROBABILITY:
        raise contradiction(path, f"the joint result is for {probability[:20]}, not {PROBABILITY}")


def _check_before(path: Path, root: etree._Element) -> None:
    """Check that each coefficient before adjustment is consistent. No record of these is attached."""
    labels = set()
    for quantity in quantities(root, BEFORE):
        label = quantity.findtext("si:real/si:label", "", NAMES)
        name, _, owner = label.removesuffix("]").partition("[")
        if not check_name(name) or label in labels:
            raise contradiction(path, f"before adjustment '{label[:60]}' is unknown or stated twice")
        labels.add(label)
        power = power_of_g(unit_of(name))
        value = number(quantity.findtext("si:real/si:value", "", NAMES), power, path, label)
        c = Coefficient(name, value, 0.0, unit_of(name), owner or None)
        if c.segment is not None and content(quantity, "dcc:name") != " ".join(title_of(c).split()):
            c = replace(c, segment=owner.partition(":")[2] or None, run=owner.partition(":")[0])
        _check_form(path, quantity, c)
        low, high = _limits(quantity, c, path)
        if not low < value < high and quantity.find(".//si:valueExpandedMU", NAMES) is not None:
            raise contradiction(path, f"before adjustment {label} has no positive uncertainty")


def _limits(real: etree._Element, c: Coefficient, path: Path) -> tuple[float, float]:
    """Stated 95 % limits of a coefficient, in its file unit."""
    power = power_of_g(c.unit)
    names = ("si:intervalMin", "si:intervalMax", "si:valueExpandedMU")
    texts = [real.findtext(f".//{name}", None, NAMES) for name in names]
    low, high, half = (None if text is None else number(text, power, path, c.key) for text in texts)
    if low is not None and high is not None:
        return low, high
    if half is None:
        raise DataError(f"{path}: {c.key} is stated without an uncertainty", remedy="get the file again")
    return c.value - half, c.value + half


def _compare_administration(path: Path, root: etree._Element, record: Calibration) -> None:
    """Compare serial, nominal scale factor, dates, ranges and declarations with the record and each other."""
    serial = " ".join(record.serial.split())
    item = only_element(root, "dcc:administrativeData/dcc:items/dcc:item", path, "items")
    stated = [
        " ".join(node.findtext("dcc:value", "", NAMES).split())
        for node in item.iterfind("dcc:identifications/dcc:identification", NAMES)
        if content(node, "dcc:name") == "Serial number"
    ]
    title = content(root.find("dcc:measurementResults/dcc:measurementResult", NAMES), "dcc:name")
    for place, words in (
        ("item's serial", stated),
        ("heading of the results", [title.removeprefix("Calibration of ")]),
    ):
        if words != [serial]:
            raise contradiction(
                path, f"the {place} is '{', '.join(words)[:60]}', the attached record is of '{serial[:60]}'"
            )
    nominal = only_element(item, "dcc:itemQuantities/dcc:itemQuantity/si:real", path, "nominal scale factors")
    value = number(nominal.findtext("si:value", "", NAMES), 0, path, "nominal scale factor")
    unit = nominal.findtext("si:unit", "", NAMES)
    if abs(value - record.scale_factor_nominal) > 1e-12 * abs(value) or unit != dsi_unit("rad/s/g"):
        raise contradiction(
            path,
            f"the nominal scale factor is {value!r} {unit[:60]}, the attached record has {record.scale_factor_nominal!r}",
        )
    releases = {node.findtext("dcc:release", "", NAMES) for node in root.iter(f"{{{DCC}}}software")}
    if len(releases) > 1:
        raise contradiction(path, f"made by releases {' and '.join(sorted(releases))[:60]} of piga")
    for condition in root.iter(f"{{{DCC}}}influenceCondition"):
        names = [content(condition, "dcc:name"), content(condition, "dcc:data/dcc:quantity/dcc:name")]
        if names[0] != names[1]:
            raise contradiction(path, f"the condition '{names[0][:60]}' holds '{names[1][:60]}'")
    _compare_dates(path, root, record)
    _compare_declarations(path, root, record)


def _compare_dates(path: Path, root: etree._Element, record: Calibration) -> None:
    """Check the order of receipt, begin, end and issue. The evaluation (in UTC) must be before the issue."""
    names = ("receiptDate", "beginPerformanceDate", "endPerformanceDate", "issueDate")
    dates = [_date(root, name, path) for name in names]
    for (first, earlier), (second, later) in itertools.pairwise(zip(names, dates, strict=True)):
        if later < earlier:
            raise contradiction(path, f"{second} {later} is before {first} {earlier}")
    try:
        evaluated = first_day_of_issue(record)
    except (ValueError, OverflowError):
        raise DataError(f"{path}: the attached record has no date of its evaluation", remedy=AGAIN) from None
    if dates[-1] < evaluated:
        raise contradiction(
            path,
            f"issued {dates[-1]}, before the attached record was evaluated, {record.provenance.created[:10]}",
        )


def _compare_declarations(path: Path, root: etree._Element, record: Calibration) -> None:
    """Compare the declarations with the record, the results and the other parts of the file."""
    declared: dict[str, etree._Element] = {}
    for node in root.iterfind("dcc:administrativeData/dcc:statements/dcc:statement", NAMES):
        if declared.setdefault(content(node, "dcc:name"), node) is not node:
            raise contradiction(path, f"the statement '{content(node, 'dcc:name')[:60]}' is there twice")
    _compare_ranges(path, declared.get("Range"), record)
    _compare_conformity(path, declared.get("Conformity"), quantities(root, MEASURED))
    adjusted = content(declared.get("Adjustment"), "dcc:declaration").startswith("The item was adjusted")
    if adjusted != bool(quantities(root, BEFORE)):
        raise contradiction(path, "the statement on adjustment does not fit the results before adjustment")
    words = "Additions, deviations and exclusions"
    deviations = content(declared.get("Method"), "dcc:declaration").removeprefix(f"{words} from the method: ")
    method = next(iter(root.iter(f"{{{DCC}}}usedMethod")), None)
    if not content(method, "dcc:description").endswith(f"{words}: {deviations}"):
        raise contradiction(path, "the deviations from the method are stated in two ways")
    replaced = root.findtext(".//dcc:replacedUniqueIdentifier", "", NAMES)
    amendment = content(declared.get("Amendment"), "dcc:declaration")
    if not amendment.startswith(f"This certificate replaces certificate {replaced}." if replaced else "") or (
        amendment and not replaced
    ):
        raise contradiction(path, f"it replaces '{replaced[:60]}', and states '{amendment[:80]}'")


def _compare_ranges(path: Path, node: etree._Element | None, record: Calibration) -> None:
    """Check that the ranges of validity, in words and in numbers, are those of the record."""
    try:
        ranges = validity_ranges(record)
    except (AttributeError, TypeError, ValueError, IndexError, KeyError):
        raise DataError(f"{path}: the range in the attached record is damaged", remedy=AGAIN) from None
    if (content(node, "dcc:declaration") or "") != (" ".join(range_sentence(ranges).split()) if ranges else ""):
        raise contradiction(path, "the range in which the results hold is not the attached record's")
    stated = [] if node is None else list(node.iterfind("dcc:data/dcc:quantity", NAMES))
    ends = [
        (f"{name}, {end}", value, unit)
        for name, low, high, unit in ranges
        for end, value in (("lower end", low), ("upper end", high))
    ]
    given = [
        (
            content(quantity, "dcc:name"),
            number(quantity.findtext("si:real/si:value", "", NAMES), 0, path, "range"),
            quantity.findtext("si:real/si:unit", "", NAMES),
        )
        for quantity in stated
    ]
    if given != [(name, value, dsi_unit(unit)) for name, value, unit in ends]:
        raise contradiction(path, "the range in which the results hold is not the attached record's")


def _compare_conformity(path: Path, node: etree._Element | None, quantities: list[etree._Element]) -> None:
    """Check that the verdict on the item is the worst verdict on its coefficients and names them."""
    marks: dict[str, str] = {}
    for quantity in quantities:
        mark = quantity.findtext("dcc:measurementMetaData/dcc:metaData/dcc:conformity", None, NAMES)
        if mark is not None:
            marks[quantity.findtext("si:real/si:label", "", NAMES)] = mark
    if node is None and not marks:
        return
    stated = "" if node is None else node.findtext("dcc:conformity", "", NAMES)
    known = [status for status in WORST if status in marks.values()]
    words = content(node, "dcc:declaration")
    listed = words.rpartition("Applies to: ")[2].rpartition(". Overall: ")[0]
    names = sorted(" ".join(key.split()) for key in marks)
    if (
        not set(marks.values()) <= set(WORST)
        or not known
        or stated != known[-1]
        or not words.endswith(f" Overall: {overall(known[-1])}.")
        or len(listed) != len(", ".join(names))
        or any(name not in listed for name in names)
    ):
        raise contradiction(
            path,
            f"the item's conformity '{stated[:40]}' is not what its coefficients have: {sorted(marks.values())}",
        )
