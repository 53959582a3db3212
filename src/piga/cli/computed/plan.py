"""``piga plan``: which positions, and how long in each."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from piga.cli.common import ForceOption, JsonOption, files_named_in, print_json, progress, say, write_text
from piga.output import results

RESULTS = ("scenario.toml", "program.csv", "plan.json", "report.html")
"""Names of the result files."""


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
    import json

    from piga.planning.mounting import plan_mounting
    from piga.planning.plan import plan_document, plan_test, program_csv, scenario_text
    from piga.planning.plan_file import read_plan
    from piga.reports.planning import plan_text, write_plan_report

    folder = out or plan_file.with_name(f"{plan_file.stem}-plan")
    with results(folder, "plan", RESULTS, files_named_in(plan_file), force=force) as stage:
        request = read_plan(plan_file)
        with progress("planning") as advance:
            mounting = plan_mounting(request)
            planned = plan_test(request, progress=advance.show)
        document = plan_document(planned, mounting)
        text = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
        written = [
            write_text(stage / "scenario.toml", scenario_text(planned)),
            write_text(stage / "program.csv", program_csv(planned)),
            write_text(stage / "plan.json", text),
        ]
        written.append(stage / "report.html")
        with progress("writing the report"):
            write_plan_report(planned, mounting, written[-1])
    if as_json:
        print_json(document)
        return
    say(plan_text(planned, mounting))
    for path in written:
        say(f"wrote {folder / path.name}")
