"""Every command has its Python beside it; a file is read from its text, too."""

from __future__ import annotations

from dataclasses import replace

import pytest

import piga

from .pages import DOCS, ROOT, commands


def test_every_command_has_its_python_beside_it() -> None:
    """A section of its own, or that of its group; but for commands that have no meaning in Python."""
    text = (DOCS / "reference" / "examples" / "commands.md").read_text(encoding="utf-8")
    sections = {line.removeprefix("## ") for line in text.splitlines() if line.startswith("## ")}
    names = [name for name, is_group in commands().items() if not is_group]
    missing = {name for name in names if not {name, name.rpartition(" ")[0]} & sections}
    assert missing == {"piga ui", "piga examples"}
    assert sections <= {*names, *(name.rpartition(" ")[0] for name in names)}


@pytest.mark.parametrize(
    ("read", "file"), [(piga.read_plan, "plan-dividing-head.toml"), (piga.read_scenario, "twin.toml")]
)
def test_a_file_is_read_from_its_text(read, file) -> None:
    path = ROOT / "examples" / file
    assert read(file, content=path.read_text(encoding="utf-8")).table == read(path).table
    with pytest.raises(piga.RunFileError, match=r"nothing\.toml: not valid TOML"):
        read("nothing.toml", content="[")


def test_other_files_are_read_from_their_text() -> None:
    path = ROOT / "examples" / "platform-piga.toml"
    read = piga.platform.load_scenario("p.toml", content=path.read_text(encoding="utf-8"))
    assert replace(read, source=None) == replace(piga.platform.load_scenario(path), source=None)
    text = (ROOT / "examples" / "certificate.toml").read_text(encoding="utf-8")
    assert piga.certificate.read_certificate_file("c.toml", content=text).item.description
