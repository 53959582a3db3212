"""Envelopes against the samples themselves, for random records, zooms and gaps; large files: the first picture, zooms."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from piga.errors import ArgumentError
from piga.records import Run
from piga.records.run_file import read_run_file
from piga.units import G0
from piga.workbench import signals
from piga.workbench.signals import Outline, picture, read_outline, write_envelopes
from tests.workbench.conftest import entered, memory, wait_until


def record(size: int, gaps: list[int], seed: int = 1) -> Run:
    """A record with steps in time after the given samples."""
    generator = np.random.default_rng(seed)
    t = 0.01 * np.arange(size)
    for gap in gaps:
        t[gap:] += generator.uniform(1.0, 5.0)
    output = np.cumsum(generator.normal(size=size))
    f = np.column_stack((np.full(size, 9.8), generator.normal(size=size), np.zeros(size)))
    return Run.from_arrays(t, output, f, scale_factor="0.8884 rad/s/g", serial="A", units="SI")


RUN = """[instrument]
serial = "a"
scale_factor = "0.8884 rad/s/g"
[data]
file = "a.csv"
output = { column = "a", kind = "angle", unit = "rad" }
time = { column = "t", unit = "s" }
temperature = { column = "T", unit = "UNIT" }
reference = { columns = ["x", "y", "z"], unit = "g" }
leave_out = [{ rows = [11, 20], reason = "door" }]
"""


def write(run: Run, folder: Path, unit: str = "K") -> Outline:
    """The envelopes of a record, with a run file that leaves rows out."""
    return write_envelopes(run, read_run_file(Path("run.toml"), RUN.replace("UNIT", unit).encode()), folder)


@settings(max_examples=60, deadline=None)
@given(
    size=st.integers(2, 30_000),
    gaps=st.lists(st.integers(1, 29_999), max_size=6),
    ends=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
    width=st.integers(1, 3000),
    key=st.sampled_from(["output", "fX", "fY", "fZ"]),
    drawn=st.sampled_from([0, 1 << 18]),
)
def test_no_peak_is_lost_and_none_invented(
    tmp_path_factory: pytest.TempPathFactory,
    size: int,
    gaps: list[int],
    ends: tuple[float, float],
    width: int,
    key: str,
    drawn: int,
) -> None:
    run = record(size, sorted({gap for gap in gaps if gap < size}))
    cache = tmp_path_factory.mktemp("envelopes") / "a-1"
    outline = write(run, cache)
    values = 0.5 / np.pi * run.output if key == "output" else 1.0 / G0 * run.f[:, "XYZ".index(key[1])]
    first, last = sorted(end * outline.duration for end in ends)
    if first == last:
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(signals, "DRAWN", drawn)  # from the samples, or from the blocks
        rows = picture(cache, [key], first, last, width)
    t = run.t - run.t[0]
    inside = (t >= first) & (t <= last)
    rows = rows[~np.isnan(rows[:, 1])]
    if inside.any():
        assert rows[:, 1].min() <= values[inside].min()
        assert rows[:, 2].max() >= values[inside].max()
    assert rows[:, 1].min() >= values.min()
    assert rows[:, 2].max() <= values.max()
    assert np.all(np.diff(rows[:, 0]) > 0.0)
    assert np.all(np.isin(rows[:, 0], t))


@pytest.mark.parametrize("drawn", [0, 1 << 18])
@pytest.mark.parametrize("width", [3, 50, 1000])
def test_no_stroke_joins_two_positions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, drawn: int, width: int
) -> None:
    """Two positions of constant force, neither a whole number of blocks: each row holds one of them, a gap lies between."""
    levels = np.repeat([1.0, 5.0, 1.0], [3001, 2003, 2500])
    t = 0.01 * np.arange(levels.size) + np.repeat([0.0, 10.0, 20.0], [3001, 2003, 2500])
    f = np.column_stack((levels, 0.0 * levels, 0.0 * levels))
    run = Run.from_arrays(t, np.cumsum(levels), f, scale_factor="0.8884 rad/s/g", serial="A", units="SI")
    outline = write(run, tmp_path / "a-1")
    monkeypatch.setattr(signals, "DRAWN", drawn)
    rows = picture(tmp_path / "a-1", ["fX"], 0.0, outline.duration, width)
    drawn_rows = rows[~np.isnan(rows[:, 1])]
    np.testing.assert_array_equal(drawn_rows[:, 1], drawn_rows[:, 2])
    assert int(np.isnan(rows[:, 1]).sum()) == 2


def test_the_difference_is_the_angle_minus_what_k_makes_of_the_force(tmp_path: Path) -> None:
    """By the trapezoidal rule from sample to sample, anew in each stretch."""
    run = record(3000, [1000, 2001])
    write(run, tmp_path / "a-1")
    shown = np.radians(np.load(tmp_path / "a-1" / "1.npy"))
    value = 0.0
    for index in range(1, run.size):
        step = run.t[index] - run.t[index - 1]
        force = 0.5 * (run.f[index, 0] + run.f[index - 1, 0])
        value += run.output[index] - run.output[index - 1] - run.scale_factor * force * step
        value = 0.0 if run.begins[index] else value
        assert shown[index] == pytest.approx(value, abs=1e-9)


def test_moves_at_the_ends_of_positions_are_seen_and_a_turning_stand_is_not_one(tmp_path: Path) -> None:
    n, angle = 3000, np.repeat([0.0, 1.0, 2.0], 1000)
    angle[1000:1040] = np.linspace(0.0, 1.0, 40)
    angle[1990:2000] = np.linspace(1.0, 1.2, 10)
    t, f = 0.01 * np.arange(n), 9.8 * np.column_stack((np.cos(angle), np.sin(angle), np.zeros(n)))
    common = {"scale_factor": "0.8884 rad/s/g", "segment": np.repeat([0, 1, 2], 1000).astype(np.int32)}
    outline = write(Run.from_arrays(t, t, f, **common, units="SI"), tmp_path / "a-1")
    assert [(one.name, one.rows) for one in outline.moves] == [("1", (1001, 1039)), ("1", (1992, 2000))]
    turning = 9.8 * np.column_stack((np.cos(t), np.sin(t), np.zeros(n)))
    assert write(Run.from_arrays(t, t, turning, **common, units="SI"), tmp_path / "b-1").moves == ()
    assert outline.left_out[0].name == "door"
    assert (outline.left_out[0].first, outline.left_out[0].last) == (pytest.approx(0.10), pytest.approx(0.20))


@pytest.mark.parametrize(
    ("key", "first", "last", "width"),
    [("nothing", 0.0, 1.0, 10), ("../t", 0.0, 1.0, 10), ("output", 1.0, 0.0, 10), ("output", float("nan"), 1.0, 10),
     ("output", 0.0, 1.0, 0), ("output", 0.0, 1.0, 10**9)],
)  # fmt: skip
def test_wrong_questions(tmp_path: Path, key: str, first: float, last: float, width: int) -> None:
    write(record(100, []), tmp_path / "a-1")
    with pytest.raises(ArgumentError):
        picture(tmp_path / "a-1", [key], first, last, width)


def test_temperature_is_shown_in_the_unit_of_the_record(tmp_path: Path) -> None:
    t = 0.01 * np.arange(100)
    kelvin = 293.15 + t
    run = Run.from_arrays(
        t, t, np.full((100, 3), 9.8), scale_factor="0.8884 rad/s/g", temperature=kelvin, units="SI"
    )
    shown = {}
    for name, unit in (("a-1", "degC"), ("b-1", "K")):
        (signal,) = (s for s in write(run, tmp_path / name, unit).signals if s.key == "temperature")
        assert read_outline(tmp_path / name).signals[-1] == signal  # type: ignore[union-attr]
        shown[signal.unit] = np.load(tmp_path / name / "5.npy")
    assert list(shown) == ["°C", "K"]
    assert shown["°C"] == pytest.approx(20.0 + t)
    assert shown["K"] == pytest.approx(kelvin)


LARGE = """[instrument]
serial = "large"
scale_factor = "0.8884 rad/s/g"
[data]
file = "large.parquet"
time = { column = "t", unit = "s" }
output = { column = "a", kind = "angle", unit = "rad" }
segment = "s"
reference = { columns = ["x", "y", "z"], unit = "g" }
"""


@pytest.mark.slow
@pytest.mark.long
def test_ten_million_rows_are_drawn_at_once(tmp_path: Path) -> None:
    """The first picture, HTTP included; each of many zooms, the best of five; memory of the server without mapped files."""
    import pyarrow as pa
    from pyarrow.parquet import write_table

    row, step = np.arange(10_000_000), 0.005
    segment = row * 24 // row.size
    x, y = np.cos(np.pi / 12.0 * segment), np.sin(np.pi / 12.0 * segment)
    columns = {"t": step * row, "a": np.cumsum(0.8884 * step * x), "s": segment, "x": x, "y": y, "z": 0.0 * x}
    write_table(pa.table(columns), tmp_path / "large.parquet")
    (tmp_path / "large.toml").write_text(LARGE, encoding="utf-8")
    server = entered(tmp_path)
    client, duration = server.client, step * (row.size - 1)

    def seconds(first: float, last: float) -> float:
        started = time.perf_counter()
        for keys in ("output", "difference", "fX,fY,fZ"):
            path = f"/signal-data/large.toml?keys={keys}&from={first}&to={last}&width=1300"
            status, _, body = client.ask(path)
            assert (status, len(body) >= 48) == (200, True)
        return time.perf_counter() - started

    client.page("/jobs")
    before = memory(server.process.pid)
    client.page("/record/large.toml")  # a page that is opened later would begin a fit
    wait_until(lambda: client.ask("/signal-data/large.toml?keys=output&from=0&to=1&width=10")[0] == 200)
    assert seconds(0.0, duration) < 2.0
    for share in np.geomspace(0.9, 1e-6, 40):
        begin = 0.7 * (1.0 - share) * duration
        assert min(seconds(begin, begin + share * duration) for _ in range(5)) < 0.3  # three pictures
    assert memory(server.process.pid) - before < 100.0
    assert server.end() == (0, "")
