"""Uncertainties of an identification: intervals that hold, and the Cramer-Rao bound from the simulator itself."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from piga.platform import identify, simulate
from piga.platform.scenario import Gyro, Harmonic, Sensors
from piga.platform.simulate import base_motion
from tests.platform.conftest import (
    ARCSEC,
    AT_SEA,
    NOISE,
    calibration,
    truth,
)

pytestmark = [pytest.mark.interpreted, pytest.mark.long]

ANGLES, FORCE = ("gimbals", "pick-off"), ("force", "pick-off")
CASES = {
    "gimbal angles": ({}, ANGLES),
    "specific force": ({}, FORCE),
    "specific force at sea": ({"motion": AT_SEA}, FORCE),
}
TURN = 2.0 * np.pi


def _true_parameters(s):
    """Amplitudes and phases that were put in, in the order of ``Identification.parameters``."""
    rows = []
    for gyro in (s.polar, s.equatorial):
        rows += [gyro.misalignment, gyro.phase]
        rows += [v for h in sorted(gyro.harmonics, key=lambda h: h.order) for v in (h.amplitude, h.phase)]
    return np.array(rows)


def _scores(case, seeds):
    """Standardised errors of unknowns and of amplitudes and phases (n, 34), and NEES (n,), run by run."""
    changes, sources = CASES[case]
    s = calibration(sensors=NOISE, step=4.0, **changes)
    motion, true, put_in = base_motion(s), truth(s), _true_parameters(s)
    scores, nees = [], []
    for seed in seeds:
        run = simulate(replace(s, seed=seed), motion=motion)
        result = identify(run.readouts, s.place, sources=sources)
        off = result.values - true
        named = result.parameters[: len(put_in)]
        turned = np.array([p.value for p in named]) - put_in
        phases = np.array([p.name.endswith("phase") for p in named])
        turned = np.where(phases, np.remainder(turned + np.pi, TURN) - np.pi, turned)
        uncertain = [np.sqrt(np.diag(result.covariance)), np.array([p.std for p in named])]
        scores.append(np.concatenate([off / uncertain[0], turned / uncertain[1]]))
        nees.append(off @ np.linalg.solve(result.covariance, off))
    return np.array(scores), np.array(nees)


def _hold(scores, nees, sigmas, margin=0.0):
    """Coverage, bias, spread and NEES of ``n`` runs within ``sigmas`` of what honest intervals give."""
    n, unknowns = len(scores), 18
    covered = np.mean(np.abs(scores) < 1.96, axis=0)
    assert np.abs(covered - 0.95).max() < sigmas * np.sqrt(0.95 * 0.05 / n) + margin
    assert np.abs(scores.mean(axis=0)).max() < sigmas / np.sqrt(n) + margin
    assert np.abs(scores.std(axis=0) - 1.0).max() < sigmas / np.sqrt(2.0 * n) + margin
    assert abs(nees.mean() / unknowns - 1.0) < sigmas * np.sqrt(2.0 / (n * unknowns)) + margin


@pytest.mark.parametrize("case", CASES)
def test_intervals_hold(case):
    scores, nees = _scores(case, range(20))
    _hold(scores, nees, 4.0)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_intervals_hold_in_ten_thousand_runs(case):
    """95 % intervals of every angle, phase and harmonic hold in 94 to 96 % of the runs; no bias; NEES."""
    scores, nees = _scores(case, range(10_000))
    covered = np.mean(np.abs(scores) < 1.96, axis=0)
    assert np.all((covered > 0.94) & (covered < 0.96))
    _hold(scores, nees, 4.0, margin=0.005)


def _numbers(s):
    """The scenario as numbers: amplitudes and phases, drift of each gyro; redundancy, triad and base."""
    gyros = [
        [g.misalignment, g.phase, *(v for h in sorted(g.harmonics) for v in h[1:]), *g.drift]
        for g in (s.polar, s.equatorial)
    ]
    return np.array(
        [*gyros[0], *gyros[1], s.redundancy, *s.triad, s.motion.roll, s.motion.pitch, s.motion.heading]
    )


def _of_numbers(s, numbers):
    """The scenario ``s`` with these numbers in place of its own."""
    first, second, (redundancy, *triad), base = np.split(numbers, [10, 20, 24])
    polar, equatorial = (
        Gyro(v[0], v[1], tuple(Harmonic(k, *v[2 * k : 2 * k + 2]) for k in (1, 2, 3)), drift=tuple(v[8:]))
        for v in (first, second)
    )
    motion = msgspec.structs.replace(s.motion, **dict(zip(("roll", "pitch", "heading"), base, strict=True)))
    return replace(
        s, polar=polar, equatorial=equatorial, redundancy=redundancy, triad=tuple(triad), motion=motion
    )


def _bound(s, sources):
    """Cramer-Rao bound (16,) of amplitudes and phases, by differences of the simulator itself.

    Nuisances: redundancy angle, drifts, attitude of triad and base. Nothing of the estimator is used.
    """
    sigma = {"gimbals": s.sensors.gimbal_noise, "pick-off": s.sensors.pickoff_noise}
    walk = s.sensors.velocity_random_walk * np.sqrt(s.step)

    def seen(scenario):
        r = simulate(replace(scenario, sensors=Sensors())).readouts
        parts = {"gimbals": np.unwrap(r.gimbals, axis=0), "pick-off": r.pickoff, "force": r.increments}
        return np.concatenate([parts[k].ravel() / sigma.get(k, walk) for k in sources])

    put_in, wanted = _numbers(s), [*range(8), *range(10, 18)]
    sizes = np.full(len(put_in), 1e-6)
    sizes[[1, 3, 5, 7, 11, 13, 15, 17]], sizes[[8, 9, 18, 19]] = 1e-3, 1e-10  # phases, drifts
    ends = [[seen(_of_numbers(s, put_in + side * by)) for side in (1.0, -1.0)] for by in np.diag(sizes)]
    columns = np.array([ahead - behind for ahead, behind in ends]).T / (2.0 * sizes)
    rows, nuisance = columns[:, wanted], np.delete(columns, wanted, axis=1)
    scale = np.linalg.norm(nuisance, axis=0)
    left, values, _ = np.linalg.svd(nuisance / np.where(scale > 0.0, scale, 1.0), full_matrices=False)
    basis = left[:, values > 1e-6 * values[0]]
    free = rows - basis @ (basis.T @ rows)
    return np.sqrt(np.diag(np.linalg.inv(free.T @ free)))


@pytest.mark.parametrize("sources", [ANGLES, FORCE])
def test_every_uncertainty_is_the_cramer_rao_bound(sources):
    """Angles, phases and harmonics. The force is held to the bound of a base *known* to be at rest."""
    s = calibration(sensors=NOISE, duration=7200.0, step=4.0)
    identified = identify(simulate(s).readouts, s.place, sources=sources)
    level = {"gimbals": ARCSEC, "pick-off": ARCSEC, "force": NOISE.velocity_random_walk / np.sqrt(s.step)}
    noise = np.mean([identified.noise[k] / level[k] for k in sources])
    stds = np.array([p.std for p in identified.parameters[:16]])
    ratio = stds / noise / _bound(s, sources)
    assert ratio.max() < 1.05
    assert ratio.min() > 0.95
