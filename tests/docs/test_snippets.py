"""Every block of code of README and docs is run as it stands there."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import pytest

from .pages import ROOT, Block, blocks, name_of, pages
from .preparations import PREPARATIONS
from .runner import Runner

RUN = {"python", "sh", "text", "toml", "json"}
PAGES = [page for page in pages() if any(block.kind in RUN for block in blocks(page))]


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


@pytest.mark.long
@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_page(runner: Runner, page: Path) -> None:
    run_page(runner, page, [block for block in blocks(page) if not block.slow])


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in PAGES if any(b.slow for b in blocks(p))], ids=name_of)
def test_page_with_its_long_blocks(runner: Runner, page: Path) -> None:
    run_page(runner, page, blocks(page))


def test_a_block_is_run_or_says_why_not() -> None:
    """A misspelt kind would never be run. Directives of the site (``{...}``) are no code."""
    silent = [
        f"{name_of(page)}:{b.line}"
        for page in pages()
        for b in blocks(page)
        if b.kind not in RUN and not b.kind.startswith("{") and not b.not_run
    ]
    assert not silent, "write <!-- not run: REASON --> above the block"


@pytest.mark.long
def test_the_readme_prints_what_its_comment_says(capsys: pytest.CaptureFixture[str]) -> None:
    """The first numbers printed, to the digits of the comment; the truth lies within three standard uncertainties."""
    (block,) = (b for b in blocks(ROOT / "README.md") if "piga.propagate" in b.text)
    made: dict[str, Any] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        exec(block.text.partition("shipped =")[0], made)  # noqa: S102 - the block itself is the subject
    line = next(line for line in block.text.splitlines() if "# 0.8884" in line)
    assert capsys.readouterr().out.split()[:3] == line.partition("# ")[2].split()
    truth = {"scale_factor": 0.8884, "tan_beta": math.tan(math.radians(1000.0 / 3600.0)), "k0": 0.0}
    for name, value in truth.items():
        assert abs(made["cal"][name].value - value) < 3.0 * made["cal"][name].std, name
