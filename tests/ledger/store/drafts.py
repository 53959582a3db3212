"""Small records for the store's tests: quick to make, each with its own bytes; and a station that writes them."""

from __future__ import annotations

import hashlib
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Barrier
from pathlib import Path

from piga.ledger.store import Draft, DraftFile, open_store
from piga.ledger.store.store import Store


def content(key: str, size: int) -> bytes:
    """Bytes that follow from ``key``: half noise, half text that packs well."""
    noise = hashlib.shake_256(key.encode()).digest(size // 2)
    return noise + (f"{key},0.125;" * size).encode()[: size - size // 2]


def draft(key: str = "a", *, serial: str = "T-1", size: int = 400, **options: str) -> Draft:
    files = (
        DraftFile("run", "run.toml", f"# {key}\n".encode()),
        DraftFile("data", "data/run.csv", content(key, size)),
        DraftFile("report", "results/report.html", f"<p>{key}</p>".encode()),
    )
    return Draft(
        serial, "A. Meyer", f"reason {key}", files, {"method": "information"}, {"piga": "0.1.0"}, **options
    )


def add(store: Store, key: str = "a", **options: object) -> str:
    return store.append(draft(key, **options)).id  # type: ignore[arg-type]


def filled(path: Path, count: int = 3, **options: object) -> Store:
    """A new store with ``count`` records."""
    store = open_store(path, create=True)
    for index in range(count):
        add(store, f"{path.name}-{index}", **options)
    return store


def station(url: str, name: str, count: int, pipe: Connection, together: Barrier | None = None) -> None:
    """A process that writes ``count`` records and says which are safe; where ``together``, each when all are ready."""
    with open_store(url, create=True) as store:
        for index in range(count):
            if together is not None:
                together.wait(60.0)
            pipe.send(add(store, f"{name}-{index}", size=3000))
    pipe.close()
