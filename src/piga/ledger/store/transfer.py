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
from importlib.resources import files
from pathlib import Path
from typing import Self

from piga._version import __version__
from piga.errors import CancelledError, PigaError, StoreError
from piga.ledger.store import (
    DIGEST,
    PART,
    Head,
    Identity,
    Link,
    Record,
    RecordDocument,
    TakenOver,
    checked_text,
    decode,
    sha256,
)
from piga.ledger.store.store import Rows, Store, is_url, whole_file
from piga.output import write_whole
from piga.progress import Progress, report
from piga.text_files import json_object, open_regular

_EXPORT = "piga.export/1"
_MAX_TEXT = 160 << 20
"""Largest text of an export [bytes]: ``SHA256SUMS`` of a million members."""
_MEMBER = re.compile(
    r"README\.txt|manifest\.json|SHA256SUMS|store\.json|(links|records)/\d{8}\.json|files/[0-9a-f]{64}"
)


def _write_members(rows: Rows, path: Path, numbers: set[int] | None, progress: Progress | None) -> None:
    """Write an export: all links, and the records with the given numbers (None: all) with their files."""
    digests: dict[str, str] = {}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as target:

        def add(name: str, data: bytes) -> None:
            target.writestr(_member(name), data)
            digests[name] = sha256(data)

        identity = rows.identity()
        add("README.txt", files("piga.data").joinpath("export-readme.txt").read_bytes())
        add("store.json", identity)
        head, number, wanted = sha256(identity), 0, set()
        for record in rows.records():
            head, number = record.head, record.number
            add(f"links/{number:08d}.json", record.raw_link)
            if record.raw is not None and (numbers is None or number in numbers):
                add(f"records/{number:08d}.json", record.raw)
                wanted |= {file.sha256 for file in record.document.files}
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
    """An export opened for reading. Its members and ``SHA256SUMS`` are checked when it is opened."""

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self._stream = open_regular(path, "an export of records", StoreError)
        try:  # what was opened is read, even if another file replaces it now
            self.zip = zipfile.ZipFile(self._stream)
            self.members = {member.filename: member for member in self.zip.infolist()}
            self._check_members()
        except (zipfile.BadZipFile, OSError, NotImplementedError, ValueError) as error:
            self._stream.close()
            raise self._damaged(str(error)[:200]) from None
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

    def records(self) -> Iterator[Record]:
        """The chain in order. Records that are not in the export have no document."""
        for name in sorted(name for name in self.members if name.startswith("links/")):
            document = name.replace("links/", "records/")
            raw = self._text(document) if document in self.members else None
            yield Record(int(name[6:14]), self._text(name), raw)

    def sizes(self) -> dict[str, int]:
        """Size of every file in the export [bytes] by its SHA-256."""
        files = (member for member in self.members.values() if member.filename.startswith("files/"))
        return {member.filename.removeprefix("files/"): member.file_size for member in files}

    def file(self, name: str) -> Iterator[bytes]:
        """The bytes of a file in parts. The whole is checked at the end."""
        return whole_file(self._parts(f"files/{name}"), name, f"was altered in {self.name}", "use another copy")

    def _check_members(self) -> None:
        """Check names, schema and sums of the members. The files are checked when they are read, by their names."""
        members = self.zip.infolist()
        for member in members:
            packed_as_piga_packs = member.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
            if not (_MEMBER.fullmatch(member.filename) and packed_as_piga_packs) or member.flag_bits & 1:
                raise self._damaged(f"member '{member.filename[:80]}' does not belong into an export")
        schema = json_object(self._text("manifest.json")).get("schema")
        if schema != _EXPORT:
            raise StoreError(
                f"{self.name}: export of schema '{str(schema)[:80]}'", remedy="a newer one needs a newer piga"
            )
        digests = {
            name: name.removeprefix("files/") if name.startswith("files/") else sha256(self._text(name))
            for name in self.members
            if name != "SHA256SUMS"
        }
        if _listing(digests) != self._text("SHA256SUMS") or len(members) != len(self.members):
            raise self._damaged("SHA256SUMS does not fit its members")

    def _text(self, name: str) -> bytes:
        if name in self.members and self.members[name].file_size > _MAX_TEXT:
            raise self._damaged(f"member '{name}' is too large")
        return b"".join(self._parts(name))

    def _parts(self, name: str) -> Iterator[bytes]:
        if name not in self.members:
            raise self._damaged(f"member '{name}' is missing")
        try:
            with self.zip.open(self.members[name]) as stream:  # never more than its stated size
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
            with store.rows() as rows:
                result.problems += rows.damage()
                check_chain(result, rows, heads, progress)
                if rows.head() != Head(result.records, result.head):
                    there = f"{result.records} records are there"
                    result.problems.append(f"the chain was cut short, or its end altered: {there}")
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
    for record in source.records():
        number = record.number
        try:
            link = decode(record.raw_link, Link, f"link {number}", strict=True)
            if number != expected or link.number != expected:
                result.problems.append(f"record {expected} is missing: {number} follows")
            if link.previous != head:
                result.problems.append(f"record {number}: its link does not follow the one before it")
            if record.raw is not None:
                words = _problems_of(record, record.raw, link, store, names, wanted)
                result.problems += [f"record {number}: {problem}" for problem in words]
        except StoreError as error:
            result.problems.append(error.message)
        head, expected = record.head, number + 1
        seen[head] = number
        result.records += record.raw is not None
    _check_files(result, source, wanted, progress)
    result.head = head
    for known in heads:
        result.known[known] = seen.get(known.lower())
        if result.known[known] is None:
            result.problems.append(
                f"head {known}: is not in this chain: it was altered, cut short, or is another store's"
            )


def _problems_of(
    record: Record, raw: bytes, link: Link, store: str, names: set[str], wanted: dict[str, int]
) -> Iterator[str]:
    """What is wrong with a record. Its name is added to ``names``, its files with their sizes to ``wanted``."""
    if sha256(raw) != link.record:
        yield "was altered (its SHA-256 is not the one in its link)"
    document = decode(raw, RecordDocument, f"record {record.number}", strict=True)
    if record.columns not in (None, (record.head, document.id, document.serial)):
        yield "the table's columns do not fit the record"
    place = (store, link.number, link.previous)
    if link.taken_over is not None:
        identity = decode(link.taken_over.identity.encode(), Identity, "identity of the origin", strict=True)
        origin = decode(link.taken_over.link.encode(), Link, "link of the origin", strict=True)
        place = (
            (identity.store, origin.number, origin.previous) if origin.record == link.record else ("", 0, "")
        )
    if (document.store, document.number, document.after) != place:
        yield "was not written for this place"
    if document.id in names:
        yield f"has the name of another ({document.id})"
    names.add(document.id)
    for file in document.files:
        if not DIGEST.fullmatch(file.sha256) or wanted.setdefault(file.sha256, file.size) != file.size:
            yield f"file '{file.name}' has no valid digest or size"


def _check_files(
    result: Verification, source: _Source, wanted: dict[str, int], progress: Progress | None
) -> None:
    there = source.sizes()
    for name in sorted(wanted.keys() - there.keys()):
        result.problems.append(f"file {name[:12]}: is missing")
    for name in sorted(there.keys() - wanted.keys()):
        result.problems.append(f"file {str(name)[:12]}: belongs to no record")
    both = sorted(wanted.keys() & there.keys())
    for name in both:
        try:
            if {sum(map(len, source.file(name))), there[name]} != {wanted[name]}:
                result.problems.append(f"file {name[:12]}: has another size than its record says")
        except StoreError as error:
            result.problems.append(error.message)
        result.files += 1
        report(progress, result.files, len(both), "checking")


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
        with store.rows() as rows:
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
        with store.rows(writing=True) as rows:
            for record in export.records():
                if record.raw is None:
                    continue
                name = record.document.id
                if (there := rows.find(name)) is not None:
                    if there.raw == record.raw:
                        continue
                    raise StoreError(
                        f"record {name} is in the store already, with other content",
                        remedy="one of the two was changed: run piga records verify on both",
                    )
                _copy_files(rows, export, record)
                try:
                    store.check(rows, record.document)
                except PigaError as error:
                    raise StoreError(
                        f"{export.name}: record {name[:20]!r} (number {record.number} there) cannot be taken over: "
                        f"{error.message}",
                        remedy="nothing was imported: ask its laboratory for an export without it (--record)",
                    ) from None
                origin = record.link.taken_over or TakenOver(identity, record.raw_link.decode(), "", "")
                taken_over = TakenOver(origin.identity, origin.link, operator, reason)
                store.insert(rows, record.raw, taken_over)
                added.append(name)
        return added


def restore(source: Path, target: str | Path) -> Verification:
    """Create a store from a backup (a complete export), with the same identity, links and head."""
    result = Verification(str(source))

    def fill(place: str | Path) -> None:
        """The copy is checked before it is committed."""
        with Store(place, create=True, identity=export.identity()) as store, store.rows(writing=True) as rows:
            if rows.head().number or rows.identity() != export.identity():
                raise StoreError(
                    f"{store.name}: there is a store already", remedy="restore into an empty database"
                )
            for record in export.records():
                if record.raw is None:
                    raise StoreError(
                        f"the export lacks record {record.number}",
                        remedy="restore from a backup, or import what is there",
                    )
                _copy_files(rows, export, record)
                rows.add(record)
            check_chain(result, rows)
            result.require_sound(result.name)
            result.name = store.name if is_url(target) else str(target)

    with Export(source) as export:
        if is_url(target):
            fill(target)
        else:
            write_whole(Path(target), fill, replace=False, kind=StoreError)
    return result


def _copy_files(rows: Rows, export: Export, record: Record) -> None:
    for file in record.document.files:
        rows.add_file(file.sha256, file.size, export.file(file.sha256))
