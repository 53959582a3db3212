import dataclasses
import math
import re

import numpy as np
import pytest

import piga
from piga.calibration.weights import residual_angles
from piga.data import copy_example
from piga.reports.calibration.page import brief
from piga.reports.calibration.page import page as calibration_page
from piga.reports.calibration.tables import residual_quantity
from piga.reports.render.page import Table, page_html
from tests.reports.example import calibration
from tests.reports.render.test_page import Checker


def tables(page):
    return {
        section.anchor: [block for block in section.blocks if isinstance(block, Table)]
        for section in page.sections
    }


@pytest.fixture(scope="module")
def written(cal, tmp_path_factory):
    return cal.report(tmp_path_factory.mktemp("report") / "report.html")


def test_report_is_one_light_well_formed_file(written):
    text = written.read_text(encoding="utf-8")
    assert written.stat().st_size < 2_000_000
    parsed = Checker(text)
    assert not parsed.faults
    assert not parsed.stack
    assert len(parsed.all("figure")) == 6
    ids = [attrs["id"] for _, attrs in parsed.elements if "id" in attrs]
    assert len(ids) == len(set(ids))
    assert not re.search(r"\bnan\b|\binf\b", re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL))


def test_coefficients_are_rounded_by_their_uncertainty(cal):
    table = tables(calibration_page(cal))["coefficients"][0]
    rows = {row[0].text: [cell.text for cell in row] for row in table.cells}
    assert rows["scale_factor"][1:6] == ["0.8885092", "0.0000014", "0.0000027", "rad/s/g", "1.6 ppm"]
    assert rows["k0"][1:5] == ["1600.2", "1.1", "2.2", "µg"]
    assert rows["tan_beta"][1] == "3.5874\u00a0×\u00a010⁻⁴"
    assert any("β = 73.996(47)″" in note for note in table.notes)
    assert any("k2 is smaller than its own uncertainty" in note for note in table.notes)


def test_correlations_are_those_of_the_covariance(cal):
    cells = tables(calibration_page(cal))["coefficients"][1].cells
    expected = cal.covariance[1, 0] / math.sqrt(cal.covariance[0, 0] * cal.covariance[1, 1])
    assert float(cells[1][1].text.replace("−", "-")) == pytest.approx(expected, abs=0.005)


def test_budget_combines_the_sources(cal):
    sources, *parts = tables(calibration_page(cal))["budget"]
    cells, names = parts[0].cells, ["Fit to the record", "Reference scale", "Reference misalignment"]
    assert [row[0].text for row in sources.cells] == names
    assert [row[0].text for row in cells] == [*names, "Combined"]
    assert cells[-1][1].text == "9.0\u00a0×\u00a010⁻⁶"  # hypot(1.4e-6, 8.9e-6)
    assert parts[-2].cells[-1][-1].text == "9.8"  # hypot(1.3, 9.7) urad


def test_sensitivities_are_per_unit_of_the_source(cal):
    table = tables(calibration_page(cal))["budget"][3]
    assert [row[1].text for row in table.cells] == ["1 ppm", "1 ″"]
    assert table.cells[0][2].text == "8.90\u00a0×\u00a010⁻⁷"  # 8.9e-6 for 10 ppm
    assert table.cells[1][-1].text == "4.85"  # 9.7 urad for 2 arcsec


def test_a_phase_that_any_angle_would_do_for_is_not_determined():
    """-2 +- 11 rad is no number; 0.2 +- 0.4 rad is one."""
    for phase in ("shared", "per-segment"):
        cal = calibration(phases=phase, with_residuals=False)
        at = next(i for i, c in enumerate(cal.coefficients) if c.name == "phi")
        for value, std, shown in ((-2.0, 11.0, True), (0.2, 0.4, False)):
            row = dataclasses.replace(cal.coefficients[at], value=value, std=std)
            loose = dataclasses.replace(
                cal, coefficients=(*cal.coefficients[:at], row, *cal.coefficients[at + 1 :])
            )
            line = next(text for text in loose.summary().splitlines() if text.startswith("  phi"))
            assert ("not determined" in line) is shown
            assert ("11" in line) is False
            assert ("not determined" in page_html(calibration_page(loose))) is shown


def test_odd_numbers_do_not_break_the_page(cal):
    strange = dataclasses.replace(
        cal,
        residuals=None,
        surplus_observations=math.inf,
        condition=math.inf,
        residual_rms=0.0,
        covariance=np.zeros_like(cal.covariance),
        coefficients=tuple(dataclasses.replace(c, std=math.nan) for c in cal.coefficients),
    )
    text = page_html(calibration_page(strange))
    assert not re.search(r"\bnan\b|\binf\b", re.sub(r"<(script|style).*?</\1>", "", text, flags=re.DOTALL))


def test_a_log_of_rates_is_reported_as_rates():
    cal = calibration()
    rates = dataclasses.replace(cal, diagnostics=dataclasses.replace(cal.diagnostics, residual_kind="rate"))
    assert residual_quantity(rates) == ("residual rate", "arcsec/s")
    assert "arcsec/s" in page_html(calibration_page(rates))
    assert "arcsec/s, before" in rates.summary()
    angles = residual_angles(rates.residuals, "rate")
    first = slice(0, 50)
    step = np.diff(rates.residuals.t[first])
    wanted = np.cumsum(step * 0.5 * (rates.residuals.after[first][1:] + rates.residuals.after[first][:-1]))
    np.testing.assert_allclose(angles.after[1:50] - angles.after[0], wanted, rtol=1e-9, atol=1e-12)
    assert residual_angles(cal.residuals, cal.diagnostics.residual_kind) is cal.residuals


def test_page_and_terminal_list_the_same_tests(tmp_path):
    """Also of a record with a line in the order spectrum: that is named at its figure."""
    cal = piga.calibrate(piga.read_run(copy_example(tmp_path)))
    page = calibration_page(cal)
    assert page.judgement == brief(cal).judgement
    assert any("Line at order" in note for figure in page.figures() for note in figure.notes)
