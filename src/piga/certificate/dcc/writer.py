"""Write the Digital Calibration Certificate: DCC 3.3.0 in XML with D-SI 2.2.1 quantities, SI only.

The certificate states the coefficients twice: one by one with expanded uncertainty for people, and as one vector with
its covariance matrix (a multivariate uncertainty) for computation. ``g`` is converted exactly. Numbers have all
digits; ``significantDigit`` states which of them are significant.
"""

from __future__ import annotations

import base64
import datetime as dt
import re
from collections.abc import Iterable, Mapping, Sequence
from decimal import Decimal
from typing import TYPE_CHECKING, Any

from piga._version import __version__
from piga.certificate.certificate_file import (
    CertificateFile,
    ConditionTable,
    PartyTable,
    quantity_text,
    title_of,
)
from piga.certificate.dcc.layout import (
    BEFORE,
    DCC,
    JOINT,
    MEASURED,
    RECORD,
    SI,
    dsi_unit,
    label_of,
    power_of_g,
    significant_digit,
    to_dsi,
)
from piga.certificate.statements import TRACEABILITY, Statement, statements, verdicts
from piga.errors import DataError
from piga.records.calibration import Calibration, Coefficient
from piga.records.calibration.coefficient import PROBABILITY, joint_factor
from piga.records.calibration.document import calibration_to_bytes
from piga.units import parse_unit

if TYPE_CHECKING:
    from lxml import etree


MOST_TEXT = 9_900_000
"""Most characters of one text in the XML. libxml2, and programs built on it, refuse more than 10 million."""
VERSION = "3.3.0"
_SCHEMA = "http://www.w3.org/2001/XMLSchema-instance"


def dcc_document(
    data: CertificateFile, calibration: Calibration, before: Calibration | None = None
) -> etree._Element:
    """The certificate as XML. ``data`` must be complete (:func:`piga.certificate.certificate_file.missing_items`).

    Raises
    ------
    DataError
        If a text holds characters that XML forbids, or the attached record is too long for XML readers.
    """
    from lxml import etree

    root = etree.Element(
        f"{{{DCC}}}digitalCalibrationCertificate",
        nsmap={"dcc": DCC, "si": SI, "xsi": _SCHEMA},
        schemaVersion=VERSION,
    )
    root.set(f"{{{_SCHEMA}}}schemaLocation", f"{DCC} {DCC}/v{VERSION}/dcc.xsd")
    try:
        root.append(administrative_data(data, calibration))
        root.append(dcc("measurementResults", [measurement_result(data, calibration, before)]))
    except ValueError as error:
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


def administrative_data(data: CertificateFile, calibration: Calibration) -> etree._Element:
    """Administrative data: laboratory, customer, item, people, statements."""
    return dcc(
        "administrativeData",
        [
            dcc("dccSoftware", [software()]),
            _core(data),
            _items(data, calibration),
            _laboratory(data),
            _persons(data),
            _contact("customer", data.customer),
            dcc("statements", [_statement(statement) for statement in statements(data, calibration)]),
        ],
    )


def _core(data: CertificateFile) -> etree._Element:
    order = _identification("customer", data.calibration.order, "Order") if data.calibration.order else None
    replaced = data.certificate.replaces
    amended = [dcc("typeOfChange", "substituted"), given("replacedUniqueIdentifier", replaced)]
    return dcc(
        "coreData",
        [
            dcc("countryCodeISO3166_1", data.laboratory.country),
            dcc("usedLangCodeISO639_1", "en"),
            dcc("mandatoryLangCodeISO639_1", "en"),
            given("uniqueIdentifier", data.certificate.number),
            None if order is None else dcc("identifications", [order]),
            day("receiptDate", data.item.received),
            day("beginPerformanceDate", data.calibration.begin),
            day("endPerformanceDate", data.calibration.end),
            dcc("performanceLocation", data.calibration.place or "laboratory"),
            day("issueDate", data.certificate.issued),
            dcc("reportAmendedSubstituted", amended) if replaced else None,
        ],
    )


def _identification(issuer: str, value: str, name: str = "") -> etree._Element:
    return dcc("identification", [dcc("issuer", issuer), given("value", value), rich("name", name)])


def _items(data: CertificateFile, calibration: Calibration) -> etree._Element:
    item = data.item
    identifications = [_identification("manufacturer", item.serial, "Serial number")]
    if item.customer_id:
        identifications.append(_identification("customer", item.customer_id, "Customer's identification"))
    nominal = dcc(
        "itemQuantity",
        [
            text("name", "Nominal scale factor"),
            si("real", [si("value", repr(calibration.scale_factor_nominal)), si("unit", dsi_unit("rad/s/g"))]),
        ],
        "piga_nominalScaleFactor",
    )
    parts = [
        text("name", item.description),
        rich("description", f"Condition on receipt: {item.condition}"),
        dcc("manufacturer", [text("name", item.manufacturer)]),
        given("model", item.model),
        dcc("identifications", identifications),
        dcc("itemQuantities", [nominal]),
    ]
    return dcc("items", [dcc("item", parts)])


def _contact(name: str, party: PartyTable) -> etree._Element:
    location = [
        given("city", party.city),
        given("countryCode", party.country),
        given("postCode", party.post_code),
        given("street", party.street),
    ]
    return dcc(
        name,
        [
            text("name", party.name),
            given("eMail", party.email),
            given("phone", party.phone),
            dcc("location", location),
        ],
    )


def _laboratory(data: CertificateFile) -> etree._Element:
    code = given("calibrationLaboratoryCode", data.laboratory.accreditation)
    return dcc("calibrationLaboratory", [code, _contact("contact", data.laboratory)])


def _persons(data: CertificateFile) -> etree._Element:
    authorised, performed = data.people.authorised, data.people.performed
    people = [(authorised, "true")] + ([(performed, "false")] if performed.name else [])
    return dcc(
        "respPersons",
        [
            dcc(
                "respPerson",
                [
                    dcc("person", [text("name", person.name)]),
                    given("role", person.role),
                    dcc("mainSigner", main),
                ],
            )
            for person, main in people
        ],
    )


def _statement(statement: Statement) -> etree._Element:
    return dcc(
        "statement",
        [
            text("name", statement.title),
            dcc("traceable", "true") if statement.ref_type == TRACEABILITY else None,
            dcc("norm", "ISO/IEC 17025:2017"),
            given("reference", statement.clause),
            rich("declaration", statement.text),
            day("date", statement.date),
            given("conformity", statement.conformity),
            _ranges(statement.ranges),
        ],
        statement.ref_type,
    )


def _ranges(ranges: Sequence[tuple[str, float, float, str]]) -> etree._Element | None:
    """Ranges in SI, each with lower and upper end."""
    quantities = []
    for name, low, high, unit in ranges:
        for end, value in (("lower end", low), ("upper end", high)):
            real = [si("value", repr(float(value))), si("unit", dsi_unit(unit))]
            quantities.append(dcc("quantity", [text("name", f"{name}, {end}"), si("real", real)]))
    return dcc("data", quantities) if quantities else None


def measurement_result(
    data: CertificateFile, calibration: Calibration, before: Calibration | None
) -> etree._Element:
    """The measurement: method, conditions and results."""
    results = []
    if before is not None:
        results.append(_coefficients("Coefficients before adjustment", before, {}, BEFORE))
    after = "" if before is None else " after adjustment"
    marks = {verdict.key: verdict.status for verdict in verdicts(data, calibration)}
    results.append(_coefficients(f"Coefficients{after}", calibration, marks, MEASURED))
    results.append(_joint(calibration))
    results.append(_record(calibration))
    return dcc(
        "measurementResult",
        [
            text("name", f"Calibration of {calibration.serial}"),
            _methods(data),
            dcc("usedSoftware", [software()]),
            _equipment(data),
            dcc("influenceConditions", [_condition(condition) for condition in data.environment]),
            dcc("results", results),
        ],
    )


def _methods(data: CertificateFile) -> etree._Element:
    documents = [given("norm", document) for document in data.method.documents]
    description = f"{data.method.description} Additions, deviations and exclusions: {data.method.deviations}."
    method = [text("name", data.method.name), rich("description", description), *documents]
    uncertainty = [
        text("name", "Measurement uncertainty"),
        rich(
            "description",
            "Expanded uncertainties are standard uncertainties times the coverage factor of Student's t for the "
            "effective degrees of freedom of each coefficient and a coverage probability of 95 %. A coefficient for "
            "which that does not hold has the shortest 95 % coverage interval by Monte Carlo. The joint "
            "result has the coverage factor sqrt(n F(n, nu)) for n coefficients, where nu is the fewest effective "
            "degrees of freedom of any of them.",
        ),
        dcc("norm", "JCGM 100:2008"),
        dcc("norm", "JCGM 101:2008"),
        dcc("norm", "JCGM 102:2011"),
    ]
    return dcc("usedMethods", [dcc("usedMethod", method), dcc("usedMethod", uncertainty, "basic_uncertainty")])


def _equipment(data: CertificateFile) -> etree._Element:
    equipment = []
    for standard in data.traceability.standard:
        shown = "; ".join(part for part in (standard.realises, standard.certificate) if part)
        identification = _identification("calibrationLaboratory", standard.identification or standard.name)
        parts = [
            text("name", standard.name),
            rich("description", shown),
            dcc("identifications", [identification]),
        ]
        equipment.append(dcc("measuringEquipment", parts, "basic_normalUsed"))
    return dcc("measuringEquipments", equipment)


def _condition(condition: ConditionTable) -> etree._Element:
    number, unit = quantity_text(condition.value)
    value = _si_decimal(number, unit, offset=True)
    uncertain: list[etree._Element] = []
    if condition.uncertainty:
        spread, spread_unit = quantity_text(condition.uncertainty)
        uncertain = [_univariate(_si_decimal(spread, spread_unit), "2")]
    real = si("real", [si("value", value), si("unit", dsi_unit(unit)), *uncertain])
    quantity = dcc("quantity", [text("name", condition.name), real])
    kind = {"air temperature": "basic_temperature", "relative humidity": "basic_humidityRelative"}
    return dcc(
        "influenceCondition",
        [text("name", condition.name), dcc("data", [quantity])],
        kind.get(condition.name.lower(), ""),
    )


def _si_decimal(number: float, unit: str, *, offset: bool = False) -> str:
    """SI text of a number written by a person, without binary rounding: 20.1 degC gives 293.25 K."""
    parsed = parse_unit(unit)
    value = Decimal(repr(number)) * Decimal(repr(parsed.factor))
    return str(value + Decimal("273.15") if offset and parsed.text == "degC" else value)


def _univariate(value: str, factor: str) -> etree._Element:
    expanded = [
        si("valueExpandedMU", value),
        si("coverageFactor", factor),
        si("coverageProbability", str(PROBABILITY)),
        si("distribution", "normal" if factor == "2" else "t"),
    ]
    return si("measurementUncertaintyUnivariate", [si("expandedMU", expanded)])


def _interval(coefficient: Coefficient, power: int) -> etree._Element:
    """The Monte Carlo interval of a coefficient."""
    covered = coefficient.coverage
    interval = [
        si("valueStandardMU", to_dsi(coefficient.std, power)),
        si("intervalMin", to_dsi(covered.low, power)),
        si("intervalMax", to_dsi(covered.high, power)),
        si("coverageProbability", str(PROBABILITY)),
    ]
    return si("measurementUncertaintyUnivariate", [si("coverageIntervalMU", interval)])


def _coefficients(
    title: str, calibration: Calibration, marks: Mapping[str, str], ref_type: str
) -> etree._Element:
    quantities = [_quantity(c, marks.get(c.key, "")) for c in calibration.coefficients]
    return dcc("result", [text("name", title), dcc("data", [dcc("list", quantities)])], ref_type)


def _quantity(coefficient: Coefficient, mark: str) -> etree._Element:
    power, covered = power_of_g(coefficient.unit), coefficient.coverage
    expanded, value = to_dsi(covered.half_width, power), to_dsi(coefficient.value, power)
    real = [
        si("label", coefficient.key),
        si("value", value),
        si("unit", dsi_unit(coefficient.unit)),
        si("significantDigit", str(significant_digit(Decimal(expanded), Decimal(value)))),
        _interval(coefficient, power)
        if covered.monte_carlo
        else _univariate(expanded, f"{covered.factor:.6f}"),
    ]
    meta = None
    if mark:
        declared = [text("declaration", "Conformity of this coefficient"), dcc("conformity", mark)]
        meta = dcc("measurementMetaData", [dcc("metaData", declared, "basic_conformity")])
    return dcc("quantity", [text("name", title_of(coefficient)), si("real", real), meta])


def _joint(calibration: Calibration) -> etree._Element:
    """All coefficients as a vector with its covariance matrix."""
    units = [c.unit for c in calibration.coefficients]
    powers = [power_of_g(unit) for unit in units]
    columns = [
        si(
            "columnXMLList",
            [
                si(
                    "covarianceXMLList",
                    [
                        si(
                            "valueXMLList",
                            " ".join(to_dsi(v, p + powers[j]) for v, p in zip(column, powers, strict=True)),
                        ),
                        si("unitXMLList", " ".join(dsi_unit(unit, units[j]) for unit in units)),
                    ],
                )
            ],
        )
        for j, column in enumerate(calibration.covariance.T.tolist())
    ]
    spread = " ".join(to_dsi(c.std, p) for c, p in zip(calibration.coefficients, powers, strict=True))
    region = [
        si("covarianceMatrixXMLList", columns),
        si("coverageFactorXMLList", f"{joint_factor(calibration.coefficients):.6f}"),
        si("coverageProbabilityXMLList", str(PROBABILITY)),
    ]
    vector = [
        si("labelXMLList", " ".join(label_of(c.key) for c in calibration.coefficients)),
        si(
            "valueXMLList",
            " ".join(to_dsi(c.value, p) for c, p in zip(calibration.coefficients, powers, strict=True)),
        ),
        si("unitXMLList", " ".join(dsi_unit(unit) for unit in units)),
        si(
            "measurementUncertaintyUnivariateXMLList",
            [si("standardMUXMLList", [si("valueStandardMUXMLList", spread)])],
        ),
        si("measurementUncertaintyMultivariateXMLList", [si("ellipsoidalRegionMUXMLList", region)]),
    ]
    quantity = dcc(
        "quantity", [text("name", "Coefficients and covariance"), si("realListXMLList", vector)], JOINT
    )
    return dcc("result", [text("name", "Joint result with covariance"), dcc("data", [quantity])])


def _record(calibration: Calibration) -> etree._Element:
    """The whole record as an attachment, so that the certificate can be read back into a calibration."""
    attached = dcc(
        "byteData",
        [
            text(
                "name", "Calibration record of piga with budget, residual figures, data quality and provenance"
            ),
            dcc("fileName", "calibration.json"),
            dcc("mimeType", "application/json"),
            dcc("dataBase64", base64.b64encode(calibration_to_bytes(calibration)).decode("ascii")),
        ],
        RECORD,
    )
    return dcc("result", [text("name", "Calibration record"), dcc("data", [attached])])


Parts = Iterable[Any]


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


def dcc(name: str, parts: Parts | str, ref_type: str = "") -> etree._Element:
    """A ``dcc`` element, with parts or text."""
    return _element(DCC, name, parts, ref_type)


def si(name: str, parts: Parts | str) -> etree._Element:
    """An ``si`` element (quantity), with parts or text."""
    return _element(SI, name, parts)


def given(name: str, words: str) -> etree._Element | None:
    """An element with text, or None without text. White space becomes single spaces, as the schema demands."""
    clean = " ".join(words.split())
    return dcc(name, clean) if clean else None


def text(name: str, words: str) -> etree._Element:
    """An element with content in English."""
    return dcc(name, [_element(DCC, "content", " ".join(words.split()), lang="en")])


def rich(name: str, words: str) -> etree._Element | None:
    """As :func:`text`, or None for white space."""
    return text(name, words) if words.strip() else None


def day(name: str, date: dt.date | None) -> etree._Element | None:
    """A date, or None for none."""
    return None if date is None else dcc(name, date.isoformat())


def software() -> etree._Element:
    """Name and release of piga."""
    release = re.match(r"\d{1,3}(\.\d{1,3}){0,3}", __version__)
    return dcc("software", [text("name", "piga"), dcc("release", f"v{release[0] if release else 0}")])
