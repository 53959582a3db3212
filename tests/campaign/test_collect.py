"""Figures of a collected campaign, against direct arithmetic on its rows; what misses its target is named."""

import json
import math

import msgspec
import numpy as np
import pytest

from piga.campaign import collect, open_campaign, plan_campaign
from piga.campaign.collect import CampaignCoefficient, _misses
from piga.cli.main import app
from piga.errors import PigaError
from tests.campaign.small import SMALL, collected, computed, rows, written


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """The small campaign, computed once; tests only read it."""
    folder = tmp_path_factory.mktemp("small")
    computed(written(folder), folder / "out")
    return folder / "out"


@pytest.mark.long
def test_figures_are_those_of_the_rows(small):
    figures = msgspec.to_builtins(collect(open_campaign(small)))
    every = rows(small)
    counts = [figures[name] for name in ("records", "computed", "failed", "complete")]
    assert counts == [17, 17, 0, True]
    for index, group in enumerate(figures["groups"]):
        own = [row for row in every if row["case"] == index]
        assert group["records"] == len(own) == (10, 7)[index]
        assert group["nees"] == pytest.approx(np.mean([row["nees"] for row in own]), rel=1e-12)
        names = {name for row in own for name in row["seen"]}
        assert group["seen"] == {name: np.mean([name in row["seen"] for row in own]) for name in sorted(names)}
        for k, c in enumerate(group["coefficients"]):
            value, u, low, high, truth, off = (
                np.array([row[name][k] for row in own])
                for name in ("value", "u", "low", "high", "truth", "deviation")
            )
            assert (c["name"], c["tests"]) == (own[0]["name"][k], len(own))
            assert np.array_equal(off, value - truth)
            share = np.mean((low <= truth) & (truth <= high))
            assert c["coverage"] == share
            assert c["coverage_std_error"] == pytest.approx(math.sqrt(0.95 * 0.05 / len(own)), rel=1e-12)
            assert c["bias"] == pytest.approx(np.mean(off), rel=1e-9)
            assert c["spread"] == pytest.approx(np.std(off, ddof=1), rel=1e-9)
            assert c["mean"] == pytest.approx(np.mean(value), rel=1e-12)
            assert c["standard_deviation"] == pytest.approx(np.std(value, ddof=1), rel=1e-6)
            assert c["nees"] == pytest.approx(np.mean((off / u) ** 2), rel=1e-9)
            assert c["largest_z"] == np.abs(off / u).max()


@pytest.mark.long
@pytest.mark.parametrize(
    ("share", "bias", "named"),
    [
        (0.90, 0.0, {"coverage": -3.2444}),  # 90.0 ± 1.5 %: once passed as in order
        (0.925, 0.0, {}),  # 1.6 standard errors
        (0.95, 0.2, {"bias": 2.8284}),
        (0.99, -0.3, {"coverage": 2.5956, "bias": -4.2426}),
    ],
)
def test_every_quantity_that_misses_its_target_is_named(small, share, bias, named):
    group = collect(open_campaign(small)).groups[0]
    c = CampaignCoefficient(
        "phi", "rad", 200, 0.0, 1.0, -1.0, 1.0, coverage=share, coverage_std_error=math.sqrt(0.95 * 0.05 / 200),
        bias=bias, bias_std_error=1.0 / math.sqrt(200), bias_over_sigma=bias, spread=1.0,
    )  # fmt: skip
    misses = _misses((msgspec.structs.replace(group, coefficients=(c,)),))
    assert {miss.what: miss.standard_errors for miss in misses} == pytest.approx(named, abs=1e-4)
    for miss in misses:  # the printed error is the one that decides
        off = miss.value - (0.95 if miss.what == "coverage" else 0.0)
        assert off / miss.std_error == pytest.approx(miss.standard_errors, rel=1e-6)


@pytest.mark.long
def test_a_record_that_fails_is_a_row(tmp_path):
    text = SMALL + '\n[[case]]\nname = "still"\nrepeats = 2\nset = { "stand.positions" = "0:1:1 deg" }\n'
    computed(written(tmp_path, text), tmp_path / "out")
    collection = collect(open_campaign(tmp_path / "out"))
    (error,) = collection.groups[2].failed
    assert collection.failed == collection.groups[2].failed[error] == 2
    assert collection.groups[2].coefficients == ()
    assert collection.groups[1].coefficients[0].tests == 7
    failure = collection.failures[0]
    assert (failure.error_class, failure.records, failure.first) == (error, 2, 17)
    assert all(row["error"] for row in rows(tmp_path / "out")[17:])
    page = collected(tmp_path / "out")["page"].decode()
    assert "2 of 19 records failed" in page
    assert "Not one record could be computed of: still" in page


@pytest.mark.long
def test_incomplete(tmp_path, capsys):
    computed(written(tmp_path), tmp_path / "out", shards=(0, 2))
    collection = collect(open_campaign(tmp_path / "out"))
    assert collection.missing == (1, 3, 4)
    assert collection.computed == 8
    assert not collection.complete
    with pytest.raises(SystemExit):
        app(["campaign", "collect", str(tmp_path / "out"), "--json"], standalone_mode=False)
    assert json.loads(capsys.readouterr().out)["missing"] == [1, 3, 4]
    with pytest.raises(PigaError, match="has no results yet"):
        collect(plan_campaign(tmp_path / "small.toml", tmp_path / "empty"))
