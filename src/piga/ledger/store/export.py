"""Exports: records in one ZIP file with a README. The chain proves links, records and files; ``SHA256SUMS`` has all members.

Members: ``README.txt``, ``manifest.json``, ``SHA256SUMS``, ``store.json`` (identity), ``links/N.json`` (all of
them), ``records/N.json`` and ``files/SHA256`` (of the chosen records). The same store and the same piga give the same bytes.
"""

from __future__ import annotations

import json
import re
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Self

from piga._version import __version__
from piga.errors import StoreError
from piga.ledger.store.database import Rows
from piga.ledger.store.documents import PART, RECORD, Entry, RecordDocument, decode, sha256
from piga.progress import Progress, report
from piga.records.limits import open_regular
from piga.records.text_files import JsonError, json_object

SCHEMA = "piga.export/1"
_MAX_MEMBERS = 1_000_000
MAX_DOCUMENT = 16 << 20
"""Largest link or record document [bytes]."""
_MAX_SUMS = 160 * _MAX_MEMBERS
"""Largest ``SHA256SUMS`` [bytes]: at most 137 bytes for each member."""
_MAX_FILE = 16 << 30
"""Largest file [bytes]."""
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


def write_members(rows: Rows, path: Path, numbers: set[int] | None, progress: Progress | None) -> None:
    """Write an export: all links, and the records with the given numbers (None: all) with their files.

    ``progress`` gets the number of files written, and the number of all files.
    """
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
                document = decode(entry.document, RecordDocument, RECORD, "record")
                wanted |= {file.sha256 for file in document.files}
        for done, name in enumerate(sorted(wanted), start=1):
            with target.open(_member(f"files/{name}"), "w", force_zip64=True) as stream:
                stream.writelines(rows.file(name))
            digests[f"files/{name}"] = name
            report(progress, done, len(wanted), "writing")
        manifest = {
            "schema": SCHEMA,
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


def is_export(path: Path) -> bool:
    """True if the file begins like a ZIP file."""
    with suppress(StoreError), open_regular(path, error=StoreError) as stream:
        return stream.read(4) == b"PK\x03\x04"
    return False


class Export:
    """An export opened for reading. Its members, their sizes and ``SHA256SUMS`` are checked when it is opened."""

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self._stream = open_regular(path, "an export of records", StoreError)
        try:
            if self._stream.read(4) != b"PK\x03\x04":
                raise StoreError(
                    f"{path}: is not an export of records (not a ZIP file)", remedy="check the name"
                )
            try:
                self.zip = zipfile.ZipFile(
                    self._stream
                )  # read the opened file, even if another file replaces it now
            except (zipfile.BadZipFile, OSError, NotImplementedError, ValueError) as error:
                raise self._damaged(str(error)) from None
            self.members = self._checked_members()
            self._check_schema()
            self._check_sums()
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
        for member in self.zip.infolist():
            name = member.filename
            if not _MEMBER.fullmatch(name) or name in members or len(members) >= _MAX_MEMBERS:
                raise self._damaged(f"member '{name[:80]}' does not belong into an export")
            limit = (
                _MAX_FILE if name.startswith("files/") else _MAX_SUMS if name == "SHA256SUMS" else MAX_DOCUMENT
            )
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise self._damaged(f"member '{name}' is packed in a way that exports do not use")
            if member.file_size > limit or member.flag_bits & 1:
                raise self._damaged(f"member '{name}' is larger than an export may hold")
            members[name] = member
        return members

    def _check_schema(self) -> None:
        try:
            schema = json_object(self._text("manifest.json")).get("schema")
        except JsonError as error:
            raise self._damaged(f"manifest.json: {str(error)[:200]}") from None
        if schema != SCHEMA:
            raise StoreError(
                f"{self.name}: export of schema '{str(schema)[:80]}'", remedy="a newer one needs a newer piga"
            )

    def _check_sums(self) -> None:
        """Check that the sums fit the members. The files are checked when they are read, by their names."""
        digests = {
            name: name.removeprefix("files/") if name.startswith("files/") else sha256(self._text(name))
            for name in self.members
            if name != "SHA256SUMS"
        }
        if _listing(digests) != self._text("SHA256SUMS"):
            raise self._damaged("SHA256SUMS does not fit its members")

    def _member(self, name: str) -> zipfile.ZipInfo:
        if name not in self.members:
            raise self._damaged(f"member '{name}' is missing")
        return self.members[name]

    def _text(self, name: str) -> bytes:
        return b"".join(self._parts(name))

    def _parts(self, name: str) -> Iterator[bytes]:
        member = self._member(name)
        try:
            with self.zip.open(member) as stream:  # never more than the size that was checked
                while part := stream.read(PART):
                    yield part
        except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError) as error:
            raise self._damaged(f"member '{name}': {error}") from None

    def _damaged(self, reason: str) -> StoreError:
        return StoreError(
            f"{self.name}: the export is damaged ({reason})", remedy="export again, or use another copy"
        )
