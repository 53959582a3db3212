"""Plans and calibrations asked for in ways that cannot be met are refused with what to do; odd but sound ones are met."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import piga
from piga.calibration.model.request import make_request
from piga.errors import RunFileError
from piga.planning.plan_file import read_plan
from piga.platform.scenario import load_scenario
from piga.records.run_file import EstimationTable, UncertaintyTable
from piga.records.terms import term_names
from piga.stand.scenario import read_scenario
from piga.units import G0
from tests.calibration.made.scenarios_joint import joint_test
from tests.calibration.made.synthetic import TERMS, record
from tests.planning.cases import request
from tests.records.files import lines, read

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
pytestmark = pytest.mark.compiled


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('phases = "shared"', 'phases = "sideways"', r"\[model\]: .*sideways|\[model\]: invalid enum value"),
        ('beta = "200 arcsec"\n', "", r"\[truth\] lacks beta(?s:.*)add the expected size"),
        ('output = "angle"', 'output = "angle"\nbias_random_walk = "1e-9 g/sqrt(s)"', "bias_random_walk"),
        ("[plan]", '[noise]\nflicker = "1 ug"\n[plan]', r"\[noise\] is not part"),
        ("[plan]", '[plan]\nwanted = { k0 = "-1 ug" }', r"wanted\.k0: must be positive"),
        ("[plan]", '[plan]\nmove = "0 s"', "move: 0 s is not positive"),
        ("[plan]", '[plan]\nmove = "3 g"', "move"),
    ],
)  # fmt: skip
def test_plans_that_are_none(tmp_path: Path, old: str, new: str, words: str) -> None:
    path = request(tmp_path).path
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(RunFileError, match=words) as caught:
        read_plan(path)
    assert "plan.toml" in str(caught.value)
    assert caught.value.remedy


def test_a_plan_on_a_stand_without_positions(tmp_path: Path) -> None:
    path = request(tmp_path).path
    first, rest = path.read_text(encoding="utf-8").split("[stand]")
    stand = '[stand]\nkind = "profile"\nlatitude = "40 deg"\n[[stand.maneuvers]]\nduration = "60 s"\n'
    path.write_text(first + stand + rest[rest.index("[model]") :], encoding="utf-8")
    with pytest.raises(RunFileError, match=r"has no positions or levels to choose from|\[stand\]"):
        read_plan(path)


def short(seed: int, **options: Any) -> piga.Run:
    return record(np.random.default_rng(seed), **({"seconds": 7.0, "rate": 2.0, "count": 4} | options))


@pytest.mark.only_compiled
def test_harmonics_without_a_coupling() -> None:
    """Their phase is that of the output zero, not one to be found: nothing turns with an angle that is estimated."""
    run = short(51)
    terms = ["scale_factor", "k0", "k2", "m_Y", "s3", "c3"]
    calibration = piga.calibrate(run, terms)
    assert "phi" not in {c.name for c in calibration.coefficients}
    assert [c.name for c in calibration.coefficients] == terms
    with_coupling = piga.calibrate(run, [*TERMS, "s3", "c3"])
    for name in ("s3", "c3"):
        assert abs(with_coupling[name].value) < 4.5 * with_coupling[name].std


@pytest.mark.only_compiled
def test_harmonics_by_monte_carlo() -> None:
    """Drawn and linear propagation agree where the model is nearly linear."""
    levels = {"angle_rms": "2.5e-5 rad", "angle_random_walk": "1e-6 rad/sqrt(s)"}
    known = EstimationTable(**levels)
    run = replace(short(52), uncertainty=UncertaintyTable(reference_scale="2 ppm"), estimation=known)
    by_formula = piga.calibrate(run, [*TERMS, "s2", "c2"])
    drawn = replace(run, estimation=EstimationTable(uncertainty="monte-carlo", **levels))
    calibration = piga.calibrate(drawn, [*TERMS, "s2", "c2"])
    table = calibration.diagnostics.monte_carlo.coefficients
    for name in ("scale_factor", "k0", "s2", "c2"):
        assert table[name].std == pytest.approx(by_formula[name].std, rel=0.05)


def test_the_published_recursion_from_another_start() -> None:
    """From the true values with a small covariance it stays there; the wrong number of values is refused."""
    t = np.arange(401) * 0.05
    a_x = G0 * (0.5 + t / 20.0)
    f = np.column_stack([a_x, 5.0 * a_x, 0.0 * a_x])
    inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec", alpha0=np.pi / 4)
    alpha, rate = piga.propagate(inst, t, f, with_rate=True)
    tangent = np.tan(np.radians(1000.0 / 3600.0))
    start = EstimationTable(x0=(float(tangent), float(np.pi / 4)), P0=1e-9)
    for kind, output in (("rate", rate), ("angle", alpha - np.pi / 4)):
        run = piga.Run.from_arrays(t, output, f, scale_factor="0.8884 rad/s/g", kind=kind)
        calibration = piga.calibrate(replace(run, estimation=start), ["tan_beta"], "published")
        assert calibration["tan_beta"].value == pytest.approx(tangent, rel=0.05)
        assert calibration["phi"].value == pytest.approx(np.pi / 4, abs=0.05)
        wrong = EstimationTable(x0=(1e-3, 0.1, 0.0), P0=1.0)
        with pytest.raises(piga.CalibrationError, match=r"\[estimation\] x0 has 3 values, 2 are needed"):
            piga.calibrate(replace(run, estimation=wrong), ["tan_beta"], "published")


@pytest.mark.only_compiled
def test_whole_turns_need_steady_positions_and_a_term() -> None:
    run = record(np.random.default_rng(53), seconds=45.0, rate=1.0, count=6, levels=(1.0,))
    with pytest.raises(piga.CalibrationError, match="needs a term besides tan_beta"):
        piga.calibrate(run, ["tan_beta"], "revolutions")
    f = run.f.copy()
    f[run.segment_index == 2] *= (1.0 + 0.2 * np.sin(run.t[run.segment_index == 2]))[:, None]
    calibration = piga.calibrate(replace(run, f=f), ["scale_factor", "k0"], "revolutions")
    assert "2" not in {segment.label for segment in calibration.segments}
    assert "2" in {
        segment.label for segment in piga.calibrate(run, ["scale_factor", "k0"], "revolutions").segments
    }


def test_temperatures_of_reference_of_a_joint_calibration() -> None:
    runs, _ = joint_test(np.random.default_rng(54), seconds=5.0, rate=2.0)
    warm = [replace(run, temperature=293.15 + 3.0 * np.sin(run.segment_index)) for run in runs]
    other = replace(warm[1], model=msgspec.structs.replace(warm[1].model, temperature_reference="25 degC"))
    with pytest.raises(piga.CalibrationError, match="different reference temperatures"):
        piga.calibrate([warm[0], other], ["scale_factor", "k0", "k0_T"])


def test_one_text_is_a_list(tmp_path: Path) -> None:
    run = read(tmp_path, lines())
    for text in ("scale_factor,k0", "scale_factor k0", " scale_factor , k0 "):
        assert term_names(text) == ("scale_factor", "k0")
        assert make_request(run, text, None, None, None).terms == ("scale_factor", "k0")
    with pytest.raises(piga.RunFileError, match="unknown term 'k99'"):
        piga.calibrate(run, "scale_factor, k99")


def test_scenario_paths_as_text() -> None:
    assert read_scenario(str(EXAMPLES / "dividing-head.toml")).path == EXAMPLES / "dividing-head.toml"
    assert load_scenario(str(EXAMPLES / "platform-moving.toml")) == load_scenario(
        EXAMPLES / "platform-moving.toml"
    )
