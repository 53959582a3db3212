"""``piga records``: calibrations kept as evidence in an append-only, chained store."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from piga.cli.common import output_directory, print_json, progress, say
from piga.cli.groups import Group
from piga.cli.options import JsonOption, RunFileArgument
from piga.cli.records_output import (
    difference_document,
    print_added,
    print_records,
    print_verification,
    print_written,
    record_document,
    reproduced_document,
    say_difference,
    say_head,
    say_record,
    say_reproduced,
    store_name,
)
from piga.errors import PigaError

if TYPE_CHECKING:
    from piga.ledger.store import Store

app = typer.Typer(
    name="records",
    cls=Group,
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Keep calibrations as evidence.\n\nThe store is append-only, chained, verifiable, and can be recomputed.",
)

StoreOption = Annotated[
    str,
    typer.Option(
        "--store", metavar="FILE|URL", envvar="PIGA_STORE", help="SQLite file, or postgresql://... URL."
    ),
]
RecordArgument = Annotated[str, typer.Argument(metavar="RECORD", help="Name of a record, or its number.")]
OperatorOption = Annotated[str, typer.Option("--operator", metavar="NAME", help="Who does this.")]
ReasonOption = Annotated[str, typer.Option("--reason", metavar="TEXT", help="Why.")]


@contextmanager
def opened(where: str, *, create: bool = False) -> Iterator[Store]:
    """The store that a command works on."""
    from piga.ledger.store import open_store

    with open_store(where, create=create) as store:
        yield store


@app.command()
def add(
    run: RunFileArgument,
    store: StoreOption,
    operator: OperatorOption,
    reason: ReasonOption,
    results: Annotated[
        Path | None,
        typer.Option("--results", metavar="DIR", help="Keep what piga calibrate left there, as it is."),
    ] = None,
    measured: Annotated[
        str | None,
        typer.Option("--measured", metavar="DATE", help="When the test was made; UTC without a zone."),
    ] = None,
    supersedes: Annotated[
        str | None, typer.Option("--supersedes", metavar="RECORD", help="Record that this one amends.")
    ] = None,
    terms: Annotated[str | None, typer.Option(metavar="A,B,...", help="As for piga calibrate.")] = None,
    method: Annotated[str | None, typer.Option(help="As for piga calibrate.")] = None,
    phase: Annotated[str | None, typer.Option(help="As for piga calibrate.")] = None,
    phase_source: Annotated[str | None, typer.Option(help="As for piga calibrate.")] = None,
    report: Annotated[bool, typer.Option(help="Make and keep report.html.")] = True,
    as_json: JsonOption = False,
) -> None:
    """Calibrate a run and keep it: inputs, result and report. Makes the store when there is none."""
    from piga.ledger import prepare_results, prepare_run

    wanted = None if terms is None else [name.strip() for name in terms.split(",") if name.strip()]
    if results is not None and any(option is not None for option in (wanted, method, phase, phase_source)):
        raise PigaError(
            "--results keeps a result as it is", remedy="leave out --terms, --method and --phase..."
        )
    _check_usable(store)
    with progress("calibrating"):
        if results is not None:
            prepared = prepare_results(run, results, operator, reason, measured=measured, supersedes=supersedes)
        else:
            prepared = prepare_run(
                run, operator, reason, terms=wanted, method=method, phase=phase, phase_source=phase_source,
                measured=measured, supersedes=supersedes, report=report,
            )  # fmt: skip
    with opened(store, create=True) as kept:
        print_added(kept, prepared.keep(kept), as_json=as_json)


def _check_usable(where: str) -> None:
    """Refuse a store that cannot be used before the work begins; a new one is made only when there is a record."""
    from piga.ledger.store.database import is_url

    if is_url(where) or Path(where).exists():
        with opened(where, create=True):
            return


@app.command("list")
def list_records(
    store: StoreOption,
    serial: Annotated[
        str | None, typer.Option("--serial", metavar="SERIAL", help="One instrument only.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the records."""
    with opened(store) as kept:
        print_records(kept, store, serial, as_json=as_json)


@app.command()
def show(
    record: RecordArgument,
    store: StoreOption,
    extract: Annotated[
        Path | None, typer.Option("--extract", metavar="DIR", help="Write the files of the record there.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show a record.

    Who, when, why, from what, with what, and the coefficients.
    """
    from piga.records.calibration_json import to_document

    with opened(store) as kept:
        found, head = kept.record(record), kept.head()
        calibration = kept.calibration(found.id) if found.file("calibration") else None
        if extract is not None:
            kept.extract(found.id, output_directory(extract, "--extract"))
    if as_json:
        result = None if calibration is None else to_document(calibration)
        print_json(
            {"store": store_name(store), "head": head.sha256, **record_document(found), "calibration": result}
        )
        return
    say_record(found)
    if calibration is not None:
        from piga.reports.calibration.page import calibration_text

        say("")
        say(calibration_text(calibration))
    if extract is not None:
        say(f"wrote {len(found.document.files)} files to {extract}")
    say_head(head.number, head.sha256)


@app.command()
def diff(
    first: RecordArgument, second: RecordArgument, store: StoreOption, as_json: JsonOption = False
) -> None:
    """Compare two records.

    Coefficients with the uncertainty of the difference, inputs, software.
    """
    from piga.ledger.store.difference import difference

    with opened(store) as kept:
        found, head = difference(kept, first, second), kept.head()
    if as_json:
        print_json({"store": store_name(store), "head": head.sha256, **difference_document(found)})
        return
    say_difference(found)
    say_head(head.number, head.sha256)


@app.command()
def verify(
    store: Annotated[
        str | None, typer.Option("--store", metavar="FILE|URL", envvar="PIGA_STORE", help="Store to check.")
    ] = None,
    archive: Annotated[
        Path | None,
        typer.Argument(metavar="[EXPORT.zip]", help="Export or backup to check instead of the store."),
    ] = None,
    head: Annotated[
        list[str] | None,
        typer.Option("--head", metavar="SHA256", help="Head noted earlier, e.g. on a report; may be repeated."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Check every link, record and file.

    Exit 2, and says what is wrong, when something is.
    """
    from piga.ledger.store import open_store  # noqa: F401 - says so when the extra is missing
    from piga.ledger.store.verify import verify as check

    where = str(archive) if archive is not None else store
    if where is None:
        raise PigaError("nothing to verify", remedy="name an export, or give --store")
    with progress("verifying") as advance:
        found = check(where, head or (), advance)
    print_verification(found, as_json=as_json)
    if not found.sound:
        raise typer.Exit(2)


@app.command()
def export(
    out: Annotated[Path, typer.Argument(metavar="EXPORT.zip", help="File to write; it must not exist.")],
    store: StoreOption,
    record: Annotated[
        list[str] | None, typer.Option("--record", metavar="RECORD", help="This record only; may be repeated.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write records into one file that explains itself.

    It can be checked without piga.
    """
    from piga.ledger.store.transfer import export_records

    with opened(store) as kept, progress("exporting") as advance:
        found = export_records(kept, out, record, advance=advance)
    print_written(out, found.records, found.head, as_json=as_json)


@app.command("import")
def import_export(
    archive: Annotated[Path, typer.Argument(metavar="EXPORT.zip", help="Export to take records from.")],
    store: StoreOption,
    operator: OperatorOption,
    reason: ReasonOption,
    as_json: JsonOption = False,
) -> None:
    """Append the records of an export that the store does not have.

    All of them, verified, or none.
    """
    from piga.ledger.store.transfer import import_records

    with opened(store, create=True) as kept, progress("importing"):
        added = import_records(kept, archive, operator, reason)
        head = kept.head()
    if as_json:
        print_json({"store": store_name(store), "added": added, "records": head.number, "head": head.sha256})
        return
    say(f"imported {len(added)} records from {archive}")
    say_head(head.number, head.sha256)


@app.command()
def reproduce(
    store: StoreOption,
    record: Annotated[
        list[str] | None, typer.Argument(metavar="[RECORD]...", help="Records to recompute [default: all].")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Recompute records from their stored inputs.

    Exit 2 when the numbers are not the same.
    """
    from piga.ledger import reproduce as recompute

    found = []
    with opened(store) as kept:
        names = record or [entry.id for entry in kept.each()]
        with progress("recomputing", len(names)) as advance:
            for name in names:
                found.append(recompute(kept, name))
                advance(1)
        head = kept.head()
    if as_json:
        results = [reproduced_document(one) for one in found]
        print_json({"store": store_name(store), "head": head.sha256, "records": results})
    else:
        for one in found:
            say_reproduced(one)
        say_head(head.number, head.sha256)
    if not all(one.reproduced for one in found):
        raise typer.Exit(2)


@app.command()
def backup(
    out: Annotated[Path, typer.Argument(metavar="BACKUP", help="File to write; it must not exist.")],
    store: StoreOption,
    as_json: JsonOption = False,
) -> None:
    """Write a verified copy of the store while it is in use.

    Of PostgreSQL it is a complete export.
    """
    from piga.ledger.store.transfer import backup as copy

    with opened(store) as kept, progress("copying") as advance:
        found = copy(kept, out, advance=advance)
    print_written(out, found.records, found.head, as_json=as_json)


@app.command()
def restore(
    source: Annotated[Path, typer.Argument(metavar="BACKUP", help="Backup, or complete export.")],
    store: StoreOption,
    as_json: JsonOption = False,
) -> None:
    """Make a store from a backup: same links, same head.

    The store must not exist yet.
    """
    from piga.ledger.store import open_store  # noqa: F401 - says so when the extra is missing
    from piga.ledger.store.transfer import restore as make

    with progress("restoring"):
        found = make(source, store)
    print_written(Path(store_name(store)), found.records, found.head, as_json=as_json)
