"""A Digital Calibration Certificate (DCC 3.x) made by piga, read back into a calibration.

The file comes from outside: it is read with limits, and what it says twice (coefficients in SI with their
covariance, and the attached record) must agree. A signature is checked apart (:mod:`piga.records.xml_signature`).
"""

from __future__ import annotations

import base64
import binascii
import datetime as dt
import warnings
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote, unquote

import numpy as np

from piga.errors import DataError, PigaWarning
from piga.records.calibration import Calibration, Coefficient
from piga.records.calibration_json import calibration_from_bytes
from piga.records.coverage import coverage_factor
from piga.records.dsi_units import dsi_unit, from_dsi, power_of_g
from piga.records.terms import check_name, unit_of
from piga.records.xml_file import read_xml

if TYPE_CHECKING:
    from lxml import etree

DCC = "https://ptb.de/dcc"
SI = "https://ptb.de/si"
JOINT = "piga_jointResult"
"""``refType`` of the quantity that holds all coefficients with their covariance."""
RECORD = "piga_calibrationRecord"
"""``refType`` of the attached calibration.json."""
AGAIN = "do not use the file; get it again from the issuer"
MOST_COEFFICIENTS = 4096
_NAMES = {"dcc": DCC, "si": SI}
_SAFE = "[]_.,:;+-=()/*"
_SLACK = 1e-6
"""Relative to U: coverage factors are stated with six decimals, and differ in the last digits between libraries."""


def label_of(key: str) -> str:
    """A coefficient's key as a word without spaces (segment labels may have some)."""
    return quote(key, safe=_SAFE)


def read_dcc(path: str | Path) -> Calibration:
    """Read a certificate in XML back into a calibration.

    Raises
    ------
    DataError
        If the file is no DCC, was not made by piga, is damaged, or contradicts itself.
    """
    path = Path(path)
    return calibration_of(read_xml(path)[1], path)


def calibration_of(root: etree._Element, path: Path) -> Calibration:
    """The calibration in a certificate; ``path`` is for messages. Errors as :func:`read_dcc`."""
    if root.tag != f"{{{DCC}}}digitalCalibrationCertificate":
        raise DataError(f"{path}: is no Digital Calibration Certificate", remedy="name a certificate in XML")
    version = root.get("schemaVersion", "")
    if not version.startswith("3."):
        raise DataError(f"{path}: DCC version '{version[:20]}' is not known", remedy="update piga")
    record = _attached(root, path)
    coefficients, covariance = _joint(root, path)
    _compare(path, record, coefficients, covariance)
    _compare_coverage(path, root, record)
    return record


def date_of_issue(root: etree._Element, path: Path) -> dt.date:
    """The date of issue that a certificate states; ``path`` is for messages.

    Raises
    ------
    DataError
        If it states none, or several.
    """
    return _date(root, "issueDate", path)


def _date(root: etree._Element, name: str, path: Path) -> dt.date:
    element = _one(root, f"dcc:administrativeData/dcc:coreData/dcc:{name}", path, name)
    try:
        return dt.date.fromisoformat(element.text or "")
    except ValueError:
        raise DataError(f"{path}: {name} '{(element.text or '')[:40]}' is no date", remedy=AGAIN) from None


def _one(root: etree._Element, query: str, path: Path, what: str) -> etree._Element:
    found = root.findall(query, _NAMES)
    if len(found) != 1:
        raise DataError(
            f"{path}: holds {len(found) or 'no'} {what}: was it made by piga?",
            remedy="only certificates made by piga can be read back",
        )
    return found[0]


def _attached(root: etree._Element, path: Path) -> Calibration:
    data = _one(root, f".//dcc:byteData[@refType='{RECORD}']", path, "calibration record")
    text = data.findtext("dcc:dataBase64", "", _NAMES)
    try:
        raw = base64.b64decode("".join(text.split()), validate=True)
    except (binascii.Error, ValueError):
        raise DataError(f"{path}: the attached record is damaged", remedy="get the file again") from None
    return calibration_from_bytes(raw, path)


def _joint(root: etree._Element, path: Path) -> tuple[tuple[Coefficient, ...], np.ndarray]:
    """Coefficients and covariance in file units, from the quantity in SI."""
    base = _one(root, f".//dcc:quantity[@refType='{JOINT}']/si:realListXMLList", path, "joint result")
    keys = [unquote(label) for label in base.findtext("si:labelXMLList", "", _NAMES).split()]
    if not 0 < len(keys) <= MOST_COEFFICIENTS or len(set(keys)) != len(keys):
        raise DataError(f"{path}: {len(keys)} coefficients, some perhaps twice", remedy="get the file again")
    parts = [key.removesuffix("]").split("[", 1) if key.endswith("]") else [key] for key in keys]
    for name, *_ in parts:
        if not check_name(name):
            raise DataError(f"{path}: unknown coefficient '{name[:40]}'", remedy="update piga")
    units = [unit_of(name) for name, *_ in parts]
    values = _numbers(base, "si:valueXMLList", "si:unitXMLList", [(unit,) for unit in units], path)
    spread = base.findtext(
        "si:measurementUncertaintyUnivariateXMLList/si:standardMUXMLList/si:valueStandardMUXMLList", "", _NAMES
    )
    stds = _converted(spread.split(), [(unit,) for unit in units], path)
    columns = base.findall(".//si:columnXMLList", _NAMES)
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
    """Numbers of a list whose units must be the expected products."""
    given = element.findtext(units, "", _NAMES).split()
    wanted = [dsi_unit(*product) for product in expected]
    if given != wanted:
        raise DataError(
            f"{path}: units {' '.join(given)[:80]} where {' '.join(wanted)[:80]} are needed", remedy=AGAIN
        )
    return _converted(element.findtext(values, "", _NAMES).split(), expected, path)


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
    """What the certificate states must be what the attached record holds."""
    if [c.key for c in record.coefficients] != [c.key for c in coefficients]:
        raise DataError(f"{path}: the attached record holds other coefficients", remedy="do not use the file")
    for stated, kept in zip(coefficients, record.coefficients, strict=True):
        if (stated.value, stated.std) != (kept.value, kept.std):
            raise DataError(
                f"{path}: contradicts itself: {stated.key} is stated as {stated.value!r} (u {stated.std!r}), the attached "
                f"record has {kept.value!r} (u {kept.std!r})",
                remedy="do not use the file; ask the issuer",
            )
    if not np.array_equal(covariance, record.covariance):
        raise DataError(
            f"{path}: contradicts itself: the covariance differs from the attached record's", remedy=AGAIN
        )


def _compare_coverage(path: Path, root: etree._Element, record: Calibration) -> None:
    """The limits that the certificate states one by one must be those of the record.

    Certificates of piga 0.1 took one coverage factor for all coefficients, from the number of rows: these are
    read, with a warning.
    """
    query = ".//dcc:result[@refType='basic_measuredValue']/dcc:data/dcc:list/dcc:quantity/si:real"
    stated = {unquote(real.findtext("si:label", "", _NAMES)): real for real in root.iterfind(query, _NAMES)}
    by_rows = coverage_factor(record.surplus_observations)
    outdated = []
    for c in record.coefficients:
        if c.key not in stated:
            raise DataError(
                f"{path}: does not state {c.key}, which its record holds", remedy="get the file again"
            )
        low, high = _limits(stated[c.key], c, path)
        slack = _SLACK * c.expanded
        if abs(low - c.limits[0]) <= slack and abs(high - c.limits[1]) <= slack:
            continue
        if abs(0.5 * (high - low) - by_rows * c.std) > slack:
            raise DataError(
                f"{path}: contradicts itself: {c.key} is stated with 95 % limits {low:.9g} and {high:.9g}, the attached "
                f"record has {c.limits[0]:.9g} and {c.limits[1]:.9g}",
                remedy="do not use the file; ask the issuer",
            )
        outdated.append(f"{c.key} {0.5 * (high - low):.2g} for {c.expanded:.2g} {c.unit}")
    if outdated:
        warnings.warn(
            f"{path}: made by an earlier piga, which took k = {by_rows:.3f} from the number of rows; the expanded "
            f"uncertainties stated and those by the effective degrees of freedom: {', '.join(outdated)}. "
            "The record that is read back holds the latter",
            PigaWarning,
            stacklevel=3,
        )


def _limits(real: etree._Element, c: Coefficient, path: Path) -> tuple[float, float]:
    """95 % limits of a coefficient as stated, in its file unit."""
    names = ("si:intervalMin", "si:intervalMax", "si:valueExpandedMU")
    texts = [real.findtext(f".//{name}", None, _NAMES) for name in names]
    try:
        low, high, half = (None if text is None else from_dsi(text, power_of_g(c.unit)) for text in texts)
    except DataError as error:
        raise DataError(f"{path}: {c.key}: {error.message}", remedy="get the file again") from None
    if low is not None and high is not None:
        return low, high
    if half is None:
        raise DataError(f"{path}: {c.key} is stated without an uncertainty", remedy="get the file again")
    return c.value - half, c.value + half
