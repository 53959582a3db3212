"""The page of a set: misfits and flags of the single instruments, what was taken out, and what is refused."""

from __future__ import annotations

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

from piga.compensation import FLAGS, SetCompensator, compensate_set
from piga.records.calibration.coefficient import NO_REFERENCE
from piga.reports.calibration.tables import sentence
from piga.reports.compensation import (
    compensation_page,
    of_set,
)
from piga.reports.render.page import page_html
from piga.units import G0
from tests.compensation.run_files import command, write
from tests.compensation.triads import PHASES, SKEWED, made, orthogonal, rotation
from tests.compensation.twin_data import K_G, TAN_BETA

NAMES = ("a", "b", "c", "d")
STEP = 0.02


def outline_of_set(axes, rows: int, fault: int = -1, **more):
    """A set under constant force, the reading of instrument 2 too high in one row; its outline."""
    t = np.arange(rows) * STEP
    f = np.tile(np.array([1.0, -0.7, 0.4]) * G0, (rows, 1))
    runs, mounted = made(t, f, axes, std={"phi": 1e-5, "scale_factor": 1e-7}, **more)
    if fault >= 0:
        runs[2].output[fault] += 1e-4
    return of_set(runs, mounted, compensate_set(runs, mounted, details=True)), mounted


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
    assert result.raised()["fault"].size == 2
    for axis, value in zip("xyz", (1.0, -0.7, 0.4), strict=True):
        force = result.curves[f"f_{axis}"]
        raw, correction = (result.curves[f"{name} f_{axis}"] for name in ("indicated", "correction"))
        away = np.isfinite(force) & (np.abs(np.arange(force.size) - 1200.5) > 2)
        np.testing.assert_allclose(force[away], value * G0, atol=1e-9 * G0)
        np.testing.assert_allclose((raw - correction)[away], force[away], atol=1e-12 * G0)
        assert 1e-4 * G0 < result.rms(f"correction f_{axis}") < 3.0 * TAN_BETA * G0


def test_three_instruments_cannot_contradict_each_other():
    three, _ = outline_of_set(orthogonal(), 200)
    assert "Three instruments fit any force exactly" in page_html(compensation_page(three, NAMES[:3], (), {}))


@pytest.mark.long
@pytest.mark.parametrize("kind", ["angle", "rate"])
def test_command_writes_the_page_of_a_set(tmp_path, monkeypatch, capsys, kind):
    lines = []
    for i, (name, axes) in enumerate(zip(NAMES, [rotation(a) for a in SKEWED], strict=True)):
        path = write(tmp_path, f"{name}.parquet", rows=400, axes=axes.tolist(), phi=PHASES[i])
        if kind == "rate":
            path.write_text(path.read_text().replace('"angle", unit = "rad"', '"rate", unit = "rad/s"'))
            table = pa.parquet.read_table(tmp_path / f"{name}.parquet")
            rate = pa.array(np.full(400, K_G * (axes[0] @ (1.0, 3.0, 1.0))))
            pa.parquet.write_table(table.set_column(1, "psi", rate), tmp_path / f"{name}.parquet")
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
