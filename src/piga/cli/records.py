"""``piga records`` and ``certificate``: calibrations kept as evidence, their trend over the years, and certified."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import piga
from piga.cli.common import (
    FORCE,
    JSON,
    App,
    Ending,
    RunFileArgument,
    argument,
    counted,
    day_in,
    deliver,
    deliver_file,
    flag,
    note,
    option,
    progress,
    tell,
)
from piga.errors import PigaError
from piga.output import HIDDEN

if TYPE_CHECKING:
    from piga.ledger.store import Record
    from piga.ledger.store.store import Store
    from piga.ledger.store.transfer import Verification
    from piga.trend.history import HistoryEntry


def _tell(kept: Store, document: dict[str, Any], lines: Iterable[str]) -> None:
    """What a command found in a store, with the head that proves it."""
    head = kept.head()
    place = {"store": kept.name, "head": head.sha256}
    tell(place | document, [*lines, f"{counted(head.number, 'record')}, head {head.sha256}"])


def _tell_written(written: Verification) -> None:
    document = {"file": written.name, "records": written.records, "head": written.head}
    held = f"{counted(written.records, 'record')}, head {written.head}"
    tell(document, (f"wrote {written.name}, read back and found sound", held))


def _record_document(record: Record) -> dict[str, Any]:
    from piga.results import plain

    place = {"number": record.number, "head": record.head, "added": record.link.added, "id": record.id}
    return place | {"taken_over": plain(record.link.taken_over), "record": plain(record.document)}


def _record_lines(record: Record) -> Iterator[str]:
    document = _record_document(record)
    files, origin = document["record"].pop("files"), document["taken_over"]
    yield f"record {record.id}, number {record.number}, head {record.head}"
    for name in ("serial", "measured", "created", "operator", "reason", "supersedes", "software"):
        value = document["record"][name] or "not said"
        words = ", ".join(map(" ".join, value.items())) if isinstance(value, dict) else value
        yield f"  {name:<12}{words}"
    if origin is not None:
        was = f"it was number {record.document.number} of store {record.document.store}"
        yield f"  imported    by {origin['operator']}: {origin['reason']}; {was}"
    for file in files:
        yield f"  {file['role']:<12}{file['sha256'][:16]}  {file['size']:>10}  {file['name']}"


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
    changed = [f"{name} {str(then)[:20]} -> {str(now)[:20]}" for name, (then, now) in pairs.items()]
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


@app.command(ends=JSON)
def add(
    run: RunFileArgument,
    store: StoreOption,
    operator: OperatorOption,
    reason: ReasonOption,
    results: Annotated[Path | None, option("DIR", "Keep the results in this folder, unchanged.")] = None,
    measured: Annotated[str | None, option("DATE", "Date of the test; UTC if it has no zone.")] = None,
    supersedes: Annotated[str | None, option("RECORD", "Record that this one corrects.")] = None,
    report: Annotated[bool, typer.Option(help="Write and keep report.html.")] = True,
) -> None:
    """Calibrate a run and keep inputs, result and report. Creates the store if there is none."""
    from piga.ledger.store import checked_text
    from piga.ledger.store.store import is_url
    from piga.records.run_file import read_run_file

    # what is wrong with the words and the store is said before the work
    checked_text("--operator", operator)
    checked_text("--reason", reason)
    if measured is not None:
        day_in(measured, "--measured")
    if supersedes is not None or is_url(store) or Path(store).exists():
        with piga.open_store(store, create=supersedes is None) as kept:
            if supersedes is not None:
                supersedes = kept.amendable(supersedes, read_run_file(run).instrument.serial)
    with progress("calibrating"):
        draft = piga.ledger.prepare_run(
            run, operator, reason, measured=measured, supersedes=supersedes, report=report, results=results
        )
    with piga.open_store(store, create=True) as kept:
        record = kept.append(draft)
        kept_as = f"kept record {record.id}, number {record.number}, instrument {record.document.serial}"
        tell({"store": kept.name, **_record_document(record)}, (kept_as, f"head {record.head}"))


@app.command("list", JSON)
def list_records(
    store: StoreOption,
    serial: Annotated[str | None, option("SERIAL", "One instrument only.")] = None,
) -> None:
    """List the records."""
    with piga.open_store(store) as kept:
        listed = kept.records(serial)
        old = {record.document.supersedes for record in listed}
        lines = (
            f"{r.number:5d}  {r.id}  {r.measured:%Y-%m-%d}  {r.document.serial}  {r.document.operator}"
            + ("  superseded" if r.id in old else "")
            for r in listed
        )
        _tell(kept, {"records": list(map(_record_document, listed))}, lines)


@app.command(ends=JSON)
def show(
    record: RecordArgument,
    store: StoreOption,
    extract: Annotated[Path | None, option("DIR", "Folder for the files of the record.")] = None,
) -> None:
    """Show a record.

    Shows who, when and why, the inputs, the software and the coefficients.
    """
    from piga.records.calibration.document import to_document

    with piga.open_store(store) as kept:
        shown = kept.record(record)
        calibration = kept.calibration(shown.id) if shown.file("calibration") else None
        lines = [*_record_lines(shown), *(["", calibration.summary()] if calibration else [])]
        if extract is not None:
            extract.mkdir(parents=True, exist_ok=True)
            kept.extract(shown.id, extract)
            lines.append(f"wrote {len(shown.document.files)} files to {extract}")
        result = None if calibration is None else to_document(calibration)
        _tell(kept, _record_document(shown) | {"calibration": result}, lines)


@app.command(ends=JSON)
def diff(first: RecordArgument, second: RecordArgument, store: StoreOption) -> None:
    """Compare two records.

    Shows the differences of the coefficients with their uncertainties, of inputs and of software.
    """
    from piga.ledger.evidence import difference

    with piga.open_store(store) as kept:
        document = difference(kept, first, second)
        _tell(kept, document, _difference_lines(document))


@app.command(ends=JSON)
def verify(
    store: Annotated[str | None, option("FILE|URL", "Store to check.", envvar="PIGA_STORE")] = None,
    archive: Annotated[Path | None, argument("EXPORT.zip", "Export or backup, instead of the store.")] = None,
    head: Annotated[list[str] | None, option("SHA256", "Head noted earlier. May be repeated.")] = None,
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
    tell({"store": v.name} | {name: getattr(v, name) for name in names}, lines)
    if not v.sound:
        if not Ending.as_json:
            for problem in v.problems:
                note(f"piga: {problem}")
            words = "keep it as it is; use another copy, or make a store of a backup: piga records restore"
            note(f"  remedy: {words}")
        raise typer.Exit(2)


@app.command(ends=JSON)
def export(
    out: Annotated[Path, argument("EXPORT.zip", "File to write; it must not exist.")],
    store: StoreOption,
    record: Annotated[list[str] | None, option("RECORD", "Only this record. May be repeated.")] = None,
) -> None:
    """Write records into one file.

    The file explains itself and can be checked without piga.
    """
    from piga.ledger.store.transfer import export_records

    with piga.open_store(store) as kept, progress("exporting") as show:
        exported = export_records(kept, out, record, progress=show)
    _tell_written(exported)


@app.command("import", JSON)
def import_export(
    archive: Annotated[Path, argument("EXPORT.zip", "Export to take records from.")],
    store: StoreOption,
    operator: OperatorOption,
    reason: ReasonOption,
) -> None:
    """Append those records of an export that the store lacks.

    Appends all of them, verified, or none.
    """
    from piga.ledger.store.transfer import Export, import_records

    with Export(archive), piga.open_store(store, create=True) as kept:
        with progress("importing"):
            added = import_records(kept, archive, operator, reason)
        document = {"added": added, "records": kept.head().number}
        _tell(kept, document, [f"imported {counted(len(added), 'record')} from {archive}"])


@app.command(ends=JSON)
def reproduce(
    store: StoreOption,
    record: Annotated[list[str] | None, argument("RECORD", "Records to recompute [default: all].")] = None,
) -> None:
    """Recompute records from their stored inputs.

    Exits with 2 if the numbers differ.
    """
    from piga.results import plain

    documents = []
    with piga.open_store(store) as kept:
        names = record or [entry.id for entry in kept.records()]
        with progress("recomputing", len(names)) as show:
            for number, name in enumerate(names):
                show(number, len(names), name)
                made = piga.ledger.reproduce(kept, name)
                facts = {"id": made.record.id, "verdict": made.verdict, "same_platform": made.same_platform}
                facts |= {"changed": plain(made.changed), "worst": made.comparison.worst}
                documents.append(facts | {"differences": list(made.comparison.differences)})
        _tell(kept, {"records": documents}, map(_reproduced_line, documents))
    if any(one["verdict"] == "different" for one in documents):
        raise typer.Exit(2)


@app.command(ends=JSON)
def restore(
    source: Annotated[Path, argument("BACKUP", "Backup, or complete export.")],
    store: StoreOption,
) -> None:
    """Create a store from a backup, with the same links and head.

    The store must not exist.
    """
    from piga.ledger.store.transfer import restore as make

    with progress("restoring"):
        restored = make(source, store)
    _tell_written(restored)


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
) -> None:
    """Show how coefficients drift over the years.

    For each coefficient: stability over time, drift per year, control limits, forecast, alarms.
    """
    from piga.reports.trend import brief, page, trend_document

    files: list[Path] = []
    for source in sources or []:  # files, and those in folders; what a command is still writing is none of them
        inside = sorted(source.rglob("calibration*.json")) if source.is_dir() else [source]
        inside = [path for path in inside if not any(part.startswith(HIDDEN) for part in path.parts)]
        if not inside:
            raise PigaError(f"{source}: holds no calibration.json", remedy="name another directory")
        files += [path for path in inside if path not in files]
    with progress("reading"):
        drifts = piga.find_trend(history(files, store, serial), common=common)
    date = day_in(at, "--at") if at else drifts.times[-1] + dt.timedelta(days=365)
    names = ("trend.json", "trend.html")
    with deliver(out, "trend", names, files) as to:
        document = trend_document(drifts, at=date)
        to.show(document, page(drifts, date), brief(drifts, date), *names)


def history(files: list[Path], store: str | None, serial: str | None) -> list[HistoryEntry]:
    """Records from files, each of the time of its evaluation, or of an instrument in a store."""
    if files:
        read = [(str(path), piga.Calibration.from_json(path)) for path in files]
        read = [(name, one) for name, one in read if serial in (None, one.serial)]
        return [(name, day_in(one.provenance.created, name), one) for name, one in read]
    if store is None:
        raise PigaError("no records are named", remedy="give calibration.json files, directories, or --store")
    if serial is None:
        raise PigaError("--store needs the instrument", remedy="add --serial")
    with piga.open_store(store) as kept:
        calibrations = kept.history(serial)
        if not calibrations:
            serials = ", ".join(sorted({record.document.serial for record in kept.records()})[:9])
            remedy = f"--serial is one of: {serials}" if serials else "add records: piga records add"
            raise PigaError(f"{store}: holds no record of '{serial}'", remedy=remedy)
        return calibrations


# -- certificates --------------------------------------------------------------------------------------

certificates = App(
    "certificate", "Issue, verify and read back calibration certificates.\n\nBy ISO/IEC 17025, and as DCC."
)

PemOption = Annotated[Path | None, option("PEM", "X.509 certificate of the laboratory.")]
AtOption = Annotated[
    str | None, option("YYYY-MM-DD", "Day on which the X.509 certificate must be valid, instead of today.")
]


@certificates.command()
def issue(
    calibration: Annotated[Path, argument("CALIBRATION.json", "Calibration to certify.")],
    data: Annotated[Path, option("CERTIFICATE.toml", "Laboratory, customer, item, method and so on.")],
    out: Annotated[Path, option("DIR", "Folder for the certificate.")],
    dcc: Annotated[bool, flag("--dcc", "Also write certificate.xml (DCC 3.3.0).")] = False,
    key: Annotated[Path | None, option("PEM", "Private key that signs the XML.")] = None,
    certificate: PemOption = None,
) -> None:
    """Write certificate.html (A4); with --dcc also certificate.xml.

    Refuses if anything is missing, and a number that another certificate in DIR has; keep a list of numbers for other folders.
    Prints the cautions of the calibration, for the person who authorises the certificate.
    """
    from msgspec.structs import replace

    from piga.certificate.certificate_file import read_certificate_file
    from piga.certificate.dcc import dcc_document, sign_xml, written
    from piga.certificate.page import certificate_html, is_draft
    from piga.records.calibration.document import read_with_digest

    if (key is None) != (certificate is None):
        raise PigaError("--key and --certificate belong together", remedy="give both, or none")
    if key is not None and not dcc:
        raise PigaError("--key signs the XML, but no XML is written", remedy="add --dcc")
    file = read_certificate_file(data)
    named = file.certificate
    if named.issued is None:
        named = replace(named, issued=dt.datetime.now().astimezone().date())
    if is_draft(file) and not named.number.startswith("DRAFT"):  # the digital certificate shows it, too
        named = replace(named, number=f"DRAFT {named.number}")
    file = replace(file, certificate=named)
    certified, digest = read_with_digest(calibration)
    former = file.adjustment.before
    before = piga.Calibration.from_json(data.parent / former) if former else None
    html = certificate_html(file, certified, before, record_sha256=digest)
    xml = None
    if dcc:
        root = dcc_document(file, certified, before)
        xml = written(root if key is None or certificate is None else sign_xml(root, key, certificate))
    if not Ending.force:
        _refuse_used_number(file.certificate.number, html, out)
    inputs = [path for path in (calibration, data, key, certificate) if path is not None]
    cautions = [doubt.words for doubt in certified.verdict.doubts]
    made = {"certificate.html": html.encode()} | ({} if xml is None else {"certificate.xml": xml})
    with deliver(out, "certificate", ("certificate.html", "certificate.xml"), inputs) as to:
        for name, content in made.items():
            (to / name).write_bytes(content)
        files = [f"{to.folder}/{name}" for name in made]
        document = {"number": file.certificate.number, "files": files, "cautions": cautions}
        to.tell(lambda: document, str)
    if is_draft(file):
        note("piga: DRAFT: named so, or laboratory or customer are those of the example; change them in --data")
    for words in [] if Ending.as_json else cautions:
        note(f"piga: caution: {words}")


def _refuse_used_number(number: str, html: str, out: Path) -> None:
    """Refuse a number that a different certificate in the folder or in one of its numbered folders has."""
    from markupsafe import escape

    line = f'<p class="number">{escape(number)}</p>'
    for path in [out / "certificate.html", *sorted(out.glob("[0-9]*/certificate.html"))]:
        there = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else html
        if line in there and there != html:
            raise PigaError(
                f"{path}: a different certificate has the number {number}",
                remedy="give a new number, and name the old one in [certificate] replaces; "
                "--force replaces a certificate that nobody has received",
            )


@certificates.command("verify", JSON)
def verify_certificate(
    file: Annotated[Path, argument("CERTIFICATE.xml", "Signed DCC.")],
    certificate: Annotated[Path, option("PEM", "X.509 certificate that must have signed it.")],
    at: AtOption = None,
) -> None:
    """Verify a signed DCC.

    Checks the signature against the laboratory's certificate. For a DCC made by piga it also checks that all
    statements agree. If the certificate is not in force, the exit code is 2.
    """
    from piga.certificate.dcc import calibration_of, date_of_issue, is_ours, verify_signature

    day = _day(at)
    signed = verify_signature(file, certificate)
    ours, issued, why = is_ours(signed.document), date_of_issue(signed.document, file), signed.out_of_force(day)
    serial = calibration_of(signed.document, file).serial if ours else None
    ends = signed.valid_from, signed.valid_until
    was = "was" if ends[0].date() <= issued <= ends[1].date() else "was not"
    document = {
        "signature": "holds",
        "signer": signed.signer,
        "signer_in_force": not why,
        "judged_for": day.date().isoformat(),
        "certificate_valid": [end.isoformat() for end in ends],
        "issued": issued.isoformat(),
        "made_by_piga": ours,
        "serial": serial,
        "remarks": list(signed.remarks),
    }
    who = f"instrument {serial}" if ours else "not made by piga, so its statements were not compared"
    lines = [
        f"{file}: the signature holds as of {day:%Y-%m-%d}; {who}",
        f"  signed by  {signed.signer}, whose certificate is valid {ends[0]:%Y-%m-%d} to {ends[1]:%Y-%m-%d}",
        f"  on the date of issue that the file states, {issued}, it {was} in force",
    ]
    tell(document, [f"{file}: the signer's X.509 certificate {why}", *lines] if why else lines)
    for remark in signed.remarks:
        note(f"piga: {remark}")
    if why:
        raise typer.Exit(2)


def _day(at: str | None) -> dt.datetime:
    """Now, or noon UTC of the given day."""
    if at is None:
        return dt.datetime.now(dt.UTC)
    return dt.datetime.combine(day_in(at, "--at").date(), dt.time(12), dt.UTC)


@certificates.command(ends=FORCE)
def read(
    file: Annotated[Path, argument("CERTIFICATE.xml", "DCC made by piga.")],
    out: Annotated[Path, option("CALIBRATION.json", "File for the calibration.")],
    certificate: PemOption = None,
    at: AtOption = None,
) -> None:
    """Read a DCC back into calibration.json.

    'piga compensate' takes the result. With --certificate the signature is verified first.
    """
    from piga.certificate.dcc import SIGNATURE, calibration_of, read_xml, verify_signature

    inputs = [file, *([] if certificate is None else [certificate])]
    with deliver_file(out, "certificate-read", inputs) as to:
        day = _day(at)
        if certificate is None:
            root = read_xml(file)
            words = "not signed: anyone can have written it"
            if root.find(SIGNATURE) is not None:
                words = "its signature was not verified (--certificate does)"
        else:
            signed = verify_signature(file, certificate)
            why = signed.out_of_force(day)
            if why:
                raise PigaError(
                    f"{file}: the signer's X.509 certificate {why}",
                    remedy="ask the issuer; --at names the day for which it is to be judged",
                )
            root, words = signed.document, f"signed by {signed.signer}"
        calibration = calibration_of(root, file)
        calibration.to_json(to / out.name)
        count = len(calibration.coefficients)
        to.tell(dict, lambda: f"instrument {calibration.serial}, {count} coefficients; {words}")
