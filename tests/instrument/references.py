"""References of the motion in 70-digit arithmetic, made when the tests run.

They are not the formula that the product computes with. Constant input: the Riccati equation of ``tan(theta/2)``, solved from
its starting point (locked) or by the tangent (running), revolutions counted with the exact period. Input that is linear between
samples: Taylor integration. Inputs are float64 numbers taken as exact, ``tan(beta)`` too.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import mpmath as mp
import numpy as np

from piga.instrument import Instrument
from piga.units import G0

DIGITS = 70
EPS = float(np.finfo(float).eps)


@dataclass(frozen=True)
class Constant:
    """One case of constant input: what goes in, and turns, rest [rad] and rate [rad/s] of the reference."""

    case: str
    inst: Instrument
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


def adler(a: mp.mpf, b: mp.mpf, theta0: mp.mpf, t: mp.mpf) -> mp.mpf:
    """Unwrapped theta(t) of theta' = a + b sin(theta), for b >= 0."""
    if a < 0:
        return -adler(-a, b, -theta0, t)
    turns = mp.floor((theta0 + mp.pi) / (2 * mp.pi))
    start = theta0 - 2 * mp.pi * turns
    p0 = mp.tan(start / 2)
    q = (a - b) * (a + b)
    if q > 0:
        root = mp.sqrt(q)
        phase = root * t / 2 + mp.atan((a * p0 + b) / root)
        n = mp.floor(phase / mp.pi + mp.mpf(1) / 2)
        return 2 * mp.atan((root * mp.tan(phase - n * mp.pi) - b) / a) + 2 * mp.pi * (turns + n)
    if q == 0:
        p = 1 / (1 / (p0 + 1) - a * t / 2) - 1 if a else p0
    else:
        root = mp.sqrt(-q)
        e = mp.expm1(root * t)
        p = p0 + (a * p0 * p0 + 2 * b * p0 + a) * e / (2 * root + (root - a * p0 - b) * e)
    theta = 2 * mp.atan(p)
    forward = (a + b * mp.sin(start)) * t
    if forward * (theta - start) < 0:
        theta += 2 * mp.pi * mp.sign(forward)
    return theta + 2 * mp.pi * turns


def rates(inst: Instrument, force: tuple[float, float, float]) -> tuple[mp.mpf, mp.mpf, mp.mpf]:
    """a, y, z [rad/s]."""
    gain, coupling = mp.mpf(inst.scale_factor), mp.mpf(inst.tan_beta)
    return gain * mp.mpf(force[0]), gain * coupling * mp.mpf(force[1]), gain * coupling * mp.mpf(force[2])


def drawn_instrument(rng: random.Random) -> Instrument:
    beta = rng.choice([-1, 1]) * 10 ** rng.uniform(-5, -1.3)
    return Instrument(rng.uniform(0.55, 0.9) / G0, beta, rng.uniform(-7, 7))


def constant_inputs(rng: random.Random) -> Iterator[tuple[str, Instrument, tuple[float, float, float], float]]:
    """Around the separatrix on both sides and signs, at zero input, without coupling, and far along."""
    for exponent in [*range(16), None]:
        distance = 0.0 if exponent is None else 10.0**-exponent
        for side, sign in np.repeat([(-1, -1), (-1, 1), (1, -1), (1, 1)], 5, axis=0).tolist():
            inst = drawn_instrument(rng)
            a_Y, a_Z = rng.uniform(-8, 8) * G0, rng.choice([0.0, rng.uniform(-8, 8) * G0])
            b = math.hypot(a_Y, a_Z) * abs(inst.tan_beta)
            a_x = sign * (b + side * distance * b)
            yield (
                f"separatrix 1e-{exponent}",
                inst,
                (a_x, a_Y, a_Z),
                10 ** rng.uniform(-1, 3) / (inst.scale_factor * b),
            )
    for _ in range(40):
        inst, (x, y, z) = drawn_instrument(rng), (rng.uniform(-10, 10) * G0 for _ in range(3))
        yield "general", inst, (x, y, z), rng.uniform(-200, 200)
        yield "zero input", inst, (0.0, y, z), 10 ** rng.uniform(0, 4)
        yield "many turns", inst, (x, y, z), 10 ** rng.uniform(4, 9.5)
    last = drawn_instrument(rng)
    yield "no coupling", Instrument(last.scale_factor, 0.0, last.alpha0), (G0, G0, G0), 100.0
    yield "no force", Instrument(last.scale_factor, 1e-3, last.alpha0), (0.0, 0.0, 0.0), 100.0


@cache
def constant_cases() -> list[Constant]:
    cases = []
    with mp.workdps(DIGITS):
        for name, inst, force, t in constant_inputs(random.Random(2024)):
            a, y, z = rates(inst, force)
            b, gamma = mp.sqrt(y * y + z * z), mp.atan2(z, y) if y or z else mp.mpf(0)
            alpha = adler(a, b, mp.mpf(inst.alpha0) - gamma, mp.mpf(t)) + gamma
            turns = mp.nint(alpha / (2 * mp.pi))
            rest, rate = alpha - 2 * mp.pi * turns, a + y * mp.sin(alpha) - z * mp.cos(alpha)
            cases.append(Constant(name, inst, force, t, int(turns), float(rest), float(rate)))
    return cases


def linear_record(seed: int) -> tuple[Instrument, np.ndarray, np.ndarray, np.ndarray]:
    """Instrument, times, specific force (n, 3) that is linear between them, and angle by Taylor integration."""
    rng = random.Random(seed)
    inst = Instrument(rng.uniform(0.55, 0.9) / G0, 0.05, rng.uniform(-3, 3))
    t = np.cumsum([rng.uniform(-1, 1), rng.uniform(0.3, 1.0), rng.uniform(0.3, 1.0)])
    force = np.array([[rng.uniform(-3, 3) * G0 for _ in range(3)] for _ in t])
    alpha = [mp.mpf(inst.alpha0)]
    with mp.workdps(25):
        for k in range(t.size - 1):
            h = mp.mpf(t[k + 1]) - mp.mpf(t[k])
            start, end = rates(inst, tuple(force[k])), rates(inst, tuple(force[k + 1]))

            def slope(s, x, start=start, end=end, h=h):
                a, y, z = (p + (q - p) * s / h for p, q in zip(start, end, strict=True))
                return [a + y * mp.sin(x[0]) - z * mp.cos(x[0])]

            alpha.append(mp.odefun(slope, 0, [alpha[-1]], tol=mp.mpf(10) ** -20)(h)[0])
    return inst, t, force, np.array(alpha, dtype=float)
