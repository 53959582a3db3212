"""Pages of the platform: numbers as the one formatter makes them."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from piga.frames import axis_turn
from piga.platform import simulate
from piga.platform.scenario import Gyro
from piga.reports.platform import alignment_page, simulation_page
from piga.reports.render.page import page_text
from tests.platform.conftest import alignment, published

MINUS_ZERO = re.compile(r"-0(\.0*)?(?![\d.])")

pytestmark = pytest.mark.interpreted


def test_a_number_that_rounds_to_zero_has_no_minus_sign():
    s = published(duration=640.0, step=8.0, polar=Gyro(1e-3, -1e-9), equatorial=Gyro(1e-3, drift=(-0.0, 0.0)))
    run = simulate(s)
    aligned = replace(alignment(drift=(-0.0,) * 3), base=axis_turn(2, 1e-9))
    assert -1e-8 < aligned.base_angles[2] < 0.0 or -1e-8 < -aligned.base_angles[2] < 0.0
    for turned in (aligned, replace(aligned, base=aligned.base.T)):
        text = page_text(alignment_page(run, turned))
        assert "base heading: 0.0000 deg" in text
        assert not MINUS_ZERO.search(text), text
    assert not MINUS_ZERO.search(page_text(simulation_page(run)))
