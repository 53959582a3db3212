"""``piga check``, ``convert`` and ``noise``: what is in a record, and the noise of a static log."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from piga.cli.common import (
    ForceOption,
    JsonOption,
    RunFileArgument,
    argument,
    deliver,
    deliver_file,
    files_named_in,
    flag,
    option,
    progress,
    say,
    tell,
)
from piga.errors import ArgumentError, PigaError

if TYPE_CHECKING:
    from piga.calibration import TermProspect


def check(
    run: Annotated[Path | None, argument("RUN.toml", "Run file of the recorded test.")] = None,
    out: Annotated[Path | None, option("DIR", "Write check.html with a picture of the record.")] = None,
    fix_suggestions: Annotated[
        bool, flag("--fix-suggestions", "Print lines for the run file that settle the open questions.")
    ] = False,
    terms: Annotated[
        bool, flag("--terms", "Also say which terms the record determines. This takes as long as a fit.")
    ] = False,
    explain: Annotated[
        str | None, option("KEY", "Say what a key of any TOML file means, e.g. data.time.stamp.")
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show the content of a recorded test. Nothing is calibrated."""
    if explain is not None:
        _explain(explain, as_json)
        return
    if run is None:
        raise ArgumentError("no run file is named", remedy="piga check RUN.toml, or piga check --explain KEY")
    from piga.stand import read_run

    try:
        with progress("reading"):
            record = read_run(run)
    except PigaError:
        if fix_suggestions:
            say("\n".join(suggested_lines(run)))
        raise
    from piga.reports.check import brief, check_document, page
    from piga.reports.render.page import page_text, write_page

    prospects: tuple[TermProspect, ...] = ()
    if terms:
        from piga.calibration import term_prospects

        with progress("asking for each term"):
            prospects = term_prospects(record)
    with deliver(out, "check", ("check.html",), files_named_in(run), force=force, as_json=as_json) as to:
        if out is not None:
            write_page(page(record, prospects), to / "check.html")
        lines = suggested_lines(run) if fix_suggestions and not as_json else []
        to.tell(
            lambda: check_document(record, prospects),
            lambda: "\n".join([page_text(brief(record, prospects)), *lines]),
        )


def _explain(key: str, as_json: bool) -> None:
    from piga.cli.words import explain, key_documents, key_lines

    hits = explain(key)
    tell(as_json, key_documents(hits), key_lines(hits))


def convert(
    run: RunFileArgument,
    out: Annotated[Path, option("FILE.parquet", "File for the clean record.")],
    force: ForceOption = False,
) -> None:
    """Write a recorded test as clean Parquet in SI.

    The file holds the units and all findings.
    """
    from piga.formats.parquet import data_table, write_run_parquet
    from piga.stand import read_run

    if out.suffix != ".parquet":
        raise PigaError(f"--out {out}: the name must end in .parquet", remedy="e.g. clean.parquet")
    with deliver_file(out, "convert", files_named_in(run), force=force) as to:
        with progress("reading"):
            record = read_run(run)
        with progress("writing"):
            write_run_parquet(record, to / out.name)
        to.tell(dict, lambda: f"{record.size} of {record.quality.rows} rows")
    say(f"a run file reads it with\n\n{data_table(record, out.name)}")


def suggested_lines(run: Path) -> list[str]:
    """The lines that were tried, in run-file syntax, with the reason as a comment."""
    from piga.describe.run_file import suggestions

    with progress("trying run-file lines"):
        tried = suggestions(run)
    lines = [] if tried else ["# no run-file line would change what was found"]
    for item in tried:
        lines += [f"# {' '.join(item.reason.split())}", f"{item.line}    # in [{item.table}]"]
    return lines


def noise(
    log: Annotated[Path, argument("LOG", "Run file, or a log written by any program.")],
    column: Annotated[str | None, option("NAME", "Column of the output, for a log.")] = None,
    kind: Annotated[
        Literal["rate", "angle"],
        typer.Option("--kind", help="rate: a voltage, a rate. angle: what is summed up, as counts, a phase."),
    ] = "rate",
    unit: Annotated[str | None, option("UNIT", "Unit of the column [default: as in the log].")] = None,
    sample_rate: Annotated[str | None, option("RATE", "If no column holds the time, e.g. '20 Hz'.")] = None,
    out: Annotated[Path | None, option("DIR", "Write noise.json and noise.html.")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show the noise of a static log.

    Allan, modified and Hadamard deviation, and the levels of quantisation, random walk, bias instability, rate random walk
    and drift, each with its interval.
    """
    from piga.noise import read_static_log
    from piga.reports.noise import brief, noise_document, page

    with progress("reading"):
        result = read_static_log(log, column=column, kind=kind, unit=unit, sample_rate=sample_rate)
    names = ("noise.json", "noise.html")
    inputs = files_named_in(log) if log.suffix == ".toml" else [log]
    with deliver(out, "noise", names, inputs, force=force, as_json=as_json) as to:
        to.show(noise_document(result), page(result), brief(result), *names)
