"""Calibration end to end on synthetic records with known truth."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

import piga
from piga.records.run_file import EstimationTable
from piga.units import G0
from tests.calibration.made.independent import Bench, head
from tests.calibration.made.synthetic import BETA, SCALE, TERMS, TRUTH, at_rest, errors, record

pytestmark = pytest.mark.long

FEW = ["scale_factor", "k0"]
NOISES = {
    "white": {"white": 2.5e-5},
    "walk": {"white": 1e-9, "walk": 3e-5},
    "mixed": {"white": 2.5e-5, "walk": 2e-5},
    "counts": {"white": 1e-6, "count_angle": 2.0 * np.pi / 72000},
}


@pytest.mark.parametrize(
    ("noise", "method"),
    [*((noise, "information") for noise in NOISES), ("mixed", "rate")],
)
def test_truth_is_recovered_within_its_uncertainty(noise: str, method: str) -> None:
    run = record(np.random.default_rng(11), **NOISES[noise])
    calibration = piga.calibrate(run, TERMS, method)
    assert all(abs(z) < 4.0 for z in errors(calibration).values()), errors(calibration)
    assert calibration["tan_beta"].std < 4e-6
    assert calibration.surplus_observations == run.size - len(run.labels) - 6
    assert noise == "counts" or 0.5 < calibration.diagnostics.segment_scatter_ratio < 1.5


def test_per_segment_phases_share_tan_beta() -> None:
    run = record(np.random.default_rng(13))
    calibration = piga.calibrate(run, TERMS, phases="per-segment")
    assert all(abs(z) < 4.0 for z in errors(calibration).values())
    phases = [c for c in calibration.coefficients if c.name == "phi"]
    assert [c.segment for c in phases] == list(run.labels)
    assert calibration["phi[0]"].value == pytest.approx(TRUTH["phi"], abs=5.0 * calibration["phi[0]"].std)
    with pytest.raises(KeyError, match="no coefficient 'k9'"):
        calibration["k9"]


def test_rate_log() -> None:
    rng = np.random.default_rng(15)
    t = np.arange(20_001) * 0.01
    f = G0 * np.column_stack([1.0 + np.sin(0.3 * t), 3.0 * np.cos(0.2 * t), 0.5 + 0.0 * t])
    inst = piga.Instrument(scale_factor=SCALE, beta=BETA)
    _, rate = piga.propagate(inst, t, f, with_rate=True, between="linear")
    run = piga.Run.from_arrays(
        t, rate + 1e-5 * rng.standard_normal(t.size), f, scale_factor=SCALE, kind="rate", units="SI"
    )
    calibration = piga.calibrate(run, ["scale_factor", "tan_beta", "k0"])
    assert calibration["tan_beta"].value == pytest.approx(np.tan(BETA), abs=4.0 * calibration["tan_beta"].std)
    assert calibration["scale_factor"].value == pytest.approx(0.8884, abs=4.0 * calibration["scale_factor"].std)
    assert abs(calibration["k0"].value) < 4.0 * calibration["k0"].std
    assert calibration.angle_random_walk == pytest.approx(1e-5 * 0.1, rel=0.03)


def test_every_term_of_the_error_model() -> None:
    """A made-up record holding every term at once, noiseless, is solved to the interpolation error."""
    t = np.arange(400 * 50 * 8 + 1) * 0.0025
    f = G0 * np.column_stack(
        [np.sin(0.5 * t) + 0.7 * np.sin(0.13 * t), np.cos(0.21 * t) * 1.5, np.sin(0.34 * t + 1.0)]
    )
    temperature = 293.15 + 8.0 * np.sin(0.017 * t)
    truth = {"k0": 1e-3, "k2": 2e-4, "k3": -5e-5, "k2o": 3e-4, "m_Y": 1e-4, "m_Z": -2e-4, "k_XY": 1e-4}
    truth |= {"k_XZ": 3e-5, "k_YY": -4e-5, "k_ZZ": 6e-5, "k_YZ": 7e-5, "k0_t": 1e-7, "k0_T": 2e-5, "k1_T": 3e-5}
    truth |= {"s1": 2e-4, "c1": -1e-4, "s2": 1e-4, "c2": 5e-5}
    x, y, z = f.T / G0
    dT, middle = temperature - 293.15, t - 0.5 * (t[0] + t[-1])
    force = truth["k0"] + truth["k2"] * x**2 + truth["k3"] * x**3 + truth["k2o"] * x * abs(x)
    force += truth["m_Y"] * y + truth["m_Z"] * z + truth["k_XY"] * x * y + truth["k_XZ"] * x * z
    force += truth["k_YY"] * y**2 + truth["k_ZZ"] * z**2 + truth["k_YZ"] * y * z
    force += truth["k0_t"] * middle + truth["k0_T"] * dT + truth["k1_T"] * x * dT
    alpha = _integrate_with_harmonics(0.0025, f, force * G0, truth)[::4]
    run = piga.Run.from_arrays(
        t[::8], alpha - 0.4, f[::8], scale_factor=SCALE, temperature=temperature[::8], units="SI"
    )
    calibration = piga.calibrate(run, ["scale_factor", "tan_beta", *truth])
    for name, value in truth.items():
        assert calibration[name].value == pytest.approx(value, abs=2e-7), name
    assert calibration["tan_beta"].value == pytest.approx(np.tan(BETA), abs=2e-7)
    assert calibration["phi"].value == pytest.approx(0.4, abs=1e-3)


def _integrate_with_harmonics(step, f, force, truth):
    """Independent Runge-Kutta integration of equation (1) with the error terms, over two samples of ``step`` [s] each."""
    K, tangent = 0.8884 / G0, np.tan(BETA)

    def rate(alpha: float, v: np.ndarray, e: float) -> float:
        s, c = np.sin(alpha), np.cos(alpha)
        ripple = (
            truth["s1"] * s
            + truth["c1"] * c
            + truth["s2"] * np.sin(2 * alpha)
            + truth["c2"] * np.cos(2 * alpha)
        )
        return K * (v[0] + tangent * (v[1] * s - v[2] * c) + e + ripple * G0)

    alpha, h = [0.4], 2.0 * step
    for i in range(0, len(force) - 2, 2):
        now = alpha[-1]
        k1 = rate(now, f[i], force[i])
        k2 = rate(now + 0.5 * h * k1, f[i + 1], force[i + 1])
        k3 = rate(now + 0.5 * h * k2, f[i + 1], force[i + 1])
        k4 = rate(now + h * k3, f[i + 2], force[i + 2])
        alpha.append(now + h * (k1 + 2 * k2 + 2 * k3 + k4) / 6.0)
    return np.array(alpha)


def test_phase_from_input_leaves_the_published_residual() -> None:
    t = np.arange(10_001) * 0.01
    a_x = 2.06 * G0 * t / 100.0
    f = np.column_stack([a_x, 5.0 * a_x, 0.0 * a_x])
    inst = piga.Instrument(scale_factor=SCALE, beta="1000 arcsec", alpha0=np.pi / 4)
    _, rate = piga.propagate(inst, t, f, with_rate=True, between="linear")
    run = piga.Run.from_arrays(t, rate, f, scale_factor=SCALE, kind="rate", units="SI")
    calibration = piga.calibrate(run, ["tan_beta"], phase_source="input")
    assert calibration.residual_max_after / 0.8884 == pytest.approx(1.67e-3, rel=0.01)
    assert piga.calibrate(run, ["tan_beta"]).residual_max_after / 0.8884 < 1e-8


@pytest.mark.parametrize(
    ("terms", "options", "message"),
    [
        (["scale_factor", "k1"], {}, "same coefficient"),
        (["k7"], {}, "unknown term 'k7'"),
        (["s1"], {}, "'s1' without 'c1'"),
        (["phi"], {}, "comes with tan_beta"),
        ([], {}, "no term"),
        (["k0", "k0"], {}, "named twice"),
        (["k0_T"], {}, "needs the temperature"),
        (["k0"], {"method": "magic"}, "method: 'magic' is not known"),
        (["k0"], {"method": "revolutions"}, "'revolutions' is not among"),
        (["tan_beta"], {"phase_source": "input", "phases": "per-segment"}, "needs phases = 'shared'"),
    ],
)
def test_impossible_requests_are_refused_with_the_reason(terms: list[str], options: dict, message: str) -> None:
    run = record(np.random.default_rng(1), seconds=5.0)
    with pytest.raises(piga.PigaError, match=message):
        piga.calibrate(run, terms, **options)


def still(f: tuple[float, float, float], seconds: float = 60.0) -> piga.Run:
    t = np.arange(0.0, seconds, 0.05)
    force = np.tile(G0 * np.array(f), (t.size, 1))
    inst = piga.Instrument(scale_factor=SCALE, beta=BETA)
    alpha = piga.propagate(inst, t, force, between="linear")
    alpha += 2e-5 * np.random.default_rng(2).standard_normal(t.size)
    return piga.Run.from_arrays(t, alpha, force, scale_factor=SCALE, units="SI")


@pytest.mark.parametrize(
    ("force", "terms", "named", "remedy"),
    [
        ((1.0, 0.3, 0.0), ["scale_factor", "k0"], ["scale_factor", "k0"], "a_x never changes"),
        ((1.0, 0.3, 0.0), ["k0", "k2"], ["k0", "k2"], "another \\|a_x\\|"),
        ((1.0, 0.0, 0.0), ["scale_factor", "tan_beta"], ["tan_beta"], "transverse force"),
    ],
)
def test_what_cannot_be_identified_is_refused_by_name(force, terms, named, remedy) -> None:
    with pytest.raises(piga.IdentifiabilityError, match=remedy) as caught:
        piga.calibrate(still(force), terms)
    assert all(name in caught.value.message for name in named)


@pytest.mark.parametrize(
    ("levels", "terms", "least"),
    [
        (head(3, start=0.2)[:, 0], ("scale_factor", "k0", "k2", "k3"), 4),
        ((1.0, -0.5, -0.5), ("scale_factor", "k0", "k2", "k3"), 4),
        ((2.0, 6.0, 2.0, 6.0), ("scale_factor", "k0", "k2"), 3),
        ((2.0, 6.0), ("scale_factor", "k2", "k3"), 3),
    ],
)
def test_too_few_levels_are_called_that(levels, terms, least) -> None:
    """Three positions of a head, two speeds of a centrifuge: a_x does change, but not often enough."""
    forces = np.stack([levels, np.zeros(len(levels)), np.ones(len(levels))], axis=1)
    run = Bench(forces=forces, seconds=5.0, rate=4.0).record(1)
    with pytest.raises(piga.IdentifiabilityError) as caught:
        piga.calibrate(run, terms)
    assert f"a_x takes too few values: scale_factor, {'k0, ' * ('k0' in terms)}k2" in caught.value.remedy
    assert f"need at least {least} different ones" in caught.value.remedy
    assert "never changes" not in caught.value.remedy


def test_type_b_first_order() -> None:
    run = record(np.random.default_rng(17), white=1e-6)
    run = replace(run, temperature=293.15 + np.array([0.0, 3.0, 1.0, 4.0, 2.0])[run.segment_index % 5])
    rest = at_rest()
    table = msgspec.structs.replace(
        rest, reference_scale="10 ppm", reference_bias="5 ug", reference_misalignment="2 arcsec", timing="1 ppm",
        temperature="0.5 K",
    )  # fmt: skip
    plain, full = (
        piga.calibrate(replace(run, uncertainty=stated), [*TERMS, "k0_T"]) for stated in (rest, table)
    )
    rows = {row.source: row for row in full.budget}
    axes = [
        f"{name} {axis}" for name in ("reference_bias", "reference_misalignment") for axis in ("X0", "Y0", "Z0")
    ]
    assert set(rows) == {"fit residuals (repeatability)", "reference_scale", "timing", "temperature", *axes}
    assert abs(rows["reference_bias X0"].contributions["k0"]) == pytest.approx(5e-6, rel=1e-2)
    across = abs(rows["reference_bias Y0"].contributions["k0"])
    assert across == pytest.approx(5e-6 * full["m_Y"].value, rel=1e-2)
    warmed = rows["temperature"].contributions
    assert abs(warmed["k0"]) == pytest.approx(0.5 * abs(full["k0_T"].value), rel=1e-6)
    assert abs(warmed["scale_factor"]) < 1e-12
    cold = replace(run, temperature=None, uncertainty=at_rest(temperature="0.5 K"))
    assert [row.type for row in piga.calibrate(cold, TERMS).budget] == ["A"]
    scale = rows["reference_scale"].contributions
    assert scale["scale_factor"] == pytest.approx(-0.8884e-5, rel=1e-3)
    assert rows["reference_misalignment Z0"].contributions["m_Y"] == pytest.approx(
        2.0 * np.pi / 648000, rel=1e-3
    )
    assert rows["timing"].contributions["scale_factor"] == pytest.approx(-0.8884e-6, rel=1e-2)
    total = sum(row.contributions["scale_factor"] ** 2 for row in full.budget) ** 0.5
    assert full["scale_factor"].std == pytest.approx(total, rel=1e-9)
    assert full["scale_factor"].std > 5.0 * plain["scale_factor"].std
    assert full["scale_factor"].value == plain["scale_factor"].value


def test_given_noise_levels_are_used() -> None:
    run = record(np.random.default_rng(18))
    given = replace(run, estimation=EstimationTable(angle_rms="5e-5 rad", angle_random_walk="0 rad/sqrt(s)"))
    estimated, used = piga.calibrate(run, TERMS), piga.calibrate(given, TERMS)
    assert used.angle_rms == 5e-5
    assert used.angle_random_walk == used.segment_scatter == 0.0
    assert used["k0"].value == pytest.approx(estimated["k0"].value, abs=estimated["k0"].std)
    assert estimated.angle_rms == pytest.approx(2.5e-5, rel=0.03)


def test_sampling_too_slow_for_the_motion_is_refused() -> None:
    t = np.arange(0.0, 60.0, 0.5)
    f = G0 * np.column_stack([30.0 * np.sin(2.0 * t), 1.0 + 0.0 * t, 0.0 * t])
    run = piga.Run.from_arrays(t, t, f, scale_factor=SCALE, units="SI")
    with pytest.raises(piga.DataError, match=r"sample at [\d.]+ Hz"):
        piga.calibrate(run, ["tan_beta"])


def test_too_short_a_record() -> None:
    t = np.arange(5) * 0.1
    run = piga.Run.from_arrays(t, t, np.ones((5, 3)), scale_factor=SCALE, units="SI")
    with pytest.raises(piga.CalibrationError, match="4 increments, too few for 6 parameters"):
        piga.calibrate(run, ["scale_factor", "tan_beta", "k0", "k2", "k3"])


def test_former_names_still_work() -> None:
    """Scripts and run files of 0.1.0 say ``phase``, and the method ``recursive``."""
    run = record(np.random.default_rng(2), seconds=12.0, rate=4.0, count=5)
    former = piga.calibrate(run, FEW, "recursive", phase="per-segment")
    assert former.coefficients == piga.calibrate(run, FEW, phases="per-segment").coefficients
    assert (former.method, former.phase, former.phases) == ("information", "per-segment", "per-segment")
    with pytest.raises(piga.PigaError, match="give phases alone"):
        piga.calibrate(run, phase="shared", phases="shared")
    with pytest.raises(piga.ArgumentError) as refused:
        piga.calibrate(run, FEW, "magic")
    assert refused.value.remedy == "one of: information, rate"


def test_harmonics_without_a_coupling() -> None:
    """Their phase is that of the output zero, not one to be found: nothing turns with an angle that is estimated."""
    run = record(np.random.default_rng(51), seconds=7.0, rate=2.0, count=4)
    terms = ["scale_factor", "k0", "k2", "m_Y", "s3", "c3"]
    assert [c.name for c in piga.calibrate(run, terms).coefficients] == terms
    with_coupling = piga.calibrate(run, [*TERMS, "s3", "c3"])
    for name in ("s3", "c3"):
        assert abs(with_coupling[name].value) < 4.5 * with_coupling[name].std


def test_one_text_is_a_list_of_terms() -> None:
    run = record(np.random.default_rng(1), seconds=5.0)
    for text in ("scale_factor,k0", "scale_factor k0", " scale_factor , k0 "):
        assert piga.calibrate(run, text).terms == tuple(FEW)
    with pytest.raises(piga.RunFileError, match="unknown term 'k99'"):
        piga.calibrate(run, "scale_factor, k99")
