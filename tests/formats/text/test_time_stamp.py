"""Time stamps in all forms are seconds, in any pieces; what is not one is refused with row, column and the form."""

from __future__ import annotations

import datetime as dt
import itertools
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

import piga
from piga.formats.text.convention import TextOptions
from piga.formats.text.reader import TextStream
from piga.formats.text.time_stamp import FORMS, StampClock, forms_of, time_stamp

CODES = {
    "YYYY": "%Y", "YY": "%y", "MM": "%m", "DD": "%d", "hh": "%H", "mm": "%M", "ss": "%S", "ap": "%p", ".f": ".%f", ":f": ":%f",
}  # fmt: skip


def written(moment: dt.datetime, form: str) -> str:
    code = form.replace("hh", "%I") if form.endswith("ap") else form
    for ours, theirs in CODES.items():
        code = code.replace(ours, theirs)
    return moment.isoformat(timespec="microseconds") if form == "iso" else moment.strftime(code)


MOMENTS = st.datetimes(dt.datetime(2000, 1, 1), dt.datetime(2068, 12, 31))


@given(moment=MOMENTS, form=st.sampled_from(FORMS))
def test_every_form_against_the_calendar_of_python(moment: dt.datetime, form: str) -> None:
    seconds = time_stamp(form).seconds(written(moment, form))
    assert seconds is not None
    short = moment if "f" in form or form == "iso" else moment.replace(second=0, microsecond=0)
    since = dt.datetime(1970, 1, 1) if time_stamp(form).dated else dt.datetime.combine(moment, dt.time())
    assert seconds == pytest.approx((short - since).total_seconds(), abs=1e-6)
    assert form in forms_of([written(moment, form)])


@given(steps=st.lists(st.floats(0.001, 40000.0), min_size=2, max_size=30), cuts=st.sets(st.integers(1, 29)))
def test_times_of_day_go_on_after_midnight_in_any_pieces(steps: list[float], cuts: set[int]) -> None:
    t = np.cumsum(np.round(steps, 3)) + 80000.0
    cells = [written(dt.datetime(2026, 1, 1) + dt.timedelta(seconds=float(x)), "hh:mm:ss.f") for x in t]
    clock = StampClock(time_stamp("hh:mm:ss.f"))
    edges = [0, *sorted(cut for cut in cuts if cut < len(cells)), len(cells)]
    parts = [clock.convert(pa.array(cells[a:b]), set()) for a, b in itertools.pairwise(edges)]
    values = np.concatenate([part.to_numpy() for part in parts if part is not None])
    np.testing.assert_allclose(values - values[0], t - t[0], atol=2e-6)


@pytest.mark.parametrize(
    "cell", ["", "1.5", "2026-13-01 00:00:00", "2026-01-01 25:00:00", "12:61:00", "yesterday", "2026-01-01"]
)
def test_what_is_not_a_stamp(cell: str) -> None:
    assert forms_of([cell]) == []


@pytest.mark.parametrize("form", ["", "DD.MM", "DD.MM hh:mm:ss", "hh", "hh:mm:ss hh", "x" * 100])
def test_forms_that_are_refused(form: str) -> None:
    with pytest.raises(piga.RunFileError, match="is not a form of time stamps"):
        time_stamp(form)


def log(folder: Path, cells: list[str]) -> Path:
    path = folder / "run.csv"
    path.write_text("time;n\n" + "".join(f"{cell};{k}\n" for k, cell in enumerate(cells)))
    return path


def test_zones_and_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cells = [f"2026-03-29T01:59:5{k}.5+01:00" for k in range(10)] + [
        f"2026-03-29T03:00:0{k}.5+02:00" for k in range(10)
    ]
    path = log(tmp_path, cells)
    for piece in (1 << 20, 100):
        monkeypatch.setattr("piga.formats.text.convention.PIECE_BYTES", piece)
        stream = TextStream(path, ("time", "n"), None, TextOptions(stamp=("time", "iso")))
        t = np.concatenate([chunk.numbers["time"] for chunk in stream.chunks()])
        np.testing.assert_allclose(t, 3590.5 + np.arange(20), atol=1e-9)


def test_a_cell_that_is_no_stamp_is_named(tmp_path: Path) -> None:
    path = log(tmp_path, ["12:00:00.0", "12:00:00.1", "noon", "12:00:00.3"])
    stream = TextStream(path, ("time", "n"), None, TextOptions(stamp=("time", "hh:mm:ss.f")))
    with pytest.raises(
        piga.DataError, match=r"row 4, column 'time' \(A\): 'noon' is not a time stamp of the form hh:mm"
    ):
        list(stream.chunks())
    masked = TextStream(path, ("time", "n"), None, TextOptions(stamp=("time", "hh:mm:ss.f"), mask_damaged=True))
    assert sum(chunk.rows.size for chunk in masked.chunks()) == 3
    assert [(event.kind, event.count) for event in masked.events()] == [("not-a-time", 1)]


def test_a_missing_stamp_is_counted(tmp_path: Path) -> None:
    stream = TextStream(
        log(tmp_path, ["12:00:00.0", "", "12:00:00.2"]),
        ("time", "n"),
        None,
        TextOptions(stamp=("time", "hh:mm:ss.f")),
    )
    t = np.concatenate([chunk.numbers["time"] for chunk in stream.chunks()])
    np.testing.assert_array_equal(np.isnan(t), [False, True, False])


def test_stamps_read_as_numbers_are_named(tmp_path: Path) -> None:
    path = log(tmp_path, ["12.03.2026 14:05:01,050", "12.03.2026 14:05:01,100"])
    with pytest.raises(piga.DataError) as caught:
        list(TextStream(path, ("time", "n"), None).chunks())
    assert "time = { column = 'time', stamp = 'DD.MM.YYYY hh:mm:ss.f' }" in str(caught.value)
