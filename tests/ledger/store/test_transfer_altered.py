"""Every change is found: random bytes, lengths, rows and members, in stores and exports.

A flipped byte that ``verify`` does not report must lie where the file keeps no content (unused space of a page, counters of
a header, dates of a member): then everything that can be read from the file is compared, and must be the same.
"""

from __future__ import annotations

import random
import shutil
import sqlite3
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from piga.ledger.store.transfer import export_records, verify
from tests.ledger.store.drafts import filled

TABLES = ("piga_store", "piga_entry", "piga_blob", "piga_chunk", "piga_head", "piga_schema_version")


def everything(path: Path) -> object:
    """All rows of all tables; the header and the words of the schema hold no evidence."""
    connection = sqlite3.connect(path)
    try:
        return [sorted(connection.execute(f"SELECT * FROM {table}").fetchall(), key=repr) for table in TABLES]
    finally:
        connection.close()


def flip(raw: bytes, chance: random.Random) -> bytes:
    at = chance.randrange(len(raw))
    return raw[:at] + bytes([raw[at] ^ chance.randrange(1, 256)]) + raw[at + 1 :]


def cut(raw: bytes, chance: random.Random) -> bytes:
    return raw[: chance.randrange(len(raw))]


def tamper(path: Path, change: Callable[[sqlite3.Connection], None]) -> None:
    """Change rows as someone would who has the file."""
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA synchronous=OFF")
    connection.execute("PRAGMA journal_mode=MEMORY")
    try:
        change(connection)
    finally:
        connection.commit()
        connection.close()


def _changed(value: object, chance: random.Random) -> object:
    if isinstance(value, int):
        return value + chance.choice((-1, 1, 1000))
    if isinstance(value, bytes):
        return flip(value, chance) if value else b"x"
    assert isinstance(value, str)
    at = chance.randrange(len(value))
    return value[:at] + chance.choice("0123456789abcdefXYZ") + value[at + 1 :]


def row_change(chance: random.Random) -> tuple[str, Callable[[sqlite3.Connection], None]]:
    """A random edit, swap, deletion or addition of rows."""
    kind = chance.choice(("edit", "swap", "delete", "copy"))
    table = chance.choice(TABLES)

    def change(connection: sqlite3.Connection) -> None:
        columns = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
        rows = connection.execute(f"SELECT rowid, * FROM {table}").fetchall()
        first, second = chance.choice(rows), chance.choice(rows)
        column = chance.randrange(len(columns))
        name = columns[column]
        if kind == "edit":
            value = _changed(first[column + 1], chance)
            connection.execute(f"UPDATE {table} SET {name} = ? WHERE rowid = ?", (value, first[0]))
        elif kind == "swap":
            for one, other in ((first, second), (second, first)):
                connection.execute(
                    f"UPDATE {table} SET {name} = ? WHERE rowid = ?", (other[column + 1], one[0])
                )
        elif kind == "delete":
            connection.execute(f"DELETE FROM {table} WHERE rowid = ?", (first[0],))
        else:
            marks = ", ".join("?" * len(columns))
            copied = [_changed(value, chance) for value in first[1:]]
            connection.execute(f"INSERT INTO {table} VALUES ({marks})", copied)

    return kind, change


def mutate_store_bytes(folder: Path, count: int, seed: int) -> Counter[str]:
    """Change bytes until ``count`` changes were found; those that change nothing that can be read are counted too."""
    filled(folder / "a.sqlite", 3, size=20_000).close()
    raw, whole = (folder / "a.sqlite").read_bytes(), everything(folder / "a.sqlite")
    chance, result, work = random.Random(seed), Counter[str](), folder / "work"
    while result["noticed"] < count:
        work.mkdir()
        path = work / "m.sqlite"
        path.write_bytes(cut(raw, chance) if chance.random() < 0.1 else flip(raw, chance))
        sound = verify(path).sound
        result["no content" if sound and everything(path) == whole else "missed" if sound else "noticed"] += 1
        shutil.rmtree(work)
    return result


def mutate_store_rows(folder: Path, count: int, seed: int) -> Counter[str]:
    filled(folder / "a.sqlite", 4).close()
    whole, chance, result = everything(folder / "a.sqlite"), random.Random(seed), Counter[str]()
    path = folder / "m.sqlite"
    while sum(result.values()) < count:
        shutil.copy(folder / "a.sqlite", path)
        kind, change = row_change(chance)
        try:
            tamper(path, change)
        except sqlite3.IntegrityError:
            continue
        if everything(path) == whole:
            continue
        result["missed" if verify(path).sound else kind] += 1
    return result


def mutate_export(folder: Path, count: int, seed: int) -> Counter[str]:
    with filled(folder / "a.sqlite", 3) as store:
        export_records(store, folder / "a.zip")
    raw, chance, result = (folder / "a.zip").read_bytes(), random.Random(seed), Counter[str]()
    path, whole = folder / "m.zip", members(folder / "a.zip")
    for index in range(count):
        if index % 5 == 0:
            path.write_bytes(cut(raw, chance))
        elif index % 5 == 1:
            kept = _member_changed(folder / "a.zip", path, chance)
            if not kept:
                continue
        else:
            path.write_bytes(flip(raw, chance))
        sound = verify(path).sound
        result["no content" if sound and members(path) == whole else "missed" if sound else "noticed"] += 1
    return result


def members(path: Path) -> dict[str, bytes]:
    """Everything that an export holds."""
    with zipfile.ZipFile(path) as export:
        return {name: export.read(name) for name in export.namelist()}


def _member_changed(source: Path, target: Path, chance: random.Random) -> bool:
    """An export made anew with a member edited, dropped, or two swapped; sums as they were."""
    changed = members(source)
    name, other = chance.choice(list(changed)), chance.choice(list(changed))
    kind = chance.choice(("edit", "drop", "swap"))
    if kind == "edit":
        changed[name] = flip(changed[name], chance)
    elif kind == "drop":
        del changed[name]
    elif changed[name] == changed[other]:
        return False
    else:
        changed[name], changed[other] = changed[other], changed[name]
    with zipfile.ZipFile(target, "w") as export:
        for key, value in changed.items():
            export.writestr(key, value)
    return True


CAMPAIGNS = {"bytes": mutate_store_bytes, "rows": mutate_store_rows, "export": mutate_export}


@pytest.mark.parametrize(("name", "count"), [("bytes", 80), ("rows", 60), ("export", 250)])
def test_no_change_is_missed(memory_path: Path, name: str, count: int) -> None:
    """Of 10 500 changes once made with other counts none was missed."""
    result = CAMPAIGNS[name](memory_path, count, 2)
    assert result["missed"] == 0, result
