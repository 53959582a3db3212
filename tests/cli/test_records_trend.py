"""``piga records trend`` as a user runs it."""

from __future__ import annotations

import datetime as dt
import json
from dataclasses import replace

import numpy as np
import pytest

from piga.cli.records import history as records_of
from piga.cli.records import trend
from piga.errors import PigaError
from piga.records.calibration.document import calibration_to_bytes
from tests.cli.runner import outcome
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
def test_directories_and_files(folder, tmp_path, capsys):
    def trend_of(*words):
        code, out, err = outcome(capsys, "records", "trend", *words, "--at", "2024-01-01", "--json")
        assert code == 0, err
        return json.loads(out)

    document = trend_of(folder, "--common", "0.5", "--out", tmp_path)
    assert document["serial"] == "G-0417"
    assert len(document["coefficients"][0]["records"]) == 6
    assert json.loads((tmp_path / "trend.json").read_text()) == document
    again = trend_of(*(folder / f"r{i}" / "calibration.json" for i in range(6)), "--common", "x=0.5")
    drifts = [one["coefficients"][0]["drift_per_year"] for one in (document, again)]
    assert drifts[0] == drifts[1]


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
def test_records_of_a_store(tmp_path, capsys):
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
    code, out, err = outcome(capsys, "records", "trend", "--store", path, "--serial", "G-0417", "--json")
    assert code == 0, err
    (trend_of_k0,) = json.loads(out)["coefficients"]
    assert trend_of_k0["drift_per_year"]["value"] == pytest.approx(2e-6, rel=1e-6)
    with pytest.raises(PigaError):
        list(records_of([], str(tmp_path / "none.sqlite"), "G-0417"))
    with pytest.raises(PigaError, match=r"holds no record of 'G-417'\n  remedy: --serial is one of: G-0417"):
        list(records_of([], str(path), "G-417"))
