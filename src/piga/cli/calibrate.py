"""``piga calibrate``, and ``piga demo``: the main job on the shipped record."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from piga.cli.common import (
    ForceOption,
    JsonOption,
    MethodOption,
    PhasesOption,
    PhaseSourceOption,
    TermsOption,
    argument,
    deliver,
    files_named_in,
    flag,
    names_in,
    note,
    option,
    progress,
)
from piga.data import EXAMPLE, copy_example
from piga.output import CALIBRATION_RESULTS

if TYPE_CHECKING:
    from piga.calibration.summary import RunSummary
    from piga.records import Calibration, Run

RunFilesArgument = Annotated[
    list[Path],
    argument("RUN.toml", "Run file. Several files, or summaries of runs (.json), are calibrated together."),
]


def calibrate(
    runs: RunFilesArgument,
    out: Annotated[Path | None, option("DIR", "Folder for the results [default: RUN-calibration].")] = None,
    terms: TermsOption = None,
    method: MethodOption = None,
    phases: PhasesOption = None,
    phase_source: PhaseSourceOption = None,
    per_run: Annotated[
        str | None, option("A,B,...", "Terms of each run alone [default: k0]; '' for none.")
    ] = None,
    compare: Annotated[str | None, option("'A,B; C'", "Sets of terms to compare.")] = None,
    summary: Annotated[bool, flag("--summary", "Also write summaries, to calibrate without the data.")] = False,
    report: Annotated[bool, typer.Option(help="Write report.html.")] = True,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate the coefficients of an instrument from its runs.

    Writes calibration.json, residuals.parquet and report.html. Several runs of one instrument are calibrated together.
    A set with reference = "gravity-norm" gives set-calibration.json and report.html.
    """
    inputs = [path for run in runs for path in files_named_in(run)]
    default = f"{runs[0].stem}-calibration" if len(runs) == 1 else "joint-calibration"
    directory = out or runs[0].parent / default
    from piga.gravity_norm.set_file import is_set_file

    if any(is_set_file(run) for run in runs):
        options = (terms, method, phases, phase_source, per_run, compare)
        _calibrate_set(
            runs, directory, inputs, plain=not summary and not any(options), force=force, as_json=as_json
        )
        return
    from piga.calibration.summary import RunSummary
    from piga.records.calibration.document import to_document

    with deliver(directory, "calibrate", CALIBRATION_RESULTS, inputs, force=force, as_json=as_json) as to:
        items = _read_items(runs) if compare is None else _with_sets(_read_items(runs), compare)
        with progress("calibrating") as advance:
            from piga.calibration.calibrate import calibrate as estimate

            calibration = estimate(
                items, names_in(terms), method, phases=phases, phase_source=phase_source,
                per_run=names_in(per_run), progress=advance,
            )  # fmt: skip
        with progress("writing the report" if report else "writing"):
            write_results(calibration, to.stage, report=report)
            for item in items if summary else []:
                if not isinstance(item, RunSummary):
                    made = RunSummary.of(item)
                    made.to_json(to / f"summary-{made.name}.json")
        to.tell(lambda: to_document(calibration), calibration.summary)


def _calibrate_set(
    runs: list[Path], directory: Path, inputs: list[Path], *, plain: bool, force: bool, as_json: bool
) -> None:
    from piga.errors import ArgumentError
    from piga.gravity_norm import calibrate_set_file
    from piga.reports.gravity_norm import brief, page, set_document

    if len(runs) > 1 or not plain:
        raise ArgumentError(
            f"{runs[0]}: a set with reference = 'gravity-norm' is calibrated alone and has no terms or methods to choose",
            remedy="name this file alone, without these options",
        )
    names = ("set-calibration.json", "report.html")
    with deliver(directory, "calibrate", names, inputs, force=force, as_json=as_json) as to:
        with progress("calibrating"):
            calibration = calibrate_set_file(runs[0])
        to.show(set_document(calibration), page(calibration), brief(calibration), *names)


def _with_sets(items: list[Run | RunSummary], text: str) -> list[Run | RunSummary]:
    """The run, with these sets of terms to compare. Only one run is allowed."""
    from dataclasses import replace

    from msgspec.structs import replace as replaced

    from piga.calibration.summary import RunSummary
    from piga.errors import ArgumentError
    from piga.records.terms import check_terms

    item = items[0]
    if len(items) > 1 or isinstance(item, RunSummary):
        raise ArgumentError("--compare: term sets are compared on one run", remedy="name one run file")
    sets = tuple(tuple(names_in(part) or ()) for part in text.split(";") if part.strip())
    if not sets:
        raise ArgumentError("--compare: there is no set of terms", remedy="e.g. 'scale_factor,tan_beta; k0'")
    for index, terms in enumerate(sets, start=1):
        check_terms(terms, where=f"--compare: set {index}")
    return [replace(item, model=replaced(item.model, compare=sets))]


def _read_items(paths: list[Path]) -> list[Run | RunSummary]:
    from piga.calibration.summary import RunSummary
    from piga.stand import read_run

    with progress("reading"):
        return [RunSummary.from_json(path) if path.suffix == ".json" else read_run(path) for path in paths]


def write_results(calibration: Calibration, directory: Path, *, report: bool = True) -> None:
    """Write the results. A calibration of summaries alone has no residuals to write."""
    from piga.formats.parquet import write_residuals

    calibration.to_json(directory / "calibration.json")
    if calibration.residuals is not None:
        write_residuals(calibration, directory / "residuals.parquet")
    if report:
        calibration.report(directory / "report.html")


def demo(
    out: Annotated[Path, option("DIR", "Folder for the results.")] = Path("piga-demo"),
    force: ForceOption = False,
) -> None:
    """Calibrate and compensate the shipped record, with a report."""
    note("demo of the shipped record; the first time takes up to a minute")
    from piga.compensation import compensate
    from piga.stand import read_run

    names = (*CALIBRATION_RESULTS, "compensated.parquet", f"{EXAMPLE}.csv", f"{EXAMPLE}.toml")
    with deliver(out, "demo", names, (), force=force, as_json=False) as to:
        run = copy_example(to.stage)
        with progress("reading"):
            record = replace(read_run(run), source=f"{to.folder}/{run.name}")
        with progress("calibrating") as show:
            from piga.calibration.calibrate import calibrate as estimate

            calibration = estimate([record], progress=show)
        with progress("writing the report"):
            write_results(calibration, to.stage)
        with progress("compensating"):
            compensate(record, calibration).to_parquet(to / "compensated.parquet")
        program = "piga" if shutil.which("piga") else sys.argv[0]  # an environment that is not activated
        again = f"To go on: change {to.folder}/{run.name} and run: {program} calibrate {to.folder}/{run.name}"
        to.tell(dict, lambda: f"{calibration.summary()}\n\n{again}")
