import colorsys
import dataclasses
import math
import re

import numpy as np
import pytest

from piga.calibration.orders import residual_angles
from piga.records.calibration import Amount, Outlier, Residuals, RunRecord, SegmentLeverage
from piga.records.run_file import ASSUMED_SOURCES, UncertaintyTable
from piga.reports.calibration.budget import SOURCES, budget_tables, source_in_words
from piga.reports.calibration.figures import (
    budget_figure,
    calibration_figures,
    convergence_figure,
    elapsed_time,
    residual_figure,
)
from piga.reports.calibration.page import page as calibration_page
from piga.reports.calibration.tables import (
    leverage_tables,
    residual_quantity,
)
from piga.reports.render.figure import LIGHT
from piga.reports.render.interactive import figure_spec
from piga.reports.render.numbers import ascii_text
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
    assert len(parsed.all("figure")) == 7
    ids = [attrs["id"] for _, attrs in parsed.elements if "id" in attrs]
    assert len(ids) == len(set(ids))
    assert not re.search(r"\bnan\b|\binf\b", re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL))


def test_every_axis_has_quantity_and_unit(cal):
    for figure in calibration_figures(cal).values():
        assert figure.caption
        for panel in figure.panels:
            for axis in (panel.x, panel.y):
                assert axis.quantity
                assert axis.unit


def test_coefficients_are_rounded_by_their_uncertainty(cal):
    table = tables(calibration_page(cal))["coefficients"][0]
    rows = {row[0].text: [cell.text for cell in row] for row in table.cells}
    assert rows["scale_factor"][1:6] == ["0.8885092", "0.0000014", "0.0000027", "rad/s/g", "1.6 ppm"]
    assert rows["k0"][1:5] == ["1600.2", "1.1", "2.2", "µg"]
    assert rows["tan_beta"][1] == "3.5874\u00a0×\u00a010⁻⁴"
    assert any("β = 73.996(47)″" in note for note in table.notes)
    assert any("k2 is smaller than its own uncertainty" in note for note in table.notes)


def test_expanded_uncertainty_uses_student(cal):
    coefficients = tuple(dataclasses.replace(c, degrees_of_freedom=6.0) for c in cal.coefficients)
    few = dataclasses.replace(cal, coefficients=coefficients)
    row = tables(calibration_page(few))["coefficients"][0].cells[0]
    assert row[3].text == "0.0000034"  # 2.447 times 1.4e-6


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
    assert parts[-1].cells[-1][-1].text == "9.8"  # hypot(1.3, 9.7) urad


def with_sensitivities(cal):
    """The budget with sensitivities, as calibrations write it."""
    rows = []
    for row in cal.budget:
        source = row.standard_uncertainty
        result = {
            c.key: Amount(row.contributions[c.key] / source.value, f"{c.unit}/{source.unit}")
            for c in cal.coefficients
            if c.key in row.contributions
        }
        rows.append(dataclasses.replace(row, sensitivities=result))
    return dataclasses.replace(cal, budget=tuple(rows))


def test_sensitivities_are_per_unit_of_the_source(cal):
    assert len(tables(calibration_page(cal))["budget"]) == 3, "a record of before has none"
    table = tables(calibration_page(with_sensitivities(cal)))["budget"][3]
    assert [row[1].text for row in table.cells] == ["1 ppm", "1 ″"]
    assert table.cells[0][2].text == "8.90\u00a0×\u00a010⁻⁷"  # 8.9e-6 for 10 ppm
    assert table.cells[1][-1].text == "4.85"  # 9.7 urad for 2 arcsec


def test_the_budget_on_the_terminal_is_that_of_the_page(cal):
    lines = cal.summary().splitlines()
    budget = lines[lines.index("Uncertainty budget") :]
    for table in budget_tables(cal):
        for row in table.cells:
            words = [ascii_text(cell.text) for cell in row if cell.text]
            assert any(all(word in line for word in words) for line in budget), words


def test_report_without_residuals_still_stands():
    page = calibration_page(calibration(with_residuals=False))
    text = page_html(page)
    assert [figure.key for figure in page.figures()] == ["segment-rms", "budget-shares"]
    assert "The residuals are not part of this record" in text


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


def test_phase_per_segment_stands_in_the_segment_table():
    page = calibration_page(calibration(phases="per-segment", with_residuals=False))
    table = tables(page)["segments"][0]
    assert table.columns[-1].heading == "Phase φ"
    assert table.cells[3][-1].text == "0.3000(30)"
    assert "phi" not in [row[0].text for row in tables(page)["coefficients"][0].cells]


def test_a_hostile_serial_stays_text():
    cal = calibration(serial="<script>alert(1)</script>", with_residuals=False)
    text = page_html(calibration_page(cal))
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text


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


def test_curves_break_between_segments_and_at_holes(cal):
    residuals = cal.residuals
    keep = (residuals.t < 20.0) | (residuals.t > 40.0)
    cut = dataclasses.replace(
        residuals,
        **{
            field.name: values[keep]
            for field in dataclasses.fields(residuals)
            if isinstance(values := getattr(residuals, field.name), np.ndarray)
        },
    )
    gaps = np.isnan(residual_figure(cut).panels[1].series[0].arrays()[1]).sum()
    assert gaps == 24


def test_clock_that_starts_again_in_each_segment_gives_rising_time(cal):
    residuals = cal.residuals
    again = dataclasses.replace(residuals, t=residuals.t % 70.0)
    assert np.all(np.diff(elapsed_time(again)) >= 0.0)


def test_convergence_figure_shows_every_coefficient_with_its_band():
    cal = calibration()
    samples = np.geomspace(100.0, 28_000.0, 50)
    history = {"sample": samples}
    for c in cal.coefficients:
        history |= {
            c.key: c.value + c.std * (100.0 / samples - 100.0 / 28_000.0),
            f"u({c.key})": c.std * 30.0 / np.sqrt(samples),
        }
    figure = convergence_figure(dataclasses.replace(cal, history=history))
    assert [panel.title for panel in figure.panels] == [c.key for c in cal.coefficients]
    for panel, c in zip(figure.panels, cal.coefficients, strict=True):
        band, curve = panel.series
        assert band.upper is not None
        assert panel.x.quantity
        assert panel.y.quantity
        last = curve.arrays()[1][-1]
        wanted = (0.0,) if c.name == "scale_factor" else (c.value, 1e6 * c.value)
        assert any(last == pytest.approx(value, rel=1e-9, abs=1e-7) for value in wanted)
    page = page_html(calibration_page(dataclasses.replace(cal, history=history)))
    assert "Convergence" in page


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


def test_joint_and_contaminated_runs_have_their_sections(cal):
    """Runs with noise and residual figure each; findings with time, miss and a figure."""
    residuals = cal.residuals
    record = RunRecord(
        "head", "head.toml", "dividing-head", "shared", True, 10, 1e-5, 1e-6, 1e-5, 1e-3, 2e-3, 5e-5, cal.quality,
        ("k0", "k2"),
    )  # fmt: skip
    half = (np.arange(residuals.t.size) >= residuals.t.size // 2).astype(np.int32)
    outliers = (Outlier("spike", 1.5, 31, 1, 1e-3, "head"), Outlier("jump", 2.5, 51, 0, 0.3, "spun"))
    joint = dataclasses.replace(
        cal,
        runs=(record, dataclasses.replace(record, name="spun", raw=False)),
        residuals=dataclasses.replace(residuals, run=half),
        outliers=outliers,
    )
    page = calibration_page(joint)
    keys = [figure.key for figure in page.figures()]
    assert keys[:2] == ["residual-time-0", "residual-time-1"]
    assert "outliers" in keys
    runs = next(section for section in page.sections if section.anchor == "runs")
    assert [row[0] for row in runs.blocks[1].rows] == ["head", "spun (summary)"]
    quality = next(section for section in page.sections if section.anchor == "quality")
    assert [row[1] for row in quality.blocks[-1].rows] == ["jump", "spike"]
    assert "spun (summary)" in joint.summary()


def test_every_source_of_a_run_file_has_words():
    entries = {field for field in UncertaintyTable.__struct_fields__ if field not in ("reference_id", "waived")}
    assert entries | set(ASSUMED_SOURCES) == set(SOURCES)
    assert source_in_words("levelling axis 1") == "levelling of the stand (levelling axis 1)"
    assert source_in_words("fit residuals (repeatability)") == "fit residuals (repeatability)"


def test_an_outline_says_how_many_rows_it_shows() -> None:
    """Every point of a reduced curve has its row, and the note counts points and rows."""
    count = 30_000
    rng = np.random.default_rng(1)
    zeros = np.zeros(count)
    residuals = Residuals(
        np.arange(2, count + 2), np.arange(count) * 0.05, zeros, zeros, rng.normal(size=count), rng.normal(size=count),
        zeros, np.zeros(count, dtype=np.int32),
    )  # fmt: skip
    figure = residual_figure(residuals)
    for panel in figure.panels:
        series = panel.series[0]
        x, y = series.arrays()
        rows = np.asarray(series.rows)
        assert rows.size == x.size
        np.testing.assert_allclose((rows - 2) * 0.05, x)
        assert np.isfinite(y).sum() < 2000
    assert "of 30000 rows" in figure.notes[0]
    assert figure_spec(figure)["data"][0]["customdata"][0] == 2
    names = ("row", "t", "psi", "a_x", "before", "after", "innovation", "segment")
    short = dataclasses.replace(residuals, **{name: getattr(residuals, name)[:500] for name in names})
    assert residual_figure(short).notes == ()


def figure_of(cal, key):
    return next(figure for figure in calibration_figures(cal).values() if figure.key == key)


def test_every_point_of_a_segment_knows_its_segment(cal):
    """Each point of the figures against the samples and the summary of the segment that it names."""
    residuals = cal.residuals
    for panel in figure_of(cal, "residual-time").panels:
        series = panel.series[0]
        own = residuals.segment[np.asarray(series.rows) - 1]
        np.testing.assert_array_equal(series.segments, own)
    for trace in figure_spec(figure_of(cal, "segment-rms"))["data"]:
        for x, segment in zip(trace["x"], trace["meta"], strict=True):
            assert x == pytest.approx(cal.segments[segment].mean_a_x / 9.80665, abs=1e-5)
    for panel in tables(calibration_page(cal))["segments"]:
        assert [cal.segments[k].label for k in panel.segments] == [row[0] for row in panel.rows]


def test_the_allan_deviation_of_one_segment_is_from_its_own_samples(cal):
    """By the definition of [Riley2008], eq. 11, from the samples of segment 7 alone."""
    (panel,) = figure_of(cal, "allan").panels
    own = dict(panel.of_segments)
    assert list(own) == list(range(24))
    angle = cal.residuals.after[cal.residuals.segment == 7] / (math.pi / 648000.0)
    tau, deviation = own[7].arrays()
    for at in (0, tau.size // 2, tau.size - 1):
        m = round(tau[at] / 0.05)
        second = angle[2 * m :] - 2.0 * angle[m:-m] + angle[: -2 * m]
        wanted = math.sqrt(np.mean(second**2) / (2.0 * (0.05 * m) ** 2))
        assert deviation[at] == pytest.approx(wanted, rel=1e-6)


def test_leverage_rows_name_their_segments_and_a_name_that_is_there_twice_names_none(cal):
    row = SegmentLeverage(0.5, {"k0": 0.1}, {"k0": 0.2})
    leverage = {"5": row, "3": row}
    with_rows = dataclasses.replace(cal, diagnostics=dataclasses.replace(cal.diagnostics, leverage=leverage))
    assert leverage_tables(with_rows)[0].segments == (5, 3)
    twice = tuple(dataclasses.replace(s, label="3") if s.label == "9" else s for s in cal.segments)
    assert leverage_tables(dataclasses.replace(with_rows, segments=twice))[0].segments == (5, None)


def test_sources_of_the_budget_have_colours_of_their_own(cal):
    rows = tuple(dataclasses.replace(cal.budget[0], source=f"source {k}") for k in range(6))
    figure = budget_figure(dataclasses.replace(cal, budget=rows))
    hues = {
        round(24 * colorsys.rgb_to_hsv(*(int(LIGHT[one.role][i : i + 2], 16) / 255 for i in (1, 3, 5)))[0])
        if one.role not in ("reference", "muted")
        else one.role
        for one in figure.panels[0].series
    }
    assert len(hues) == len(figure.panels[0].series) == 6
