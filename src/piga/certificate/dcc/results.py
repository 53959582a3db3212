"""Results of a Digital Calibration Certificate: method, conditions, coefficients one by one and jointly.

Coefficients stand in it twice: one by one with expanded uncertainty for any reader of certificates, and as one
vector with its covariance matrix (a multivariate uncertainty) for those who compute with them. ``g`` is
converted exactly; numbers carry all their digits, and ``significantDigit`` says which of them count.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable
from decimal import Decimal
from typing import TYPE_CHECKING

from piga.certificate.certificate_file import CertificateFile, ConditionTable, quantity_text, title_of
from piga.certificate.dcc.dsi_units import dsi_unit, power_of_g, significant_digit, to_dsi
from piga.certificate.dcc.elements import dcc, given, rich, si, software, text
from piga.certificate.dcc.reader import JOINT, RECORD, label_of
from piga.certificate.statements import verdicts
from piga.records.calibration import Calibration, Coefficient
from piga.records.calibration_json import calibration_to_bytes
from piga.records.coverage import PROBABILITY, joint_factor
from piga.units import parse_unit

if TYPE_CHECKING:
    from lxml import etree


def measurement_result(
    data: CertificateFile, calibration: Calibration, before: Calibration | None
) -> etree._Element:
    """How it was measured, under what conditions, and what came out."""
    results = []
    if before is not None:
        results.append(_coefficients("Coefficients before adjustment", before, {}, "basic_beforeAdjustment"))
    after = "" if before is None else " after adjustment"
    marks = {verdict.key: verdict.dcc for verdict in verdicts(data, calibration)}
    results.append(_coefficients(f"Coefficients{after}", calibration, marks, "basic_measuredValue"))
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
    found = []
    for standard in data.traceability.standard:
        shown = "; ".join(part for part in (standard.realises, standard.certificate) if part)
        identification = [
            dcc("issuer", "calibrationLaboratory"),
            given("value", standard.identification or standard.name),
        ]
        parts = [
            text("name", standard.name),
            rich("description", shown),
            dcc("identifications", [dcc("identification", identification)]),
        ]
        found.append(dcc("measuringEquipment", parts, "basic_normalUsed"))
    return dcc("measuringEquipments", found)


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
    """SI text of a number that a person wrote, without binary artefacts: 20.1 degC is 293.25 K."""
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


def _coefficients(title: str, calibration: Calibration, marks: dict[str, str], ref_type: str) -> etree._Element:
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
                            _words(to_dsi(v, p + powers[j]) for v, p in zip(column, powers, strict=True)),
                        ),
                        si("unitXMLList", _words(dsi_unit(unit, units[j]) for unit in units)),
                    ],
                )
            ],
        )
        for j, column in enumerate(calibration.covariance.T.tolist())
    ]
    spread = _words(to_dsi(c.std, p) for c, p in zip(calibration.coefficients, powers, strict=True))
    region = [
        si("covarianceMatrixXMLList", columns),
        si("coverageFactorXMLList", f"{joint_factor(calibration.coefficients):.6f}"),
        si("coverageProbabilityXMLList", str(PROBABILITY)),
    ]
    vector = [
        si("labelXMLList", _words(label_of(c.key) for c in calibration.coefficients)),
        si(
            "valueXMLList",
            _words(to_dsi(c.value, p) for c, p in zip(calibration.coefficients, powers, strict=True)),
        ),
        si("unitXMLList", _words(dsi_unit(unit) for unit in units)),
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


def _words(parts: Iterable[str]) -> str:
    return " ".join(parts)


def _record(calibration: Calibration) -> etree._Element:
    """The whole record as an attachment: what it takes to read the certificate back into a calibration."""
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
