"""A test on a dividing head, and its log as other programs write it."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta
from functools import lru_cache
from pathlib import Path

import h5py
import numpy as np
import openpyxl
import pyarrow as pa
from nptdms import ChannelObject, TdmsWriter
from pyarrow import parquet
from scipy.io import savemat

ANGLES = (10.0, 70.0, 130.0, 190.0, 250.0, 310.0)
RATE, DWELL, MOVE = 10.0, 20.0, 5.0
START = datetime(2026, 11, 23, 23, 58, 30, 250000)


@lru_cache(maxsize=1)
def truth() -> dict[str, np.ndarray]:
    """Time [s], counts (72000 a revolution), force [g] (n, 3), position and head angle [deg]; held positions only.

    The output turns evenly in each position, with K of 0.8890 (rad/s)/g.
    """
    inside, x = np.arange(int(DWELL * RATE) + 1) / RATE, np.radians(ANGLES)[:, None]
    rate = 0.8890 * np.cos(x)
    turned = np.cumsum(rate[:-1] * DWELL + 0.5 * MOVE * (rate[:-1] + rate[1:]), axis=0)
    alpha = 0.3 + np.concatenate(([[0.0]], turned)) + rate * inside
    t = (DWELL + MOVE) * np.arange(len(ANGLES))[:, None] + inside
    counts = np.round(alpha.ravel() * 72000 / (2.0 * np.pi)).astype(np.int64)
    position, angle = (np.repeat(values, inside.size) for values in (np.arange(len(ANGLES)) + 1, ANGLES))
    held = np.radians(angle)
    f = np.column_stack([np.cos(held), -np.sin(held), np.full(held.size, 0.002)]).round(8)
    return {"t": t.ravel().round(3), "counts": counts, "f": f, "position": position, "angle": angle}


def stamps() -> list[datetime]:
    return [START + timedelta(seconds=float(t)) for t in truth()["t"]]


def rows(first: Callable[[int], str] = lambda k: f"{truth()['t'][k]:.3f}", sep: str = ",") -> list[str]:
    d = truth()
    forces = (sep.join(f"{value:.8f}" for value in f) for f in d["f"])
    return [sep.join([first(k), str(n), f]) for k, (n, f) in enumerate(zip(d["counts"], forces, strict=True))]


def text(path: Path, header: str, body: list[str], footer: str = "", encoding: str = "utf-8") -> None:
    lines = [*([header] if header else []), *body, *([footer] if footer else [])]
    path.write_bytes(("\n".join(lines) + "\n").encode(encoding))


def changed(column: int, value: Callable[[int, str], str]) -> list[str]:
    """The rows with other cells in a column."""
    result = []
    for k, row in enumerate(rows()):
        cells = row.split(",")
        cells[column] = value(k, cells[column])
        result.append(",".join(cells))
    return result


def sheet_rows() -> list[list[object]]:
    d = truth()
    return [
        [float(t), int(n), *map(float, f), int(p)]
        for t, n, f, p in zip(d["t"], d["counts"], d["f"], d["position"], strict=True)
    ]


def title_xlsx(path: Path) -> None:
    book = openpyxl.Workbook()
    sheet = book.active
    sheet["A1"] = "PIGA Kalibrierung 23.11.2026"
    sheet.merge_cells("A1:F1")
    sheet.append(["Zeit", "Zähler", "Beschleunigung X", "Beschleunigung Y", "Beschleunigung Z", "Lage"])
    sheet.append(["s", "-", "g", None, None, "-"])
    sheet.merge_cells("C3:E3")
    for row in sheet_rows():
        sheet.append(row)
    book.save(path)


def dated_xlsx(path: Path) -> None:
    book = openpyxl.Workbook()
    book.active.append(["Operator", "mm"])
    sheet = book.create_sheet("log")
    sheet.append(["Timestamp", "Counts", "fx (g)", "fy (g)", "fz (g)", "Position"])
    for stamp, row in zip(stamps(), sheet_rows(), strict=True):
        sheet.append([stamp, *row[1:]])
    book.save(path)


def columns() -> dict[str, np.ndarray]:
    d = truth()
    forces = {f"f{axis}": d["f"][:, k].copy() for k, axis in enumerate("xyz")}
    return {"time": d["t"], "counts": d["counts"], **forces, "position": d["position"]}


def matrix() -> np.ndarray:
    return np.column_stack(list(columns().values()))


def grouped_tdms(path: Path) -> None:
    units = {"time": "s", "fx": "g", "fy": "g", "fz": "g"}
    with TdmsWriter(path) as out:
        out.write_segment([
            ChannelObject("Messung", name, values, {"unit_string": units.get(name, "")})
            for name, values in columns().items()
        ])  # fmt: skip


def grouped_h5(path: Path) -> None:
    with h5py.File(path, "w") as out:
        for name, values in columns().items():
            out.create_dataset(f"run 1/{name}", data=values)
        out["run 2/time"] = np.arange(3.0)


def stamped_parquet(path: Path) -> None:
    d = columns() | {
        "time": pa.array(stamps(), pa.timestamp("us")),
        "position": [f"P{n}" for n in truth()["position"]],
    }
    parquet.write_table(
        pa.table({f"{name} [g]" if name in ("fx", "fy", "fz") else name: v for name, v in d.items()}), path
    )


def us_stamp(k: int) -> str:
    """Local time as US programs write it."""
    at = stamps()[k]
    return f"{at.month}/{at.day}/{at.year} {(at.hour - 1) % 12 + 1}:{at:%M:%S}.{at.microsecond // 1000:03d} {at:%p}"


def rounded(k: int) -> str:
    """A stamp without decimals of the second."""
    return f"{stamps()[k]:%d.%m.%Y %H:%M:%S}"


NAMES = "time,counts,fx,fy,fz"
LOGS: dict[str, Callable[[Path], None]] = {
    "no-names.csv": lambda path: text(path, "", rows()),
    "no-names-preamble.csv": lambda path: text(path, "Log of run 12\nstarted 14:03", rows()),
    "no-names-stamps.csv": lambda path: text(path, "", rows(lambda k: stamps()[k].isoformat(timespec="milliseconds"))),
    "no-names-blanks.dat": lambda path: text(path, "", [f"  {row}" for row in rows(sep="   ")]),
    "letters.csv": lambda path: text(path, "A,B,C,D,E", rows()),
    "blanks.dat": lambda path: text(path, "t counts fx fy fz", rows(sep="  ")),
    "hash.txt": lambda path: text(path, "# t[s]\tcounts\tfx[g]\tfy[g]\tfz[g]", rows(sep="\t")),
    "percent.txt": lambda path: text(path, "% log of run 12\n% t[s] counts fx[g] fy[g] fz[g]", rows(sep=" ")),
    "midnight.csv": lambda path: text(path, NAMES.replace("time", "Uhrzeit"), rows(lambda k: f"{stamps()[k]:%H:%M:%S.%f}"[:-3])),
    "us.csv": lambda path: text(path, NAMES, rows(us_stamp)),
    "epoch-ms.csv": lambda path: text(path, NAMES, rows(lambda k: str(round(stamps()[k].timestamp() * 1000)))),
    "twice.csv": lambda path: text(path, f"{NAMES},fx", [f"{row},{k}" for k, row in enumerate(rows())]),
    "trailing.csv": lambda path: text(path, f"{NAMES},", [f"{row}," for row in rows()]),
    "footer.csv": lambda path: text(path, NAMES, rows(), "Mean,,0.1,0.0,0.002\nEnd of measurement 14:25"),
    "words.csv": lambda path: text(path, NAMES, changed(1, lambda k, n: "ERR" if k in (50, 51, 700) else n)),
    "fill.csv": lambda path: text(path, NAMES, changed(2, lambda k, f: "-9999" if k in (50, 51, 700) else f)),
    "fill-in-counts.csv": lambda path: text(path, NAMES, changed(1, lambda k, n: "-9999" if k in (50, 51, 700) else n)),
    "signed-16.csv": lambda path: text(path, NAMES, changed(1, lambda _, n: str((int(n) + 32768) % 65536 - 32768))),
    "other-axis.csv": lambda path: text(path, "time,counts,fz,fx,fy", rows()),
    "metres.csv": lambda path: text(path, "time,counts,ax,ay,az", [
        ",".join([*row.split(",")[:2], *(f"{float(cell) * 9.80665:.8f}" for cell in row.split(",")[2:])]) for row in rows()
    ]),
    "title.xlsx": title_xlsx,
    "dated.xlsx": dated_xlsx,
    "groups.tdms": grouped_tdms,
    "groups.h5": grouped_h5,
    "matrix.h5": lambda path: h5py.File(path, "w").create_dataset("data", data=matrix()).file.close(),
    "matrix.mat": lambda path: savemat(path, {"data": matrix()}),
    "struct.mat": lambda path: savemat(path, {"log": columns()}),
    "stamps.parquet": stamped_parquet,
}  # fmt: skip
"""Writer of each log."""
