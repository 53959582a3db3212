"""What cannot be compensated as asked is refused with what to do; the edges of what can be are computed right."""

from __future__ import annotations

import datetime as dt
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest

import piga
from piga.compensation import Mounted, Phase, SetCompensator, compensate_set
from piga.compensation.sets import read_member, read_triad
from piga.units import G0
from tests.compensation.run_files import CAL, command, write
from tests.compensation.triads import orthogonal
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, constant_force, run_of

T = 0.01 * np.arange(60)
F = constant_force(T, 1.0, 3.0, 0.5)


# --- one instrument


@pytest.mark.parametrize(
    ("chunk", "message"),
    [
        ({"t": T, "output": T[:5], "f": F}, r"chunk\['output'\]: shape \(5,\) instead of \(60,\)"),
        ({"t": T, "output": T, "f": F[:, :2]}, r"chunk\['f'\]: shape \(60, 2\) instead of \(60, 3\)"),
        ({"t": T, "output": T, "f": F, "base_rate": F[:9]}, r"chunk\['base_rate'\]: shape \(9, 3\)"),
        ({"t": T, "output": T}, "chunk: lacks 'f'"),
        ({"t": T, "output": T, "f": F, "speed": T}, "chunk: has the unknown key 'speed'"),
    ],
)
def test_chunks_that_do_not_fit(chunk: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(piga.ArgumentError, match=message) as caught:
        piga.Compensator(calibration_of(CAL)).push(chunk)
    assert caught.value.remedy


def test_a_stream_of_another_kind_or_without_its_temperature() -> None:
    with pytest.raises(piga.ArgumentError, match="kind: 'counts' is neither 'angle' nor 'rate'"):
        piga.Compensator(calibration_of(CAL), kind="counts")
    warm = calibration_of({**CAL, "k0_T": 1e-5})
    with pytest.raises(piga.CalibrationError, match="the calibration has temperature terms"):
        piga.Compensator(warm).push({"t": T, "output": T, "f": F})
    with pytest.raises(piga.CalibrationError, match="no temperature is given"):
        piga.compensate(run_of(T, F, phi=0.3), warm)


def test_nothing_and_time_that_stands() -> None:
    """An empty chunk changes nothing; time that stands begins a stretch even before an interval is known."""
    stream = piga.Compensator(calibration_of(CAL))
    assert stream.push({"t": T[:0], "output": T[:0], "f": F[:0]}).size == 0
    stream.push({"t": 1.0, "output": 0.0, "f": F[0]})
    stood = stream.push({"t": 1.0, "output": 0.1, "f": F[0]})
    assert stood.flagged("no_increment").all()
    assert np.isnan(stood.ax).all()


def test_calibrations_that_do_not_say_enough() -> None:
    run = run_of(T, F, phi=0.3)
    with pytest.raises(piga.CalibrationError, match="the calibration has tan_beta but no phi"):
        piga.compensate(run, calibration_of({"tan_beta": TAN_BETA}))
    given = piga.compensate(run, calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA}), phase=Phase(0.3))
    assert np.abs(given.ax[1:] - G0).max() < 1e-9
    assert np.abs(piga.compensate(run, calibration_of({"scale_factor": K_G})).ax[1:] - G0).max() > 1e-4
    with pytest.raises(piga.CalibrationError, match=r"method: 'best' is not known(?s:.*)exact, published"):
        piga.compensate(run, calibration_of(CAL), method="best")
    many = {**CAL} | {f"{name}{order}": 1e-6 for order in range(2, 24) for name in "sc"}
    with pytest.raises(piga.CalibrationError, match=r"48 uncertain coefficients .* at most 40"):
        piga.compensate(run, calibration_of(many, dict.fromkeys(many, 1e-7)))
    joint = calibration_of(CAL, serial="A")
    own = [replace(c, run="east") if c.name == "k0" else c for c in joint.coefficients]
    record = piga.records.calibration.calibration.RunRecord(
        "east", "east.csv", None, "shared", True, 9, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, joint.quality
    )
    joint = replace(joint, coefficients=tuple(own), runs=(record,))
    with pytest.raises(piga.CalibrationError, match=r"k0 differs between the runs(?s:.*)--as-run east"):
        piga.compensate(run, joint)
    assert np.isfinite(piga.compensate(run, joint.for_run("east")).ax[1:]).all()


def test_age() -> None:
    """A date without a zone is taken as UTC; one that cannot be read is too old for any limit."""
    made = dt.datetime.now(dt.UTC) - dt.timedelta(days=10)
    for created in (made.isoformat(), made.replace(tzinfo=None).isoformat(), "last week"):
        cal = calibration_of(CAL, created=created)
        run = run_of(T, F, phi=0.3)
        assert piga.compensate(run, cal, max_age_days=10.1).flagged("age")[1:].all() == (created == "last week")
        assert piga.compensate(run, cal, max_age_days=9.9).flagged("age")[1:].all()
        assert not piga.compensate(run, cal).flagged("age").any()


def test_results_as_files(tmp_path: Path) -> None:
    compensated = piga.compensate(run_of(T, F, phi=0.3), calibration_of(CAL, {"k0": 1e-6}))
    compensated.to_parquet(tmp_path / "a.parquet")
    compensated.to_csv(tmp_path / "a.csv")
    parquet, csv = pa.parquet.read_table(tmp_path / "a.parquet"), pa.csv.read_csv(tmp_path / "a.csv")
    for index, name in enumerate(("t", "ax", "dv", "u_ax", "flags")):
        np.testing.assert_array_equal(parquet.column(name).to_numpy(), getattr(compensated, name))
        np.testing.assert_array_equal(csv.column(index).to_numpy().astype(float), getattr(compensated, name))


# --- sets


def mounted(**values: float) -> list[Mounted]:
    return [Mounted(calibration_of({**CAL, **values}), axes) for axes in orthogonal()]


PSI = np.tile(0.9 * T, (3, 1))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"output": PSI[:2]}, r"output: shape \(2, 60\) instead of \(3, 60\)"),
        ({"output": PSI, "rate": PSI}, "not allowed for a set of angles"),
        ({"output": PSI, "base_rate": np.zeros((3, 60, 2))}, r"base_rate: shape"),
        ({"output": PSI, "temperature": np.zeros((2, 60))}, r"temperature: shape"),
        ({"output": np.where(np.arange(60) == 7, np.nan, PSI)}, r"output\[0, 7\] is not finite"),
    ],
)
def test_samples_of_a_set_that_do_not_fit(given: dict[str, np.ndarray], message: str) -> None:
    stream = SetCompensator(mounted())
    before = stream.push(T[:1] - 0.01, PSI[:, :1]).size
    with pytest.raises(piga.ArgumentError, match=message):
        stream.push(T, **given)  # type: ignore[arg-type]
    assert stream.push(T, PSI).size == T.size
    assert before == 1


@pytest.mark.parametrize(
    ("values", "logged", "change"),
    [({"k0_T": 1e-4}, {"temperature": 303.15}, 1e-3), ({"k2v": 1e-3}, {"vibration": 2.0 * G0}, 4e-3)],
)
def test_what_else_a_set_must_log(values: dict[str, float], logged: dict[str, float], change: float) -> None:
    """The change is in g; each couples into the others."""
    items = mounted(**values)
    with pytest.raises(piga.CalibrationError, match=f"no {next(iter(logged))} is given"):
        SetCompensator(items).push(T, PSI)
    columns = {name: np.full((3, 60), value) for name, value in logged.items()}
    moved = SetCompensator(mounted()).push(T, PSI).f - SetCompensator(items).push(T, PSI, **columns).f
    assert np.abs(moved[1:] - change * G0).max() < 2.0 * TAN_BETA * change * G0


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        (np.eye(2), r"axes of instrument 1: shape \(2, 2\)"),
        (np.full((3, 3), np.nan), "axes of instrument 1"),
        (np.diag([1.0, 1.0, -1.0]), "instrument 1: the rows are not a right-handed set"),
        (np.eye(3) * 1.001, "not a right-handed set"),
        (np.eye(3), "the input axes lie in one plane"),
    ],
)
def test_axes_that_are_none(axes: np.ndarray, message: str) -> None:
    items = mounted()
    items[1] = replace(items[1], axes=axes)
    with pytest.raises(piga.ArgumentError, match=message):
        SetCompensator(items)


def test_sets_of_records_that_do_not_fit() -> None:
    records = [run_of(T, np.roll(F, -i, axis=1), phi=0.3) for i in range(3)]
    with pytest.raises(piga.ArgumentError, match="a set of 2 instruments"):
        compensate_set(records[:2], mounted()[:2])
    other = run_of(T, F, phi=0.3, kind="rate")
    with pytest.raises(
        piga.DataError, match="record 2: the output is of kind 'rate', that of record 0 is 'angle'"
    ):
        compensate_set([*records[:2], other], mounted())
    with pytest.raises(piga.DataError, match="record 2: has 61 rows that can be used, record 0 has 60"):
        compensate_set(
            [*records[:2], run_of(np.append(T, 0.6), np.append(F, F[:1], axis=0), phi=0.3)], mounted()
        )


def test_set_whose_times_differ_is_refused_by_name(tmp_path: Path) -> None:
    runs = [write(tmp_path, f"{name}.parquet", rows=200) for name in "xyz"]
    table = pa.parquet.read_table(tmp_path / "z.parquet")
    late = table["t"].to_numpy() + np.where(np.arange(200) > 150, 1e-4, 0.0)
    pa.parquet.write_table(table.set_column(0, "t", pa.array(late)), tmp_path / "z.parquet")
    mounted = [Mounted(calibration_of(CAL, serial="A"), axes) for axes in orthogonal()]
    with pytest.raises(
        piga.DataError, match=r"z\.toml: row 152, t = 1\.51\d* s: the times are not those of .*x\.toml"
    ):
        compensate_set([read_member(path) for path in runs], mounted)


def test_base_rate_of_some_instruments_of_a_set() -> None:
    """Those without one are taken as at rest in their base."""
    rate = np.tile([1e-4, 2e-3, -1e-3], (T.size, 1))
    records = [run_of(T, np.roll(F, -i, axis=1), phi=0.3, base_rate=rate if i == 1 else None) for i in range(3)]
    compensated = compensate_set(records, mounted(k0=0.0))
    assert np.abs(compensated.f[1:] - F[1:]).max() < 1e-9 * G0


def test_triad_files_that_are_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    item = (
        '[[triad.instrument]]\nrun = "run.toml"\ncalibration = "run.json"\naxes = [[1,0,0],[0,1,0],[0,0,1]]\n'
    )
    path = tmp_path / "triad.toml"
    write(tmp_path)
    path.write_text(2 * item)
    with pytest.raises(piga.RunFileError, match=r"\[\[triad\.instrument\]\] occurs 2 times"):
        read_triad(path)
    path.write_text(3 * item)
    code, _, text = command(monkeypatch, capsys, path, "--out", tmp_path / "o.parquet")
    assert code == 2
    assert "the input axes lie in one plane" in text
    path.write_text(3 * item.replace("run.json", "none.json"))
    with pytest.raises(piga.CalibrationError, match=r"none\.json: cannot be read"):
        read_triad(path)
    path.write_text(3 * (item + 'phase = "2 g"\n'))
    with pytest.raises(piga.PigaError, match="phase"):
        read_triad(path)
    path.write_text(3 * (item + 'phase = "90 deg"\n'))
    assert read_triad(path)[1][0].phase == Phase(np.pi / 2.0)
    path.write_text("[triad\n")
    code, _, text = command(
        monkeypatch, capsys, path, "--calibration", tmp_path / "run.json", "--out", tmp_path / "o.parquet"
    )
    assert code == 2
    assert "not valid TOML" in text


@pytest.mark.parametrize("kind", ["angle", "rate"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e308])
def test_samples_that_begin_a_stretch_are_checked_too(kind: str, bad: float) -> None:
    """The first one and one behind a gap have no increment that would show it; the state stays as it was."""
    stream = piga.Compensator(calibration_of(CAL), kind=kind)
    good = {"t": T[:3], "output": np.zeros(3), "f": F[:3]}
    for first in (True, False):
        time = 0.0 if first else 100.0
        for name in ("output", "f", "t"):
            values = {"t": np.array([time, time + 0.01]), "output": np.zeros(2), "f": F[:2].copy()}
            values[name][0] = bad
            before = stream.state
            with pytest.raises(piga.ArgumentError, match=r"not finite|too large"):
                stream.push(values)
            assert stream.state.tobytes() == before.tobytes()
        stream.push(good)


def test_names_of_files_are_answered_by_what_to_pass(tmp_path: Path) -> None:
    with pytest.raises(
        piga.ArgumentError, match=r"pass piga.read_run\('run.toml'\) and piga.Calibration.from_json"
    ):
        piga.compensate(str(write(tmp_path, rows=50)), calibration_of(CAL))  # type: ignore[arg-type]


# --- the command


def test_words_of_the_command_that_do_not_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, cal = write(tmp_path), tmp_path / "run.json"
    for words, message in (
        (
            (run, "--calibration", cal, "--out", tmp_path / "o.txt"),
            f"piga: {tmp_path / 'o.txt'}: piga does not write",
        ),
        ((run, "--calibration", cal, "--calibration", cal, "--out", tmp_path / "o.csv"), "is given 2 times"),
        ((run, run, "--calibration", cal, "--out", tmp_path / "o.csv"), "2 run files: piga cannot know"),
        (
            (run, "--calibration", cal, "--out", tmp_path / "o.csv", "--kind", "rate"),
            "--kind is not for a run file",
        ),
    ):
        code, _, text = command(monkeypatch, capsys, *words)
        assert code == 2
        assert message in text
    assert not list(tmp_path.glob("o.*"))
