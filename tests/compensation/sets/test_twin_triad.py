from __future__ import annotations

import numpy as np
import pytest

from piga.units import G0
from tests.compensation.sets.twin_triad import run, spectrum


@pytest.mark.only_compiled
def test_twin_triad_is_at_the_noise_floor_without_a_line_at_the_revolution_orders():
    """Three servo twins, skewed, 120 s, slow swing, angle noise 1e-6 rad and walk 1e-5 rad/sqrt(s)."""
    outcome = run(120.0)
    assert abs(np.std(outcome.after) / np.std(outcome.noise) - 1.0) < 0.02
    orders = np.array([1.0, 2.0, 3.0, 4.0])
    floor = np.median(spectrum(outcome.psi, outcome.noise, np.arange(0.4, 4.7, 0.1)))
    assert spectrum(outcome.psi, outcome.before, orders)[0] > 1e-3 * G0
    assert spectrum(outcome.psi, outcome.after, orders).max() < 3.0 * floor
