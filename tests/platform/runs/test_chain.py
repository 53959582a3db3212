"""What a scenario and a budget choose, against the definition of each choice."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from piga.platform import Alignment, load_scenario
from piga.platform.budget import standard_sources
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


@pytest.mark.parametrize("axis", range(3))
def test_sources_of_the_budget_act_on_one_axis_each(axis: int) -> None:
    aligned = alignment(std=(1e-6, 2e-6, 3e-6, 4e-9, 5e-9, 6e-9, 7e-6, 8e-6, 9e-6))
    sources = standard_sources(aligned)
    label = "xyz"[axis]
    tilt = sources[f"triad attitude {label}"].attitude
    assert tilt == tuple(aligned.std[k] if k == axis else 0.0 for k in range(3))
    for name, kind, size in (
        (f"drift {label}, 1e-5 deg/h", "drift", np.radians(1e-5) / 3600.0),
        (f"accelerometer bias {label}, 1 ug", "bias", 9.80665e-6),
    ):
        assert getattr(sources[name], kind) == pytest.approx([size if k == axis else 0.0 for k in range(3)])
    assert standard_sources()[f"triad attitude {label}"].attitude[axis] == pytest.approx(np.pi / 648000.0)
