"""The page of a simulated test, and the figure of the locked plateau: it shows what the motion does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from piga.instrument import Instrument, closed_form
from piga.instrument.twin import PRESETS
from piga.reports.render.figure import Figure
from piga.reports.render.page import page_html
from piga.reports.stand import figures as simulation_figures
from piga.reports.stand import locking_figure
from piga.reports.stand import page as simulation_page
from piga.stand import DividingHead, Imperfections, Specimen, simulate_test
from piga.stand.write_run import coefficients
from piga.units import G0
from tests.stand.simulated import COUNTS, INST, SITE

COUPLED = Instrument("0.8884 rad/s/g", "1000 arcsec")


def test_locking_figure_has_the_plateau_and_the_mean_rate():
    figure = locking_figure((COUPLED, 5 * G0), (Instrument("0.8884 rad/s/g", "300 arcsec"), 2 * G0))
    (panel,) = figure.panels
    assert (panel.x.unit, panel.y.unit) == ("mg", "deg/s")
    ideal, wide, narrow = panel.series
    x, y = wide.arrays()
    border = 5e3 * COUPLED.tan_beta
    assert np.all(y[np.abs(x) <= border] == 0.0)
    assert np.all(y[x > border * (1 + 1e-12)] > 0.0)
    assert narrow.name == "a_t = 2 g, beta = 300 arcsec"
    assert ideal.arrays()[1][1] == pytest.approx(np.degrees(0.8884 * ideal.arrays()[0][1] * 1e-3))
    a_x, whole_turns = x[-1] * 1e-3 * G0, 200
    period = whole_turns * 360.0 / y[-1]
    alpha, _ = closed_form(COUPLED, period, a_x, 5 * G0, 0.0)
    assert np.degrees(alpha) == pytest.approx(360.0 * whole_turns, abs=1e-7)


@pytest.mark.interpreted
@pytest.mark.long
def test_page_shows_stand_output_servo_and_truth():
    stand = DividingHead(SITE, (0.0, 1.0), dwell=1.0, move=1.0)
    specimen = Specimen(INST, twin=replace(PRESETS["example"], torque_limit=0.01))
    test = simulate_test(stand, specimen, COUNTS, model="twin", imperfections=Imperfections(gravity=1e-5))
    drawn = simulation_figures(test)
    assert list(drawn) == ["stand", "imperfections", "output", "locking", "servo", "bode"]
    for figure in (make() for make in drawn.values()):
        assert isinstance(figure, Figure)
        assert all(panel.x.quantity and panel.y.quantity for panel in figure.panels)
    html = page_html(simulation_page(test, "S-1"))
    for words in ("Simulated test of S-1", "pendulosity", "gravity", "tan_beta"):
        assert words in html
    text = test.summary()
    assert "servo twin" in text
    shown = next(line.split() for line in text.splitlines() if line.startswith("  k0 "))
    k0 = next(value.value for value in coefficients(test) if value.name == "k0")
    assert float(shown[1]) == pytest.approx(1e6 * k0, rel=1e-6)
    assert shown[2] == "ug", "the unit of a calibration"
