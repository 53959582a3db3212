"""Plans that are none are refused with what to do; order of the visits; the search."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from piga.calibration.joint import fit_alone
from piga.errors import RunFileError
from piga.planning import candidates
from piga.planning.candidates import (
    Visit,
    candidate_of,
    find_candidates,
    information_tables,
    predict,
    read_plan,
    request_of,
)
from piga.planning.search import in_order
from piga.progress import SILENT
from piga.records.calibration.coefficient import changes
from piga.stand import Composite, simulate_test
from tests.planning.cases import request

MOUNTING = '[mounting]\nprofile = { kind = "dividing-head", latitude = "40 deg", positions = [] }\n'


@pytest.mark.interpreted
@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('phases = "shared"', 'phases = "sideways"', r"\[model.phases\]: 'sideways' is not one"),
        ('beta = "200 arcsec"\n', "", r"\[truth\] lacks beta(?s:.*)add the expected size"),
        ('output = "angle"', 'output = "angle"\nbias_random_walk = "1e-9 g/sqrt(s)"', "bias_random_walk"),
        ('output = "angle"', 'output = "rate"', "a log of rates does not tell"),
        ("[plan]", '[noise]\nflicker = "1 ug"\n[plan]', r"\[noise\] is not part"),
        ("[plan]", '[plan]\nwanted = { k0 = "-1 ug" }', r"wanted\.k0: must be positive"),
        ("[plan]", '[plan]\nmove = "0 s"', "move: 0 s is not positive"),
        ("[plan]", '[plan]\nmove = "3 g"', "move"),
        ("[plan]", '[plan]\nwanted = { k3 = "1 ug/g^3" }', "wanted: 'k3' is not estimated"),
        ("[plan]", '[plan]\ncriterion = "c"', "criterion 'c' needs combination"),
        ("[plan]", f'{MOUNTING}step = "0 s"\n[plan]', r"\[mounting\] step is not positive"),
        ("[plan]", '[plan]\ndwell = "3 s"', "unknown key 'dwell'"),
        ("[plan]", '[plan]\nlongest_dwell = "3 s"', "longest_dwell is below minimum_dwell"),
        ('"k2"', '"k0_t"', "'k0_t' depends on when"),
        ('duration = "720 s"', 'duration = "-5 s"', "duration: -5 s is not positive"),
        ('kind = "dividing-head"\nlatitude = "40 deg"\npositions = "0:360:30 deg"\nmove = "20 s"',
         'kind = "vibration-table"\nlatitude = "40 deg"', "kind 'vibration-table' has no positions or levels"),
        ('duration = "720 s"', 'duration = "10 s"', "duration is below minimum_dwell twice"),
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


@pytest.mark.parametrize("count", [4, 5, 6, 8, 12, 24])
def test_positions_are_shuffled_unless_the_order_of_the_stand_is_asked_for(tmp_path: Path, count: int) -> None:
    """Neither the order of the stand nor its reverse: few visits are neighbours of the one before."""
    wish = request(tmp_path)
    (table,) = wish.table.stands
    places = [msgspec.structs.replace(table, positions=(f"{360.0 * k / count!r} deg",)) for k in range(count)]
    visits = tuple(Visit(candidate_of(wish, str(k), table), 60.0) for k, table in enumerate(places))
    assert in_order(request(tmp_path, plan="shuffle = false"), visits) == visits
    ordered = in_order(wish, visits)
    step = np.abs(np.diff([int(visit.candidate.label) for visit in ordered]))
    assert (np.minimum(step, count - step) <= 1).sum() <= count / 4


@pytest.mark.parametrize("phases", ["shared", "per-segment"])
def test_many_candidates_are_simulated_in_several_records(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, phases: str
) -> None:
    wish = request(tmp_path, positions="0:360:6 deg", terms='"scale_factor", "tan_beta", "k0"', phases=phases)
    places, dwells = find_candidates(wish), np.array([30.0, 60.0])
    whole = information_tables(wish, places, dwells)
    monkeypatch.setattr(candidates, "_SAMPLES", 1500)
    sizes, made = [], candidates.noiseless_run
    monkeypatch.setattr(candidates, "noiseless_run", lambda *given: sizes.append(made(*given)) or sizes[-1])
    parts = information_tables(wish, places, dwells)
    assert max(run.size for run in sizes) < 1500 < sum(run.size for run in sizes)
    std = [np.sqrt(np.diagonal(np.linalg.inv(one.sum(axis=0)), 0, 1, 2)) for one in (parts, whole)]
    assert std[0] == pytest.approx(std[1], rel=0.02)


@pytest.mark.long
def test_coarse_counts_are_predicted_as_they_will_be_stated(tmp_path: Path) -> None:
    """Twelve positions with 3600 counts a turn. Two nearly stand: their rounding is neither white nor a walk.

    As white noise the rounding would make u of phi several times too large; as a walk, all u twenty times.
    """
    options = {
        "rate": 20,
        "white": 0,
        "walk": 1e-6,
        "duration": 3600,
        "terms": '"scale_factor", "tan_beta", "k0", "m_Y"',
    }
    path = request(tmp_path, **options).path
    text = path.read_text(encoding="utf-8").replace('output = "angle"', 'output = "counts"')
    path.write_text(text.replace("[truth]", "counts_per_revolution = 3600\n[truth]"), encoding="utf-8")
    wish = read_plan(path)
    (stand,) = wish.table.stands
    angles = [f"{30 * k} deg" for k in range(12)]
    tables = [msgspec.structs.replace(stand, positions=(angle,)) for angle in angles]
    visits = tuple(Visit(candidate_of(wish, str(k), table), 275.0) for k, table in enumerate(tables))
    predicted = predict(wish, "few", visits)
    motion = Composite(tuple(visit.table.build(wish.path.parent) for visit in visits), wish.move)
    stated, errors, truth = [], [], np.array([c.value for c in predicted.coefficients])
    for seed in range(12):
        run = simulate_test(motion, wish.scenario.specimen, wish.scenario.electronics, seed=seed).to_run()
        found = fit_alone(run, request_of(wish.model), SILENT).coefficients
        stated.append([c.std for c in found])
        errors.append(changes(predicted.coefficients, truth, np.array([c.value for c in found])))
    u = np.array([c.std for c in predicted.coefficients])
    assert [c.name for c in predicted.coefficients][1:3] == ["tan_beta", "phi"]
    scatter = np.sqrt(np.mean(np.square(errors), axis=0))
    for seen in (np.median(stated, axis=0), scatter):
        assert np.abs(np.log(u / seen)).max() < np.log(1.6), u / seen
