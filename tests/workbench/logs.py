"""A log of a stranger with a known truth. The motion is integrated here by Runge and Kutta's rule; piga has no part in it."""

from __future__ import annotations

import math

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
