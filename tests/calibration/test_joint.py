"""Several runs calibrated together: what one cannot separate, two do; summaries merge without raw data."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import piga
from piga.calibration.summary import RunSummary
from tests.calibration.made.scenarios import JOINT_TERMS as TERMS
from tests.calibration.made.scenarios import SCENARIOS, joint_test, scores
from tests.calibration.made.synthetic import at_rest, record
from tests.chance import assert_variance

pytestmark = pytest.mark.interpreted
FEW = ["scale_factor", "k0", "k2"]


@pytest.fixture(scope="module")
def made() -> tuple[list[piga.Run], dict[str, float]]:
    return joint_test(np.random.default_rng(11), seconds=5.0, rate=3.0)


@pytest.fixture(scope="module")
def runs(made: tuple[list[piga.Run], dict[str, float]]) -> list[piga.Run]:
    """The second as a run file of its own names it, with a record of what was read."""
    first, second = made[0]
    return [
        first,
        replace(second, source="spun/run.toml", input_sha256={"run.csv": "1" * 64, "run.toml": "2" * 64}),
    ]


@pytest.fixture(scope="module")
def joint(runs: list[piga.Run]) -> piga.Calibration:
    return piga.calibrate(runs, TERMS, per_run=[])


def test_two_small_runs_together(
    joint: piga.Calibration, made: Any, runs: list[piga.Run], tmp_path: Path
) -> None:
    truth = {key.replace("run 2", "spun"): value for key, value in made[1].items()}
    z = scores(joint, truth)
    assert set(z) == {*TERMS, "phi[run 1]", "phi[spun]"}
    assert all(abs(value) < 4.5 for value in z.values()), z
    assert [(run.name, run.raw, run.rows) for run in joint.runs] == [
        ("run 1", True, runs[0].size - 12), ("spun", True, runs[1].size - 8)
    ]  # fmt: skip
    assert joint.provenance.input_sha256 == {"run.csv": "1" * 64, "run.toml": "2" * 64}
    assert joint.residuals is not None
    assert joint.residuals.run is not None
    assert set(joint.residuals.run.tolist()) == {0, 1}
    joint.to_json(tmp_path / "c.json")
    assert piga.Calibration.from_json(tmp_path / "c.json").runs == joint.runs


def test_two_runs_separate_what_one_cannot(runs: list[piga.Run], joint: piga.Calibration) -> None:
    with pytest.raises(piga.IdentifiabilityError, match="cannot separate k0, k2, k_YY") as caught:
        piga.calibrate(runs[0], TERMS)
    assert "one-plane tumble" in caught.value.remedy
    assert str(caught.value).count("a centrifuge or a vibration table") == 1
    with pytest.raises(piga.IdentifiabilityError, match=r"cannot separate k0, (m_Y, k_YY|k_YY, m_Y)") as caught:
        piga.calibrate(runs[1], TERMS)
    assert "dividing head" in str(caught.value)
    assert joint.condition < 10.0
    assert any("run 1" in remark and "alone" in remark for remark in joint.remarks)


@pytest.mark.long
def test_truth_within_uncertainty_over_repeats() -> None:
    """Squared errors of 6 joint tests average to one; a right program is outside the band once in 1000 draws of seeds."""
    squares = []
    for seed in range(6):
        runs, truth = joint_test(np.random.default_rng([seed, 5]), seconds=10.0)
        calibration = piga.calibrate(runs, TERMS, per_run=[])
        z = scores(calibration, truth)
        error = np.array([z[c.key] * c.std for c in calibration.coefficients])
        squares.append(error @ np.linalg.solve(calibration.covariance, error))
    assert_variance(np.mean(squares) / 8.0, 6 * 8, "squared error over variance")


@pytest.mark.long
def test_joint_of_split_record_is_the_record() -> None:
    """Two halves of one record with given noise and a phase per segment give what the whole gives."""
    run = joint_test(np.random.default_rng(4))[0][0]
    levels = {"angle_rms": "2.5e-5 rad", "angle_random_walk": "1e-5 rad/sqrt(s)"}
    whole = replace(run, estimation=msgspec.structs.replace(run.estimation, **levels))
    part = whole.segment_index < 6
    terms = ["scale_factor", "tan_beta", "k0", "m_Y"]
    split = piga.calibrate([whole.without(~part), whole.without(part)], terms, phases="per-segment", per_run=[])
    once = piga.calibrate(whole, terms, phases="per-segment")
    for name in terms:
        assert split[name].value == pytest.approx(once[name].value, abs=1e-5 * once[name].std)
        assert split[name].std == pytest.approx(once[name].std, rel=0.3), "a slow change does not cross runs"


@pytest.mark.long
@pytest.mark.parametrize("name", ["static", "coarse-slow"])
def test_by_its_summary_as_the_run_alone(tmp_path: Path, name: str) -> None:
    """One run by its summary is that run."""
    scenario = SCENARIOS[name]
    run = scenario.record(np.random.default_rng(5))
    RunSummary.of(run, scenario.terms).to_json(tmp_path / "s.json")
    alone = scenario.calibrate(run)
    merged = piga.calibrate([RunSummary.from_json(tmp_path / "s.json")], scenario.terms)
    for a, b in zip(alone.coefficients, merged.coefficients, strict=True):
        assert (b.value - a.value) / a.std == pytest.approx(0.0, abs=1e-3)
        assert b.std == pytest.approx(a.std, rel=1e-3)
        assert b.degrees_of_freedom == pytest.approx(a.degrees_of_freedom, rel=1e-3)


@pytest.mark.long
def test_a_summary_for_the_raw_data(runs: list[piga.Run], tmp_path: Path) -> None:
    kept = replace(runs[1], uncertainty=at_rest(reference_scale="10 ppm"))
    RunSummary.of(kept, FEW).to_json(tmp_path / "old.json")
    assert json.loads((tmp_path / "old.json").read_text(encoding="utf-8"))["phase"] == "shared"
    old = RunSummary.from_json(tmp_path / "old.json")
    assert [source.name for source in old.sources] == ["reference_scale"]
    document = json.loads((tmp_path / "old.json").read_text(encoding="utf-8"))
    for position in document["positions"]:
        position["part"]["names"][-1] = "source 1"
    (tmp_path / "odd.json").write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(piga.CalibrationError, match="its sources are damaged"):
        RunSummary.from_json(tmp_path / "odd.json")
    merged, fresh, plain = (piga.calibrate([runs[0], other], FEW) for other in (old, kept, runs[1]))
    for a, b, c in zip(merged.coefficients, fresh.coefficients, plain.coefficients, strict=True):
        assert (a.key, a.value) == (b.key, pytest.approx(b.value, rel=1e-9))
        assert a.std == pytest.approx(b.std, rel=1e-6)
        assert a.value == pytest.approx(c.value, rel=1e-9)
        assert a.std >= c.std * (1.0 - 1e-12)
    assert merged["scale_factor"].std > 1.01 * plain["scale_factor"].std
    assert [run.raw for run in merged.runs] == [True, False]
    assert any("is a summary" in remark for remark in merged.remarks)
    assert merged.segments[-1].label.startswith("spun:")


@pytest.mark.parametrize(
    ("in_file", "argument", "own"),
    [
        (None, None, ["k0[run 1]", "k0[spun]"]),
        ((), None, ["k0"]),
        (("k2",), None, ["k0", "k2[run 1]", "k2[spun]"]),
        (("k2",), ["k0"], ["k0[run 1]", "k0[spun]"]),
        (None, [], ["k0"]),
    ],
)
def test_each_run_has_its_own_bias_unless_asked_otherwise(
    runs: list[piga.Run], in_file: tuple[str, ...] | None, argument: list[str] | None, own: list[str]
) -> None:
    given = [replace(run, estimation=msgspec.structs.replace(run.estimation, per_run=in_file)) for run in runs]
    result = piga.calibrate(given, FEW, per_run=argument)
    keys = [c.key for c in result.coefficients]
    assert [key for key in keys if key.startswith("k0") or "[" in key] == own
    summaries = [RunSummary.of(run, FEW) for run in given]
    merged = piga.calibrate([runs[0], summaries[1]], FEW, per_run=argument)
    assert in_file is not None or [c.key for c in merged.coefficients] == keys


def test_a_run_of_one_position_shares_the_bias(runs: list[piga.Run]) -> None:
    one = runs[1].without(runs[1].segment_index != 0)
    assert "k0" in [c.key for c in piga.calibrate([runs[0], one], ["scale_factor", "k0"]).coefficients]


def cut(run: piga.Run, size: int) -> list[piga.Run]:
    """The run as runs of ``size`` positions each, as a bench may write them."""
    plain, last = replace(run, input_sha256={}), int(run.segment_index[-1])
    return [
        plain.without((run.segment_index < first) | (run.segment_index >= first + size))
        for first in range(0, last + 1, size)
    ]


def test_a_run_of_one_position_is_one_repetition(runs: list[piga.Run]) -> None:
    """Twelve files of one position leave as few degrees of freedom as one file of twelve."""
    terms = ["scale_factor", "k0", "m_Y"]
    one, files = piga.calibrate(runs[0], terms), piga.calibrate(cut(runs[0], 1), terms)
    for name in terms:
        assert files[name].degrees_of_freedom < 12.0
        assert abs(files[name].value - one[name].value) < 3.0 * one[name].std
    with pytest.raises(piga.IdentifiabilityError, match="position 'run 1' alone determines"):
        piga.calibrate(cut(runs[0], 1)[::6], ["scale_factor", "k0"])


def test_runs_that_cannot_tell_their_biases_are_told_to_share_one(runs: list[piga.Run]) -> None:
    pairs = [replace(pair, f=np.tile(pair.f[0], (pair.size, 1))) for pair in cut(runs[0], 2)]
    with pytest.raises(piga.IdentifiabilityError, match=r"leave it out of per_run"):
        piga.calibrate(pairs, ["scale_factor", "k0"])


@pytest.mark.long
def test_a_coefficient_of_each_run(runs: list[piga.Run]) -> None:
    calibration = piga.calibrate(runs, FEW, per_run=["k0"])
    assert [c.key for c in calibration.coefficients] == ["scale_factor", "k0[run 1]", "k0[spun]", "k2"]
    seen = calibration.for_run("spun")
    assert seen["k0"].value == calibration["k0[spun]"].value
    assert piga.compensate(runs[1], seen).ax.size == runs[1].size
    with pytest.raises(piga.CalibrationError, match=r"k0 differs between the runs"):
        piga.compensate(runs[1], calibration)
    again = piga.calibrate([runs[0], runs[0]], FEW, per_run=["k2"])
    assert [c.key for c in again.coefficients][2:] == ["k2[run 1]", "k2[run 2]"]


@pytest.mark.long
def test_sources_that_runs_share(runs: list[piga.Run]) -> None:
    """10 ppm of one reference for both go into K undiminished, those of two references average."""

    def parts(first: str, second: str) -> list[float]:
        moved = [
            replace(run, uncertainty=at_rest(reference_scale="10 ppm", reference_id=name))
            for run, name in zip(runs, (first, second), strict=True)
        ]
        rows = piga.calibrate(moved, FEW).budget
        return [row.contributions["scale_factor"] for row in rows if row.type == "B"]

    (shared,) = parts("head 1", "head 1")
    assert abs(shared) == pytest.approx(10e-6 * 0.8884, rel=1e-3)
    apart = parts("head 1", "centrifuge 2")
    assert len(apart) == 2
    assert abs(sum(apart)) == pytest.approx(abs(shared), rel=1e-4)
    assert np.hypot(*apart) < 0.999 * abs(shared)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a, b: [a, replace(b, serial="other")], "is of instrument 'synthetic', run 'spun' of 'other'"),
        (
            lambda a, b: [a, replace(b, scale_factor=b.scale_factor * 1.001)],
            "have different nominal scale factors",
        ),
        (lambda a, b: [a, b, b], r"run 'spun \(2\)' has the same data as run 'spun'"),
        (lambda a, b: [a, "b"], "a list of runs and run summaries"),
        (lambda a, b: [], "a list of runs and run summaries"),
    ],
)
def test_runs_that_do_not_belong_together(
    runs: list[piga.Run], change: Callable[[piga.Run, piga.Run], list[Any]], message: str
) -> None:
    with pytest.raises(piga.PigaError, match=message):
        piga.calibrate(change(*runs), FEW)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("k3", "'k3' is not among the terms"),
        ("scale_factor", "'scale_factor' belongs to the instrument"),
        ("tan_beta", "'tan_beta' depends on the output angle"),
    ],
)
def test_terms_that_cannot_differ_between_runs(runs: list[piga.Run], name: str, message: str) -> None:
    with pytest.raises(piga.ArgumentError, match=message):
        piga.calibrate(runs, TERMS, per_run=[name])
    with pytest.raises(piga.CalibrationError, match="calibrated together only with method 'information'"):
        piga.calibrate(runs, TERMS, "rate")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["positions"][0]["part"]["factor"][0].pop(), "not a valid run summary"),
        (lambda d: d["positions"][0]["part"]["names"].__setitem__(0, "speed"), "its summaries are damaged"),
        (lambda d: d["positions"][0]["part"].__setitem__("count", -1), "its summaries are damaged"),
        (lambda d: d["positions"].clear(), "its summaries are damaged"),
        (lambda d: d["noise"].update(white=-1e-9), r"noise\.white"),
        (lambda d: d.update(scale_factor=1e101), r"\.scale_factor"),
        (lambda d: d.pop("kind"), "kind"),
        (lambda d: d.__setitem__("schema", "piga.run-summary/9"), "no run summary of schema"),
    ],
)
def test_a_damaged_summary(
    runs: list[piga.Run], tmp_path: Path, change: Callable[[dict[str, Any]], object], message: str
) -> None:
    path = tmp_path / "s.json"
    RunSummary.of(runs[1], ["scale_factor"]).to_json(path)
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    with pytest.raises(piga.CalibrationError, match=message):
        RunSummary.from_json(path)


def test_files_that_are_no_summary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for content, message in (
        (b"\xff", "not a valid run summary"),
        (b"[" * 100_000, "not a valid run summary"),
        (b"{}", "no run summary"),
    ):
        (tmp_path / "s.json").write_bytes(content)
        with pytest.raises(piga.CalibrationError, match=message):
            RunSummary.from_json(tmp_path / "s.json")
    with pytest.raises(piga.CalibrationError, match="cannot be read"):
        RunSummary.from_json(tmp_path / "none.json")
    monkeypatch.setattr("piga.calibration.summary.MOST_SUMMARY_BYTES", 1)
    with pytest.raises(piga.CalibrationError, match="larger than 1 bytes"):
        RunSummary.from_json(tmp_path / "s.json")


def test_a_phase_that_was_lost_cannot_be_shared() -> None:
    run = record(np.random.default_rng(42), seconds=5.0, rate=2.0, count=3, levels=(1.0,))
    lost = replace(run, phase_group=(0, 0, 1))
    with pytest.raises(piga.CalibrationError, match="the zero of the output angle is lost at segment '2'"):
        piga.calibrate(lost, ["scale_factor", "tan_beta", "k0"])


def test_runs_with_different_reference_temperatures_are_refused(runs: list[piga.Run]) -> None:
    warm = [replace(run, temperature=293.15 + 3.0 * np.sin(run.segment_index)) for run in runs]
    other = replace(warm[1], model=msgspec.structs.replace(warm[1].model, temperature_reference="25 degC"))
    with pytest.raises(piga.CalibrationError, match="different reference temperatures"):
        piga.calibrate([warm[0], other], ["scale_factor", "k0", "k0_T"])
