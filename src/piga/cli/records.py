"""``piga records``: calibrations kept as evidence in an append-only, chained store; their trend over the years."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from piga.cli.common import (
    App,
    ForceOption,
    JsonOption,
    RunFileArgument,
    argument,
    counted,
    day_in,
    deliver,
    note,
    option,
    progress,
    tell,
)
from piga.errors import PigaError
from piga.output import is_hidden

if TYPE_CHECKING:
    from piga.ledger import Reproduced
    from piga.ledger.store import Record
    from piga.ledger.store.store import Store
    from piga.ledger.store.transfer import Verification
    from piga.trend.history import HistoryEntry


def _tell(kept: Store, as_json: bool, document: dict[str, Any], lines: Iterable[str]) -> None:
    """What a command found in a store, with the head that proves it."""
    head = kept.head()
    place = {"store": kept.name, "head": head.sha256}
    tell(as_json, place | document, [*lines, f"{counted(head.number, 'record')}, head {head.sha256}"])


def _tell_written(written: Verification, as_json: bool) -> None:
    document = {"file": written.name, "records": written.records, "head": written.head}
    lines = (
        f"wrote {written.name}, read back and found sound",
        f"{counted(written.records, 'record')}, head {written.head}",
    )
    tell(as_json, document, lines)


def _record_document(record: Record) -> dict[str, Any]:
    from piga.results import plain

    place = {"number": record.number, "head": record.head, "added": record.link.added, "id": record.id}
    return place | {"taken_over": plain(record.link.taken_over), "record": plain(record.document)}


def _record_lines(record: Record) -> Iterator[str]:
    document, origin = record.document, record.link.taken_over
    software = (document.software.get(name, "?") for name in ("piga", "python"))
    facts = {
        "instrument": document.serial,
        "measured": document.measured or "not said",
        "created": document.created,
        "operator": document.operator,
        "reason": document.reason,
        "supersedes": document.supersedes,
        "software": f"piga {', '.join(software)}",
    }
    if origin is not None:
        was = f"it was number {document.number} of store {document.store}"
        facts["imported"] = f"by {origin.operator}: {origin.reason}; {was}"
    yield f"record {record.id}, number {record.number}, head {record.head}"
    yield from (f"  {name:<11}{value}" for name, value in facts.items() if value is not None)
    for file in document.files:
        yield f"  {file.role:<12}{file.sha256[:16]}  {file.size:>10}  {file.name}"


def _difference_lines(document: dict[str, Any]) -> Iterator[str]:
    from piga.records.terms import shown_unit
    from piga.reports.render.numbers import ascii_text, rounded, signed

    yield "{first} -> {second}: second less first, uncertainties taken as independent".format(**document)
    for c in document["coefficients"]:
        if c["ratio"] is None:
            yield f"  {c['key']:<14} only in {document['first' if c['second'] is None else 'second']}"
        else:
            scale, unit = shown_unit(c["key"], c["unit"])
            shown = ascii_text(rounded(c["difference"] * scale, c["std"] * scale).interval)
            yield f"  {c['key']:<14} {shown:>24} {unit:<8} {ascii_text(signed(c['ratio'], 2))} u"
    yield from (f"  {line}" for line in document["notes"])
    yield from (f"  {name}: {old} -> {new}" for name, (old, new) in document["facts"].items())


def _reproduced_document(reproduced: Reproduced) -> dict[str, Any]:
    from piga.results import plain

    return {
        "id": reproduced.record.id,
        "verdict": reproduced.verdict,
        "same_platform": reproduced.same_platform,
        "changed": plain(reproduced.changed),
        "worst": reproduced.comparison.worst,
        "differences": list(reproduced.comparison.differences),
    }


def _reproduced_line(document: dict[str, Any]) -> str:
    """Whether a recomputed record is the same, and the changes since; differences go to stderr."""
    words = {
        "identical": "identical to the bit",
        "within tolerance": f"within tolerance ({document['worst']:.1g} of what is allowed)",
        "different": "NOT the same",
    }
    if document["verdict"] == "different":
        for line in document["differences"] or ("the numbers differ in their last digits",):
            note(f"piga: {document['id']}: {line}")
    pairs = {name: pair for name, pair in document["changed"].items() if pair[0] is not None}
    changed = [f"{name} {then} -> {now}" for name, (then, now) in pairs.items() if name != "source_sha256"]
    changed += ["other numeric source"] if "source_sha256" in pairs else []
    then_and_now = "; ".join(changed) or "the software of then was not recorded in full"
    where = "same software and platform" if document["same_platform"] else f"then and now: {then_and_now}"
    return f"{document['id']}: {words[document['verdict']]}; {where}"


app = App(
    "records",
    "Keep calibrations as evidence.\n\nNothing in the store can be changed unnoticed, and every record can be recomputed.",
)

StoreOption = Annotated[str, option("FILE|URL", "SQLite file, or postgresql://... URL.", envvar="PIGA_STORE")]
RecordArgument = Annotated[str, argument("RECORD", "Name of a record, or its number.")]
OperatorOption = Annotated[str, option("NAME", "Who does this.")]
ReasonOption = Annotated[str, option("WORDS", "Why.")]


def opened(where: str, *, create: bool = False) -> Store:
    """The store of a command."""
    from piga.ledger.store import open_store

    return open_store(where, create=create)


@app.command()
def add(
    run: RunFileArgument,
    store: StoreOption,
    operator: OperatorOption,
    reason: ReasonOption,
    results: Annotated[Path | None, option("DIR", "Keep the results in this folder, unchanged.")] = None,
    measured: Annotated[str | None, option("DATE", "Date of the test; UTC if it has no zone.")] = None,
    supersedes: Annotated[str | None, option("RECORD", "Record that this one corrects.")] = None,
    report: Annotated[bool, typer.Option(help="Write and keep report.html.")] = True,
    as_json: JsonOption = False,
) -> None:
    """Calibrate a run and keep inputs, result and report. Creates the store if there is none."""
    from piga.ledger import prepare_run
    from piga.ledger.store.documents import checked_text
    from piga.ledger.store.store import is_url
    from piga.records.run_file import read_run_file

    # what is wrong with the words and the store is said before the work
    checked_text("--operator", operator)
    checked_text("--reason", reason)
    if measured is not None:
        day_in(measured, "--measured")
    if supersedes is not None or is_url(store) or Path(store).exists():
        with opened(store, create=supersedes is None) as kept:
            if supersedes is not None:
                supersedes = kept.amendable(supersedes, read_run_file(run).instrument.serial)
    with progress("calibrating"):
        draft = prepare_run(
            run, operator, reason, measured=measured, supersedes=supersedes, report=report, results=results
        )
    with opened(store, create=True) as kept:
        record = kept.append(draft)
        lines = (
            f"kept record {record.id}, number {record.number}, instrument {record.document.serial}",
            f"head {record.head}",
        )
        tell(as_json, {"store": kept.name, **_record_document(record)}, lines)


@app.command("list")
def list_records(
    store: StoreOption,
    serial: Annotated[str | None, option("SERIAL", "One instrument only.")] = None,
    as_json: JsonOption = False,
) -> None:
    """List the records."""
    with opened(store) as kept:
        listed = kept.records(serial)
        old = {record.document.supersedes for record in listed}
        lines = (
            f"{r.number:5d}  {r.id}  {r.measured:%Y-%m-%d}  {r.document.serial}  {r.document.operator}"
            + ("  superseded" if r.id in old else "")
            for r in listed
        )
        _tell(kept, as_json, {"records": list(map(_record_document, listed))}, lines)


@app.command()
def show(
    record: RecordArgument,
    store: StoreOption,
    extract: Annotated[Path | None, option("DIR", "Folder for the files of the record.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Show a record.

    Shows who, when and why, the inputs, the software and the coefficients.
    """
    from piga.records.calibration.document import to_document

    with opened(store) as kept:
        shown = kept.record(record)
        calibration = kept.calibration(shown.id) if shown.file("calibration") else None
        lines = [*_record_lines(shown), *(["", calibration.summary()] if calibration else [])]
        if extract is not None:
            extract.mkdir(parents=True, exist_ok=True)
            kept.extract(shown.id, extract)
            lines.append(f"wrote {len(shown.document.files)} files to {extract}")
        result = None if calibration is None else to_document(calibration)
        _tell(kept, as_json, _record_document(shown) | {"calibration": result}, lines)


@app.command()
def diff(
    first: RecordArgument, second: RecordArgument, store: StoreOption, as_json: JsonOption = False
) -> None:
    """Compare two records.

    Shows the differences of the coefficients with their uncertainties, of inputs and of software.
    """
    from piga.ledger.evidence import difference

    with opened(store) as kept:
        document = difference(kept, first, second)
        _tell(kept, as_json, document, _difference_lines(document))


@app.command()
def verify(
    store: Annotated[str | None, option("FILE|URL", "Store to check.", envvar="PIGA_STORE")] = None,
    archive: Annotated[Path | None, argument("EXPORT.zip", "Export or backup, instead of the store.")] = None,
    head: Annotated[list[str] | None, option("SHA256", "Head noted earlier. May be repeated.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Check every link, record and file.

    If something is wrong it says what, and exits with 2.
    """
    from piga.ledger.store.store import is_url
    from piga.ledger.store.transfer import verify as check
    from piga.text_files import open_regular

    where = str(archive) if archive is not None else store
    if where is None:
        raise PigaError("nothing to verify", remedy="name an export, or give --store")
    if not is_url(where):
        open_regular(Path(where), "a store, an export or a backup").close()
    with progress("verifying") as show:
        v = check(where, head or (), show)
    names = ("sound", "records", "files", "head", "known", "problems")
    lines = [
        f"known head {one[:16]}... is that after record {n}" for one, n in v.known.items() if n is not None
    ]
    if v.sound:
        held = f"{counted(v.records, 'record')} and {counted(v.files, 'file')}"
        lines.insert(0, f"{v.name}: sound: {held} are what they were")
    lines += [f"{counted(v.records, 'record')}, head {v.head}"] if v.head else []
    tell(as_json, {"store": v.name} | {name: getattr(v, name) for name in names}, lines)
    if not v.sound:
        for problem in [] if as_json else v.problems:
            note(f"piga: {problem}")
        if not as_json:
            note(
                "  remedy: keep it as it is; use another copy, or make a store of a backup: piga records restore"
            )
        raise typer.Exit(2)


@app.command()
def export(
    out: Annotated[Path, argument("EXPORT.zip", "File to write; it must not exist.")],
    store: StoreOption,
    record: Annotated[list[str] | None, option("RECORD", "Only this record. May be repeated.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Write records into one file.

    The file explains itself and can be checked without piga.
    """
    from piga.ledger.store.transfer import export_records

    with opened(store) as kept, progress("exporting") as show:
        exported = export_records(kept, out, record, progress=show)
    _tell_written(exported, as_json)


@app.command("import")
def import_export(
    archive: Annotated[Path, argument("EXPORT.zip", "Export to take records from.")],
    store: StoreOption,
    operator: OperatorOption,
    reason: ReasonOption,
    as_json: JsonOption = False,
) -> None:
    """Append those records of an export that the store lacks.

    Appends all of them, verified, or none.
    """
    from piga.ledger.store.transfer import Export, import_records

    with Export(archive), opened(store, create=True) as kept:
        with progress("importing"):
            added = import_records(kept, archive, operator, reason)
        document = {"added": added, "records": kept.head().number}
        _tell(kept, as_json, document, [f"imported {counted(len(added), 'record')} from {archive}"])


@app.command()
def reproduce(
    store: StoreOption,
    record: Annotated[list[str] | None, argument("RECORD", "Records to recompute [default: all].")] = None,
    as_json: JsonOption = False,
) -> None:
    """Recompute records from their stored inputs.

    Exits with 2 if the numbers differ.
    """
    from piga.ledger import reproduce as recompute

    documents = []
    with opened(store) as kept:
        names = record or [entry.id for entry in kept.records()]
        with progress("recomputing", len(names)) as show:
            for number, name in enumerate(names):
                show(number, len(names), name)
                documents.append(_reproduced_document(recompute(kept, name)))
        _tell(kept, as_json, {"records": documents}, map(_reproduced_line, documents))
    if any(one["verdict"] == "different" for one in documents):
        raise typer.Exit(2)


@app.command()
def backup(
    out: Annotated[Path, argument("BACKUP", "File to write; it must not exist.")],
    store: StoreOption,
    as_json: JsonOption = False,
) -> None:
    """Write a verified copy of the store while it is in use.

    It is an export of all records.
    """
    export(out, store, as_json=as_json)


@app.command()
def restore(
    source: Annotated[Path, argument("BACKUP", "Backup, or complete export.")],
    store: StoreOption,
    as_json: JsonOption = False,
) -> None:
    """Create a store from a backup, with the same links and head.

    The store must not exist.
    """
    from piga.ledger.store.transfer import restore as make

    with progress("restoring"):
        restored = make(source, store)
    _tell_written(restored, as_json)


# -- trend ---------------------------------------------------------------------------------------------


@app.command()
def trend(
    sources: Annotated[
        list[Path] | None, argument("CALIBRATION.json|DIR", "Files, or folders of them.")
    ] = None,
    store: Annotated[str | None, option("FILE|URL", "Store, instead of files.", envvar="PIGA_STORE")] = None,
    serial: Annotated[str | None, option("SERIAL", "Serial number; needed with a store.")] = None,
    at: Annotated[str | None, option("YYYY-MM-DD", "Date of the forecast [default: a year ahead].")] = None,
    common: Annotated[float, option("PART", "Share (0 to 1) of Type B that all records have in common.")] = 1.0,
    out: Annotated[Path | None, option("DIR", "Write trend.json and trend.html.")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show how coefficients drift over the years.

    For each coefficient: stability over time, drift per year, control limits, forecast, alarms.
    """
    from piga.reports.trend import brief, page, trend_document
    from piga.trend.history import find_trend

    with progress("reading"):
        drifts = find_trend(history(sources or [], store, serial), common=common)
    date = day_in(at, "--at") if at else drifts.times[-1] + dt.timedelta(days=365)
    names = ("trend.json", "trend.html")
    with deliver(out, "trend", names, _files(sources or []), force=force, as_json=as_json) as to:
        document = trend_document(drifts, at=date)
        to.show(document, page(drifts, date), brief(drifts, date), *names)


def history(sources: list[Path], store: str | None, serial: str | None) -> Iterator[HistoryEntry]:
    """Records from files, or of an instrument in a store."""
    if sources:
        entries = (_entry(path) for path in _files(sources))
        yield from (entry for entry in entries if serial is None or entry[2].serial == serial)
        return
    if store is None:
        raise PigaError("no records are named", remedy="give calibration.json files, directories, or --store")
    if serial is None:
        raise PigaError("--store needs the instrument", remedy="add --serial")
    with opened(store) as kept:
        calibrations = kept.history(serial)
        if not calibrations:
            serials = ", ".join(sorted({record.document.serial for record in kept.records()})[:9])
            remedy = f"--serial is one of: {serials}" if serials else "add records: piga records add"
            raise PigaError(f"{store}: holds no record of '{serial}'", remedy=remedy)
        yield from calibrations


def _files(sources: list[Path]) -> list[Path]:
    """The files that are named, and those of folders; what a command is still writing is none of them."""
    paths: list[Path] = []
    for source in sources:
        inside = sorted(source.rglob("calibration*.json")) if source.is_dir() else [source]
        inside = [path for path in inside if not any(is_hidden(part) for part in path.parents)]
        if not inside:
            raise PigaError(f"{source}: holds no calibration.json", remedy="name another directory")
        paths += inside
    return list(dict.fromkeys(paths))


def _entry(path: Path) -> HistoryEntry:
    """A file as a record. Its path is the id; the time is that of the evaluation."""
    from piga.records.calibration.calibration import Calibration

    calibration = Calibration.from_json(path)
    time = day_in(calibration.provenance.created[:40], f"{path}: provenance.created")
    return str(path), time, calibration
