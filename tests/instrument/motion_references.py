"""Write tests/instrument/data/{constant,linear}.csv: the exact motion in 70-digit arithmetic.

Run: python tests/instrument/motion_references.py

The reference is not the formula that the product computes with. Constant input: the Riccati equation
of tan(theta/2), solved from its starting point (locked) or by the tangent (running), revolutions
counted with the exact period; some are checked here against Taylor integration of the differential
equation (mpmath.odefun). Input linear between samples: Taylor integration alone.
Inputs are float64 numbers taken as exact (tan(beta) too), in SI, written in hexadecimal.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from pathlib import Path

import mpmath as mp

mp.mp.dps = 70
DATA = Path(__file__).parent / "data"
G0 = 9.80665
HEADER = (
    "# made by tests/instrument/motion_references.py (mpmath, 70 digits); SI, float64 inputs in hexadecimal\n"
)

Input = tuple[float, float, float, float, float, float, float, float]  # K, beta, tan_beta, alpha0, force, t


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


def rates(K: float, tan_beta: float, force: tuple[float, float, float]) -> tuple[mp.mpf, mp.mpf, mp.mpf]:
    """a, y, z [rad/s]."""
    gain, coupling = mp.mpf(K), mp.mpf(tan_beta)
    return gain * mp.mpf(force[0]), gain * coupling * mp.mpf(force[1]), gain * coupling * mp.mpf(force[2])


def constant(case: Input) -> tuple[mp.mpf, mp.mpf]:
    """Unwrapped alpha and alpha' after t."""
    K, _, tan_beta, alpha0, *force, t = case
    a, y, z = rates(K, tan_beta, tuple(force))
    b, gamma = mp.sqrt(y * y + z * z), mp.atan2(z, y) if y or z else mp.mpf(0)
    alpha = adler(a, b, mp.mpf(alpha0) - gamma, mp.mpf(t)) + gamma
    return alpha, a + y * mp.sin(alpha) - z * mp.cos(alpha)


def taylor(K: float, tan_beta: float, alpha0: float, t: list[float], force: list) -> list[mp.mpf]:
    """alpha at the sample times by Taylor integration, force linear between samples; 25 digits."""
    alpha, out = mp.mpf(alpha0), [mp.mpf(alpha0)]
    for k in range(len(t) - 1):
        h = mp.mpf(t[k + 1]) - mp.mpf(t[k])
        start, end = rates(K, tan_beta, force[k]), rates(K, tan_beta, force[k + 1])

        def slope(s, x, start=start, end=end, h=h):
            a, y, z = (p + (q - p) * s / h for p, q in zip(start, end, strict=True))
            return [a + y * mp.sin(x[0]) - z * mp.cos(x[0])]

        with mp.workdps(30):
            alpha = mp.odefun(slope, 0, [alpha], tol=mp.mpf(10) ** -25)(h)[0]
        out.append(alpha)
    return out


def draw_instrument(rng: random.Random) -> tuple[float, float, float, float]:
    beta = rng.choice([-1, 1]) * 10 ** rng.uniform(-5, -1.3)
    return rng.uniform(0.55, 0.9) / G0, beta, math.tan(beta), rng.uniform(-7, 7)


def constant_inputs(rng: random.Random) -> Iterator[tuple[str, Input]]:
    """Around the separatrix on both sides and signs, at zero input, without coupling, and far along."""
    for exponent in [*range(16), None]:
        distance = 0.0 if exponent is None else 10.0**-exponent
        for side in (-1, 1):
            for sign in (-1, 1):
                for _ in range(5):
                    K, beta, tan_beta, alpha0 = draw_instrument(rng)
                    a_Y, a_Z = rng.uniform(-8, 8) * G0, rng.choice([0.0, rng.uniform(-8, 8) * G0])
                    b = math.hypot(a_Y, a_Z) * abs(tan_beta)
                    a_x = sign * (b + side * distance * b)
                    t = 10 ** rng.uniform(-1, 3) / (K * b)
                    yield f"separatrix 1e-{exponent}", (K, beta, tan_beta, alpha0, a_x, a_Y, a_Z, t)
    for _ in range(40):
        K, beta, tan_beta, alpha0 = draw_instrument(rng)
        force = (rng.uniform(-10, 10) * G0, rng.uniform(-10, 10) * G0, rng.uniform(-10, 10) * G0)
        yield "general", (K, beta, tan_beta, alpha0, *force, rng.uniform(-200, 200))
        yield "zero input", (K, beta, tan_beta, alpha0, 0.0, *force[1:], 10 ** rng.uniform(0, 4))
        yield "many turns", (K, beta, tan_beta, alpha0, *force, 10 ** rng.uniform(4, 9.5))
    K, _, _, alpha0 = draw_instrument(rng)
    yield "no coupling", (K, 0.0, 0.0, alpha0, G0, G0, G0, 100.0)
    yield "no force", (K, 1e-3, math.tan(1e-3), alpha0, 0.0, 0.0, 0.0, 100.0)


def write_constant(rng: random.Random) -> None:
    lines = [HEADER, "case,K,beta,tan_beta,alpha0,a_x,a_Y,a_Z,t,turns,rest,rate\n"]
    for number, (name, case) in enumerate(constant_inputs(rng)):
        alpha, rate = constant(case)
        K, _, tan_beta, alpha0, *force, t = case
        if number % 40 == 0 and K * max(map(abs, force)) * t < 100 and t > 0:
            independent = taylor(K, tan_beta, alpha0, [0.0, t], [tuple(force)] * 2)[-1]
            assert abs(independent - alpha) < 1e-20, (name, independent - alpha)
        turns = mp.nint(alpha / (2 * mp.pi))
        rest = alpha - 2 * mp.pi * turns
        inputs = ",".join(value.hex() for value in case)
        lines.append(f"{name},{inputs},{int(turns)},{mp.nstr(rest, 25)},{mp.nstr(rate, 25)}\n")
    (DATA / "constant.csv").write_text("".join(lines))


def write_linear(rng: random.Random) -> None:
    lines = [HEADER, "record,K,beta,tan_beta,t,f_x,f_Y,f_Z,alpha\n"]
    for record in range(4):
        K, beta, tan_beta, alpha0 = rng.uniform(0.55, 0.9) / G0, 0.05, math.tan(0.05), rng.uniform(-3, 3)
        t, force = [rng.uniform(-1, 1)], [tuple(rng.uniform(-3, 3) * G0 for _ in range(3))]
        for _ in range(5):
            t.append(t[-1] + rng.uniform(0.3, 1.0))
            force.append(tuple(rng.uniform(-3, 3) * G0 for _ in range(3)))
        for time, f, alpha in zip(t, force, taylor(K, tan_beta, alpha0, t, force), strict=True):
            inputs = ",".join(value.hex() for value in (K, beta, tan_beta, time, *f))
            lines.append(f"{record},{inputs},{mp.nstr(alpha, 22)}\n")
    (DATA / "linear.csv").write_text("".join(lines))


if __name__ == "__main__":
    DATA.mkdir(parents=True, exist_ok=True)
    write_constant(random.Random(2024))
    write_linear(random.Random(1946))
