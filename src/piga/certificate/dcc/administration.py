"""Administrative data of a Digital Calibration Certificate: who, for whom, on what, and what is declared."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from piga.certificate.certificate_file import CertificateFile, PartyTable
from piga.certificate.dcc.dsi_units import dsi_unit
from piga.certificate.dcc.elements import day, dcc, given, rich, si, software, text
from piga.certificate.statements import Statement, statements
from piga.records.calibration import Calibration

if TYPE_CHECKING:
    from lxml import etree


def administrative_data(data: CertificateFile, calibration: Calibration) -> etree._Element:
    """What does not come from the measurement: laboratory, customer, item, people, statements."""
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


def _identification(issuer: str, value: str, name: str) -> etree._Element:
    return dcc("identification", [dcc("issuer", issuer), given("value", value), text("name", name)])


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
            dcc("traceable", "true") if statement.kind == "traceability" else None,
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
    """Ranges in SI, lower and upper end each."""
    quantities = []
    for name, low, high, unit in ranges:
        for end, value in (("lower end", low), ("upper end", high)):
            real = [si("value", repr(float(value))), si("unit", dsi_unit(unit))]
            quantities.append(dcc("quantity", [text("name", f"{name}, {end}"), si("real", real)]))
    return dcc("data", quantities) if quantities else None
