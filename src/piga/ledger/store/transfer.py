"""Verify a store or an export, and transfer records: export, import (onto another chain), restore (the same chain).

An export is a ZIP file of records with a README. The chain proves links, records and files; ``SHA256SUMS`` has all members:
``README.txt``, ``manifest.json``, ``SHA256SUMS``, ``store.json`` (identity), ``links/N.json`` (all of them), ``records/N.json``
and ``files/SHA256`` (of the chosen records). The same store and the same piga give the same bytes.
"""

from __future__ import annotations

import json
import re
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import sqlalchemy as sa

from piga._version import __version__
from piga.errors import CancelledError, PigaError, StoreError
from piga.ledger.store.documents import (
    DIGEST,
    PART,
    Entry,
    Head,
    Identity,
    Link,
    RecordDocument,
    TakenOver,
    checked_text,
    decode,
    digest_of,
    sha256,
)
from piga.ledger.store.store import ENTRY, HEAD, SCHEMA, STORE, VERSION, Rows, Store, is_url
from piga.output import write_whole
from piga.progress import Progress, report
from piga.text_files import JsonError, json_object, open_regular

_EXPORT = "piga.export/1"
_MAX_MEMBERS = 1_000_000
_MAX_DOCUMENT, _MAX_SUMS, _MAX_FILE = 16 << 20, 160 * _MAX_MEMBERS, 16 << 30
"""Largest link or record document, ``SHA256SUMS`` (at most 137 bytes for each member) and file [bytes]."""
_MEMBER = re.compile(
    r"README\.txt|manifest\.json|SHA256SUMS|store\.json|(links|records)/\d{8}\.json|files/[0-9a-f]{64}"
)

_README = """\
This is an export of calibration records by piga. It can be checked with unzip and sha256sum alone.

  sha256sum -c SHA256SUMS      every member is what it was

store.json is the identity of the store. links/N.json is the N-th link of its chain, records/N.json the record
it vouches for, files/X the file with the SHA-256 X. The chain holds when

  "previous" of links/00000001.json is the SHA-256 of store.json,
  "previous" of each later link is the SHA-256 of the link before it,
  "record" of each link is the SHA-256 of its record,
  each file that a record lists is there under its SHA-256.

The SHA-256 of the last link is the head. A head noted earlier (every report of a record prints one) is the
SHA-256 of one of the links: then nothing up to that link was altered since.
"""


def _write_members(rows: Rows, path: Path, numbers: set[int] | None, progress: Progress | None) -> None:
    """Write an export: all links, and the records with the given numbers (None: all) with their files."""
    digests: dict[str, str] = {}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as target:

        def add(name: str, data: bytes) -> None:
            target.writestr(_member(name), data)
            digests[name] = sha256(data)

        identity = rows.identity()
        add("README.txt", _README.encode())
        add("store.json", identity)
        head, number, wanted = sha256(identity), 0, set()
        for entry in rows.entries():
            head, number = sha256(entry.link), entry.number
            add(f"links/{number:08d}.json", entry.link)
            if entry.document is not None and (numbers is None or number in numbers):
                add(f"records/{number:08d}.json", entry.document)
                document = decode(entry.document, RecordDocument, "record")
                wanted |= {file.sha256 for file in document.files}
        for done, name in enumerate(sorted(wanted), start=1):
            with target.open(_member(f"files/{name}"), "w", force_zip64=True) as stream:
                stream.writelines(rows.file(name))
            digests[f"files/{name}"] = name
            report(progress, done, len(wanted), "writing")
        manifest = {
            "schema": _EXPORT,
            "software": f"piga {__version__}",
            "records": number if numbers is None else len(numbers),
            "links": number,
            "head": head,
        }
        add("manifest.json", json.dumps(manifest, indent=1, sort_keys=True).encode())
        add("SHA256SUMS", _listing(digests))


def _listing(digests: dict[str, str]) -> bytes:
    return "".join(f"{digest}  {name}\n" for name, digest in sorted(digests.items())).encode()


def _member(name: str) -> zipfile.ZipInfo:
    member = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
    member.compress_type, member.create_system, member.external_attr = zipfile.ZIP_DEFLATED, 3, 0o644 << 16
    return member


class Export:
    """An export opened for reading. Its members, their sizes and ``SHA256SUMS`` are checked when it is opened."""

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self._stream = open_regular(path, "an export of records", StoreError)
        try:  # what was opened is read, even if another file replaces it now
            self.zip = zipfile.ZipFile(self._stream)
            self.members = self._checked_members()
            self._check_sums()
        except (zipfile.BadZipFile, OSError, NotImplementedError, ValueError) as error:
            self._stream.close()
            raise self._damaged(str(error)) from None
        except StoreError:
            self._stream.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.zip.close()
        self._stream.close()

    def identity(self) -> bytes:
        """The identity document of the store that wrote the export."""
        return self._text("store.json")

    def entries(self) -> Iterator[Entry]:
        """The chain in order. Records that are not in the export have no document."""
        numbers = sorted(int(name[6:14]) for name in self.members if name.startswith("links/"))
        for number in numbers:
            name = f"records/{number:08d}.json"
            yield Entry(
                number,
                self._text(f"links/{number:08d}.json"),
                self._text(name) if name in self.members else None,
            )

    def file_names(self) -> set[str]:
        """SHA-256 of every file in the export."""
        return {name.removeprefix("files/") for name in self.members if name.startswith("files/")}

    def file(self, name: str) -> Iterator[bytes]:
        """The parts of a file; never more bytes than its stated size."""
        return self._parts(f"files/{name}")

    def _checked_members(self) -> dict[str, zipfile.ZipInfo]:
        members: dict[str, zipfile.ZipInfo] = {}
        limits = {"files/": _MAX_FILE, "SHA256": _MAX_SUMS}
        for member in self.zip.infolist():
            name = member.filename
            packed_as_piga_packs = member.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
            if (
                not (_MEMBER.fullmatch(name) and packed_as_piga_packs)
                or name in members
                or len(members) >= _MAX_MEMBERS
                or member.file_size > limits.get(name[:6], _MAX_DOCUMENT)
                or member.flag_bits & 1
            ):
                raise self._damaged(f"member '{name[:80]}' does not belong into an export")
            members[name] = member
        return members

    def _check_sums(self) -> None:
        """Check the schema, and that the sums fit the members. The files are checked when they are read, by their names."""
        try:
            schema = json_object(self._text("manifest.json")).get("schema")
        except JsonError as error:
            raise self._damaged(f"manifest.json: {str(error)[:200]}") from None
        if schema != _EXPORT:
            raise StoreError(
                f"{self.name}: export of schema '{str(schema)[:80]}'", remedy="a newer one needs a newer piga"
            )
        digests = {
            name: name.removeprefix("files/") if name.startswith("files/") else sha256(self._text(name))
            for name in self.members
            if name != "SHA256SUMS"
        }
        if _listing(digests) != self._text("SHA256SUMS"):
            raise self._damaged("SHA256SUMS does not fit its members")

    def _text(self, name: str) -> bytes:
        return b"".join(self._parts(name))

    def _parts(self, name: str) -> Iterator[bytes]:
        if name not in self.members:
            raise self._damaged(f"member '{name}' is missing")
        try:
            with self.zip.open(self.members[name]) as stream:  # never more than the size that was checked
                while part := stream.read(PART):
                    yield part
        except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError) as error:
            raise self._damaged(f"member '{name}': {error}") from None

    def _damaged(self, reason: str) -> StoreError:
        return StoreError(
            f"{self.name}: the export is damaged ({reason})",
            remedy="export again, or use another copy; if it is a store itself, copy it and name it with --store",
        )


# -- verification ----------------------------------------------------------------------------------------

_Source = Rows | Export
"""What holds a chain: a store, or an export of one."""


@dataclass(eq=False)
class Verification:
    """Result of a verification: numbers of records and files checked, the head, the known heads, and problems in words."""

    name: str
    records: int = 0
    files: int = 0
    head: str = ""
    known: dict[str, int | None] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    @property
    def sound(self) -> bool:
        """True if there is no problem."""
        return not self.problems

    def require_sound(self, name: str) -> None:
        """Refuse what is not sound."""
        if self.problems:
            raise StoreError(
                f"{name}: {self.problems[0]} ({len(self.problems)} problems in all)",
                remedy="piga records verify lists them; use another copy",
            )


def verify(where: str | Path, heads: Iterable[str] = (), progress: Progress | None = None) -> Verification:
    """Check a store or an export from end to end.

    Parameters
    ----------
    where:
        Store (file or URL) or export.
    heads:
        Heads noted earlier, for example on reports. Each must be a head of the chain.
    progress:
        Called with the number of files checked, and the number of all files (:mod:`piga.progress`).
    """
    result = Verification(str(where))
    try:
        if not is_url(where) and _is_zip(Path(where)):
            with Export(Path(where)) as export:
                check_chain(result, export, heads, progress)
            return result
        with Store(where) as store:
            result.name = store.name
            with store.reading() as rows:
                if store.path is not None:
                    _check_sqlite(result, rows.connection)
                check_chain(result, rows, heads, progress)
                _check_tables(result, rows)
    except CancelledError:
        raise
    except PigaError as error:
        result.problems.append(error.message)
    except (TypeError, ValueError, OverflowError) as error:
        result.problems.append(f"something in it cannot be read at all ({error})")
    return result


def _is_zip(path: Path) -> bool:
    """True if the file begins like a ZIP file."""
    with suppress(StoreError), open_regular(path, error=StoreError) as stream:
        return stream.read(4) == b"PK\x03\x04"
    return False


def check_chain(
    result: Verification, source: _Source, heads: Iterable[str] = (), progress: Progress | None = None
) -> None:
    """Check links, records and files of a chain. Problems are added to ``result``."""
    identity = source.identity()
    store = decode(identity, Identity, "identity", strict=True).store
    head, expected = sha256(identity), 1
    seen: dict[str, int] = {head: 0}
    names: set[str] = set()
    wanted: dict[str, int] = {}
    for entry in source.entries():
        try:
            link = decode(entry.link, Link, f"link {entry.number}", strict=True)
            if entry.number != expected or link.number != expected:
                result.problems.append(f"record {expected} is missing: {entry.number} follows")
            if link.previous != head:
                result.problems.append(f"record {entry.number}: its link does not follow the one before it")
            if entry.document is not None:
                _check_document(result, entry, link, store, names, wanted)
        except StoreError as error:
            result.problems.append(error.message)
        head, expected = sha256(entry.link), entry.number + 1
        seen[head] = entry.number
        result.records += entry.document is not None
    _check_files(result, source, wanted, progress)
    result.head = head
    for known in heads:
        result.known[known] = seen.get(known.lower())
        if result.known[known] is None:
            result.problems.append(
                f"head {known}: is not in this chain: it was altered, cut short, or is another store's"
            )


def _check_document(
    result: Verification, entry: Entry, link: Link, store: str, names: set[str], wanted: dict[str, int]
) -> None:
    raw = entry.document or b""
    if sha256(raw) != link.record:
        result.problems.append(f"record {entry.number}: was altered (its SHA-256 is not the one in its link)")
    document = decode(raw, RecordDocument, f"record {entry.number}", strict=True)
    if entry.columns not in (None, (sha256(entry.link), document.id, document.serial)):
        result.problems.append(f"record {entry.number}: the table's columns do not fit the record")
    place = (store, link.number, link.previous)
    if link.taken_over is not None:
        place = _place_of_origin(link.taken_over, link.record)
    if (document.store, document.number, document.after) != place:
        result.problems.append(f"record {entry.number}: was not written for this place")
    if document.id in names:
        result.problems.append(f"record {entry.number}: has the name of another ({document.id})")
    names.add(document.id)
    for file in document.files:
        if not DIGEST.fullmatch(file.sha256) or wanted.setdefault(file.sha256, file.size) != file.size:
            result.problems.append(f"record {entry.number}: file '{file.name}' has no valid digest or size")


def _place_of_origin(taken_over: TakenOver, record: str) -> tuple[str, int, str]:
    """For an imported record: its original store, its number there and the head before it."""
    identity = decode(taken_over.identity.encode(), Identity, "identity of the origin", strict=True)
    link = decode(taken_over.link.encode(), Link, "link of the origin", strict=True)
    return (identity.store, link.number, link.previous) if link.record == record else ("", 0, "")


def _check_files(
    result: Verification, source: _Source, wanted: dict[str, int], progress: Progress | None
) -> None:
    there = source.file_names()
    for name in sorted(wanted.keys() - there):
        result.problems.append(f"file {name[:12]}: is missing")
    for name in sorted(there - wanted.keys()):
        result.problems.append(f"file {str(name)[:12]}: belongs to no record")
    both = sorted(wanted.keys() & there)
    for name in both:
        try:
            if digest_of(source.file(name)) != (name, wanted[name]):
                result.problems.append(f"file {name[:12]}: was altered")
        except StoreError as error:
            result.problems.append(error.message)
        result.files += 1
        report(progress, result.files, len(both), "checking")


def _check_tables(result: Verification, rows: Rows) -> None:
    """Check the tables of one row, and that the chain is as long as the head says."""
    if rows.head() != Head(result.records, result.head):
        result.problems.append(
            f"the chain was cut short, or its end altered: {result.records} records are there"
        )
    for table in (STORE, HEAD, VERSION):
        if rows.connection.execute(sa.select(sa.func.count()).select_from(table)).scalar_one() != 1:
            result.problems.append(f"table {table.name}: one row is needed")
    if rows.connection.execute(sa.select(VERSION.c.version_num)).scalar() != f"{SCHEMA:04d}":
        result.problems.append("the version of the tables was altered")


def _check_sqlite(result: Verification, connection: sa.Connection) -> None:
    rows = connection.exec_driver_sql("PRAGMA integrity_check").scalars().all()
    if rows != ["ok"]:
        result.problems.append(f"SQLite integrity_check: {'; '.join(str(row) for row in rows[:3])}")
    if connection.exec_driver_sql("PRAGMA foreign_key_check").first() is not None:
        result.problems.append("a part of a file belongs to no file")


# -- transfer ------------------------------------------------------------------------------------------


def export_records(
    store: Store, target: Path, chosen: Iterable[str] | None = None, *, progress: Progress | None = None
) -> Verification:
    """Write all records of a store, or the chosen ones, with all links of its chain.

    The file is read back before it gets its name. ``progress`` gets the number of files written, then read back, and the
    number of all files. If the store is damaged, no file is left.
    """
    numbers = None if chosen is None else {store.record(name).number for name in chosen}
    result = Verification("")

    def write(part: Path) -> None:
        nonlocal result
        with store.reading() as rows:
            _write_members(rows, part, numbers, progress)
        result = verify(part, progress=progress)
        result.require_sound(store.name)

    write_whole(target, write, replace=False, kind=StoreError)
    result.name = str(target)
    return result


def import_records(store: Store, path: Path, operator: str, reason: str) -> list[str]:
    """Append the records of an export that the store does not have yet: all of them or none.

    Each keeps its document unchanged. Its new link holds its old link, and who imported it and why.
    Returns the names of those that were added. A record that ``add`` would refuse is refused (:meth:`Store.check`).
    """
    operator, reason = checked_text("operator", operator), checked_text("reason", reason)
    with Export(path) as export:
        checked = Verification(export.name)
        check_chain(checked, export)
        checked.require_sound(export.name)
        identity = export.identity().decode()
        added = []
        with store.writing() as rows:
            for entry in export.entries():
                if entry.document is None:
                    continue
                document = decode(entry.document, RecordDocument, "record")
                if (there := rows.find(ENTRY.c.id == document.id)) is not None:
                    if there.document == entry.document:
                        continue
                    raise StoreError(
                        f"record {document.id} is in the store already, with other content",
                        remedy="one of the two was changed: run piga records verify on both",
                    )
                _copy_files(rows, export, document)
                try:
                    store.check(rows, document)
                except PigaError as error:
                    raise StoreError(
                        f"{export.name}: record {document.id[:20]!r} (number {entry.number} there) cannot be taken over: "
                        f"{error.message}",
                        remedy="nothing was imported: ask its laboratory for an export without it (--record)",
                    ) from None
                link = decode(entry.link, Link, f"link {entry.number}")
                origin = link.taken_over or TakenOver(identity, entry.link.decode(), "", "")
                taken_over = TakenOver(origin.identity, origin.link, operator, reason)
                store.insert(rows, document, entry.document, taken_over)
                added.append(document.id)
        return added


def restore(source: Path, target: str | Path) -> Verification:
    """Create a store from a backup (a complete export), with the same identity, links and head."""
    result = Verification(str(source))

    def fill(place: str | Path) -> None:
        """The copy is checked before it is committed."""
        with Store(place, create=True, identity=export.identity()) as store, store.writing() as rows:
            if rows.head().number or rows.identity() != export.identity():
                raise StoreError(
                    f"{store.name}: there is a store already", remedy="restore into an empty database"
                )
            for entry in export.entries():
                if entry.document is None:
                    raise StoreError(
                        f"the export lacks record {entry.number}",
                        remedy="restore from a backup, or import what is there",
                    )
                document = decode(entry.document, RecordDocument, "record")
                _copy_files(rows, export, document)
                rows.add(entry, document)
            check_chain(result, rows)
            result.require_sound(result.name)
            result.name = store.name if is_url(target) else str(target)

    with Export(source) as export:
        if is_url(target):
            fill(target)
        else:
            write_whole(Path(target), fill, replace=False, kind=StoreError)
    return result


def _copy_files(rows: Rows, export: Export, document: RecordDocument) -> None:
    for file in document.files:
        rows.add_file(file.sha256, file.size, export.file(file.sha256))
