"""Campaign files: the list of records, what is drawn, and what is refused."""

import numpy as np
import pytest

from piga.campaign import plan_campaign, read_campaign
from piga.errors import PigaError, RunFileError
from tests.campaign.small import ROOT, SMALL, find, written

HEAD = (ROOT / "examples" / "dividing-head.toml").read_text(encoding="utf-8")
STAND = """
scenario = "head.toml"
[campaign]
repeats = 2
"""


def stand(folder, text):
    """A campaign of the shipped dividing head."""
    written(folder, HEAD, "head.toml")
    return written(folder, text)


def test_records_have_case_and_repeat(tmp_path):
    plan = read_campaign(written(tmp_path))
    assert plan.records == 17
    names = [(plan.record(n).case, plan.record(n).repeat, plan.record(n).group.name) for n in range(17)]
    assert names[:2] == [(0, 0, "walk"), (0, 1, "walk")]
    assert names[10:12] == [(1, 0, "white"), (1, 1, "white")]
    assert len(set(names)) == 17
    with pytest.raises(RunFileError, match=r"no record 17(?s:.*)from 0 to 16"):
        plan.record(17)


def test_grid_times_designs_times_repeats(tmp_path):
    text = (
        STAND
        + 'designs = 3\n[grid]\n"stand.latitude" = ["10 deg", "20 deg"]\n"run.step" = ["0.1 s", "0.05 s"]\n'
    )
    text += '[draw]\n"truth.k0" = { distribution = "normal", mean = "0 g", std = "1e-3 g" }\n'
    plan = read_campaign(stand(tmp_path, text))
    assert (len(plan.groups), plan.records) == (4, 24)
    assert [group.first for group in plan.groups] == [0, 3, 6, 9]
    document = plan.document(plan.record(plan.groups[3].start))
    assert document["stand"]["latitude"] == "20 deg"
    assert document["run"]["step"] == "0.05 s"
    drawn = [plan.document(find(plan, case, 0))["truth"]["k0"] for case in range(12)]
    assert len(set(drawn)) == 12
    assert plan.document(find(plan, 5, 1))["truth"]["k0"] == drawn[5], (
        "repeats of a design share what was drawn"
    )
    assert plan.document(plan.record(0))["truth"]["beta"] == "74 arcsec", "the rest is that of the file"


@pytest.mark.parametrize(
    ("entry", "low", "high"),
    [
        ('{ distribution = "uniform", low = "1 g", high = "2 g" }', 1.0, 2.0),
        ('{ distribution = "log-uniform", low = "1e-6 g", high = "1e-2 g" }', 1e-6, 1e-2),
        ('{ distribution = "normal", mean = "3 g", std = "0 g" }', 3.0, 3.0),
        ('{ distribution = "choice", values = ["1 g", "4 g"] }', 1.0, 4.0),
    ],
)
def test_distributions(tmp_path, entry, low, high):
    plan = read_campaign(stand(tmp_path, STAND + f'designs = 50\n[draw]\n"truth.k0" = {entry}\n'))
    values = [float(plan.document(find(plan, case, 0))["truth"]["k0"].removesuffix(" g")) for case in range(50)]
    assert low <= min(values) <= max(values) <= high
    assert len(set(values)) == (1 if "normal" in entry else 2 if "choice" in entry else 50)
    if "log" in entry:
        assert 5e-5 < float(np.median(values)) < 2e-4, "the middle of the logarithms"


def test_seeds_are_those_of_the_seed_sequence(tmp_path):
    plan = read_campaign(written(tmp_path))
    record = find(plan, 1, 3)
    own = np.random.SeedSequence(7, spawn_key=(1, 3)).generate_state(1, np.uint64)[0]
    assert plan.seed_of(record) == int(own) >> 1
    seeds = {plan.seed_of(plan.record(n)) for n in range(17)}
    assert len(seeds) == 17
    assert all(0 <= seed < 2**63 for seed in seeds)


REFUSED = {
    "unknown table": (SMALL + "\n[grids]\n", "has the unknown key 'grids'"),
    "unknown key": (SMALL.replace("repeats = 7", "repeat = 7"), "has the unknown key 'repeat'"),
    "unknown key of a scenario": (SMALL.replace("angle_random", "angel_random", 1), "'angel_random_walk'"),
    "unit": (SMALL.replace("0 arcsec/sqrt(s)", "0 m", 1), "angle_random_walk"),
    "no repeats": (SMALL.replace("repeats = 10", "repeats = 0"), "repeats"),
    "two of a name": (SMALL.replace('"walk"', '"white"'), "two cases have the name 'white'"),
    "nothing": ("[campaign]\n", "there is nothing to compute"),
    "no TOML": ("[campaign", "not valid TOML"),
}


@pytest.mark.parametrize("name", list(REFUSED))
def test_refused(tmp_path, name):
    text, words = REFUSED[name]
    with pytest.raises(PigaError, match=r"small\.toml") as caught:
        plan_campaign(written(tmp_path, text), tmp_path / "out")
    assert words in str(caught.value)
    assert not (tmp_path / "out" / "manifest.json").exists()


OF_A_STAND = {
    "grid key": ('[grid]\n"stand.lattitude" = ["1 deg"]\n', "unknown key 'lattitude'"),
    "grid key through a value": ('[grid]\n"stand.latitude.x" = ["1 deg"]\n', "key 'stand.latitude.x' goes through a value"),
    "grid table": ('[grid]\n"stnd.latitude" = ["1 deg"]\n', "unknown key 'stnd'"),
    "grid value": ('[grid]\n"stand.latitude" = ["10 deg", "1 m"]\n', "latitude"),
    "truth": ('[grid]\n"truth.k9" = ["1 g"]\n', "unknown key 'k9'"),
    "twin": ('[grid]\n"twin.gain" = [1.0]\n', "gain"),
    "model": ('[grid]\n"model.phas" = ["shared"]\n', "phas"),
    "k1": ('[grid]\n"truth.k1" = [1e-4]\n', "cannot separate it from the scale factor"),
    "empty grid": ('[grid]\n"stand.latitude" = []\n', "the list is empty"),
    "draw key": ('[draw]\n"stand.foo" = { distribution = "uniform", low = 0, high = 1 }\n', "unknown key 'foo'"),
    "draw ends": ('[draw]\n"truth.k0" = { distribution = "uniform", low = "2 g", high = "1 g" }\n', "not below"),
    "draw units": ('[draw]\n"truth.k0" = { distribution = "uniform", low = "2 g", high = "3 m" }\n', "units differ"),
    "draw lacks": ('[draw]\n"truth.k0" = { distribution = "normal", mean = "0 g" }\n', "needs mean and std"),
    "draw what": ('[draw]\n"truth.k0" = { distribution = "cauchy" }\n', "cauchy"),
    "both": ('[grid]\n"truth.k0" = ["0 g"]\n[draw]\n"truth.k0" = { distribution = "choice", values = ["0 g"] }\n',
             "is in [grid] and in [draw]"),
}  # fmt: skip


@pytest.mark.parametrize("name", list(OF_A_STAND))
def test_keys_of_a_scenario_that_do_not_exist(tmp_path, name):
    text, words = OF_A_STAND[name]
    with pytest.raises(RunFileError) as caught:
        read_campaign(stand(tmp_path, STAND + text))
    assert "small.toml" in str(caught.value)
    assert words.lower() in str(caught.value).lower()


def test_scenario_that_is_missing_or_none(tmp_path):
    with pytest.raises(RunFileError, match=r"gone\.toml"):
        read_campaign(written(tmp_path, 'scenario = "gone.toml"\n'))
    written(tmp_path, "[instrument]\nserial = 'x'\n", "run.toml")
    with pytest.raises(RunFileError, match="is not a scenario"):
        read_campaign(written(tmp_path, 'scenario = "run.toml"\n'))
