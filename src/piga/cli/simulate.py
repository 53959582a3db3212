"""``piga plan``, ``simulate`` and ``reproduce``: tests to come, synthetic tests with their truth, and the published cases."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from piga.cli.common import (
    ForceOption,
    JsonOption,
    files_named_in,
    note,
    print_json,
    progress,
    say,
    write_json,
    write_text,
)
from piga.output import results

if TYPE_CHECKING:
    from piga.studies import Reproduction


PLAN_RESULTS = ("scenario.toml", "program.csv", "plan.json", "report.html")
"""Names of the result files of ``plan``."""


def plan(
    plan_file: Annotated[Path, typer.Argument(metavar="PLAN.toml", help="Plan file.", show_default=False)],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder for the results [default: PLAN-plan]."),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Plan a test: positions, times and the uncertainty it gives.

    Writes plan.json, report.html, program.csv for the stand, and scenario.toml for 'piga simulate'.
    """
    from piga.planning.mounting import plan_mounting
    from piga.planning.plan import plan_document, plan_test, program_csv, scenario_text
    from piga.planning.plan_file import read_plan
    from piga.reports.planning import brief, page
    from piga.reports.render.page import page_text, write_page

    folder = out or plan_file.parent / f"{plan_file.stem}-plan"
    with results(folder, "plan", PLAN_RESULTS, files_named_in(plan_file), force=force) as stage:
        request = read_plan(plan_file)
        with progress("planning") as advance:
            mounting = plan_mounting(request)
            planned = plan_test(request, progress=advance)
        document = plan_document(planned, mounting)
        written = [
            write_text(stage / "scenario.toml", scenario_text(planned)),
            write_text(stage / "program.csv", program_csv(planned)),
            write_json(stage / "plan.json", document),
        ]
        written.append(stage / "report.html")
        with progress("writing the report"):
            write_page(page(planned, mounting), written[-1])
    if as_json:
        print_json(document)
        return
    say(page_text(brief(planned, mounting)))
    for path in written:
        say(f"wrote {folder / path.name}")


RESULTS = ("run.toml", "run.csv", "run.parquet", "truth.json", "report.html")
"""Names of the result files of ``simulate``."""


def simulate(
    scenario: Annotated[
        Path, typer.Argument(metavar="SCENARIO.toml", help="Scenario file.", show_default=False)
    ],
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder for run.toml, the data, truth.json and the page.")
    ],
    model: Annotated[
        Literal["quasi-steady", "twin"] | None,
        typer.Option(help="Instrument model, instead of the scenario's."),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of the noise, instead of the scenario's.", min=0)
    ] = None,
    unstable: Annotated[bool, typer.Option("--unstable", help="Also accept an unstable servo loop.")] = False,
    force: ForceOption = False,
    json: Annotated[bool, typer.Option("--json", help="Print the truth as JSON.")] = False,
) -> None:
    """Simulate a test: a run to calibrate, and its truth."""
    from piga.reports.render.page import write_page
    from piga.reports.stand import page
    from piga.stand.scenario import read_scenario, run_scenario
    from piga.stand.write_run import run_file_text, truth_document, truth_text, write_data

    read = read_scenario(scenario)
    data = f"run.{read.table.run.format}"
    with results(out, "simulate", RESULTS, files_named_in(scenario), force=force) as folder:
        with progress("simulating") as advance:
            test = run_scenario(read, model=model, seed=seed, force=unstable, progress=advance)
        with progress("writing data and report"):
            write_data(test, folder / data)
            write_text(folder / "run.toml", run_file_text(read, test, data))
            write_text(folder / "truth.json", truth_text(read, test))
            write_page(page(test, read.table.instrument.serial), folder / "report.html")
    if json:
        print_json(truth_document(read, test))
        return
    say(test.summary())
    for name in ("run.toml", data, "truth.json", "report.html"):
        say(f"wrote {out / name}")


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
    with progress("reproducing", len(names)) as show:
        for chapter in run_chapters(names):
            chapters.append(chapter)
            show(len(chapters), len(names), chapter.id)
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

    from piga.reports.render.axes import write_figure
    from piga.reports.render.page import write_page
    from piga.studies.reproduction import reproduction_page

    pictures = folder / "figures"
    pictures.mkdir()
    write_page(reproduction_page(reproduction), folder / "reproduction.html")
    kinds = ("svg", "png") if find_spec("matplotlib") else ("svg",)
    if "png" not in kinds:
        note("piga: no PNG figures: they need the extra 'report' (pip install 'piga[report]')")
    with progress("drawing", len(reproduction.figures)) as show:
        for number, figure in enumerate(reproduction.figures):
            show(number, len(reproduction.figures), figure.key)
            for kind in kinds:
                write_figure(figure, pictures / f"{figure.key}.{kind}")
