"""Draw logs of tests by a seed, as programs of four languages write them, and calibrate them as a new user would.

The motion comes from a Runge-Kutta integration of its own, through moves, ramps and gaps.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
from numpy.typing import NDArray

import piga
from piga.describe import describe_log, draft_run_file, try_run_file
from piga.describe.draft import setting

Array = NDArray[np.float64]
G, OMEGA, LATITUDE, HEIGHT, RADIUS = 9.80665, 7.292115e-5, math.radians(48.0), 300.0, 1.2
K, TANGENT, BIAS = 0.8891, 5e-4, 2e-4
"""In rad/s/g, 1 and g."""
STEP, DWELL, MOVE = 0.1, 24.0, 6.0
WORDS = {
    "de": {
        "time": "Zeit", "angle": "Teilkopfstellung", "speed": "Drehzahl", "count": "Zählerstand", "pulses": "Impulse je Takt",
        "output": "Ausgangswinkel", "room": "Raumtemperatur", "number": "Messpunkt", "degree": "°", "serial": "Gerätenummer",
    },
    "en": {
        "time": "Elapsed time", "angle": "Head angle", "speed": "Arm speed", "count": "Counter value",
        "pulses": "Pulses per sample", "output": "Gimbal angle", "room": "Room temperature", "number": "Step",
        "degree": "deg", "serial": "Unit no.",
    },
    "fr": {
        "time": "Temps écoulé", "angle": "Angle du plateau", "speed": "Vitesse du bras", "count": "Compteur",
        "pulses": "Impulsions par échantillon", "output": "Angle de sortie", "room": "Température", "number": "Palier",
        "degree": "°", "serial": "N° de série",
    },
    "zh": {
        "time": "时间", "angle": "分度头角度", "speed": "转速", "count": "计数值", "pulses": "每次采样脉冲数",
        "output": "输出角度", "room": "温度", "number": "位置", "degree": "°", "serial": "编号",
    },
}  # fmt: skip


SPEEDS = (("rpm", 30.0 / math.pi), ("1/min", 30.0 / math.pi), ("°/s", 180.0 / math.pi), ("rad/s", 1.0))
"""Units of the speed of an arm, and their number in 1 rad/s."""


@dataclass(frozen=True)
class DrawnLog:
    """A log: its file name, what it is, and what the laboratory knows about the test, by key of the run file."""

    name: str
    what: str
    known: dict[str, str]


def gravity() -> float:
    """Normal gravity of WGS 84 at the site [m/s^2] (Somigliana; free air)."""
    s2 = math.sin(LATITUDE) ** 2
    at_sea = 9.7803253359 * (1.0 + 0.00193185265241 * s2) / math.sqrt(1.0 - 0.00669437999013 * s2)
    return at_sea * (1.0 - 2.0 * (1.0 + 0.00335281 + 0.00344979 - 2.0 * 0.00335281 * s2) * HEIGHT / 6378137.0)


def turned(force: Callable[[float], tuple[float, float, float]], t: Array, rng: np.random.Generator) -> Array:
    """Output angle [rad] at the times: force less base rate over K [m/s^2] by time; Runge-Kutta of fourth order, ten steps each."""
    scale = K / G

    def rate(at: float, alpha: float) -> float:
        x, y, z = force(at)
        return scale * (x + BIAS * G + TANGENT * (y * math.sin(alpha) - z * math.cos(alpha)))

    alpha, out = float(rng.uniform(0.0, 6.0)), []
    for start, stop in zip(t, np.append(t[1:], t[-1]), strict=True):
        out.append(alpha)
        h = (stop - start) / 10.0
        for at in start + h * np.arange(10):
            a = rate(at, alpha)
            b = rate(at + 0.5 * h, alpha + 0.5 * h * a)
            c = rate(at + 0.5 * h, alpha + 0.5 * h * b)
            alpha += h / 6.0 * (a + 2.0 * b + 2.0 * c + rate(at + h, alpha + h * c))
    return np.array(out) + 1e-5 * math.sqrt(STEP) * np.cumsum(rng.standard_normal(t.size))


def driven(rng: np.random.Generator, *, arm: bool) -> tuple[Array, Array, Array, Array]:
    """Time [s], angle [rad] or speed [rad/s] of the stand, number of the position (0 in a move), output angle [rad]."""
    g, scale = gravity(), K / G
    if arm:
        levels = np.sqrt(np.array([1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 5.0, 3.5, 2.5, 1.5]) * G / RADIUS)
    else:
        levels = np.radians(rng.permutation(30.0 * np.arange(12)) + rng.integers(0, 25))
    t = STEP * np.arange(round((levels.size * (DWELL + MOVE) - MOVE) / STEP) + 1)
    edges = np.concatenate([[k * (DWELL + MOVE), k * (DWELL + MOVE) + DWELL] for k in range(levels.size)])
    values = np.repeat(levels, 2)

    def force(at: float) -> tuple[float, float, float]:
        x = float(np.interp(at, edges, values))
        if arm:
            speed = x + OMEGA * math.sin(LATITUDE)
            return RADIUS * (x * x + 2.0 * x * OMEGA * math.sin(LATITUDE)), 0.0, g - speed / scale
        up, north = OMEGA * math.sin(LATITUDE), OMEGA * math.cos(LATITUDE)
        c, s = math.cos(x), math.sin(x)
        return (g - up / scale) * c, -(g - up / scale) * s, -north / scale

    place = np.searchsorted(edges, t + 1e-9, side="right")
    number = np.where(place % 2 == 1, place // 2 + 1, 0).astype(float)
    return t, np.interp(t, edges, values), number, turned(force, t, rng)


def drawn(seed: int, folder: Path) -> DrawnLog:
    """Write the log of a seed."""
    rng = np.random.default_rng([42, seed])
    language = str(rng.choice(list(WORDS)))
    words, arm, sheet = WORDS[language], bool(rng.random() < 0.35), bool(rng.random() < 0.25)
    t, place, number, alpha = driven(rng, arm=arm)
    counts_per_turn = int(rng.choice([36000, 72000, 144000]))
    falling = bool(rng.random() < 0.25)
    output = str(rng.choice(["count", "count", "folded", "pulses", "saw-tooth"]))
    gap = str(rng.choice(["none", "none", "kept", "lost"]))
    counts = np.round((-alpha if falling else alpha) / (2.0 * math.pi) * counts_per_turn).astype(np.int64)
    known = {
        "instrument.scale_factor": "0.8884 rad/s/g", "instrument.counts_per_revolution": str(counts_per_turn),
        "stand.latitude": "48 deg", "stand.height": "300 m", "stand.radius": f"{RADIUS} m",
        "stand.kind": "centrifuge" if arm else "dividing-head",
    }  # fmt: skip
    kept = np.ones(t.size, bool)
    if gap != "none":
        at = int(rng.integers(2, 8)) * (DWELL + MOVE) + 10.0
        kept = (t < at) | (t > at + 4.0)
        if gap == "lost":
            counts = counts - np.where(t > at, int(rng.integers(1000, 9000)), 0)
    columns: list[tuple[str, str, list[str]]] = []
    seconds = str(rng.choice(["s", "ms", "stamp"]))
    start = datetime(2026, 5, 4, 23, 57, 12)
    if seconds == "stamp":
        form = {"de": "%d.%m.%Y %H:%M:%S.%f", "fr": "%d/%m/%Y %H:%M:%S.%f"}.get(
            language, "%Y-%m-%d %H:%M:%S.%f"
        )
        cells = [(start + timedelta(seconds=float(x))).strftime(form)[:-3] for x in t]
        columns.append((words["time"].split()[-1] if language == "de" else words["time"], "", cells))
    else:
        columns.append(
            (words["time"], seconds, [f"{x:.3f}" if seconds == "s" else f"{1000 * x:.0f}" for x in t])
        )
    numbered = bool(rng.random() < 0.3)
    if numbered:
        columns.append((words["number"], "", [f"{n:.0f}" for n in number]))
    if arm:
        unit, factor = SPEEDS[rng.integers(len(SPEEDS))]
        noise = place * 2e-6 * rng.standard_normal(t.size)
        columns.append((words["speed"], unit, [f"{factor * x:.5f}" for x in place + noise]))
    else:
        columns.append((words["angle"], words["degree"], [f"{math.degrees(x) % 360.0:.4f}" for x in place]))
    if output == "pulses":
        columns.append((words["pulses"], "", [str(n) for n in np.diff(counts, prepend=counts[0])]))
    elif output == "saw-tooth":
        columns.append(
            (words["output"], words["degree"], [f"{n / counts_per_turn * 360.0 % 360.0:.4f}" for n in counts])
        )
    else:
        columns.append((words["count"], "", [str(n % 65536 if output == "folded" else n) for n in counts]))
    if rng.random() < 0.5:
        columns.append((words["room"], "°C", [f"{21.3 + 0.02 * math.sin(x / 900.0):.2f}" for x in t]))
    header = str(rng.choice(["in the name", "second row", "two rows"]))
    preamble = int(rng.integers(0, 2)) * [[words["serial"], "K-77"], ["Version", "2.4"]]
    rows = [*preamble, *_header(columns, header)]
    table = zip(*(cells for _, _, cells in columns), strict=True)
    rows += [list(cells) for cells, keep in zip(table, kept, strict=True) if keep]
    name = f"log-{seed}.xlsx" if sheet else f"log-{seed}.{rng.choice(['csv', 'txt'])}"
    form = _write_sheet(folder / name, rows) if sheet else _write_text(folder / name, rows, language, rng)
    what = ", ".join(
        [language, "arm" if arm else "head", output, *(["falling"] if falling else []), f"gap {gap}", header, seconds, form]
        + (["numbered"] if numbered else []) + (["preamble"] if preamble else [])
    )  # fmt: skip
    return DrawnLog(name, what, known)


def _header(columns: list[tuple[str, str, list[str]]], form: str) -> list[list[str]]:
    """Rows of the header: names and units in one row, in two, or names over two rows."""
    if form == "in the name":
        return [[f"{name} [{unit}]" if unit else name for name, unit, _ in columns]]
    if form == "second row":
        return [[name for name, _, _ in columns], [unit or "-" for _, unit, _ in columns]]
    split = [name.rsplit(" ", 1) if " " in name else [name, ""] for name, _, _ in columns]
    units = [f" ({unit})" if unit else "" for _, unit, _ in columns]
    return [
        [first for first, _ in split],
        [(second + unit).strip() for (_, second), unit in zip(split, units, strict=True)],
    ]


def _write_text(path: Path, rows: list[list[str]], language: str, rng: np.random.Generator) -> str:
    comma = language in ("de", "fr") and rng.random() < 0.8
    separator = str(rng.choice([";", "\t"] if comma else [",", ";", "\t"]))
    encoding = {"de": "cp1252", "fr": "utf-8-sig", "zh": "gb18030"}.get(language, "utf-8")
    if comma:
        rows = [[cell.replace(".", ",") if _numeric(cell) else cell for cell in row] for row in rows]
    path.write_bytes("".join(separator.join(row) + "\r\n" for row in rows).encode(encoding))
    return f"{separator!r} {'comma' if comma else 'point'}"


def _write_sheet(path: Path, rows: list[list[str]]) -> str:
    book = openpyxl.Workbook()
    sheet = book.active
    for row in rows:
        sheet.append([_cell(cell) for cell in row])
    book.save(path)
    return "sheet"


def _cell(text: str) -> float | datetime | str | None:
    """A number, a day with its time, a text, or an empty cell."""
    for form in ("%d.%m.%Y %H:%M:%S.%f", "%d/%m/%Y %H:%M:%S.%f"):
        with suppress(ValueError):
            return datetime.strptime(text, form)
    return float(text) if _numeric(text) else text or None


def _numeric(text: str) -> bool:
    return text.replace(".", "").lstrip("-").isdigit()


def calibrated(log: DrawnLog, folder: Path) -> piga.Calibration:
    """The log as ``piga init``, which asks for what the log does not say, and ``piga calibrate`` take it."""
    described, settings = describe_log(folder / log.name), {}
    while (draft := draft_run_file(described, settings)).open:
        settings |= {one.key: setting(f"{one.key}={log.known[one.key]}")[1] for one in draft.open}
        settings |= {"stand.height": log.known["stand.height"]} if "stand.latitude" in settings else {}
    path = (folder / log.name).with_suffix(".toml")
    try_run_file(draft, path)
    path.write_text(draft.text(), encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return piga.calibrate(piga.read_run(path))


def outcome(seed: int, folder: Path) -> tuple[DrawnLog, float, str]:
    """The log, the error of K in halves of its 95 % half-width (nan: refused), and the doubts or the refusal.

    Ten levels of an arm leave five degrees of freedom: by chance alone the error exceeds 3 u in 3 % of such logs, and the
    half-width, 2.6 u, in 5 %.
    """
    log = drawn(seed, folder)
    try:
        result = calibrated(log, folder)
    except (piga.PigaError, KeyError) as error:
        return log, math.nan, repr(error)
    k: Any = result["scale_factor"]
    doubts = " | ".join(doubt.what[:110] for doubt in result.verdict.doubts if "not stated" not in doubt.what)
    return log, 2.0 * (k.value - K) / k.expanded, f"u {k.std / K * 1e6:.2g} ppm; {doubts}"
