"""The page of ``piga compensate --report``: what it shows of whole and streamed records, and what is refused."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

import piga
from piga.reports.compensation import force_figure, of_record
from piga.units import G0
from tests.compensation.run_files import KERNEL, command, write
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, constant_force, run_of


def compensated(tmp_path, monkeypatch, capsys, run, *more):
    words = (run, "--calibration", tmp_path / "run.json", "--out", tmp_path / "out.parquet", *more)
    return command(monkeypatch, capsys, *words)


def test_page_holds_what_was_written(tmp_path, monkeypatch, capsys):
    run, page = write(tmp_path, rows=3000), tmp_path / "page.html"
    code, text, _ = compensated(tmp_path, monkeypatch, capsys, run, "--report", page, "--json")
    assert code == 0
    html = page.read_text(encoding="utf-8")
    assert json.loads(text)["rows"] == 3000
    for words in ("run.toml", "run.parquet", "run.json", "SHA-256", "no_increment", "as recorded"):
        assert words in html


def digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_inputs_are_stated_as_they_were_read(tmp_path, monkeypatch, capsys):
    """Every input is replaced while the rows are computed: page, file and summary have the digests of what was read."""
    run, page = write(tmp_path), tmp_path / "page.html"
    files = [tmp_path / name for name in ("run.toml", "run.parquet", "run.json")]
    known = [{"file": path.name, "sha256": digest(path)} for path in files]
    real = KERNEL.compensate_record

    def replaced(*inputs):
        for path in files:
            path.write_bytes(path.read_bytes() + b"\n")
        real(*inputs)

    monkeypatch.setattr(KERNEL, "compensate_record", replaced)
    code, text, _ = compensated(tmp_path, monkeypatch, capsys, run, "--report", page, "--json")
    assert code == 0
    assert digest(files[1]) != known[1]["sha256"]
    assert json.loads(text)["inputs"] == known
    metadata = pa.parquet.read_schema(tmp_path / "out.parquet").metadata
    assert json.loads(metadata[b"piga.inputs"]) == known
    html = page.read_text(encoding="utf-8")
    assert all(one["sha256"] in html for one in known)
    assert not any(digest(path) in html for path in files)


@pytest.mark.parametrize("kind", ["angle", "rate"])
def test_the_correction_is_the_cross_coupling(kind):
    """1000 arcsec across 1 g: a wave of the amplitude tan(beta) g; indicated less correction is the force."""
    t = np.arange(0.0, 120.0, 0.02)
    record = run_of(t, constant_force(t, 1.0, 1.0), phi=0.3, kind=kind)
    cal = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.3})
    outline = of_record(record, cal, piga.compensate(record, cal))
    indicated, correction = (outline.curves[f"{name} a_x"] for name in ("indicated", "correction"))
    known = np.isfinite(correction)
    np.testing.assert_allclose((indicated - correction)[known], G0, rtol=1e-6)
    assert abs(outline.rms("correction a_x") / (TAN_BETA * G0 / np.sqrt(2.0)) - 1.0) < 0.05
    figure = force_figure(outline)
    assert all(axis.quantity and axis.unit for panel in figure.panels for axis in (panel.x, panel.y))


@pytest.mark.parametrize("option", ["--report", "--out"])
def test_a_path_that_cannot_be_written_is_told_by_its_option(tmp_path, monkeypatch, capsys, option):
    """Before anything is computed: a file stands where the folder would be."""
    monkeypatch.setattr(KERNEL, "compensate_record", None)
    run, bad = write(tmp_path), tmp_path / "run.json" / ("page.html" if option == "--report" else "x.parquet")
    code, _, err = compensated(tmp_path, monkeypatch, capsys, run, option, bad)
    assert code == 2
    assert f"{bad.parent}: is a file" in err
    assert "choose another folder" in err


def test_a_report_that_cannot_be_is_refused(tmp_path, monkeypatch, capsys):
    run = write(tmp_path)
    code, _, err = compensated(tmp_path, monkeypatch, capsys, run, "--report", tmp_path / "page.pdf")
    assert code == 2
    assert "must end in .html" in err
    code, _, err = command(
        monkeypatch, capsys, "-", "--calibration", tmp_path / "run.json", "--report", tmp_path / "page.html"
    )
    assert code == 2
    assert "--report is not for a live stream" in err
    assert not (tmp_path / "page.html").exists()
    assert not (tmp_path / "out.parquet").exists()
