"""The text of a page fits the terminal: lines go on below themselves, and no number or name is broken."""

from __future__ import annotations

import pytest

from piga.reports.render.page import Page, Section, TableOf, Text, page_text

WORDS = "a long sentence of the uncertainty with 1.23e-07 rad/s/g and break-even words that go on and on and on for longer"
ROWS = [
    ("direction of the reference (reference_misalignment X0)", "0.300 arcsec"),
    ("periodic error of the head's angle (angle_harmonics order 4)", "0.100 arcsec"),
]


def page() -> Page:
    two = TableOf(ROWS).text("Source", lambda row: row[0]).number("Standard uncertainty", lambda row: row[1])
    wide = TableOf(range(3)).text("Name", lambda k: f"coefficient {k}")
    for j in range(8):
        wide = wide.number(f"value {j}", lambda k, j=j: f"{k}.{j}234567e-07")
    return Page(
        "A page",
        WORDS,
        sections=(
            Section("Words", "a", (Text(f"{WORDS}\n\n{WORDS}"),)),
            Section("Two", "b", (two.table(),)),
            Section("Many", "c", (wide.table(),)),
        ),
    )


@pytest.mark.parametrize("width", [60, 80, 120])
def test_no_line_is_longer_than_the_terminal(monkeypatch, width):
    monkeypatch.setenv("COLUMNS", str(width))
    text = page_text(page())
    assert max(map(len, text.splitlines())) <= min(width, 100)
    words = text.split()
    assert words.count("1.23e-07") == words.count("break-even") == 3
    assert {f"{k}.{j}234567e-7" for k in range(3) for j in range(8)} <= set(words)
    assert max(map(len, page_text(page(), width=100).splitlines())) > 90
