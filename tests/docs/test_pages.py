"""What a page names is there: files, modules, commands, tests, pictures, messages, and the figures of ``docs/measured``."""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from pkgutil import resolve_name

import pytest
from benchmarks import measured

import piga

from .pages import DOCS, ROOT, commands, name_of, pages


def test_accuracy_names_a_test_for_every_model() -> None:
    """The first table: model, valid for, error at most, proved by."""
    text = (DOCS / "validation.md").read_text(encoding="utf-8").split("\n## ")[0]
    rows = re.findall(r"^\| (?!model|---)(.*) \|$", text, re.MULTILINE)
    assert len(rows) >= 10
    assert all(re.search(r"tests/.*::[^|]*$", row) for row in rows)


def test_no_remote_assets() -> None:
    """Nothing that the pages or the theme's settings name is fetched from elsewhere."""
    for path in [*pages(), DOCS / "conf.py", DOCS / "_static" / "piga.css"]:
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"(!\[[^\]]*\]\(|src=|url\(|@import\s+)['\"]?https?:", text), path


PLACES = ("src", "tests", "docs", "builders", "benchmarks", "examples")
_PATH = re.compile(rf"(?<![\w./-])((?:{'|'.join(PLACES)})/[\w./*-]*\w)")
_PAGE = re.compile(r"(?<![\w./*-])([\w-]+(?:/[\w-]+)*\.md)\b")
_TEST = re.compile(r"`(tests/[\w/]+\.py)::(\w+)")
_LINK = re.compile(r"\]\(([^)\s#]*)[^)\s]*\)")
_DOTTED = re.compile(r"(?:`|:\w+:`~?)(piga(?:\.\w+)+)(?![\w/-])")
_COMMAND = re.compile(r"`piga ([a-z]+(?: [a-z]+)?)(?=[ `])")
_KEYS = {"piga.flags", "piga.inputs", "piga.notes"}
"""Names of metadata in files, which look like modules."""


def resolves(dotted: str) -> bool:
    """True for a module of piga or something in one."""
    try:
        resolve_name(dotted)
    except (ImportError, AttributeError):
        owner, _, name = dotted.rpartition(".")
        return owner != "piga" and name in getattr(resolve_name(owner), "__annotations__", {})
    return True


def missing_commands(text: str) -> list[str]:
    missing = []
    for words in _COMMAND.findall(text):
        first = f"piga {words.split()[0]}"
        name = f"piga {words}" if commands().get(first) else first
        missing += [] if name in commands() else [name]
    return missing


@pytest.mark.parametrize("page", pages(), ids=name_of)
def test_what_is_named_is_there(page: Path) -> None:
    """Files, pages, tests, modules, commands, and targets of links."""
    text = page.read_text(encoding="utf-8")
    files = {name for name in _PATH.findall(text) if not (ROOT / f"{name}.md").exists()}
    missing = [name for name in files if not list(ROOT.glob(name))]
    for name in set(_PAGE.findall(text)):
        places = (page.parent, DOCS, ROOT, *DOCS.iterdir())
        if "generated/" not in name and not any((place / name).is_file() for place in places):
            missing.append(name)
    for file, name in _TEST.findall(text):
        if f"def {name}(" not in (ROOT / file).read_text(encoding="utf-8"):
            missing.append(f"{file}::{name}")
    missing += [name for name in set(_DOTTED.findall(text)) - _KEYS if not resolves(name)]
    missing += missing_commands(text)
    for target in _LINK.findall(re.sub(r"`[^`\n]*`", "", text)):
        generated = "reference/generated" in target or target.startswith("generated/")
        if target and "://" not in target and not generated and not (page.parent / target).exists():
            missing.append(target)
    assert not missing, f"{name_of(page)} names what is not there: {sorted(missing)}"


def test_every_command_has_its_python_beside_it() -> None:
    """A section of its own, or that of its group; but for commands that have no meaning in Python."""
    text = (DOCS / "reference" / "examples" / "commands.md").read_text(encoding="utf-8")
    sections = {line.removeprefix("## ") for line in text.splitlines() if line.startswith("## ")}
    names = [name for name, is_group in commands().items() if not is_group]
    missing = {name for name in names if not {name, name.rpartition(" ")[0]} & sections}
    assert missing == {"piga ui", "piga examples"}
    assert sections <= {*names, *(name.rpartition(" ")[0] for name in names)}


# --- messages


_ROW = re.compile(r"^\| `([^`]+)` \| [^|]+ \| [^|]+ \|$", re.MULTILINE)


def messages() -> list[str]:
    return _ROW.findall((DOCS / "reference" / "messages.md").read_text(encoding="utf-8"))


def words(node: ast.expr) -> str:
    """Text of an expression; ``\\0`` stands for what is computed."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(words(part) for part in node.values)
    if isinstance(node, ast.BinOp):
        return words(node.left) + words(node.right)
    return "\0"


@cache
def texts() -> tuple[str, ...]:
    """Every text in the package; text that is put together counts as one."""
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in (ROOT / "src").rglob("*.py")]
    kinds = (ast.Constant, ast.JoinedStr, ast.BinOp)
    return tuple(words(node) for tree in trees for node in ast.walk(tree) if isinstance(node, kinds))


def held(message: str, text: str) -> bool:
    """True if a text holds the message; ``...`` is what differs."""
    pattern = ".*".join(map(re.escape, message.split("...")))
    return re.search(pattern, text, re.DOTALL | re.IGNORECASE) is not None


@pytest.mark.parametrize("message", messages())
def test_a_message_is_one_of_the_program(message: str) -> None:
    assert any(held(message, text) for text in texts())


def test_the_refusals_that_users_meet_are_explained() -> None:
    run = piga.example_run()
    with pytest.raises(piga.PigaError) as confounded:
        piga.calibrate(run, ["scale_factor", "tan_beta", "k0", "k2", "k_YY"])
    calibration = piga.calibrate(run, ["scale_factor", "tan_beta", "k0"], phases="per-segment")
    with pytest.raises(piga.PigaError) as phaseless:
        piga.compensate(replace(run, labels=tuple(f"part {label}" for label in run.labels)), calibration)
    for refusal in (confounded, phaseless):
        assert any(held(message, str(refusal.value)) for message in messages()), str(refusal.value)


# --- figures: the tables are those of docs/measured, and every figure says how it was measured


@pytest.mark.parametrize("page", measured.pages(), ids=name_of)
def test_tables_are_those_of_the_figures(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert measured.filled(text) == text, "run: python benchmarks/measured.py"


def test_every_table_is_shown_once() -> None:
    shown = [name for page in measured.pages() for name in measured.shown(page.read_text(encoding="utf-8"))]
    assert sorted(shown) == measured.names()
    marks = [page.read_text(encoding="utf-8").count("<!-- measured:") for page in measured.pages()]
    assert sum(marks) == len(shown), "a mark without its end"


@pytest.mark.parametrize("name", measured.names())
def test_every_figure_says_how_it_was_measured(name: str) -> None:
    table, figures = measured.load(name)
    assert len({figure["name"] for figure in figures}) == len(figures), "one name, two figures"
    for figure in figures:
        missing = [key for key in measured.NEEDED if figure.get(key) in (None, "")]
        assert not missing, f"{figure['name']}: {missing}"
        values = figure["value"] if isinstance(figure["value"], list) else [figure["value"]]
        assert all(isinstance(value, int | float) for value in values), figure["name"]
        assert values == sorted(values), f"{figure['name']}: lowest value first"
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", figure["date"])
        assert re.fullmatch(r"\d+\.\d+\.\d+(\.dev\d+)?", figure["version"])
        assert figure.get("column", "") in table.get("columns", [""])
        words = figure["command"].split()
        paths = [word for word in words if "/" in word]
        paths += [word.replace(".", "/") + ".py" for word in words if word.startswith("tests.")]
        assert all((ROOT / path).exists() for path in paths), figure["command"]


def test_shipped_comparisons_hold_and_stand_on_the_page() -> None:
    """Validation on data of others has the numbers of today, as far as the data are here."""
    spec = importlib.util.spec_from_file_location("validate", ROOT / "validation" / "validate.py")
    assert spec is not None
    assert spec.loader is not None
    validate = importlib.util.module_from_spec(spec)
    sys.modules["validate"] = validate
    spec.loader.exec_module(validate)
    results = [*validate.xsens(), *validate.imucal(), *validate.nist_suite()]
    assert all(one.holds for one in results)
    page = (ROOT / "docs" / "validation-data.md").read_text(encoding="utf-8")
    for row in validate.page(results).splitlines():
        assert row in page
