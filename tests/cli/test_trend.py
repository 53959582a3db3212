"""``piga records trend`` as a user runs it."""

from __future__ import annotations

import datetime as dt
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from piga.cli.trend import history as records_of
from piga.cli.trend import trend
from piga.errors import PigaError
from piga.records.calibration.document import calibration_to_bytes
from tests.cli.test_cli_commands import piga
from tests.trend.history import history


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("history")
    rng = np.random.default_rng(1)
    for name, time, calibration in history(np.arange(6) / 2, 1e-3 + rng.normal(0, 1e-6, 6), 1e-6):
        (path / name).mkdir()
        stamp = time.astimezone(dt.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        used = replace(calibration, provenance=replace(calibration.provenance, created=stamp))
        used.to_json(path / name / "calibration.json")
    return path


@pytest.mark.long
def test_directories_and_files(folder, tmp_path):
    done = piga(
        "records", "trend", folder, "--at", "2024-01-01", "--common", "0.5", "--out", tmp_path, "--json"
    )
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["serial"] == "G-0417"
    assert len(document["coefficients"][0]["records"]) == 6
    assert json.loads((tmp_path / "trend.json").read_text()) == document
    files = [folder / f"r{i}" / "calibration.json" for i in range(6)]
    again = piga("records", "trend", *files, "--at", "2024-01-01", "--common", "x=0.5", "--json")
    assert (
        json.loads(again.stdout)["coefficients"][0]["drift_per_year"]
        == document["coefficients"][0]["drift_per_year"]
    )


def test_a_trend_loads_no_estimator(folder):
    """An instrument of thousands of records has its trend in seconds; the estimator alone takes a tenth of them."""
    script = (
        "import sys; from piga.cli.trend import trend\n"
        "from pathlib import Path; trend([Path(sys.argv[1])])\n"
        "loaded = sorted(name for name in sys.modules if name.startswith(('piga.calibration', 'piga.stand', 'piga.trend')))\n"
        "print(loaded, file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(folder)], capture_output=True, text=True, check=True
    )
    loaded = done.stderr.splitlines()[-1]
    assert "piga.trend.trend_line" in loaded
    for heavy in ("piga.calibration.calibrate", "piga.calibration.model", "piga.calibration.fit", "piga.stand"):
        assert heavy not in loaded, loaded


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sources": []}, "no records are named"),
        ({"sources": [], "store": "x.sqlite"}, "--serial"),
        ({"at": "soon"}, "not a date"),
        ({"common": ["much"]}, "is not a number"),
        ({"common": ["0.5", "timing=0"]}, "drop the plain number"),
        ({"common": ["7"]}, "not between 0 and 1"),
        ({"serial": "other"}, "at least two records"),
        ({"sources": ["empty"]}, "holds no calibration"),
        ({"sources": ["r0/calibration.json", "r0/none.json"]}, "cannot be read"),
    ],
)
def test_wrong_use_in_words(folder, options, words):
    (folder / "empty").mkdir(exist_ok=True)
    used = {"sources": ["."], "store": None, "serial": None, "at": None, "common": None, "out": None} | options
    used["sources"] = [folder / name for name in used["sources"]]
    with pytest.raises(PigaError, match=words):
        trend(**used, as_json=True)


@pytest.mark.long
def test_records_of_a_store(tmp_path):
    pytest.importorskip("sqlalchemy")
    from piga.ledger.store import Draft, DraftFile, open_store

    path = tmp_path / "lab.sqlite"
    with open_store(path, create=True) as store:
        for i, (_, time, calibration) in enumerate(history(np.arange(4) / 2, 1e-3 + 1e-6 * np.arange(4), 1e-6)):
            file = DraftFile("calibration", "results/calibration.json", calibration_to_bytes(calibration))
            made = Draft(
                "G-0417", "A", f"test {i}", (file,), {}, {"piga": "0"}, measured=f"{time:%Y-%m-%dT%H:%M:%SZ}"
            )
            store.append(lambda _place, made=made: made)
    entries = list(records_of([], str(path), "G-0417"))
    assert len(entries) == 4
    done = piga("records", "trend", "--store", path, "--serial", "G-0417", "--json")
    assert done.returncode == 0, done.stderr
    (trend_of_k0,) = json.loads(done.stdout)["coefficients"]
    assert trend_of_k0["drift_per_year"]["value"] == pytest.approx(2e-6, rel=1e-6)
    with pytest.raises(PigaError):
        list(records_of([], str(tmp_path / "none.sqlite"), "G-0417"))
