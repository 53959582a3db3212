"""What ``piga records`` prints: lines for people, documents for ``--json``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from piga.cli.common import note, print_json, print_json_list, say

if TYPE_CHECKING:
    from piga.ledger import Reproduced
    from piga.ledger.store import Record, Store
    from piga.ledger.store.difference import Difference
    from piga.ledger.store.verify import Verification


def store_name(where: str) -> str:
    """Store as printed: a password in a URL is not shown."""
    from piga.ledger.store.database import is_url, postgresql_database

    return postgresql_database(where).name if is_url(where) else where


def say_head(records: int, head: str) -> None:
    """Number of records and the head that vouches for them."""
    say(f"{records} record{'' if records == 1 else 's'}, head {head}")


def record_document(record: Record) -> dict[str, Any]:
    """A record as JSON values: its place here, then the document as written."""
    from msgspec import to_builtins

    place = {"number": record.number, "head": record.head, "added": record.link.added}
    taken_over = None if record.link.taken_over is None else to_builtins(record.link.taken_over)
    return place | {"taken_over": taken_over, "record": to_builtins(record.document), "id": record.id}


def print_added(store: Store, record: Record, *, as_json: bool) -> None:
    """The record that was kept."""
    if as_json:
        print_json({"store": store.name, **record_document(record)})
        return
    say(f"kept record {record.id}, number {record.number}, instrument {record.document.serial}")
    say(f"head {record.head}")


def print_records(store: Store, where: str, serial: str | None, *, as_json: bool) -> None:
    """All records, or those of one instrument, one by one: a line or a document for each."""
    head = store.head()
    if as_json:
        print_json_list(
            {"store": store_name(where), "head": head.sha256},
            "records",
            (record_document(record) for record in store.each(serial)),
        )
        return
    old = store.superseded(serial)
    for r in store.each(serial):
        amended = "  superseded" if r.id in old else ""
        say(
            f"{r.number:5d}  {r.id}  {r.measured:%Y-%m-%d}  {r.document.serial}  {r.document.operator}{amended}"
        )
    say_head(head.number, head.sha256)


def say_record(record: Record) -> None:
    """Who, when, why, with what, and the files."""
    document = record.document
    say(f"record {record.id}, number {record.number}, head {record.head}")
    facts = [
        ("instrument", document.serial),
        ("measured", document.measured or "not said"),
        ("created", document.created),
    ]
    facts += [("operator", document.operator), ("reason", document.reason)]
    facts += [("supersedes", document.supersedes)] if document.supersedes else []
    facts += [
        ("software", f"piga {document.software.get('piga', '?')}, {document.software.get('python', '?')}")
    ]
    for name, value in facts:
        say(f"  {name:<11}{value}")
    if record.link.taken_over is not None:
        who = record.link.taken_over
        say(
            f"  imported   by {who.operator}: {who.reason}; it was number {document.number} of store {document.store}"
        )
    for file in document.files:
        say(f"  {file.role:<12}{file.sha256[:16]}  {file.size:>10}  {file.name}")


def difference_document(found: Difference) -> dict[str, Any]:
    """The difference of two records as JSON values."""
    from msgspec import to_builtins

    return {
        "first": found.first.id,
        "second": found.second.id,
        "coefficients": [to_builtins(change) | {"ratio": change.ratio} for change in found.coefficients],
        "facts": {name: list(pair) for name, pair in found.facts.items()},
        "notes": _type_a_only(found),
    }


def _type_a_only(found: Difference) -> list[str]:
    """What is to be said of the uncertainties."""
    from piga.records.coverage import TYPE_A_ONLY

    return [f"{name}: {TYPE_A_ONLY}" for name in found.type_a_only]


def say_difference(found: Difference) -> None:
    """Each coefficient's difference with its uncertainty, then the facts that differ."""
    from piga.records.terms import shown_unit
    from piga.reports.render.numbers import rounded, signed

    say(f"{found.first.id} -> {found.second.id}: second less first, uncertainties taken as independent")
    for c in found.coefficients:
        if c.difference is None or c.ratio is None:
            say(f"  {c.key:<14} only in {found.first.id if c.second is None else found.second.id}")
        else:
            scale, unit = shown_unit(c.key, c.unit)
            number = rounded(c.difference * scale, (c.std or 0.0) * scale)
            shown = f"{number.value} +- {number.uncertainty}"
            say(f"  {c.key:<14} {shown:>24} {unit:<8} {signed(c.ratio, 2)} u")
    for line in _type_a_only(found):
        say(f"  {line}")
    for name, (old, new) in found.facts.items():
        say(f"  {name}: {old} -> {new}")


def print_verification(found: Verification, *, as_json: bool) -> None:
    """What a check of the chain found."""
    if as_json:
        document = {"store": found.name, "sound": found.sound, "records": found.records, "files": found.files}
        print_json(document | {"head": found.head, "known": found.known, "problems": found.problems})
        return
    if found.sound:
        say(f"{found.name}: sound: {found.records} records and {found.files} files are what they were")
    for known, number in found.known.items():
        if number is not None:
            say(f"known head {known[:16]}... is that after record {number}")
    for problem in found.problems:
        note(f"piga: {problem}")
    if found.head:
        say_head(found.records, found.head)


def print_written(path: Path, records: int, head: str, *, as_json: bool) -> None:
    """The file that was written and read back."""
    if as_json:
        print_json({"file": str(path), "records": records, "head": head})
        return
    say(f"wrote {path}, read back and found sound")
    say_head(records, head)


def reproduced_document(found: Reproduced) -> dict[str, Any]:
    """A recomputed record as JSON values."""
    return {
        "id": found.record.id,
        "verdict": found.verdict,
        "same_platform": found.same_platform,
        "changed": {name: list(pair) for name, pair in found.changed.items()},
        "worst": found.comparison.worst,
        "differences": list(found.comparison.differences),
    }


def say_reproduced(found: Reproduced) -> None:
    """Whether a recomputed record is the same, and what changed since."""
    where = "same software and platform" if found.same_platform else f"then and now: {_changes(found)}"
    words = {
        "identical": "identical to the bit",
        "within tolerance": f"within 1e-12 kappa ({found.comparison.worst:.1g} of what is allowed)",
        "different": "NOT the same",
    }
    say(f"{found.record.id}: {words[found.verdict]}; {where}")
    if not found.reproduced:
        for line in found.comparison.differences or ("the numbers differ in their last digits",):
            note(f"piga: {found.record.id}: {line}")


def _changes(found: Reproduced) -> str:
    changed = {
        name: pair for name, pair in found.changed.items() if pair[0] is not None and name != "source_sha256"
    }
    words = [f"{name} {then} -> {now}" for name, (then, now) in changed.items()]
    words += ["other numeric source"] if found.changed.get("source_sha256", (None, None))[0] else []
    return "; ".join(words) or "the software of then was not recorded in full"
