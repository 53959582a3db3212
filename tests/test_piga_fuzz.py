"""Mutated files and streams at the doors that take records of others: used, or refused in words; nothing else.

The default run is 200 cases a door and ten imports; ``PIGA_FUZZ=500`` makes it 100 000 each.
"""

from __future__ import annotations

import io
import os
import random
import warnings
from pathlib import Path

import numpy as np
import pytest

import piga
from piga.compensation.compensator import compensate_lines
from piga.compensation.model import make_model
from piga.records.calibration.document import calibration_from_bytes, calibration_to_bytes
from tests.certificate.certificate_data import budgeted, complete
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of
from tests.formats.test_formats_fuzz import SCALE, mutated, outcome, seeded
from tests.reports.example import calibration

CASES = 200 * SCALE
IMPORTS = CASES if SCALE > 1 else 10
"""An import takes some 20 ms of processor time: few in the default run, all cases in a campaign."""
IMPORT_SEED = int(os.environ.get("PIGA_FUZZ_SEED", "25"))
"""Another seed continues a campaign of imports."""
TOKENS = [b"-", b"0", b"1e308", b"1e-320", b"null", b"true", b"[]", b"{}", b'""', b'"phi"', b"9" * 30, b"\\u0000",
          b"scale_factor", b'"run": "b", ', b"per-segment", b"NaN", b"e99", b".", b",", b"\xff"]  # fmt: skip


def altered(source: bytes, draw: random.Random) -> bytes:
    """Bytes changed, or a token put over or between others."""
    if draw.random() < 0.5:
        return mutated(source, draw)
    at, token = draw.randrange(len(source)), draw.choice(TOKENS)
    return source[:at] + token + source[at + draw.choice((0, 1, len(token))) :]


def test_calibrations() -> None:
    """What is read is also what compensation can use."""
    draw = seeded(21)
    source = calibration_to_bytes(budgeted(calibration(with_residuals=False)))

    def use(raw: bytes) -> None:
        read = calibration_from_bytes(raw, Path("calibration.json"))
        assert np.linalg.eigvalsh(read.covariance / np.abs(read.covariance).max()).min() > -1e-6
        make_model(read)

    with np.errstate(all="ignore"):
        kept = sum(outcome(lambda: use(altered(source, draw))) for _ in range(CASES))
    assert 0 < kept < CASES


def test_live_streams() -> None:
    draw = seeded(23)
    rows = [[0.01 * i, 0.1 * i, 9.8, 1.0, 0.0] for i in range(4)]
    source = "\n".join(["t,output,fx,fy,fz", *(",".join(map(repr, row)) for row in rows), ""]).encode()
    cal = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.3}, {"scale_factor": 1e-6})

    def work(raw: bytes) -> None:
        stream = io.TextIOWrapper(io.BytesIO(raw), "utf-8-sig", errors="replace")
        compensate_lines(stream, io.StringIO(), piga.Compensator(cal))

    with np.errstate(all="ignore"):
        for _ in range(CASES):
            cut = altered(source, draw)
            case = cut[: draw.randrange(len(cut) + 1)] if draw.random() < 0.2 else cut
            outcome(lambda case=case: work(case))


def test_certificates() -> None:
    etree = pytest.importorskip("lxml.etree")
    from piga.certificate.dcc import calibration_of as calibration_in
    from piga.certificate.dcc import dcc_document, parse_xml

    draw = seeded(24)
    cal = budgeted(calibration(serial="G-0417", with_residuals=False))
    source = etree.tostring(dcc_document(complete(), cal))
    path = Path("certificate.xml")
    for _ in range(CASES):
        case = altered(source, draw)
        outcome(lambda case=case: calibration_in(parse_xml(case, path), path))


def test_imports(tmp_path: Path) -> None:
    """Exports of which members were changed, with sums that fit, so that more than the sums is tried."""
    pytest.importorskip("sqlalchemy")
    import hashlib
    import zipfile

    from piga.ledger.store import open_store
    from piga.ledger.store.transfer import import_records

    draw = seeded(IMPORT_SEED)
    source = Path(__file__).parent / "ledger" / "store" / "corpus" / "0.1.0" / "export.zip"
    with zipfile.ZipFile(source) as export:
        members = {name: export.read(name) for name in export.namelist() if not name.endswith("SUMS")}
    small = [name for name in members if len(members[name]) < 20_000]
    target = tmp_path / "export.zip"

    def put() -> None:
        changed = dict(members)
        name = draw.choice(small)
        data = altered(changed.pop(name), draw)
        renamed = draw.random() < 0.8 and name.startswith("files/")
        changed[f"files/{hashlib.sha256(data).hexdigest()}" if renamed else name] = data
        sums = {n: hashlib.sha256(data).hexdigest() for n, data in changed.items()}
        changed["SHA256SUMS"] = "".join(f"{sums[n]}  {n}\n" for n in sorted(sums)).encode()
        with zipfile.ZipFile(target, "w") as out:
            for n, data in changed.items():
                out.writestr(n, data)

    empty, lab = tmp_path / "empty.sqlite", tmp_path / "lab.sqlite"
    open_store(empty, create=True).close()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(IMPORTS):
            put()
            lab.write_bytes(empty.read_bytes())
            with open_store(lab) as store:
                outcome(lambda store=store: import_records(store, target, "A", "B"))
