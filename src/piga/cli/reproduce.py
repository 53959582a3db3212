"""``piga reproduce``: every published case beside ours, judged."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from piga.cli.common import output_directory, print_json, progress, say, write_by_rename

if TYPE_CHECKING:
    from piga.reports.reproduction import Reproduction

_COLOURS = {"pass": typer.colors.GREEN, "fail": typer.colors.RED, "info": typer.colors.BLUE}


def reproduce(
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Directory for reproduction.html and figures.")
    ] = None,
    only: Annotated[
        str | None, typer.Option("--only", metavar="ID", help="Run one chapter, e.g. ten-days.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the cases as JSON.")] = False,
) -> None:
    """Reproduce every published case, and judge it.

    Published, computed, difference, verdict; exit 1 if one disagrees.
    """
    from piga.reports.reproduction import Reproduction, chosen, run_chapters
    from piga.reports.reproduction.page import summary

    names = chosen(only)
    folder = None if out is None else output_directory(out)
    chapters = []
    with progress("reproducing", len(names)) as advance:
        for chapter in run_chapters(names):
            chapters.append(chapter)
            advance(1)
    found = Reproduction(tuple(chapters))
    if json:
        print_json(found.document())
    else:
        _print_table(found)
        say("")
        say(summary(found))
    if folder is not None:
        _write(found, folder, quiet=json)
    if found.failed:
        raise typer.Exit(1)


def _print_table(found: Reproduction) -> None:
    from piga.reports.reproduction.page import text_lines

    plain = "NO_COLOR" in os.environ
    for verdict, line in text_lines(found):
        if verdict is None:
            typer.echo(line)
        else:
            typer.echo(f"{line}  {verdict if plain else typer.style(verdict, fg=_COLOURS[verdict])}")


def _write(found: Reproduction, folder: Path, *, quiet: bool) -> None:
    from piga.reports.page import write_page
    from piga.reports.reproduction.page import reproduction_page
    from piga.reports.static import write_figure

    pictures = output_directory(folder / "figures")
    page = reproduction_page(found)
    write_by_rename(folder / "reproduction.html", partial(write_page, page))
    with progress("drawing", len(found.figures)) as advance:
        for figure in found.figures:
            for kind in ("svg", "png"):
                write_by_rename(pictures / f"{figure.key}.{kind}", partial(write_figure, figure))
            advance(1)
    if not quiet:
        say(f"wrote {folder}/reproduction.html and {len(found.figures)} figures (SVG, PNG) in {pictures}")
