"""Linear platform errors against the difference of two full navigation runs, and the sources of the budget."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from piga import earth
from piga.frames import rotation_vector_to_matrix
from piga.platform import (
    Start,
    compensator,
    error_budget,
    errors,
    linear_errors,
    navigate,
    simulate,
    true_knowledge,
)
from piga.platform.chain import standard_sources
from piga.platform.geometry import local_axes
from piga.platform.navigator import Perturbation, true_start
from tests.platform.conftest import INTERPRETED, alignment, published, without_errors

pytestmark = pytest.mark.interpreted

DURATION = 7200.0 if INTERPRETED else 86400.0
SOURCES = list(standard_sources().items())


@pytest.fixture(scope="module")
def quiet_run():
    return simulate(without_errors(published(duration=DURATION, step=2.0)))


def perturbed_errors(run, perturbation):
    """Errors of a full navigation run whose navigator or sensors have the error ``perturbation``."""
    readouts, place = run.readouts, run.scenario.place
    start = true_start(run.truth)
    axes = local_axes(place.latitude, place.longitude)
    off = axes @ np.array(perturbation.position)
    velocity = start.velocity + axes @ np.array(perturbation.velocity) + np.cross([0, 0, earth.EARTH_RATE], off)
    triad = rotation_vector_to_matrix(np.array(perturbation.attitude)) @ start.triad
    biased = replace(
        readouts,
        increments=readouts.increments + readouts.step * np.array(perturbation.bias),
        altitude=readouts.altitude + perturbation.height,
    )
    made = compensator("none", true_knowledge(run.scenario), biased)
    moved = Start(start.position + off, velocity, triad, np.array(perturbation.drift))
    return errors(navigate(biased, made, moved, every=5), run.truth, readouts)


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
    s = published(duration=3600.0, step=10.0)
    rows = error_budget(s, sources)
    assert [r.source for r in rows] == [*sources, "all together"]
    one, two = sources.values()
    for row, moved in zip(rows, (one, two, one.plus(two)), strict=True):
        n, e, _, vn, ve, _ = linear_errors(s.place, moved, 3600.0).T[1:]
        assert row.position_linear_m == np.hypot(n, e).max()
        assert row.velocity_linear_m_s == np.hypot(vn, ve).max()


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
