"""What an installation brings: pinned with hashes, under a licence that is named and no GPL."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS: dict[str, list[str]] = {"core": PROJECT["dependencies"]} | PROJECT["optional-dependencies"]


def plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def packages(extra: str) -> set[str]:
    seen = {plain(re.match(r"[A-Za-z0-9._-]+", wish)[0]) for wish in EXTRAS[extra]}  # type: ignore[index]
    return seen - {"piga"}


def pins(file: str) -> dict[str, str]:
    """Entry of each pinned package."""
    blocks = re.split(r"\n(?=\S)", (ROOT / file).read_text())
    return {plain(re.split(r"[\[=]", block)[0]): block for block in blocks if "==" in block.splitlines()[0]}


@pytest.mark.parametrize("extra", list(EXTRAS))
def test_every_package_of_an_extra_is_pinned_with_hashes_and_its_licence_is_named(extra: str) -> None:
    pinned = pins("requirements-docs.txt" if extra == "docs" else "requirements-dev.txt")
    notice = (ROOT / "NOTICE").read_text()
    own = re.search(rf"^{extra} .*?(?=^\S)", notice, flags=re.MULTILINE | re.DOTALL)
    assert own, f"NOTICE has no line for the extra {extra}"
    for name in packages(extra):
        assert "--hash=sha256:" in pinned[name]
        licence = re.search(rf"(?<![\w-]){re.escape(name)} (?:\w+-)?[A-Z]", own[0], flags=re.IGNORECASE)
        assert licence, f"NOTICE names no licence of {name}"


def test_all_that_the_pages_need_is_named() -> None:
    notice = (ROOT / "NOTICE").read_text().lower()
    assert [name for name in pins("requirements.txt") if f" {name} " not in notice] == []


def test_every_pin_has_hashes_and_none_is_of_the_gpl() -> None:
    for file in ("requirements.txt", "requirements-dev.txt", "requirements-docs.txt"):
        for name, block in pins(file).items():
            assert "--hash=sha256:" in block, (file, name)
            assert name != "pysolid"
    assert not re.search(r"(?<!L)GPL-[23]", (ROOT / "NOTICE").read_text())
