"""What cannot be compensated as asked is refused with what to do; the edges of what can be are computed right."""

from __future__ import annotations

import datetime as dt
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest

import piga
from piga.compensation import FLAGS, Mounted, Phase, Resampler, SetCompensator, compensate_set
from piga.compensation.files.live import Bounded, _field, compensate_arrow, compensate_lines, unpacked_size
from piga.compensation.model import MEANING, age_in_days, describe
from piga.compensation.sets.set_compensator import PublishedSet
from piga.compensation.sets.set_files import read_triad
from piga.units import G0
from tests.compensation.run_files import CAL, command, write
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
    with pytest.raises(piga.ArgumentError, match="the calibration has temperature terms"):
        piga.Compensator(warm).push({"t": T, "output": T, "f": F})
    with pytest.raises(piga.CalibrationError, match="the record has no temperature"):
        piga.compensate(run_of(T, F, phi=0.3), warm)


def test_nothing_and_single_samples() -> None:
    """An empty chunk changes nothing; time that stands begins a stretch even before an interval is known."""
    run, cal = run_of(T, F, phi=0.3), calibration_of(CAL)
    whole = piga.compensate(run, cal)
    stream = piga.Compensator(cal)
    assert stream.push({"t": T[:0], "output": T[:0], "f": F[:0]}).size == 0
    seen = [
        stream.push({"t": t, "output": psi, "f": f}) for t, psi, f in zip(run.t, run.output, run.f, strict=True)
    ]
    assert np.concatenate([part.ax for part in seen]).tobytes() == whole.ax.tobytes()
    again = piga.Compensator(cal)
    again.push({"t": 1.0, "output": 0.0, "f": F[0]})
    stood = again.push({"t": 1.0, "output": 0.1, "f": F[0]})
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
    with pytest.raises(piga.CalibrationError, match="uncertain coefficients; at most 40"):
        piga.compensate(run, calibration_of(many, dict.fromkeys(many, 1e-7)))
    joint = calibration_of(CAL, serial="A")
    own = [replace(c, run="east") if c.name == "k0" else c for c in joint.coefficients]
    record = piga.records.calibration.RunRecord(
        "east", "east.csv", None, "shared", True, 9, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, joint.quality
    )
    joint = replace(joint, coefficients=tuple(own), runs=(record,))
    with pytest.raises(piga.CalibrationError, match=r"k0 differs between the runs(?s:.*)for_run\('east'\)"):
        piga.compensate(run, joint)
    assert np.isfinite(piga.compensate(run, joint.for_run("east")).ax[1:]).all()


def test_age() -> None:
    """A date without a zone is taken as UTC; one that cannot be read is too old for any limit."""
    now = dt.datetime(2026, 1, 11, tzinfo=dt.UTC)
    for created, days in (("2026-01-01T00:00:00Z", 10.0), ("2026-01-01T12:00:00", 9.5), ("last week", None)):
        cal = calibration_of(CAL, created=created)
        assert age_in_days(cal, now) == days
        run = run_of(T, F, phi=0.3)
        assert piga.compensate(run, cal, max_age_days=1e5).flagged("age")[1:].all() == (days is None)
        assert piga.compensate(run, cal, max_age_days=0.5).flagged("age")[1:].all()
        assert not piga.compensate(run, cal).flagged("age").any()


def test_flags_in_words() -> None:
    assert set(FLAGS) == set(MEANING)
    assert describe(0) == ()
    assert describe(FLAGS["locked"] | FLAGS["coarse"]) == ("locked", "coarse")


def test_results_as_files(tmp_path: Path) -> None:
    compensated = piga.compensate(run_of(T, F, phi=0.3), calibration_of(CAL, {"k0": 1e-6}))
    compensated.to_parquet(tmp_path / "a.parquet")
    compensated.to_csv(tmp_path / "a.csv")
    parquet, csv = pa.parquet.read_table(tmp_path / "a.parquet"), pa.csv.read_csv(tmp_path / "a.csv")
    for index, name in enumerate(("t", "ax", "dv", "u_ax", "flags")):
        np.testing.assert_array_equal(parquet.column(name).to_numpy(), getattr(compensated, name))
        np.testing.assert_array_equal(csv.column(index).to_numpy().astype(float), getattr(compensated, name))


# --- the phase


def test_a_phase_that_cannot_be_found() -> None:
    with pytest.raises(piga.CalibrationError, match="no cross-coupling: there is no phase to find"):
        piga.compensation.PhaseFinder(calibration_of({"scale_factor": K_G, "k0": 1e-3}))
    t = 0.01 * np.arange(3000)
    cal = calibration_of(CAL, angle_rms=1e-6)
    still = run_of(t[:100], constant_force(t[:100], 1.0, 3.0), phi=0.3)
    with pytest.raises(piga.CalibrationError, match=r"the output does not turn once in the first 0\.5 s"):
        piga.compensation.identify_phase(still, cal, 0.5)
    alone = run_of(t, constant_force(t, 1.0, 0.0), phi=0.3)
    with pytest.raises(piga.CalibrationError, match=r"does not turn once|more transverse specific force"):
        piga.compensation.identify_phase(alone, cal, 30.0)
    weak = run_of(t, constant_force(t, 1.0, 1e-3), phi=0.3)
    noisy = calibration_of(CAL, angle_rms=1e-4)
    with pytest.raises(piga.CalibrationError, match=r"known to .* rad only after 30 s(?s:.*)more transverse"):
        piga.compensation.identify_phase(weak, noisy, 30.0)


def test_the_phase_of_a_record_of_rates_up_to_its_first_gap() -> None:
    """Behind the gap another phase begins: it must not be looked at."""
    t = 0.01 * np.arange(3000)
    f = constant_force(t, 1.0, 3.0)
    first, second = run_of(t, f, phi=0.3, kind="rate"), run_of(t, f, phi=2.0, kind="rate")
    record = piga.Run.from_arrays(
        np.concatenate((t, t + 100.0)), np.concatenate((first.output, second.output)), np.concatenate((f, f)),
        scale_factor=K_G / G0, kind="rate", segment=np.repeat([0, 1], t.size),
    )  # fmt: skip
    cal = calibration_of(CAL, angle_rms=1e-6)
    phase = piga.compensation.identify_phase(record, cal, 1000.0)
    assert abs(phase.value - 0.3) < 1e-3
    by_angle = piga.compensation.identify_phase(run_of(t, f, phi=0.3), cal, 30.0)
    assert abs(phase.value - by_angle.value) < 1e-3


# --- sets


def mounted(**values: float) -> list[Mounted]:
    return [Mounted(calibration_of({**CAL, **values}), np.roll(np.eye(3), -i, axis=0)) for i in range(3)]


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


def test_one_sample_of_a_set_at_a_time() -> None:
    whole = SetCompensator(mounted()).push(T, PSI)
    stream = SetCompensator(mounted())
    parts = [stream.push(t, PSI[:, k]) for k, t in enumerate(T[:12])]
    assert np.concatenate([part.f for part in parts]).tobytes() == whole.f[:12].tobytes()


def test_temperature_of_a_set() -> None:
    warm = [replace(item, calibration=calibration_of({**CAL, "k0_T": 1e-4})) for item in mounted()]
    with pytest.raises(
        piga.ArgumentError, match="temperature: missing, and a calibration has temperature terms"
    ):
        SetCompensator(warm).push(T, PSI)
    cold = SetCompensator(warm).push(T, PSI, temperature=np.full((3, 60), 293.15)).f
    hot = SetCompensator(warm).push(T, PSI, temperature=np.full((3, 60), 303.15)).f
    plain = SetCompensator(mounted()).push(T, PSI).f
    assert np.abs(cold[1:] - plain[1:]).max() < 1e-12
    change = 10.0 * 1e-4 * G0
    assert np.abs((plain - hot)[1:] - change).max() < 2.0 * TAN_BETA * change  # each couples into the others


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        (np.eye(2), r"axes of instrument 1: shape \(2, 2\)"),
        (np.full((3, 3), np.nan), "axes of instrument 1"),
        (np.diag([1.0, 1.0, -1.0]), "not a right-handed set"),
        (np.eye(3) * 1.001, "not a right-handed set"),
    ],
)
def test_axes_that_are_none(axes: np.ndarray, message: str) -> None:
    items = mounted()
    items[1] = replace(items[1], axes=axes)
    with pytest.raises(piga.ArgumentError, match=message):
        SetCompensator(items)


def test_sets_of_records_that_do_not_fit() -> None:
    records = [run_of(T, np.roll(F, -i, axis=1), phi=0.3) for i in range(3)]
    with pytest.raises(piga.ArgumentError, match=r"method: 'best' is not known"):
        compensate_set(records, mounted(), method="best")
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


def test_base_rate_of_some_instruments_of_a_set() -> None:
    """Those without one are taken as at rest in their base."""
    rate = np.tile([1e-4, 2e-3, -1e-3], (T.size, 1))
    records = [run_of(T, np.roll(F, -i, axis=1), phi=0.3, base_rate=rate if i == 1 else None) for i in range(3)]
    plain = [Mounted(calibration_of({**CAL, "k0": 0.0}), np.roll(np.eye(3), -i, axis=0)) for i in range(3)]
    compensated = compensate_set(records, plain)
    assert np.abs(compensated.f[1:] - F[1:]).max() < 1e-9 * G0


def test_nothing_for_a_published_set() -> None:
    stream = PublishedSet(mounted())
    assert stream.push(T[:0], PSI[:, :0]).size == 0
    assert stream.push(T, PSI).size == 60


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


# --- streams through a pipe


def test_base_rate_and_temperature_through_a_pipe() -> None:
    rate, warm = np.tile([1e-4, 2e-3, -1e-3], (T.size, 1)), 293.15 + 5.0 * T
    run = run_of(T, F, phi=0.3, base_rate=rate, temperature=warm)
    cal = calibration_of({**CAL, "k0_T": 1e-4})
    names = "t, output, fx, fy, fz, wx, wy, wz, temperature"
    rows = np.column_stack((run.t, run.output, F, rate, warm)).tolist()
    text = "\n\n".join([names, *(",".join(map(repr, row)) for row in rows), ""])
    answer = io.StringIO()
    assert compensate_lines(io.StringIO(text), answer, piga.Compensator(cal)) == T.size
    ax = np.array([line.split(",")[1] for line in answer.getvalue().splitlines()[1:]], dtype=float)
    assert ax.tobytes() == piga.compensate(run, cal).ax.tobytes()


@pytest.mark.parametrize(
    ("header", "message"),
    [("t,output,fx,fy", "no column 'fz'"), ("t,output,fx,fy,fz,speed", "the unknown column 'speed'")],
)
def test_columns_of_a_pipe(header: str, message: str) -> None:
    stream = piga.Compensator(calibration_of(CAL))
    with pytest.raises(piga.DataError, match=f"standard input: {message}"):
        compensate_lines(io.StringIO(header + "\n"), io.StringIO(), stream)
    table = pa.table({name: [1.0] for name in header.split(",")})
    sent = io.BytesIO()
    with pa.ipc.new_stream(sent, table.schema) as writer:
        writer.write_table(table)
    sent.seek(0)
    with pytest.raises(piga.DataError, match=f"standard input: {message}"):
        compensate_arrow(sent, io.BytesIO(), stream)


def test_names_of_a_pipe_stand_once_and_base_rates_together() -> None:
    stream = piga.Compensator(calibration_of(CAL))
    for header, message in (
        ("t,output,fx,fy,fz,fx", "the column 'fx' occurs twice"),
        ("t,output,fx,fy,fz,wx,wz", "no column 'wy', but the other base rates"),
        ("", "no column 't'"),
    ):
        with pytest.raises(piga.DataError, match=f"standard input: {message}"):
            compensate_lines(io.StringIO(header + "\n"), io.StringIO(), stream)


NO_NUMBERS = [
    "nan",
    "inf",
    "-Infinity",
    "0_14",
    "\uff11\uff12",
    "1e999",
    "0x10",
    "",
    "1 2",
    "\u0661",
    "1e",
    "--1",
    "\0",
]
"""What Python's float() takes for a number, or a logger writes in place of one."""


@pytest.mark.parametrize("cell", NO_NUMBERS)
@pytest.mark.parametrize("row", [0, 2, 4], ids=["first row", "after a row", "after a gap"])
def test_cells_of_a_pipe_that_are_no_numbers(cell: str, row: int) -> None:
    """Refused with their line wherever they stand; the rows before are answered."""
    table = [[0.01 * i + (5.0 if i >= 4 else 0.0), 0.1 * i, 9.8, 1.0, 0.0] for i in range(6)]
    texts = [",".join(map(repr, values)) for values in table]
    for column in range(5):
        cells = texts[row].split(",")
        cells[column] = cell
        sent = "\n".join(["t,output,fx,fy,fz", *texts[:row], ",".join(cells), *texts[row + 1 :], ""])
        answer = io.StringIO()
        with pytest.raises(
            piga.DataError, match=f"standard input: line {row + 2}: .* is not a row of 5 numbers"
        ):
            compensate_lines(io.StringIO(sent), answer, piga.Compensator(calibration_of(CAL)))
        assert answer.getvalue().count("\n") == (row + 1 if row else 0)


def test_a_line_without_end() -> None:
    """Memory does not grow with it; and a last line that is cut is not taken for a shorter number."""

    class Endless(io.TextIOBase):
        asked = 0

        def readline(self, size: int = -1) -> str:  # type: ignore[override]
            assert 0 < size <= 1 << 20
            self.asked += size
            return "1" * size if self.asked > size else "t,output,fx,fy,fz\n"

    stream = piga.Compensator(calibration_of(CAL))
    with pytest.raises(piga.DataError, match=r"line 2 is longer than 65536 characters"):
        compensate_lines(Endless(), io.StringIO(), stream)
    answer = io.StringIO()
    with pytest.raises(piga.DataError, match=r"line 3 has no end: the stream was cut off"):
        compensate_lines(io.StringIO("t,output,fx,fy,fz\n0,0,9.8,1,0\n0.01,0.1,9.8,1,0.12"), answer, stream)
    assert answer.getvalue().count("\n") == 2


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


@pytest.mark.parametrize("compression", [None, "lz4"])
def test_cut_and_damaged_arrow_streams(compression: str | None) -> None:
    """Every length of a stream, and many a changed byte: answered, or refused in words."""
    table = pa.table({name: np.arange(4.0) for name in ("t", "output", "fx", "fy", "fz")})
    sent = io.BytesIO()
    with pa.ipc.new_stream(
        sent, table.schema, options=pa.ipc.IpcWriteOptions(compression=compression)
    ) as writer:
        writer.write_table(table, 2)
    whole = sent.getvalue()
    draw = np.random.default_rng(3)
    cases = [whole[:length] for length in range(0, len(whole), 23)]
    for _ in range(80):
        changed = bytearray(whole)
        changed[draw.integers(len(whole))] = draw.integers(256)
        cases.append(bytes(changed))
    cal = calibration_of(CAL)
    for case in cases:
        try:
            with np.errstate(all="ignore"):  # compiled kernels do not warn
                compensate_arrow(io.BytesIO(case), io.BytesIO(), piga.Compensator(cal))
        except piga.DataError as error:
            assert str(error).startswith("standard input: ")  # noqa: PT017 - either outcome is right


@pytest.mark.parametrize("kind", [0, 2, 3, 4, 5, 6, 255])
def test_only_a_schema_is_read_as_a_schema(kind: int) -> None:
    """The type of the first message is damaged: PyArrow reads its content as a schema all the same, and crashes."""
    sent = bytearray(packed_stream(4))
    message = pa.ipc.MessageReader.open_stream(bytes(sent)).read_next_message()
    metadata = bytes(message.metadata)
    at = _field(metadata, int.from_bytes(metadata[:4], "little"), 1)
    start = sent.index(metadata)
    assert sent[start + at] == 1
    sent[start + at] = kind
    with pytest.raises(piga.DataError, match="no Arrow stream"):
        compensate_arrow(io.BytesIO(sent), io.BytesIO(), piga.Compensator(calibration_of(CAL)))


TIMES = {
    "repeat": [0.0, 0.01, 0.02, 0.02, 0.03],
    "go back": [0.0, 0.01, 0.02, 0.01, 0.02],
    "leave a gap": [0.0, 0.01, 0.02, 5.0, 5.01],
    "go back from the start": [0.0, -1.0, -2.0, -3.0, -4.0],
}


@pytest.mark.parametrize("kind", list(TIMES))
@pytest.mark.parametrize("rows", [1, 2, 5])
def test_both_doors_begin_a_stretch_at_the_same_rows(kind: str, rows: int) -> None:
    """Times that repeat, go back or leave a gap: no increment into that row (flag 1, dv 0, ax nan), through either door."""
    t = TIMES[kind]
    columns = {"t": t, "output": [0.1 * i for i in range(5)], "fx": [9.8] * 5, "fy": [1.0] * 5, "fz": [0.0] * 5}
    table, sent, got, said = pa.table(columns), io.BytesIO(), io.BytesIO(), io.StringIO()
    with pa.ipc.new_stream(sent, table.schema) as writer:
        writer.write_table(table, rows)
    sent.seek(0)
    compensate_arrow(sent, got, piga.Compensator(calibration_of(CAL)))
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in zip(*columns.values(), strict=True)), ""]
    compensate_lines(io.StringIO("\n".join(lines)), said, piga.Compensator(calibration_of(CAL)))
    batches = pa.ipc.open_stream(got.getvalue()).read_all()
    told = np.array([line.split(",") for line in said.getvalue().split()[1:]], float)
    for number, name in enumerate(said.getvalue().split()[0].split(",")):
        np.testing.assert_array_equal(batches.column(name).to_numpy(), told[:, number], err_msg=name)
    begins = np.diff(t, prepend=-1.0)
    begins = (begins <= 0.0) | (begins > 0.015)
    np.testing.assert_array_equal(batches.column("flags").to_numpy(), begins.astype(int))
    assert not batches.column("dv").to_numpy()[begins].any()
    assert np.isnan(batches.column("ax").to_numpy()[begins]).all()


def packed_stream(rows: int, compression: str | None = "zstd") -> bytes:
    """One batch of columns that hold one value."""
    table = pa.table({name: np.zeros(rows) for name in ("t", "output", "fx", "fy", "fz")})
    sent, options = io.BytesIO(), pa.ipc.IpcWriteOptions(compression=compression)
    with pa.ipc.new_stream(sent, table.schema, options=options) as writer:
        writer.write_table(table)
    return sent.getvalue()


def test_an_arrow_batch_is_measured_before_it_is_unpacked() -> None:
    """80 MB in a few kB: refused without being unpacked; a small batch is taken."""
    stream = piga.Compensator(calibration_of(CAL))
    before = pa.total_allocated_bytes()
    with pytest.raises(piga.DataError, match=r"a batch of [0-9]+ bytes unpacks to 160000000"):
        compensate_arrow(io.BytesIO(packed_stream(2_000_000)), io.BytesIO(), stream)
    assert pa.total_allocated_bytes() - before < 1 << 20
    assert compensate_arrow(io.BytesIO(packed_stream(2000)), io.BytesIO(), stream) == 2000


@pytest.mark.only_compiled
def test_a_large_arrow_batch_that_is_not_packed_is_taken() -> None:
    stream = piga.Compensator(calibration_of(CAL))
    assert compensate_arrow(io.BytesIO(packed_stream(1_000_000, None)), io.BytesIO(), stream) == 1_000_000


def test_size_of_an_arrow_batch() -> None:
    """Its rows as doubles, and its buffers as they will be, whatever the packing."""
    for compression in ("zstd", "lz4", None):
        for rows in (1, 1000):
            reader = pa.ipc.MessageReader.open_stream(packed_stream(rows, compression))
            reader.read_next_message()
            message = reader.read_next_message()
            assert unpacked_size(bytes(message.metadata), message.body) == 2 * 5 * 8 * rows


def test_lengths_that_are_damage_cost_no_memory() -> None:
    with pytest.raises(OSError, match="more than 2048 MiB"):
        Bounded(io.BytesIO()).read(1 << 40)


def test_arrow_columns_that_hold_no_numbers() -> None:
    columns = {name: pa.array([1.0]) for name in ("t", "output", "fx", "fy")}
    for column in (pa.array(["0_14"]), pa.array([[1.0]]), pa.array([True])):
        table, sent = pa.table(columns | {"fz": column}), io.BytesIO()
        with pa.ipc.new_stream(sent, table.schema) as writer:
            writer.write_table(table)
        sent.seek(0)
        with pytest.raises(piga.DataError, match=r"column 'fz' holds .*, not numbers"):
            compensate_arrow(sent, io.BytesIO(), piga.Compensator(calibration_of(CAL)))


def test_no_arrow_stream_and_an_empty_one() -> None:
    stream = piga.Compensator(calibration_of(CAL))
    with pytest.raises(piga.DataError, match="standard input: no Arrow stream"):
        compensate_arrow(io.BytesIO(b"t,output,fx,fy,fz\n"), io.BytesIO(), stream)
    schema = pa.schema([(name, pa.float64()) for name in ("t", "output", "fx", "fy", "fz")])
    sent, got = io.BytesIO(), io.BytesIO()
    pa.ipc.new_stream(sent, schema).close()
    sent.seek(0)
    assert compensate_arrow(sent, got, stream) == 0
    assert got.getvalue() == b""


# --- resampling, and the command


def test_periods_that_are_none() -> None:
    for period in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(piga.ArgumentError, match=r"period: .* is not positive"):
            Resampler(period)
    new = Resampler(0.03)
    assert new.waiting.size == 0
    _, given = new.push(T[:8], np.ones(8))
    np.testing.assert_allclose(given, [4.0, 3.0])  # the first sample's goes out with the three behind it
    np.testing.assert_allclose(new.waiting, [1.0])


def test_words_of_the_command_that_do_not_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, cal = write(tmp_path), tmp_path / "run.json"
    for words, message in (
        ((run, "--calibration", cal, "--out", tmp_path / "o.txt"), "piga does not write files of kind '.txt'"),
        ((run, "--calibration", cal, "--calibration", cal, "--out", tmp_path / "o.csv"), "is given 2 times"),
        ((run, run, "--calibration", cal, "--out", tmp_path / "o.csv"), "2 runs and 1 calibrations"),
    ):
        code, _, text = command(monkeypatch, capsys, *words)
        assert code == 2
        assert message in text
    assert not list(tmp_path.glob("o.*"))
