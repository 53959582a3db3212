from __future__ import annotations

import numpy as np

import piga
from piga.reports.compensation.figures import compensation_errors, error_figures
from piga.reports.render.orders import order_spectrum
from piga.units import G0
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, constant_force, run_of


def test_no_line_is_left_at_the_revolution_orders():
    """Before: 1000 arcsec times 1 g at order 1; after: below three times white noise everywhere."""
    t = np.arange(0.0, 120.0, 0.05)
    record = run_of(t, constant_force(t, 1.0, 1.0), phi=0.3)
    record.output[:] += 1e-5 * np.random.default_rng(2).standard_normal(t.size)
    cal = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.3}, angle_rms=1e-5)
    result = piga.compensate(record, cal)
    spectrum = order_spectrum(compensation_errors(record, result, K_G / G0), K_G / G0, noise=(1e-5, 0.0))
    first = int(np.argmin(np.abs(spectrum.order - 1.0)))
    assert abs(spectrum.before[first] / (TAN_BETA * G0) - 1.0) < 0.02
    shown = np.isfinite(spectrum.after)
    assert (spectrum.after[shown] < 3.5 * spectrum.noise[shown]).all()
    figures = error_figures(record, result, K_G / G0, (1e-5, 0.0))
    assert [figure.key for figure in figures] == ["compensation-error", "compensation-spectrum"]
    assert all(axis.unit for figure in figures for panel in figure.panels for axis in (panel.x, panel.y))
