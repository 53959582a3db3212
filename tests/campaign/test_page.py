"""The page and the text of a campaign."""

import pytest

from piga.campaign import collect, open_campaign
from piga.campaign.page import campaign_page
from piga.reports.render.page import FigureBlock, Table, page_html, page_text
from tests.campaign.small import SMALL, computed, written

GRID = SMALL + '\n[grid]\n"electronics.angle_noise" = ["2 arcsec", "8 arcsec"]\n'


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    """A campaign over a grid."""
    folder = tmp_path_factory.mktemp("grid")
    computed(written(folder, GRID), folder / "out")
    return collect(open_campaign(folder / "out"))


@pytest.mark.long
def test_page_of_a_grid(grid):
    page = campaign_page(grid)
    blocks = [block for section in page.sections for block in section.blocks]
    tables = [block for block in blocks if isinstance(block, Table)]
    assert [table.caption for table in tables[:4]] == [result.group.label for result in grid.groups]
    figures = {block.figure.key: block.figure for block in blocks if isinstance(block, FigureBlock)}
    assert list(figures) == ["coverage", "errors", "grid-scale-factor", "grid-k0"]
    lines = figures["grid-k0"].panels[0].series
    assert [line.name for line in lines] == ["walk", "white"]
    assert list(lines[0].x) == [2.0, 8.0]
    k0 = [next(c for c in r.coefficients if c.name == "k0") for r in grid.groups if r.group.name == "walk"]
    assert list(lines[0].y) == [1e6 * c.bias for c in k0], "in micro-g, as on all pages"
    html = page_html(page)
    seen = next(table for table in tables if table.columns[0].heading == "Group")
    assert [row[0] for row in seen.rows] == [result.group.label for result in grid.groups if result.seen]
    assert "random walk" in [column.heading for column in seen.columns]
    assert "piga campaign repeat small.toml --case" in html
    assert "electronics.angle_noise = 8 arcsec" in html
    assert "Coverage" in page_text(page)
