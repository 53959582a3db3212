"""A station that writes to the lab's PostgreSQL store, and says which records it was told are safe."""

from __future__ import annotations

from multiprocessing.connection import Connection
from multiprocessing.synchronize import Barrier

from piga.ledger.store import open_store
from tests.ledger.store.drafts import add


def station(url: str, name: str, count: int, pipe: Connection, together: Barrier | None = None) -> None:
    """Write ``count`` records; each when all stations are ready for theirs, where they write ``together``."""
    with open_store(url, create=True) as store:
        for index in range(count):
            if together is not None:
                together.wait(60.0)
            pipe.send(add(store, f"{name}-{index}", size=3000))
    pipe.close()
