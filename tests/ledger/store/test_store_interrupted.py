"""``kill -9`` at random moments: what was acknowledged is there, and the store is sound.

A journal may stay beside a store: SQLite rolls it back when the store is read, or writes over it.
"""

from __future__ import annotations

import multiprocessing
import os
import random
import time
from pathlib import Path

import pytest

from piga.ledger.store import open_store
from piga.ledger.store.transfer import export_records, import_records, verify
from tests.ledger.store import drafts
from tests.ledger.store.drafts import filled


def importer(store: str, export: str, pipe: multiprocessing.connection.Connection) -> None:
    """A process that makes a store by an import of many records."""
    pipe.send("ready")
    with open_store(store, create=True) as opened:
        pipe.send(import_records(opened, Path(export), "A. Meyer", "merge"))


def kill_some(folder: Path, kills: int, seed: int) -> int:
    """Kill workers that make a store and fill it; returns how many records were acknowledged. Any loss fails at once."""
    context, chance, seen = multiprocessing.get_context("forkserver"), random.Random(seed), 0
    context.set_forkserver_preload([drafts.__name__])
    with filled(folder / "other.sqlite", 30, size=2000) as other:
        export_records(other, folder / "other.zip")
    for number in range(kills):
        path = folder / f"{number}.sqlite"
        mine, pipe = context.Pipe(duplex=False)
        if number % 3:
            process = context.Process(target=drafts.station, args=(str(path), "s", 1000, pipe))
        else:
            process = context.Process(target=importer, args=(str(path), str(folder / "other.zip"), pipe))
        process.start()
        pipe.close()
        assert mine.poll(60), "the worker did not start"
        time.sleep(chance.uniform(0.0, 0.2))
        process.kill()
        process.join()
        acknowledged: set[str] = set()
        try:
            while mine.poll():
                names = mine.recv()
                acknowledged |= set(names if isinstance(names, list) else [names]) - {"ready"}
        except (EOFError, OSError):
            pass
        with open_store(path, create=True) as store:
            there = {record.id for record in store.records()}
        assert acknowledged <= there, f"lost: {acknowledged - there}"
        assert number % 3 or len(there) in (0, 30), "an import is whole or nothing"
        assert verify(path).sound
        seen += len(acknowledged)
        for left in folder.glob(f"{number}.sqlite*"):
            left.unlink()
    return seen


@pytest.mark.skipif(os.name == "nt", reason="kill -9 is POSIX")
@pytest.mark.parametrize(
    "kills", [pytest.param(9, marks=pytest.mark.long), pytest.param(1000, marks=pytest.mark.slow)]
)
def test_kills(memory_path: Path, kills: int) -> None:
    assert kill_some(memory_path, kills, seed=5) > kills
