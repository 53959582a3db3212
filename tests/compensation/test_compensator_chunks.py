"""Results do not depend, to the bit, on the chunks and on what else is asked for; rare rows among them."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numba
import numpy as np
import pytest

import piga
from piga.compensation import Mounted, SetCompensator
from piga.records.calibration import Diagnostics
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of

ROWS = 300 if numba.config.DISABLE_JIT else 10_000
CUTS = (0, 1, 2, 64, 65, 130, 250, ROWS)
CAL = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.3, "s1": 1e-5, "c1": -2e-5})


def samples(seed: int = 1) -> dict[str, np.ndarray]:
    """Any numbers will do; the angle passes the limit of the fast reduction."""
    rng = np.random.default_rng(seed)
    angle = 1.5999e6 + np.cumsum(np.abs(rng.standard_normal(ROWS)))
    begins = np.zeros(ROWS, dtype=bool)
    begins[[70, 200]] = True
    return {
        "t": np.cumsum(0.01 + 1e-4 * rng.random(ROWS)), "output": rng.standard_normal(ROWS),
        "f": 9.8 * rng.standard_normal((ROWS, 3)), "angle": angle, "begins": begins,
    }  # fmt: skip


STD = {"scale_factor": 1e-7, "tan_beta": 1e-6, "phi": 1e-4, "k0": 1e-6}
VALUES = {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.3, "s1": 1e-5, "c1": -2e-5, "k0": 1e-3}
LIMITS = Diagnostics(range={"a_x": (-20.0, 20.0), "a_t": (0.0, 15.0)})


@pytest.mark.compiled
@pytest.mark.parametrize("left_out", [(), ("tan_beta",), ("scale_factor", "k0"), tuple(STD)])
def test_samples_are_the_same_to_the_bit_whatever_the_chunks_and_what_is_asked_for(left_out):
    """Chunks of any size, all results or some."""
    columns = samples()
    columns["t"][120] = columns["t"][119]
    std = {name: u for name, u in STD.items() if name not in left_out}
    cal = calibration_of(VALUES, std, angle_rms=1e-6, angle_random_walk=1e-5, diagnostics=LIMITS)
    spread = np.sqrt(np.diag(cal.covariance))
    cal = replace(cal, covariance=np.outer(spread, spread) * (0.6 + 0.4 * np.eye(spread.size)))
    whole = piga.Compensator(cal, kind="rate", step=0.01).push(columns)
    assert len(set(whole.flags.tolist())) > 4
    stream = piga.Compensator(cal, kind="rate", step=0.01)
    parts = [stream.push({name: c[a:b] for name, c in columns.items()}) for a, b in pairwise(CUTS)]
    for name in ("ax", "dv", "u_ax", "flags"):
        assert np.concatenate([getattr(p, name) for p in parts]).tobytes() == getattr(whole, name).tobytes()
    bare = piga.Compensator(cal, kind="rate", uncertainty=False, flags=False).push(columns)
    flagged = piga.Compensator(cal, kind="rate", step=0.01, uncertainty=False).push(columns)
    known = piga.Compensator(cal, kind="rate", step=0.01, flags=False).push(columns)
    for one in (bare, flagged, known):
        assert one.ax.tobytes() == whole.ax.tobytes()
        assert one.dv.tobytes() == whole.dv.tobytes()
    assert np.array_equal(flagged.flags, whole.flags)
    assert known.u_ax.tobytes() == whole.u_ax.tobytes()
    assert list(bare.columns()) == ["t", "ax", "dv"]
    assert columns["angle"][-1] > 1.6e6 > columns["angle"][0]
    assert np.all(whole.dv[columns["begins"]] == 0.0)


@pytest.mark.compiled
def test_triad_of_samples_is_the_same_to_the_bit_whatever_the_chunks_and_what_is_asked_for():
    data = [samples(seed) for seed in range(3)]
    t, begins = data[0]["t"], data[0]["begins"]
    psi, rate = np.array([d["angle"] for d in data]), np.array([d["output"] for d in data])
    mounted = [Mounted(CAL, np.roll(np.eye(3), -i, axis=0)) for i in range(3)]

    def push(cuts, **wanted):
        stream = SetCompensator(mounted, sampled=True, **wanted)
        parts = [
            stream.push(t[a:b], psi[:, a:b], rate=rate[:, a:b], begins=begins[a:b]) for a, b in pairwise(cuts)
        ]
        return {name: np.concatenate([getattr(p, name) for p in parts]) for name in ("f", "dv", "flags")}

    whole, plain = push((0, ROWS)), push((0, ROWS), uncertainty=False)
    cut, bare = push(CUTS, uncertainty=False), push(CUTS, uncertainty=False, flags=False)
    assert len(set(whole["flags"].tolist())) > 2
    for name in ("f", "dv"):
        assert whole[name].tobytes() == plain[name].tobytes() == cut[name].tobytes() == bare[name].tobytes()
    assert whole["flags"].tobytes() == plain["flags"].tobytes() == cut["flags"].tobytes()


def test_bad_number_in_a_set_is_named_and_leaves_the_state():
    data = samples()
    psi = np.tile(data["angle"], (3, 1))
    mounted = [Mounted(CAL, np.roll(np.eye(3), -i, axis=0)) for i in range(3)]
    stream, sound = SetCompensator(mounted), SetCompensator(mounted)
    stream.push(data["t"][:10], psi[:, :10])
    sound.push(data["t"][:10], psi[:, :10])
    broken = psi[:, 10:20].copy()
    broken[1, 9] = np.nan
    with pytest.raises(piga.ArgumentError, match=r"output\[1, 9\] is not finite"):
        stream.push(data["t"][10:20], broken)
    again = [s.push(data["t"][10:20], psi[:, 10:20]).f for s in (stream, sound)]
    assert again[0].tobytes() == again[1].tobytes()


def angles(start: float) -> dict[str, np.ndarray]:
    """Intervals that turn little and far, even and uneven, beginnings, one repeated time; weak and strong force."""
    rng = np.random.default_rng(7)
    step = np.where(np.arange(ROWS) % 150 < 90, 0.01, rng.choice([0.01, 0.012, 0.05, 1.5], ROWS))
    step[120] = 0.0
    begins = np.zeros(ROWS, dtype=bool)
    begins[[70, 131, 132, 200]] = True
    force = (
        9.8 * (0.3 + rng.standard_normal((ROWS, 3))) * np.where(np.arange(ROWS) % 40 < 25, 1.0, 1e-2)[:, None]
    )
    turn = K_G * step * force[:, 0] / 9.8
    turn[90] = 30.0
    return {"t": np.cumsum(step), "output": start + np.cumsum(turn), "f": force, "begins": begins}


@pytest.mark.compiled
@pytest.mark.parametrize("start", [0.0, 1.6e6 - 30.0])
@pytest.mark.parametrize("left_out", [(), ("scale_factor", "k0"), tuple(STD)])
def test_angles_are_the_same_to_the_bit_whatever_the_chunks_and_what_is_asked_for(start, left_out):
    columns = angles(start)
    std = {name: u for name, u in STD.items() if name not in left_out}
    cal = calibration_of(VALUES, std, angle_rms=1e-6, angle_random_walk=1e-5, diagnostics=LIMITS)
    whole = piga.Compensator(cal).push(columns)
    assert len(set(whole.flags.tolist())) > 4
    assert whole.flagged("no_increment")[120]
    rng = np.random.default_rng(8)
    for cuts in (CUTS, (0, 66, 67, 131, 195, ROWS), (0, *np.sort(rng.integers(0, ROWS, 20)), ROWS)):
        stream = piga.Compensator(cal)
        parts = [stream.push({name: c[a:b] for name, c in columns.items()}) for a, b in pairwise(cuts)]
        for name in ("ax", "dv", "u_ax", "flags"):
            assert np.concatenate([getattr(p, name) for p in parts]).tobytes() == getattr(whole, name).tobytes()
    for wanted in ({"flags": False}, {"uncertainty": False}, {"flags": False, "uncertainty": False}):
        rows = piga.Compensator(cal, **wanted).push(columns)
        assert rows.ax.tobytes() == whole.ax.tobytes()
        assert rows.dv.tobytes() == whole.dv.tobytes()
        assert not rows.u_ax.size or rows.u_ax.tobytes() == whole.u_ax.tobytes()
        assert not rows.flags.size or rows.flags.tobytes() == whole.flags.tobytes()


@pytest.mark.compiled
def test_base_rate_may_come_and_go_in_a_stream_of_angles():
    """A chunk without one is a chunk with a base at rest."""
    columns = angles(0.0)
    cal = calibration_of(VALUES, STD, angle_rms=1e-6)
    whole, stream = piga.Compensator(cal).push(columns), piga.Compensator(cal)
    parts = []
    for k, (a, b) in enumerate(pairwise(CUTS)):
        part = {name: c[a:b] for name, c in columns.items()}
        parts.append(stream.push(part | ({"base_rate": np.zeros((b - a, 3))} if k % 2 else {})).ax)
    result = np.concatenate(parts)
    assert not np.any(np.abs(result - whole.ax) > 1e-9)
    assert np.array_equal(np.isnan(result), np.isnan(whole.ax))
