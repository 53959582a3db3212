"""Plans for direct instruments: the uncertainty against weighted least squares with NumPy, and nothing of a gimbal."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import piga
from piga.planning.candidates import read_plan
from piga.planning.plan import Plan, plan_document, plan_test, program_csv, scenario_text
from piga.reports.planning import page
from piga.reports.render.page import page_html

TEXT = """
[instrument]
serial = "QA-1"
kind = "direct"
scale_factor = "{K} {unit}/g"
[truth]
k0 = "2e-3 g"
m_Y = "300 urad"
[electronics]
sample_rate = "10 Hz"
{output}
[stand]
kind = "dividing-head"
latitude = "40 deg"
positions = "0:360:30 deg"
move = "30 s"
[model]
terms = ["scale_factor", "k0", "k2", "m_Y"]
[plan]
duration = "900 s"
wanted = {{ scale_factor = "{wanted} {unit}/g" }}
"""
CASES = {
    "mA": (1.3, 1e-3, 'output = "rate"\nunit = "mA"\nangle_random_walk = "1e-6 mA s/sqrt(s)"'),
    "count/s": (5e4, 1.0, 'output = "counts"'),
}


@pytest.fixture(scope="module", params=CASES)
def plan(request: pytest.FixtureRequest) -> Plan:
    K, wanted, output = CASES[request.param]
    text = TEXT.format(K=K, unit=request.param, output=output, wanted=wanted)
    return plan_test(read_plan("plan.toml", content=text))


@pytest.mark.long
def test_uncertainties_are_those_of_means_of_the_visits(plan: Plan) -> None:
    K, wanted, _ = CASES[plan.request.unit]
    g = np.array([visit.candidate.force for visit in plan.best.visits]) / 9.80665
    x, y, dwell = g[:, 0], g[:, 1], np.array([visit.dwell for visit in plan.best.visits])
    columns = np.stack((x, np.ones(x.size), x**2, y), axis=1) * [1.0, K, K, K]
    n = dwell * 10.0 + 1.0
    slope = 0.1**-2 / (n * (n**2 - 1.0))  # of a line through counts with a variance of 1/12
    variance = slope if plan.request.unit == "count/s" else 1e-6**2 / dwell
    expected = np.sqrt(np.diag(np.linalg.inv(columns.T @ (columns / variance[:, None]))))
    assert [plan.best.std(name) for name in plan.request.names] == pytest.approx(expected, rel=0.02)
    assert all(visit.candidate.margin == visit.candidate.revolution == np.inf for visit in plan.best.visits)
    assert plan.request.wanted["scale_factor"] == pytest.approx(wanted, rel=1e-12)


@pytest.mark.long
def test_page_program_and_scenario_have_nothing_of_a_gimbal(plan: Plan) -> None:
    text = scenario_text(plan)
    shown = page_html(page(plan)).split("plotly.js v")[0] + text + program_csv(plan) + str(plan_document(plan))
    assert not re.findall(r"gimbal|revolution|lock zone|rad/s|phase|tan\(?_?beta", shown)
    assert f"{plan.request.unit}/g" in shown
    scenario = piga.stand.read_scenario("scenario.toml", content=text)
    assert scenario.specimen.unit == plan.request.unit


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"k2"', '"tan_beta"', "'tan_beta' turns with the gimbal"),
        (
            "[plan]",
            '[mounting]\nprofile = {{ kind = "dividing-head", latitude = "0 deg", positions = [] }}\n[plan]',
            "belongs to a gyro",
        ),
        ('{unit}/g" }}', 'rad/s/g" }}', "wanted.scale_factor"),
    ],
)
def test_what_belongs_to_a_gimbal_is_refused_by_name(tmp_path: Path, old: str, new: str, words: str) -> None:
    K, wanted, output = CASES["mA"]
    text = TEXT.replace(old, new).format(K=K, unit="mA", output=output, wanted=wanted)
    with pytest.raises(piga.PigaError, match=words):
        read_plan(tmp_path / "plan.toml", content=text)
