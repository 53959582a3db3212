"""Every block of code of README and docs is run as it stands there."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest

from .pages import Block, blocks, name_of, pages
from .preparations import PREPARATIONS
from .runner import Runner

RUN = {"python", "sh", "text", "toml", "json"}
PAGES = [page for page in pages() if any(block.kind in RUN for block in blocks(page))]
KINDS = RUN | {
    "",
    "console",
    "yaml",
    "{eval-rst}",
    "{include}",
    "{toctree}",
    "{container}",
    "{note}",
    "{list-table}",
}


@pytest.fixture
def runner(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Runner:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    return Runner(tmp_path)


def run_page(runner: Runner, page: Path, chosen: list[Block]) -> None:
    for prepare in PREPARATIONS.get(name_of(page), ()):
        prepare(runner)
    for block in chosen:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                runner.run(block)
        except BaseException as error:
            raise AssertionError(f"{name_of(page)}:{block.line}: {type(error).__name__}: {error}") from error


@pytest.mark.only_compiled
@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_page(runner: Runner, page: Path) -> None:
    run_page(runner, page, [block for block in blocks(page) if not block.slow])


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in PAGES if any(b.slow for b in blocks(p))], ids=name_of)
def test_page_with_its_long_blocks(runner: Runner, page: Path) -> None:
    run_page(runner, page, blocks(page))


def test_every_block_says_what_it_is() -> None:
    """A misspelt fence would never be run."""
    odd = [
        f"{name_of(page)}:{b.line}: {b.kind}" for page in pages() for b in blocks(page) if b.kind not in KINDS
    ]
    assert not odd


def test_preparations_belong_to_pages() -> None:
    assert set(PREPARATIONS) <= {name_of(page) for page in PAGES}


def test_a_wrong_output_is_noticed(runner: Runner) -> None:
    runner.run(Block("python", "print('a  1.25 s')\nprint('b')", 1))
    runner.run(Block("text", "a 1... s\nb", 4))
    with pytest.raises(AssertionError, match="not printed: b 2"):
        runner.run(Block("text", "b 2", 4))
    with pytest.raises(AssertionError, match="no_such"):
        runner.run(Block("sh", "piga check no_such.toml", 4))
