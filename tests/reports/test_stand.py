"""The figure of the locked plateau shows what the motion does."""

import numpy as np
import pytest

from piga.instrument import Instrument, closed_form
from piga.reports.stand import locking_figure
from piga.units import ARCSEC, G0

INST = Instrument("0.8884 rad/s/g", "1000 arcsec")


def test_locking_figure_has_the_plateau_and_the_mean_rate():
    figure = locking_figure(INST, (5 * G0, 2 * G0), (1000 * ARCSEC, 300 * ARCSEC))
    (panel,) = figure.panels
    assert (panel.x.unit, panel.y.unit) == ("mg", "deg/s")
    ideal, wide, narrow = panel.series
    x, y = wide.arrays()
    border = 5e3 * INST.tan_beta
    assert np.all(y[np.abs(x) <= border] == 0.0)
    assert np.all(y[x > border * (1 + 1e-12)] > 0.0)
    assert narrow.name == "a_t = 2 g, beta = 300 arcsec"
    assert ideal.arrays()[1][1] == pytest.approx(np.degrees(0.8884 * ideal.arrays()[0][1] * 1e-3))
    a_x, whole_turns = x[-1] * 1e-3 * G0, 200
    period = whole_turns * 360.0 / y[-1]
    alpha, _ = closed_form(INST, period, a_x, 5 * G0, 0.0)
    assert np.degrees(alpha) == pytest.approx(360.0 * whole_turns, abs=1e-7)


def test_one_beta_serves_all_curves_and_none_means_the_instrument():
    assert len(locking_figure(INST, (G0, 2 * G0)).panels[0].series) == 3
    assert locking_figure(Instrument(0.09), (G0,)).panels[0].series[1].arrays()[1][-1] > 0.0
    with pytest.raises(ValueError, match="zip"):
        locking_figure(INST, (G0, G0, G0), (1e-3, 2e-3))


@pytest.mark.parametrize("reach", [2.0, 3.0])
def test_the_axis_reaches_over_the_zone(reach):
    (panel,) = locking_figure(INST, (5 * G0,), reach=reach).panels
    assert panel.series[1].arrays()[0][[0, -1]] == pytest.approx(
        [-reach * 5e3 * INST.tan_beta, reach * 5e3 * INST.tan_beta]
    )
