"""Streams: the result is the same to the bit, whatever the chunks and whatever else is asked for."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import piga
from piga.compensation import Mounted, SetCompensator
from piga.records.calibration import Diagnostics
from piga.units import G0
from tests.compensation.triads import orthogonal
from tests.compensation.twin_data import (
    K_G,
    TAN_BETA,
    assert_same_bits,
    calibration_of,
    constant_force,
    in_pieces,
    run_of,
)

ERRORS = {"k0": 1.6e-3, "k2": 2e-5, "m_Y": 2e-4, "k_XY": 1e-4, "s2": 1e-5, "c2": 2e-5}


STD = {"scale_factor": 1e-6, "tan_beta": 1e-7, "phi": 1e-4, "k0": 1e-6}


CAL = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.3, **ERRORS}, STD, angle_rms=1e-5)


ROWS = 400 if numba.config.DISABLE_JIT else 5000


def noisy_columns(kind: str) -> dict:
    rng = np.random.default_rng(5)
    t = np.arange(ROWS) * 0.01
    f = constant_force(t, 1.0, 5.0, 1.0) + 0.3 * G0 * rng.standard_normal((ROWS, 3))
    base = 1e-3 * rng.standard_normal((ROWS, 3))
    output = run_of(t, f, phi=0.3, kind=kind, base_rate=base).output
    output = output + 1e-5 * rng.standard_normal(ROWS)
    t = np.where(t > 2.0, t + 0.5, t)
    return {"t": t, "output": output, "f": f, "base_rate": base}


@pytest.mark.interpreted
@pytest.mark.parametrize("kind", ["angle", "rate", "both"])
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cuts=st.lists(st.integers(0, ROWS), max_size=12))
def test_result_is_the_same_to_the_bit_whatever_the_chunks(kind, cuts):
    columns = noisy_columns("angle" if kind == "angle" else "rate")
    if kind == "both":
        columns["angle"] = noisy_columns("angle")["output"]
    whole = piga.Compensator(CAL, kind="angle" if kind == "angle" else "rate").push(columns)
    stream = piga.Compensator(CAL, kind="angle" if kind == "angle" else "rate")
    assert_same_bits(in_pieces(stream, columns, [0, *sorted(cuts), ROWS]), whole)


def test_state_moves_to_another_compensator():
    columns = noisy_columns("angle")
    second = {name: column[ROWS // 2 :] for name, column in columns.items()}
    stream = piga.Compensator(CAL)
    in_pieces(stream, columns, (0, ROWS // 2))
    moved = piga.Compensator(CAL, state=stream.state)
    assert moved.push(second).ax.tobytes() == stream.push(second).ax.tobytes()


@pytest.mark.parametrize("kind", ["angle", "rate"])
def test_a_record_with_a_gap_is_the_same_whole_and_streamed(kind):
    """The gap of 0.51 s begins a stretch in both, is counted, and is no interval of the record."""
    columns = {name: column[150:250] for name, column in noisy_columns(kind).items()}
    t, output, f = columns["t"], columns["output"], columns["f"]
    run = piga.Run.from_arrays(
        t, output, f, scale_factor=K_G / G0, kind=kind, base_rate=columns["base_rate"], units="SI"
    )
    behind = int(np.argmax(t > 2.4))
    assert np.flatnonzero(run.begins).tolist() == [0, behind]
    assert [(event.kind, event.count, event.first_row) for event in run.quality.events] == [
        ("gap", 1, behind + 1)
    ]
    assert run.duration == pytest.approx(0.98)
    whole = piga.compensate(run, CAL)
    assert np.flatnonzero(whole.flagged("no_increment")).tolist() == [0, behind]
    for chunk in (columns, run):
        streamed = piga.Compensator(CAL, kind=kind, step=run.median_step).push(chunk)
        for name in ("ax", "dv", "u_ax", "flags"):
            assert getattr(streamed, name).tobytes() == getattr(whole, name).tobytes(), name


def test_stretches_of_a_record_are_kept_in_a_stream():
    """A lost sample number leaves no gap in time: the record knows of it, and a stream of two records."""
    t = np.arange(20) * 0.01
    run = run_of(t, constant_force(t, 1.0, 1.0), phi=0.3)
    run.begins[12] = True
    stream = piga.Compensator(CAL)
    assert np.flatnonzero(stream.push(run).flagged("no_increment")).tolist() == [0, 12]
    later = run_of(t + 0.2, constant_force(t, 1.0, 1.0), phi=0.3)
    assert not stream.push(later).flagged("no_increment").any()
    assert stream.push(run_of(t + 0.5, constant_force(t, 1.0, 1.0), phi=0.3)).flagged("no_increment")[0]


LIMITED_ROWS = 300 if numba.config.DISABLE_JIT else 10_000


CUTS = (0, 1, 2, 64, 65, 130, 250, LIMITED_ROWS)


LIMITED = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.3, "s1": 1e-5, "c1": -2e-5})


def samples(seed: int = 1) -> dict[str, np.ndarray]:
    """Any numbers will do; the angle passes the limit of the fast reduction."""
    rng = np.random.default_rng(seed)
    angle = 1.5999e6 + np.cumsum(np.abs(rng.standard_normal(LIMITED_ROWS)))
    begins = np.zeros(LIMITED_ROWS, dtype=bool)
    begins[[70, 200]] = True
    return {
        "t": np.cumsum(0.01 + 1e-4 * rng.random(LIMITED_ROWS)), "output": rng.standard_normal(LIMITED_ROWS),
        "f": 9.8 * rng.standard_normal((LIMITED_ROWS, 3)), "angle": angle, "begins": begins,
    }  # fmt: skip


LIMITED_STD = {"scale_factor": 1e-7, "tan_beta": 1e-6, "phi": 1e-4, "k0": 1e-6}


VALUES = {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.3, "s1": 1e-5, "c1": -2e-5, "k0": 1e-3}


LIMITS = Diagnostics(range={"a_x": (-20.0, 20.0), "a_t": (0.0, 15.0)})


def test_bad_number_in_a_set_is_named_and_leaves_the_state():
    data = samples()
    psi = np.tile(data["angle"], (3, 1))
    mounted = [Mounted(LIMITED, axes) for axes in orthogonal()]
    stream, sound = SetCompensator(mounted), SetCompensator(mounted)
    stream.push(data["t"][:10], psi[:, :10])
    sound.push(data["t"][:10], psi[:, :10])
    broken = psi[:, 10:20].copy()
    broken[1, 9] = np.nan
    with pytest.raises(piga.ArgumentError, match=r"output\[1, 9\] is not finite"):
        stream.push(data["t"][10:20], broken)
    again = [s.push(data["t"][10:20], psi[:, 10:20]).f for s in (stream, sound)]
    assert again[0].tobytes() == again[1].tobytes()


def angle_samples(start: float) -> dict[str, np.ndarray]:
    """Intervals that turn little and far, even and uneven, beginnings, one repeated time; weak and strong force."""
    rng = np.random.default_rng(7)
    step = np.where(
        np.arange(LIMITED_ROWS) % 150 < 90, 0.01, rng.choice([0.01, 0.012, 0.05, 1.5], LIMITED_ROWS)
    )
    step[120] = 0.0
    begins = np.zeros(LIMITED_ROWS, dtype=bool)
    begins[[70, 131, 132, 200]] = True
    force = (
        9.8
        * (0.3 + rng.standard_normal((LIMITED_ROWS, 3)))
        * np.where(np.arange(LIMITED_ROWS) % 40 < 25, 1.0, 1e-2)[:, None]
    )
    turn = K_G * step * force[:, 0] / 9.8
    turn[90] = 30.0
    return {"t": np.cumsum(step), "output": start + np.cumsum(turn), "f": force, "begins": begins}


@pytest.mark.interpreted
@pytest.mark.parametrize("left_out", [(), tuple(LIMITED_STD)])
def test_angles_are_the_same_to_the_bit_whatever_the_chunks_and_what_is_asked_for(left_out):
    columns = angle_samples(1.6e6 - 30.0)
    std = {name: u for name, u in LIMITED_STD.items() if name not in left_out}
    cal = calibration_of(VALUES, std, angle_rms=1e-6, angle_random_walk=1e-5, diagnostics=LIMITS)
    whole = piga.Compensator(cal).push(columns)
    assert len(set(whole.flags.tolist())) > 4
    assert whole.flagged("no_increment")[120]
    rng = np.random.default_rng(8)
    for cuts in (CUTS, (0, *np.sort(rng.integers(0, LIMITED_ROWS, 20)), LIMITED_ROWS)):
        assert_same_bits(in_pieces(piga.Compensator(cal), columns, cuts), whole)
    for wanted in ({"flags": False}, {"uncertainty": False}, {"flags": False, "uncertainty": False}):
        rows = piga.Compensator(cal, **wanted).push(columns)
        assert rows.ax.tobytes() == whole.ax.tobytes()
        assert rows.dv.tobytes() == whole.dv.tobytes()
        assert not rows.u_ax.size or rows.u_ax.tobytes() == whole.u_ax.tobytes()
        assert not rows.flags.size or rows.flags.tobytes() == whole.flags.tobytes()
