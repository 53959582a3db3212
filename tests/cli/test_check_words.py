"""Every key, term and method has its words; every example is written and runs; completion with Tab."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from piga.cli.check import explain
from piga.data import example_files
from piga.describe.draft import FILES, places_of
from piga.records.terms import TERM_WORDS, UNITS, term_words
from tests.cli.runner import invoked


@pytest.mark.parametrize("file", FILES)
def test_every_key_has_a_sentence_and_an_example(file: str) -> None:
    keys = places_of(file)
    assert len(keys) > 4
    for place in keys:
        assert place.words.sentence.endswith("."), place.path
        assert place.words.example, place.path
        tomllib.loads(f"x = {place.words.example}")


def test_explain() -> None:
    done = invoked("check", "--explain", "data.time.stamp")
    assert done.exit_code == 0
    assert 'example  stamp = "DD.MM.YYYY hh:mm:ss.f"' in done.stdout
    assert {place.file for place in explain("terms")} == {"run"}
    assert next(place.path for place in explain("[data] time")) == "data.time"
    document = json.loads(invoked("check", "--explain", "criterion", "--json").stdout)
    assert document[0]["key"] == "plan.criterion"
    wrong = invoked("check", "--explain", "data.tme")
    assert "did you mean" in str(wrong.exception)
    assert "no run file is named" in str(invoked("check").exception)


def test_terms() -> None:
    assert set(TERM_WORDS) - {"sn", "cn"} == set(UNITS)
    out = invoked("terms").stdout
    for name in UNITS:
        assert f"{name}  [{UNITS[name]}]  {TERM_WORDS[name].meaning}" in out
    assert term_words("s2").formula == "s2 sin(2 psi)"
    assert "s3 sin(3 psi)" in invoked("terms", "s3").stdout
    assert "is not a term" in str(invoked("terms", "k9").exception)
    rows = json.loads(invoked("terms", "--json").stdout)
    assert {row["name"] for row in rows} == set(TERM_WORDS)


ROOT = Path(__file__).resolve().parents[2]


def test_every_example_is_written(tmp_path: Path) -> None:
    done = invoked("examples", "--out", tmp_path / "examples")
    assert done.exit_code == 0
    for path in (ROOT / "examples").rglob("*.*"):
        if path.suffix in (".toml", ".py"):
            assert (
                tmp_path / "examples" / path.relative_to(ROOT / "examples")
            ).read_bytes() == path.read_bytes()
    assert "wrote" in done.stdout


def test_what_the_docs_name_is_there() -> None:
    names = set(example_files())
    for page in [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]:
        for name in re.findall(r"\bexamples/([\w/-]+\.(?:toml|py))", page.read_text(encoding="utf-8")):
            assert name in names, (page.name, name)


def asked(**environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "piga"],
        capture_output=True,
        text=True,
        env=os.environ | environment,
        check=False,
    )
    return done.stdout + done.stderr


def test_a_shell_completes_commands() -> None:
    assert asked(_PIGA_COMPLETE="complete_bash", COMP_WORDS="piga cal", COMP_CWORD="1").split() == ["calibrate"]
    assert "piga --install-completion" in str(invoked("completion", "bash").exception)
