"""The drift that the navigator is told, against the definition of each choice."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from piga.platform import Alignment, load_scenario
from piga.platform.chain import _drift

EXAMPLES = Path(__file__).parents[3] / "examples"


def alignment(drift: tuple[float, ...] = (0.0, 0.0, 0.0), std: tuple[float, ...] = (1.0,) * 9) -> Alignment:
    """An alignment at the place of the published case, with this drift and these standard uncertainties."""
    place = load_scenario(EXAMPLES / "platform-published.toml").place
    return Alignment(place, np.eye(3), np.array(drift), np.eye(3), np.diag(np.square(std)), {}, {}, 1.0)


def test_the_drift_that_the_navigator_is_told() -> None:
    """None, that of the alignment, or the true one of the triad: ``w1x, w1y, w2z/cos(eta) - w1x tan(eta)`` [He2014]."""
    s = load_scenario(EXAMPLES / "platform-published.toml")
    w1x, w1y, w2z, eta = 3e-8, -2e-8, 5e-8, 0.3
    s = replace(
        s,
        polar=replace(s.polar, drift=(w1x, w1y)),
        equatorial=replace(s.equatorial, drift=(7e-8, w2z)),
        redundancy=eta,
    )
    aligned = alignment(drift=(1e-8, 2e-8, 3e-8))
    told = {
        kind: _drift(replace(s, compensation=replace(s.compensation, drift=kind)), aligned)
        for kind in ("none", "aligned", "true")
    }
    assert told["none"].tolist() == [0.0, 0.0, 0.0]
    assert told["aligned"].tolist() == [1e-8, 2e-8, 3e-8]
    np.testing.assert_allclose(told["true"], [w1x, w1y, w2z / np.cos(eta) - w1x * np.tan(eta)], rtol=1e-14)
