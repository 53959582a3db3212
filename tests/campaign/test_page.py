"""The page and the text of a campaign, and the table of the documentation that is made from it."""

import json

import pytest
from benchmarks import intervals, measured

from piga.campaign import collect, document, open_campaign, read_campaign
from piga.campaign.page import campaign_page, collected_text
from piga.campaign.subjects import NOISE_DOUBTED
from piga.reports.render.page import FigureBlock, Notice, Table, page_html
from tests.campaign.small import COVERAGE, SMALL, computed, one_case, written

GRID = (
    SMALL.replace("repeats = 10", "repeats = 6").replace("repeats = 7", "repeats = 6")
    + """
[grid]
"constant_force.white" = ["1e-5 rad", "4e-5 rad"]
"""
)


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    """A campaign over a grid."""
    folder = tmp_path_factory.mktemp("grid")
    computed(written(folder, GRID), folder / "out")
    return collect(open_campaign(folder / "out"))


@pytest.mark.only_compiled
def test_page_of_a_grid(grid):
    page = campaign_page(grid)
    blocks = [block for section in page.sections for block in section.blocks]
    tables = [block for block in blocks if isinstance(block, Table)]
    assert [table.caption for table in tables[:4]] == [result.group.label for result in grid.groups]
    keys = [block.figure.key for block in blocks if isinstance(block, FigureBlock)]
    assert keys == ["coverage", "errors", "grid-scale-factor", "grid-k0"]
    figure = next(
        block.figure for block in blocks if isinstance(block, FigureBlock) and block.figure.key == "grid-k0"
    )
    lines = figure.panels[0].series
    assert [line.name for line in lines] == ["white", "walk"]
    assert list(lines[0].x) == [1e-5, 4e-5]
    k0 = [next(c for c in r.coefficients if c.name == "k0") for r in grid.groups if r.group.name == "white"]
    assert list(lines[0].y) == [1e6 * c.bias for c in k0], "in micro-g, as on all pages"
    html = page_html(page)
    seen = next(table for table in tables if table.columns[0].heading == "Group")
    assert [row[0] for row in seen.rows] == [result.group.label for result in grid.groups if result.seen]
    assert "random walk" in [column.heading for column in seen.columns]
    assert "piga campaign repeat small.toml --case" in html
    assert "constant_force.white = 4e-5 rad" in html
    assert "coverage" in collected_text(grid)


@pytest.mark.only_compiled
def test_coverage_away_from_95_per_cent_is_marked(grid):
    from dataclasses import replace

    def page(share):
        result = grid.groups[0]
        c = replace(result.coefficients[0], coverage=share, tests=1000)
        changed = replace(grid, groups=(replace(result, coefficients=(c,)),))
        return [b for b in campaign_page(changed).sections[0].blocks if isinstance(b, Notice)]

    assert page(0.95)[0].kind == "good"
    assert page(0.94)[0].kind == "good", "within what chance explains"
    assert "scale_factor" in page(0.90)[0].text
    assert "(90.0 %)" in page(0.90)[0].text


@pytest.mark.only_compiled
def test_rows_of_the_accuracy_page_are_never_replaced_by_fewer_tests(tmp_path):
    """A campaign of as many tests replaces a row, a smaller one leaves it; fewer replace a row of another version."""
    folder = tmp_path / "measured"
    folder.mkdir()
    kept = (measured.FOLDER / "intervals.json").read_text(encoding="utf-8")
    (folder / "intervals.json").write_text(kept, encoding="utf-8")
    campaign = computed(written(tmp_path, one_case("near-critical", 3)), tmp_path / "out")
    figures = document(collect(campaign))
    rows = json.loads(kept)["figures"]
    shown = next(f["value"] for f in rows if (f["scenario"], f["column"]) == ("near-critical", "tests"))
    said = intervals.put_down(figures, folder)
    assert said == [f"near-critical: 3 tests; the row of {shown} tests stays"]
    assert (folder / "intervals.json").read_text(encoding="utf-8") == kept
    figures["groups"][0]["records"] = 10_000
    figures["groups"][0]["planned"] = 10_001
    stays = intervals.put_down(figures, folder)
    assert stays == ["near-critical: records are missing or failed; the row stays"]
    figures["groups"][0]["planned"] = 10_000
    assert intervals.put_down(figures, folder) == ["near-critical: 10000 tests put down"]
    figures["groups"][0] |= {"records": 9000, "planned": 9000}
    assert intervals.put_down(figures | {"version": measured.version()}, folder)[0].endswith(
        "10000 tests stays"
    )
    assert intervals.put_down(figures | {"version": "9.9"}, folder) == ["near-critical: 9000 tests put down"]
    rows = {
        f["name"]: f["value"]
        for f in json.loads((folder / "intervals.json").read_text(encoding="utf-8"))["figures"]
    }
    assert rows["near-critical: NEES"] == round(figures["groups"][0]["nees"], 3)
    assert rows["near-critical: coverage"] == sorted(rows["near-critical: coverage"])


def test_the_table_of_coloured_noise_is_written_as_a_whole(tmp_path):
    """Shares of the records with a miss: a doubt. Too few tests or kinds leave the table."""
    kept = (measured.FOLDER / "coloured-intervals.json").read_text(encoding="utf-8")
    (tmp_path / "coloured-intervals.json").write_text(kept, encoding="utf-8")
    cases = [group.name for group in read_campaign(COVERAGE.parent / "coloured.toml").groups]
    group = {
        "records": 2000, "planned": 2000, "failed": {}, "coefficients": [{"coverage": 0.95}, {"coverage": 0.57}],
        "seen": {}, "missed": 40, "seen_where_missed": {NOISE_DOUBTED: 0.25},
    }  # fmt: skip
    collected = {"campaign": "coloured.toml", "groups": [{"name": name} | group for name in cases]}
    few = {"groups": [{"name": name} | group | {"records": 9, "planned": 9} for name in cases]}
    assert intervals.put_down_coloured(few, tmp_path)[0].startswith("9 tests; the table of ")
    some = intervals.put_down_coloured({"groups": collected["groups"][1:]}, tmp_path)
    assert some == ["head-flicker: records are missing or failed; the table stays"]
    assert (tmp_path / "coloured-intervals.json").read_text(encoding="utf-8") == kept
    assert len(intervals.put_down_coloured(collected, tmp_path)) == 6
    table, figures = measured.load("coloured-intervals", tmp_path)
    assert [f["row"] for f in figures][::4] == list(intervals.COLOURED.values())
    assert {f["column"]: f["value"] for f in figures[:4]} == {
        "records": 2000,
        "intervals hold": [57.0, 95.0],
        "misses": 40,
        "misses with a warning": 25,
    }
    assert {f["unit"] for f in figures if f["column"] in ("records", "misses")} == {"1"}
    assert table["rows"] == "record"
