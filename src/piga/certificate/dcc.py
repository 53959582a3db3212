"""Write a Digital Calibration Certificate, and read one back (DCC 3.3.0, D-SI 2.2.1, SI only).

The certificate states the coefficients one by one with expanded uncertainty for people, and as one vector with its covariance
matrix for programs. Three attachments hold all that piga wrote it from: the calibration, the data of the certificate, and the
calibration before adjustment if there is one. So reading is writing again: the two documents must be equal, and the first
difference is named by its place.
"""

from __future__ import annotations

import base64
import binascii
import copy
import datetime as dt
import math
import re
import warnings
from decimal import Context, Decimal, InvalidOperation
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import msgspec

from piga._version import __version__
from piga.certificate.certificate_file import (
    TRACEABILITY,
    CertificateFile,
    ConditionTable,
    quantity_text,
    statements,
    title_of,
    verdicts,
)
from piga.certificate.xml_signature import SIGNATURE, read_xml
from piga.errors import DataError, PigaWarning
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.coefficient import PROBABILITY, Coefficient, joint_factor
from piga.records.calibration.document import calibration_from_bytes, calibration_to_bytes
from piga.text_files import converted
from piga.units import parse_unit

if TYPE_CHECKING:
    import jinja2
    from lxml import etree

DCC, SI = "https://ptb.de/dcc", "https://ptb.de/si"
NAMES = {"dcc": DCC, "si": SI}
RECORD, DATA, _BEFORE = "piga_calibrationRecord", "piga_certificateData", "piga_calibrationBefore"
"""``refType`` of the attached calibration, of the data of the certificate, and of the calibration before adjustment."""
_AGAIN = "do not use the file; get it again from the issuer"
MOST_TEXT = 9_900_000
"""Most characters of one text in the XML. libxml2, and programs built on it, refuse more than 10 million."""
_ROUNDED = ("valueExpandedMU", "coverageFactor", "coverageFactorXMLList")
"""Numbers that hold a quantile. Libraries differ in its last digits."""
_SLACK = Decimal("1e-6")
"""Relative difference allowed in them."""
_CONDITIONS = {"air temperature": "basic_temperature", "relative humidity": "basic_humidityRelative"}
_UNCERTAINTY = (
    "Expanded uncertainties are standard uncertainties times the coverage factor of Student's t for the "
    "effective degrees of freedom of each coefficient and a coverage probability of 95 %. A coefficient for "
    "which that does not hold has the shortest 95 % coverage interval by Monte Carlo. The joint "
    "result has the coverage factor sqrt(n F(n, nu)) for n coefficients, where nu is the fewest effective "
    "degrees of freedom of any of them."
)


def dcc_document(
    data: CertificateFile, calibration: Calibration, before: Calibration | None = None, release: str = ""
) -> etree._Element:
    """The certificate as XML, as piga of this or of another release writes it.

    ``data`` must be complete (:func:`piga.certificate.certificate_file.missing_items`).
    """
    from lxml import etree

    days = {
        "receiptDate": data.item.received,
        "beginPerformanceDate": data.calibration.begin,
        "endPerformanceDate": data.calibration.end,
    }
    rendered = _template().render(
        data=data,
        calibration=calibration,
        before=before,
        nominal=calibration.scale_factor_nominal * parse_unit(calibration.unit).factor,
        release=release or _own_release(),
        days=days.items(),
        statements=statements(data, calibration),
        traceability=TRACEABILITY,
        uncertainty=_UNCERTAINTY,
        conditions=[_condition(condition) for condition in data.environment],
        marks={verdict.key: verdict.status for verdict in verdicts(data, calibration)},
        covariance=[
            (list(zip(column, calibration.coefficients, strict=True)), owner)
            for column, owner in zip(calibration.covariance.T.tolist(), calibration.coefficients, strict=True)
        ],
        joint_factor=joint_factor(calibration.coefficients),
        attachments=_attachments(data, calibration, before),
    )
    try:
        root = etree.fromstring(rendered.encode(), etree.XMLParser(remove_blank_text=True, huge_tree=True))
    except etree.XMLSyntaxError as error:
        raise DataError(
            f"certificate: a text of the data or of the calibration cannot stand in XML: {error}",
            remedy="write it with letters, digits and signs",
        ) from None
    longest = max(len(node.text or "") for node in root.iter())
    if longest > MOST_TEXT:
        raise DataError(
            f"certificate: the attached calibration has {longest} characters with its {len(calibration.coefficients)} "
            f"coefficients; readers of XML take {MOST_TEXT}",
            remedy="calibrate with phases = 'shared', or with fewer segments",
        )
    etree.indent(root)
    return root


@lru_cache(maxsize=1)
def _template() -> jinja2.Template:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"line": lambda words: " ".join(words.split()), "si": to_dsi}
    environment.globals |= {
        "unit": dsi_unit,
        "label": label_of,
        "title_of": title_of,
        "digit_of": _digit_of,
        "probability": PROBABILITY,
    }
    return environment.get_template("dcc.xml.jinja")


def _digit_of(c: Coefficient) -> int:
    """Power of ten of the last significant digit in SI. U has two. Without U (a given value) all digits count."""
    half_width, value = Decimal(to_dsi(c.expanded, c.unit)), Decimal(to_dsi(c.value, c.unit))
    return half_width.adjusted() - 1 if half_width else value.adjusted() - (DIGITS - 1)


def _condition(condition: ConditionTable) -> dict[str, str]:
    """A condition of the environment in SI, as texts."""
    number, unit = quantity_text(condition.value)
    spread = quantity_text(condition.uncertainty) if condition.uncertainty else None
    return {
        "name": condition.name,
        "kind": _CONDITIONS.get(condition.name.lower(), ""),
        "value": _si_decimal(number, unit, offset=True),
        "unit": dsi_unit(unit),
        "uncertainty": _si_decimal(*spread) if spread else "",
    }


def _si_decimal(number: float, unit: str, *, offset: bool = False) -> str:
    """SI text of a number written by a person, without binary rounding: 20.1 degC gives 293.25 K."""
    parsed = parse_unit(unit)
    value = Decimal(repr(number)) * Decimal(repr(parsed.factor))
    return str(value + Decimal("273.15") if offset and parsed.text == "degC" else value)


def _attachments(
    data: CertificateFile, calibration: Calibration, before: Calibration | None
) -> list[tuple[str, str, str, str, str]]:
    """What the certificate is written from: title, kind, name, file and Base64 of each attachment."""
    words = "Calibration record of piga with budget, residual figures, data quality and provenance"
    parts = [("Calibration record", RECORD, words, "calibration.json", calibration_to_bytes(calibration))]
    if before is not None:
        words, raw = "Calibration record of piga before adjustment", calibration_to_bytes(before)
        parts.append(("Record before adjustment", _BEFORE, words, "before.json", raw))
    words, raw = "Data that piga wrote it from", msgspec.json.encode(data)
    parts.append(("Data of the certificate", DATA, words, "data.json", raw))
    return [(*names, base64.b64encode(raw).decode("ascii")) for *names, raw in parts]  # type: ignore[misc]


def read_dcc(path: str | Path) -> Calibration:
    """Read a certificate in XML, made by piga, back into a calibration. One that contradicts itself is refused."""
    path = Path(path)
    return calibration_of(read_xml(path), path)


def calibration_of(root: etree._Element, path: Path) -> Calibration:
    """The calibration in a certificate. Messages name ``path``. Errors as in :func:`read_dcc`."""
    if root.tag != f"{{{DCC}}}digitalCalibrationCertificate":
        raise DataError(f"{path}: is not a Digital Calibration Certificate", remedy="name a certificate in XML")
    if len(root) and root[-1].tag == SIGNATURE:
        root = copy.deepcopy(root)
        root.remove(root[-1])
    version = root.get("schemaVersion", "")
    if not version.startswith("3."):
        remedy = "ask the issuer for one of version 3" if version[:2] in ("1.", "2.") else "update piga"
        raise DataError(f"{path}: DCC version '{version[:20]}' is not known", remedy=remedy)
    raw = _attached(root, RECORD, path)
    if raw is None:
        raise DataError(
            f"{path}: holds no calibration record of piga",
            remedy="only certificates made by piga can be read back",
        )
    calibration = calibration_from_bytes(raw, path)
    release = root.findtext("dcc:administrativeData/dcc:dccSoftware/dcc:software/dcc:release", "", NAMES)
    if (data := _attached(root, DATA, path)) is None:
        if not release.startswith("v0.2"):
            raise DataError(f"{path}: lacks the attached data of the certificate", remedy=_AGAIN)
        _compare_results(root, calibration, path)
        return calibration
    try:
        file = converted(msgspec.json.decode(data), CertificateFile)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise DataError(
            f"{path}: the attached data of the certificate are damaged ({error})", remedy=_AGAIN
        ) from None
    before = _attached(root, _BEFORE, path)
    former = None if before is None else calibration_from_bytes(before, path)
    try:
        again = dcc_document(file, calibration, former, release)
    except (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise DataError(
            f"{path}: the attached data do not fit the attached calibration ({error})", remedy=_AGAIN
        ) from None
    _compare_trees(root, again, path, words=release == _own_release())
    return calibration


def _own_release() -> str:
    release = re.match(r"\d{1,3}(\.\d{1,3}){0,3}", __version__)
    return f"v{release[0] if release else 0}"


def _attached(root: etree._Element, kind: str, path: Path) -> bytes | None:
    """The bytes of an attachment; None if there is none."""
    attachments = root.findall(f"dcc:measurementResults//dcc:byteData[@refType='{kind}']/dcc:dataBase64", NAMES)
    if not attachments:
        return None
    try:
        if len(attachments) > 1:
            raise DataError(f"{path}: holds {len(attachments)} attachments {kind}", remedy=_AGAIN)
        return base64.b64decode("".join((attachments[0].text or "").split()), validate=True)
    except (binascii.Error, ValueError):
        raise DataError(f"{path}: the attached record is damaged", remedy=_AGAIN) from None


def _compare_results(root: etree._Element, calibration: Calibration, path: Path) -> None:
    """Compare the results of a certificate of piga 0.2, which attached nothing but the calibration."""
    query = "dcc:measurementResults/dcc:measurementResult/dcc:results/dcc:result/dcc:data"
    again = dcc_document(CertificateFile(), calibration)
    for part in ("dcc:list", "dcc:quantity"):
        kind = "[@refType='basic_measuredValue']" if part == "dcc:list" else ""
        place = query.replace("dcc:result/", f"dcc:result{kind}/")
        stated, ours = root.findall(f"{place}/{part}", NAMES), again.findall(f"{place}/{part}", NAMES)
        if len(stated) != len(ours):
            raise DataError(f"{path}: holds other results than piga writes", remedy=_AGAIN)
        for one, other in zip(stated, ours, strict=True):
            for mark in one.findall(".//dcc:measurementMetaData", NAMES):
                mark.getparent().remove(mark)
            _compare_trees(one, other, path)
    warnings.warn(
        f"{path}: made by piga 0.2: its results agree with the attached record; laboratory, dates and statements "
        "were not compared",
        PigaWarning,
        stacklevel=3,
    )


def is_ours(root: etree._Element) -> bool:
    """True if a certificate holds a calibration record of piga."""
    return root.find(f"dcc:measurementResults//dcc:byteData[@refType='{RECORD}']", NAMES) is not None


def date_of_issue(root: etree._Element, path: Path) -> dt.date:
    """The date of issue of a certificate. Messages name ``path``."""
    text = root.findtext("dcc:administrativeData/dcc:coreData/dcc:issueDate", "", NAMES)
    try:
        return dt.date.fromisoformat(text)
    except ValueError:
        raise DataError(f"{path}: issueDate '{text[:40]}' is not a date", remedy=_AGAIN) from None


def _compare_trees(stated: etree._Element, again: etree._Element, path: Path, *, words: bool = True) -> None:
    """Refuse a certificate ``stated`` that differs from what piga writes ``again``. The first difference is named.

    Without ``words`` sentences are not compared: another release of piga may word them otherwise.
    """
    for one in (*stated.itersiblings(preceding=True), *stated.itersiblings(), *stated.iter()):
        if not isinstance(one.tag, str):
            raise DataError(f"{path}: holds comments or instructions, which piga does not write", remedy=_AGAIN)
    for one, other in zip(stated.iter(), again.iter(), strict=False):
        if one.tag != other.tag or dict(one.attrib) != dict(other.attrib):
            raise _contradiction(path, one, f"stands where '{_place(other)}' is expected")
        if len(one) != len(other):
            raise _contradiction(path, one, f"has {len(one)} parts, not {len(other)}")
        if (one is not stated and (one.tail or "").strip()) or (len(one) and (one.text or "").strip()):
            raise _contradiction(path, one, "has text beside its parts")
        text, expected = (one.text or "").strip(), (other.text or "").strip()
        sentence = one.tag == f"{{{DCC}}}content" and not words
        if not (len(one) or sentence) and not _equal(text, expected, one.tag.rpartition("}")[2]):
            raise _contradiction(path, one, f"is '{text[:60]}', by the attached records '{expected[:60]}'")


def _equal(text: str, expected: str, name: str) -> bool:
    if text == expected or name not in _ROUNDED:
        return " ".join(text.split()) == " ".join(expected.split())
    try:
        return abs(Decimal(text) - Decimal(expected)) <= _SLACK * abs(Decimal(expected))
    except InvalidOperation:
        return False


def _contradiction(path: Path, node: etree._Element, what: str) -> DataError:
    return DataError(
        f"{path}: contradicts itself: {_place(node)} {what}", remedy="do not use the file; ask the issuer"
    )


def _place(node: etree._Element) -> str:
    """Names of an element and of the elements around it, with the label of the quantity that it belongs to."""
    around = [node, *node.iterancestors()]
    names = [str(one.tag).rpartition("}")[2] for one in reversed(around)]
    labels = (one.findtext("si:real/si:label", None, NAMES) for one in around)
    label = next((label for label in labels if label), "")
    return "/".join(names[1:][-4:] or names) + (f" of {label[:60]}" if label else "")


_SAFE = "[]_.,:;+-=()/*"


def label_of(key: str) -> str:
    """A coefficient's key without spaces (segment labels may contain spaces)."""
    return quote(key, safe=_SAFE)


G = Decimal("9.80665")
"""Standard gravity [m/s^2], exact."""
DIGITS = 17
"""Significant digits of converted numbers: enough to distinguish any two floats."""

_EXACT = Context(prec=60)
_SHOWN = Context(prec=DIGITS)
_POWERS = {"rad/s/g": -1, "1": 0, "rad": 0, "g": 1, "g/g^2": -1, "g/g^3": -2, "g/s": 1, "g/K": 1, "1/K": 0}
"""Power of ``g`` in each unit of a coefficient."""
_BASE = (r"\metre", r"\second", r"\radian", r"\kilogram", r"\kelvin", r"\volt", "", r"\ampere")
"""D-SI names of the base units of piga. A count is a plain number."""


def power_of_g(unit: str) -> int:
    """Power of ``g`` in a coefficient's unit: ``value_SI = value * 9.80665**power``; -1 in the K of any instrument."""
    return _POWERS.get(unit, -1)


def _of_output(unit: str) -> Decimal:
    """SI value of the output unit in the K of a direct instrument, as in mA/g; 1 for all other units."""
    return Decimal(1) if unit in _POWERS else Decimal(repr(parse_unit(unit.removesuffix("/g")).factor))


@lru_cache(maxsize=256)
def dsi_unit(*units: str) -> str:
    r"""D-SI text of a unit, or of the product of several units.

    Examples
    --------
    >>> dsi_unit("g/g^2"), dsi_unit("g", "rad")
    ('\\metre\\tothe{-1}\\second\\tothe{2}', '\\metre\\second\\tothe{-2}\\radian')
    """
    totals = [sum(column) for column in zip(*(parse_unit(unit).dimension for unit in units), strict=True)]
    parts = [_powered(name, power) for name, power in zip(_BASE, totals, strict=True) if power and name]
    return "".join(parts) or r"\one"


def _powered(name: str, power: float) -> str:
    return name if power == 1.0 else f"{name}\\tothe{{{power:g}}}"


def to_dsi(value: float, *units: str) -> str:
    """SI text of a number in the product of these units."""
    power, output = sum(map(power_of_g, units)), math.prod(map(_of_output, units), start=Decimal(1))
    if power == 0 and output == 1:
        return repr(float(value))
    factor = _EXACT.multiply(output, _EXACT.power(G, power))
    return str(_SHOWN.plus(_EXACT.multiply(Decimal(value), factor)))
