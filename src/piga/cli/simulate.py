"""``piga simulate``: a synthetic test with its truth."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

from piga.cli.common import output_directory, print_json, progress, say, write_by_rename


def simulate(
    scenario: Annotated[Path, typer.Argument(help="Scenario file (TOML).", show_default=False)],
    out: Annotated[Path, typer.Option(help="Directory for run.toml, the data, truth.json and the page.")],
    model: Annotated[
        Literal["quasi-steady", "twin"] | None, typer.Option(help="Override the model of the scenario.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Override the seed of the scenario.", min=0)] = None,
    force: Annotated[bool, typer.Option("--force", help="Simulate an unstable servo loop as well.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the truth as JSON.")] = False,
) -> None:
    """Simulate a test: a run to calibrate, and the truth beside it."""
    from piga.reports.simulation import simulation_text, write_simulation_report
    from piga.stand.scenario import read_scenario, run_scenario
    from piga.stand.write_run import run_file_text, truth_document, truth_text, write_data

    read = read_scenario(scenario)
    with progress("simulating"):
        test = run_scenario(read, model=model, seed=seed, force=force)
    folder = output_directory(out)
    data = folder / f"run.{read.table.run.format}"
    write_by_rename(data, partial(write_data, test))
    write_by_rename(folder / "run.toml", partial(_text, run_file_text(read, test, data.name)))
    write_by_rename(folder / "truth.json", partial(_text, truth_text(read, test)))
    serial = read.table.instrument.serial
    write_by_rename(folder / "report.html", partial(write_simulation_report, test, serial))
    if json:
        print_json(truth_document(read, test))
        return
    say(simulation_text(test))
    say(f"wrote {folder}/run.toml, {data.name}, truth.json, report.html")


def _text(text: str, path: Path) -> None:
    path.write_text(text, encoding="utf-8", newline="\n")
