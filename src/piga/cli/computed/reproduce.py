"""``piga reproduce``: compare every published case with piga's result."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from piga.cli.common import ForceOption, note, print_json, progress, say
from piga.output import results

if TYPE_CHECKING:
    from piga.studies import Reproduction

_COLOURS = {"pass": typer.colors.GREEN, "fail": typer.colors.RED, "info": typer.colors.BLUE}


def reproduce(
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder for reproduction.html and the figures.")
    ] = None,
    only: Annotated[
        str | None, typer.Option("--only", metavar="ID", help="Run one chapter, e.g. ten-days.")
    ] = None,
    force: ForceOption = False,
    json: Annotated[bool, typer.Option("--json", help="Print the cases as JSON.")] = False,
) -> None:
    """Compute every published case and compare.

    Shows published value, computed value, difference and verdict. Exits with 1 if one disagrees.
    """
    from piga.studies import Reproduction, chosen, run_chapters
    from piga.studies.reproduction import summary

    names = chosen(only)
    chapters = []
    with progress("reproducing", len(names)) as advance:
        for chapter in run_chapters(names):
            chapters.append(chapter)
            advance(1)
    reproduction = Reproduction(tuple(chapters))
    if json:
        print_json(reproduction.document())
    else:
        _print_table(reproduction)
        say("")
        say(summary(reproduction))
    if out is not None:
        with results(out, "reproduce", ("reproduction.html", "figures/*"), (), force=force) as folder:
            _write(reproduction, folder)
        if not json:
            say(f"wrote {out}/reproduction.html and {len(reproduction.figures)} figures in {out / 'figures'}")
    if reproduction.failed:
        raise typer.Exit(1)


def _print_table(reproduction: Reproduction) -> None:
    from piga.studies.reproduction import text_lines

    plain = "NO_COLOR" in os.environ
    for verdict, line in text_lines(reproduction):
        if verdict is None:
            typer.echo(line)
        else:
            typer.echo(f"{line}  {verdict if plain else typer.style(verdict, fg=_COLOURS[verdict])}")


def _write(reproduction: Reproduction, folder: Path) -> None:
    from importlib.util import find_spec

    from piga.reports.render.page import write_page
    from piga.reports.render.static import write_figure
    from piga.studies.reproduction import reproduction_page

    pictures = folder / "figures"
    pictures.mkdir()
    write_page(reproduction_page(reproduction), folder / "reproduction.html")
    kinds = ("svg", "png") if find_spec("matplotlib") else ("svg",)
    if "png" not in kinds:
        note("piga: no PNG figures: they need the extra 'report' (pip install 'piga[report]')")
    with progress("drawing", len(reproduction.figures)) as advance:
        for figure in reproduction.figures:
            for kind in kinds:
                write_figure(figure, pictures / f"{figure.key}.{kind}")
            advance(1)
