"""Long calls say how far they are, and stop when they are told to."""

from __future__ import annotations

import pytest

import piga
from piga.progress import Steps, report
from tests.results.conftest import SCALE, TERMS, a_run


def heard(call, **settings):
    steps = []
    result = call(progress=lambda done, total, what: steps.append((done, total, what)), **settings)
    return result, steps


def goes_up(steps) -> bool:
    done = [step[0] for step in steps]
    return done == sorted(done) and len({step[1] for step in steps}) == 1 and done[-1] == steps[-1][1]


def test_calibrate_says_its_steps(run, cal):
    found, steps = heard(lambda progress: piga.calibrate(run, TERMS, progress=progress))
    assert found == cal.__class__(**found.__dict__)
    assert [step[2] for step in steps][:2] == ["fitting the model", "finding the noise"]
    assert goes_up(steps)
    assert found["k0"] == cal["k0"]


def test_compensate_says_its_rows(run, cal):
    result, steps = heard(lambda progress: piga.compensate(run, cal, progress=progress))
    assert goes_up(steps)
    assert steps[-1][:2] == (run.size, run.size)
    assert result == piga.compensate(run, cal)


@pytest.mark.parametrize("stop_at", [0, 1, 3])
def test_a_call_stops_when_progress_returns_false(run, stop_at):
    calls = []

    def progress(done: float, _total: float, what: str) -> bool:
        calls.append(what)
        return done < stop_at

    with pytest.raises(piga.CancelledError, match=r"stopped before: .*") as stopped:
        piga.calibrate(run, TERMS, progress=progress)
    assert len(calls) == stop_at + 1
    assert calls[-1] in str(stopped.value)


def test_none_and_true_go_on_and_only_false_stops():
    for answer in (None, True, 0, ""):
        report(lambda *_, answer=answer: answer, 0, 1, "x")
    with pytest.raises(piga.CancelledError):
        report(lambda *_: False, 0, 1, "x")
    report(None, 0, 1, "x")


def test_an_error_of_the_callers_function_reaches_the_caller(run, cal):
    def interrupted(*_: object) -> bool:
        raise KeyboardInterrupt

    for call in (
        lambda p: piga.calibrate(run, TERMS, progress=p),
        lambda p: piga.compensate(run, cal, progress=p),
    ):
        with pytest.raises(KeyboardInterrupt):
            call(interrupted)
    assert piga.calibrate(run, TERMS)["k0"] == cal["k0"]


def test_simulation_platform_plan_and_reproduction_say_their_steps(tmp_path):
    from pathlib import Path

    from piga.earth import Site
    from piga.instrument import Electronics
    from piga.stand import DividingHead, Specimen
    from piga.studies import reproduce

    head = DividingHead(Site(0.7), positions=(0.1, 0.9), dwell=5.0)
    specimen = Specimen(piga.Instrument(scale_factor=SCALE, beta="500 arcsec"))
    test, steps = heard(
        lambda progress: piga.simulate_test(head, specimen, Electronics(sample_rate=5.0), progress=progress)
    )
    assert len(steps) == 3
    assert test == piga.simulate_test(head, specimen, Electronics(sample_rate=5.0))
    found, steps = heard(lambda progress: reproduce("mounting", progress=progress))
    assert found.cases
    assert [step[2] for step in steps] == ["mounting", "done"]
    plan = piga.read_plan(Path(__file__).parents[2] / "examples" / "plan-dividing-head.toml")
    with pytest.raises(piga.CancelledError, match="listing positions"):
        piga.plan_test(plan, progress=lambda *_: False)
    scenario = piga.platform.load_scenario(Path(__file__).parents[2] / "examples" / "platform-published.toml")
    with pytest.raises(piga.CancelledError, match="simulating"):
        piga.platform.compare(scenario, progress=lambda *_: False)


def test_steps_count():
    said = []
    steps = Steps(lambda *where: said.append(where), 2)
    steps("a")
    steps("b")
    steps.finish()
    assert said == [(0, 2, "a"), (1, 2, "b"), (2, 2, "done")]


def test_a_long_record_reports_more_than_once(cal, monkeypatch):
    from piga.records import spool

    run = a_run()
    _, steps = heard(lambda progress: piga.compensate(run, cal, progress=progress))
    assert [step[0] for step in steps] == [0, 400, 800]
    assert spool.BLOCK > 800
