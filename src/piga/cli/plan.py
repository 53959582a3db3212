"""``piga plan``: which positions, and how long in each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from piga.cli.common import output_directory, print_json, progress, report_available, say, write_by_rename
from piga.cli.options import JsonOption


def plan(
    plan_file: Annotated[Path, typer.Argument(metavar="PLAN.toml", help="Plan file.", show_default=False)],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Where the results go [default: PLAN-plan]."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Plan a test: which positions, how long, what it will give.

    Leaves plan.json, report.html, and scenario.toml for 'piga simulate'.
    """
    import json

    from piga.calibration.mounting import plan_mounting
    from piga.calibration.plan_export import plan_document, scenario_text
    from piga.calibration.plan_file import read_plan
    from piga.calibration.planning import plan_test
    from piga.reports.planning import plan_text, write_plan_report

    request = read_plan(plan_file)
    with progress("planning"):
        mounting = plan_mounting(request)
        found = plan_test(request)
    document = plan_document(found, mounting)
    text = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    folder = output_directory(out or plan_file.with_name(f"{plan_file.stem}-plan"))
    written = [
        write_by_rename(folder / "scenario.toml", _writer(scenario_text(found))),
        write_by_rename(folder / "plan.json", _writer(text)),
    ]
    if report_available():
        written.append(
            write_by_rename(folder / "report.html", lambda path: write_plan_report(found, mounting, path))
        )
    if as_json:
        print_json(document)
        return
    say(plan_text(found, mounting))
    for path in written:
        say(f"wrote {path}")


def _writer(text: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(text, encoding="utf-8", newline="\n")
