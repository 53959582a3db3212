"""``kill -9`` at random moments: the old or the new state is there, nothing is lost.

A journal may stay beside a store: SQLite rolls it back when the store is read, or writes over it.
"""

from __future__ import annotations

import multiprocessing
import os
import random
import time
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from piga.ledger.store import open_store
from piga.ledger.store.transfer import export_records, verify
from tests.ledger.store import kill_worker
from tests.ledger.store.drafts import filled

OPERATIONS = ("add", "import", "export", "create")


EXPECTED = {"a.sqlite", "all.zip", *(f"new-{k}.sqlite" for k in range(5))}


AFRESH = 20
"""Rounds after which a new store is begun: a small one is quickly verified."""


def campaign(folder: Path, kills: int, seed: int) -> Counter[str]:
    """Kill ``kills`` workers; returns what happened. Any loss, damage or orphan fails at once."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([kill_worker.__name__])
    chance, result = random.Random(seed), Counter[str]()
    _prepare(folder, exports=min(40, 3 + kills // 20))
    acknowledged: set[str] = set()
    for number in range(kills):
        place = folder / f"place-{number // AFRESH}"
        if number % AFRESH == 0:
            place.mkdir()
            filled(place / "a.sqlite", 2).close()
            with open_store(place / "a.sqlite") as store:
                acknowledged = {record.id for record in store.records()}
        operation = OPERATIONS[number % len(OPERATIONS)]
        mine, other = context.Pipe(duplex=False)
        process = context.Process(target=kill_worker.work, args=(operation, place, other, number))
        process.start()
        other.close()
        acknowledged |= _killed(process, mine, chance, result)
        result["journals or parts left by the kill"] += any(_left(place))
        _check(place, operation, acknowledged)
        result[operation] += 1
    return result


def _prepare(folder: Path, exports: int) -> None:
    (folder / "exports").mkdir()
    with filled(folder / "other.sqlite", 3 * exports, size=2000) as other:
        records = [record.id for record in other.records()]
        for index in range(exports):
            export_records(other, folder / "exports" / f"{index}.zip", records[3 * index : 3 * index + 3])


def _killed(
    process: multiprocessing.Process, pipe: Connection, chance: random.Random, result: Counter[str]
) -> set[str]:
    """Let the worker start, kill it after a random time, and collect what it acknowledged."""
    assert pipe.poll(60), "the worker did not start"
    assert pipe.recv() == "ready"
    time.sleep(chance.uniform(0.0, 0.2))
    process.kill()
    process.join()
    names: set[str] = set()
    try:
        while pipe.poll():
            names |= set(pipe.recv())
            result["acknowledgements"] += 1
    except (EOFError, OSError):
        pass
    pipe.close()
    return names


def _left(place: Path) -> list[str]:
    return [path.name for path in place.iterdir() if path.name.removesuffix("-journal") not in EXPECTED]


def _check(place: Path, operation: str, acknowledged: set[str]) -> None:
    """Recover as the next user would, then look."""
    with open_store(place / "a.sqlite") as store:
        there = {record.id for record in store.records()}
        if operation == "export":
            export_records(store, place / "all.zip", replace=True)
    assert acknowledged <= there, f"lost: {acknowledged - there}"
    for name in ("a.sqlite", "all.zip"):
        verification = verify(place / name)
        assert verification.sound or not (place / name).exists(), verification.problems
    if operation == "create":
        for index in range(5):
            open_store(place / f"new-{index}.sqlite", create=True).close()
            assert verify(place / f"new-{index}.sqlite").sound
    assert not _left(place), _left(place)


@pytest.mark.skipif(os.name == "nt", reason="kill -9 is POSIX")
@pytest.mark.long
def test_some_kills(memory_path: Path) -> None:
    figures = campaign(memory_path, 12, seed=5)
    assert figures["add"] == 3


@pytest.mark.skipif(os.name == "nt", reason="kill -9 is POSIX")
@pytest.mark.slow
def test_thousand_kills(tmp_path: Path) -> None:
    figures = campaign(tmp_path, 1000, seed=int(time.time()))
    print(dict(figures))
    assert sum(figures[operation] for operation in OPERATIONS) == 1000
