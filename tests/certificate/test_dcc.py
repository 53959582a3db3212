"""The Digital Calibration Certificate: schema, Schematron, SI numbers, covariance, and the way back."""

from __future__ import annotations

import base64
import datetime as dt
import json
import math
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy import stats

from piga.calibration.uncertainty import with_given_servo
from piga.certificate.certificate_file import ConformityTable
from piga.certificate.dcc import dsi_unit, to_dsi
from piga.errors import PigaError
from piga.records.calibration.coefficient import Coefficient, joint_factor
from piga.records.calibration.diagnostics import Diagnostics
from piga.records.calibration.document import to_document
from piga.records.terms import UNITS, si_factor, unit_of
from tests.certificate.certificate_data import SCHEMAS, budgeted, changed, complete
from tests.reports.example import calibration

etree = pytest.importorskip("lxml.etree")

from piga.certificate.dcc import calibration_of, dcc_document, read_dcc, written  # noqa: E402

N = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}
needs_schemas = pytest.mark.skipif(
    not SCHEMAS.is_dir(), reason="the DCC schema files are not beside the project"
)


@pytest.fixture(scope="module")
def per_segment():
    result = calibration(phases="per-segment", with_residuals=False)
    return replace(
        result,
        coefficients=tuple(
            replace(c, segment="position 7 / up é") if c.segment == "7" else c for c in result.coefficients
        ),
    )


def all_terms(cal):
    """The calibration with every coefficient name there is."""
    names = [*UNITS, "s1", "c1", "s12", "c12"]
    rng = np.random.default_rng(3)
    values = rng.normal(0, 1, len(names)) * 10.0 ** rng.integers(-9, 1, len(names))
    values[names.index("tan_beta")] = 3e-4
    mixing = rng.normal(0, 1, (len(names), len(names)))
    spread = np.abs(values) * 1e-3
    shape = mixing @ mixing.T
    covariance = shape / np.sqrt(np.outer(np.diag(shape), np.diag(shape))) * np.outer(spread, spread)
    kind = type(cal.coefficients[0])
    coefficients = tuple(
        kind(name, float(v), float(s), unit_of(name)) for name, v, s in zip(names, values, spread, strict=True)
    )
    terms = tuple(name for name in names if name != "phi")
    return replace(cal, coefficients=coefficients, covariance=covariance, terms=terms)


def document(cal, **tables):
    return written(dcc_document(changed(complete(), **tables), cal))


def back(raw, tmp_path):
    path = tmp_path / "certificate.xml"
    path.write_bytes(raw)
    return read_dcc(path)


def problems(raw):
    schema = etree.XMLSchema(etree.parse(str(SCHEMAS / "v3.3.0" / "dcc.xsd")))
    schema.validate(etree.fromstring(raw))
    return [str(entry) for entry in schema.error_log]


@needs_schemas
@pytest.mark.parametrize("kind", ["plain", "per-segment", "all terms", "stated"])
def test_valid_by_schema_and_schematron(cal, per_segment, stated, kind):
    pytest.importorskip("saxonche")
    from tests.certificate.schematron import findings

    used = {"per-segment": per_segment, "all terms": all_terms(cal)}.get(kind, cal)
    raw = stated if kind == "stated" else document(used)
    assert problems(raw) == []
    result = findings(SCHEMAS / "schematron" / "dcc.sch", raw)
    assert "error" not in result
    # the rule warns of every list with more than one unit, whether the units are alike or not
    assert all("Redundant unit" in warning for warning in result.get("warning", []))


@needs_schemas
def test_the_checks_can_fail():
    pytest.importorskip("saxonche")
    from tests.certificate.schematron import findings

    rules = SCHEMAS / "schematron" / "dcc.sch"
    assert problems((SCHEMAS / "example-valid.xml").read_bytes()) == []
    assert problems((SCHEMAS / "example-invalid-schema.xml").read_bytes())
    assert "error" not in findings(rules, (SCHEMAS / "example-valid.xml").read_bytes())
    assert findings(rules, (SCHEMAS / "example-invalid-schematron.xml").read_bytes())["error"]


def test_back_to_the_bit(cal, per_segment, tmp_path):
    for used in (cal, per_segment, all_terms(cal)):
        result = back(document(used), tmp_path)
        assert to_document(result) == to_document(used)
        assert np.array_equal(result.covariance, used.covariance)


def test_a_given_servo_without_an_uncertainty_comes_back(cal, tmp_path):
    exact = with_given_servo(budgeted(cal), {"servo": 1.3e-7}, {})
    raw = document(exact)
    again = back(raw, tmp_path)
    assert (again["servo"].value, again["servo"].std) == (exact["servo"].value, 0.0)


def test_conditions_are_si(cal):
    """20.3 degC is 293.45 K without binary artefacts, its expanded uncertainty 0.4 K; 46 % is 0.46."""
    root = etree.fromstring(document(cal))
    values = {}
    for condition in root.iterfind(".//dcc:influenceCondition", N):
        real = condition.find(".//si:real", N)
        texts = [real.findtext(f".//si:{name}", "", N) for name in ("value", "unit", "valueExpandedMU")]
        values[condition.findtext("dcc:name/dcc:content", "", N)] = tuple(texts)
    assert values["Air temperature"] == ("293.45", r"\kelvin", "0.4")
    assert float(values["Relative humidity"][0]) == pytest.approx(0.46, abs=1e-16)
    gravity, unit, expanded = values["Local gravity"]
    assert (float(gravity), unit, float(expanded)) == (9.80166, r"\metre\second\tothe{-2}", 2e-6)


def test_numbers_are_si(cal):
    root = etree.fromstring(document(cal))
    seen = {}
    for real in root.iterfind(".//dcc:list/dcc:quantity/si:real", N):
        seen[real.findtext("si:label", "", N)] = real
    k2, scale = seen["k2"], seen["scale_factor"]
    assert k2.findtext("si:unit", "", N) == r"\metre\tothe{-1}\second\tothe{2}"
    assert float(k2.findtext("si:value", "", N)) == pytest.approx(cal["k2"].value / 9.80665, rel=1e-15)
    assert scale.findtext("si:unit", "", N) == r"\metre\tothe{-1}\second\radian"
    assert float(scale.findtext("si:value", "", N)) == pytest.approx(
        cal["scale_factor"].value / 9.80665, rel=1e-15
    )
    assert "nonSI" not in document(cal).decode()
    expanded = scale.find(".//si:expandedMU", N)
    k = stats.norm.ppf(0.975)  # the made-up coefficients have infinitely many degrees of freedom
    assert float(expanded.findtext("si:coverageFactor", "", N)) == pytest.approx(k, abs=1e-6)
    u = float(expanded.findtext("si:valueExpandedMU", "", N))
    assert u == pytest.approx(k * cal["scale_factor"].std / 9.80665, rel=1e-12)


def test_covariance_is_multivariate_uncertainty_in_products_of_units(cal):
    root = etree.fromstring(document(cal))
    columns = root.findall(".//si:ellipsoidalRegionMUXMLList/si:covarianceMatrixXMLList/si:columnXMLList", N)
    keys = [c.key for c in cal.coefficients]
    i, j = keys.index("k0"), keys.index("m_Y")
    column = columns[j].find("si:covarianceXMLList", N)
    assert column.findtext("si:unitXMLList", "", N).split()[i] == r"\metre\second\tothe{-2}\radian"
    value = float(column.findtext("si:valueXMLList", "", N).split()[i])
    assert value == pytest.approx(cal.covariance[i, j] * 9.80665, rel=1e-14)


def few(*degrees):
    return [Coefficient(f"k{i}", 0.0, 1.0, "g", degrees_of_freedom=nu) for i, nu in enumerate(degrees)]


def test_joint_factor():
    assert joint_factor(few(10.0)) == pytest.approx(stats.t.ppf(0.975, 10))
    assert joint_factor(few(math.inf, math.inf, math.inf)) == pytest.approx(math.sqrt(stats.chi2.ppf(0.95, 3)))
    assert joint_factor(few(12.0, math.inf, 40.0)) == pytest.approx(math.sqrt(3 * stats.f.ppf(0.95, 3, 12)))


@pytest.mark.parametrize("degrees", [(4.0, 4.0, 4.0), (4.0, 12.0, 60.0), (4.0, 1e6, 1e6, 1e6, 1e6, 1e6)])
def test_joint_region_holds_95_percent(degrees):
    """Drawn from the definition: independent errors, each with its own estimated variance, or one for all."""
    rng, draws = np.random.default_rng(5), 100_000
    error = rng.standard_normal((draws, len(degrees)))
    each = np.array([rng.chisquare(nu, draws) / nu for nu in degrees]).T
    limit = joint_factor(few(*degrees)) ** 2
    apart = np.mean(np.sum(error**2 / each, axis=1) <= limit)
    together = np.mean(np.sum(error**2, axis=1) / each[:, 0] <= limit)
    assert together == pytest.approx(0.95, abs=0.003)  # four standard deviations of the draw
    assert apart > 0.947
    by_rows = math.sqrt(stats.chi2.ppf(0.95, len(degrees)))
    assert np.mean(np.sum(error**2, axis=1) / each[:, 0] <= by_rows**2) < 0.9


@pytest.mark.parametrize("name", [*UNITS, "s1", "c3"])
def test_every_unit_of_a_coefficient_is_si(name):
    assert float(to_dsi(1.7, unit_of(name))) == pytest.approx(1.7 * si_factor(name), rel=1e-15)


def test_units_of_the_digital_si():
    assert dsi_unit("1") == r"\one"
    assert dsi_unit("rad") == r"\radian"
    assert dsi_unit("g/K") == r"\metre\second\tothe{-2}\kelvin\tothe{-1}"
    assert dsi_unit("g", "g/g^2") == r"\one"
    assert dsi_unit("hPa") == r"\metre\tothe{-1}\second\tothe{-2}\kilogram"
    assert dsi_unit("count/s/g") == r"\metre\tothe{-1}\second"
    assert dsi_unit("V/g") == r"\metre\tothe{-1}\second\tothe{2}\volt"
    assert dsi_unit("mA/g", "g") == r"\ampere"


@pytest.fixture(scope="module")
def stated(cal):
    """A certificate that states all there is: ranges, conformity, statements, results before adjustment, an interval."""
    by_interval = replace(cal.coefficients[3], interval=(1.5001e-3, 1.70035e-3))
    used = replace(
        cal,
        coefficients=(*cal.coefficients[:3], by_interval, *cal.coefficients[4:]),
        diagnostics=Diagnostics(range={"a_x": (-9.8, 9.8), "temperature": (293.0, 295.5)}),
    )
    rule = ConformityTable(
        specification="S 1",
        rule="simple",
        agreed_with_customer=True,
        limits={"k0": ("-5 mg", "5 mg"), "m_Y": ("-1 urad", "1 mrad")},
    )
    opinion = {"opinions": "stable", "opinions_by": "A", "remarks": "a <b> & c", "interval_agreed": True}
    data = changed(
        complete(),
        adjustment={"performed": True},
        certificate={"replaces": "old 1", "amendment": "k0"},
        statements=opinion | {"recalibrate": dt.date(2027, 3, 9)},
    )
    return written(dcc_document(msgspec.structs.replace(data, conformity=rule), used, cal))


def real_of(key, kind="basic_measuredValue"):
    return f".//dcc:result[@refType='{kind}']//si:real[si:label='{key}']"


def sentence(title):
    return f".//dcc:statement[dcc:name/dcc:content='{title}']/dcc:declaration/dcc:content"


CORE = "dcc:administrativeData/dcc:coreData/dcc:"
ALTERED = [
    (f"{real_of('scale_factor')}/si:value", "0.09060", "value of scale_factor is '0.09060'"),
    (f"{real_of('k2')}/si:label", "k3", "label of k3 is 'k3', by the attached records 'k2'"),
    (f"{real_of('m_Y')}//si:valueExpandedMU", "2.6E-6", "valueExpandedMU of m_Y is"),
    (f"{real_of('k0')}//si:intervalMin", "0.01569", "intervalMin of k0 is"),
    (f"{CORE}issueDate", "2025-03-09", "issueDate is '2025-03-09', by the attached records '2026-03-09'"),
    (f"{real_of('m_Y')}/../dcc:measurementMetaData//dcc:conformity", "fail", "conformity of m_Y is 'fail'"),
    (".//dcc:statement/dcc:data/dcc:quantity/si:real/si:value", "-98.0", "quantity/real/value is"),
    (sentence("Range"), "The results hold in any range.", "declaration/content is"),
    (sentence("Conformity"), "Overall: does not conform.", "declaration/content is"),
    (sentence("Amendment"), "This certificate replaces certificate old 2.", "declaration/content is"),
]  # fmt: skip


@pytest.mark.parametrize(("query", "text", "words"), ALTERED)
def test_an_altered_statement_contradicts_the_attached_records(stated, query, text, words):
    root = etree.fromstring(stated)
    node = root.xpath(query, namespaces=N)[0]
    assert node.text != text
    node.text = text
    with pytest.raises(PigaError, match=f"contradicts itself: .*{words}"):
        calibration_of(root, Path("forged.xml"))


def test_rounding_of_quantiles_alone_is_accepted(stated):
    root = etree.fromstring(stated)
    node = root.xpath(f"{real_of('m_Y')}//si:coverageFactor", namespaces=N)[0]
    node.text = f"{float(node.text) + 1e-6:.6f}"
    calibration_of(root, Path("x.xml"))


def test_another_release_may_use_other_words(stated):
    root = etree.fromstring(stated)
    for node in root.iterfind(".//dcc:software/dcc:release", N):
        node.text = "v9.9.9"
    root.xpath(sentence("Sampling"), namespaces=N)[0].text = "Plan of sampling: not applicable."
    calibration_of(root, Path("x.xml"))
    root.find(".//dcc:result[@refType='basic_measuredValue']//si:real/si:value", N).text = "0.0906"
    with pytest.raises(PigaError, match="contradicts itself"):
        calibration_of(root, Path("x.xml"))


def test_a_certificate_without_its_data_is_refused(stated):
    root = etree.fromstring(stated)
    data = root.find(".//dcc:byteData[@refType='piga_certificateData']", N)
    result = data.getparent().getparent()
    result.getparent().remove(result)
    with pytest.raises(PigaError, match=r"lacks the attached data(?s:.*)piga 0\.2 with that version"):
        calibration_of(root, Path("x.xml"))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            b"<dcc:results>",
            b"<dcc:results><dcc:result><dcc:name/><dcc:data/></dcc:result>",
            "is not there as piga writes it",
        ),
        (
            b"</dcc:coreData>",
            b"<dcc:issueDate>2026-03-10</dcc:issueDate></dcc:coreData>",
            "is not there as piga writes it",
        ),
        (b"<si:label>k2</si:label>", b"<si:label>k2</si:label>is 3", "label of k2 is not there"),
        (b"<si:label>k2<", b"<si:label>k2<!-- 0 --><", "label of k2 is not there"),
        (b"<si:label>k2<", b"<si:label value='3'>k2<", "label of k2 is not there"),
        (
            b"<dcc:digitalCalibrationCertificate",
            b"<?xml-stylesheet href='x.xsl'?><dcc:digitalCalibrationCertificate",
            "instructions",
        ),
        (b"digitalCalibrationCertificate", b"digitalCalibration", "not a Digital Calibration Certificate"),
        (b'schemaVersion="3.3.0"', b'schemaVersion="4.0.0"', "DCC version '4.0.0'"),
        (b"piga_calibrationRecord", b"other", "no calibration record"),
        (b"<dcc:dataBase64>e", b"<dcc:dataBase64>!", "record is damaged"),
        (b"<si:valueStandardMUXMLList>1", b"<si:valueStandardMUXMLList>2", "valueStandardMUXMLList is"),
        (
            b"<si:columnXMLList>",
            b"<si:columnXMLList/><si:columnXMLList>",
            "covarianceMatrixXMLList is not there",
        ),
    ],
)
def test_a_certificate_has_one_form(stated, old, new, words):
    assert old in stated
    raw = stated.replace(old, new) if b"Certificate" in old else stated.replace(old, new, 1)
    with pytest.raises(PigaError, match=words):
        calibration_of(etree.fromstring(raw), Path("forged.xml"))


@pytest.mark.parametrize("limits", [{"k9": ["-1 g", "1 g"]}, {"k0": ["-1 s", "1 s"]}, {"k0": ["x"]}])
def test_attached_data_that_do_not_fit_are_refused(stated, limits):
    root = etree.fromstring(stated)
    node = root.find(".//dcc:byteData[@refType='piga_certificateData']/dcc:dataBase64", N)
    data = json.loads(base64.b64decode(node.text))
    data["conformity"]["limits"] = limits
    node.text = base64.b64encode(json.dumps(data).encode()).decode()
    with pytest.raises(PigaError):
        calibration_of(root, Path("forged.xml"))
