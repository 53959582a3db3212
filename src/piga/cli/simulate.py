"""``piga plan``, ``simulate`` and ``reproduce``: tests to come, synthetic tests with their truth, and the published cases."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from piga.cli.common import (
    ForceOption,
    JsonOption,
    argument,
    deliver,
    files_named_in,
    flag,
    option,
    progress,
    write_text,
)

if TYPE_CHECKING:
    from piga.studies import Reproduction


_PLAN_RESULTS = ("scenario.toml", "program.csv", "plan.json", "report.html")
"""Names of the result files of ``plan``."""


def plan(
    plan_file: Annotated[Path, argument("PLAN.toml", "Plan file.", show_default=False)],
    out: Annotated[Path | None, option("DIR", "Folder for the results [default: PLAN-plan].")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Plan a test: positions, times and the uncertainty it gives.

    Writes plan.json, report.html, program.csv for the stand, and scenario.toml for 'piga simulate'.
    """
    from piga.planning.mounting import plan_mounting
    from piga.planning.plan import plan_document, plan_test, program_csv, scenario_text
    from piga.planning.plan_file import read_plan
    from piga.reports.planning import page

    inputs = files_named_in(plan_file)
    folder = out or plan_file.parent / f"{plan_file.stem}-plan"
    with deliver(folder, "plan", _PLAN_RESULTS, inputs, force=force, as_json=as_json) as to:
        request = read_plan(plan_file)
        with progress("planning") as show:
            mounting = plan_mounting(request)
            planned = plan_test(request, progress=show)
        document = plan_document(planned, mounting)
        write_text(to / "scenario.toml", scenario_text(planned))
        write_text(to / "program.csv", program_csv(planned))
        whole = page(planned, mounting)
        to.show(document, whole, whole, "plan.json", "report.html")


RESULTS = ("run.toml", "run.csv", "run.parquet", "truth.json", "report.html")
"""Names of the result files of ``simulate``."""


def simulate(
    scenario: Annotated[Path, argument("SCENARIO.toml", "Scenario file.", show_default=False)],
    out: Annotated[Path, option("DIR", "Folder for run.toml, the data, truth.json and the page.")],
    model: Annotated[
        Literal["quasi-steady", "twin"] | None,
        typer.Option(help="Instrument model, instead of the scenario's."),
    ] = None,
    seed: Annotated[int | None, option("N", "Seed of the noise, instead of the scenario's.", min=0)] = None,
    unstable: Annotated[bool, flag("--unstable", "Also accept an unstable servo loop.")] = False,
    force: ForceOption = False,
    json: Annotated[bool, flag("--json", "Print the truth as JSON.")] = False,
) -> None:
    """Simulate a test: a run to calibrate, and its truth."""
    from piga.reports.render.page import write_page
    from piga.reports.stand import page
    from piga.stand.scenario import read_scenario, run_scenario
    from piga.stand.write_run import run_file_text, truth_document, truth_text, write_data

    read = read_scenario(scenario)
    data = f"run.{read.table.run.format}"
    with deliver(out, "simulate", RESULTS, files_named_in(scenario), force=force, as_json=json) as to:
        with progress("simulating") as show:
            test = run_scenario(read, model=model, seed=seed, force=unstable, progress=show)
        with progress("writing data and report"):
            write_data(test, to / data)
            write_text(to / "run.toml", run_file_text(read, test, data))
            write_text(to / "truth.json", truth_text(read, test))
            write_page(page(test, read.table.instrument.serial), to / "report.html")
        to.tell(lambda: truth_document(read, test), test.summary)


def reproduce(
    out: Annotated[Path | None, option("DIR", "Folder for reproduction.html and the figures.")] = None,
    only: Annotated[str | None, option("ID", "Run one chapter, e.g. ten-days.")] = None,
    force: ForceOption = False,
    json: Annotated[bool, flag("--json", "Print the cases as JSON.")] = False,
) -> None:
    """Compute every published case and compare.

    Shows published value, computed value, difference and verdict. Exits with 1 if one disagrees.
    """
    from piga import studies
    from piga.reports.render.page import page_text
    from piga.studies.reproduction import brief

    with deliver(out, "reproduce", ("reproduction.html", "figures/*"), (), force=force, as_json=json) as to:
        with progress("reproducing") as show:
            reproduction = studies.reproduce(only, progress=show)
        if out is not None:
            _write(reproduction, to.stage)
        to.tell(reproduction.document, lambda: page_text(brief(reproduction)))
    if reproduction.failed:
        raise typer.Exit(1)


def _write(reproduction: Reproduction, folder: Path) -> None:
    from piga.reports.render.axes import write_figure
    from piga.reports.render.page import write_page
    from piga.studies.reproduction import reproduction_page

    pictures = folder / "figures"
    pictures.mkdir()
    write_page(reproduction_page(reproduction), folder / "reproduction.html")
    with progress("drawing", len(reproduction.figures)) as show:
        for number, figure in enumerate(reproduction.figures):
            show(number, len(reproduction.figures), figure.key)
            for kind in ("svg", "png"):
                write_figure(figure, pictures / f"{figure.key}.{kind}")
