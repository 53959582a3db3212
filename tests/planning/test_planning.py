"""Plans that are none are refused with what to do; mountings; what a phase of its own costs."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

import piga
from piga.calibration.fit import fit_run, interval_of_run
from piga.calibration.model.design import Design
from piga.calibration.model.solution import name_coefficients
from piga.errors import ArgumentError, CalibrationError, RunFileError
from piga.planning.candidates import (
    Visit,
    _without_phase,
    candidate_of,
    coefficient_names,
    find_candidates,
    predict,
    run_of,
)
from piga.planning.mounting import plan_mounting
from piga.planning.plan import _ordered, plan_test
from piga.planning.plan_file import PlanRequest, read_plan, request_of
from piga.results import Array
from piga.stand import Composite, simulate_test
from piga.units import G0
from tests.calibration.made.synthetic import SCALE
from tests.planning.cases import request
from tests.planning.test_plan import mounting_request


@pytest.mark.interpreted
@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('phases = "shared"', 'phases = "sideways"', r"\[model\]: .*sideways|\[model\]: invalid enum value"),
        ('beta = "200 arcsec"\n', "", r"\[truth\] lacks beta(?s:.*)add the expected size"),
        ('output = "angle"', 'output = "angle"\nbias_random_walk = "1e-9 g/sqrt(s)"', "bias_random_walk"),
        ("[plan]", '[noise]\nflicker = "1 ug"\n[plan]', r"\[noise\] is not part"),
        ("[plan]", '[plan]\nwanted = { k0 = "-1 ug" }', r"wanted\.k0: must be positive"),
        ("[plan]", '[plan]\nmove = "0 s"', "move: 0 s is not positive"),
        ("[plan]", '[plan]\nmove = "3 g"', "move"),
    ],
)  # fmt: skip
def test_plans_that_are_none(tmp_path: Path, old: str, new: str, words: str) -> None:
    path = request(tmp_path).path
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(RunFileError, match=words) as caught:
        read_plan(path)
    assert "plan.toml" in str(caught.value)
    assert caught.value.remedy


@pytest.mark.interpreted
def test_a_plan_on_a_stand_without_positions(tmp_path: Path) -> None:
    path = request(tmp_path).path
    first, rest = path.read_text(encoding="utf-8").split("[stand]")
    stand = '[stand]\nkind = "profile"\nlatitude = "40 deg"\n[[stand.maneuvers]]\nduration = "60 s"\n'
    path.write_text(first + stand + rest[rest.index("[model]") :], encoding="utf-8")
    with pytest.raises(RunFileError, match=r"has no positions or levels to choose from|\[stand\]"):
        read_plan(path)


def test_a_mounting_that_cannot_be_planned(tmp_path: Path) -> None:
    wish = mounting_request(tmp_path, '"0 deg", "80 deg"')
    table = wish.table.mounting
    assert table is not None

    def planned(**changes: object) -> None:
        changed = msgspec.structs.replace(table, **changes)
        plan_mounting(replace(wish, table=msgspec.structs.replace(wish.table, mounting=changed)))

    with pytest.raises(ArgumentError, match=r"\[mounting\] step: must be positive"):
        planned(step="0 s")
    with pytest.raises(ArgumentError, match=r"\[mounting\] skew: '0:90 deg' is not a range(?s:.*)0:91:1 deg"):
        planned(skew="0:90 deg")
    scenario = wish.scenario
    straight = replace(scenario.specimen, instrument=piga.Instrument(scale_factor=SCALE, beta=0.0))
    with pytest.raises(CalibrationError, match=r"without it there is no lock zone"):
        plan_mounting(replace(wish, scenario=replace(scenario, specimen=straight)))


@pytest.mark.parametrize("phase", ["shared", "per-segment"])
def test_a_phase_of_its_own_costs_information(tmp_path: Path, phase: str) -> None:
    """What is known of the others is the inverse of their part of the covariance, a phase that is shared among them."""
    wish = request(tmp_path, phases=phase)
    names = coefficient_names(wish)
    size = len([name for name in names if name != "phi"]) + 1
    spread = np.random.default_rng(6).standard_normal((3, size, size + 3))
    information = spread @ spread.swapaxes(1, 2)
    t, f = np.arange(3.0), np.full((3, 3), G0)
    run = run_of(wish, t, t, f, np.zeros((3, 3)), np.zeros(3, np.int32))
    result = _without_phase(information, wish, Design(run, request_of(wish.model), run.scale_factor))
    covariance = np.linalg.inv(information)
    order = [name for name in names if name != "phi"] + ["phi"]
    kept = [order.index(name) for name in names]
    np.testing.assert_allclose(result, np.linalg.inv(covariance[:, kept][:, :, kept]), rtol=1e-9, atol=1e-9)


def test_positions_are_shuffled_unless_the_order_of_the_stand_is_asked_for(tmp_path: Path) -> None:
    """The same visits in both, with the same uncertainty."""
    shuffled, ordered = (plan_test(request(tmp_path, plan=f"shuffle = {word}")) for word in ("true", "false"))
    labels = [[float(v.candidate.label.split()[0]) for v in plan.best.visits] for plan in (shuffled, ordered)]
    assert sorted(labels[0]) == sorted(labels[1])
    assert len(labels[1]) > 4
    assert labels[0] != labels[1]
    assert shuffled.best.std("k0") == pytest.approx(ordered.best.std("k0"), rel=0.02)


_CENTRIFUGE = """[stand]
kind = "centrifuge"
radius = "2 m"
latitude = "40 deg"
dwell = "60 s"
levels = ["1 g", "2 g", "3 g", "4 g", "5 g", "6 g", "8 g", "10 g"]
"""


def _counted(folder: Path, counts: int, places: int, dwell: float, stand: str, **changes: object) -> tuple:
    """A plan with this many counts a turn, and visits to evenly spaced positions or to all levels, shuffled."""
    wish = {
        "rate": 50 if stand else 10,
        "terms": f'"scale_factor", "tan_beta", "k0", {"k2" if stand else "m_Y"!r}',
        **changes,
    }
    path = request(folder, **wish).path
    text = path.read_text(encoding="utf-8").replace('output = "angle"', 'output = "counts"')
    text = text.replace("[truth]", f"counts_per_revolution = {counts}\n[truth]")
    if stand:
        text = text[: text.index("[stand]")] + stand + text[text.index("[model]") :]
    path.write_text(text, encoding="utf-8")
    plan = read_plan(path)
    (table,), angles = plan.stands, [360.0 * k / places for k in range(places)]
    tables = [] if stand else [msgspec.structs.replace(table, positions=(f"{x!r} deg",)) for x in angles]
    places_of = [candidate_of(plan, str(k), t) for k, t in enumerate(tables)] or find_candidates(plan)
    return plan, _ordered(plan, tuple(Visit(place, dwell) for place in places_of))


def _stated(plan: PlanRequest, visits: tuple[Visit, ...], records: int) -> Array:
    """Root mean square of what the calibrations of simulated records state; the gimbal starts anywhere in a count."""
    e, own, rng = plan.scenario.electronics, plan.scenario.specimen.instrument, np.random.default_rng(7)
    motion = Composite(tuple(visit.candidate.stand(visit.dwell, plan) for visit in visits), plan.move)
    count, squares = 2.0 * math.pi / e.counts_per_revolution, []
    for seed in range(records):
        start = piga.Instrument(own.scale_factor, own.beta, own.alpha0 + rng.uniform(0.0, count))
        log = simulate_test(motion, replace(plan.scenario.specimen, instrument=start), e, seed=seed).log
        run = run_of(plan, log.t, log.output * count, log.reference, log.base_rate, log.segment)
        fit = fit_run(replace(run, resolution=count), request_of(plan.model))
        covariance = interval_of_run(fit).covariance
        squares.append(np.diag(name_coefficients(fit.design, fit.solution, covariance)[1]))
    return np.sqrt(np.mean(squares, axis=0))


def _all_marked(*cases: tuple) -> list:
    return [pytest.param(*case, marks=pytest.mark.long) for case in cases]


@pytest.mark.parametrize(
    ("counts", "places", "dwell", "walk", "stand", "records"),
    [
        (3600, 24, 60.0, 1e-5, "", 30),
        *_all_marked(
            (3600, 6, 60.0, 1e-5, "", 100),
            (3600, 6, 575.0, 1e-6, "", 100),
            (3600, 12, 60.0, 1e-6, "", 100),
            (3600, 12, 300.0, 1e-5, "", 60),
            (36000, 24, 60.0, 1e-5, "", 60),
            (360000, 12, 60.0, 1e-5, "", 60),
            (360000, 24, 60.0, 1e-5, "", 60),
            (36000, 0, 60.0, 1e-5, _CENTRIFUGE, 40),
        ),
    ],
)
def test_a_plan_keeps_its_word(
    tmp_path: Path, counts: int, places: int, dwell: float, walk: float, stand: str, records: int
) -> None:
    """Predicted standard uncertainties are those that calibrations state, whatever the counts do (issue of few long positions)."""
    plan, visits = _counted(tmp_path, counts, places, dwell, stand, walk=walk)
    predicted = predict(plan, "planned", visits, type_b=False)
    assert not predicted.refusal
    ratios = [c.std for c in predicted.coefficients] / _stated(plan, visits, records)
    assert np.abs(np.log(ratios)).max() < math.log(1.0 / 0.85), ratios


@pytest.mark.parametrize("count", [4, 5, 6, 8, 12, 24])
def test_few_positions_are_shuffled_too(tmp_path: Path, count: int) -> None:
    """Neither the order of the stand nor its reverse: few visits are neighbours of the one before."""
    _, visits = _counted(tmp_path, 3600, count, 60.0, "")
    step = np.abs(np.diff([int(visit.candidate.label) for visit in visits]))
    assert (np.minimum(step, count - step) <= 1).sum() <= count / 4
