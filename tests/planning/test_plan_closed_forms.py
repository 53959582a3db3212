"""Planning on tests small enough to be interpreted: against closed forms, and every output of the command."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import pytest
from scipy import stats
from typer.testing import CliRunner

from piga.cli.main import app
from piga.planning.plan import Plan, plan_document, plan_test, scenario_text
from piga.stand import read_scenario
from tests.planning.cases import request

pytestmark = pytest.mark.long
WALK = 1e-5
TINY = {"rate": 1, "positions": "0:360:90 deg", "duration": 250, "terms": '"scale_factor", "k0"', "walk": WALK}
SMALL = {"rate": 1, "positions": "0:360:60 deg", "duration": 301, "terms": '"scale_factor", "k0"', "walk": WALK}


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    wishes = 'wanted = { k0 = "2 ug" }\nmove = "1 s"\nmargin = 700.0\nlongest_dwell = "400 s"'
    return plan_test(request(tmp_path_factory.mktemp("plan"), **SMALL, plan=wishes))


def test_up_and_down_with_the_uncertainty_of_the_closed_form(plan: Plan) -> None:
    """A walk q over the dwell T leaves the mean rate with q / sqrt(T): K and k0 from two of them at +-g."""
    assert {visit.candidate.label for visit in plan.best.visits} == {"0 deg", "180 deg"}
    labels = [visit.candidate.label for visit in plan.best.visits]
    assert min(labels.count(label) for label in set(labels)) >= 2  # visited once, it determines both alone
    up = sum(visit.dwell for visit in plan.best.visits if visit.candidate.label == "0 deg")
    assert up == pytest.approx(0.5 * plan.best.recorded, rel=0.05)
    assert plan.best.duration <= 301.0 + 1e-9
    mean = (
        WALK / math.sqrt(0.5 * plan.best.recorded) / math.sqrt(2.0)
    )  # of half the sum, and half the difference
    gravity = plan.best.coefficients[0].value  # K [rad/s/g]; at +-1 g the local gravity is within 0.3 % of it
    assert plan.best.std("scale_factor") == pytest.approx(mean, rel=0.01)
    assert plan.best.std("k0") == pytest.approx(mean / gravity, rel=0.01)
    assert 0.9 < plan.efficiency <= 1.0
    assert plan.largest_derivative == pytest.approx(2.0, rel=5e-3)
    assert plan.standard[-1].std("k0") >= plan.best.std("k0")


def test_document_text_and_scenario(plan: Plan, tmp_path: Path) -> None:
    cheapest, document = plan.cheapest, plan_document(plan, None)
    assert cheapest is not None
    assert cheapest.plan is not None
    assert cheapest.plan.std("k0") <= 2e-6
    assert cheapest.bound <= cheapest.plan.duration < plan.best.duration
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert document["cheapest"]["duration_s"] == cheapest.plan.duration
    planned = document["planned"]["standard_uncertainty"]["k0"]
    degrees = plan.best.degrees("k0")
    assert degrees == pytest.approx(len(plan.best.visits) - 2, rel=0.02)  # two means of equal visits
    assert planned == {
        "type_a": plan.best.std("k0"),
        "combined": plan.best.combined("k0"),
        "expanded": pytest.approx(stats.t.ppf(0.975, degrees) * plan.best.std("k0"), rel=1e-6),
        "degrees_of_freedom": pytest.approx(degrees),
        "unit": "g",
    }
    reasons = {one.label: reason for one, reason in plan.excluded}
    assert set(reasons) == {"60 deg", "120 deg", "240 deg", "300 deg"}
    assert reasons["60 deg"].startswith("within 700 times the lock zone")
    assert [row["reason"] for row in document["excluded"]] == list(reasons.values())
    (tmp_path / "s.toml").write_text(scenario_text(plan), encoding="utf-8")
    segments = read_scenario(tmp_path / "s.toml").stand.segments()
    assert [s.duration for s in segments if s.recorded] == [visit.dwell for visit in plan.best.visits]


def test_the_stand_may_not_be_good_enough(tmp_path: Path) -> None:
    wish = request(
        tmp_path,
        **TINY,
        plan='wanted = { scale_factor = "1e-9 rad/s/g" }',
        more='[uncertainty]\nreference_scale = "1 ppm"',
    )
    plan = plan_test(wish)
    assert plan.cheapest is not None
    assert plan.cheapest.plan is None
    assert "the stand alone adds" in plan.cheapest.refusal
    both = math.hypot(plan.best.std("scale_factor"), 0.8884e-6)
    assert plan.best.combined("scale_factor") == pytest.approx(both, rel=1e-3)
    assert plan.best.combined("k9") == plan.best.std("k9") == math.inf
    assert plan_document(plan, None)["cheapest"]["refusal"] == plan.cheapest.refusal


def test_dwells_of_whole_turns(tmp_path: Path) -> None:
    plan = plan_test(request(tmp_path, **TINY | {"rate": 4, "duration": 270}, whole="true"))
    turns = [visit.dwell / visit.candidate.revolution for visit in plan.best.visits]
    for visit, turn in zip(plan.best.visits, turns, strict=True):
        assert abs(turn - round(turn)) * visit.candidate.revolution <= 0.25 + 1e-9


def test_the_command_writes_the_plan(tmp_path: Path) -> None:
    path = request(tmp_path, **TINY).path
    done = CliRunner().invoke(app, ["plan", str(path), "--out", str(tmp_path / "out"), "--json"])
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    assert document["schema"] == "piga.plan/1"
    assert json.loads((tmp_path / "out" / "plan.json").read_text()) == document
    scenario = read_scenario(tmp_path / "out" / "scenario.toml")
    assert scenario.stand.segments()
    with (tmp_path / "out" / "program.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["position"], float(row["hold_s"])) for row in rows] == [
        (visit["position"], pytest.approx(visit["dwell_s"], abs=1e-3)) for visit in document["visits"]
    ]
    ends = [float(row["begin_s"]) + float(row["hold_s"]) for row in rows]
    assert ends[-1] == pytest.approx(document["duration_s"], abs=0.01)
    assert all(abs(sum(float(row[f"a_{axis}_g"]) ** 2 for axis in "xYZ") - 1.0) < 0.01 for row in rows)
    assert "</html>" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
