"""The Digital Calibration Certificate: DCC 3.3.0 in XML with D-SI 2.2.1 quantities, SI only.

Coefficients stand in it twice: one by one with expanded uncertainty for any reader of certificates, and as one
vector with its covariance matrix (a multivariate uncertainty) for those who compute with them. ``g`` is
converted exactly; numbers carry all their digits, and ``significantDigit`` says which of them count.
"""

from __future__ import annotations

import base64
import datetime as dt
import math
import re
from collections.abc import Iterable, Sequence
from decimal import Decimal
from typing import TYPE_CHECKING, Any

from piga._version import __version__
from piga.records.calibration import Calibration, Coefficient
from piga.records.calibration_json import calibration_to_bytes
from piga.records.certificate_file import CertificateFile, ConditionTable, PartyTable, quantity_text
from piga.records.dcc_reader import DCC, JOINT, RECORD, SI, label_of
from piga.records.dsi_units import dsi_unit, power_of_g, to_dsi
from piga.records.terms import meaning_of
from piga.reports.certificate_statements import Statement, statements, verdicts
from piga.reports.numbers import coverage_factor
from piga.units import parse_unit

if TYPE_CHECKING:
    from lxml import etree

VERSION = "3.3.0"
PROBABILITY = 0.95
_SCHEMA = "http://www.w3.org/2001/XMLSchema-instance"

Parts = Iterable[Any]


def dcc_document(
    data: CertificateFile, calibration: Calibration, before: Calibration | None = None
) -> etree._Element:
    """The certificate as XML; ``data`` must be complete (:func:`piga.records.certificate_file.missing_items`)."""
    from lxml import etree

    root = etree.Element(
        f"{{{DCC}}}digitalCalibrationCertificate",
        nsmap={"dcc": DCC, "si": SI, "xsi": _SCHEMA},
        schemaVersion=VERSION,
    )
    root.set(f"{{{_SCHEMA}}}schemaLocation", f"{DCC} {DCC}/v{VERSION}/dcc.xsd")
    root.append(_administrative(data, calibration))
    root.append(_d("measurementResults", [_result(data, calibration, before)]))
    etree.indent(root)
    return root


def _element(
    namespace: str, name: str, parts: Parts | str, ref_type: str = "", **attributes: str
) -> etree._Element:
    from lxml import etree

    element = etree.Element(f"{{{namespace}}}{name}", attributes, nsmap={"dcc": DCC, "si": SI})
    if ref_type:
        element.set("refType", ref_type)
    if isinstance(parts, str):
        element.text = parts
    else:
        element.extend([part for part in parts if part is not None])
    return element


def _d(name: str, parts: Parts | str, ref_type: str = "") -> etree._Element:
    return _element(DCC, name, parts, ref_type)


def _s(name: str, parts: Parts | str) -> etree._Element:
    return _element(SI, name, parts)


def _given(name: str, text: str) -> etree._Element | None:
    """An element with text, or None for none (white space made single, as the schema wants it)."""
    words = " ".join(text.split())
    return _d(name, words) if words else None


def _text(name: str, text: str) -> etree._Element:
    """An element with content in English."""
    return _d(name, [_element(DCC, "content", " ".join(text.split()), lang="en")])


def _rich(name: str, text: str) -> etree._Element | None:
    return _text(name, text) if text.strip() else None


def _date(name: str, date: dt.date | None) -> etree._Element | None:
    return None if date is None else _d(name, date.isoformat())


# administrative data


def _administrative(data: CertificateFile, calibration: Calibration) -> etree._Element:
    return _d(
        "administrativeData",
        [
            _d("dccSoftware", [_software()]),
            _core(data),
            _items(data, calibration),
            _laboratory(data),
            _persons(data),
            _contact("customer", data.customer),
            _d("statements", [_statement(statement) for statement in statements(data, calibration)]),
        ],
    )


def _software() -> etree._Element:
    release = re.match(r"\d{1,3}(\.\d{1,3}){0,3}", __version__)
    return _d("software", [_text("name", "piga"), _d("release", f"v{release[0] if release else 0}")])


def _core(data: CertificateFile) -> etree._Element:
    order = _identification("customer", data.calibration.order, "Order") if data.calibration.order else None
    replaced = data.certificate.replaces
    amended = [_d("typeOfChange", "substituted"), _given("replacedUniqueIdentifier", replaced)]
    return _d(
        "coreData",
        [
            _d("countryCodeISO3166_1", data.laboratory.country),
            _d("usedLangCodeISO639_1", "en"),
            _d("mandatoryLangCodeISO639_1", "en"),
            _given("uniqueIdentifier", data.certificate.number),
            None if order is None else _d("identifications", [order]),
            _date("receiptDate", data.item.received),
            _date("beginPerformanceDate", data.calibration.begin),
            _date("endPerformanceDate", data.calibration.end),
            _d("performanceLocation", data.calibration.place or "laboratory"),
            _date("issueDate", data.certificate.issued),
            _d("reportAmendedSubstituted", amended) if replaced else None,
        ],
    )


def _identification(issuer: str, value: str, name: str) -> etree._Element:
    return _d("identification", [_d("issuer", issuer), _given("value", value), _text("name", name)])


def _items(data: CertificateFile, calibration: Calibration) -> etree._Element:
    item = data.item
    identifications = [_identification("manufacturer", item.serial, "Serial number")]
    if item.customer_id:
        identifications.append(_identification("customer", item.customer_id, "Customer's identification"))
    nominal = _d(
        "itemQuantity",
        [
            _text("name", "Nominal scale factor"),
            _s("real", [_s("value", repr(calibration.scale_factor_nominal)), _s("unit", dsi_unit("rad/s/g"))]),
        ],
        "piga_nominalScaleFactor",
    )
    parts = [
        _text("name", item.description),
        _rich("description", f"Condition on receipt: {item.condition}"),
        _d("manufacturer", [_text("name", item.manufacturer)]),
        _given("model", item.model),
        _d("identifications", identifications),
        _d("itemQuantities", [nominal]),
    ]
    return _d("items", [_d("item", parts)])


def _contact(name: str, party: PartyTable) -> etree._Element:
    location = [
        _given("city", party.city),
        _given("countryCode", party.country),
        _given("postCode", party.post_code),
        _given("street", party.street),
    ]
    return _d(
        name,
        [
            _text("name", party.name),
            _given("eMail", party.email),
            _given("phone", party.phone),
            _d("location", location),
        ],
    )


def _laboratory(data: CertificateFile) -> etree._Element:
    code = _given("calibrationLaboratoryCode", data.laboratory.accreditation)
    return _d("calibrationLaboratory", [code, _contact("contact", data.laboratory)])


def _persons(data: CertificateFile) -> etree._Element:
    authorised, performed = data.people.authorised, data.people.performed
    people = [(authorised, "true")] + ([(performed, "false")] if performed.name else [])
    return _d(
        "respPersons",
        [
            _d(
                "respPerson",
                [
                    _d("person", [_text("name", person.name)]),
                    _given("role", person.role),
                    _d("mainSigner", main),
                ],
            )
            for person, main in people
        ],
    )


def _statement(statement: Statement) -> etree._Element:
    return _d(
        "statement",
        [
            _text("name", statement.title),
            _d("traceable", "true") if statement.kind == "traceability" else None,
            _d("norm", "ISO/IEC 17025:2017"),
            _given("reference", statement.clause),
            _rich("declaration", statement.text),
            _date("date", statement.date),
            _given("conformity", statement.conformity),
            _ranges(statement.ranges),
        ],
        statement.ref_type,
    )


def _ranges(ranges: Sequence[tuple[str, float, float, str]]) -> etree._Element | None:
    """Ranges in SI, lower and upper end each."""
    quantities = []
    for name, low, high, unit in ranges:
        for end, value in (("lower end", low), ("upper end", high)):
            real = [_s("value", repr(float(value))), _s("unit", dsi_unit(unit))]
            quantities.append(_d("quantity", [_text("name", f"{name}, {end}"), _s("real", real)]))
    return _d("data", quantities) if quantities else None


# results


def _result(data: CertificateFile, calibration: Calibration, before: Calibration | None) -> etree._Element:
    results = []
    if before is not None:
        results.append(_coefficients("Coefficients before adjustment", before, {}, "basic_beforeAdjustment"))
    after = "" if before is None else " after adjustment"
    marks = {verdict.key: verdict.dcc for verdict in verdicts(data, calibration)}
    results.append(_coefficients(f"Coefficients{after}", calibration, marks, "basic_measuredValue"))
    results.append(_joint(calibration))
    results.append(_record(calibration))
    return _d(
        "measurementResult",
        [
            _text("name", f"Calibration of {calibration.serial}"),
            _methods(data),
            _d("usedSoftware", [_software()]),
            _equipment(data),
            _d("influenceConditions", [_condition(condition) for condition in data.environment]),
            _d("results", results),
        ],
    )


def _methods(data: CertificateFile) -> etree._Element:
    documents = [_given("norm", document) for document in data.method.documents]
    description = f"{data.method.description} Additions, deviations and exclusions: {data.method.deviations}."
    method = [_text("name", data.method.name), _rich("description", description), *documents]
    uncertainty = [
        _text("name", "Measurement uncertainty"),
        _rich(
            "description",
            "Expanded uncertainties are standard uncertainties times the coverage factor of Student's t for "
            "a coverage probability of 95 %.",
        ),
        _d("norm", "JCGM 100:2008"),
    ]
    return _d("usedMethods", [_d("usedMethod", method), _d("usedMethod", uncertainty, "basic_uncertainty")])


def _equipment(data: CertificateFile) -> etree._Element:
    found = []
    for standard in data.traceability.standard:
        shown = "; ".join(part for part in (standard.realises, standard.certificate) if part)
        identification = [
            _d("issuer", "calibrationLaboratory"),
            _given("value", standard.identification or standard.name),
        ]
        parts = [
            _text("name", standard.name),
            _rich("description", shown),
            _d("identifications", [_d("identification", identification)]),
        ]
        found.append(_d("measuringEquipment", parts, "basic_normalUsed"))
    return _d("measuringEquipments", found)


def _condition(condition: ConditionTable) -> etree._Element:
    number, unit = quantity_text(condition.value)
    value = _si_decimal(number, unit, offset=True)
    uncertain: list[etree._Element] = []
    if condition.uncertainty:
        spread, spread_unit = quantity_text(condition.uncertainty)
        uncertain = [_univariate(_si_decimal(spread, spread_unit), "2")]
    real = _s("real", [_s("value", value), _s("unit", dsi_unit(unit)), *uncertain])
    quantity = _d("quantity", [_text("name", condition.name), real])
    kind = {"air temperature": "basic_temperature", "relative humidity": "basic_humidityRelative"}
    return _d(
        "influenceCondition",
        [_text("name", condition.name), _d("data", [quantity])],
        kind.get(condition.name.lower(), ""),
    )


def _si_decimal(number: float, unit: str, *, offset: bool = False) -> str:
    """SI text of a number that a person wrote, without binary artefacts: 20.1 degC is 293.25 K."""
    parsed = parse_unit(unit)
    value = Decimal(repr(number)) * Decimal(repr(parsed.factor))
    return str(value + Decimal("273.15") if offset and parsed.text == "degC" else value)


def _univariate(value: str, factor: str) -> etree._Element:
    expanded = [
        _s("valueExpandedMU", value),
        _s("coverageFactor", factor),
        _s("coverageProbability", str(PROBABILITY)),
        _s("distribution", "normal" if factor == "2" else "t"),
    ]
    return _s("measurementUncertaintyUnivariate", [_s("expandedMU", expanded)])


def _coefficients(title: str, calibration: Calibration, marks: dict[str, str], ref_type: str) -> etree._Element:
    factor = coverage_factor(calibration.degrees_of_freedom, PROBABILITY)
    quantities = [_quantity(c, factor, marks.get(c.key, "")) for c in calibration.coefficients]
    return _d("result", [_text("name", title), _d("data", [_d("list", quantities)])], ref_type)


def _quantity(coefficient: Coefficient, factor: float, mark: str) -> etree._Element:
    power = power_of_g(coefficient.unit)
    expanded = to_dsi(factor * coefficient.std, power)
    real = [
        _s("label", coefficient.key),
        _s("value", to_dsi(coefficient.value, power)),
        _s("unit", dsi_unit(coefficient.unit)),
        _s("significantDigit", str(Decimal(expanded).adjusted() - 1)),
        _univariate(expanded, f"{factor:.6f}"),
    ]
    words = meaning_of(coefficient.name)
    where = "" if coefficient.segment is None else f", segment {coefficient.segment}"
    meta = None
    if mark:
        declared = [_text("declaration", "Conformity of this coefficient"), _d("conformity", mark)]
        meta = _d("measurementMetaData", [_d("metaData", declared, "basic_conformity")])
    return _d("quantity", [_text("name", f"{words[:1].upper()}{words[1:]}{where}"), _s("real", real), meta])


def _joint(calibration: Calibration) -> etree._Element:
    """All coefficients as a vector with its covariance matrix."""
    units = [c.unit for c in calibration.coefficients]
    powers = [power_of_g(unit) for unit in units]
    columns = [
        _s(
            "columnXMLList",
            [
                _s(
                    "covarianceXMLList",
                    [
                        _s(
                            "valueXMLList",
                            _words(to_dsi(v, p + powers[j]) for v, p in zip(column, powers, strict=True)),
                        ),
                        _s("unitXMLList", _words(dsi_unit(unit, units[j]) for unit in units)),
                    ],
                )
            ],
        )
        for j, column in enumerate(calibration.covariance.T.tolist())
    ]
    spread = _words(to_dsi(c.std, p) for c, p in zip(calibration.coefficients, powers, strict=True))
    region = [
        _s("covarianceMatrixXMLList", columns),
        _s("coverageFactorXMLList", f"{joint_factor(len(units), calibration.degrees_of_freedom):.6f}"),
        _s("coverageProbabilityXMLList", str(PROBABILITY)),
    ]
    vector = [
        _s("labelXMLList", _words(label_of(c.key) for c in calibration.coefficients)),
        _s(
            "valueXMLList",
            _words(to_dsi(c.value, p) for c, p in zip(calibration.coefficients, powers, strict=True)),
        ),
        _s("unitXMLList", _words(dsi_unit(unit) for unit in units)),
        _s(
            "measurementUncertaintyUnivariateXMLList",
            [_s("standardMUXMLList", [_s("valueStandardMUXMLList", spread)])],
        ),
        _s("measurementUncertaintyMultivariateXMLList", [_s("ellipsoidalRegionMUXMLList", region)]),
    ]
    quantity = _d(
        "quantity", [_text("name", "Coefficients and covariance"), _s("realListXMLList", vector)], JOINT
    )
    return _d("result", [_text("name", "Joint result with covariance"), _d("data", [quantity])])


def _words(parts: Iterable[str]) -> str:
    return " ".join(parts)


def joint_factor(count: int, degrees_of_freedom: float) -> float:
    """Coverage factor of the joint ellipsoid, ``sqrt(n F(n, nu))`` for 95 % (JCGM 102, 6.5.2 with Hotelling's T^2)."""
    from scipy.special import chdtri, fdtri

    if math.isinf(degrees_of_freedom) or degrees_of_freedom > 1e9:
        return math.sqrt(float(chdtri(count, 1.0 - PROBABILITY)))
    return math.sqrt(count * float(fdtri(count, degrees_of_freedom, PROBABILITY)))


def _record(calibration: Calibration) -> etree._Element:
    """The whole record as an attachment: what it takes to read the certificate back into a calibration."""
    attached = _d(
        "byteData",
        [
            _text(
                "name", "Calibration record of piga with budget, residual figures, data quality and provenance"
            ),
            _d("fileName", "calibration.json"),
            _d("mimeType", "application/json"),
            _d("dataBase64", base64.b64encode(calibration_to_bytes(calibration)).decode("ascii")),
        ],
        RECORD,
    )
    return _d("result", [_text("name", "Calibration record"), _d("data", [attached])])
