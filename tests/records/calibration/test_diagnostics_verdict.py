"""One verdict: the same doubts at the top of page, terminal, repr and JSON, and as warnings in Python."""

from __future__ import annotations

import html
import json
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

import piga
from piga.records.calibration.coefficient import NO_REFERENCE, BudgetEntry
from piga.records.calibration.diagnostics import SEPARATED, WELL_SEPARATED, Event, Quality, verdict
from piga.records.calibration.document import calibration_to_bytes
from piga.reports.calibration.page import page as calibration_page
from piga.reports.render.page import page_html
from piga.units import G0
from tests.reports.example import calibration

K = 0.8884 / G0


def rate_log(f_unit: float = 1.0, harmonic: float = 0.0, **options) -> piga.Run:
    """Rates with white noise of 2e-7 rad/s; ``f_unit`` divides the force, ``harmonic`` [rad/s] is left in."""
    rng = np.random.default_rng(1)
    a = G0 * np.cos(np.linspace(0.1, 6.0, 400))
    f = np.column_stack([a, np.zeros(400), np.zeros(400)])
    rate = K * (a + 300e-6 * G0) + 2e-7 * rng.standard_normal(400)
    rate = rate + harmonic * np.sin(np.arange(400) / 7.0)
    about = {"scale_factor": "0.8884 rad/s/g", "kind": "rate", "serial": "G-1", "units": "SI"}
    return piga.Run.from_arrays(np.arange(400.0), rate, f / f_unit, **about, **options)


WAIVED = dict.fromkeys(
    ("reference_bias", "reference_misalignment", "timing", "vibration", "earth_rate"),
    "simulated: there is none",
)
KNOWN = {"reference_scale": "1 ppm", "waived": WAIVED}
TERMS = ["scale_factor", "k0"]
CONTAINS = "he uncertainties contain Type A and 0 of"


@pytest.fixture(scope="module")
def sound() -> piga.Calibration:
    return piga.calibrate(rate_log(uncertainty=KNOWN), TERMS, "rate")


@pytest.fixture(scope="module")
def coloured() -> piga.Calibration:
    return piga.calibrate(rate_log(uncertainty=KNOWN, harmonic=4e-7), TERMS, "rate")


@pytest.fixture(scope="module")
def alone() -> piga.Calibration:
    return piga.calibrate(rate_log(), TERMS, "rate")


def body(page: str) -> str:
    """Text of a page, white space made single."""
    text = re.sub(r"<(script|style).*?</\1>", " ", page[page.index("<body>") :], flags=re.DOTALL)
    return " ".join(html.unescape(re.sub("<[^>]*>", " ", text)).split())


def test_a_sound_calibration_is_clear_and_warns_of_nothing(sound):
    assert sound.verdict.grade == "clear"
    assert sound.verdict.doubts == ()
    assert "Clear: no doubt in what was tested; Type A and 1 of 1 sources." in sound.summary().splitlines()[0]
    assert "not tested: a change of the bias as slow as the test" in sound.summary()
    assert "waived, not in the uncertainties: reference_bias (simulated: there is none)" in sound.summary()
    with warnings.catch_warnings():
        warnings.simplefilter("error", piga.PigaWarning)
        piga.calibrate(rate_log(uncertainty=KNOWN), TERMS, "rate")


def of_one_phase(result: piga.Calibration) -> piga.Calibration:
    """The result with a phase of one segment, whose interval comes from the noise within it, and correlated residuals."""
    phase = replace(result["k0"], name="phi", segment="a")
    tests = replace(result.diagnostics, lag1_correlation=0.6)
    return replace(result, coefficients=(*result.coefficients, phase), diagnostics=tests)


def test_coloured_residuals_are_said_and_move_no_interval_by_the_scatter_of_the_positions(coloured):
    assert coloured.diagnostics.verdict != "white"
    assert coloured.verdict.grade == "clear"
    for key, true in (("scale_factor", K * G0), ("k0", 300e-6)):
        low, high = coloured[key].limits
        assert low < true < high
    said = "the whitened residuals are not white (Ljung-Box, p "
    assert any(
        words.startswith(said) for words in json.loads(calibration_to_bytes(coloured))["verdict"]["tested"]
    )


def test_coloured_residuals_are_a_doubt_where_the_noise_within_a_position_gives_an_interval(coloured):
    result = of_one_phase(coloured)
    (doubt,) = result.verdict.doubts
    assert doubt.what.endswith("intervals from the noise within one position are about 2 times too small")
    said = "he whitened residuals are not white (Ljung-Box, p "
    text = body(page_html(calibration_page(result)))
    assert 0 < text.index(said) < text.index("Data used"), "the verdict stands above the tiles"
    white = replace(result, diagnostics=replace(result.diagnostics, lag1_correlation=0.3))
    assert white.verdict.grade == "clear"
    found = replace(result, notes=("a creep after each move: leave out the first 22 s",))
    assert found.verdict.reason == "a creep after each move: leave out the first 22 s"
    assert found.verdict.doubts[1:] == (doubt,)


def test_residuals_of_an_older_version_are_judged_by_its_rule(coloured):
    """Before 0.3 the intervals came from a model of the noise."""
    old = replace(of_one_phase(coloured), coefficients=coloured.coefficients)
    assert old.verdict.grade == "clear"
    old = replace(old, provenance=replace(old.provenance, software="piga 0.2.0"))
    assert old.verdict.grade == "doubt"
    rough = replace(old, diagnostics=replace(old.diagnostics, variance=1.5, lag1_correlation=0.0))
    assert "root mean square of 1.225 instead of 1" in rough.verdict.reason


def test_the_verdict_is_the_same_after_reading_back(coloured, tmp_path):
    coloured.to_json(tmp_path / "c.json")
    assert piga.Calibration.from_json(tmp_path / "c.json").verdict == coloured.verdict


def test_without_uncertainty_every_output_says_which_sources_u_contains(alone):
    """And none says expanded, but for the key of the file: it has one name with and without a stated budget."""
    with pytest.warns(piga.PigaWarning, match=CONTAINS):
        piga.calibrate(rate_log(), TERMS, "rate")
    outputs = {
        "terminal": " ".join(alone.summary().split()),
        "page": body(page_html(calibration_page(alone))),
        "json": calibration_to_bytes(alone).decode(),
        "repr": " ".join(repr(alone).split()),
    }
    for name, text in outputs.items():
        assert CONTAINS in text, name
        assert "expanded" not in text.replace('"expanded":', "").lower(), name
    from piga.certificate.certificate_file import missing_items
    from tests.certificate.certificate_data import complete

    assert any("neither stated" in item for item in missing_items(complete("G-1"), alone))


def test_a_force_in_g_is_named(recwarn):
    result = piga.calibrate(rate_log(f_unit=G0, uncertainty=KNOWN), TERMS, "rate")
    assert result["scale_factor"].value == pytest.approx(0.8884 * G0, rel=1e-3)
    assert result.verdict.grade == "do not use"
    said = "\n".join(str(warning.message) for warning in recwarn.list)
    assert "the scale factor is 9.807 times the nominal one" in said
    assert "check f (wanted in m/s^2)" in said
    assert "[data]" not in said
    assert "verdict: Do not use: the scale factor" in repr(result)


@pytest.mark.parametrize(
    ("change", "words", "grade"),
    [
        ({"condition": 1.1 * SEPARATED}, "hardly separates", "do not use"),
        ({"budget": ()}, NO_REFERENCE, "doubt"),
        ({"notes": ("odd",)}, "odd", "doubt"),
    ],
)
def test_each_doubt(change, words, grade):
    base = replace(calibration(with_residuals=False), notes=())
    assert verdict(base).grade == "clear"
    result = verdict(replace(base, **change))
    assert result.grade == grade
    assert len(result.doubts) == 1
    assert words in result.doubts[0].what


def test_a_condition_number_that_moves_no_number_is_said_and_is_no_doubt():
    base = replace(calibration(with_residuals=False), notes=(), condition=1.1 * WELL_SEPARATED)
    assert verdict(base).grade == "clear"
    assert any("hard to separate" in said for said in verdict(base).tested)


@pytest.mark.parametrize(
    ("kind", "grade"), [("moving", "clear"), ("settling", "clear"), ("missing-value", "doubt")]
)
def test_rows_between_positions_are_not_lost(kind, grade):
    """A third of the rows: moves of the stand, or readings that are missing."""
    base = replace(calibration(with_residuals=False), notes=())
    rows = base.quality.rows
    gone = Quality(rows, rows - rows // 3, rows // 3, (Event(kind, rows // 3, 1, ""),))
    assert verdict(replace(base, quality=gone)).grade == grade
    assert gone.lost == pytest.approx(0.0 if grade == "clear" else 1 / 3, abs=1e-3)


def test_a_source_of_the_model_is_not_the_reference():
    """What the servo may do to the scale factor is Type B, and says nothing of the reference."""
    base = replace(calibration(with_residuals=False), notes=())
    row = BudgetEntry(source="meaning of the cubic signature: servo or k3", type="B", contributions={})
    assert verdict(replace(base, budget=(row,))).doubts[0].what == NO_REFERENCE


@pytest.mark.parametrize(("used", "grade"), [(0.9, "clear"), (0.74, "doubt")])
def test_rows_that_were_not_used(used, grade):
    """They move a coefficient by up to 2 sqrt(share) u: a tenth by 0.63 u, a quarter by 1 u."""
    base = replace(calibration(with_residuals=False), notes=())
    few = replace(base.quality, used=round(used * base.quality.rows))
    result = verdict(replace(base, quality=few))
    assert result.grade == grade
    said = [*result.tested, *(doubt.what for doubt in result.doubts)]
    words = f"{100 * used:.4g} % of the rows of the positions were used: the others would move a coefficient by up to "
    assert any(text.startswith(f"{words}{2 * np.sqrt(1 - used):.2g} u") for text in said)


def centrifuge(tilt: float, **uncertainty) -> piga.Run:
    """A centrifuge of +-10 g with a reference of the perfect stand; its arm is tilted by ``tilt`` [rad].

    The tilt brings ``g sin(tilt)`` to the input axis, written here from the geometry and not by the simulator.
    """
    level = np.repeat(np.array([-10.0, -7.0, -4.0, -1.0, 1.0, 4.0, 7.0, 10.0]), 40) * G0
    f = np.column_stack([level, np.zeros(320), np.full(320, G0)])
    rate = K * (level + 300e-6 * G0 + G0 * np.sin(tilt)) + 1e-8 * np.random.default_rng(2).standard_normal(320)
    stand = {"kind": "centrifuge", "latitude": "40 deg", "levels": ["1 g"]}
    return piga.Run.from_arrays(
        np.arange(320.0), rate, f, scale_factor=K, kind="rate", stand=stand, uncertainty=uncertainty,
        segment=np.repeat(np.arange(8), 40), units="SI",
    )  # fmt: skip


def test_a_tilted_arm_does_not_pass_when_only_the_scale_is_stated():
    tilt = np.radians(20.0 / 3600.0)
    with pytest.warns(piga.PigaWarning, match="Type A and 1 of 10 sources"):
        result = piga.calibrate(centrifuge(tilt, reference_scale="1 ppm"), TERMS, "rate")
    assert abs(result["k0"].value - 300e-6) > 100.0 * result["k0"].std
    assert result.verdict.grade == "doubt"
    document = json.loads(calibration_to_bytes(result))["verdict"]
    assert document["sources"] == "Type A and 1 of 10 sources"
    assert "reference_misalignment" in document["sources_unstated"]
    effects = next(s for s in result.sources if s.name == "reference_misalignment").effects
    moved = effects["reference_misalignment Y0"]["k0"]
    assert abs(20.0 * moved) == pytest.approx(abs(result["k0"].value - 300e-6), rel=0.01)
    assert "reference_misalignment Y0" in body(page_html(calibration_page(result)))
    from piga.certificate.certificate_file import missing_items
    from tests.certificate.certificate_data import complete

    assert any("reference_misalignment" in item for item in missing_items(complete(""), result))


def test_a_stated_tilt_covers_k0_and_its_absence_can_be_waived_by_a_reason():
    rest = ("arm_radius", "arm_stretch", "rate_error", "gravity", "levelling", "timing", "vibration", "servo")
    waived = dict.fromkeys(rest, "negligible on this machine")
    stated = {"reference_scale": "1 ppm", "reference_misalignment": "20 arcsec", "waived": waived}
    result = piga.calibrate(centrifuge(np.radians(20.0 / 3600.0), **stated), TERMS, "rate")
    assert result["k0"].limits[0] < 300e-6 < result["k0"].limits[1]
    assert result.verdict.unstated == ()
    assert result.verdict.sources == "Type A and 2 of 2 sources"


@pytest.mark.parametrize(
    ("waived", "words"),
    [
        ({"radius": "small"}, "no source 'radius'"),
        ({"timing": " "}, "a reason"),
        ({"reference_scale": "x"}, "stated too"),
    ],
)
def test_what_is_waived_is_checked(waived, words):
    with pytest.raises(piga.PigaError, match=words):
        rate_log(uncertainty={"reference_scale": "1 ppm", "waived": waived})


def test_without_a_base_rate_the_rotation_of_the_earth_is_a_source():
    """The true instrument turns with the Earth at latitude 50 degrees: K is 63 ppm off, and covered."""
    run = rate_log(uncertainty=KNOWN | {"waived": {k: v for k, v in WAIVED.items() if k != "earth_rate"}})
    up = run.f[:, 0] / G0
    turned = replace(run, output=run.output - 7.292115e-5 * np.sin(np.radians(50.0)) * up)
    result = piga.calibrate(turned, TERMS, "rate")
    off = result["scale_factor"].value / 0.8884 - 1.0
    assert off == pytest.approx(-62.9e-6, rel=0.02)
    assert result["scale_factor"].limits[0] < 0.8884 < result["scale_factor"].limits[1]
    assert "earth_rate (no base rate and no site are given: the rotation of the Earth is up to 82 ppm of K" in (
        result.verdict.reason
    )
    still = piga.calibrate(replace(turned, base_rate=np.zeros_like(run.f)), TERMS, "rate")
    assert not any(source.name == "earth_rate" for source in still.sources)


def test_a_height_that_is_not_stated_is_a_source_and_g_is_stated():
    """Gravity falls by 3.1e-7 of itself a metre: 155 ppm of K for 500 m."""

    def head(**site) -> piga.Calibration:
        stand = {"kind": "dividing-head", "latitude": "40 deg", "dwell": "10 s", "move": "10 s"}
        stand["positions"] = "0:360:30 deg"
        x, t = np.radians(30.0 * np.arange(12)), np.arange(12.0) * 20.0
        t = (t[:, None] + np.arange(11.0)).ravel()
        rate = K * 9.80172 * np.repeat(np.cos(x), 11) + 1e-8 * np.random.default_rng(3).standard_normal(132)
        run = piga.Run.from_dataframe(
            {"t": t, "rate": rate, "at": np.repeat(np.arange(12), 11)}, output="rate", kind="rate", segment="at",
            reference=None, stand=stand | site, scale_factor=K, uncertainty={"reference_scale": "1 ppm"}, units="SI",
        )  # fmt: skip
        return piga.calibrate(run, ["scale_factor", "k0", "m_Y"], "rate")

    unknown, known = head(), head(height="120 m")
    assert unknown["scale_factor"].std / unknown["scale_factor"].value == pytest.approx(155e-6, rel=0.02)
    assert known["scale_factor"].std / known["scale_factor"].value < 5e-6
    assert "height" in unknown.verdict.unstated
    assert "height" not in known.verdict.unstated
    assert "sea level (the height is not stated)" in unknown.gravity
    assert "9.8013" in known.gravity
    assert known.gravity.replace("^2", "²") in body(page_html(calibration_page(known)))
    assert json.loads(calibration_to_bytes(known))["gravity"] == known.gravity
