"""``piga check`` and ``piga convert``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from piga.cli.common import (
    ForceOption,
    JsonOption,
    RunFileArgument,
    files_named_in,
    print_json,
    progress,
    say,
    write_by_rename,
)
from piga.errors import PigaError
from piga.output import check_outputs, results

if TYPE_CHECKING:
    from piga.records import Run


def check(
    run: RunFileArgument,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Write check.html with a picture of the record.")
    ] = None,
    fix_suggestions: Annotated[
        bool,
        typer.Option("--fix-suggestions", help="Print lines for the run file that settle the open questions."),
    ] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show what is in a recorded test. Nothing is calibrated."""
    from piga.stand import read_run

    try:
        with progress("reading"):
            record = read_run(run)
    except PigaError:
        if fix_suggestions:
            print_suggestions(run)
        raise
    document = _quality_document(record)
    if as_json:
        print_json(document)
    else:
        _print_check(run, record, document)
    if fix_suggestions and not as_json:
        print_suggestions(run)
    if out is not None:
        from piga.reports.check import write_check

        with results(out, "check", ("check.html",), files_named_in(run), force=force) as folder:
            write_check(record, folder / "check.html")
        if not as_json:
            say(f"wrote {out / 'check.html'}")


def convert(
    run: RunFileArgument,
    out: Annotated[Path, typer.Option("--out", metavar="FILE.parquet", help="File for the clean record.")],
    force: ForceOption = False,
) -> None:
    """Write a recorded test as clean Parquet in SI.

    The file holds the units, and everything that was noticed.
    """
    from piga.formats.parquet_writer import data_table, write_run_parquet
    from piga.stand import read_run

    if out.suffix != ".parquet":
        raise PigaError(f"--out {out}: the name must end in .parquet", remedy="e.g. clean.parquet")
    check_outputs([out], files_named_in(run), force=force)
    with progress("reading"):
        record = read_run(run)
    write_by_rename(out, lambda path: write_run_parquet(record, path))
    say(f"wrote {out}: {record.size} of {record.quality.rows} rows; a run file reads it with")
    say("")
    say(data_table(record, out.name))


def _print_check(run: Path, record: Run, document: dict[str, Any]) -> None:
    say(f"{run}: instrument {record.serial}, {record.size} of {record.quality.rows} rows used")
    say(
        f"  segments   {len(record.labels)}, {document['duration_s']:.6g} s recorded, {document['rate_hz']:.6g} Hz"
    )
    say(f"  reference  |f| {document['force_g'][0]:.6g} to {document['force_g'][1]:.6g} g")
    say(
        f"  phase      {'kept through the whole record' if document['phase_kept'] else 'lost between segments'}"
    )
    say(f"  calibrate  {document['calibration']}")
    if not record.quality.events:
        say("  findings   none")
    for event in record.quality.events:
        row = "" if event.first_row is None else f", first at row {event.first_row}"
        say(f"  found      {event.count} x {event.kind}{row}{': ' + event.detail if event.detail else ''}")


def print_suggestions(run: Path) -> None:
    """Print the lines that were tried in run-file syntax, with the reason as a comment."""
    from piga.describe import suggestions

    with progress("trying run-file lines"):
        tried = suggestions(run)
    if not tried:
        say("# no run-file line would change what was found")
    for item in tried:
        say(f"# {' '.join(item.reason.split())}")
        say(f"{item.line}    # in [{item.table}]")


def _quality_document(record: Run) -> dict[str, Any]:
    import msgspec
    import numpy as np

    from piga.records.spool import spans
    from piga.reports.check import calibration_words
    from piga.units import G0

    low, high = np.inf, 0.0
    for part in spans(record.size):
        size = np.linalg.norm(record.f[part], axis=1)
        low, high = min(low, float(size.min())), max(high, float(size.max()))
    return {
        "serial": record.serial,
        "quality": msgspec.to_builtins(record.quality),
        "segments": list(record.labels),
        "duration_s": record.duration,
        "rate_hz": 1.0 / step if (step := record.median_step) > 0.0 else 0.0,
        "force_g": [low / G0, high / G0],
        "phase_kept": len(set(record.phase_group)) == 1,
        "calibration": calibration_words(record),
        "input_sha256": record.input_sha256,
    }
