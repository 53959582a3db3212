"""What a reader cannot use is refused with the place and a remedy; what it can is read as meant."""

from __future__ import annotations

import math
import os
import zipfile
from pathlib import Path

import h5py
import numpy as np
import openpyxl
import pyarrow as pa
import pytest
from nptdms import ChannelObject, TdmsWriter
from pyarrow import parquet
from scipy.io import savemat

import piga
from piga.certificate.dcc.dsi_units import dsi_unit, from_dsi
from piga.formats.columns import label_text
from piga.formats.containers.container import READERS, read_container
from piga.reading.signal_checks import OutputScale, Reading
from piga.records import Run, read_run_file
from piga.records.distribution import Spread, shape_of, standard_uncertainty
from piga.records.spool import Arrays
from piga.records.terms import check_terms, meaning_of
from piga.units import G0
from tests.records.containers import columns, write_h5, write_tdms, write_xlsx
from tests.records.files import events, lines, read, write_log, write_run

NAMES = ("t", "n", "fx", "fy", "fz")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"data": "range = { speed = [0.0, 1.0] }"}, "range: 'speed' is not a column in use"),
        ({"data": "range = { fx = [1.0, 0.0] }"}, "range: 'fx': 1 is not below 0"),
        ({"data": 'segment = "fx"'}, "'fx' is a number column that is in use already"),
        ({"data": 'sequence = { column = "k", wraps_at = 1 }'}, "wraps_at must be 2 or more"),
        ({"data": 'missing = ["-999"]'}, "'-999' is a number"),
        (
            {"model": '[estimation]\nangle_rms = "-1 urad"\nangle_random_walk = "0 rad/sqrt(s)"'},
            "angle_rms: '-1 urad' is negative",
        ),
    ],
)
def test_run_files_that_contradict_themselves(tmp_path: Path, options: dict[str, str], message: str) -> None:
    with pytest.raises(piga.RunFileError, match=message) as caught:
        read_run_file(write_run(tmp_path, **options))
    assert caught.value.remedy


def test_words_for_nothing_may_mark_missing_values(tmp_path: Path) -> None:
    assert read_run_file(write_run(tmp_path, data='missing = ["nan", "void"]')).data.missing == ("nan", "void")


def test_an_unknown_key_deep_in_a_list_is_refused_without_a_guess(tmp_path: Path) -> None:
    path = write_run(tmp_path, data="time_zone = { a = 1 }")
    with pytest.raises(piga.RunFileError, match="unknown key 'time_zone'"):
        read_run_file(path)


@pytest.mark.parametrize(
    ("terms", "message"),
    [
        ((), "no term is asked for"),
        (("k0", "phi"), "'phi' comes with tan_beta"),
        (("k0", "k0"), "'k0' is named twice"),
        (("k0", "s2"), "'s2' without 'c2'"),
        (("c3", "k0"), "'c3' without 's3'"),
        (("k1", "scale_factor"), "the same coefficient"),
        (("s100", "c100"), "unknown term 's100'"),
    ],
)
def test_terms_that_do_not_go_together(terms: tuple[str, ...], message: str) -> None:
    with pytest.raises(piga.RunFileError, match=message) as caught:
        check_terms(terms)
    assert caught.value.remedy


def test_coefficients_in_words() -> None:
    assert meaning_of("s2") == "sine of 2 x output angle"
    assert meaning_of("c12[3]") == "cosine of 12 x output angle"
    assert meaning_of("k0[up]") == "bias"


def test_spreads() -> None:
    with pytest.raises(piga.RunFileError, match="degrees_of_freedom must be positive"):
        standard_uncertainty(Spread(standard="1 ppm", degrees_of_freedom=-1.0), "ppm", "scale")
    assert shape_of("1 ppm") == ("normal", math.inf)
    assert shape_of(Spread(standard="1 ppm", degrees_of_freedom=7.0)) == ("normal", 7.0)


def test_numbers_of_a_certificate() -> None:
    with pytest.raises(piga.DataError, match="not made of SI base units"):
        dsi_unit("V")
    for text, message in (("one", "is not a number"), ("1e999", "not a finite"), ("NaN", "not a finite")):
        with pytest.raises(piga.DataError, match=message):
            from_dsi(text, 0)


def test_labels_as_text() -> None:
    given = (None, b" up ", 3.0, 2.5, float("nan"), np.float64(4.0), 7)
    assert [label_text(value) for value in given] == ["", "up", "3", "2.5", "", "4", "7"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "counts"}, "neither 'angle' nor 'rate'"),
        ({"t": [0.0], "output": [0.0], "f": [[1.0, 0, 0]]}, "at least two samples"),
        ({"output": [0.0, 1.0]}, r"output: shape \(2,\), but t has 3 samples(?s:.*)give shape \(3,\)"),
        ({"base_rate": [[0.0] * 3] * 2}, r"base_rate: shape \(2, 3\)"),
        ({"temperature": [290.0]}, r"temperature: shape \(1,\)"),
        ({"output": [0.0, math.nan, 1.0]}, r"output\[1\] is not finite"),
        ({"t": [0.0, 1.0, 1.0]}, r"t\[2\] = .*is not after t\[1\]"),
    ],
)
def test_arrays_that_do_not_fit(change: dict[str, object], message: str) -> None:
    given = {"t": [0.0, 1.0, 2.0], "output": [0.0, 1.0, 2.0], "f": [[1.0, 0.0, 0.0]] * 3}
    arrays = {
        name: value if isinstance(value, str) else np.array(value) for name, value in (given | change).items()
    }
    with pytest.raises(piga.ArgumentError, match=message):
        Run.from_arrays(scale_factor="0.8884 rad/s/g", **arrays)


def test_time_may_begin_anew_with_a_segment() -> None:
    run = Run.from_arrays(
        t=np.array([5.0, 6.0, 0.0, 1.0]), output=np.arange(4.0), f=np.ones((4, 3)), segment=np.array([0, 0, 1, 1]),
        scale_factor="0.8884 rad/s/g",
    )  # fmt: skip
    assert run.size == 4


def test_an_unwrapped_reading_takes_the_nearest_turn() -> None:
    values = np.array([250.0, 4.0, 10.0, 200.0, 190.0])
    begins = np.array([True, False, False, True, False])
    scale = OutputScale(0.5, 256.0, keeps_phase=False, counts=True)
    reading = Reading(Path("run.csv"), "n", values, np.arange(5), begins, 40.0, 1.0, scale)
    output, lost, events = reading.output(Arrays(None))
    np.testing.assert_array_equal(output, [125.0, 130.0, 133.0, 100.0, 95.0])
    assert [(event.kind, event.count) for event in events] == [("counter-roll-over", 1)]
    np.testing.assert_array_equal(lost, [False, False, False, True, False])


@pytest.mark.parametrize("name", ["run.h5", "run.tdms", "run.xlsx"])
def test_containers_without_a_row(tmp_path: Path, name: str) -> None:
    writer = {"run.h5": write_h5, "run.tdms": write_tdms, "run.xlsx": write_xlsx}[name]
    writer(tmp_path / name, columns(0))
    with pytest.raises(piga.DataError, match="no data"):
        READERS[Path(name).suffix](tmp_path / name, NAMES, None)


def test_a_container_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(piga.DataError, match=r"run\.h5: no such file"):
        read_container(tmp_path / "run.h5", ".h5", NAMES, None)


def test_a_counter_beyond_64_signed_bits(tmp_path: Path) -> None:
    data = columns()
    data["n"] = data["n"].astype(np.uint64) + np.uint64(2**63)
    write_h5(tmp_path / "run.h5", data)
    with pytest.raises(piga.DataError, match="more than a signed 64-bit integer can hold"):
        READERS[".h5"](tmp_path / "run.h5", NAMES, None)


def test_hdf5_structs_and_units(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as out:
        table = np.zeros(4, dtype=[("t", "f8"), ("n", "i8")])
        table["n"] = [0, 3, 5, 9]
        out["log"] = table
        out["deep/fx"] = np.ones(4)
        out["deep/fx"].attrs["units"] = "g"
        out["deep/soft"] = h5py.SoftLink("/deep/fx")
    result = READERS[".h5"](path, ("log/n", "deep/fx"), None)
    np.testing.assert_array_equal(result.numbers["log/n"], [0, 3, 5, 9])
    assert result.units == {"deep/fx": "g"}
    for wrong in ("log/speed", "log/n/more", "log", "deep"):
        with pytest.raises(piga.DataError, match=r"no column .*log/t, log/n") as caught:
            READERS[".h5"](path, (wrong,), None)
        assert "soft" not in str(caught.value).split("the columns are")[1]


def test_matlab_fields_and_labels(tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    cells = np.empty(3, dtype=object)
    cells[:] = ["up", "down", 7.0]
    savemat(path, {"log": {"t": np.arange(3.0)}, "place": cells, "word": np.array(["aa", "bb", "cc"])})
    with pytest.raises(piga.DataError, match=r"no column 'log.speed'"):
        READERS[".mat"](path, ("log.speed",), None)
    with pytest.raises(piga.DataError, match=r"no column 'place.t.t'|no column 'log.t.t'"):
        READERS[".mat"](path, ("log.t.t",), None)
    codes, names = READERS[".mat"](path, ("log.t",), "place").labels["place"]
    assert [names[code] for code in codes] == ["up", "down", "7"]
    codes, names = READERS[".mat"](path, ("log.t",), "word").labels["word"]
    assert [names[code] for code in codes] == ["aa", "bb", "cc"]


def test_tdms_labels_and_channels_of_one_name(tmp_path: Path) -> None:
    path = tmp_path / "run.tdms"
    with TdmsWriter(path) as out:
        out.write_segment(
            [
                ChannelObject("a", "t", np.arange(3.0)),
                ChannelObject("b", "t", np.arange(3.0) + 1.0),
                ChannelObject("a", "place", ["up", "up", "down"]),
            ]
        )
    with pytest.raises(piga.DataError, match=r"(?s)several groups have a channel 't'.*'a/t', 'b/t'"):
        READERS[".tdms"](path, ("t",), None)
    result = READERS[".tdms"](path, ("b/t",), "place")
    np.testing.assert_array_equal(result.numbers["b/t"], [1.0, 2.0, 3.0])
    codes, names = result.labels["place"]
    assert [names[code] for code in codes] == ["up", "up", "down"]


def test_sheets_without_names_or_rows(tmp_path: Path) -> None:
    path = tmp_path / "run.xlsx"
    for row, message in (((), "the sheet is empty"), ((0.0, 1, 1.0), "the first row holds numbers")):
        book = openpyxl.Workbook()
        book.active.append(row)
        book.save(path)
        with pytest.raises(piga.DataError, match=message):
            READERS[".xlsx"](path, NAMES, None, sheet=None)


def test_a_sheet_with_gaps_and_many_wrong_cells(tmp_path: Path) -> None:
    path = tmp_path / "run.xlsx"
    book = openpyxl.Workbook()
    book.active.append(["t", "n", "place"])
    for k in range(130):
        book.active.append([0.1 * k, "NaN" if k == 3 else k])
    book.save(path)
    result = READERS[".xlsx"](path, ("t", "n"), "place", sheet=None)
    assert np.flatnonzero(np.isnan(result.numbers["n"])).tolist() == [3]
    codes, names = result.labels["place"]
    assert (set(codes.tolist()), names) == ({-1}, ())
    for row in range(2, 132):
        book.active.cell(row=row, column=2, value="seven")
    book.save(path)
    with pytest.raises(piga.DataError, match=r"(?s)seven.*more"):
        READERS[".xlsx"](path, ("t", "n"), None, sheet=None)


def test_workbooks_of_too_many_or_encrypted_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.xlsx"
    write_xlsx(path, columns(3))
    content = bytearray(path.read_bytes())
    at = content.find(b"PK\x01\x02")  # flags of the first entry in the directory of the archive
    content[at + 8] |= 1
    (tmp_path / "locked.xlsx").write_bytes(content)
    with pytest.raises(piga.DataError, match="the file is encrypted"):
        READERS[".xlsx"](tmp_path / "locked.xlsx", NAMES, None, sheet=None)
    with zipfile.ZipFile(path) as source:
        count = len(source.infolist())
    monkeypatch.setattr("piga.formats.containers.xlsx_reader.MAX_MEMBERS", count - 1)
    with pytest.raises(piga.DataError, match=f"{count} parts, at most {count - 1} are read"):
        READERS[".xlsx"](path, NAMES, None, sheet=None)


def test_parquet_without_rows_or_with_two_columns_of_one_name(tmp_path: Path) -> None:
    empty = pa.table({name: pa.array([], pa.float64()) for name in NAMES})
    twice = pa.Table.from_arrays([pa.array([0.0, 1.0])] * 6, names=[*NAMES, "fz"])
    for table, message in ((empty, "no data row"), (twice, "duplicate column name 'fz'")):
        parquet.write_table(table, tmp_path / "run.parquet")
        with pytest.raises(piga.DataError, match=message):
            piga.read_run(write_run(tmp_path, "run.parquet"))
    with pytest.raises(piga.DataError, match=r"cannot be read|no such file"):
        piga.read_run(write_run(tmp_path, "none.parquet"))


def test_the_digest_beside_a_log_counts(tmp_path: Path) -> None:
    write_log(tmp_path, lines())
    run = piga.read_run(write_run(tmp_path))
    (digest,) = {value for name, value in run.input_sha256.items() if name.endswith(".csv")}
    beside = tmp_path / "run.csv.sha256"
    beside.write_text(f"{digest}  run.csv\n")
    assert piga.read_run(tmp_path / "run.toml").size == run.size
    for words in ("", "0" * 64):
        beside.write_text(words)
        with pytest.raises(piga.DataError, match="SHA-256 is not the one in"):
            piga.read_run(tmp_path / "run.toml")


def test_a_log_that_changes_or_is_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from piga.reading import raw_columns

    path = write_log(tmp_path, lines())
    states = iter([(1, 0, 0, 0), (2, 0, 0, 0)])
    with monkeypatch.context() as patch:
        patch.setattr(raw_columns.SteadyFile, "_state", lambda _file: next(states))
        with pytest.raises(piga.DataError, match="changed while it was read"):
            piga.read_run(write_run(tmp_path))
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(piga.DataError, match="not a regular file"):
        piga.read_run(tmp_path / "run.toml")


def test_a_sheet_is_asked_of_a_text_file(tmp_path: Path) -> None:
    write_log(tmp_path, lines())
    with pytest.raises(piga.DataError, match=r"sheet is for \.xlsx files"):
        piga.read_run(write_run(tmp_path, data='sheet = "log"'))


def test_a_missing_log_is_named(tmp_path: Path) -> None:
    for name in ("none.csv", "none.csv.gz"):
        with pytest.raises(piga.DataError, match=rf"{name}: (no such file|cannot be read)"):
            piga.read_run(write_run(tmp_path, name))


@pytest.mark.parametrize(
    ("cell", "options", "hint"),
    [
        ("１２", {}, "full-width"),
        ("1'000", {}, "thousands separators"),
        ("1.5", {"data": "decimal = ','\ndelimiter = ';'"}, "is not a number"),
    ],
)
def test_cells_with_a_hint(tmp_path: Path, cell: str, options: dict[str, str], hint: str) -> None:
    mark = ";" if options else ","
    rows = [row.replace(",", mark).replace(".", "," if options else ".") for row in lines()]
    cells = rows[5].split(mark)
    cells[1] = cell
    rows[5] = mark.join(cells)
    with pytest.raises(piga.DataError, match=hint):
        read(tmp_path, rows, header=mark.join(NAMES), **options)


def test_a_reference_in_another_unit_is_suspected(tmp_path: Path) -> None:
    rows = [f"{i / 20:.4f},{round(10179.0 * i / 20)},{G0},0.0,0.0" for i in range(60)]
    run = read(tmp_path, rows)
    (event,) = [event for event in run.quality.events if "|f|" in event.detail]
    assert event.kind == "implausible-unit"
    assert "too large by" in event.detail


def test_an_output_that_stands_still_is_noticed(tmp_path: Path) -> None:
    rows = [f"{i / 20:.4f},{min(round(10179.0 * i / 20), 300_000)},1.0,0.1,0.0" for i in range(1500)]
    result = events(read(tmp_path, rows))
    assert "stopped-output" in result or "stuck-value" in result


def test_lost_and_disordered_sequence_numbers_are_counted(tmp_path: Path) -> None:
    numbers = [*range(10), *range(13, 30), *range(25, 38)]
    rows = [f"{row},{k}" for row, k in zip(lines(len(numbers)), numbers, strict=True)]
    run = read(tmp_path, rows, header="t,n,fx,fy,fz,k", data='sequence = { column = "k" }')
    result = {event.kind: event for event in run.quality.events}
    assert result["sequence-gap"].count == 1
    assert result["sequence-gap"].detail.startswith("3 samples missing")
    assert result["sequence-back"].count == 1
    assert np.flatnonzero(run.begins).tolist() == [0, 10, 27]
