import base64
import hashlib
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from piga.reports.render.figure import Axis, Figure, Panel, Series
from piga.reports.render.page import (
    Cell,
    FigureBlock,
    Notice,
    Page,
    Section,
    Table,
    TableColumn,
    Text,
    Tile,
    json_island,
    page_html,
)

EVIL = "</script><script>alert('x')</script><img src=x onerror=alert(1)> & \u2028"
VOID = {"meta", "img", "br", "hr", "input", "link"}


class Checker(HTMLParser):
    """Open and close tags must match; collects elements and the text of scripts."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.stack, self.elements, self.scripts, self.faults = [], [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.stack.append(tag)
        if tag == "script":
            self.scripts.append((dict(attrs), ""))

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if not self.stack or self.stack.pop() != tag:
            self.faults.append(tag)

    def handle_data(self, data):
        if self.stack and self.stack[-1] == "script":
            attrs, text = self.scripts[-1]
            self.scripts[-1] = (attrs, text + data)

    def all(self, tag):
        return [attrs for name, attrs in self.elements if name == tag]


def figure(key="curve", name="data"):
    x = np.linspace(0, 1, 20)
    return Figure(
        key, f"Title {name}", (Panel(Axis("time", "s"), Axis("angle", "rad"), (Series(x, x, name=name),)),)
    )


def page(word="plain"):
    blocks = (
        Text(f"One {word}.", lead=True),
        Table(
            (TableColumn("Name", align="text"), TableColumn(word, "arcsec")),
            (("a", Cell("1", "good")), (word, Cell("2", "quiet"))),
            caption=word,
            notes=(word,),
        ),
        Notice("warning", word),
        FigureBlock(figure(name=word)),
    )
    sections = tuple(
        Section(f"Section {n} {word}", f"part-{n}", blocks[: 4 if n == 0 else 3]) for n in range(3)
    )
    return Page(word, word, (Tile(word, word, word, word, "good"),), sections, footer=word)


@pytest.fixture(scope="module")
def evil():
    return page_html(page(EVIL))


def test_html_is_well_formed_and_same_bytes_again(evil):
    parsed = Checker(evil)
    assert not parsed.faults
    assert not parsed.stack
    assert evil == page_html(page(EVIL))
    ids = [attrs["id"] for _, attrs in parsed.elements if "id" in attrs]
    assert len(ids) == len(set(ids))


def test_text_of_the_data_never_becomes_markup(evil):
    parsed = Checker(evil)
    assert not parsed.all("img")
    assert "<script>alert" not in evil
    executable = [text for attrs, text in parsed.scripts if attrs.get("type") != "application/json"]
    assert len(executable) == 2
    assert all("alert('x')" not in text for text in executable)


def test_json_islands_parse(evil):
    islands = [text for attrs, text in Checker(evil).scripts if attrs.get("type") == "application/json"]
    (document,) = map(json.loads, islands)
    assert document["panels"][0]["series"][0]["name"].startswith("&lt;/script&gt;")
    assert json.loads(json_island({"a": EVIL})) == {"a": EVIL}
    assert not set("<>&\u2028") & set(json_island({"a": EVIL}))


def test_nothing_is_loaded_from_elsewhere():
    text = page_html(page())
    parsed = Checker(text)
    for name, attrs in parsed.elements:
        for key, value in attrs.items():
            if key in {"src", "href", "xlink:href", "srcset", "action", "data", "poster"}:
                assert value.startswith("#"), (name, key, value)
    css = "".join(re.findall(r"<style>(.*?)</style>", text, re.DOTALL))
    assert "url(" not in css
    assert "@import" not in css
    assert not parsed.all("link")


def test_policy_admits_exactly_the_scripts_of_the_page():
    parsed = Checker(page_html(page()))
    policy = next(attrs["content"] for attrs in parsed.all("meta") if "http-equiv" in attrs)
    scripts = [text for attrs, text in parsed.scripts if attrs.get("type") != "application/json"]
    digests = {base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in scripts}
    assert set(re.findall(r"'sha256-([^']+)'", policy)) == digests
    assert "script-src 'sha256" in policy
    assert "default-src 'none'" in policy
    assert "http" not in policy
