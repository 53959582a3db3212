"""Scenarios and the files of simulated tests: they belong together, and bad ones are refused by name."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import numpy as np
import pytest

from piga.calibration.calibrate import calibrate
from piga.errors import CalibrationError, RunFileError
from piga.stand import (
    read_scenario,
    run_scenario,
)
from piga.stand.write_run import (
    run_file_text,
    truth_document,
    write_data,
)
from tests.stand.simulated import SCENARIO, saved, truth_of, written

pytestmark = pytest.mark.interpreted

EXAMPLES = Path(__file__).parents[2] / "examples"

SCENARIOS = [
    path
    for path in sorted(EXAMPLES.glob("*.toml"))
    if "\n[stand]" in path.read_text(encoding="utf-8") and not path.name.startswith("plan-")
]


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda p: p.stem)
def test_examples_are_valid(path):
    scenario = read_scenario(path)
    assert len(SCENARIOS) >= 6
    assert scenario.stand.segments()


def test_run_file_truth_and_data_belong_together(tmp_path):
    scenario = read_scenario(written(tmp_path))
    test = run_scenario(scenario)
    run = saved(scenario, test, tmp_path)
    assert run.serial == "S-1"
    assert run.size == test.log.t.size
    assert run.labels == test.log.labels
    assert np.abs(run.f - test.log.reference).max() < 1e-14
    document = truth_document(scenario, test)
    assert document["schema"] == "piga.truth/1"
    names = {c["name"]: c for c in document["coefficients"]}
    assert names["tan_beta"]["value"] == pytest.approx(math.tan(74 * math.pi / 648000))
    assert names["phi"] == {"name": "phi", "value": pytest.approx(0.5), "unit": "rad", "segment": None}
    assert names["k0"]["unit"] == "g"
    table = tomllib.loads(run_file_text(scenario, test, "run.parquet"))
    assert table["model"] == {"terms": ["scale_factor", "tan_beta", "k0"], "phases": "shared"}


def test_servo_terms_are_prescribed_to_the_quasi_steady_model_and_predicted_of_the_twin(tmp_path):
    own = 'servo = "13 ug/g^3"\nservo_damping = "5 ug/g^3"\nk0 = "3e-4 g"'
    path = written(tmp_path, terms=('k0 = "3e-4 g"', own))
    scenario = read_scenario(path)
    truth = truth_of(run_scenario(scenario))
    assert (truth["servo", None], truth["servo_damping", None]) == (pytest.approx(13e-6), pytest.approx(5e-6))
    table = tomllib.loads(run_file_text(scenario, run_scenario(scenario), "run.parquet"))
    assert table["model"]["terms"] == ["scale_factor", "tan_beta", "k0", "servo", "servo_damping"]
    twin = SCENARIO.replace('"0:360:60 deg"', '"45:46:1 deg"').replace('dwell = "20 s"', 'dwell = "1 s"')
    path.write_text(
        twin + '[twin]\nintegral_gain = "3000 N m/(rad s)"\n[run]\nmodel = "twin"\n', encoding="utf-8"
    )
    truth = truth_of(run_scenario(read_scenario(path)))
    assert truth["servo", None] == pytest.approx(0.8884 * 0.08884 / 6000.0)
    assert truth["servo_damping", None] == pytest.approx(0.05 * 0.8884**2 / 3000.0)


SERVO = (
    'servo = { integral_gain = { value = "3000 N m/(rad s)", standard = 0.0 }, '
    'damping = { value = "0.05 N m s/rad", standard = "0.005 N m s/rad" }, angular_momentum = "0.1 kg m^2/s" }\n'
)

INSTRUMENT = "[instrument]\n"


def test_given_servo_goes_into_the_run_file(tmp_path):
    own = 'servo = "13 ug/g^3"\nservo_damping = "13 ug/g^3"\nk0 = "3e-4 g"'
    path = written(tmp_path, terms=('k0 = "3e-4 g"', own), servo=(INSTRUMENT, INSTRUMENT + SERVO))
    scenario = read_scenario(path)
    test = run_scenario(scenario)
    table = tomllib.loads(run_file_text(scenario, test, "run.parquet"))
    assert table["instrument"]["servo"]["damping"]["standard"] == "0.005 N m s/rad"
    assert table["model"]["terms"] == ["scale_factor", "tan_beta", "k0"]
    run = saved(scenario, test, tmp_path)
    assert {p.name: (p.value, p.standard) for p in run.servo} == {
        "integral_gain": (3000.0, 0.0),
        "damping": (0.05, 0.005),
        "angular_momentum": (0.1, 0.0),
    }


@pytest.mark.long
def test_wrapping_counter_loses_its_phase_between_positions(tmp_path):
    path = written(tmp_path, bits=('serial = "S-1"', 'serial = "S-1"\ncounter_bits = 16'))
    scenario = read_scenario(path)
    test = run_scenario(scenario)
    run = saved(scenario, test, tmp_path)
    assert run.model.phases == "per-segment"
    cal = calibrate(run)
    phases = [c for c in cal.coefficients if c.name == "phi"]
    truth = truth_of(test)
    assert len(phases) == 6
    for c in phases:
        assert abs(math.remainder(c.value - truth["phi", c.segment], 2 * math.pi)) < 5 * c.std


def test_same_seed_same_bytes_other_seed_other_noise(tmp_path):
    noisy = written(tmp_path, noise=('zero = "0.5 rad"', 'angle_noise = "1e-4 rad"\nclock_jitter = "1 us"'))
    scenario = read_scenario(noisy)
    for name, seed in (("a", 4), ("b", 4), ("c", 5)):
        write_data(run_scenario(scenario, seed=seed), tmp_path / f"{name}.parquet")
    a, b, c = ((tmp_path / f"{name}.parquet").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_harmonics_are_true_in_the_zero_of_the_output(tmp_path):
    path = written(
        tmp_path, more=('k0 = "3e-4 g"', 'k0 = "3e-4 g"\ns2 = "1e-3 g"\nc2 = "-5e-4 g"\ns1 = "1e-4 g"')
    )
    scenario = read_scenario(path)
    test = run_scenario(scenario)
    truth = truth_of(test)
    alpha = np.linspace(0, 6, 50)
    own = 1e-3 * np.sin(2 * alpha) - 5e-4 * np.cos(2 * alpha)
    psi = alpha - 0.5
    assert truth["s2", None] * np.sin(2 * psi) + truth["c2", None] * np.cos(2 * psi) == pytest.approx(own)
    assert math.hypot(truth["s1", None], truth["c1", None]) == pytest.approx(1e-4)


@pytest.mark.long
def test_negative_beta_turns_the_phase(tmp_path):
    path = written(tmp_path, beta=('beta = "74 arcsec"', 'beta = "-74 arcsec"'))
    scenario = read_scenario(path)
    test = run_scenario(scenario)
    cal = calibrate(saved(scenario, test, tmp_path))
    assert cal["tan_beta"].value == pytest.approx(math.tan(74 * math.pi / 648000), abs=4 * cal["tan_beta"].std)
    assert math.remainder(cal["phi"].value - truth_of(test)["phi", None], 2 * math.pi) == pytest.approx(
        0.0, abs=4 * cal["phi"].std
    )


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('serial = "S-1"', 'serial = "S-1"\nmass = 3', "mass"),
        ('sample_rate = "10 Hz"', "", "sample_rate"),
        ('sample_rate = "10 Hz"', 'sample_rate = "10 m"', r"\[electronics\] sample_rate"),
        ('k0 = "3e-4 g"', 'k9 = "3e-4 g"', "k9"),
        ('k0 = "3e-4 g"', 'k0 = "3e-4 m"', r"\[truth\] k0"),
        ('k0 = "3e-4 g"', "tan_beta = 1e-3", "same thing"),
        ('positions = "0:360:60 deg"', 'positions = "0:360 deg"', "is not a range"),
        ('latitude = "40 deg"', 'latitude = "40"', r"\[stand\] latitude"),
        ('kind = "dividing-head"', 'kind = "swing"', "swing"),
        ('dwell = "20 s"', 'dwell = "0 s"', "must be positive"),
        ('move = "5 s"', 'move = "5 s"\n[imperfections]\narm_radius = "1 m"', "arm_radius"),
        ('move = "5 s"', 'move = "5 s"\n[twin]\ndampin = 1', r"\[twin\]"),
    ],
)
def test_scenario_errors_name_file_and_key(tmp_path, old, new, words):
    path = written(tmp_path, change=(old, new))
    with pytest.raises(RunFileError, match=words) as caught:
        read_scenario(path)
    assert "scenario.toml" in str(caught.value)


def test_a_log_of_rates_loses_its_phase_between_positions(tmp_path: Path) -> None:
    """One phase for all positions would be a tan_beta that is far too small, with a narrow interval."""
    path = written(tmp_path, rate=('sample_rate = "10 Hz"', 'sample_rate = "10 Hz"\noutput = "rate"'))
    scenario = read_scenario(path)
    test = run_scenario(scenario)
    run = saved(scenario, test, tmp_path)
    assert run.model.phases == "per-segment"
    truth = truth_of(test)
    assert not [name for name, _ in truth if name == "phi"]
    c = calibrate(run)["tan_beta"]
    assert abs(c.value - truth["tan_beta", None]) < 3.0 * c.std
    with pytest.raises(CalibrationError, match="a log of rates does not tell") as caught:
        calibrate(run, phases="shared")
    assert "per-segment" in caught.value.remedy
    assert calibrate(run, ["scale_factor", "k0"], phases="shared").terms == ("scale_factor", "k0")


@pytest.mark.parametrize(("output", "unit"), [("angle", "rad"), ("rate", "rad/s")])
def test_run_file_of_an_output_in_rad(tmp_path: Path, output: str, unit: str) -> None:
    path = written(tmp_path, rate=('sample_rate = "10 Hz"', f'sample_rate = "10 Hz"\noutput = "{output}"'))
    scenario = read_scenario(path)
    test = run_scenario(scenario)
    document = tomllib.loads(run_file_text(scenario, test, "run.parquet"))
    assert document["data"]["output"] | {"column": ""} == {"column": "", "kind": output, "unit": unit}
    assert "counts_per_revolution" not in document["instrument"]
    assert "local_error" not in truth_document(scenario, test)["simulation"]
