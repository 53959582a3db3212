"""The terms of the servo against integrations by SciPy: exact columns, phases, what a record cannot tell."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from piga._kernels.estimation import servo_columns
from piga.calibration import RunSummary
from piga.calibration.calibrate import calibrate
from piga.errors import ArgumentError, CalibrationError, IdentifiabilityError, RunFileError, UnitError
from piga.records.run_file import Given, GivenParameter, ServoTable
from piga.units import G0
from tests.calibration.made.servo_data import (
    PHI,
    SERVO_LEFT,
    STIFFNESS,
    TERMS,
    TRUTH,
    UNNAMED,
    K,
    half_width,
    head,
    known_noise,
    levels,
    rate,
    recorded,
)


def check(result, truth, tolerance, names=None):
    for name in names or truth:
        assert result[name].value == pytest.approx(truth[name], abs=tolerance[name]), name


EXACT = {
    "scale_factor": 3e-9, "tan_beta": 3e-9, "phi": 1e-5, "k0": 3e-9, "k2": 3e-9, "m_Y": 3e-9, "servo": 1e-8,
    "servo_damping": 1e-8,
}  # fmt: skip
"""The columns miss what the output departs from its chord between samples (tan_beta squared)."""


def test_sag_of_the_output_turns_the_columns():
    one, psi, h, sag = np.full(2, 2.0), np.array([0.3, 1.2]), np.array([0.5]), 1e-5
    flat, bent = np.empty((5, 1)), np.empty((5, 1))
    servo_columns(psi, one, one, -one, h, np.zeros(1), flat)
    servo_columns(psi, one, one, -one, h, np.array([sag]), bent)

    def moved(order, size):
        def value(v):
            p = psi[0] + v * (psi[1] - psi[0]) + sag * (1.0 - (2.0 * v - 1.0) ** 2)
            return np.exp(-1j * order * p)

        parts = [quad(lambda v, part=part: getattr(value(v), part), 0.0, 1.0)[0] for part in ("real", "imag")]
        return h[0] * size * (parts[0] + 1j * parts[1])

    side = 2.0 - 2.0j
    second, first = moved(2, 2.0 * side**2), moved(1, 4.0 * side)
    change = bent[:, 0] - flat[:, 0]
    exact = np.array([0.0, second.real, -second.imag, first.real, first.imag]) - [0.0, *flat[1:, 0]]
    assert change == pytest.approx(exact, abs=1e-3 * np.abs(exact).max())
    assert np.abs(exact).max() > 1e-5


@pytest.mark.parametrize("method", ["information", "rate"])
def test_head_gives_every_coefficient_back(method):
    calibration = calibrate(known_noise(recorded(head())), TERMS, method)
    check(calibration, TRUTH, EXACT)


@pytest.mark.long
def test_turning_base_and_the_pulling_across_it():
    base = np.tile([0.1, -0.3, 0.25], (8, 1)) * np.linspace(0.5, 1.0, 8)[:, None]
    calibration = calibrate(known_noise(recorded(head(8), seconds=8.0, base=base)), TERMS)
    check(calibration, TRUTH, {name: 2.0 * size for name, size in EXACT.items()})


@pytest.mark.long
def test_log_of_rates():
    run = recorded(head(8), seconds=8.0, step=0.125)
    alpha = run.output + PHI
    rates = np.array([rate(a, f, np.zeros(3)) for a, f in zip(alpha, run.f, strict=True)])
    log = replace(run, kind="rate", output=rates)
    calibration = calibrate(log, TERMS[:-1], phases="per-segment")  # the phases take up the damping
    for name in ("scale_factor", "servo"):
        assert calibration[name].value == pytest.approx(
            TRUTH[name], rel=5e-3 if name != "scale_factor" else 1e-7
        )


def test_phase_of_its_own_in_each_segment():
    phases = np.linspace(-2.0, 2.5, 8)
    run = recorded(head(8), seconds=8.0, phases=phases, d=0.0)
    calibration = calibrate(known_noise(run), TERMS[:-1], phases="per-segment")
    check(calibration, TRUTH, EXACT, list(TERMS[:-1]))
    own = [c.value for c in calibration.coefficients if c.name == "phi"]
    assert np.abs(np.angle(np.exp(1j * (own - phases)))).max() < 1e-4


def test_k3_beside_servo_is_refused_on_a_head():
    with pytest.raises(IdentifiabilityError, match=r"cannot separate scale_factor, k3, servo") as refused:
        calibrate(known_noise(recorded(head(8))), [*TERMS[:-2], "k3", "servo"])
    assert "centrifuge" in refused.value.remedy
    assert "k3 g^2" in refused.value.remedy


def test_scale_factor_beside_servo_is_refused_where_the_transverse_force_is_constant():
    run = recorded(levels(), seconds=4.0, step=0.01)
    with pytest.raises(IdentifiabilityError, match="cannot separate scale_factor, servo") as refused:
        calibrate(known_noise(run), ["scale_factor", "tan_beta", "k0", "servo"])
    assert "dividing head" in refused.value.remedy
    assert "[instrument] servo" in refused.value.remedy


def test_damping_is_refused_where_it_turns_nothing_else_than_the_phase():
    run = recorded(levels((-8.0, 8.0)), seconds=4.0, step=0.01)
    with pytest.raises(IdentifiabilityError, match="tan_beta, servo_damping") as refused:
        calibrate(known_noise(run), ["scale_factor", "tan_beta", "k0", "servo_damping"])
    assert "|a_x|" in refused.value.remedy
    own = recorded(head(8), phases=np.linspace(-2.0, 2.5, 8))
    with pytest.raises(IdentifiabilityError, match="tan_beta, servo_damping") as refused:
        calibrate(known_noise(own), TERMS, phases="per-segment")
    assert "shared" in refused.value.remedy


def test_servo_needs_the_phase_of_tan_beta_and_belongs_to_the_instrument():
    run = recorded(head(3))
    with pytest.raises(CalibrationError, match="'servo' depends on the output angle"):
        calibrate(run, ["scale_factor", "k0", "servo"])
    with pytest.raises(ArgumentError, match="servo"):
        calibrate(run, TERMS, per_run=["servo"])


def joint_runs():
    """A head run, and a centrifuge run whose zero of the output is elsewhere."""
    across = recorded(levels(), seconds=4.0, step=0.02)
    first = known_noise(replace(recorded(head(8), seconds=8.0), input_sha256={"head": "1"}))
    return [first, known_noise(replace(across, output=across.output - 0.9, input_sha256={"arm": "2"}))]


@pytest.mark.long
def test_head_and_centrifuge_together_separate_what_neither_can(tmp_path):
    runs = joint_runs()
    terms = ["scale_factor", "tan_beta", "k0", "k2", "k3", "m_Y", "servo", "servo_damping"]
    calibration = calibrate(runs, terms, per_run=[])
    check(
        calibration,
        TRUTH | {"k3": 0.0},
        EXACT | {"k3": 1e-9},
        ["scale_factor", "tan_beta", "k0", "k2", "k3", *TERMS[-2:]],
    )
    own = [c.value for c in calibration.coefficients if c.name == "phi"]
    assert own == pytest.approx([PHI, PHI + 0.9], abs=1e-5)
    assert any(
        "run 1" in note and "servo" in note and "alone cannot" in note
        for note in (*calibration.notes, *calibration.remarks)
    )
    stored = RunSummary.of(runs[0], terms, name="head")
    stored.to_json(tmp_path / "head.json")
    again = calibrate([RunSummary.from_json(tmp_path / "head.json"), runs[1]], terms, per_run=[])
    for name in ("scale_factor", "tan_beta", "servo", "servo_damping", "k3"):
        assert again[name].value == pytest.approx(calibration[name].value, rel=1e-9, abs=1e-12)
        assert again[name].std == pytest.approx(calibration[name].std, rel=1e-6)
    with pytest.raises(
        IdentifiabilityError, match=r"these 2 runs together cannot separate scale_factor, servo"
    ):
        calibrate(
            [runs[1], replace(runs[1], input_sha256={"other": "3"})],
            ["scale_factor", "tan_beta", "k0", "servo"],
        )


def on_a_head(terms, s=STIFFNESS, positions=12):
    """Calibration of a noisy head record whose damping is nothing, its noise given."""
    run = recorded(head(positions), seconds=8.0, noise=2e-7, s=s, d=0.0)
    return calibrate(known_noise(run, angle="2e-7 rad"), terms)


@pytest.mark.long
def test_doing_nothing_holds_both_meanings_of_a_cube():
    calibration = on_a_head(TERMS[:5])
    scale = calibration["scale_factor"]
    half = half_width(calibration, SERVO_LEFT)
    by_k3 = TRUTH["scale_factor"] * (1.0 - 1.3e-5)
    for meaning in (TRUTH["scale_factor"], by_k3):
        assert abs(scale.value - meaning) < 1.05 * half
        assert abs(scale.value - meaning) < scale.expanded
    assert scale.value - half == pytest.approx(by_k3, rel=1e-6)
    assert calibration.diagnostics.missing_terms[0].terms == ("servo",)
    said = (*calibration.notes, *calibration.remarks)
    (note,) = (note for note in said if "servo = 1.3e-05" in note)
    scales = [float(re.search(rf"{where} (0\.\d+)", note)[1]) for where in ("scale_factor", "of servo:")]
    assert scales == pytest.approx([TRUTH["scale_factor"], by_k3], rel=1e-6)
    assert not any("missing term: k3" in note for note in said)


def test_a_sound_record_has_no_such_row():
    calibration = on_a_head(TERMS[:5], s=0.0)
    assert [row.source for row in calibration.budget][1:] == [UNNAMED]
    assert not calibration.diagnostics.missing_terms


@pytest.mark.long
def test_an_asked_k3_is_a_choice_of_meaning_and_k_holds_both():
    calibration = on_a_head([*TERMS[:5], "k3"], positions=8)
    scale = calibration["scale_factor"]
    assert scale.value == pytest.approx(TRUTH["scale_factor"] * (1.0 - 1.3e-5), rel=2e-6)
    assert abs(scale.value - TRUTH["scale_factor"]) < scale.expanded
    row = next(row for row in calibration.budget if row.source == UNNAMED)
    half = np.sqrt(3.0) * row.contributions["scale_factor"]
    assert half == pytest.approx(TRUTH["scale_factor"] - scale.value, rel=0.05)
    assert not any(size for key, size in row.contributions.items() if key != "scale_factor")


@pytest.mark.long
def test_an_asked_k3_beside_a_given_servo_means_itself():
    stiff = replace(SERVO[0], value=1e5, standard=0.0)
    run = replace(recorded(head(8), seconds=8.0, noise=2e-7, d=0.0), servo=(stiff, SERVO[2]))
    calibration = calibrate(known_noise(run, angle="2e-7 rad"), [*TERMS[:5], "k3"])
    assert abs(calibration["k3"].value) > 2.0 * calibration["k3"].std
    assert UNNAMED not in [row.source for row in calibration.budget]


@pytest.mark.long
def test_phi_holds_the_damping_that_the_model_lacks():
    terms = [*TERMS[:5], "servo"]
    run = recorded(head(), seconds=8.0, noise=2e-6)
    calibration = calibrate(known_noise(run, angle="2e-6 rad"), terms)
    phi = calibration["phi"]
    row = next(row for row in calibration.budget if row.source == SERVO_LEFT)
    plain = calibration.budget[0].contributions["phi"]
    assert abs(phi.value - PHI) < phi.expanded
    assert row.contributions["phi"] > 0.5 * plain
    assert any("show servo_damping = " in note and "cover this" in note for note in calibration.notes)
    whole = calibrate(known_noise(run, angle="2e-6 rad"), TERMS)
    assert SERVO_LEFT not in [row.source for row in whole.budget]
    assert whole["phi"].std < 0.3 * phi.std


SERVO = (
    GivenParameter("integral_gain", 3000.0, 60.0, "N m/(rad s)"),
    GivenParameter("damping", 0.1, 0.01, "N m s/rad"),
    GivenParameter("angular_momentum", 0.1, 0.0, "kg m^2/s"),
)
"""Parameters of a servo: s = K^2 H/(2 k_i), d = c K^2/k_i."""
S, D = K**2 * 0.1 / 6000.0, 0.1 * K**2 / 3000.0


@pytest.mark.long
def test_given_parameters_are_a_known_part_of_the_model_with_their_uncertainty():
    run = known_noise(replace(recorded(head(8), seconds=8.0, s=S, d=D), servo=SERVO))
    calibration = calibrate(run, TERMS[:5])
    check(calibration, TRUTH, {name: 3.0 * size for name, size in EXACT.items()}, TERMS[:5])
    assert calibration.terms == tuple(TERMS)
    assert calibration["servo"].value == pytest.approx(S * G0**2, rel=1e-3)
    assert calibration["servo"].std == pytest.approx(0.02 * S * G0**2, rel=0.05)
    assert calibration["servo_damping"].std == pytest.approx(np.hypot(0.02, 0.1) * D * G0**2, rel=0.05)
    rows = {row.source: row.contributions for row in calibration.budget}
    assert set(rows) == {"fit residuals (repeatability)", "servo integral gain", "servo damping"}
    shift = 0.25 * S * G0**2 * TRUTH["scale_factor"]
    assert rows["servo integral gain"]["scale_factor"] == pytest.approx(-0.02 * shift, rel=0.1)
    assert abs(rows["servo damping"]["phi"]) > 2.0 * abs(rows["servo integral gain"]["phi"])
    total = np.sqrt(sum(row["servo_damping"] ** 2 for row in rows.values()))
    assert total == pytest.approx(calibration["servo_damping"].std)


def test_phases_of_segments_beside_a_given_damping() -> None:
    """The sign of the coupling is no choice there: each phase would be off by twice what the damping turns it."""
    for seed in range(4):
        phases = np.random.default_rng(seed).uniform(-3.0, 3.0, 12)
        run = recorded(head(12), seconds=10.0, phases=phases, noise=2e-5, seed=seed, s=S, d=D)
        for terms in (TERMS[:5], TERMS[:6]):
            result = calibrate(replace(run, servo=SERVO), terms, phases="per-segment")
            own = np.array([(c.value, c.expanded) for c in result.coefficients if c.name == "phi"])
            away = np.angle(np.exp(1j * (own[:, 0] - phases)))
            assert np.mean(np.abs(away) > own[:, 1]) < 0.25


def test_a_given_servo_beside_harmonics_without_a_coupling() -> None:
    run = replace(recorded(head(8), seconds=8.0, s=S, d=D), servo=SERVO)
    assert calibrate(run, ["scale_factor", "k0", "s2", "c2"])["s2"].std > 0.0
    with pytest.raises(CalibrationError, match="tan_beta"):
        calibrate(run, ["scale_factor", "k0", "s2", "c2"], phases="per-segment")


@pytest.mark.long
def test_what_is_asked_for_is_estimated_even_where_it_is_given():
    wrong = (replace(SERVO[0], value=1500.0), *SERVO[1:])
    run = known_noise(replace(recorded(head(8), seconds=8.0, s=S, d=D), servo=wrong))
    calibration = calibrate(run, TERMS)
    assert calibration["servo"].value == pytest.approx(S * G0**2, abs=1e-8)
    assert [row.source for row in calibration.budget] == ["fit residuals (repeatability)"]


@pytest.mark.parametrize(
    ("servo", "message"),
    [
        ({"integral_gain": "3000 N m/(rad s)"}, "one of pendulosity and angular_momentum"),
        ({"integral_gain": "-1 N m/(rad s)", "pendulosity": "0.009 kg m"}, "integral_gain: must be positive"),
        ({"integral_gain": "3 N m", "pendulosity": "0.009 kg m"}, "integral_gain"),
        (
            {"integral_gain": Given(value="3 N m/(rad s)", standard="-1 N m/(rad s)"), "pendulosity": "1 kg m"},
            "is negative",
        ),
    ],
)
def test_faults_of_the_servo_table_are_named(servo, message):
    with pytest.raises((RunFileError, UnitError), match=message):
        ServoTable(**servo).parameters()


def test_servo_table_in_si():
    table = ServoTable(
        Given(value="3 N m/(rad s)", half_width="0.3 N m/(rad s)", distribution="rectangular"),
        pendulosity="9e-3 kg m",
    )
    gain, lever = table.parameters()
    assert (gain.value, gain.distribution) == (3.0, "rectangular")
    assert gain.standard == pytest.approx(0.3 / np.sqrt(3.0))
    assert lever.name == "pendulosity"
