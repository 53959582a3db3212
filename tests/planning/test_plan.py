"""Planning: the optimum is one, the prediction is what happens, and what cannot be planned is refused."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

import piga
from piga.calibration.fit import fit_run
from piga.calibration.model.request import make_request
from piga.cli.main import app
from piga.errors import CalibrationError, IdentifiabilityError, PigaError
from piga.planning.candidates import (
    Visit,
    find_candidates,
    information_tables,
    predict,
    read_plan,
)
from piga.planning.plan import Plan, plan_document, plan_mounting, plan_test, scenario_text
from piga.planning.search import Criterion, whole_pairs
from piga.reports.planning import page
from piga.reports.render.page import page_text
from piga.stand import Scenario, read_scenario, run_scenario
from tests.chance import assert_variance
from tests.planning.cases import request

pytestmark = pytest.mark.interpreted
REPEATS = 30


def simulated(scenario: Scenario, seed: int) -> piga.Run:
    """The record of a planned test."""
    log = run_scenario(scenario, seed=seed).log
    return piga.Run.from_arrays(
        log.t, log.output, log.reference, scale_factor="0.8884 rad/s/g", base_rate=log.base_rate, segment=log.segment,
        units="SI", uncertainty={"waived": {"servo": "simulated without"}},
    )  # fmt: skip


def regression(points: np.ndarray, degree: int) -> np.ndarray:
    """Information matrices of polynomial regression."""
    rows = points[:, None] ** np.arange(degree + 1)
    return rows[:, :, None] * rows[:, None, :]


@pytest.mark.parametrize(
    ("degree", "support"), [(1, [-1, 1]), (2, [-1, 0, 1]), (3, [-1, -(5**-0.5), 5**-0.5, 1])]
)
def test_d_optimum_of_polynomial_regression(degree, support):
    """Known optima: equal weights at the zeros of (1 - x^2) P'_d(x)."""
    points, count = np.union1d(np.linspace(-1.0, 1.0, 201), support), 2 * len(support)
    criterion = Criterion(np.eye(degree + 1), 0.0)
    value, places = whole_pairs(regression(points, degree), criterion, count)
    best = criterion.values(regression(np.array(support), degree).mean(axis=0))
    assert value == pytest.approx(float(best) - math.log(count), abs=5e-4)
    assert np.sort(points[places]) == pytest.approx(np.repeat(support, 2), abs=0.011)


def test_c_and_a_optima_of_a_line():
    """Slope of a line: half at either end, variance 1. A-optimum for (1, x) on [-1, 1]: the same, mean variance 1."""
    points = np.linspace(-1.0, 1.0, 21)
    for criterion in (Criterion(np.array([[0.0, 1.0]]), 1.0), Criterion(np.eye(2), 1.0)):
        value, places = whole_pairs(regression(points, 1), criterion, 6)
        assert value == pytest.approx(-math.log(6.0), abs=1e-4)
        assert list(np.sort(points[places])) == [-1.0] * 3 + [1.0] * 3


def test_a_singular_plan_has_a_finite_value():
    """A long test of one position: its information is large in one direction, and none in the others."""
    one = np.outer([4096.0, 2048.0, 1024.0], [4096.0, 2048.0, 1024.0])
    values = Criterion(np.eye(3), 0.0).values(np.array([one, one + np.eye(3)]))
    assert np.isfinite(values).all()
    assert values[0] > values[1]


SERVO = {
    "terms": '"scale_factor", "tan_beta", "k0", "servo", "servo_damping"',
    "positions": "5:365:60 deg",
}


def with_servo(folder, **changes):
    """A plan for an instrument whose servo is soft."""
    path = request(folder, **(SERVO | changes)).path
    own = 'k0 = "3e-4 g"\nservo = "13 ug/g^3"\nservo_damping = "20 ug/g^3"'
    path.write_text(path.read_text(encoding="utf-8").replace('k0 = "3e-4 g"', own), encoding="utf-8")
    return read_plan(path)


TABLES = {"terms": '"scale_factor", "tan_beta", "k0"'}


@pytest.mark.parametrize(
    ("made", "changes"),
    [
        (request, TABLES),
        (request, TABLES | {"phases": "per-segment"}),
        (request, TABLES | {"phases": "per-segment", "walk": 1e-6, "white": 1e-4}),
        (with_servo, {}),
    ],
)
def test_tables_agree_with_the_estimator(tmp_path, made, changes):
    """Summed information of visits is the inverse of the covariance that the calibration reports."""
    wish = made(tmp_path, **changes)
    places = find_candidates(wish)[:: 2 if made is request else 1]
    tables = information_tables(wish, places, np.array([30.0, 60.0]))
    prediction = predict(wish, "x", tuple(Visit(c, 60.0) for c in places))
    std = np.sqrt(np.diag(np.linalg.inv(tables[:, -1].sum(axis=0))))
    for name, value in zip(wish.names, std, strict=True):
        assert prediction.std(name) == pytest.approx(value, rel=0.02), name


@pytest.mark.long
@pytest.mark.parametrize("criterion", ["D", "A", "c", "wanted"])
def test_no_standard_plan_is_better(tmp_path, criterion):
    extra = 'combination = { k0 = 1.0 }\nwanted = { k0 = "1 ug", m_Y = "1 urad" }'
    plan = plan_test(request(tmp_path, plan=f'criterion = "{criterion}"\n{extra}'))
    size = {
        "D": lambda p: math.exp(np.linalg.slogdet(p.covariance * 1e12)[1]),
        "A": lambda p: sum((p.std(name) / plan.best.std(name)) ** 2 for name in plan.request.names),
        "c": lambda p: p.std("k0"),
        "wanted": lambda p: max(p.std("k0") / 1e-6, p.std("m_Y") / 1e-6),
    }[criterion]
    assert size(plan.best) <= min(1.02 * size(other) for other in plan.standard if not other.refusal)
    assert plan.best.duration <= 720.0 + 1e-9


@pytest.mark.long
def test_no_plan_is_recommended_that_the_calibration_refuses(tmp_path):
    """Long visits determine coefficients alone: they are cut. The record of the plan has the degrees of freedom predicted."""
    wish = request(
        tmp_path, duration=1300, rate=4, terms='"scale_factor", "tan_beta", "k0"', positions="0:360:90 deg"
    )
    alone = predict(wish, "x", tuple(Visit(c, 300.0) for c in find_candidates(wish)[::2]))
    assert "alone determines" in alone.refusal
    path = tmp_path / "scenario.toml"
    plan = plan_test(wish)
    path.write_text(scenario_text(plan), encoding="utf-8")
    calibration = piga.calibrate(simulated(read_scenario(path), 2), list(wish.model.terms))
    for name in ("scale_factor", "k0"):
        assert plan.best.uncertainty(name)[2] == pytest.approx(calibration[name].degrees_of_freedom, rel=0.3)
        assert plan.best.expanded(name) > 1.99 * plan.best.std(name)


def test_what_cannot_be_planned_is_refused(tmp_path):
    with pytest.raises(IdentifiabilityError, match="this plan cannot separate k0, k2, k_YY"):
        plan_test(request(tmp_path, terms='"scale_factor", "k0", "k2", "k_YY"'))
    with pytest.raises(CalibrationError, match="no noise"):
        plan_test(request(tmp_path, walk=0))
    with pytest.raises(CalibrationError, match="lock zone"):
        plan_test(request(tmp_path, plan="margin = 1e9", positions="30:60:10 deg"))


@pytest.mark.long
def test_levels_of_a_centrifuge_and_a_head_together(tmp_path):
    text = request(tmp_path, terms='"scale_factor", "k0", "k2", "k_YY"').path.read_text(encoding="utf-8")
    first, rest = text.split("[stand]")
    parts = '[stand]\nkind = "composite"\npause = "60 s"\n'
    parts += '[[stand.parts]]\nkind = "dividing-head"\nlatitude = "40 deg"\npositions = "0:360:60 deg"\n'
    parts += '[[stand.parts]]\nkind = "centrifuge"\nlatitude = "40 deg"\nlevels = ["2 g", "5 g"]\ncounter_rotating = true\n'
    path = tmp_path / "both.toml"
    path.write_text(first.replace("2 Hz", "20 Hz") + parts + rest[rest.index("[model]") :], encoding="utf-8")
    plan = plan_test(read_plan(path))
    labels = [visit.candidate.label for visit in plan.best.visits]
    assert any("deg" in label for label in labels)
    assert any(label.endswith("g") and "deg" not in label for label in labels)
    assert all(prediction.refusal for prediction in plan.standard)


PROFILE = """
[mounting]
skew = "0:91:5 deg"
margin = 800.0
profile = { kind = "dividing-head", latitude = "40 deg", positions = [POSITIONS], dwell = "5 s", move = "5 s" }
"""


def mounting_request(folder: Path, positions: str):
    return request(folder, more=PROFILE.replace("POSITIONS", positions), plan='wanted = { k0 = "2 ug" }')


def test_mounting_skew(tmp_path):
    """A force that swings from 0 to 80 deg: least angle to the axis is largest with the axis at 40 deg."""
    mounting = plan_mounting(mounting_request(tmp_path, '"0 deg", "80 deg"'))
    assert math.degrees(mounting.skew) == pytest.approx(40.0)
    assert math.degrees(mounting.clock) == pytest.approx(180.0)
    tangent = math.tan(200.0 / 206264.806)
    assert mounting.margin == pytest.approx(1.0 / (math.tan(math.radians(40.0)) * tangent), rel=0.01)
    assert mounting.margin == mounting.margin_history.min() > mounting.unskewed_history.min() > 1.0
    assert list(np.degrees(mounting.acceptable)) == pytest.approx([30, 35, 40, 45, 50])


def test_mounting_sees_a_passage_between_rows(tmp_path):
    """The force turns through 180 deg and back: every axis in its plane is passed through."""
    mounting = plan_mounting(mounting_request(tmp_path, '"0 deg", "180 deg"'))
    assert mounting.margins[0].max() == 0.0
    assert plan_mounting(request(tmp_path)) is None


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("0:91:5 deg", "0:90 deg", r"\[mounting\] skew: '0:90 deg' is not a range"),
        ("0:91:5 deg", "0:0:5 deg", r"\[mounting\] skew: the range is empty"),
        ("200 arcsec", "0 arcsec", "without it there is no lock zone"),
    ],
)
def test_a_mounting_that_cannot_be_planned(tmp_path, old, new, words):
    path = mounting_request(tmp_path, '"0 deg", "80 deg"').path
    path.write_text(path.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")
    with pytest.raises(piga.PigaError, match=words):
        plan_mounting(read_plan(path))


@pytest.mark.long
def test_prediction_is_what_repeats_show(tmp_path):
    """Spread of the estimates over simulated repeats of the exported scenario."""
    wish = request(tmp_path, duration=400, walk=3e-6, white=5e-5, rate=4)
    plan = plan_test(wish)
    path = tmp_path / "scenario.toml"
    path.write_text(scenario_text(plan), encoding="utf-8")
    scenario = read_scenario(path)
    assert run_scenario(scenario).log.labels == tuple(f"{k}.0" for k in range(len(plan.best.visits)))
    values = []
    for seed in range(REPEATS):
        run = simulated(scenario, seed)
        fit = fit_run(run, make_request(run, list(wish.model.terms), phases=wish.model.phases))
        named, _ = fit.runs.named(fit.estimate, fit.estimate.covariance)
        values.append(
            [c.value for name in plan.request.names if name != "phi" for c in named if c.name == name]
        )
    spread = np.std(values, axis=0, ddof=1)
    for name, s in zip([n for n in plan.request.names if n != "phi"], spread, strict=True):
        assert_variance((s / plan.best.std(name)) ** 2, REPEATS - 1, name)


@pytest.mark.long
@pytest.mark.parametrize("terms", ['"scale_factor", "tan_beta", "k0"', '"scale_factor", "k0"'])
def test_a_given_servo_is_a_source_of_the_plan(tmp_path, terms):
    """An error of 2 % of the integral gain moves K by 2 % of the servo's part; without a table nothing moves it."""
    path = request(tmp_path, terms=terms, positions="5:365:60 deg").path
    text = path.read_text(encoding="utf-8")

    def moved(own):
        path.write_text(text.replace("[instrument]\n", f"[instrument]\n{own}"), encoding="utf-8")
        wish = read_plan(path)
        visits = tuple(Visit(c, 60.0) for c in find_candidates(wish))
        prediction = predict(wish, "x", visits)
        return prediction.type_b[[c.name for c in prediction.coefficients].index("scale_factor")]

    table = (
        'servo = {{ integral_gain = {{ value = "3000 N m/(rad s)", standard = "{} N m/(rad s)" }}, '
        'angular_momentum = "0.1 kg m^2/s" }}\n'
    )
    plain, exact, known = moved(""), moved(table.format("0.0")), moved(table.format("60.0"))
    assert exact == pytest.approx(plain, rel=1e-3, abs=1e-12)
    part = 0.02 * 0.8884**2 * 0.1 / 6000.0 * 0.8884
    assert 0.1 * part < np.sqrt(known**2 - plain**2) < 0.5 * part


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"terms": '"scale_factor", "tan_beta", "k0", "k3", "servo"'}, "this plan cannot separate .*k3.*servo"),
        ({"terms": '"scale_factor", "k0", "servo"'}, "'servo' depends on the output angle"),
    ],
)
def test_a_plan_refuses_what_the_calibration_refuses(tmp_path, changes, words):
    with pytest.raises(PigaError, match=words):
        plan_test(with_servo(tmp_path, **changes))


# -- tests small enough for closed forms, and every output of the command --------------------------------

WALK = 1e-5
TINY = {"rate": 1, "positions": "0:360:90 deg", "duration": 250, "terms": '"scale_factor", "k0"', "walk": WALK}
SMALL = {"rate": 1, "positions": "0:360:60 deg", "duration": 301, "terms": '"scale_factor", "k0"', "walk": WALK}


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    wishes = 'wanted = { k0 = "2 ug" }\nmove = "1 s"\nmargin = 700.0\nlongest_dwell = "400 s"'
    more = PROFILE.replace("POSITIONS", '"0 deg", "80 deg"')
    return plan_test(request(tmp_path_factory.mktemp("plan"), **SMALL, plan=wishes, more=more))


@pytest.mark.long
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
    assert plan.standard[-1].std("k0") >= plan.best.std("k0")


@pytest.mark.long
def test_document_text_and_scenario(plan: Plan, tmp_path: Path) -> None:
    cheapest, document = plan.cheapest, plan_document(plan)
    assert cheapest is not None
    assert cheapest.std("k0") <= 2e-6
    assert cheapest.duration < plan.best.duration
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert document["cheapest"]["duration_s"] == cheapest.duration
    planned = document["planned"]["standard_uncertainty"]["k0"]
    degrees = plan.best.uncertainty("k0")[2]
    assert degrees == pytest.approx(len(plan.best.visits) - 2, rel=0.02)  # two means of equal visits
    assert planned == {
        "type_a": plan.best.std("k0"),
        "combined": plan.best.combined("k0"),
        "expanded": pytest.approx(stats.t.ppf(0.975, degrees) * plan.best.std("k0"), rel=1e-6),
        "degrees_of_freedom": pytest.approx(degrees),
        "unit": "g",
    }
    assert document["mounting"]["skew_deg"] == pytest.approx(40.0)
    assert "Best skew 40 deg towards 180 deg about X: least |a_x| is 12" in page_text(page(plan))
    reasons = {one.label: reason for one, reason in plan.excluded}
    assert set(reasons) == {"60 deg", "120 deg", "240 deg", "300 deg"}
    assert reasons["60 deg"].startswith("within 700 times the lock zone")
    assert [row["reason"] for row in document["excluded"]] == list(reasons.values())
    (tmp_path / "s.toml").write_text(scenario_text(plan), encoding="utf-8")
    segments = read_scenario(tmp_path / "s.toml").stand.segments()
    assert [s.duration for s in segments if s.recorded] == [visit.dwell for visit in plan.best.visits]


@pytest.mark.long
def test_the_stand_may_not_be_good_enough(tmp_path: Path) -> None:
    wish = request(
        tmp_path,
        **TINY,
        plan='wanted = { scale_factor = "1e-9 rad/s/g" }',
        more='[uncertainty]\nreference_scale = "1 ppm"',
    )
    plan = plan_test(wish)
    assert plan.cheapest is not None
    assert "the stand alone adds" in plan.cheapest.refusal
    both = math.hypot(plan.best.std("scale_factor"), 0.8884e-6)
    assert plan.best.combined("scale_factor") == pytest.approx(both, rel=1e-3)
    assert plan.best.combined("k9") == plan.best.std("k9") == math.inf
    assert plan_document(plan)["cheapest"]["refusal"] == plan.cheapest.refusal


@pytest.mark.long
def test_a_test_that_is_too_short_for_the_usual_ones(tmp_path: Path) -> None:
    """Four positions and their moves do not fit; two visits of one do. It was refused before."""
    wish = request(tmp_path, **TINY | {"duration": 300, "terms": '"scale_factor"'}, plan='move = "100 s"')
    plan = plan_test(wish)
    assert plan.standard == ()
    assert len(plan.best.visits) == 2
    assert "than" not in plan.summary().split("The test")[0]


@pytest.mark.long
def test_dwells_of_whole_turns(tmp_path: Path) -> None:
    plan = plan_test(request(tmp_path, **TINY | {"rate": 4, "duration": 270}, whole="true"))
    turns = [visit.dwell / visit.candidate.revolution for visit in plan.best.visits]
    for visit, turn in zip(plan.best.visits, turns, strict=True):
        assert abs(turn - round(turn)) * visit.candidate.revolution <= 0.25 + 1e-9


@pytest.mark.long
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
