"""Envelopes against the samples themselves, for random records, zooms and gaps; large files: the first picture, zooms, memory."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from piga.errors import ArgumentError
from piga.records import Run
from piga.workbench.signals import SignalOutline, picture, read_outline, write_envelopes
from tests.workbench.size import SIZES, measure


def record(size: int, gaps: list[int], seed: int = 1) -> Run:
    """A record with steps in time after the given samples."""
    generator = np.random.default_rng(seed)
    t = 0.01 * np.arange(size)
    for gap in gaps:
        t[gap:] += generator.uniform(1.0, 5.0)
    output = np.cumsum(generator.normal(size=size))
    f = np.column_stack((np.full(size, 9.8), generator.normal(size=size), np.zeros(size)))
    return Run.from_arrays(t, output, f, scale_factor="0.8884 rad/s/g", serial="A")


def test_the_whole_picture_holds_the_extremes(tmp_path: Path) -> None:
    run = record(200_000, [50_000, 120_001])
    outline = write_envelopes(run, tmp_path / "a-1")
    rows = picture(tmp_path / "a-1", "output", 0.0, outline.duration, 800)
    assert 800 <= len(rows) < 4 * 800 + 10
    assert np.nanmin(rows[:, 1]) == run.output.min()
    assert np.nanmax(rows[:, 2]) == run.output.max()
    gaps = np.flatnonzero(np.isnan(rows[:, 1]))
    assert gaps.size == 2
    starts = rows[gaps + 1, 0]
    assert starts == pytest.approx(run.t[[50_000, 120_001]] - run.t[0])


@settings(max_examples=60, deadline=None)
@given(
    size=st.integers(2, 30_000),
    gaps=st.lists(st.integers(1, 29_999), max_size=6),
    ends=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
    width=st.integers(1, 3000),
    key=st.sampled_from(["output", "fX", "fY", "fZ"]),
)
def test_no_peak_is_lost_and_none_invented(
    tmp_path_factory: pytest.TempPathFactory,
    size: int,
    gaps: list[int],
    ends: tuple[float, float],
    width: int,
    key: str,
) -> None:
    run = record(size, sorted({gap for gap in gaps if gap < size}))
    cache = tmp_path_factory.mktemp("envelopes") / "a-1"
    outline = write_envelopes(run, cache)
    values = run.output if key == "output" else run.f[:, "XYZ".index(key[1])]
    first, last = sorted(end * outline.duration for end in ends)
    if first == last:
        return
    rows = picture(cache, key, first, last, width)
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


def test_a_clock_that_starts_anew_is_shown_after(tmp_path: Path) -> None:
    t = np.concatenate((np.arange(1000), np.arange(500))) * 0.01
    run = Run.from_arrays(
        np.arange(1500) * 0.01, np.arange(1500.0), np.full((1500, 3), 9.8), scale_factor="0.8884 rad/s/g",
        segment=np.repeat([0, 1], [1000, 500]).astype(np.int32),
    )  # fmt: skip
    object.__setattr__(run, "t", t)
    outline = write_envelopes(run, tmp_path / "a-1")
    assert outline.duration == pytest.approx(9.99 + 0.01 + 4.99)
    assert [segment[1:] for segment in outline.segments] == [
        (0.0, pytest.approx(9.99)),
        (pytest.approx(10.0), pytest.approx(14.99)),
    ]


def test_older_caches_of_a_record_go_and_a_broken_one_is_none(tmp_path: Path) -> None:
    run = record(100, [])
    write_envelopes(run, tmp_path / "a-1")
    write_envelopes(run, tmp_path / "b-1")
    write_envelopes(run, tmp_path / "a-2")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a-2", "b-1"]
    (tmp_path / "a-2" / "outline.json").unlink()
    assert read_outline(tmp_path / "a-2") is None


@pytest.mark.parametrize(
    ("key", "first", "last", "width"),
    [("nothing", 0.0, 1.0, 10), ("../t", 0.0, 1.0, 10), ("output", 1.0, 0.0, 10), ("output", float("nan"), 1.0, 10),
     ("output", 0.0, 1.0, 0), ("output", 0.0, 1.0, 10**9)],
)  # fmt: skip
def test_wrong_questions(tmp_path: Path, key: str, first: float, last: float, width: int) -> None:
    write_envelopes(record(100, []), tmp_path / "a-1")
    with pytest.raises(ArgumentError):
        picture(tmp_path / "a-1", key, first, last, width)


def test_an_outline_is_read_as_it_was_written(tmp_path: Path) -> None:
    outline = write_envelopes(record(100, [50]), tmp_path / "a-1")
    assert isinstance(outline, SignalOutline)
    assert read_outline(tmp_path / "a-1") == outline


@pytest.mark.slow
def test_a_hundred_million_rows(tmp_path: Path) -> None:
    size = 100_000_000
    from piga.workbench import signals

    folder = tmp_path / "a-1"
    folder.mkdir()
    t = np.lib.format.open_memmap(folder / "t.npy", mode="w+", dtype=np.float64, shape=(size,))
    values = np.lib.format.open_memmap(tmp_path / "v.npy", mode="w+", dtype=np.float64, shape=(size,))
    for start in range(0, size, 1 << 20):
        part = slice(start, min(start + (1 << 20), size))
        t[part] = 0.005 * np.arange(part.start, part.stop)
        values[part] = np.sin(1e-4 * t[part])
    breaks = np.zeros(1, np.int64)
    np.save(folder / "breaks.npy", breaks[1:])
    levels = signals._levels(size, breaks)
    for number, edges in enumerate(levels):
        np.save(folder / f"edges-{number}.npy", edges)
    signals._write_column(folder, "output", values, size, levels)
    outline = SignalOutline(
        (signals.Signal("output", "", "rev", 1.0, "output"),), float(t[-1]), size, size, (), ()
    )
    import json
    from dataclasses import asdict

    (folder / "outline.json").write_text(json.dumps(asdict(outline)), encoding="utf-8")
    longest = 0.0
    for share in (1.0, 0.3, 0.01, 1e-3, 1e-5):
        started = time.process_time()
        rows = picture(folder, "output", 0.1, 0.1 + share * 0.99 * outline.duration, 2000)
        longest = max(longest, time.process_time() - started)
        assert len(rows) > 300
    assert longest < 0.1


def test_temperature_is_shown_in_the_unit_of_the_record(tmp_path: Path) -> None:
    t = 0.01 * np.arange(100)
    kelvin = 293.15 + t
    run = Run.from_arrays(t, t, np.full((100, 3), 9.8), scale_factor="0.8884 rad/s/g", temperature=kelvin)
    shown = {}
    for name, unit in (("a-1", "degC"), ("b-1", "K")):
        (signal,) = (s for s in write_envelopes(run, tmp_path / name, unit).signals if s.key == "temperature")
        assert read_outline(tmp_path / name).signals[-1] == signal  # type: ignore[union-attr]
        shown[signal.unit] = kelvin * signal.factor + signal.offset
    assert list(shown) == ["°C", "K"]
    assert shown["°C"] == pytest.approx(20.0 + t)
    assert shown["K"] == pytest.approx(kelvin)


@pytest.mark.slow
@pytest.mark.only_compiled
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")
@pytest.mark.parametrize("kind", SIZES)
def test_a_large_file_is_drawn_at_once(tmp_path: Path, kind: str) -> None:
    seen = measure(tmp_path, kind, SIZES[kind])
    assert seen["first"] < 2.0
    assert seen["zoom"] < 0.1
    assert seen["server"] < 100.0
    assert seen["job"] < 600.0
