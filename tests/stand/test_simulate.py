"""Simulated tests: what is written is what was simulated, and calibration finds the truth again."""

import json
import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from typer.testing import CliRunner

from piga.calibration import calibrate
from piga.cli.main import app
from piga.earth import Site
from piga.errors import ArgumentError, PigaError, RunFileError
from piga.instrument import ErrorModel, Instrument
from piga.instrument.electronics import Electronics, Temperature
from piga.instrument.twin_linear import UnstableDesignError
from piga.instrument.twin_parameters import PRESETS
from piga.reports.figure import Figure
from piga.reports.page import page_html
from piga.reports.simulation import simulation_page, simulation_text
from piga.reports.simulation_figures import simulation_figures
from piga.stand import (
    Centrifuge,
    Composite,
    DividingHead,
    Drive,
    Imperfections,
    LoggedProfile,
    RateTable,
    Specimen,
    SpinPlan,
    VibrationTable,
    read_run,
    read_scenario,
    run_scenario,
    simulate_test,
)
from piga.stand.truth import coefficients, imperfection_values, predicted_angle_error
from piga.stand.write_run import log_table, run_file_text, truth_text, write_data
from piga.units import G0

pytestmark = pytest.mark.compiled

EXAMPLES = Path(__file__).parents[2] / "examples"
SCENARIOS = [
    path
    for path in sorted(EXAMPLES.glob("*.toml"))
    if "\n[stand]" in path.read_text(encoding="utf-8") and not path.name.startswith("plan-")
]
SITE = Site(math.radians(40.0), gravity=9.80166)
HEAD = DividingHead(SITE, (0.0, 1.0, 2.0, 4.0), dwell=20.0, move=5.0)
INST = Instrument("0.8884 rad/s/g", "74 arcsec", 0.8)
COUNTS = Electronics(sample_rate=10.0, zero=0.5)

SCENARIO = """
[instrument]
serial = "S-1"
scale_factor = "0.8884 rad/s/g"

[truth]
beta = "74 arcsec"
alpha0 = "0.8 rad"
k0 = "3e-4 g"

[electronics]
sample_rate = "10 Hz"
zero = "0.5 rad"

[stand]
kind = "dividing-head"
latitude = "40 deg"
positions = "0:360:60 deg"
dwell = "20 s"
move = "5 s"
"""


def written(tmp_path, text=SCENARIO, **changes):
    for old, new in changes.values():
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "scenario.toml"
    path.write_text(text, encoding="utf-8")
    return path


def truth_of(test):
    return {(v.name, v.segment): v.value for v in coefficients(test)}


def saved(scenario, test, folder):
    write_data(test, folder / "run.parquet")
    (folder / "run.toml").write_text(run_file_text(scenario, test, "run.parquet"), encoding="utf-8")
    return read_run(folder / "run.toml")


# -- motion -------------------------------------------------------------------------------------------


def test_log_holds_what_the_gimbal_did():
    test = simulate_test(HEAD, Specimen(INST), COUNTS)
    assert test.log.labels == ("0", "1", "2", "3")
    assert test.log.t.size == 4 * 201
    rows = np.searchsorted(test.profile.t, test.log.t - 1e-9)
    psi = test.log.output * 2 * math.pi / 72000
    assert np.abs(psi + 0.5 - test.alpha[rows]).max() <= math.pi / 72000 * 1.0001
    assert test.phases == (0.5,) * 4
    assert np.all(test.log.reference == test.profile.reference[rows])


def test_harmonics_of_the_gimbal_angle_enter_the_motion():
    """Second harmonic by iteration, against a direct integration."""
    harmonics = {1: (2e-3, 1e-3), 2: (3e-3, -1e-3)}
    stand = DividingHead(SITE, (0.3,), dwell=10.0, move=1.0)
    test = simulate_test(stand, Specimen(INST, harmonics=harmonics), COUNTS, step=2e-3)
    f, omega = test.profile.force[0], test.profile.base_rate[0]
    u = INST.scale_factor * f - omega

    def slope(_t, x):
        extra = sum(s * math.sin(n * x[0]) + c * math.cos(n * x[0]) for n, (s, c) in harmonics.items())
        pull = u[1] * math.sin(x[0]) - u[2] * math.cos(x[0])
        return [u[0] + INST.tan_beta * pull + INST.scale_factor * extra]

    truth = solve_ivp(slope, (0.0, 10.0), [0.8], method="DOP853", rtol=1e-12, atol=1e-12)
    assert test.alpha[-1] == pytest.approx(truth.y[0, -1], abs=1e-8)


def test_random_walk_enters_the_motion_exactly():
    """With rate noise the walked angle acts as phase: against an integration with the same increments."""
    stand = DividingHead(SITE, (1.0,), dwell=10.0, move=1.0)
    e = replace(COUNTS, angle_random_walk=1e-2, kind="angle")
    specimen = Specimen(Instrument("0.8884 rad/s/g", "2 deg", 0.8))
    test = simulate_test(stand, specimen, e, seed=3, step=0.01)
    plain = simulate_test(stand, specimen, replace(e, angle_random_walk=0.0), step=0.01)
    walk = np.concatenate([[0.0], np.cumsum(1e-3 * np.random.default_rng(3).spawn(4)[0].standard_normal(1000))])
    u = INST.scale_factor * test.profile.force - test.profile.base_rate
    tangent = specimen.instrument.tan_beta
    alpha = [0.8]
    for k in range(1000):
        parts = 50
        x = alpha[-1]
        for j in range(parts):
            w = walk[k] + (walk[k + 1] - walk[k]) * (j + 0.5) / parts - walk[k]
            mid = x + w
            x += (u[k, 0] + tangent * (u[k, 1] * math.sin(mid) - u[k, 2] * math.cos(mid))) * 0.01 / parts
        alpha.append(x + walk[k + 1] - walk[k])
    assert np.std(test.alpha - plain.alpha) > 1e-3
    assert test.alpha == pytest.approx(np.array(alpha), abs=1e-4)


def test_clock_errors_shift_the_samples():
    late = simulate_test(HEAD, Specimen(INST), replace(COUNTS, kind="angle", clock_offset=0.02))
    plain = simulate_test(HEAD, Specimen(INST), replace(COUNTS, kind="angle"))
    rate = np.interp(late.log.t, late.profile.t, late.rate)
    assert late.log.output - plain.log.output == pytest.approx(0.02 * rate, abs=2e-4)
    fast = simulate_test(
        HEAD, Specimen(INST), replace(COUNTS, kind="angle"), imperfections=Imperfections(timing=1e-3)
    )
    shift = fast.log.output - plain.log.output
    assert shift[100] == pytest.approx(1e-3 * fast.log.t[100] * rate[100], rel=1e-2)
    assert np.all(fast.log.t == plain.log.t)


def test_temperature_is_felt_and_logged_with_its_error():
    specimen = Specimen(INST, ErrorModel(k0_T="1e-4 g/K"))
    warm = simulate_test(
        HEAD,
        specimen,
        COUNTS,
        temperature=Temperature(303.15),
        imperfections=Imperfections(temperature=0.5),
    )
    assert warm.log.temperature == pytest.approx(302.65)
    plain = simulate_test(HEAD, Specimen(INST), COUNTS)
    assert (warm.alpha[-1] - plain.alpha[-1]) == pytest.approx(
        INST.scale_factor * 1e-3 * G0 * warm.profile.t[-1], rel=1e-2
    )


def test_bias_walk_and_rate_output():
    e = Electronics(sample_rate=10.0, kind="rate", bias_random_walk=1e-3)
    walked = simulate_test(HEAD, Specimen(INST), e)
    plain = simulate_test(HEAD, Specimen(INST), replace(e, bias_random_walk=0.0))
    assert np.std(walked.log.output - plain.log.output) > 1e-4
    assert plain.log.output[0] == pytest.approx(plain.rate[0])


# -- twin ---------------------------------------------------------------------------------------------


def test_twin_takes_k_beta_and_start_from_the_instrument():
    specimen = Specimen(INST, twin=PRESETS["example"])
    assert (specimen.design.K, specimen.design.pick_off_null, specimen.design.alpha0) == (
        pytest.approx(INST.scale_factor),
        INST.beta,
        0.8,
    )
    stand = DividingHead(SITE, (0.0,), dwell=1.0, move=1.0)
    test = simulate_test(stand, specimen, COUNTS, model="twin")
    assert test.motion is not None
    assert test.alpha[0] == 0.8
    assert test.rate[-1] == pytest.approx(INST.scale_factor * 9.80166, rel=1e-4)


def test_twin_refuses_what_it_cannot_do():
    with pytest.raises(ArgumentError, match=r"needs \[twin\] parameters"):
        simulate_test(HEAD, Specimen(INST), COUNTS, model="twin")
    unstable = Specimen(INST, twin=replace(PRESETS["example"], proportional_gain=300.0))
    with pytest.raises(UnstableDesignError, match="unstable"):
        simulate_test(HEAD, unstable, COUNTS, model="twin")
    with pytest.raises(ArgumentError, match="makes its own"):
        simulate_test(HEAD, Specimen(INST, ErrorModel(s1=1e-3), twin=PRESETS["example"]), COUNTS, model="twin")


def test_unstable_design_runs_when_forced():
    unstable = Specimen(INST, twin=replace(PRESETS["example"], proportional_gain=120.0))
    stand = DividingHead(SITE, (0.0,), dwell=0.1, move=1.0)
    test = simulate_test(stand, unstable, COUNTS, model="twin", force=True)
    assert np.all(np.isfinite(test.alpha))


def test_random_walk_of_the_twin_has_the_stated_level():
    stand = DividingHead(SITE, (0.0,), dwell=2.0, move=1.0)
    specimen = Specimen(Instrument("0.8884 rad/s/g"), twin=PRESETS["example-stiff"])
    e = replace(COUNTS, angle_random_walk=1e-4)
    noisy = simulate_test(stand, specimen, e, model="twin", seed=2, step=0.01)
    plain = simulate_test(stand, specimen, COUNTS, model="twin", step=0.01)
    increments = np.diff(noisy.alpha - plain.alpha)
    assert increments.std() == pytest.approx(1e-4 * math.sqrt(0.01), rel=0.15)


# -- round trips ------------------------------------------------------------------------------------------


SHORT = {
    "dividing-head": (DividingHead(SITE, tuple(0.15 + np.arange(12) * math.pi / 6), 20.0, 5.0), 20.0),
    "centrifuge": (Centrifuge(SITE, 1.0, SpinPlan((3.0, 6.0, 9.0, 5.0), 20.0, 5.0)), 50.0),
    "rate-table": (
        RateTable(SITE, SpinPlan((0.05, 0.1, -0.1), 40.0, 10.0), along="Z0", horizontal=True),
        100.0,
    ),
    "vibration-table": (
        VibrationTable(
            SITE, (Drive("rest", 10.0), Drive("sine", 40.0, 0.3, amplitude=5.0)), axis="Y0", up="X0"
        ),
        50.0,
    ),
    "composite": (
        Composite(
            (
                DividingHead(SITE, (0.0, 1.0, 2.5), 20.0, 5.0),
                Centrifuge(SITE, 1.0, SpinPlan((4.0, 8.0), 20.0, 5.0)),
            ),
            10.0,
        ),
        50.0,
    ),
}
_TIMES = np.arange(0.0, 120.5, 0.5)
_SWING = np.column_stack(
    [1.0 + 0.4 * np.sin(0.2 * _TIMES), 0.5 * np.cos(0.13 * _TIMES), 0.3 * np.sin(0.17 * _TIMES)]
)
SHORT["profile"] = (LoggedProfile(_TIMES, 9.80665 * _SWING, np.full((_TIMES.size, 3), 4e-5)), 50.0)

TERMS = {
    "profile": ["scale_factor", "tan_beta", "k0"],
    "dividing-head": ["scale_factor", "tan_beta", "k0", "k2"],
    "centrifuge": ["scale_factor", "tan_beta", "k0", "k2"],
    "rate-table": ["scale_factor", "tan_beta", "k0"],
    "vibration-table": ["tan_beta", "k0"],
    "composite": ["scale_factor", "tan_beta", "k0", "k2"],
}


def run_record(test, folder, terms):
    """The test as a lab would hand it over, read back."""
    path = folder / "scenario.toml"
    path.write_text(SCENARIO, encoding="utf-8")
    scenario = read_scenario(path)
    table = replace_struct(scenario.table, model={"terms": terms})
    return saved(replace(scenario, table=table), test, folder)


def replace_struct(struct, **changes):
    import msgspec

    return msgspec.structs.replace(struct, **changes)


def scores(cal, test):
    """Error and uncertainty by name; tan beta and its phase as one complex coefficient."""
    truth = truth_of(test)
    result = {
        c.key: (c.value - truth.get((c.name, c.segment), 0.0), c.std)
        for c in cal.coefficients
        if c.name not in ("tan_beta", "phi")
    }
    size, phase = cal["tan_beta"], cal["phi"]
    error = size.value * np.exp(1j * phase.value) - truth["tan_beta", None] * np.exp(1j * truth["phi", None])
    return result | {"coupling": (error, math.hypot(size.std, size.value * phase.std))}


@pytest.mark.parametrize("kind", SHORT)
def test_calibration_finds_the_truth_of_every_stand(kind, tmp_path):
    stand, sample_rate = SHORT[kind]
    model = ErrorModel(k0="3e-4 g", k2="4e-6 g/g^2" if "k2" in TERMS[kind] else 0.0)
    e = Electronics(sample_rate=sample_rate, zero=0.5, angle_random_walk=1e-6)
    test = simulate_test(stand, Specimen(INST, model), e, seed=11)
    cal = calibrate(run_record(test, tmp_path, TERMS[kind]))
    for key, (error, std) in scores(cal, test).items():
        assert abs(error) < 4.0 * std, key


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="minutes of twin need compiled code")
@pytest.mark.parametrize("kind", SHORT)
def test_calibration_of_a_twin_run_is_off_by_the_predicted_model_error(kind, tmp_path):
    """Within the uncertainty plus the predicted model error; taken off first, within the uncertainty."""
    stand, sample_rate = SHORT[kind]
    twin = replace(PRESETS["example-stiff"], product_of_inertia=1e-6 if "k2" in TERMS[kind] else 0.0)
    e = Electronics(sample_rate=sample_rate, zero=0.5, angle_noise=3e-5, angle_random_walk=1e-6)
    model = ErrorModel(k0="3e-4 g")
    test = simulate_test(stand, Specimen(INST, model, twin=twin), e, model="twin", step=0.005)
    run = run_record(test, tmp_path, TERMS[kind])
    raw = scores(calibrate(run), test)
    corrected = scores(calibrate(replace(run, output=run.output - predicted_angle_error(test))), test)
    for key, (error, std) in corrected.items():
        model_error = raw[key][0] - error
        assert abs(error) < 4.0 * std + 0.1 * abs(model_error), key
        assert abs(raw[key][0]) < 4.0 * std + 1.2 * abs(model_error), key


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="minutes of twin need compiled code")
def test_second_harmonic_of_a_soft_servo_shows_at_order_two(tmp_path):
    from piga.reports.calibration_figures import order_spectrum, scale_factor

    stand = DividingHead(SITE, (math.pi / 4, 7 * math.pi / 4), dwell=120.0, move=5.0)
    soft = replace(PRESETS["example"], integral_gain=0.0)
    e = Electronics(sample_rate=20.0)
    test = simulate_test(stand, Specimen(INST, twin=soft), e, model="twin")
    cal = calibrate(run_record(test, tmp_path, ["tan_beta", "k0"]))
    spectrum = order_spectrum(cal.residuals, scale_factor(cal))
    amplitude = np.nan_to_num(spectrum.after)
    assert spectrum.order[int(np.argmax(amplitude))] == pytest.approx(2.0, abs=0.15)


# -- files ------------------------------------------------------------------------------------------------


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
    document = json.loads(truth_text(scenario, test))
    assert document["schema"] == "piga.truth/1"
    names = {c["name"]: c for c in document["coefficients"]}
    assert names["tan_beta"]["value"] == pytest.approx(math.tan(74 * math.pi / 648000))
    assert names["phi"] == {"name": "phi", "value": pytest.approx(0.5), "unit": "rad", "segment": None}
    assert names["k0"]["unit"] == "g"
    table = tomllib.loads(run_file_text(scenario, test, "run.parquet"))
    assert table["model"] == {"terms": ["scale_factor", "tan_beta", "k0"], "phase": "shared"}


def test_wrapping_counter_loses_its_phase_between_positions(tmp_path):
    path = written(tmp_path, bits=('serial = "S-1"', 'serial = "S-1"\ncounter_bits = 16'))
    scenario = read_scenario(path)
    test = run_scenario(scenario)
    run = saved(scenario, test, tmp_path)
    assert run.model.phase == "per-segment"
    cal = calibrate(run)
    phases = [c for c in cal.coefficients if c.name == "phi"]
    truth = truth_of(test)
    assert len(phases) == 6
    for c in phases:
        assert abs(math.remainder(c.value - truth["phi", c.segment], 2 * math.pi)) < 5 * c.std


def test_csv_holds_the_same_as_parquet(tmp_path):
    from pyarrow import csv

    test = run_scenario(read_scenario(written(tmp_path)))
    write_data(test, tmp_path / "run.csv")
    table, own = csv.read_csv(tmp_path / "run.csv"), log_table(test)
    for name in own.column_names:
        assert np.array_equal(table[name].to_numpy(), own[name].to_numpy())


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


def test_negative_beta_turns_the_phase(tmp_path):
    path = written(tmp_path, beta=('beta = "74 arcsec"', 'beta = "-74 arcsec"'))
    scenario = read_scenario(path)
    test = run_scenario(scenario)
    cal = calibrate(saved(scenario, test, tmp_path))
    assert cal["tan_beta"].value == pytest.approx(math.tan(74 * math.pi / 648000), abs=4 * cal["tan_beta"].std)
    assert math.remainder(cal["phi"].value - truth_of(test)["phi", None], 2 * math.pi) == pytest.approx(
        0.0, abs=4 * cal["phi"].std
    )


def test_drawn_imperfections_come_from_the_seed(tmp_path):
    extra = '\n[imperfections]\nreference_scale = "10 ppm"\n[run]\nimperfections = "drawn"\n'
    scenario = read_scenario(written(tmp_path, SCENARIO + extra))
    values = [imperfection_values(scenario.imperfections(seed))[0].value for seed in (1, 1, 2)]
    assert values[0] == values[1] != values[2]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('serial = "S-1"', 'serial = "S-1"\nmass = 3', "mass"),
        ('sample_rate = "10 Hz"', "", "sample_rate"),
        ('sample_rate = "10 Hz"', 'sample_rate = "10 m"', r"\[electronics\] sample_rate"),
        ('k0 = "3e-4 g"', 'k9 = "3e-4 g"', "k9"),
        ('k0 = "3e-4 g"', 'k0 = "3e-4 m"', r"\[truth\] k0"),
        ('k0 = "3e-4 g"', "tan_beta = 1e-3", "same thing"),
        ('positions = "0:360:60 deg"', 'positions = "0:360 deg"', "no range"),
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


def test_errors_while_running_name_the_file(tmp_path):
    path = written(tmp_path, rate=('sample_rate = "10 Hz"', 'sample_rate = "0.3 Hz"'))
    with pytest.raises(PigaError, match=r"scenario.toml: segment 'move to 1' lasts"):
        run_scenario(read_scenario(path))


# -- page and command ------------------------------------------------------------------------------------------


def test_page_shows_stand_output_servo_and_truth():
    stand = DividingHead(SITE, (0.0, 1.0), dwell=1.0, move=1.0)
    specimen = Specimen(INST, twin=replace(PRESETS["example"], torque_limit=0.01))
    test = simulate_test(stand, specimen, COUNTS, model="twin", imperfections=Imperfections(gravity=1e-5))
    keys = [figure.key for figure in simulation_figures(test)]
    assert keys == ["stand", "imperfections", "output", "servo", "loop-bode", "loop-step", "loop-poles"]
    for figure in simulation_figures(test):
        assert isinstance(figure, Figure)
        assert all(panel.x.quantity and panel.y.quantity for panel in figure.panels)
    html = page_html(simulation_page(test, "S-1"))
    for words in ("Simulated test of S-1", "pendulosity", "gravity", "tan_beta"):
        assert words in html
    assert "servo twin" in simulation_text(test)


def test_command_writes_all_files_and_json(tmp_path):
    path = written(tmp_path)
    result = CliRunner().invoke(app, ["simulate", str(path), "--out", str(tmp_path / "out"), "--json"])
    assert result.exit_code == 0
    assert json.loads(result.stdout)["schema"] == "piga.truth/1"
    names = {p.name for p in (tmp_path / "out").iterdir()}
    assert names == {"run.toml", "run.parquet", "truth.json", "report.html"}
    assert calibrate(read_run(tmp_path / "out" / "run.toml"))["k0"].value == pytest.approx(3e-4, abs=1e-5)


def test_command_says_what_was_simulated(tmp_path):
    result = CliRunner().invoke(
        app, ["simulate", str(written(tmp_path)), "--out", str(tmp_path), "--seed", "7"]
    )
    assert result.exit_code == 0
    assert "tan_beta" in result.stdout
    assert "seed 7" in (tmp_path / "run.toml").read_text()
