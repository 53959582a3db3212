"""Every public class keeps the contract: short repr, HTML, equality, hash, pickle, tables, plots with labels."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure as Canvas

import piga
from piga.results import Result
from piga.studies import capstone
from tests.planning.cases import request
from tests.short_record import SCALE, pickled

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    return piga.plan_test(request(tmp_path_factory.mktemp("plan"), terms='"scale_factor", "k0"'))


@pytest.fixture(scope="module")
def platform_results():
    """Two hours of a platform with gyro accelerometers."""
    scenario = piga.platform.load_scenario(ROOT / "examples" / "platform-piga.toml")
    short = replace(scenario, duration=7200.0, calibration_time=3600.0)
    run = piga.platform.simulate(short)
    prepared = piga.platform.prepare(run)
    return {
        "PlatformScenario": short,
        "PlatformRun": run,
        "Readouts": run.readouts,
        "Identification": prepared.identification,
        "Alignment": prepared.alignment,
        "Start": prepared.start,
        "Knowledge": prepared.knowledge,
        "Comparison": piga.platform.compare(short),
        "Capstone": capstone(short),
        "Short": piga.platform.compare(replace(short, duration=1000.0, calibration_time=1000.0)),
    }


PLATFORM = (
    "PlatformScenario", "PlatformRun", "Readouts", "Identification", "Alignment", "Start", "Knowledge",
    "Comparison", "Capstone", "Short",
)  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("name", PLATFORM)
def test_a_result_of_the_platform_keeps_the_contract(platform_results, name):
    keeps_the_contract(platform_results[name])


@pytest.mark.long
def test_a_plan_keeps_the_contract(plan):
    keeps_the_contract(plan)
    _, dwell = plan.plot().axes
    assert all(tick == int(tick) for tick in dwell.get_xticks())


@pytest.fixture(scope="module")
def samples(run, cal):
    import datetime as dt

    from piga.earth import Site
    from piga.instrument import Electronics
    from piga.stand import DividingHead, Specimen

    inst = piga.Instrument(scale_factor=SCALE, beta="500 arcsec", alpha0=0.1)
    head = DividingHead(Site(0.7), positions=(0.1, 0.9, 2.2, 3.9), dwell=5.0)
    axes = [np.roll(np.eye(3), k, axis=1) for k in range(3)]
    t = np.arange(200) * 0.05
    f = 9.8 * np.column_stack([0.6 + 0.1 * np.sin(t), 0.5 + 0 * t, 0.7 + 0 * t])
    known = piga.Calibration.from_coefficients({"scale_factor": 0.8884, "tan_beta": inst.tan_beta, "phi": 0.0})
    runs = [
        piga.Run.from_arrays(
            t, piga.propagate(inst, t, f @ a.T, between="linear"), f @ a.T, scale_factor=SCALE, units="SI"
        )
        for a in axes
    ]
    dates = [dt.datetime(2024, month, 1, tzinfo=dt.UTC) for month in (1, 4, 8, 12)]
    residual = cal.residuals
    return {
        "Run": run,
        "Calibration": cal,
        "Coefficient": cal["k0"],
        "Residuals": residual,
        "BudgetTable": cal.budget,
        "Quality": cal.quality,
        "Provenance": cal.provenance,
        "Compensated": piga.compensate(run, cal),
        "CompensatedSet": piga.compensate_set(runs, [piga.Mounted(known, a) for a in axes]),
        "Instrument": inst,
        "ErrorModel": piga.ErrorModel(k0="1 ug"),
        "SimulatedTest": piga.simulate_test(head, Specimen(inst), Electronics(sample_rate=5.0)),
        "Trend": piga.find_trend([(f"r{d:%m}", d, cal) for d in dates]),
        "AllanDeviation": piga.allan_deviation(
            residual.after[:400], residual.t[:400], np.arange(400) == 0, noise={0: 1.0}
        ),
        "NoiseAnalysis": piga.analyse_noise(residual.after[:400], residual.t[:400], kind="angle"),
        "RunSummary": piga.RunSummary.of(run),
    }


NAMES = (
    "Run", "Calibration", "Coefficient", "Residuals", "BudgetTable", "Quality", "Provenance", "Compensated",
    "CompensatedSet", "Instrument", "ErrorModel", "SimulatedTest", "Trend", "AllanDeviation", "NoiseAnalysis",
    "RunSummary",
)  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_a_result_keeps_the_contract(samples, name):
    keeps_the_contract(samples[name])


def keeps_the_contract(value: object) -> None:
    """Short repr and HTML, equality, hash, pickle, copies, and labels on the axes of its plot."""
    assert len(repr(value).splitlines()) <= 10
    assert len(repr(value)) <= 3000
    again = pickled(value)
    assert again == value
    assert copy.copy(value) == value
    assert copy.deepcopy(value) == value
    assert value != "something else"
    assert hasattr(value, "_repr_html_") or not isinstance(value, Result)
    if hasattr(value, "_repr_html_"):
        html = value._repr_html_()
        assert "<table>" in html
        assert len(html) < 200_000
    if callable(getattr(value, "plot", None)):
        drawn = value.plot()
        labelled(drawn)
        labelled(value.plot(ax=Canvas().subplots(len(drawn.axes))))


def labelled(figure: Canvas) -> None:
    """Every axes of a figure has labels."""
    assert figure.axes
    for axes in figure.axes:
        assert axes.get_xlabel()
        assert axes.get_ylabel()
