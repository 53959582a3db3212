"""The ledger at 1e3, 1e4 and 1e5 records: processor time and memory of each command.

Run: ``python -m benchmarks.records [--record] [COUNT ...]``.

One instrument has up to 3000 records, the rest belong to others, a hundred each. Each record holds a run file and a
calibration of 5 kB (that of the instrument: 30 kB, as large as a real one). Every command runs in a process of its own.
"""

from __future__ import annotations

import datetime as dt
import json
import random
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks import measured as figures

import piga
from piga.data import copy_example
from piga.ledger.store import Draft, DraftFile, open_store
from piga.ledger.store.documents import IDENTITY, Identity, Position, decode, encode, new_id
from piga.records.calibration.document import to_document

MOST = 3000
CHILD = """
import sys
from pathlib import Path
from piga.cli.main import main
try:
    main()
except SystemExit as done:
    if done.code:
        raise
peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
print(peak.split()[1], file=sys.stderr)
"""
"""A command, and the largest resident memory of its process as Linux counts it."""
COMMANDS = ("list --serial A", "show 7", "trend --serial A", "list", "verify", "export")


def documents(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """The shipped calibration as a document, whole and without segments, diagnostics and budget."""
    whole = to_document(piga.calibrate(piga.read_run(copy_example(folder))))
    small = {
        key: value
        for key, value in whole.items()
        if key not in ("segments", "uncertainty_budget", "diagnostics")
    }
    return json.loads(json.dumps(whole)), json.loads(json.dumps(small))


def varied(document: dict[str, Any], serial: str, chance: random.Random) -> bytes:
    """The document of another day."""
    coefficients = [
        c | {"value": c["value"] + chance.gauss(0.0, 1.0) * c["std"]} for c in document["coefficients"]
    ]
    for c in coefficients:
        c.pop("interval", None)
    instrument = document["instrument"] | {"serial": serial}
    return json.dumps(document | {"coefficients": coefficients, "instrument": instrument}, indent=1).encode()


def fill(path: Path, count: int, whole: dict[str, Any], small: dict[str, Any]) -> None:
    """A store with ``count`` records, in transactions of a thousand."""
    chance = random.Random(1)
    with open_store(path, create=True) as store:
        for start in range(0, count, 1000):
            with store.database.writing() as rows:
                identity = decode(rows.identity(), Identity, IDENTITY, "identity")
                for number in range(start, min(start + 1000, count)):
                    own = number < MOST
                    serial = "A" if own else f"B-{number // 100}"
                    raw = varied(whole if own else small, serial, chance)
                    day = dt.date(2000, 1, 1) + dt.timedelta(days=number % MOST)
                    head = rows.head()
                    place = Position(new_id(), head.number + 1, identity.store, head.sha256)
                    files = (
                        DraftFile("run", "run.toml", b"# run\n"),
                        DraftFile("calibration", "results/c.json", raw),
                    )
                    made = Draft(serial, "A. Meyer", f"number {number}", files, {}, {}, str(day))
                    store.insert(rows, encode(store._document(rows, place, made)))


def children() -> float:
    """Processor time of the child processes so far [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def measured(command: str, store: Path, folder: Path) -> tuple[float, float]:
    """Processor time [s] and largest resident memory [MB] of a command."""
    words = command.split()
    if words[0] == "export":
        words.insert(1, str(folder / f"{time.monotonic_ns()}.zip"))
    start = children()
    done = subprocess.run(
        [sys.executable, "-c", CHILD, "records", *words, "--store", str(store)],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=True,
    )  # fmt: skip
    return children() - start, int(done.stderr.split()[-1]) / 1024.0


def main() -> None:
    counts = [int(word) for word in sys.argv[1:] if word != "--record"] or [1000, 10_000, 100_000]
    kept: dict[str, float] = {}
    with tempfile.TemporaryDirectory(dir=".") as name:
        folder = Path(name)
        whole, small = documents(folder)
        for count in counts:
            store = folder / f"{count}.sqlite"
            start = time.process_time()
            fill(store, count, whole, small)
            filled = time.process_time() - start
            print(f"\n{count} records, {store.stat().st_size / 1e6:.0f} MB, filled in {filled:.0f} s")
            measured("trend --serial A", store, folder)  # compiled kernels are kept from here on
            for command in COMMANDS:
                seconds, memory = measured(command, store, folder)
                kept |= {
                    f"{command}, {count}: time": round(seconds, 1),
                    f"{command}, {count}: memory": round(memory),
                }
                print(f"  records {command:<18} {seconds:7.2f} s {memory:6.0f} MB", flush=True)
    if "--record" in sys.argv:
        known = {figure["name"] for figure in figures.load("ledger")[1]}
        figures.record("ledger", {name: value for name, value in kept.items() if name in known})


if __name__ == "__main__":
    main()
