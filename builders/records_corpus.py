"""Write the old-record corpus of this version: a folder named by it in ``tests/ledger/store/corpus``.

It holds a store, its export, and what they hold.

Run once for each release, on a tree of that release; what was written is kept for ever and never written again:

    PYTHONPATH=src:. python builders/records_corpus.py
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from pathlib import Path

import numpy as np

import piga
from piga.ledger import prepare_run
from piga.ledger.store import Draft, DraftFile, encode, sha256
from piga.ledger.store.transfer import export_records, import_records

CORPUS = Path(__file__).parent.parent / "tests" / "ledger" / "store" / "corpus"

RUN = """\
[instrument]
serial = "CORPUS-1"
scale_factor = "0.8884 rad/s/g"
counts_per_revolution = 72000

[data]
file = "{file}"
time = {{ column = "t", unit = "s" }}
output = {{ column = "n", kind = "counts" }}
reference = {{ columns = ["fx", "fy", "fz"], unit = "g" }}
segment = "seg"

[model]
terms = ["scale_factor", "k0"]
"""


def write_run(folder: Path, seed: int) -> Path:
    """Four positions of a made-up instrument, with counts that jitter."""
    chance = np.random.default_rng(seed)
    rows = ["t,n,fx,fy,fz,seg"]
    for position, force in enumerate((1.0, 0.5, -0.5, -1.0)):
        for k in range(120):
            t = 20.0 * position + k / 20.0
            count = round(10180.3 * (force + 2e-3) * k / 20.0 + chance.normal(0.0, 0.7)) + 100_000 * position
            rows.append(f"{t:.4f},{count},{force},0.0,0.0,{position}")
    (folder / f"run-{seed}.csv").write_text("\n".join(rows) + "\n", newline="\n")
    path = folder / f"run-{seed}.toml"
    path.write_text(RUN.format(file=f"run-{seed}.csv"), newline="\n")
    return path


def build(folder: Path) -> None:
    """A calibration, its amendment, a large file, and a record taken over from another store."""
    with piga.open_store("other.sqlite", create=True) as other:
        other.append(prepare_run(write_run(Path(), 3), "C. Wang 王", "another bench", report=False))
        export_records(other, Path("other.zip"))
    with piga.open_store(folder / "store.sqlite", create=True) as store:
        made = prepare_run(write_run(Path(), 1), "A. Meyer", "first", measured="2026-11-20", report=False)
        first = store.append(made)
        write_run(Path(), 2).write_text(
            RUN.format(file="run-2.csv") + '[estimation]\nmethod = "rate"\n', newline="\n"
        )
        store.append(
            prepare_run(
                Path("run-2.toml"), "B. Kühn", "the table was not level", measured="2026-11-20T10:00:00+01:00",
                supersedes=first.id, report=False,
            )
        )  # fmt: skip
        large = b"".join(f"{k % 500},0.125\n".encode() for k in range(150_000))
        files = (
            DraftFile("data", "log/large.csv", large),
            DraftFile("report", "results/report.html", b"<p>made by hand</p>\n"),
        )
        store.append(Draft("CORPUS-2", "A. Meyer", "a file in more than one part", files))
        import_records(store, Path("other.zip"), "A. Meyer", "benches joined")
        export_records(store, folder / "export.zip")
        (folder / "expected.json").write_text(json.dumps(expected(store), indent=1, ensure_ascii=False) + "\n")


def expected(store: piga.ledger.store.store.Store) -> dict[str, object]:
    """What must be read for ever."""
    records = []
    for record in store.records():
        entry: dict[str, object] = {
            "number": record.number,
            "id": record.id,
            "head": record.head,
            "serial": record.document.serial,
            "operator": record.document.operator,
            "document_sha256": sha256(encode(record.document)),
            "files": {file.name: file.sha256 for file in record.document.files},
            "measured": record.measured.isoformat(),
        }
        if record.file("calibration"):
            coefficients = store.calibration(record.id).coefficients
            entry["coefficients"] = {c.key: [c.value, c.std, c.unit] for c in coefficients}
        records.append(entry)
    history = {serial: [name for name, _, _ in store.history(serial)] for serial in ("CORPUS-1", "CORPUS-2")}
    return {"head": store.head().sha256, "records": records, "history": history}


def main() -> None:
    folder = CORPUS / piga.__version__
    if folder.exists():
        sys.exit(f"{folder.name} is there already: a corpus is never written again")
    folder.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as work:
        os.chdir(work)
        build(folder)
    for path in sorted(folder.iterdir()):
        print(f"{path.stat().st_size:9d} {path.name}")


if __name__ == "__main__":
    main()
