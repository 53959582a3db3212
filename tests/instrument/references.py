"""The committed 50-digit references of the motion, read as float64."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from piga.instrument import Instrument

DATA = Path(__file__).parent / "data"
EPS = float(np.finfo(float).eps)


def rows(name: str) -> list[dict[str, str]]:
    lines = (DATA / name).read_text().splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


@dataclass(frozen=True)
class Constant:
    """One case of constant input: what goes in, and turns, rest [rad] and rate [rad/s] of the reference."""

    case: str
    inst: Instrument
    same_tangent: bool
    force: tuple[float, float, float]
    t: float
    turns: int
    rest: float
    rate: float

    @property
    def kappa(self) -> float:
        """a^2 / |a^2 - b^2|, the condition of the problem."""
        a, b = abs(self.force[0]), math.hypot(*self.force[1:]) * abs(self.inst.tan_beta)
        gap = abs(a - b) * (a + b)
        return a * a / gap if gap else math.inf


def constant_cases() -> list[Constant]:
    cases = []
    for row in rows("constant.csv"):
        K, beta, tan_beta, alpha0, a_x, a_Y, a_Z, t = (
            float.fromhex(row[name]) for name in ("K", "beta", "tan_beta", "alpha0", "a_x", "a_Y", "a_Z", "t")
        )
        inst = Instrument(K, beta, alpha0)
        cases.append(
            Constant(row["case"], inst, inst.tan_beta == tan_beta, (a_x, a_Y, a_Z), t,
                     int(row["turns"]), float(row["rest"]), float(row["rate"]))
        )  # fmt: skip
    return cases


def linear_records() -> list[tuple[Instrument, np.ndarray, np.ndarray, np.ndarray]]:
    """Instrument, times, specific force (n, 3) and reference alpha of each record."""
    records = []
    table = rows("linear.csv")
    for number in sorted({row["record"] for row in table}):
        part = [row for row in table if row["record"] == number]
        t, f_x, f_Y, f_Z = (np.array([float.fromhex(r[n]) for r in part]) for n in ("t", "f_x", "f_Y", "f_Z"))
        alpha = np.array([float(r["alpha"]) for r in part])
        inst = Instrument(float.fromhex(part[0]["K"]), float.fromhex(part[0]["beta"]), alpha[0])
        records.append((inst, t, np.column_stack((f_x, f_Y, f_Z)), alpha))
    return records
