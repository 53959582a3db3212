"""A creep after each move is named with size, time and effect; records are integrated by SciPy (``made/independent.py``)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

import piga
from tests.calibration.made.independent import Bench, head
from tests.calibration.made.servo_data import known_noise
from tests.calibration.made.synthetic import at_rest

SECONDS, PAUSE, TIME = 60.0, 5.0, 5.0
ORDER = np.random.default_rng(5).permutation(16)
BENCH = Bench(forces=head(16)[ORDER], seconds=SECONDS, pause=PAUSE, walk=1e-5, k0_T=1.0, rate=10.0)
TERMS = ["scale_factor", "tan_beta", "k0", "m_Y"]


def record(sizes: float | NDArray[np.float64], seed: int = 3, bench: Bench = BENCH) -> piga.Run:
    """A test with a bias of ``sizes`` [g] at the start of each position, gone after a few times ``TIME``."""

    def bias(t: NDArray[np.float64]) -> NDArray[np.float64]:
        place, age = np.divmod(t, SECONDS + PAUSE)
        each = np.broadcast_to(sizes, len(bench.forces))[place.astype(int).ravel()].reshape(t.shape)
        return each * np.exp(-age / TIME)

    return replace(replace(bench, warmth=bias).record(seed), temperature=None, source="run.toml")


def age(run: piga.Run) -> NDArray[np.float64]:
    """Time since the start of the position [s]."""
    return run.t - run.t[run.segment_edges()[:-1]][run.segment_index]


def doubts(result: piga.Calibration) -> list[str]:
    return [doubt.words for doubt in result.verdict.doubts if "creep" in doubt.words]


@pytest.fixture(scope="module")
def crept() -> piga.Calibration:
    return quiet(record(50e-6))


def quiet(run: piga.Run | list[piga.Run]) -> piga.Calibration:
    with pytest.warns(piga.CalibrationWarning):
        return piga.calibrate(run, TERMS)


@pytest.mark.interpreted
def test_creep_is_a_doubt_with_size_time_effect_and_remedy(crept):
    creep = crept.diagnostics.creep
    assert creep.size == pytest.approx(50e-6, abs=4.0 * creep.standard_uncertainty)
    assert 3.0 < creep.time_constant < 8.0
    assert not creep.by_move
    (words,) = doubts(crept)
    assert "k0 by" in words
    assert "settle = " in words


def test_effect_is_that_of_taking_the_creep_out(crept):
    clean = quiet(record(0.0))
    shift = crept.diagnostics.creep.shift
    moved = {c.key: (clean[c.key].value - c.value) / c.std for c in crept.coefficients}
    assert abs(moved["k0"]) > 4.0
    assert shift["k0"] == pytest.approx(moved["k0"], rel=0.15)
    for name in ("scale_factor", "tan_beta", "phi", "m_Y"):
        assert shift[name] == pytest.approx(moved[name], abs=0.3)
    assert clean.diagnostics.creep.probability > 0.01


def test_time_advised_leaves_nothing(crept):
    (words,) = doubts(crept)
    wait = float(words.partition('settle = "')[2].partition(" s")[0])
    run = record(50e-6)
    late = quiet(run.without(age(run) < wait))
    assert not doubts(late)
    assert abs(late["k0"].value - BENCH.k0) < late["k0"].expanded
    assert abs(crept["k0"].value - BENCH.k0) > crept["k0"].expanded


@pytest.mark.long
def test_creep_that_follows_the_move_is_told_from_one_that_does_not():
    moves = np.diff(BENCH.forces[:, 0], prepend=BENCH.forces[0, 0])
    result = quiet(record(100e-6 * moves))
    creep = result.diagnostics.creep
    assert creep.by_move
    assert creep.size == pytest.approx(100e-6, abs=4.0 * creep.standard_uncertainty)
    assert abs(creep.shift["scale_factor"]) > 1.0
    assert "for a change of a_x by 1 g" in doubts(result)[0]


def test_creep_below_the_uncertainty_is_a_remark():
    stated = at_rest(reference_bias="20 ug")
    result = quiet(replace(record(14e-6), uncertainty=stated))
    creep = result.diagnostics.creep
    assert creep.seen
    assert max(map(abs, creep.shift.values())) < 1.0
    assert not doubts(result)
    assert any("creep" in remark for remark in result.remarks)


@pytest.fixture(scope="module")
def turned() -> piga.Run:
    """Another run of the instrument, without creep."""
    bench = replace(BENCH, forces=head(16)[ORDER[::-1]], k0_T=0.0, seconds=30.0)
    return weighed(replace(bench.record(9), source="other.toml", input_sha256={"b": "b"}))


def weighed(run: piga.Run) -> piga.Run:
    """The run with stated levels of noise: its weights do not depend on the creep."""
    return known_noise(run, f"{BENCH.white} rad", f"{BENCH.walk} rad/sqrt(s)")


@pytest.mark.long
def test_creep_of_one_run_among_several_is_named(turned):
    crept, clean = (
        weighed(replace(record(size), source="crept.toml", input_sha256={"a": "a"})) for size in (100e-6, 0.0)
    )
    together, without = quiet([turned, crept]), quiet([turned, clean])
    (words,) = doubts(together)
    assert words.startswith("run 'crept': a creep after each move")
    creep = together.diagnostics.creep
    assert creep.size == pytest.approx(100e-6, abs=4.0 * creep.standard_uncertainty)
    moved = {c.key: (without[c.key].value - c.value) / c.std for c in together.coefficients}
    assert max(map(abs, moved.values())) > 1.0
    assert creep.shift == pytest.approx(moved, abs=0.3)
    assert not doubts(without)
    assert without.diagnostics.creep.probability > 0.01


def test_few_positions_are_not_tested():
    bench = replace(BENCH, forces=head(4), k0_T=0.0, seconds=10.0)
    result = quiet(bench.record(1))
    assert result.diagnostics.creep is None
    assert any("creep" in words for words in result.verdict.not_tested)
