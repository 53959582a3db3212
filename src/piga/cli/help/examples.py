"""``piga examples``: the example files of the how-tos."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from piga.cli.common import ForceOption, say
from piga.data import example_files
from piga.output import results


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
