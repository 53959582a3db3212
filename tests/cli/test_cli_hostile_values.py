"""Values that no lab writes and every program meets: each ends in exit 2 and one message, at once."""

from __future__ import annotations

import errno
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from piga.certificate import dcc
from piga.compensation import result as compensated
from piga.compensation.result import Compensated, write_rows
from piga.errors import DataError, StoreError
from piga.ledger.store.store import _write_new
from tests.certificate.certificate_data import budgeted, changed, complete
from tests.cli.runner import exit_code
from tests.records.files import lines, write_log, write_run
from tests.reports.example import calibration

FILE = 'file = "run.csv"'
HOSTILE = {
    "NUL in a file name": ('"run.csv"', '"run\\u0000.csv"', "control character"),
    "300 letters in a file name": ('"run.csv"', f'"{"r" * 300}.csv"', "File name too long"),
    "NUL in the serial": ('"T-1"', '"T\\u0000"', "control character"),
    "integer of 5000 digits": ("72000", "9" * 5000, "not valid TOML"),
    "integer of 300 digits": ("72000", "9" * 300, "more than 64 bits"),
    "float beyond use": ("72000", "1e308", "too large to compute with"),
    "tiny counts": ("72000", "1e-308", "counts_per_revolution]: expected a number >= 1e-06"),
    "parentheses": ('unit = "s"', f'unit = "{"(" * 20000}"', "has 20000 characters"),
    "power": ("0.8884 rad/s/g", "1 km^99999", "too large or too small"),
    "power of nothing": ("0.8884 rad/s/g", "1 rad/s/(mm^9999)", "too large or too small"),
    "huge quantity": ("0.8884 rad/s/g", "1e308 rad/s/g", "too large to compute with"),
    "full-width digits": ("0.8884 rad/s/g", "１.0 rad/s/g", "is not a number with a unit"),
    "34 000 words": (FILE, FILE + "\nmissing = [" + ",".join(f'"w{i}"' for i in range(34000)) + "]", "missing"),
    **{
        f"encoding {name}": (FILE, f'{FILE}\nencoding = "{name}"', "is not supported")
        for name in ("zlib_codec", "rot13", "undefined", "hex", "x" * 300)
    },
}


@pytest.mark.parametrize("case", list(HOSTILE))
def test_values_of_a_run_file(tmp_path: Path, case: str, capsys: pytest.CaptureFixture[str]) -> None:
    old, new, message = HOSTILE[case]
    write_log(tmp_path, lines())
    path = write_run(tmp_path)
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    began = time.monotonic()
    assert exit_code("check", path) == 2
    assert time.monotonic() - began < 5.0
    err = capsys.readouterr().err
    assert message in err
    assert "remedy: " in err
    assert len(err) < 2000


@pytest.mark.parametrize("value", ["1e308", "-1e308", "9" * 400])
@pytest.mark.parametrize("column", [0, 1, 2])
def test_values_of_a_log(tmp_path: Path, value: str, column: int, capsys: pytest.CaptureFixture[str]) -> None:
    """Too large to be squared: named with row and column, or masked where the reader takes it for infinite."""
    rows = [row.split(",") for row in lines()]
    rows[7][column] = value
    write_log(tmp_path, [",".join(row) for row in rows])
    code = exit_code("check", write_run(tmp_path))
    err = capsys.readouterr().err
    assert code in (0, 2)
    assert code == 0 or "row 9" in err
    assert code == 2 or value.startswith("9")


def test_control_characters_in_a_certificate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In the TOML file, and what only XML refuses."""
    data = tmp_path / "certificate.toml"
    text = Path("examples/certificate.toml").read_text(encoding="utf-8")
    data.write_text(text.replace('name = "', 'name = "a\\u0001', 1), encoding="utf-8")
    cal = budgeted(calibration(with_residuals=False))
    cal.to_json(tmp_path / "calibration.json")
    words = ("issue", tmp_path / "calibration.json", "--data", data, "--out", tmp_path / "out")
    assert exit_code("certificate", *words) == 2
    assert "holds a control character" in capsys.readouterr().err
    with pytest.raises(DataError, match="cannot stand in XML"):
        dcc.dcc_document(changed(complete(), customer={"name": "a\ufffe"}), cal)


def test_a_certificate_that_no_reader_takes() -> None:
    """Seven hundred phases make a text that the parsers of XML refuse: said before it is signed."""
    data = changed(complete(), statements={"remarks": "x" * 10_100_000})
    with pytest.raises(DataError, match=r"cannot stand in XML: .*(?i:huge|too long)(?s:.*)fewer segments"):
        dcc.dcc_document(data, budgeted(calibration(with_residuals=False)))


def test_a_full_disk_leaves_no_cut_file(tmp_path: Path) -> None:
    def parts() -> Iterator[bytes]:
        yield b"half"
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(StoreError, match="cannot be written"):
        _write_new(tmp_path / "a.csv", parts())
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_what_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Closing a file that could not be written does not hide the reason."""

    class Full:
        closed = False

        def write_table(self, *_: object) -> None:
            raise ValueError("Operation on closed file") if self.closed else OSError(errno.ENOSPC, "full")

        def close(self) -> None:
            raise ValueError("Operation on closed file")

    monkeypatch.setattr(compensated, "_opened", lambda *_: Full())
    t = np.arange(3.0)
    with pytest.raises(OSError, match="full"):
        write_rows(Compensated(t, t, t, t, np.zeros(3, np.int32)), tmp_path / "a.parquet")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.ENAMETOOLONG])
def test_what_the_disk_refuses_is_no_internal_error(
    tmp_path: Path, number: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(number, "the disk says no", "somewhere")

    monkeypatch.setattr("piga.read_run", full)
    write_log(tmp_path, lines())
    assert exit_code("check", write_run(tmp_path)) == 2
    err = capsys.readouterr().err
    assert "piga: somewhere: the disk says no" in err
    assert "Traceback" not in err
