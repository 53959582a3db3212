"""A station that writes to the lab's PostgreSQL store, and says which records it was told are safe."""

from __future__ import annotations

from multiprocessing.connection import Connection

from piga.records.store import open_store
from tests.records.store.drafts import add


def station(url: str, name: str, count: int, pipe: Connection) -> None:
    with open_store(url, create=True) as store:
        for index in range(count):
            pipe.send(add(store, f"{name}-{index}", size=3000))
    pipe.close()
