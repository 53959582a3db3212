"""The chapters that are quick without compiled kernels: nothing fails, everything is labelled, defects are seen."""

from __future__ import annotations

import re

import numpy as np
import pytest
from msgspec.structs import replace

from piga.errors import ArgumentError
from piga.instrument import Instrument, closed_form, propagate
from piga.studies import (
    CHAPTERS,
    Chapter,
    chosen,
    constant,
    platform,
    recursion,
    reproduce,
    varying,
)
from piga.studies.case import published_calibration, raw_state
from piga.studies.reproduction import brief, reproduction_page, summary
from piga.units import ARCMIN

QUICK = (
    "constant-input",
    "period",
    "closed-forms",
    "time-varying",
    "mounting",
    "redundancy-angle",
    "drift-coupling",
)


def check(chapter: Chapter) -> None:
    assert chapter.cases
    assert chapter.figures
    assert chapter.text
    for case in chapter.cases:
        assert case.verdict != "fail", (case.id, case.published, case.computed, case.tolerance)
        assert len(case.note) > 10, case.id
        assert case.unit
        assert re.search(r"\[(Wei2020|Wei2024|He2014)\]|own", case.source), case.source
        assert case.tolerance is None or case.tolerance >= 0.0
    for figure in chapter.figures:
        assert figure.title
        assert len(figure.caption) > 20
        for panel in figure.panels:
            for axis in (panel.x, panel.y):
                assert axis.quantity
                assert axis.unit
            for series in panel.series:
                x, y = series.arrays()
                assert x.size == y.size > 0
                assert np.isfinite(x).all()
                assert np.isfinite(y).all()


@pytest.mark.parametrize("name", QUICK)
def test_quick_chapters_agree_and_are_labelled(name):
    chapter = CHAPTERS[name]()
    assert chapter.id == name
    check(chapter)


@pytest.mark.long
def test_recursion_settles_where_it_is_known_to():
    """Ramp: 4.84683e-3 and 0.78672; constant input: the wrong solution -2.6e-3, -3.24."""
    check(CHAPTERS["recursion"]())
    check(CHAPTERS["compensation"]())
    assert raw_state(published_calibration("ramp")) == pytest.approx((4.84683e-3, 0.78672), abs=6e-6)
    wrong = raw_state(published_calibration("constant"))
    assert wrong == pytest.approx((-2.6e-3, -3.24), abs=2e-2)
    assert wrong[0] == pytest.approx(-2.6e-3, abs=5e-5)
    (model,) = [case for case in CHAPTERS["compensation"]().cases if case.id == "compensation.model"]
    assert model.computed == pytest.approx(1.67e-3, abs=5e-6)


def test_examples_meet_fifty_digit_references():
    """alpha at 100 s of the four examples, from 50-digit arithmetic."""
    known = (2.595170058228499, 3.668827377185051, 3.084120483267742, 89.61827271643399)
    for example, alpha in zip(constant.EXAMPLES, known, strict=True):
        assert constant.solved(example).closed[0][-1] == pytest.approx(alpha, abs=1e-12 * max(1.0, alpha))


def test_misalignment_amplitudes_meet_the_known_values():
    known = {1.0: 0.06982, 2.4: 0.16765, 5.0: 0.34995}
    for eta, amplitude in known.items():
        result = platform.pole_amplitude(4.0 * ARCMIN, np.radians(eta))
        assert result / ARCMIN == pytest.approx(amplitude, abs=6e-6)


def test_a_wrong_propagator_fails(monkeypatch):
    def slow(inst, t, f, **options):
        return propagate(replace_scale(inst, 1.0 - 1e-6), t, f, **options)

    constant.solved.cache_clear()
    monkeypatch.setattr(constant, "propagate", slow)
    failed = {case.id for case in constant.examples().cases if case.verdict == "fail"}
    constant.solved.cache_clear()
    assert "constant-input.example-4.agreement" in failed


def test_a_wrong_closed_form_fails(monkeypatch):
    monkeypatch.setattr(
        varying,
        "closed_form",
        lambda inst, *a: closed_form(Instrument(inst.scale_factor, 1.01 * inst.beta), *a),
    )
    assert [case.verdict for case in varying.mounting().cases] == ["pass", "fail", "info"]


def test_wrong_forms_and_geometry_fail(monkeypatch):
    varying.solved.cache_clear()
    monkeypatch.setattr(varying, "published_closed_form", lambda n, i, t, *f: (t, np.zeros_like(t)))
    assert all(case.verdict == "fail" for case in varying.forms().cases)
    varying.solved.cache_clear()
    monkeypatch.setattr(
        platform, "momentum_coupling", lambda eta, **d: platform.published_coupling(1.001 * eta, **d)
    )
    assert any(case.verdict == "fail" for case in platform.coupling().cases)


def test_a_wrong_compensation_fails(monkeypatch):
    wrong = recursion.compensated_error

    def biased(run, result, method):
        return wrong(run, result, method) + 1e-9

    monkeypatch.setattr(recursion, "compensated_error", biased)
    failed = [case.id for case in recursion.compensation().cases if case.verdict == "fail"]
    assert failed == ["compensation.exact"]


def test_only_takes_a_chapter_or_a_case_in_it():
    assert chosen("mounting") == ["mounting"] == chosen("mounting.moves")
    assert chosen(None) == list(CHAPTERS)
    with pytest.raises(ArgumentError, match=r"no 'nothing'[^:]*: one of: constant-input"):
        chosen("nothing")


def test_page_and_terminal_table_show_every_case():
    reproduced = reproduce("period")
    page = reproduction_page(reproduced)
    assert [section.anchor for section in page.sections] == ["period", "sources"]
    assert len(page.figures()) == len(reproduced.figures)
    (table,) = (block for section in brief(reproduced).sections for block in section.blocks)
    assert [row[-1].text for row in table.rows] == [case.verdict for case in reproduced.cases]
    assert summary(reproduced).startswith("8 cases: 6 agree, 0 do not, 2 without")


def replace_scale(inst: Instrument, factor: float) -> Instrument:
    return Instrument(factor * inst.scale_factor, inst.beta, inst.alpha0)


def test_limits_are_marked_as_such():
    limits = [case for case in CHAPTERS["compensation"]().cases if case.limit]
    assert limits
    assert all("upper limit" in case.note for case in limits)
    assert replace(limits[0], computed=0.0021).verdict == "fail"
