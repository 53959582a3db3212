"""The page of ``piga compensate --report``: of records, streams and sets; what it shows, and what is refused."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

import piga
from piga.compensation import FLAGS, SetCompensator, compensate_set
from piga.records.calibration.coefficient import NO_REFERENCE
from piga.reports.calibration.tables import sentence
from piga.reports.compensation import CompensationOutline, compensation_page, force_figure
from piga.units import G0
from tests.compensation.run_files import KERNEL, command, write
from tests.compensation.triads import PHASES, SKEWED, made, rotation
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, constant_force, run_of


def compensated(tmp_path, monkeypatch, capsys, run, *more):
    words = (run, "--calibration", tmp_path / "run.json", "--out", tmp_path / "out.parquet", *more)
    return command(monkeypatch, capsys, *words)


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
    outline = CompensationOutline(piga.compensate(record, cal), [record], [cal])
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


# -- sets ----------------------------------------------------------------------------------------------

NAMES = ("a", "b", "c", "d")
STEP = 0.02


def outline_of_set(axes, rows: int, fault: int = -1, **more):
    """A set under constant force, the reading of instrument 2 too high in one row; its outline."""
    t = np.arange(rows) * STEP
    f = np.tile(np.array([1.0, -0.7, 0.4]) * G0, (rows, 1))
    runs, mounted = made(t, f, axes, std={"phi": 1e-5, "scale_factor": 1e-7}, **more)
    if fault >= 0:
        runs[2].output[fault] += 1e-4
    result = compensate_set(runs, mounted, details=True)
    return CompensationOutline(result, runs, [item.calibration for item in mounted], mounted), mounted


def test_misfits_make_the_residual_and_flags_the_flags():
    axes = [rotation(a) for a in SKEWED]
    t = np.arange(300) * STEP
    f = np.tile(np.array([1.0, -0.7, 0.4]) * G0, (t.size, 1)) * np.where(t < 3.0, 1.0, 1e-3)[:, None]
    runs, mounted = made(t, f, axes, std={"phi": 1e-5})
    psi = np.array([r.output for r in runs])
    psi += 1e-5 * np.random.default_rng(1).standard_normal(psi.shape)
    rows = SetCompensator(mounted, details=True).push(t, psi)
    plain = SetCompensator(mounted).push(t, psi)
    assert rows.f.tobytes() == plain.f.tobytes()
    assert plain.misfit.size == plain.each.size == 0
    np.testing.assert_allclose(np.sqrt((rows.misfit**2).sum(axis=0))[1:], rows.residual[1:], rtol=1e-12)
    together = np.bitwise_or.reduce(rows.each, axis=0)
    assert np.array_equal(together[1:], rows.flags[1:] & ~FLAGS["fault"])
    assert (rows.each[:, 0] == FLAGS["no_increment"]).all()
    records = compensate_set(runs, mounted, details=True)
    assert records.misfit.shape == (4, 300)


def test_the_page_of_a_set_says_that_the_reference_is_not_in_u():
    """In the verdict, once, with the names of the instruments: no calibration here states the reference's uncertainty."""
    result, _ = outline_of_set([rotation(a) for a in SKEWED], 200)
    page = compensation_page(result, NAMES, (), {})
    assert page.judgement is not None
    assert page.judgement.tone == "doubtful"
    assert [what for what, _ in page.judgement.problems] == [f"{', '.join(NAMES)}: {sentence(NO_REFERENCE)}"]


@pytest.mark.long
def test_outline_holds_misfits_corrections_and_flags():
    result, _ = outline_of_set([rotation(a) for a in SKEWED], 3000, fault=1200)
    for name in ("residual", *(f"misfit {i}" for i in range(4))):
        assert np.nanargmax(np.abs(result.curves[name])) in (1200, 1201)
    assert np.count_nonzero(result.result.flagged("fault")) == 2
    for axis, value in zip("xyz", (1.0, -0.7, 0.4), strict=True):
        force = result.curves[f"f_{axis}"]
        raw, correction = (result.curves[f"{name} f_{axis}"] for name in ("indicated", "correction"))
        away = np.isfinite(force) & (np.abs(np.arange(force.size) - 1200.5) > 2)
        np.testing.assert_allclose(force[away], value * G0, atol=1e-9 * G0)
        np.testing.assert_allclose((raw - correction)[away], force[away], atol=1e-12 * G0)
        assert 1e-4 * G0 < result.rms(f"correction f_{axis}") < 3.0 * TAN_BETA * G0


@pytest.mark.long
def test_command_writes_the_page_of_a_set(tmp_path, monkeypatch, capsys):
    lines = []
    for i, (name, axes) in enumerate(zip(NAMES, [rotation(a) for a in SKEWED], strict=True)):
        write(tmp_path, f"{name}.parquet", rows=400, axes=axes.tolist(), phi=PHASES[i])
        lines.append(
            f'[[triad.instrument]]\nrun = "{name}.toml"\ncalibration = "{name}.json"\naxes = {axes.tolist()}\n'
        )
    (tmp_path / "set.toml").write_text("\n".join(lines))
    page = tmp_path / "r.html"
    words = (tmp_path / "set.toml", "--out", tmp_path / "o.parquet", "--report", page, "--json")
    code, text, said = command(monkeypatch, capsys, *words)
    assert code == 0, said
    assert json.loads(text)["rows"] == 400
    html = page.read_text(encoding="utf-8")
    for name in (*(f"{name} (A)" for name in NAMES), "set.toml", "a.toml", "a.json", "d.parquet", "SHA-256"):
        assert name in html
