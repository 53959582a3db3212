"""Direct instruments, without a gimbal: estimates, units, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import piga
from piga.records.terms import turns
from tests.calibration.direct import TERMS, G, Tumble

pytestmark = pytest.mark.filterwarnings("ignore::piga.errors.CalibrationWarning")
MA, COUNTS = Tumble(), Tumble(K=50_000.0, noise=0.0)
CASES = {
    "rate": (MA, "rate", "mA", "0.6006 mA/g", "mA"),
    "other unit of K": (MA, "rate", "mA", "600.6 uA/g", "mA"),
    "counts": (COUNTS, "counts", "", "50050 count/s/g", "count/s"),
    "pulses": (COUNTS, "pulses", "", "50.05 kHz/g".replace("kHz", "count/ms"), "count/s"),
    "LSB": (Tumble(K=4000.0, noise=0.1), "rate", "LSB", "4004 LSB/g", "LSB"),
    "g": (Tumble(K=1.0), "rate", "g", "1.001 g/g", "g"),
}


@pytest.fixture(scope="module", params=CASES)
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Tumble, Path]:
    """A run file of each case."""
    tumble, kind, unit, scale_factor, _ = CASES[request.param]
    return request.param, tumble, tumble.write(tmp_path_factory.mktemp("direct"), kind, unit, scale_factor)


def test_truth_lies_in_the_intervals_and_units_are_those_of_the_output(
    made: tuple[str, Tumble, Path], tmp_path: Path
) -> None:
    name, tumble, path = made
    unit = CASES[name][-1]
    result = piga.calibrate(piga.read_run(path))
    truth = {"scale_factor": tumble.K} | tumble.truth
    for key in TERMS:
        assert abs(result[key].value - truth[key]) < result[key].expanded, key
    scale = result["scale_factor"]
    assert scale.unit == f"{unit}/g"
    assert scale.unit_si == f"{unit}/(m/s^2)"
    assert scale.value_si == pytest.approx(scale.value / G, rel=1e-15)
    result.to_json(tmp_path / "c.json")
    document = json.loads((tmp_path / "c.json").read_text())
    residual = "count" if unit == "count/s" else unit
    assert document["instrument"]["scale_factor_nominal"]["unit"] == f"{unit}/g"
    assert document["residual"]["rms"]["unit"] == residual
    assert "phase" not in document["model"]
    assert "turns" not in document["segments"][0]
    back = piga.Calibration.from_json(tmp_path / "c.json")
    assert (back.unit, back.direct, back.residual_unit) == (unit, True, residual)
    assert back.coefficients == result.coefficients


def test_estimate_is_that_of_least_squares_of_the_samples(tmp_path: Path) -> None:
    result = piga.calibrate(piga.read_run(MA.write(tmp_path, "rate", "mA", "0.6 mA/g")))
    x, y, _ = MA.force()[2].T
    columns = np.stack((x, np.ones(x.size), x**2, x**3, y), axis=1)
    fitted = np.linalg.lstsq(columns, MA.rate(), rcond=None)[0]
    expected = np.concatenate((fitted[:1], fitted[1:] / fitted[0]))
    found = np.array([result[key].value for key in TERMS])
    assert np.abs(found - expected).max() < 1e-9
    spread = MA.noise * np.sqrt(np.diag(np.linalg.inv(columns.T @ columns)))
    of_fit = next(row for row in result.budget if row.type == "A").contributions
    ratio = np.array([abs(of_fit[key]) for key in TERMS]) / np.concatenate((spread[:1], spread[1:] / MA.K))
    assert np.all((ratio > 0.6) & (ratio < 1.6))


def test_asymmetry_of_the_scale_factor_is_found_and_taken_out(tmp_path: Path) -> None:
    """K above and below zero, each fitted by itself with NumPy; then the force of the true reference back from the output."""
    tumble = Tumble(truth=MA.truth | {"k2": 0.0, "k3": 0.0, "k1a": 4e-4})
    path = tumble.write(tmp_path, "rate", "mA", "0.6 mA/g")
    path.write_text(path.read_text().replace(str(list(TERMS)), "['scale_factor', 'k0', 'k1a', 'm_Y']"))
    run = piga.read_run(path)
    result = piga.calibrate(run)
    x, y, _ = tumble.force()[2].T
    columns = np.stack((np.maximum(x, 0.0), np.minimum(x, 0.0), np.ones(x.size), y), axis=1)
    above, below = np.linalg.lstsq(columns, tumble.rate(), rcond=None)[0][:2]
    assert result["scale_factor"].value == pytest.approx(0.5 * (above + below), rel=1e-9)
    assert result["k1a"].value == pytest.approx((above - below) / (above + below), abs=1e-9)
    assert abs(result["k1a"].value - 4e-4) < result["k1a"].expanded
    force = piga.compensate(run, result).ax / G
    assert abs(np.mean(force - x)) < 1e-7
    assert abs(np.corrcoef(force - x, np.abs(x))[0, 1]) < 0.1


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('serial = "QA-1"', 'serial = "QA-1"\ncounts_per_revolution = 3600', "counts_per_revolution belongs to a gyro"),
        ('serial = "QA-1"', 'serial = "QA-1"\nservo = { integral_gain = "1 N m/(rad s)" }', "servo belongs to a gyro"),
        ('kind = "rate"', 'kind = "angle"', "kind 'angle' belongs to a gyro"),
        ('"rate", unit = "mA"', '"rate", unit = "deg/s"', "'deg/s' is that of an angle"),
        ('"rate", unit = "mA"', '"rate", unit = "V"', "'0.6 mA/g' is given in"),
        ('"rate", unit = "mA"', '"rate"', "needs a unit"),
        ('segment = "p"', 'segment = "p"\nbase_rate = { columns = ["fx", "fy", "fz"], unit = "rad/s" }', "base_rate"),
        ("'m_Y'", "'tan_beta'", "'tan_beta' turns with the gimbal"),
        ("'m_Y'", "'servo'", "'servo' turns with the gimbal"),
        ("'m_Y'", "'s1', 'c1'", "'s1' turns with the gimbal"),
        ("[model]", '[model]\nphases = "per-segment"', "phases 'per-segment' belongs to the gimbal"),
        ("[model]", '[model]\nphase_source = "input"', "phase_source 'input' belongs to the gimbal"),
    ],
)  # fmt: skip
def test_what_belongs_to_a_gimbal_is_refused_by_name(tmp_path: Path, old: str, new: str, words: str) -> None:
    path = MA.write(tmp_path, "rate", "mA", "0.6 mA/g")
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(piga.PigaError, match=words) as caught:
        piga.calibrate(piga.read_run(path))
    assert caught.value.remedy


def test_terms_that_nobody_asked_for_are_those_of_the_kind() -> None:
    t, segment, f = MA.force()
    run = piga.Run.from_arrays(
        t, MA.rate(), G * f, scale_factor="0.6 mA/g", kind="rate", unit="mA", segment=segment, units="SI"
    )
    assert run.model.terms == ("scale_factor", "k0")
    assert (run.output_unit, run.quantity) == ("mA", "rate")
    suggested = {term for entry in piga.calibrate(run).diagnostics.missing_terms for term in entry.terms}
    assert "m_Y" in suggested
    assert not any(map(turns, suggested))


def test_a_base_rate_in_memory_is_refused() -> None:
    t, _, f = MA.force()
    with pytest.raises(piga.PigaError, match="base_rate"):
        piga.Run.from_arrays(
            t, MA.rate(), f, scale_factor="0.6 mA/g", kind="rate", unit="mA", base_rate=f, units={"f": "g"}
        )


def six_positions(terms: list[str]) -> piga.Run:
    """+-X, +-Y, +-Z up, each once, with a tilt of 2 mrad of each position that nobody knows."""
    rng = np.random.default_rng(3)
    axes = np.repeat(np.concatenate((np.eye(3), -np.eye(3))), 300, axis=0)
    segment = np.repeat(np.arange(6), 300)
    tilt = np.repeat(rng.normal(0.0, 2e-3, 6), 300)
    output = 100.0 * (axes @ [1.0, 3e-3, -2e-3] + 0.02 + tilt) + 0.2 * rng.standard_normal(1800)
    return piga.Run.from_arrays(
        0.01 * np.arange(1800) + 10.0 * segment,
        output,
        G * axes,
        scale_factor="100 LSB/g",
        kind="rate",
        unit="LSB",
        segment=segment,
        model={"terms": terms},
        units="SI",
    )


def test_six_positions_give_what_their_differences_give() -> None:
    run = six_positions(["scale_factor", "k0", "m_Y", "m_Z"])
    result = piga.calibrate(run)
    mean = np.array([run.output[run.segment_index == k].mean() for k in range(6)])
    half = 0.5 * (mean[:3] - mean[3:])
    assert result["scale_factor"].value == pytest.approx(half[0], rel=1e-9)
    assert result["m_Y"].value == pytest.approx(half[1] / half[0], rel=1e-9)
    assert result["m_Z"].value == pytest.approx(half[2] / half[0], rel=1e-9)
    assert result["k0"].value == pytest.approx(mean.mean() / half[0], rel=1e-9)
    assert abs(result["scale_factor"].value - 100.0) < result["scale_factor"].expanded


def test_a_term_that_one_of_six_positions_decides_is_refused() -> None:
    with pytest.raises(piga.PigaError, match=r"alone determines .*k_ZZ") as refused:
        piga.calibrate(six_positions(["scale_factor", "k0", "m_Y", "m_Z", "k_ZZ"]))
    assert "visit this position again" in refused.value.remedy


def test_runs_are_joined_if_their_units_agree(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    first = piga.read_run(MA.write(tmp_path, "rate", "mA", "0.6 mA/g"))
    second = piga.read_run(Tumble(seed=2).write(tmp_path / "a", "rate", "mA", "0.6 mA/g"))
    summary = piga.calibration.RunSummary.of(second)
    result = piga.calibrate([first, summary])
    assert result.unit == "mA"
    biases = [c for c in result.coefficients if c.name == "k0"]
    assert len(biases) == 2
    assert all(abs(c.value - 2e-3) < c.expanded for c in biases)
    other = piga.read_run(COUNTS.write(tmp_path / "a", "counts", "", "50000 count/s/g"))
    with pytest.raises(piga.PigaError, match=r"is in mA, that of run 'a.*' in count/s"):
        piga.calibrate([first, other])


def test_coefficients_may_be_given_in_the_unit() -> None:
    made = piga.Calibration.from_coefficients({"scale_factor": "100 mV/g", "k0": (1e-3, 1e-5)}, unit="V")
    assert made["scale_factor"].value == pytest.approx(0.1)
    assert made["scale_factor"].unit == "V/g"
    assert made.scale_factor_nominal == pytest.approx(0.1 / G)
    for name in ("tan_beta", "s1"):
        with pytest.raises(piga.PigaError, match="gyro accelerometer"):
            piga.Calibration.from_coefficients({"scale_factor": "100 mV/g", name: 0.0}, unit="V")
    with pytest.raises(piga.PigaError, match="that of an angle"):
        piga.Calibration.from_coefficients({"scale_factor": 1.0}, unit="rpm")
