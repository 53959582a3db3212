"""The store. Records are appended, listed and read. Nothing is ever changed or deleted."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Self

from piga.errors import ArgumentError, CalibrationError, PigaWarning, StoreError
from piga.ledger.store.database import ENTRY, Database, Rows, entry_of, is_url
from piga.ledger.store.documents import (
    IDENTITY,
    LINK,
    RECORD,
    Draft,
    Entry,
    Head,
    Identity,
    Link,
    Position,
    Record,
    RecordDocument,
    StoredFile,
    TakenOver,
    check_record,
    decode,
    digest_of,
    encode,
    is_id,
    new_id,
    now,
    safe_name,
    sha256,
)
from piga.output import write_whole
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.document import MOST_BYTES, calibration_from_bytes
from piga.text_files import open_regular

if TYPE_CHECKING:
    import sqlalchemy as sa

_INPUT_ROLES = ("run", "data", "sidecar", "stand")
"""Roles of the files that a calibration is computed from."""


class Store(Database):
    """A store of records, opened by :func:`piga.open_store`. Use it in a ``with`` block or close it.

    ``where`` is a SQLite file, or the URL of a PostgreSQL database. ``create`` makes the store if there is none.
    """

    def __init__(self, where: str | Path, *, create: bool = False) -> None:
        if not is_url(where) and (os.path.exists(where) or not create):  # noqa: PTH110 - Path.exists refuses long names
            open_regular(Path(where), "a store; piga records add makes a new one", StoreError).close()
        super().__init__(where, new=create)
        if create:
            with self.writing() as rows:
                if rows.version() == 0:
                    rows.create()
        self.check_version()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self.engine.dispose()

    def head(self) -> Head:
        """The current head of the chain."""
        with self.reading() as rows:
            return rows.head()

    def records(self, serial: str | None = None) -> tuple[Record, ...]:
        """All records in order, or those of one instrument."""
        with self.reading() as rows:
            return tuple(self._each(rows, serial))

    def record(self, name: str | int) -> Record:
        """One record, by its name or by its number in this store.

        Raises
        ------
        StoreError
            If there is no such record.
        """
        with self.reading() as rows:
            return self._find(rows, str(name))

    def read(self, name: str | int, role: str) -> bytes:
        """The first file with this role (run, data, calibration, report, ...) in a record.

        Raises
        ------
        StoreError
            If there is no such record or file, or it is damaged.
        """
        with self.reading() as rows:
            record = self._find(rows, str(name))
            file = record.file(role)
            if file is None:
                roles = ", ".join(sorted({stored.role for stored in record.document.files}))
                raise StoreError(f"record {record.id} has no file '{role}'", remedy=f"it has: {roles}")
            return b"".join(rows.file(file.sha256))

    def calibration(self, name: str | int) -> Calibration:
        """The calibration of a record (without residuals)."""
        return calibration_from_bytes(self.read(name, "calibration"), Path(f"record {name}"))

    def history(self, serial: str) -> list[tuple[str, datetime, Calibration]]:
        """Calibrations of one instrument in the order of the tests: record, time, calibration.

        Superseded records are left out, because their successors replace them. A calibration that cannot be read is left
        out, and a :class:`piga.PigaWarning` names it.
        """
        calibrations = []
        with self.reading() as rows:
            kept = sorted(self._each(rows, serial), key=lambda record: (record.measured, record.number))
            old = {record.document.supersedes for record in kept}
            for record in kept:
                file = record.file("calibration")
                if file is None or record.id in old:
                    continue
                raw = b"".join(rows.file(file.sha256))
                try:
                    calibration = calibration_from_bytes(raw, Path(f"record {record.id}"))
                except CalibrationError as error:
                    warnings.warn(f"{self.name}: left out: {error}", PigaWarning, stacklevel=2)
                    continue
                calibrations.append((record.id, record.measured, calibration))
        return calibrations

    def extract(self, name: str | int, folder: Path, *, inputs_only: bool = False) -> Path:
        """Write the files of a record below ``folder`` under their own names. Returns the path of the run file.

        Raises
        ------
        StoreError
            If a name would lead out of the folder, or a file exists already.
        """
        run = folder
        with self.reading() as rows:
            for file in self._find(rows, str(name)).document.files:
                if inputs_only and file.role not in _INPUT_ROLES:
                    continue
                path = folder / safe_name(file.name)
                run = path if file.role == "run" else run
                _write_new(path, rows.file(file.sha256))
        return run

    def append(self, draft: Draft) -> Record:
        """Append one record. When this returns, it is on disk.

        Raises
        ------
        StoreError, ArgumentError
            If the record is refused; the store is unchanged.
        """
        with self.writing() as rows:
            head = rows.head()
            place = Position(new_id(), head.number + 1, _identity(rows).store, head.sha256)
            document = self._document(rows, place, draft)
            return self.insert(rows, document, encode(document))

    def insert(
        self, rows: Rows, document: RecordDocument, raw: bytes, taken_over: TakenOver | None = None
    ) -> Record:
        """Append a record whose files are stored, with a new link. ``raw``: the bytes of the document."""
        head = rows.head()
        link = Link(LINK, head.number + 1, head.sha256, sha256(raw), now(), taken_over)
        entry = Entry(link.number, encode(link), raw)
        rows.add(entry, document)
        return Record(link.number, sha256(entry.link), link, document)

    def _document(self, rows: Rows, place: Position, draft: Draft) -> RecordDocument:
        files = []
        for file in (*draft.files, *([draft.report(place)] if draft.report else [])):
            digest, size = digest_of(file.parts())
            if file.sha256 not in (None, digest):
                raise StoreError(
                    f"{file.name}: is not the file that the calibration was computed from (its SHA-256 differs)",
                    remedy="calibrate again, with the files as they are now",
                )
            rows.add_file(digest, size, file.parts())
            files.append(StoredFile(file.role, file.name, digest, size))
        document = RecordDocument(
            schema=RECORD,
            id=place.id,
            store=place.store,
            number=place.number,
            after=place.after,
            created=now(),
            operator=draft.operator.strip(),
            reason=draft.reason.strip(),
            serial=draft.serial,
            files=tuple(files),
            request=draft.request,
            software=draft.software,
            measured=draft.measured,
            supersedes=None if draft.supersedes is None else self._find(rows, draft.supersedes).id,
        )
        self.check(rows, document)
        return document

    def check(self, rows: Rows, document: RecordDocument) -> None:
        """Refuse a record that must not be added or imported. Its files are stored already."""
        check_record(document)
        for file in document.files:
            if file.role == "calibration":
                _check_calibration(rows, file, document.serial)
        if document.supersedes is None:
            return
        there = rows.find(ENTRY.c.id == document.supersedes)
        old = (
            None if there is None else self._record(there)
        )  # an export may leave out a record that another amends
        self._check_amended(rows, document.supersedes, document.serial, old)
        if old and old.document.store != document.store and document.store != _identity(rows).store:
            raise ArgumentError(
                f"supersedes: record {old.id} is not of the store that the record comes from",
                remedy="a record is amended where it was written, or by this store",
            )

    def amendable(self, name: str, serial: str) -> str:
        """Name of a record that a new record of this instrument may supersede; ``name`` may be its number."""
        with self.reading() as rows:
            old = self._find(rows, name)
            self._check_amended(rows, old.id, serial, old)
            return old.id

    def _check_amended(self, rows: Rows, name: str, serial: str, old: Record | None) -> None:
        if old is not None and old.document.serial != serial:
            raise ArgumentError(
                f"supersedes: record {name} is of instrument '{old.document.serial}', not '{serial}'",
                remedy="name a record of the same instrument: piga records list",
            )
        for other in self._each(rows, serial):
            if other.document.supersedes == name:
                raise ArgumentError(
                    f"supersedes: record {name} is superseded already, by {other.id}",
                    remedy=f"supersede {other.id}",
                )

    def _find(self, rows: Rows, name: str) -> Record:
        text = name.strip().upper()
        if is_id(text):
            condition = ENTRY.c.id == text
        elif text.isascii() and text.isdigit() and len(text) < 10:
            condition = ENTRY.c.number == int(text)
        else:
            raise StoreError(f"'{name}' is not a record", remedy="give a number, or a name like 7K3QP-9XW2M")
        row = rows.find(condition)
        if row is None:
            raise StoreError(f"{self.name}: no record {name}", remedy="piga records list shows them")
        return self._record(row)

    def _each(self, rows: Rows, serial: str | None) -> Iterator[Record]:
        return map(self._record, rows.chain(*([] if serial is None else [ENTRY.c.serial == serial])))

    def _record(self, row: sa.Row) -> Record:
        what, entry = f"{self.name}: record {row.number}", entry_of(row)
        link = decode(entry.link, Link, LINK, what)
        return Record(row.number, row.head, link, decode(entry.document or b"", RecordDocument, RECORD, what))


def _write_new(path: Path, parts: Iterator[bytes]) -> None:
    """Write a new file. It appears under its name when it is complete, or not at all."""

    def write(part: Path) -> None:
        with part.open("wb") as stream:
            stream.writelines(parts)

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(
            f"{path}: cannot be written ({error.strerror})", remedy="choose another folder"
        ) from None
    write_whole(path, write, replace=False, remedy="choose another folder", kind=StoreError)


def _identity(rows: Rows) -> Identity:
    return decode(rows.identity(), Identity, IDENTITY, "identity")


def _check_calibration(rows: Rows, file: StoredFile, serial: str) -> None:
    """Refuse a file that is no calibration, or one of another instrument."""
    if file.size > MOST_BYTES:
        raise StoreError(
            f"{file.name}: larger than {MOST_BYTES} bytes",
            remedy="a calibration is never so large; check the file",
        )
    stated = calibration_from_bytes(b"".join(rows.file(file.sha256)), Path(file.name)).serial
    if stated != serial:
        raise StoreError(
            f"{file.name}: is of instrument '{stated[:60]}', the record of '{serial}'",
            remedy="keep each calibration under its own instrument",
        )
