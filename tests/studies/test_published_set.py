"""The published solution of a set, beside the exact one."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

import piga
from piga.compensation import Mounted, compensate_set
from piga.studies.published import PublishedSet
from piga.units import G0
from tests.compensation.triads import made, orthogonal
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of

CAL = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.4})


@pytest.mark.parametrize("kind", ["angle", "rate"])
def test_published_formula_of_a_set_leaves_the_second_order(kind):
    """The coupling of 5 g goes from 25 mg to its square; to the bit whatever the chunks."""
    t = np.arange(0.0, 3.0, 0.01)
    f = np.tile(np.array([1.0, 5.0, -0.8]) * G0, (t.size, 1))
    records, mounted = made(t, f, orthogonal(), kind)
    psi, given = np.array([r.output for r in records]), {}
    if kind == "rate":
        psi, given = np.array([r.output for r in made(t, f, orthogonal())[0]]), {"rate": psi}
    compensated = PublishedSet(mounted, sampled=kind == "rate").push(t, psi, **given)
    error = np.abs(compensated.f[2:] - f[2:]).max()
    assert 1e-6 * G0 < error < 4.0 * TAN_BETA**2 * 5.0 * G0
    exact = compensate_set(records, mounted)
    assert np.abs(exact.f[2:] - f[2:]).max() < 1e-8 * G0
    if kind == "angle":
        stream = PublishedSet(mounted)
        parts = [stream.push(t[a:b], psi[:, a:b]).f for a, b in pairwise([0, 1, 70, 71, 200, t.size])]
        assert np.concatenate(parts).tobytes() == compensated.f.tobytes()


def test_published_set_of_two_is_refused():
    item = Mounted(CAL, np.eye(3))
    with pytest.raises(piga.ArgumentError, match="set of 2"):
        PublishedSet([item, item])
