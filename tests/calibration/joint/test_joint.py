"""Several runs calibrated together: what one cannot separate, two do; summaries merge without raw data."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import jsonschema
import msgspec
import numpy as np
import pytest

import piga
from piga.calibration.joint.summary import RunSummary
from piga.formats.parquet import write_residuals
from piga.records.calibration.document import to_document
from piga.records.run_file import Spread, UncertaintyTable
from tests.calibration.made.scenarios import SCENARIOS
from tests.calibration.made.scenarios_joint import TERMS, joint_test, scores
from tests.chance import assert_variance

pytestmark = pytest.mark.only_compiled


@pytest.fixture(scope="module")
def runs() -> list[piga.Run]:
    return joint_test(np.random.default_rng(3))[0]


@pytest.fixture(scope="module")
def together(runs: list[piga.Run]) -> piga.Calibration:
    return piga.calibrate(runs, TERMS)


def test_two_runs_separate_what_one_cannot(runs: list[piga.Run], together: piga.Calibration) -> None:
    with pytest.raises(piga.IdentifiabilityError, match="cannot separate k0, k2, k_YY") as caught:
        piga.calibrate(runs[0], TERMS)
    assert (
        str(caught.value).count("a centrifuge or a vibration table")
        == str(caught.value).count("centrifuge")
        == 1
    )
    with pytest.raises(piga.IdentifiabilityError, match=r"cannot separate k0, (m_Y, k_YY|k_YY, m_Y)") as caught:
        piga.calibrate(runs[1], TERMS)
    assert "dividing head" in str(caught.value)
    assert together.condition < 10.0
    assert any("run 1" in remark and "alone" in remark for remark in together.remarks)


def test_truth_within_uncertainty_over_repeats() -> None:
    """Squared errors of 12 joint tests average to one; a right program is outside the band once in 1000 draws of seeds."""
    squares = []
    for seed in range(12):
        runs, truth = joint_test(np.random.default_rng([seed, 5]), seconds=10.0)
        calibration = piga.calibrate(runs, TERMS)
        z = scores(calibration, truth)
        error = np.array([z[c.key] * c.std for c in calibration.coefficients])
        squares.append(error @ np.linalg.solve(calibration.covariance, error))
    assert_variance(np.mean(squares) / 8.0, 12 * 8, "squared error over variance")


def test_joint_of_split_record_is_the_record() -> None:
    """Two halves of one record with given noise and a phase per segment give what the whole gives."""
    runs, _ = joint_test(np.random.default_rng(4))
    given = msgspec.structs.replace(
        runs[0].estimation, angle_rms="2.5e-5 rad", angle_random_walk="1e-5 rad/sqrt(s)"
    )
    whole = replace(runs[0], estimation=given)
    part = whole.segment_index < 6
    halves = [_rows(whole, part), _rows(whole, ~part)]
    terms = ["scale_factor", "tan_beta", "k0", "m_Y"]
    split = piga.calibrate(halves, terms, phases="per-segment")
    once = piga.calibrate(whole, terms, phases="per-segment")
    for name in terms:
        assert split[name].value == pytest.approx(once[name].value, abs=1e-5 * once[name].std)
        assert split[name].std == pytest.approx(once[name].std, rel=0.3), "a slow change does not cross runs"


def _rows(run: piga.Run, mask: np.ndarray) -> piga.Run:
    made = piga.Run.from_arrays(
        run.t[mask],
        run.output[mask],
        run.f[mask],
        uncertainty={"waived": {"earth_rate": "simulated at rest", "servo": "simulated without"}},
        scale_factor=run.scale_factor,
        segment=run.segment_index[mask],
        serial=run.serial,
        units="SI",
    )
    return replace(made, estimation=run.estimation)


def test_summary_stands_in_for_the_raw_data(
    runs: list[piga.Run], together: piga.Calibration, tmp_path: Path
) -> None:
    """A summary holds the columns of all terms; written, read and merged it gives the same numbers."""
    RunSummary.of(runs[0], TERMS, name="run 1").to_json(tmp_path / "old.json")
    old = RunSummary.from_json(tmp_path / "old.json")
    merged = piga.calibrate([old, runs[1]], TERMS)
    for a, b in zip(merged.coefficients, together.coefficients, strict=True):
        assert (a.key, a.value, a.std) == (
            b.key,
            pytest.approx(b.value, rel=1e-9),
            pytest.approx(b.std, rel=1e-9),
        )
    assert [run.raw for run in merged.runs] == [False, True]
    assert any("is a summary" in remark for remark in merged.remarks)
    asked_anew = piga.calibrate([old, runs[1]], [*TERMS, "k3"])
    assert asked_anew["k3"].std < 1e-4


def test_damaged_summary_is_refused(runs: list[piga.Run], tmp_path: Path) -> None:
    path = tmp_path / "s.json"
    RunSummary.of(runs[0], ["scale_factor", "k0"]).to_json(path)
    document = json.loads(path.read_text())
    for change, words in (
        (lambda d: d["positions"][0]["part"]["factor"][0].pop(), "its summaries are damaged"),
        (lambda d: d["positions"][0]["part"]["factor"][0].__setitem__(0, "1.0"), "its summaries are damaged"),
        (lambda d: d["positions"][0]["part"].update(factor=None), "its summaries are damaged"),
        (lambda d: d["positions"][0]["part"].update(count=-1), "its summaries are damaged"),
        (lambda d: d["noise"].update(white=-1e-9), "its noise levels are damaged"),
        (lambda d: d["noise"].update(walk="much"), "noise.walk"),
        (lambda d: d.pop("kind"), "kind"),
    ):
        damaged = json.loads(json.dumps(document))
        change(damaged)
        path.write_text(json.dumps(damaged))
        with pytest.raises(piga.CalibrationError, match=words):
            RunSummary.from_json(path)
    path.write_text('{"schema": "piga.calibration/1"}')
    with pytest.raises(piga.CalibrationError, match="no run summary"):
        RunSummary.from_json(path)


def test_coefficients_per_run(runs: list[piga.Run]) -> None:
    calibration = piga.calibrate(runs, ["scale_factor", "tan_beta", "k0", "k2"], per_run=["k0"])
    assert {c.key for c in calibration.coefficients} >= {"k0[run 1]", "k0[run 2]", "phi[run 1]", "phi[run 2]"}
    seen = calibration.for_run("run 2")
    assert [c.key for c in seen.coefficients] == ["scale_factor", "tan_beta", "phi", "k0", "k2"]
    assert seen["k0"].value == calibration["k0[run 2]"].value
    assert piga.compensate(runs[1], seen).ax.size == runs[1].size
    with pytest.raises(piga.CalibrationError, match=r"k0 differs between the runs"):
        piga.compensate(runs[1], calibration)
    with pytest.raises(piga.ArgumentError, match="scale_factor"):
        piga.calibrate(runs, per_run=["scale_factor"])


def test_common_source_moves_all_runs_an_own_one_only_its_run(runs: list[piga.Run]) -> None:
    """A scale error shared by both stands goes into K undiminished; independent ones average."""
    terms = TERMS

    def scale_part(first: str | None, second: str | None) -> tuple[float, int]:
        tables = (
            UncertaintyTable(
                waived={"earth_rate": "simulated at rest", "servo": "simulated without"},
                reference_scale="10 ppm",
                reference_id=name,
            )
            for name in (first, second)
        )
        moved = [replace(run, uncertainty=table) for run, table in zip(runs, tables, strict=True)]
        rows = [row for row in piga.calibrate(moved, terms).budget if row.type == "B"]
        return float(np.sqrt(sum(row.contributions["scale_factor"] ** 2 for row in rows))), len(rows)

    shared, count = scale_part("head 1", "head 1")
    assert count == 1
    assert shared == pytest.approx(10e-6 * 0.8886, rel=1e-3)
    apart, count = scale_part("head 1", "centrifuge 2")
    assert count == 2
    assert apart < 0.999 * shared


def test_result_is_valid_and_names_every_run(
    runs: list[piga.Run], together: piga.Calibration, tmp_path: Path
) -> None:
    schema = json.loads((Path(piga.__file__).parent / "records/schema/calibration-1.json").read_text())
    jsonschema.validate(json.loads(json.dumps(to_document(together))), schema)
    together.to_json(tmp_path / "c.json")
    back = piga.Calibration.from_json(tmp_path / "c.json")
    assert back.runs == together.runs
    assert back["phi[run 2]"] == together["phi[run 2]"]
    assert together.runs[0].angle_rms == pytest.approx(2.5e-5, rel=0.1)
    assert together.runs[1].angle_rms == pytest.approx(6e-5, rel=0.1)
    write_residuals(together, tmp_path / "r.parquet")
    from pyarrow import parquet

    names = parquet.read_table(tmp_path / "r.parquet").column("run").to_pylist()
    assert (names[0], names[-1], len(names)) == ("run 1", "run 2", sum(run.size for run in runs))


def test_runs_that_do_not_belong_together(runs: list[piga.Run]) -> None:
    with pytest.raises(piga.CalibrationError, match="instrument 'synthetic'"):
        piga.calibrate([runs[0], replace(runs[1], serial="other")])
    with pytest.raises(piga.CalibrationError, match="nominal scale factors"):
        piga.calibrate([runs[0], replace(runs[1], scale_factor=runs[0].scale_factor * 1.001)])
    marked = replace(runs[0], input_sha256={"run.csv": "a" * 64})
    with pytest.raises(piga.CalibrationError, match="same data"):
        piga.calibrate([marked, marked])
    with pytest.raises(piga.ArgumentError, match="list of runs"):
        piga.calibrate([runs[0], "b"])
    with pytest.raises(piga.CalibrationError, match="method 'information'"):
        piga.calibrate(runs, method="rate")
    with pytest.raises(piga.IdentifiabilityError, match="2 runs together cannot"):
        piga.calibrate(runs, ["scale_factor", "k0", "m_Z", "k_ZZ"])


def test_every_segment_with_its_own_phase(runs: list[piga.Run], together: piga.Calibration) -> None:
    calibration = piga.calibrate(runs, TERMS, phases="per-segment")
    assert calibration["phi[run 2:3]"].std < 0.5
    for name in TERMS:
        assert calibration[name].value == pytest.approx(together[name].value, abs=3.0 * calibration[name].std)


@pytest.mark.parametrize("name", ["static", "coarse-slow"])
def test_by_its_summary_as_the_run_alone(tmp_path: Path, name: str) -> None:
    """One run by its summary is that run."""
    scenario = SCENARIOS[name]
    run = scenario.record(np.random.default_rng(5))
    RunSummary.of(run, scenario.terms).to_json(tmp_path / "s.json")
    alone, merged = (
        scenario.calibrate(run),
        piga.calibrate([RunSummary.from_json(tmp_path / "s.json")], scenario.terms),
    )
    for a, b in zip(alone.coefficients, merged.coefficients, strict=True):
        assert (b.value - a.value) / a.std == pytest.approx(0.0, abs=1e-3)
        assert b.std == pytest.approx(a.std, rel=1e-3)
        assert b.degrees_of_freedom == pytest.approx(a.degrees_of_freedom, rel=1e-3)


def test_degrees_of_freedom_of_two_runs(runs: list[piga.Run]) -> None:
    """The positions of both runs together are more repetitions than those of either."""
    terms = ["scale_factor", "tan_beta", "k0"]
    alone, together = [piga.calibrate(run, terms) for run in runs], piga.calibrate(runs, terms)
    for name in ("tan_beta", "k0"):
        own = [one[name].degrees_of_freedom for one in alone]
        assert together[name].degrees_of_freedom > 1.1 * min(own)


def test_a_bounded_source_keeps_its_distribution(runs: list[piga.Run]) -> None:
    spread = Spread(half_width="10 ppm", distribution="rectangular")
    moved = [
        replace(
            run,
            uncertainty=UncertaintyTable(
                waived={"earth_rate": "simulated at rest", "servo": "simulated without"}, reference_scale=spread
            ),
        )
        for run in runs
    ]
    assert piga.calibrate(moved, TERMS).budget[1].distribution == "rectangular"
