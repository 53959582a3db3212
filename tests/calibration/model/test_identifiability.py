"""Doubts about coefficients are said when there are and only then; a phase that nothing shows spoils nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest

import piga
from piga.calibration.model.identifiability import (
    _aligned,
    one_way_in_words,
    refuse_useless,
)
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.solution import Layout
from piga.errors import IdentifiabilityError
from piga.records.calibration.coefficient import Coefficient
from piga.units import G0


def coefficient(
    name: str, value: float, std: float, unit: str = "1", segment: str | None = None
) -> Coefficient:
    return Coefficient(name, value, std, unit, segment)


@pytest.mark.parametrize(
    ("name", "largest", "unit_error"),
    [
        ("scale_factor", 4.0, 1.0 / 0.9),  # relative
        ("k0", 4.0, 0.25),  # of 4 g
        ("k0_t", 4.0, 0.5 * 600.0 / 4.0),  # at the ends of 600 s, zero in the middle
        ("k0_T", 4.0, 0.5 * 8.0 / 4.0),
        ("k1_T", 4.0, 0.5 * 8.0),
        ("k2", 4.0, 4.0),  # g^2 per g
        ("k3", 4.0, 16.0),
        ("k_YY", 4.0, 4.0),
        ("m_Y", 4.0, 1.0),
        ("s2", 4.0, 0.25),
    ],
)
def test_an_estimate_is_useless_from_a_twentieth_of_the_largest_force(
    name: str, largest: float, unit_error: float
) -> None:
    limit = 0.05 / unit_error
    refuse_useless((coefficient(name, 0.9, 0.99 * limit),), largest * G0, 600.0, 8.0)
    with pytest.raises(IdentifiabilityError, match=f"does not determine {name}: {name} = 0.9"):
        refuse_useless((coefficient(name, 0.9, 1.01 * limit),), largest * G0, 600.0, 8.0)
    refuse_useless((coefficient("phi", 0.9, 100.0),), largest * G0, 600.0, 8.0)


def test_groups_are_turned_to_their_own_phases() -> None:
    """Exact data of one coupling at two phases: turned, both have it in the first column and nothing in the second."""
    rng = np.random.default_rng(14)
    layout = Layout(True, (), (), (np.zeros(0, dtype=np.int64),) * 2)
    parts = []
    for phase in (0.4, -2.1):
        x = rng.standard_normal((40, 2)) @ np.array([[1.0, 0.8], [0.0, 0.5]])  # columns that are correlated
        part = Reduction.empty(("p", "q"))
        part.absorb(
            np.ascontiguousarray(np.column_stack([x, x @ [0.7 * math.cos(phase), 0.7 * math.sin(phase)]]).T)
        )
        parts.append(part)
    factor = _aligned(layout, parts).factor
    np.testing.assert_allclose(np.linalg.solve(factor[:2, :2], factor[:2, 2]), [0.7, 0.0], atol=1e-12)


def test_a_phase_that_no_sample_shows_is_not_determined_and_spoils_nothing() -> None:
    """A position along gravity has no coupling to show its phase; a segment of one sample has no increment."""
    inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="100 arcsec")
    generator = np.random.default_rng(3)
    t, f, psi, segment = [], [], [], []
    for number, angle in enumerate((0.0, 30.0, 60.0, 90.0, 90.0, 120.0, 150.0)):
        count = 1 if number == 4 else 200
        time = 0.1 * np.arange(count) + 100.0 * number
        force = np.tile(9.8 * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0]), (count, 1))
        force[np.abs(force) < 1e-12] = 0.0
        turned = piga.propagate(inst, time - time[0], force, between="linear") if count > 1 else np.zeros(1)
        t.append(time), f.append(force), segment.append(np.full(count, number, np.int32))
        psi.append(turned + 1e-5 * generator.standard_normal(count))
    run = piga.Run.from_arrays(
        np.concatenate(t), np.concatenate(psi), np.concatenate(f), scale_factor=inst.scale_factor,
        segment=np.concatenate(segment), serial="P", uncertainty={"waived": {"earth_rate": "simulated"}}, units="SI",
    )  # fmt: skip
    cal = piga.calibrate(run, ["scale_factor", "tan_beta", "k0"], phases="per-segment")
    assert np.isfinite(cal.covariance).all()
    phases = [c for c in cal.coefficients if c.name == "phi"]
    unknown = [k for k, c in enumerate(phases) if c.std == pytest.approx(np.pi / np.sqrt(3.0))]
    assert unknown == [0, 4]
    for name, truth in (("scale_factor", 0.8884), ("tan_beta", inst.tan_beta), ("k0", 0.0)):
        assert abs(cal[name].value - truth) < 4.0 * cal[name].std, name
    assert cal["scale_factor"].std < 1e-4


def tumble(angles: list[float]) -> piga.Run:
    """Ten seconds of rest at each angle [deg] of a dividing head; the output is that of a perfect instrument."""
    t = (20.0 * np.arange(len(angles))[:, None] + np.arange(11.0)).ravel()
    x = np.repeat(np.radians(angles), 11)
    f = 9.80665 * np.column_stack([np.cos(x), -np.sin(x), np.zeros_like(x)])
    return piga.Run.from_arrays(
        t,
        0.09 * f[:, 0],
        f,
        scale_factor=0.09,
        kind="rate",
        segment=np.repeat(np.arange(len(angles)), 11),
        units="SI",
    )


@pytest.mark.parametrize(
    ("angles", "remarked"),
    [
        (list(range(0, 360, 30)), True),
        (list(range(360, 0, -30)), True),
        ([*range(0, 360, 60), *range(360, 0, -60)], False),
        ([0, 180, 60, 300, 120, 240], False),
    ],
)
def test_a_head_that_turned_one_way_cannot_tell_hysteresis(angles, remarked):
    run = tumble(angles)
    said = one_way_in_words(run, ("scale_factor", "k0", "m_Y"))
    assert bool(said) == remarked
    assert not one_way_in_words(run, ("scale_factor", "k0"))
    if remarked:
        assert "there and back" in said[0]
