"""``piga examples`` writes every example, also from an installed wheel; what the how-tos name is there and runs."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from typer.testing import CliRunner

from piga.cli.main import app
from piga.data import example_files

ROOT = Path(__file__).resolve().parents[2]


def test_every_example_is_written(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["examples", "--out", str(tmp_path / "examples")])
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


def test_an_example_runs(tmp_path: Path) -> None:
    CliRunner().invoke(app, ["examples", "--out", str(tmp_path / "examples")])
    done = CliRunner().invoke(
        app, ["simulate", str(tmp_path / "examples/dividing-head.toml"), "--out", str(tmp_path / "head")]
    )
    assert done.exit_code == 0, done.exception
    assert (tmp_path / "head" / "run.toml").exists()


def test_the_wheel_holds_them() -> None:
    build = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"][
        "targets"
    ]
    assert build["wheel"]["force-include"] == {"examples": "piga/data/examples"}
