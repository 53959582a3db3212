r"""The XML of a certificate that piga writes: its elements, their order, and the units and numbers in them.

Units and numbers follow the Digital System of Units (D-SI 2.2.1). All units are SI. The unit ``g`` is exactly 9.80665 m/s^2,
a decimal fraction. Coefficients are converted with decimal arithmetic and written with 17 significant digits. Reading
them back gives the same float, bit for bit.
"""

from __future__ import annotations

import re
from collections import Counter
from decimal import Context, Decimal, InvalidOperation
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from piga.certificate.dcc.xml_signature import check_profile
from piga.errors import DataError
from piga.units import parse_unit

if TYPE_CHECKING:
    from lxml import etree

DCC = "https://ptb.de/dcc"
SI = "https://ptb.de/si"
JOINT = "piga_jointResult"
"""``refType`` of the quantity that holds all coefficients with their covariance."""
RECORD = "piga_calibrationRecord"
"""``refType`` of the attached calibration.json."""
AGAIN = "do not use the file; get it again from the issuer"
NAMES = {"dcc": DCC, "si": SI}
BEFORE = "basic_beforeAdjustment"
MEASURED = "basic_measuredValue"
"""``refType`` of the coefficients before adjustment, and of the certified ones."""
RESULTS = "dcc:measurementResults/dcc:measurementResult/dcc:results"
_MANY = ("dcc:result", "dcc:quantity", "dcc:statement", "dcc:usedMethod", "dcc:norm", "dcc:measuringEquipment",
         "dcc:influenceCondition", "dcc:identification", "dcc:respPerson", "si:columnXMLList")  # fmt: skip
"""Elements that may be repeated in one place."""
_ATTRIBUTES = {"refType", "lang", "schemaVersion", "{http://www.w3.org/2001/XMLSchema-instance}schemaLocation"}
_COEFFICIENT = f"{RESULTS}/dcc:result/dcc:data/dcc:list/dcc:quantity"
_JOINT = f"{RESULTS}/dcc:result/dcc:data/dcc:quantity"
_SHAPES = (
    (".", r"dcc:administrativeData dcc:measurementResults (Signature )?"),
    ("dcc:measurementResults", r"dcc:measurementResult "),
    (
        "dcc:measurementResults/dcc:measurementResult",
        r"dcc:name dcc:usedMethods dcc:usedSoftware dcc:measuringEquipments dcc:influenceConditions dcc:results ",
    ),
    (RESULTS, r"(dcc:result ){3,4}"),
    (f"{RESULTS}/dcc:result", r"dcc:name dcc:data "),
    (f"{RESULTS}/dcc:result/dcc:data", r"dcc:list |dcc:quantity |dcc:byteData "),
    (f"{RESULTS}/dcc:result/dcc:data/dcc:byteData", r"dcc:name dcc:fileName dcc:mimeType dcc:dataBase64 "),
    (f"{RESULTS}/dcc:result/dcc:data/dcc:list", r"(dcc:quantity )+"),
    (_COEFFICIENT, r"dcc:name si:real (dcc:measurementMetaData )?"),
    (
        f"{_COEFFICIENT}/si:real",
        r"si:label si:value si:unit si:significantDigit si:measurementUncertaintyUnivariate ",
    ),
    (f"{_COEFFICIENT}/si:real/si:measurementUncertaintyUnivariate", r"si:expandedMU |si:coverageIntervalMU "),
    (
        f"{_COEFFICIENT}/si:real/si:measurementUncertaintyUnivariate/si:expandedMU",
        r"si:valueExpandedMU si:coverageFactor si:coverageProbability si:distribution ",
    ),
    (
        f"{_COEFFICIENT}/si:real/si:measurementUncertaintyUnivariate/si:coverageIntervalMU",
        r"si:valueStandardMU si:intervalMin si:intervalMax si:coverageProbability ",
    ),
    (_JOINT, r"dcc:name si:realListXMLList "),
    (
        f"{_JOINT}/si:realListXMLList",
        r"si:labelXMLList si:valueXMLList si:unitXMLList (si:measurementUncertainty(Uni|Multi)variateXMLList ){2}",
    ),
    (
        f"{_JOINT}/si:realListXMLList/si:measurementUncertaintyUnivariateXMLList",
        r"si:standardMUXMLList ",
    ),
    (
        f"{_JOINT}/si:realListXMLList/si:measurementUncertaintyMultivariateXMLList",
        r"si:ellipsoidalRegionMUXMLList ",
    ),
    (
        f"{_JOINT}/si:realListXMLList/si:measurementUncertaintyMultivariateXMLList/si:ellipsoidalRegionMUXMLList",
        r"si:covarianceMatrixXMLList si:coverageFactorXMLList si:coverageProbabilityXMLList ",
    ),
    (".//si:standardMUXMLList", r"si:valueStandardMUXMLList "),
    (".//si:covarianceMatrixXMLList", r"(si:columnXMLList )+"),
    (".//si:columnXMLList", r"si:covarianceXMLList "),
    (".//si:covarianceXMLList", r"si:valueXMLList si:unitXMLList "),
    (".//dcc:data/dcc:quantity/si:real", r"si:value si:unit (si:measurementUncertaintyUnivariate )?"),
    (
        "dcc:administrativeData",
        r"dcc:dccSoftware dcc:coreData dcc:items dcc:calibrationLaboratory dcc:respPersons dcc:customer dcc:statements ",
    ),
    ("dcc:administrativeData/dcc:items", r"dcc:item "),
    (
        "dcc:administrativeData/dcc:items/dcc:item",
        r"dcc:name (dcc:description )?dcc:manufacturer (dcc:model )?dcc:identifications dcc:itemQuantities ",
    ),
    (".//dcc:identification", r"dcc:issuer (dcc:value )?(dcc:name )?"),
    (
        ".//dcc:statement",
        r"dcc:name (dcc:traceable )?dcc:norm (dcc:reference )?(dcc:declaration )?((dcc:date|dcc:conformity|dcc:data) )*",
    ),
    (".//dcc:measurementMetaData", r"dcc:metaData "),
    (".//dcc:metaData", r"dcc:declaration dcc:conformity "),
    (".//dcc:influenceCondition", r"dcc:name dcc:data "),
    (".//dcc:itemQuantity", r"dcc:name si:real "),
    (".//dcc:itemQuantity/si:real", r"si:value si:unit "),
)
"""Allowed children of elements, in order, by path."""
_SAFE = "[]_.,:;+-=()/*"


def label_of(key: str) -> str:
    """A coefficient's key without spaces (segment labels may contain spaces)."""
    return quote(key, safe=_SAFE)


def only_element(root: etree._Element, query: str, path: Path, what: str) -> etree._Element:
    """The one element at a place. ``what`` names it in the message.

    Raises
    ------
    DataError
        If there is none, or more than one.
    """
    elements = root.findall(query, NAMES)
    if len(elements) != 1:
        raise DataError(
            f"{path}: holds {len(elements) or 'no'} {what}: was it made by piga?",
            remedy="only certificates made by piga can be read back",
        )
    return elements[0]


def contradiction(path: Path, what: str) -> DataError:
    """The refusal of a certificate that states one thing in two ways."""
    return DataError(f"{path}: contradicts itself: {what}", remedy="do not use the file; ask the issuer")


def check_layout(path: Path, root: etree._Element) -> None:
    """Check the layout: no element in an unexpected place, where a reader may overlook it, and no repeated element."""
    check_profile(root, path)
    for node in (*root.itersiblings(preceding=True), *root.itersiblings(), *root.iter()):
        if not isinstance(node.tag, str):
            raise DataError(f"{path}: holds comments or instructions, which piga does not write", remedy=AGAIN)
    for node in root.iter(f"{{{DCC}}}*", f"{{{SI}}}*"):
        twice = [tag for tag, count in Counter(child.tag for child in node).items() if count > 1]
        if any(short_tag(tag) not in _MANY for tag in twice):
            raise contradiction(path, f"'{short_tag(node.tag)}' holds '{short_tag(twice[0])}' more than once")
    for node in root.iter(f"{{{DCC}}}*", f"{{{SI}}}*"):
        if (len(node) and (node.text or "").strip()) or (node is not root and (node.tail or "").strip()):
            raise DataError(f"{path}: text stands beside the parts of '{short_tag(node.tag)}'", remedy=AGAIN)
        if not set(map(str, node.attrib)) <= _ATTRIBUTES:
            raise DataError(
                f"{path}: '{short_tag(node.tag)}' has attributes that piga does not write", remedy=AGAIN
            )
    for query, pattern in _SHAPES:
        for node in root.iterfind(query, NAMES):
            held = "".join(f"{short_tag(child.tag)} " for child in node)
            if not re.fullmatch(pattern, held):
                raise DataError(
                    f"{path}: '{short_tag(node.tag)}' holds '{held[:80].strip()}': was it made by piga?",
                    remedy=AGAIN,
                )
    kinds = [node.get("refType") for node in root.iterfind(f"{RESULTS}/dcc:result", NAMES)]
    if kinds[-3:] != [MEASURED, None, None] or kinds[:-3] not in ([], [BEFORE]):
        raise DataError(
            f"{path}: holds results of other kinds or in another order than piga writes", remedy=AGAIN
        )


def short_tag(tag: object) -> str:
    """Name of an element with the usual prefix."""
    return str(tag).replace(f"{{{DCC}}}", "dcc:").replace(f"{{{SI}}}", "si:").rpartition("}")[2][:60]


def content(node: etree._Element | None, query: str) -> str:
    """Text below an element, with single spaces."""
    return "" if node is None else " ".join(node.findtext(f"{query}/dcc:content", "", NAMES).split())


def number(text: str, power: int, path: Path, what: str) -> float:
    """A number of the certificate in its file unit, which holds this power of ``g``. ``what`` names it in the message."""
    try:
        return from_dsi(text, power)
    except DataError as error:
        raise DataError(f"{path}: {what}: {error.message}", remedy=AGAIN) from None


def quantities(root: etree._Element, kind: str) -> list[etree._Element]:
    """The coefficients of the results of a kind: :data:`MEASURED` or :data:`BEFORE`."""
    query = f"{RESULTS}/dcc:result[@refType='{kind}']/dcc:data/dcc:list/dcc:quantity"
    return list(root.iterfind(query, NAMES))


# --- units and numbers ----------------------------------------------------------------------------

G = Decimal("9.80665")
"""Standard gravity [m/s^2], exact."""
DIGITS = 17
"""Significant digits of converted numbers: enough to distinguish any two floats."""

_AGAIN = "correct the number, or get the certificate from its laboratory again"
_EXACT = Context(prec=60)
_SHOWN = Context(prec=DIGITS)
_POWERS = {"rad/s/g": -1, "1": 0, "rad": 0, "g": 1, "g/g^2": -1, "g/g^3": -2, "g/s": 1, "g/K": 1, "1/K": 0}
"""Power of ``g`` in each unit of a coefficient."""
_BASE = (r"\metre", r"\second", r"\radian", r"\kilogram", r"\kelvin")


def power_of_g(unit: str) -> int:
    """Power of ``g`` in a coefficient's unit: ``value_SI = value * 9.80665**power``."""
    return _POWERS[unit]


@lru_cache(maxsize=256)
def dsi_unit(*units: str) -> str:
    r"""D-SI text of a unit, or of the product of several units.

    Examples
    --------
    >>> dsi_unit("g/g^2"), dsi_unit("g", "rad")
    ('\\metre\\tothe{-1}\\second\\tothe{2}', '\\metre\\second\\tothe{-2}\\radian')
    """
    totals = [sum(column) for column in zip(*(parse_unit(unit).dimension for unit in units), strict=True)]
    if any(totals[len(_BASE) :]):
        raise DataError(
            f"unit '{' '.join(units)}' is not made of SI base units and the radian",
            remedy="write the quantity in units that are",
        )
    parts = [_powered(name, power) for name, power in zip(_BASE, totals, strict=False) if power]
    return "".join(parts) or r"\one"


def _powered(name: str, power: float) -> str:
    return name if power == 1.0 else f"{name}\\tothe{{{power:g}}}"


def to_dsi(value: float, power: int = 0) -> str:
    """SI text of a number whose unit contains that power of ``g``."""
    if power == 0:
        return repr(float(value))
    return str(_SHOWN.plus(_EXACT.multiply(Decimal(value), _EXACT.power(G, power))))


def significant_digit(half_width: Decimal, value: Decimal) -> int:
    """Power of ten of the last significant digit. U has two significant digits. Without U (a given value) all digits count."""
    return half_width.adjusted() - 1 if half_width else value.adjusted() - (DIGITS - 1)


def from_dsi(text: str, power: int = 0) -> float:
    """The number of an SI text. Inverse of :func:`to_dsi`.

    Raises
    ------
    DataError
        If the text is not a finite number.
    """
    try:
        number = Decimal(text.strip())
    except InvalidOperation:
        raise DataError(f"'{text[:40]}' is not a number", remedy=_AGAIN) from None
    if not number.is_finite() or abs(number.adjusted()) > 300:
        raise DataError(f"'{text[:40]}' is not a finite number", remedy=_AGAIN)
    return float(_EXACT.divide(number, _EXACT.power(G, power)) if power else number)
