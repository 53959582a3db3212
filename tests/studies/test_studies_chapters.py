"""The chapters that are quick without compiled kernels: nothing fails, everything is labelled, defects are seen."""

from __future__ import annotations

import re

import numpy as np
import pytest

from piga.errors import ArgumentError
from piga.instrument import Instrument, propagate
from piga.studies import Chapter, constant, reproduce
from piga.studies.reproduction import brief, reproduction_page, summary


def check(chapter: Chapter) -> None:
    assert chapter.cases
    assert chapter.text
    for case in chapter.cases.values():
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


def test_a_wrong_propagator_fails(monkeypatch):
    def slow(inst, t, f, **options):
        return propagate(replace_scale(inst, 1.0 - 1e-6), t, f, **options)

    monkeypatch.setattr(constant, "propagate", slow)
    failed = {case.id for case in constant.examples().cases.values() if case.verdict == "fail"}
    assert "constant-input.example-4.agreement" in failed


def test_only_takes_a_chapter_or_a_case_in_it():
    assert [chapter.id for chapter in reproduce("mounting.moves").chapters] == ["mounting"]
    with pytest.raises(ArgumentError, match=r"no 'nothing'[^:]*: one of: constant-input"):
        reproduce("nothing")


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
