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


@pytest.mark.parametrize("width", range(40, 100, 3))
def test_no_number_is_parted_from_its_unit(width: int) -> None:
    words = "a bias of 12.5 ug, 6.4 u, at 0 deg and 1.3e-7 rad/s/g with 47 ppm or 3.1 % in 60 s (0.12 arcsec) of 2 runs; "
    text = page_text(Page("A page", 9 * words), width=width)
    assert " ".join(text.split()) == " ".join(f"A page {9 * words}".split())
    for number in ("12.5 ug", "6.4 u,", "0 deg", "1.3e-7 rad/s/g", "47 ppm", "3.1 %", "60 s", "(0.12 arcsec)"):
        assert text.count(number) == 9, number
