"""Figures of a collected campaign, against direct arithmetic on its rows; parts that cannot be trusted."""

import json
import math

import numpy as np
import pytest
from pyarrow import parquet

from piga.campaign import collect, document, open_campaign, plan_campaign, run_campaign
from piga.campaign.collect import _share_error
from piga.campaign.shard import run_shard
from piga.cli.main import app
from piga.errors import DataError, PigaError
from tests.campaign.small import SMALL, collected, computed, rows, written

ENDS = ("low", "truth", "high")


def computed_folder(folder, text=SMALL, name="out", shards=None):
    """The folder of a campaign computed in this process."""
    computed(written(folder, text), folder / name, shards)
    return folder / name


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """The small campaign, computed once; tests only read it."""
    return computed_folder(tmp_path_factory.mktemp("small"))


@pytest.mark.only_compiled
def test_figures_are_those_of_the_rows(small):
    figures = document(collect(open_campaign(small)))
    every = rows(small)
    assert (figures["records"], figures["computed"], figures["failed"], figures["complete"]) == (
        17,
        17,
        0,
        True,
    )
    assert sum(group["missed"] for group in figures["groups"]) > 0
    for index, group in enumerate(figures["groups"]):
        own = [row for row in every if row["case"] == index]
        assert group["records"] == len(own) == (10, 7)[index]
        assert group["nees"] == pytest.approx(np.mean([row["nees"] for row in own]), rel=1e-12)
        names = {name for row in own for name in row["seen"]}
        assert group["seen"] == {name: np.mean([name in row["seen"] for row in own]) for name in sorted(names)}
        missed = [
            row for row in own if any(not a <= t <= b for a, t, b in zip(*map(row.get, ENDS), strict=True))
        ]
        assert group["missed"] == len(missed)
        names = {name for row in missed for name in row["seen"]}
        assert group["seen_where_missed"] == {
            name: np.mean([name in row["seen"] for row in missed]) for name in sorted(names)
        }
        for k, c in enumerate(group["coefficients"]):
            value, u, low, high, truth, off = (
                np.array([row[name][k] for row in own])
                for name in ("value", "u", "low", "high", "truth", "deviation")
            )
            assert c["name"] == own[0]["name"][k]
            assert c["tests"] == len(own)
            assert np.array_equal(off, value - truth)
            share = np.mean((low <= truth) & (truth <= high))
            assert c["coverage"] == share
            within = min(max(share, 0.5 / len(own)), 1.0 - 0.5 / len(own))
            assert c["coverage_std_error"] == pytest.approx(
                math.sqrt(within * (1 - within) / len(own)), rel=1e-12
            )
            assert c["bias"] == pytest.approx(np.mean(off), rel=1e-9)
            assert c["spread"] == pytest.approx(np.std(off, ddof=1), rel=1e-9)
            assert c["mean"] == pytest.approx(np.mean(value), rel=1e-12)
            assert c["std"] == pytest.approx(np.std(value, ddof=1), rel=1e-6)
            assert c["nees"] == pytest.approx(np.mean((off / u) ** 2), rel=1e-9)
            bound = np.array([row["bound"][k] for row in own])
            assert np.isfinite(bound).tolist() == [row["repeat"] < 3 for row in own]
            ratio = np.var(off, ddof=1) / np.mean(bound[:3] ** 2)
            assert c["variance_over_bound"] == pytest.approx(ratio, rel=1e-9)


@pytest.mark.parametrize(
    ("held", "tests", "error"), [(95, 100, 0.0217945), (100, 100, 0.0070533), (0, 100, 0.0070533)]
)
def test_standard_error_of_a_share(held, tests, error):
    """Where all intervals hold, or none, it is that of half a test and not zero."""
    assert _share_error(held, tests) == pytest.approx(error, rel=1e-5)


@pytest.mark.only_compiled
def test_worst_case_is_repeated_by_its_command(small, tmp_path, capsys):
    collection = collect(open_campaign(small))
    every = rows(small)
    largest = max(abs(z) for row in every for z in row["z"])
    worst = collection.worst[0]
    assert abs(worst.z) == largest
    assert [abs(w.z) for w in collection.worst] == sorted((abs(w.z) for w in collection.worst), reverse=True)
    words = worst.command.replace("small.toml", str(small.parent / "small.toml")).replace(
        "DIR", str(tmp_path / "r")
    )
    app([*words.split()[1:], "--json"], standalone_mode=False)
    again = json.loads(capsys.readouterr().out)
    assert next(c["z"] for c in again["coefficients"] if c["name"] == worst.coefficient) == worst.z
    import piga

    calibration = piga.calibrate(piga.read_run(tmp_path / "r" / "run.toml"))
    row = every[worst.record]
    assert [c.value for c in calibration.coefficients] == pytest.approx(row["value"], rel=1e-12)


@pytest.mark.only_compiled
def test_collect_does_not_depend_on_the_cut(small, tmp_path):
    other = computed_folder(tmp_path, SMALL.replace("records_per_shard = 4", "records_per_shard = 7"))
    first, second = collected(small), collected(other)
    assert first["json"] == second["json"]
    assert first["csv"] == second["csv"]


@pytest.mark.only_compiled
def test_a_record_that_fails_is_a_row(tmp_path):
    same = "forces = [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]"
    text = SMALL.replace("tumble = { positions = 6 }", same, 1)
    folder = computed_folder(tmp_path, text)
    collection = collect(open_campaign(folder))
    assert collection.failed == 10
    assert collection.groups[0].failed == {"IdentifiabilityError": 10}
    assert collection.groups[0].coefficients == ()
    assert collection.groups[1].coefficients[0].tests == 7
    failure = collection.failures[0]
    assert (failure.error_class, failure.records, failure.first) == ("IdentifiabilityError", 10, 0)
    assert "--case 0 --repeat 0" in failure.command
    assert all(row["error"] for row in rows(folder)[:10])
    assert "10 of 17 records failed" in collected(folder)["page"].decode()


@pytest.mark.only_compiled
def test_incomplete(tmp_path):
    folder = computed_folder(tmp_path, shards=(0, 2))
    collection = collect(open_campaign(folder))
    assert collection.missing == (1, 3, 4)
    assert collection.computed == 8
    assert not collection.complete
    with pytest.raises(PigaError, match="has no results yet"):
        collect(plan_campaign(tmp_path / "small.toml", tmp_path / "empty"))


@pytest.mark.only_compiled
def test_damaged_parts_are_named(tmp_path):
    folder = computed_folder(tmp_path, shards=(0, 1))
    part = folder / "parts" / "part-00001.parquet"
    whole = part.read_bytes()
    table = parquet.read_table(part)
    foreign = table.replace_schema_metadata({b"piga.campaign": b"another"})
    for damage, words in (
        (lambda: part.write_bytes(whole[: len(whole) // 2]), "is damaged"),
        (lambda: part.write_bytes(b""), "is damaged"),
        (lambda: part.write_bytes(b"\0" * len(whole)), "is damaged"),
        (lambda: parquet.write_table(foreign, part), "belongs to another campaign"),
        (lambda: parquet.write_table(table.slice(1), part), "holds 3 records, not 4"),
    ):
        damage()
        with pytest.raises(DataError, match=r"part-00001\.parquet") as caught:
            collect(open_campaign(folder))
        assert words in str(caught.value)
        assert "delete it" in str(caught.value)
        with pytest.raises(DataError, match=r"part-00001\.parquet"):
            run_campaign(open_campaign(folder), workers=1)
    part.unlink()
    run_shard(str(folder), 1)
    again = parquet.read_table(part).drop_columns(["seconds"])
    assert repr(again.to_pylist()) == repr(table.drop_columns(["seconds"]).to_pylist())


def test_no_campaign_there(tmp_path):
    with pytest.raises(PigaError, match="holds no campaign"):
        open_campaign(tmp_path)
    (tmp_path / "manifest.json").write_text('{"schema": "piga.camp')
    with pytest.raises(PigaError, match=r"manifest\.json: is damaged"):
        open_campaign(tmp_path)
