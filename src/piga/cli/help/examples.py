"""``piga examples``: the example files of the how-tos."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from piga.cli.common import ForceOption, say
from piga.output import results

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable


def examples(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the files.")] = Path("examples"),
    force: ForceOption = False,
) -> None:
    """Write all example files, as the how-tos use them.

    Run the commands of the how-tos in the folder that holds DIR.
    """
    texts = example_files()
    with results(out, "examples", tuple(texts), (), force=force) as folder:
        for name, content in texts.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
    for name in texts:
        say(f"wrote {out / name}")
    say(f"Try: piga simulate {out / 'dividing-head.toml'} --out head; piga calibrate head/run.toml")


def example_files() -> dict[str, bytes]:
    """Content of each example, by its name with ``/``: from the package, or from the checkout it runs in."""
    packed = files("piga.data").joinpath("examples")
    root = packed if packed.is_dir() else Path(__file__).resolve().parents[4] / "examples"
    return dict(sorted(_walk(root, "")))


def _walk(folder: Traversable, before: str) -> list[tuple[str, bytes]]:
    entries: list[tuple[str, bytes]] = []
    for item in folder.iterdir():
        if item.is_dir() and not item.name.startswith(("_", ".")):
            entries += _walk(item, f"{before}{item.name}/")
        elif item.name.endswith((".toml", ".py")):
            entries.append((before + item.name, item.read_bytes()))
    return entries
