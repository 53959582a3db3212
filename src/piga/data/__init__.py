"""Data files of the package, and the shipped record."""

from __future__ import annotations

import gzip
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

EXAMPLE = "tumble-a"
"""Name of the shipped record."""


def copy_example(folder: Path) -> Path:
    """Copy the shipped record and its run file into ``folder``. Returns the run file."""
    source = files("piga.data")
    (folder / f"{EXAMPLE}.csv").write_bytes(gzip.decompress(source.joinpath(f"{EXAMPLE}.csv.gz").read_bytes()))
    run = folder / f"{EXAMPLE}.toml"
    run.write_bytes(source.joinpath(f"{EXAMPLE}.toml").read_bytes())
    return run


def example_files() -> dict[str, bytes]:
    """Content of each example, by its name with ``/``: from the package, or from the checkout it runs in."""
    packed = files("piga.data").joinpath("examples")
    root = packed if packed.is_dir() else Path(__file__).resolve().parents[3] / "examples"
    return dict(sorted(_walk(root, "")))


def _walk(folder: Traversable, before: str) -> list[tuple[str, bytes]]:
    entries: list[tuple[str, bytes]] = []
    for item in folder.iterdir():
        if item.is_dir() and not item.name.startswith(("_", ".")):
            entries += _walk(item, f"{before}{item.name}/")
        elif item.name.endswith((".toml", ".py")):
            entries.append((before + item.name, item.read_bytes()))
    return entries
