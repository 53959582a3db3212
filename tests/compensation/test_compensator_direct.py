"""Compensation of direct instruments: the inverse of a polynomial."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import piga
from piga.compensation import Compensator, identify_phase
from piga.compensation.files import orthogonal_triad
from piga.compensation.model import FLAGS
from tests.calibration.direct import G, Tumble
from tests.cli.runner import exit_code

pytestmark = pytest.mark.filterwarnings("ignore::piga.errors.CalibrationWarning")
TRUTH = {"k0": 2e-3, "k2": 20e-6, "k3": 5e-6, "m_Y": 3e-4}


def given(unit: str, K: float, u: float = 0.0) -> piga.Calibration:
    """The true coefficients; K with the standard uncertainty ``u``."""
    return piga.Calibration.from_coefficients({"scale_factor": (K, u)} | dict(TRUTH), serial="QA-1", unit=unit)


@pytest.mark.parametrize(
    ("kind", "unit", "K", "noise", "close"),
    [("rate", "mA", 0.6, 0.0, 4e-12), ("counts", "count/s", 5e6, 0.0, 1e-6), ("rate", "LSB", 4e6, 0.0, 4e-12)],
)
def test_force_is_the_true_one(
    tmp_path: Path, kind: str, unit: str, K: float, noise: float, close: float
) -> None:
    tumble = Tumble(K=K, noise=noise)
    declared = "" if kind == "counts" else unit
    run = piga.read_run(tumble.write(tmp_path, kind, declared, f"{K:g} {unit}/g"))
    result = piga.compensate(run, given(unit, K, 1e-6 * K))
    truth = tumble.force()[2][:, 0]
    seen = np.isfinite(result.ax) & (np.arange(run.size) % 100 > 2)
    tolerance = close if kind == "rate" else 3.0 / (K * tumble.step)
    assert np.abs(result.ax[seen] / G - truth[seen]).max() < tolerance
    assert not (result.flags[seen] & FLAGS["coarse"]).any()
    assert result.u_ax[seen] == pytest.approx(1e-6 * G * np.abs(truth[seen] + TRUTH["k0"]), rel=1e-2, abs=1e-8)


@pytest.mark.parametrize("name", ["k1a", "k2o"])
def test_an_interval_in_which_the_force_passes_zero(name: str) -> None:
    """Counts by the antiderivative of the model; the mean force of each interval comes back."""
    t = np.arange(40) * 0.1
    x = -1.03 + 0.5 * t
    integral = x**2 / 2.0 + 1e-3 * (x * np.abs(x) / 2.0 if name == "k1a" else np.abs(x) ** 3 / 3.0)
    truth = piga.Calibration.from_coefficients({"scale_factor": 5e9, name: 1e-3}, unit="count/s")
    force = G * np.stack((x, 0.0 * x, 0.0 * x), axis=1)
    run = piga.Run.from_arrays(
        t, 5e9 * (integral - integral[0]) / 0.5, force, scale_factor="5e9 count/s/g", unit="count/s", units="SI"
    )
    error = piga.compensate(run, truth).ax[3:] / G - 0.5 * (x[3:] + x[2:-1])
    assert np.abs(error).max() < 2e-8


def test_velocity_is_that_of_all_counts(tmp_path: Path) -> None:
    tumble = Tumble(K=5e6, noise=0.0)
    run = piga.read_run(tumble.write(tmp_path, "counts", "", "5e6 count/s/g"))
    result = piga.compensate(run, given("count/s", 5e6))
    inside = run.segment_index == 0
    assert result.dv[inside].sum() == pytest.approx(G * 9.9, abs=G * 2.0 / 5e6)


def test_a_page_shows_the_unit_and_nothing_of_a_gimbal(tmp_path: Path) -> None:
    tumble = Tumble()
    path = tumble.write(tmp_path, "rate", "mA", "0.6 mA/g")
    piga.calibrate(piga.read_run(path)).to_json(tmp_path / "c.json")
    out = tmp_path / "out.csv"
    assert (
        exit_code(
            "compensate",
            path,
            "--calibration",
            tmp_path / "c.json",
            "--out",
            out,
            "--report",
            tmp_path / "p.html",
        )
        == 0
    )
    page = (tmp_path / "p.html").read_text().split("plotly.js v")[0]
    assert "(mA)/(m/s²)" in page
    for word in ("gimbal", "rad/s", "output angle", "Revolution", "phase"):
        assert word not in page, word


def test_what_needs_a_gimbal_is_refused(tmp_path: Path) -> None:
    run = piga.read_run(Tumble().write(tmp_path, "rate", "mA", "0.6 mA/g"))
    own, other = given("mA", 0.6), given("V", 0.6)
    with pytest.raises(piga.PigaError, match="record is in mA, that of the calibration in V"):
        piga.compensate(run, other)
    with pytest.raises(piga.PigaError, match=r"phase at power-up: only for a gyro accelerometer"):
        identify_phase(run, own, 10.0)
    with pytest.raises(piga.PigaError, match="compensation of a set: only for a gyro"):
        piga.compensate_set([run] * 3, orthogonal_triad([own] * 3))
    with pytest.raises(piga.PigaError, match="motion of an instrument: only for a gyro"):
        own.instrument()


def test_a_stream_gives_what_the_record_gives(tmp_path: Path) -> None:
    run = piga.read_run(Tumble().write(tmp_path, "rate", "mA", "0.6 mA/g"))
    whole = piga.compensate(run, given("mA", 0.6))
    stream = Compensator(given("mA", 0.6), kind="rate", step=run.median_step)
    parts = [
        stream.push({"t": run.t[k : k + 7], "output": run.output[k : k + 7], "f": run.f[k : k + 7]}).ax
        for k in range(0, 700, 7)
    ]
    assert np.array_equal(np.concatenate(parts), whole.ax[:700])
