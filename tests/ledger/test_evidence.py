"""Keep a calibration and compute it again: same bits here, 1e-6 u where the arithmetic differs."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path

import numpy as np
import pytest

import piga
import piga.calibration.calibrate as estimator
from piga.errors import PigaError
from piga.ledger import compare_calibrations, evidence, prepare_run, reproduce
from piga.ledger.evidence import difference, input_files
from piga.ledger.store.transfer import verify
from piga.stand.run_reference import _check_unchanged
from tests.records.files import write_log, write_run

POSITIONS = 6


def axial(position: int) -> float:
    """Specific force along X0 [g] of a position; the positions begin every 10 s."""
    return 1.0 if position % 2 == 0 else 0.5


def small_run(folder: Path, name: str = "run.csv") -> Path:
    """Two forces, each visited three times, with noise of two counts: enough for scale_factor and k0, and for their scatter."""
    rows, rng = [], np.random.default_rng(1)
    for position in range(POSITIONS):
        a = axial(position)
        for i in range(60):
            count = 20000 * position + round(10179.0 * a * i / 20.0 + 2.0 * rng.standard_normal())
            rows.append(f"{i / 20.0 + 10.0 * position:.4f},{count},{a},0.3,0.0,{position}")
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    write_log(folder, rows, header="t,n,fx,fy,fz,seg", name=name)
    return write_run(folder, name, data='segment = "seg"')


def test_a_test_of_tomorrow_is_refused(tmp_path: Path) -> None:
    with pytest.raises(piga.PigaError, match="measured: '2190-01-01' is in the future"):
        prepare_run(small_run(tmp_path), "A. Meyer", "yearly", measured="2190-01-01")


@pytest.mark.long
def test_keep_and_reproduce(tmp_path: Path) -> None:
    run = small_run(tmp_path)
    with piga.open_store(tmp_path / "lab.sqlite", create=True) as store:
        prepared = prepare_run(run, "A. Meyer", "yearly", measured="2026-11-20")
        record = store.append(prepared)
        before = store.head()
        report = store.read(record.id, "report").decode()
        for text in (record.id, record.document.after, record.document.store, "A. Meyer", "number 1"):
            assert text in report
        assert "\u27e6" not in report
        assert store.read(record.id, "run") == run.read_bytes()
        stored = store.calibration(record.id)
        calibration = piga.calibrate(piga.read_run(run))
        assert stored.coefficients == calibration.coefficients
        again = reproduce(store, record.id)
        assert (again.verdict, again.same_platform, again.comparison.worst) == ("identical", True, 0.0)
        name, when, result = store.history("T-1")[0]
        assert (name, when.isoformat()) == (record.id, "2026-11-20T00:00:00+00:00")
        assert np.array_equal(result.covariance, calibration.covariance)
        second = store.append(prepare_run(run, "B", "corrected", supersedes=record.id, report=False))
        assert [name for name, _, _ in store.history("T-1")] == [second.id]
        assert store.record(2).document.after == before.sha256
    assert verify(tmp_path / "lab.sqlite").sound


@pytest.mark.long
def test_reproduce_needs_nothing_but_the_store(tmp_path: Path) -> None:
    (tmp_path / "deep" / "er").mkdir(parents=True)
    run = small_run(tmp_path / "deep" / "er", "../logs/run.csv")
    names = [(file.role, file.name) for file in input_files(run, piga.read_run(run).input_sha256)]
    assert names == [("run", "run/run.toml"), ("data", "logs/run.csv")]
    with piga.open_store(tmp_path / "lab.sqlite", create=True) as store:
        store.append(prepare_run(run, "A", "test", report=False))
        (tmp_path / "deep" / "logs" / "run.csv").unlink()
        run.unlink()
        assert reproduce(store, 1).verdict == "identical"


def test_results_of_calibrate_are_kept_as_they_are(tmp_path: Path) -> None:
    run = small_run(tmp_path)
    calibration = piga.calibrate(piga.read_run(run), ["scale_factor"], "rate")
    (tmp_path / "out").mkdir()
    calibration.to_json(tmp_path / "out" / "calibration.json")
    with piga.open_store(tmp_path / "lab.sqlite", create=True) as store:
        record = store.append(prepare_run(run, "A", "as it was", results=tmp_path / "out"))
        assert store.read(record.id, "calibration") == (tmp_path / "out" / "calibration.json").read_bytes()
        assert record.document.request["method"] == "rate"
        assert reproduce(store, record.id).verdict == "identical"
        computed = store.append(prepare_run(run, "A", "computed", report=False))
        compared = difference(store, record.id, computed.id)
        assert not any(name.startswith("software ") for name in compared["facts"])
        (tmp_path / "run.csv").write_text((tmp_path / "run.csv").read_text() + "9,1,1,1,1,1\n")
        with pytest.raises(PigaError, match="is not the file that the calibration was computed from"):
            store.append(prepare_run(run, "A", "changed", results=tmp_path / "out"))
        assert store.head().number == 2


def test_absolute_data_file_is_refused(tmp_path: Path) -> None:
    run = small_run(tmp_path)
    run.write_text(run.read_text().replace('file = "run.csv"', f'file = "{tmp_path}/run.csv"'))
    with pytest.raises(PigaError, match="is an absolute path"):
        input_files(run, {})


def profile_run(folder: Path) -> Path:
    """A record whose reference is a logged profile."""
    run = small_run(folder)
    text = (
        run.read_text()
        .replace('["scale_factor", "k0"]', '["scale_factor"]')
        .replace('reference = { columns = ["fx", "fy", "fz"], unit = "g" }\n', "")
    )
    columns = 'time = { column = "t", unit = "s" }, force = { columns = ["fx", "fy", "fz"], unit = "g" }'
    (folder / "stand").mkdir()
    rows = "\n".join(f"{t / 10},{axial(t // 100)},0.3,0.0" for t in range(100 * POSITIONS))
    (folder / "stand" / "p.csv").write_text(f"t,fx,fy,fz\n{rows}\n")
    composite = (
        f'[stand]\nkind = "profile"\nfile = "stand/p.csv"\n{columns.replace(", force", chr(10) + "force")}\n'
    )
    run.write_text(f"{text}\n{composite}")
    return run


def test_every_input_has_its_digest_in_the_result(tmp_path: Path) -> None:
    run = profile_run(tmp_path)
    digests = piga.calibrate(piga.read_run(run), ["scale_factor"]).provenance.input_sha256
    files = ("run.toml", "run.csv", "stand/p.csv")
    assert digests == {name: hashlib.sha256((tmp_path / name).read_bytes()).hexdigest() for name in files}
    roles = [(file.role, file.name) for file in input_files(run, digests)]
    assert roles == [("run", "run.toml"), ("data", "run.csv"), ("stand", "stand/p.csv")]


@pytest.mark.parametrize("name", ["run.toml", "run.csv", "stand/p.csv"])
def test_an_input_that_changes_before_the_record_is_written_is_refused(tmp_path: Path, name: str) -> None:
    """Between calibration and record (while the report is drawn), and between calibrate and ``add --results``."""
    run = profile_run(tmp_path)
    with piga.open_store(tmp_path / "lab.sqlite", create=True) as store:
        prepared = prepare_run(run, "A", "test", report=False)
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "calibration.json").write_bytes(prepared.files[-1].source)
        path = tmp_path / name
        path.write_text(path.read_text() + ("# more\n" if name == "run.toml" else "\n"))
        for late in (prepared, prepare_run(run, "A", "test", results=tmp_path / "out")):
            with pytest.raises(
                PigaError, match=f"{name}: is not the file that the calibration was computed from"
            ):
                store.append(late)
        assert store.head().number == 0


def test_a_stand_that_changes_between_reading_and_its_uncertainty_is_refused(tmp_path: Path) -> None:
    run = profile_run(tmp_path)
    record = piga.read_run(run)
    path = tmp_path / "stand" / "p.csv"
    path.write_text(path.read_text().replace("0.3", "0.4"))
    with pytest.raises(PigaError, match="changed after it was read"):
        _check_unchanged(record)


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> piga.Calibration:
    folder = tmp_path_factory.mktemp("run")
    return piga.calibrate(piga.read_run(small_run(folder)))


def _with(calibration: piga.Calibration, index: int, **changes: float) -> piga.Calibration:
    coefficients = list(calibration.coefficients)
    coefficients[index] = dataclasses.replace(coefficients[index], **changes)
    return dataclasses.replace(calibration, coefficients=tuple(coefficients))


def test_comparison_knows_bits_rounding_and_difference(calibration: piga.Calibration) -> None:
    assert compare_calibrations(calibration, calibration).identical
    value, std = calibration.coefficients[0].value, calibration.coefficients[0].std
    for step, agrees in ((np.spacing(value), True), (0.5e-6 * std, True), (2e-6 * std, False)):
        difference = compare_calibrations(calibration, _with(calibration, 0, value=value + step))
        assert (difference.identical, difference.agrees) == (False, agrees)
    assert "recomputed" in difference.differences[0]
    difference = compare_calibrations(calibration, dataclasses.replace(calibration, method="rate"))
    assert difference.differences == ("method: 'information', recomputed 'rate'",)
    other = dataclasses.replace(calibration, covariance=calibration.covariance * (1.0 + 1e-3))
    assert not compare_calibrations(calibration, other).agrees


def test_a_record_of_the_former_estimator_agrees_within_a_share_of_u(calibration: piga.Calibration) -> None:
    provenance = dataclasses.replace(calibration.provenance, software="piga 0.2.0")
    old = dataclasses.replace(calibration, provenance=provenance)
    value, std = calibration.coefficients[0].value, calibration.coefficients[0].std
    for step, agrees in ((0.2, True), (0.4, False)):
        again = _with(calibration, 0, value=value + step * std, std=2.0 * std)
        assert compare_calibrations(old, again).agrees == agrees
    assert not compare_calibrations(calibration, _with(calibration, 0, value=value + 0.2 * std)).agrees


@pytest.mark.long
def test_a_last_digit_counts_on_the_same_platform(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One unit in the last place: different here, within tolerance where the software is another."""
    with piga.open_store(tmp_path / "lab.sqlite", create=True) as store:
        store.append(prepare_run(small_run(tmp_path), "A", "test", report=False))
        original = estimator.calibrate

        def nearly(*arguments, **options):  # type: ignore[no-untyped-def]
            result = original(*arguments, **options)
            return _with(result, 0, value=float(np.nextafter(result.coefficients[0].value, 1.0)))

        monkeypatch.setattr(estimator, "calibrate", nearly)
        assert reproduce(store, 1).verdict == "different"
        here = evidence.software_identity()
        monkeypatch.setattr(evidence, "software_identity", lambda: here | {"numpy": "9.9"})
        result = reproduce(store, 1)
        assert (result.verdict, result.changed) == ("within tolerance", {"numpy": (here["numpy"], "9.9")})


@pytest.mark.slow
def test_other_arithmetic_agrees_within_rounding(tmp_path: Path) -> None:
    """The shipped record, interpreted instead of compiled: other rounding everywhere, the same result."""
    import json
    import os
    import subprocess
    import sys

    from piga.data import copy_example

    run = copy_example(tmp_path)
    command = [sys.executable, "-c", "from piga.cli.main import main; main()", "records"]
    who = ["--operator", "A", "--reason", "test"]
    kept = ["add", run, "--store", tmp_path / "lab.sqlite", *who, "--no-report"]
    for arguments, jit in ((kept, "0"), (["reproduce", "--store", tmp_path / "lab.sqlite", "--json"], "1")):
        environment = os.environ | {"NUMBA_DISABLE_JIT": jit}
        done = subprocess.run(
            [*command, *map(str, arguments)], env=environment, capture_output=True, check=True
        )
    content = json.loads(done.stdout)["records"][0]
    assert content["verdict"] == "within tolerance", content
    assert "compiled" in content["changed"]
