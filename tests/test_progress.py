"""Long calls say how far they are, and stop when they are told to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

import piga
from piga.records.run_file import UncertaintyTable
from tests.short_record import SCALE, TERMS

EXAMPLES = Path(__file__).parents[1] / "examples"


def heard(call, **settings):
    steps = []
    result = call(progress=lambda done, total, what: steps.append((done, total, what)), **settings)
    return result, steps


def goes_up(steps) -> bool:
    done = [step[0] for step in steps]
    return done == sorted(done) and len({step[1] for step in steps}) == 1 and done[-1] == steps[-1][1]


def test_a_plan_and_a_platform_stop_when_told():
    plan = piga.read_plan(EXAMPLES / "plan-dividing-head.toml")
    with pytest.raises(piga.CancelledError, match="listing positions"):
        piga.plan_test(plan, progress=lambda *_: False)
    scenario = piga.platform.load_scenario(EXAMPLES / "platform-published.toml")
    with pytest.raises(piga.CancelledError, match="simulating"):
        piga.platform.compare(scenario, progress=lambda *_: False)


def long_calls(run: piga.Run, cal: piga.Calibration) -> dict[str, Callable[..., object]]:
    """Calls that take long on long records, each small here."""
    run = run.between(0.0, 12.0)
    other = replace(run, output=run.output + 1e-6 * np.sin(run.t), input_sha256={"other.csv": "1"})
    budgeted = [
        replace(one, uncertainty=UncertaintyTable(reference_scale="10 ppm", reference_bias="1 ug"))
        for one in (run, other)
    ]
    axes = [np.roll(np.eye(3), k, axis=1) for k in range(3)]
    inst = piga.Instrument(scale_factor=SCALE, beta="1000 arcsec", alpha0=0.4)
    known = piga.Calibration.from_coefficients({"scale_factor": 0.8884, "tan_beta": inst.tan_beta, "phi": 0.0})
    runs = [
        piga.Run.from_arrays(
            run.t,
            piga.propagate(inst, run.t, run.f @ a.T, between="linear"),
            run.f @ a.T,
            scale_factor=SCALE,
            units="SI",
        )
        for a in axes
    ]
    return {
        "joint": lambda progress: piga.calibrate(budgeted, TERMS, progress=progress),
        "budget": lambda progress: piga.calibrate(budgeted[0], TERMS, progress=progress),
        "compare": lambda progress: piga.compare_models(run, [TERMS[:2], TERMS], progress=progress),
        "set": lambda progress: piga.compensate_set(
            runs, [piga.Mounted(known, a) for a in axes], progress=progress
        ),
        "rows": lambda progress: piga.compensate(run, cal, progress=progress),
    }


LONG = ("joint", "budget", "compare", "set", "rows")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", LONG)
def test_a_long_call_tells_its_steps_and_stops_when_told(run, cal, name):
    call = long_calls(run, cal)[name]
    _, steps = heard(call)
    assert len(steps) >= 2
    assert goes_up(steps)
    assert len(set(steps)) == len(steps)
    told: list[str] = []

    def progress(_done: float, _total: float, what: str) -> bool:
        told.append(what)
        return len(told) <= len(steps) // 2

    with pytest.raises(piga.CancelledError, match="stopped before: ") as stopped:
        call(progress=progress)
    assert len(told) == len(steps) // 2 + 1
    assert told[-1] in str(stopped.value)


def test_a_stopped_file_is_as_it_was(run, cal, tmp_path, monkeypatch):
    from piga.compensation.result import write_rows
    from piga.output import write_whole

    monkeypatch.setattr("piga.compensation.result.GROUP_ROWS", 100)
    result = piga.compensate(run, cal)
    out = tmp_path / "out.parquet"
    out.write_text("before")

    def write(stop: float) -> list[float]:
        told: list[float] = []

        def progress(done: float, _total: float, _what: str) -> bool:
            told.append(done)
            return done < stop

        write_whole(out, lambda path: write_rows(result, path, "parquet", progress=progress))
        return told

    with pytest.raises(piga.CancelledError, match="nothing was written"):
        write(500)
    assert out.read_text() == "before"
    assert [path.name for path in tmp_path.iterdir()] == ["out.parquet"]
    assert write(np.inf) == [100, 200, 300, 400, 500, 600, 700, 800]
    assert pa.parquet.read_table(out)["ax"].to_numpy().tobytes() == result.ax.tobytes()
