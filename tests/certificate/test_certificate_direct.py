"""Certificates of direct instruments: the unit of the output on paper and in the DCC."""

from __future__ import annotations

import datetime as dt
import re
from pathlib import Path

import msgspec
import pytest

import piga
from piga.certificate.certificate_file import ConformityTable
from piga.certificate.dcc import calibration_of, dcc_document
from piga.certificate.page import certificate_html
from tests.calibration.direct import Tumble
from tests.certificate.certificate_data import changed, complete

pytestmark = pytest.mark.filterwarnings("ignore::piga.errors.CalibrationWarning")


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> piga.Calibration:
    folder = tmp_path_factory.mktemp("certified")
    return piga.calibrate(piga.read_run(Tumble().write(folder, "rate", "mA", "0.6 mA/g")))


def test_paper_and_dcc_state_the_unit_of_the_output(result: piga.Calibration) -> None:
    rule = ConformityTable(
        specification="SPEC-1",
        rule="guarded",
        agreed_with_customer=True,
        limits={"scale_factor": ("590 uA/g", "610 uA/g")},
    )
    today = changed(complete("QA-1", gravity="9.80665"), certificate={"issued": dt.datetime.now(dt.UTC).date()})
    data = msgspec.structs.replace(today, conformity=rule)
    shown = re.sub(r"<[^>]*>", " ", certificate_html(data, result).partition("<body>")[2])
    assert "mA/g" in shown
    assert "conforms" in shown
    for word in ("rad/s", "gimbal", "ml/H"):
        assert word not in shown
    root = dcc_document(data, result)
    scale = root.xpath("//*[local-name()='label'][.='scale_factor']/..")[0]
    value, unit = (scale.xpath(f"*[local-name()='{name}']")[0].text for name in ("value", "unit"))
    assert float(value) == pytest.approx(result["scale_factor"].value * 1e-3 / 9.80665, rel=1e-15)
    assert unit == r"\metre\tothe{-1}\second\tothe{2}\ampere"
    back = calibration_of(root, Path("c.xml"))
    assert (back.unit, back["scale_factor"].value) == ("mA", result["scale_factor"].value)
