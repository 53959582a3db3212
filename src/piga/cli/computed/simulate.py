"""``piga simulate``: a synthetic test with its truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from piga.cli.common import ForceOption, files_named_in, print_json, progress, say, write_text
from piga.output import results

RESULTS = ("run.toml", "run.csv", "run.parquet", "truth.json", "report.html")
"""Names of the result files."""


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
    from piga.reports.stand import simulation_text, write_simulation_report
    from piga.stand.scenario import read_scenario, run_scenario
    from piga.stand.write_run import run_file_text, truth_document, truth_text, write_data

    read = read_scenario(scenario)
    data = f"run.{read.table.run.format}"
    with results(out, "simulate", RESULTS, files_named_in(scenario), force=force) as folder:
        with progress("simulating") as advance:
            test = run_scenario(read, model=model, seed=seed, force=unstable, progress=advance.show)
        with progress("writing data and report"):
            write_data(test, folder / data)
            write_text(folder / "run.toml", run_file_text(read, test, data))
            write_text(folder / "truth.json", truth_text(read, test))
            write_simulation_report(test, read.table.instrument.serial, folder / "report.html")
    if json:
        print_json(truth_document(read, test))
        return
    say(simulation_text(test))
    for name in ("run.toml", data, "truth.json", "report.html"):
        say(f"wrote {out / name}")
