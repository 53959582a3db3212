"""Streams: the result is the same to the bit, whatever the chunks and whatever else is asked for."""

from __future__ import annotations

import numba
import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import piga
from piga.units import G0
from tests.compensation import run_files
from tests.compensation.run_files import run_text, write
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
    """The gap of 0.51 s begins a stretch in both."""
    columns = {name: column[150:250] for name, column in noisy_columns(kind).items()}
    t, output, f = columns["t"], columns["output"], columns["f"]
    run = piga.Run.from_arrays(
        t, output, f, scale_factor=K_G / G0, kind=kind, base_rate=columns["base_rate"], units="SI"
    )
    behind = int(np.argmax(t > 2.4))
    whole = piga.compensate(run, CAL)
    assert np.flatnonzero(whole.flagged("no_increment")).tolist() == [0, behind]
    streamed = piga.Compensator(CAL, kind=kind, step=run.median_step).push(columns)
    for name in ("ax", "dv", "u_ax", "flags"):
        assert getattr(streamed, name).tobytes() == getattr(whole, name).tobytes(), name


def test_a_lost_sample_number_begins_a_stretch():
    """It leaves no gap in time: the record knows of it, and ``begins`` of a stream."""
    t = np.arange(20) * 0.01
    run = run_of(t, constant_force(t, 1.0, 1.0), phi=0.3)
    run.begins[12] = True
    chunk = {"t": t, "output": run.output, "f": run.f, "begins": run.begins}
    for result in (piga.compensate(run, CAL), piga.Compensator(CAL).push(chunk)):
        assert np.flatnonzero(result.flagged("no_increment")).tolist() == [0, 12]


@pytest.mark.parametrize(("turn", "kept"), [(2.0 * np.pi, True), (5.0, False)])
def test_a_gap_loses_the_phase_of_a_range_that_is_no_whole_turn(tmp_path, turn, kept):
    path, data = write(tmp_path, rows=400), tmp_path / "run.parquet"
    table = pa.parquet.read_table(data).to_pydict()
    table["t"] = np.array(table["t"]) + np.where(np.arange(400) < 300, 0.0, 7.0)
    table["psi"] = np.mod(np.array(table["psi"]) + 1.0, turn)
    pa.parquet.write_table(pa.table(table), data)
    folded = f'kind = "angle", unit = "rad", wraps_at = "{turn!r} rad"'
    path.write_text(run_text(data.name, folded))
    run, cal = piga.read_run(path), calibration_of(run_files.CAL, serial="A")
    if kept:
        assert np.count_nonzero(piga.compensate(run, cal).flagged("no_increment")) == 2
        return
    with pytest.raises(piga.CalibrationError, match="the zero of the output angle was lost before segment"):
        piga.compensate(run, cal)
