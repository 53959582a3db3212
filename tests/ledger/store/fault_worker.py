"""Runs under the fault shim: each operation with its first, second, third ... call failing, until none fails.

Started by ``test_store_interrupted.py`` as ``python -m tests.ledger.store.fault_worker FOLDER STEP``; prints one JSON document.
Step 1 tries every kind of failure, a larger step one kind for each operation.
"""

from __future__ import annotations

import ctypes
import errno
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

from piga.errors import StoreError
from piga.ledger.reproduce import source_digest
from piga.ledger.store import open_store
from piga.ledger.store.transfer import backup, export_records, import_records, restore, verify
from tests.ledger.store.drafts import add, filled

SHIM = ctypes.CDLL(None)
KINDS = {
    "EIO once": (errno.EIO, 0, 0),
    "ENOSPC from then on": (errno.ENOSPC, 1, 0),
    "EROFS from then on": (errno.EROFS, 1, 0),
    "EINTR once": (errno.EINTR, 0, 0),
    "short write": (0, 0, 1),
}
ALLOWED = {"a.sqlite", "o.sqlite", "all.zip", "new.sqlite", "new.zip"}


def prepare(folder: Path) -> None:
    with filled(folder / "a.sqlite", 2) as store:
        add(store, "large", size=300_000)
    with filled(folder / "o.sqlite", 2) as other:
        export_records(other, folder / "all.zip")


def append(folder: Path) -> None:
    with open_store(folder / "a.sqlite") as store:
        add(store, "more", size=20_000)


def take_over(folder: Path) -> None:
    with open_store(folder / "a.sqlite") as store:
        import_records(store, folder / "all.zip", "A", "merge")


def make_new(folder: Path) -> None:
    open_store(folder / "new.sqlite", create=True).close()


def export(folder: Path) -> None:
    with open_store(folder / "a.sqlite") as store:
        export_records(store, folder / "new.zip")


def copy(folder: Path) -> None:
    with open_store(folder / "a.sqlite") as store:
        backup(store, folder / "new.sqlite")


def make_again(folder: Path) -> None:
    restore(folder / "all.zip", folder / "new.sqlite")


OPERATIONS: dict[str, Callable[[Path], None]] = {
    "append": append,
    "import": take_over,
    "create": make_new,
    "export": export,
    "backup": copy,
    "restore": make_again,
}


def loop(source: Path, work: Path, name: str, kind: str, step: int) -> dict[str, int]:
    """Fail call 1, 1 + step, ... of one operation; check after each that the old or the new state is there."""
    error, stays, short = KINDS[kind]
    old = verify(source / "a.sqlite").head
    points = refused = 0
    for n in range(1, 100_000, step):
        shutil.rmtree(work, ignore_errors=True)
        shutil.copytree(source, work)
        done = False
        SHIM.fault_arm(ctypes.c_long(n), error, stays, short)
        try:
            OPERATIONS[name](work)
            done = True
        except StoreError:
            refused += 1
        finally:
            counted = SHIM.fault_disarm()
        points += counted >= n
        check(work, name, done, old)
        if counted < n:
            return {"points": points, "refused": refused}
    raise AssertionError("the operation never ends")


def check(work: Path, name: str, done: bool, old: str) -> None:
    verification = verify(work / "a.sqlite")
    assert verification.sound, verification.problems
    if name in ("append", "import"):
        assert verification.records in ((5,) if done and name == "import" else (4,) if done else (3, 4, 5)), (
            verification
        )
        assert done or verification.records == 3 or verify(work / "a.sqlite", [old]).sound
    else:
        assert verification.head == old
    made = work / ("new.zip" if name == "export" else "new.sqlite")
    if name in ("create", "export", "backup", "restore"):
        assert made.exists() or not done
        assert not made.exists() or verify(made).sound
        if not made.exists():
            OPERATIONS[name](work)
        elif made.suffix == ".sqlite":
            open_store(made).close()
    orphans = {path.name for path in work.iterdir()} - ALLOWED
    assert not orphans or name == "export", orphans
    if orphans:
        made.unlink(missing_ok=True)
        export(work)
        assert {path.name for path in work.iterdir()} <= ALLOWED


def main() -> None:
    folder, step = Path(sys.argv[1]), int(sys.argv[2])
    source, work = folder / "source", folder / "work"
    source.mkdir()
    prepare(source)
    source_digest()
    OPERATIONS["append"](shutil.copytree(source, folder / "warm"))
    values = {}
    for number, name in enumerate(OPERATIONS):
        kinds = list(KINDS) if step == 1 else [list(KINDS)[number % len(KINDS)]]
        for kind in kinds:
            values[f"{name}, {kind}"] = loop(source, work, name, kind, step)
    json.dump(values, sys.stdout)


if __name__ == "__main__":
    main()
