"""``piga calibrate``."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from piga.cli.common import note, output_directory, print_json, progress, say, write_by_rename

if TYPE_CHECKING:
    from piga.records import Calibration

RunFileArgument = Annotated[Path, typer.Argument(metavar="RUN.toml", help="Run file of the recorded test.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout, nothing else.")]


def calibrate(
    run: RunFileArgument,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Where the results go [default: RUN-calibration]."),
    ] = None,
    terms: Annotated[
        str | None, typer.Option(metavar="A,B,...", help="Terms to estimate, instead of those of the run file.")
    ] = None,
    method: Annotated[str | None, typer.Option(help="information | rate | recursive | published")] = None,
    phase: Annotated[str | None, typer.Option(help="shared | per-segment")] = None,
    phase_source: Annotated[str | None, typer.Option(help="output | input")] = None,
    report: Annotated[bool, typer.Option(help="Write report.html.")] = True,
    as_json: JsonOption = False,
) -> None:
    """Estimate the coefficients of an instrument: calibration.json, residuals.parquet, report.html."""
    wanted = None if terms is None else [name.strip() for name in terms.split(",") if name.strip()]
    directory = out or run.with_name(f"{run.stem}-calibration")
    calibration = run_calibration(run, wanted, method, phase, phase_source)
    written = write_results(calibration, output_directory(directory), report=report)
    if as_json:
        from piga.records.calibration_json import to_document

        print_json(to_document(calibration))
        return
    from piga.reports.calibration import calibration_text

    say(calibration_text(calibration))
    for path in written:
        say(f"wrote {path}")


def run_calibration(
    run: Path, terms: list[str] | None, method: str | None, phase: str | None, phase_source: str | None
) -> Calibration:
    """Read and calibrate, with progress."""
    from piga.calibration import calibrate as estimate
    from piga.stand import read_run

    with progress("reading"):
        record = read_run(run)
    with progress("calibrating"):
        return estimate(record, terms, method, phase=phase, phase_source=phase_source)


def write_results(calibration: Calibration, directory: Path, *, report: bool = True) -> list[Path]:
    """Write the three results, each by rename; says so when the report extra is not installed."""
    from piga.records.residuals_parquet import write_residuals

    with ThreadPoolExecutor(1) as beside:
        written = [write_by_rename(directory / "calibration.json", calibration.to_json)]
        residuals = beside.submit(
            write_by_rename, directory / "residuals.parquet", lambda path: write_residuals(calibration, path)
        )
        if report and report_available():
            from piga.reports.calibration import write_calibration_report

            page = directory / "report.html"
            write_by_rename(page, lambda path: write_calibration_report(calibration, path))
            return [*written, residuals.result(), page]
        return [*written, residuals.result()]


def report_available() -> bool:
    """True when the report extra is installed; otherwise a note says how to get it."""
    from importlib.util import find_spec

    if find_spec("matplotlib") is None:
        note("piga: no report.html: figures need the extra 'report' (pip install 'piga[report]')")
        return False
    return True
