"""What the kill campaign kills: a process that adds, imports, exports or creates without end and says what is done.

Every acknowledgement is sent after the call has returned; the parent counts on nothing else.
"""

from __future__ import annotations

from multiprocessing.connection import Connection
from pathlib import Path

from piga.ledger.store import open_store
from piga.ledger.store.transfer import export_records, import_records
from tests.ledger.store.drafts import add


def work(operation: str, folder: Path, pipe: Connection, round_number: int) -> None:
    """Do one operation again and again until killed."""
    exports = sorted((folder.parent / "exports").iterdir())
    pipe.send("ready")
    for index in range(1_000_000):
        key = f"{round_number}-{index}"
        if operation == "add":
            with open_store(folder / "a.sqlite") as store:
                pipe.send([add(store, key, size=30_000)])
        elif operation == "import":
            with open_store(folder / "a.sqlite") as store:
                source = exports[(round_number + index) % len(exports)]
                pipe.send(import_records(store, source, "A. Meyer", f"import {key}"))
        elif operation == "export":
            with open_store(folder / "a.sqlite") as store:
                export_records(store, folder / "all.zip", replace=True)
            pipe.send([])
        else:
            open_store(folder / f"new-{index % 5}.sqlite", create=True).close()
            pipe.send([])
