"""The page of ``piga compensate --report``: what it shows of whole and streamed records, and what is refused."""

from __future__ import annotations

import hashlib
import importlib
import json
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

import piga
from piga.compensation import FLAGS, Compensated
from piga.records.calibration import Residuals
from piga.reports import compensation as compensation_module
from piga.reports.compensation import correction_spectrum, flag_figure, force_figure, in_windows, of_record
from piga.units import G0
from tests.compensation.run_files import KERNEL, command, small_chunks, write
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, constant_force, run_of


@pytest.fixture
def watched(monkeypatch):
    """The outline that the command filled."""
    collected = []
    compensation = importlib.import_module("piga.reports.compensation")
    real = compensation.compensation_page

    def page(outline, facts, whole=None):
        collected.append((outline, facts, whole))
        return real(outline, facts, whole)

    monkeypatch.setattr(compensation, "compensation_page", page)
    return collected


def compensated(tmp_path, monkeypatch, capsys, run, *more):
    words = (run, "--calibration", tmp_path / "run.json", "--out", tmp_path / "out.parquet", *more)
    return command(monkeypatch, capsys, *words)


@pytest.mark.parametrize("streamed", [False, True])
def test_page_holds_what_was_written(tmp_path, monkeypatch, capsys, watched, streamed):
    """Counts, velocity and files of the page are those of the summary; a streamed file says what is not shown."""
    run, page = write(tmp_path, rows=3000), tmp_path / "page.html"
    if streamed:
        monkeypatch.setattr(sys.modules["piga.reports.compensation"], "COMPARED_ROWS", 2999)
        small_chunks(monkeypatch, 211)
    code, text, _ = compensated(tmp_path, monkeypatch, capsys, run, "--report", page, "--json")
    assert code == 0
    summary, html = json.loads(text), page.read_text(encoding="utf-8")
    (outline, facts, whole), *others = watched
    assert not others
    assert outline.size == summary["rows"] == 3000
    assert abs(outline.velocity[0] - summary["velocity_m_s"]) < 1e-9
    assert {name: marks.count for name, marks in outline.marks.items() if marks.count} == summary["flags"]
    assert [name for name, _ in facts.files] == ["run.toml", "run.parquet", "run.json"]
    assert whole is not None
    assert ("is shown for records of at most 2999 rows" in html) == streamed
    assert "SHA-256" in html
    assert "no_increment" in html
    assert "as recorded" in html


def digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_inputs_are_stated_as_they_were_read(tmp_path, monkeypatch, capsys):
    """Every input is replaced while the rows are computed: page, file and summary have the digests of what was read."""
    run, page = write(tmp_path), tmp_path / "page.html"
    files = [tmp_path / name for name in ("run.toml", "run.parquet", "run.json")]
    known = [{"file": path.name, "sha256": digest(path)} for path in files]
    real = KERNEL.run_kernel

    def replaced(*inputs):
        for path in files:
            path.write_bytes(path.read_bytes() + b"\n")
        real(*inputs)

    monkeypatch.setattr(KERNEL, "run_kernel", replaced)
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
    """1000 arcsec across 1 g: an amplitude of tan(beta) g at order 1; indicated less correction is the force."""
    t = np.arange(0.0, 120.0, 0.02)
    record = run_of(t, constant_force(t, 1.0, 1.0), phi=0.3, kind=kind)
    cal = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.3})
    outline = of_record(record, cal, piga.compensate(record, cal))
    order, amplitude = correction_spectrum(outline.instruments[0])
    first = int(np.argmin(np.abs(order - 1.0)))
    assert abs(amplitude[first] / (TAN_BETA * G0) - 1.0) < 0.02
    indicated, correction = (outline.curve(f"{name} a_x")[1] for name in ("indicated", "correction"))
    known = np.isfinite(correction)
    np.testing.assert_allclose((indicated - correction)[known], G0, rtol=1e-6)
    taken_out = K_G / G0 * 0.02 * np.nansum(correction[1:])
    leading = outline.instruments[0].leading
    assert abs(leading.before[-1] - taken_out) < 1e-3 * TAN_BETA * K_G * 0.02 * t.size
    assert abs(outline.rms("correction a_x") / (TAN_BETA * G0 / np.sqrt(2.0)) - 1.0) < 0.05
    figure = force_figure(outline)
    assert all(axis.quantity and axis.unit for panel in figure.panels for axis in (panel.x, panel.y))


def test_windows_begin_with_segments_and_after_sixteen_turns():
    """40 turns and then 10 backwards: three windows and one."""
    psi = 2.0 * np.pi * np.concatenate((np.linspace(5.0, 45.0, 4001), np.linspace(0.0, -10.0, 1001)))
    segment = np.repeat(np.array([0, 1], np.int32), (4001, 1001))
    zero = np.zeros(psi.size)
    windows = in_windows(Residuals(np.arange(psi.size), zero, psi, zero, zero, zero, zero, segment))
    starts = np.flatnonzero(np.diff(windows.segment, prepend=-1))
    assert abs(starts[1:4] - [1600, 3200, 4001]).max() <= 1
    assert windows.segment[0] == windows.segment[1599]


def test_extremes_and_flags_are_kept():
    """Of 200 000 rows: the outline is small, holds lone extremes and flags; the leading part is cut."""
    size, cal = 200_000, calibration_of({"scale_factor": K_G})
    t = np.arange(size) * 0.01
    ax, flags = np.sin(t), np.full(size, FLAGS["temperature"], np.int32)
    for row in (47, 134_711):
        ax[row], flags[row] = 50.0 + row, FLAGS["coarse"]
    record = run_of(t, np.stack((ax, ax, ax), axis=1), kind="rate")
    result = of_record(record, cal, Compensated(t, ax, 0.01 * ax, np.zeros(0), flags))
    times, drawn = result.curve("a_x")
    assert times.size <= compensation_module.CURVE_POINTS
    assert (np.diff(times) > 0).all()
    for row in (47, 134_711):
        assert drawn[np.abs(times - row * 0.01) < 1e-3] == [50.0 + row]
    coarse, warm = result.marks["coarse"], result.marks["temperature"]
    assert (coarse.count, warm.count) == (2, size - 2)
    assert (coarse.first, coarse.last) == (t[47], t[134_711])
    assert 0 < warm.t.size <= compensation_module.MARKS
    drawn_marks = sorted(len(series.arrays()[0]) for series in flag_figure(result).panels[0].series)
    assert drawn_marks[0] == 2
    assert 500 < drawn_marks[1] <= warm.t.size


@pytest.mark.parametrize("option", ["--report", "--out"])
def test_a_path_that_cannot_be_written_is_told_by_its_option(tmp_path, monkeypatch, capsys, option):
    """Before anything is computed: a file stands where the folder would be."""
    monkeypatch.setattr(KERNEL, "run_kernel", None)
    run, bad = write(tmp_path), tmp_path / "run.json" / ("page.html" if option == "--report" else "x.parquet")
    code, _, err = compensated(tmp_path, monkeypatch, capsys, run, option, bad)
    assert code == 2
    assert f"{bad.parent}: is a file" in err
    assert f"choose another {option}" in err


def test_results_of_other_inputs_go_beside_with_their_page(tmp_path, monkeypatch, capsys):
    """The same name from another run: a folder 2 beside it; from the same run: in place; with --force: replaced."""
    write(tmp_path), write(tmp_path, "other.parquet", rows=300)
    (tmp_path / "o").mkdir()

    def rows(run, *more):
        words = (
            tmp_path / f"{run}.toml",
            "--calibration",
            tmp_path / "run.json",
            "--out",
            tmp_path / "o" / "c.csv",
        )
        page = "--report", tmp_path / "o" / "c.html"
        code, text, err = command(monkeypatch, capsys, *words, *page, "--json", *more)
        assert code == 0, err
        summary = json.loads(text)
        written = tmp_path / "o" / "2" if "/2/" in summary["file"] else tmp_path / "o"
        assert (written / "c.html").is_file()
        return summary["file"].removeprefix(str(tmp_path)), len(
            (written / "c.csv").read_text().splitlines()
        ) - 1

    assert rows("run") == ("/o/c.csv", 500)
    assert rows("run") == ("/o/c.csv", 500)
    assert rows("other") == ("/o/2/c.csv", 300)
    assert len((tmp_path / "o" / "c.csv").read_text().splitlines()) == 501
    assert rows("other", "--force") == ("/o/c.csv", 300)


def test_a_report_that_cannot_be_is_refused(tmp_path, monkeypatch, capsys):
    run = write(tmp_path)
    for words, says in ((("--report", tmp_path / "page.pdf"), "must end in .html"),):
        code, _, err = compensated(tmp_path, monkeypatch, capsys, run, *words)
        assert code == 2
        assert says in err
    code, _, err = command(
        monkeypatch, capsys, "-", "--calibration", tmp_path / "run.json", "--report", tmp_path / "page.html"
    )
    assert code == 2
    assert "--report is not for a live stream" in err
    assert not (tmp_path / "page.html").exists()
    assert not (tmp_path / "out.parquet").exists()


def test_without_a_report_no_report_is_loaded(tmp_path):
    """Plain compensation loads neither the page nor what draws it."""
    run = write(tmp_path)
    code = (
        "import sys; from piga.cli.compensate import compensate; from pathlib import Path;"
        f"compensate([Path({str(run)!r})], [Path({str(tmp_path / 'run.json')!r})], Path({str(tmp_path / 'o.csv')!r}));"
        "assert not {name for name in sys.modules if name.startswith(('piga.reports', 'matplotlib', 'jinja2'))}"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
