"""Logs of strangers with a known truth. The motion is integrated here by Runge and Kutta's rule; piga has no part in it."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator

import numpy as np

K, TAN_BETA, K0 = 0.8884 * 1.0007, 4e-3, 3.1e-4
"""Scale factor [rad/s/g], non-orthogonality, bias [g]."""
COUNTS = 72000
Force = tuple[float, float, float]


def step(alpha: float, f: Force, h: float) -> float:
    """The output angle after ``h`` seconds under a constant force [g]."""

    def rate(a: float) -> float:
        return K * (K0 + f[0] + TAN_BETA * (f[1] * math.sin(a) - f[2] * math.cos(a)))

    one = rate(alpha)
    two = rate(alpha + 0.5 * h * one)
    three = rate(alpha + 0.5 * h * two)
    return alpha + h / 6.0 * (one + 2.0 * two + 2.0 * three + rate(alpha + h * three))


def counted(alpha: float, rng: np.random.Generator) -> int:
    """The counter at an angle, with a little noise."""
    return int(alpha / (2.0 * math.pi) * COUNTS + 0.2 * rng.standard_normal())


def german() -> bytes:
    """A dividing head that moves at the begin of each position, and a gap: preamble, decimal commas, cp1252."""
    rng, t, alpha, h = np.random.default_rng(3), 0.0, 0.3, 0.05
    text = "Pr\u00fcfstand 3;Teilkopf\nBediener;M\u00fcller\nZeit;Z\u00e4hlerstand;Position;fx;fy;fz\ns;-;-;g;g;g\n"

    def head(position: int, row: float) -> Force:
        part = min(row / 40.0, 1.0) if position else 1.0
        a = math.radians(45.0 * (position - 1 + part))
        return math.cos(a), math.sin(a), 0.0

    for position in range(8):
        for row in range(1200):
            f = head(position, row)
            cells = (f"{t:.2f}", str(counted(alpha, rng)), str(position), *(f"{x:.9f}" for x in f))
            if not (position == 4 and 600 <= row < 700):
                text += ";".join(cells).replace(".", ",") + "\n"
            alpha = step(alpha, head(position, row + 0.5), h)
            t += h
    return text.encode("cp1252")


def chinese_rows() -> Iterator[tuple[object, ...]]:
    """Eight positions; an output angle in degrees that wraps at 360."""
    rng, t, alpha, h = np.random.default_rng(5), 0.0, 0.7, 0.1
    yield (
        "\u65f6\u95f4",
        "\u8f93\u51fa\u89d2",
        "\u4f4d\u7f6e",
        "X\u8f74\u6bd4\u529b",
        "Y\u8f74\u6bd4\u529b",
        "Z\u8f74\u6bd4\u529b",
    )
    yield ("s", "deg", "-", "g", "g", "g")
    for position in range(8):
        a = math.radians(45.0 * position + (11.0 if position % 2 else 0.0))
        f = (math.cos(a), 0.8 * math.sin(a), 0.6 * math.sin(a))
        for _ in range(600):
            shown = math.degrees(alpha + 2e-5 * float(rng.standard_normal())) % 360.0
            yield (round(t, 1), round(shown, 5), position + 1, *(round(x, 9) for x in f))
            alpha = step(alpha, f, h)
            t += h
        alpha, t = step(alpha, f, 0.5), t + 0.5


def chinese() -> bytes:
    """The rows as an XLSX file."""
    from openpyxl import Workbook

    book = Workbook()
    for row in chinese_rows():
        book.active.append(row)
    stream = io.BytesIO()
    book.save(stream)
    return stream.getvalue()


def centrifuge() -> bytes:
    """A centrifuge that goes up in ramps, with the specific force logged."""
    rng, t, alpha, h = np.random.default_rng(7), 0.0, 0.1, 0.05
    text = "t_s,counts,level,fx_g,fy_g,fz_g\n"
    levels = (1.0, 2.0, 4.0, 6.0, 8.0, 10.0, 3.0)

    def force(index: int, row: float) -> Force:
        before = levels[index - 1] if index else levels[0]
        part = min(row / 100.0, 1.0)
        return before + (levels[index] - before) * part, 0.0, 1.0

    for index in range(len(levels)):
        for row in range(900):
            f = force(index, row)
            text += f"{t:.2f},{counted(alpha, rng)},{index},{f[0]:.9f},{f[1]:.9f},{f[2]:.9f}\n"
            alpha = step(alpha, force(index, row + 0.5), h)
            t += h
    return text.encode()
