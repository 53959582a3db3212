"""Linear platform errors against the difference of two full navigation runs, and the sources of the budget."""

from __future__ import annotations

import numpy as np
import pytest

from piga.platform import error_budget, linear_errors, simulate
from piga.platform.chain import perturbed_errors, standard_sources
from piga.platform.navigator import Perturbation
from tests.platform.conftest import INTERPRETED, alignment, published

pytestmark = pytest.mark.interpreted

DURATION = 7200.0 if INTERPRETED else 86400.0
SOURCES = list(standard_sources().items())


@pytest.fixture(scope="module")
def quiet_run():
    return simulate(published(duration=DURATION, step=2.0).without_errors())


@pytest.mark.parametrize(("name", "perturbation"), SOURCES, ids=[name for name, _ in SOURCES])
def test_linear_errors_are_those_of_a_perturbed_run(quiet_run, name, perturbation):
    full, quiet = perturbed_errors(quiet_run, perturbation), perturbed_errors(quiet_run, Perturbation())
    linear = linear_errors(quiet_run.scenario.place, perturbation, DURATION, step=10.0)[1:]
    position = np.stack([full.north - quiet.north, full.east - quiet.east, quiet.up - full.up], axis=1)
    velocity = full.velocity - quiet.velocity
    off = np.abs(position - linear[:, 1:4]).max(axis=0)
    assert off[:2].max() < 5e-3 * np.abs(position[:, :2]).max()
    assert off[2] < 0.04 * max(
        np.abs(position[:, 2]).max(), 0.01 * np.abs(position).max()
    )  # height one step late
    assert np.abs(velocity[:, :2] - linear[:, 4:6]).max() < 0.02 * np.abs(velocity[:, :2]).max()


def test_the_budget_lists_every_source_and_their_sum():
    sources = dict(SOURCES[:2])
    rows = error_budget(published(duration=3600.0, step=10.0), sources)
    assert [r.source for r in rows] == [*sources, "all together"]
    for row in rows:
        assert row.position_linear_m == pytest.approx(row.position_full_m, rel=0.01)
        assert row.largest_difference_m < 0.01 * row.position_full_m


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
