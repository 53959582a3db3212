"""Records with coloured noise from outside: motion, flicker and Markov noise are made here with NumPy alone.

The motion is a Runge-Kutta integration of fourth order. Flicker noise comes from its spectrum ``S = level^2/(ln 10 f)`` by
random amplitudes of a Fourier series eight times as long as the record. Markov noise is the exact recursion of an
Ornstein-Uhlenbeck process at four points of each interval.

``python -m tests.calibration.made.coloured_truth --tests 100 [CASE ...]``: how often each interval holds, by the shape of the
test. With ``--record`` the rows go into the table of the page 'Accuracy and limits'.
"""

from __future__ import annotations

import argparse
import math
import sys
import warnings
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from benchmarks import measured

import piga
from piga.units import G0
from tests.calibration.made.independent import Array, K, head

WARNED = "misses with a warning"
POINTS = 4
"""Points of the noise in an interval."""
PASSES = 4
"""Passes over the motion of a rate log: its gimbal stands still between the positions, so each begins where the last one ended."""


@dataclass(frozen=True)
class Coloured:
    """A test at positions or levels of constant force [g]; noise in rad, rad/sqrt(s), rad/s; ``markov`` has its time [s]."""

    forces: Array
    seconds: float = 60.0
    pause: float = 30.0
    rate: float = 5.0
    kind: Literal["angle", "rate"] = "angle"
    white: float = 2.5e-5
    walk: float = 1e-6
    flicker: float = 0.0
    markov: tuple[float, float] = (0.0, 5.0)
    wave: tuple[float, float] = (0.0, 1500.0)
    turning: Array | None = None
    terms: tuple[str, ...] = ("scale_factor", "tan_beta", "k0", "k2", "m_Y")
    truth: tuple[tuple[str, float], ...] = (("k0", 3e-4), ("k2", 2e-6), ("m_Y", 9.7e-5))
    tan_beta: float = 3.6e-4
    phi: float = 0.48

    def noise(self, rng: np.random.Generator) -> Array:
        """Mean coloured rate of every interval (positions, intervals) [rad/s]."""
        h, steps, count = 1.0 / self.rate, round(self.seconds * self.rate), len(self.forces)
        period = steps + round(self.pause * self.rate)
        size, fine = POINTS * count * period, h / POINTS
        rate = spectral(rng, size, fine, self.flicker) if self.flicker else np.zeros(size)
        level, time = self.markov
        if level:
            rate += level * ornstein_uhlenbeck(rng, size, fine, time)
        size_of_wave, long = self.wave
        rate += size_of_wave * np.sin(2.0 * np.pi * (fine * np.arange(size) / long + rng.uniform()))
        means: Array = rate.reshape(count, period, POINTS).mean(axis=2)[:, :steps]
        return means

    def record(self, seed: int) -> piga.Run:
        """One test."""
        rng = np.random.default_rng([seed, 2411])
        h, coloured = 1.0 / self.rate, self.noise(rng)
        count, steps = coloured.shape
        noise = coloured + self.walk / math.sqrt(h) * rng.standard_normal(coloured.shape)
        a, y, z = self.forces.T
        known = dict(self.truth)
        along = a + known.get("k0", 0.0) + known.get("k2", 0.0) * a**2 + known.get("k3", 0.0) * a**3
        along = K * (along + known.get("m_Y", 0.0) * y)
        base = np.zeros((count, 3)) if self.turning is None else self.turning
        across = self.tan_beta * np.stack([K * y - base[:, 1], K * z - base[:, 2]])

        def speed(angle: Array, extra: Array) -> Array:
            rates: Array = along - base[:, 0] + extra + across[0] * np.sin(angle) - across[1] * np.cos(angle)
            return rates

        angle = np.empty((count, steps + 1))
        angle[:, 0] = rng.uniform(-np.pi, np.pi, count) if self.kind == "angle" else self.phi
        for _ in range(1 if self.kind == "angle" else PASSES):
            for k in range(steps):
                now, extra = angle[:, k], noise[:, k]
                first = speed(now, extra)
                second = speed(now + 0.5 * h * first, extra)
                third = speed(now + 0.5 * h * second, extra)
                fourth = speed(now + h * third, extra)
                angle[:, k + 1] = now + h / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
            if self.kind == "rate":
                turned = angle[:, -1] - angle[:, 0]
                angle += (self.phi + np.cumsum(turned) - turned - angle[:, 0])[:, None]
        output = angle - self.phi + self.white * rng.standard_normal(angle.shape)
        if self.kind == "rate":
            drawn = self.walk * math.sqrt(self.rate) * rng.standard_normal((count, 1))
            output = speed(angle.T, np.hstack([coloured[:, :1] + drawn, noise]).T).T
        t = np.arange(count)[:, None] * (self.seconds + self.pause) + h * np.arange(steps + 1)
        return piga.Run.from_arrays(
            t.ravel(),
            output.ravel(),
            np.repeat(self.forces * G0, steps + 1, axis=0),
            scale_factor=f"{K} rad/s/g",
            base_rate=None if self.turning is None else np.repeat(base, steps + 1, axis=0),
            segment=np.repeat(np.arange(count, dtype=np.int32), steps + 1),
            serial="independent",
            kind=self.kind,
        )

    def true(self, name: str) -> float:
        """True value in file units."""
        fixed = {"scale_factor": K, "tan_beta": self.tan_beta, "phi": self.phi}
        return fixed[name] if name in fixed else dict(self.truth).get(name, 0.0)


def spectral(rng: np.random.Generator, size: int, step: float, level: float) -> Array:
    """1/f noise with the standard deviation ``level`` in each decade of frequency, down to an eighth of a period in the record."""
    whole = 1 << math.ceil(math.log2(8 * size))
    frequency = np.fft.rfftfreq(whole, step)[1:]
    amplitude = np.sqrt(level**2 / math.log(10.0) / frequency * frequency[0])
    phases = (
        amplitude * rng.rayleigh(1.0, frequency.size) * np.exp(2j * np.pi * rng.uniform(size=frequency.size))
    )
    rate: Array = np.fft.irfft(np.append(0.0, phases) * 0.5 * whole, whole)[:size]
    return rate


def ornstein_uhlenbeck(rng: np.random.Generator, size: int, step: float, time: float) -> Array:
    """A stationary first-order Markov process of unit variance at ``size`` times ``step`` [s] apart."""
    kept, drawn = math.exp(-step / time), rng.standard_normal(size)
    drawn[1:] *= math.sqrt(1.0 - kept**2)
    values = np.empty(size)
    last = 0.0
    for k, new in enumerate(drawn.tolist()):
        last = kept * last + new
        values[k] = last
    return values


HEAD = Coloured(head(24))
LOG = replace(HEAD, kind="rate", white=0.0, walk=2e-5)
LEVELS = np.array([-10.0, -6.0, -3.0, -1.0, 1.0, 3.0, 6.0, 10.0])
SPUN = Coloured(
    np.stack([LEVELS, 0.0 * LEVELS, 0.0 * LEVELS + 1.0], axis=1),
    turning=np.stack([0.0 * LEVELS, 0.0 * LEVELS, np.sqrt(np.abs(LEVELS) * G0)], axis=1),
    terms=("scale_factor", "tan_beta", "k0", "k2", "k3"),
    truth=(("k0", 3e-4), ("k2", 2e-6), ("k3", 1e-7)),
)
SHAPES = {
    "24 positions of 20 s": {"seconds": 20.0},
    "24 positions of 60 s": {},
    "24 positions of 180 s": {"seconds": 180.0},
    "12 positions of 60 s": {"forces": head(12)},
    "40 positions of 60 s": {"forces": head(40)},
    "24 positions of 600 s": {"seconds": 600.0},
}
NOISES = {
    "sound": {},
    "flicker": {"flicker": 3e-6},
    "Markov 5 s": {"markov": (3e-6, 5.0)},
    "Markov 60 s": {"markov": (3e-6, 60.0)},
    "wave of 5 µg and 1500 s": {"wave": (5e-6 * K, 1500.0)},
}


def cases() -> dict[str, Coloured]:
    """Every shape with every noise, angle and rate logs."""
    every = {}
    for noise, levels in NOISES.items():
        for base, log in ((HEAD, "angle log"), (LOG, "rate log")):
            for shape, changed in SHAPES.items():
                every[f"{noise}, {log}, {shape}"] = replace(base, **(changed | levels))
        every[f"{noise}, angle log, centrifuge of 8 levels of 60 s"] = replace(SPUN, **levels)
    return every


def judged(test: Coloured, tests: int, first: int = 0) -> dict[str, Any]:
    """Records, share with coloured noise, drift or scatter, share of intervals that hold (worst, best), what the records say."""
    held, seen, warned, degrees = [], 0, [], []
    for seed in range(first, first + tests):
        calibration = piga.calibrate(test.record(seed), test.terms)
        errors = np.array([c.value - test.true(c.name) for c in calibration.coefficients])
        turns = np.array([c.name == "phi" for c in calibration.coefficients])
        errors = np.where(turns, np.angle(np.exp(1j * errors)), errors)
        held.append(np.abs(errors) <= [c.expanded for c in calibration.coefficients])
        degrees.append(np.median([c.degrees_of_freedom for c in calibration.coefficients]))
        seen += (
            calibration.coloured_noise is not None
            or calibration.bias_drift > 0.0
            or calibration.segment_scatter > 0.0
        )
        warned.append(calibration.verdict.warns_of_noise)
    share, missed = 100.0 * np.mean(held, axis=0), ~np.all(held, axis=1)
    return {
        "records": tests,
        "seen": round(100.0 * seen / tests),
        "intervals hold": (round(float(share.min()), 1), round(float(share.max()), 1)),
        "misses": int(missed.sum()),
        WARNED: percent(np.array(warned)[missed]),
        "degrees of freedom": round(float(np.median(degrees))),
        "worst": calibration.coefficients[int(share.argmin())].name,
    }


def percent(said: Array) -> int:
    """Share [%] of records; 100 of none."""
    return round(100.0 * float(np.mean(said))) if said.size else 100


def put_down(rows: dict[str, dict[str, Any]], command: str) -> None:
    """These rows in the table of the page 'Accuracy and limits'; its other rows stay as they are."""
    columns = (
        "records", "seen", "intervals hold", "misses", WARNED, "degrees of freedom"
    )  # fmt: skip
    table: dict[str, dict[str, Any]] = {}
    for figure in measured.load("coloured-shapes")[1]:
        kept = {key: figure[key] for key in ("value", "version", "commit", "date", "command")}
        table.setdefault(figure["row"], {})[figure["column"]] = kept
    table |= {
        name: {column: {"value": row[column], "command": command} for column in columns}
        for name, row in rows.items()
    }
    measured.write(
        "coloured-shapes",
        "record",
        {name: {c: table[name][c] for c in columns if c in table[name]} for name in cases() if name in table},
        dict.fromkeys(("seen", "intervals hold", WARNED), "%"),
        command="python -m tests.calibration.made.coloured_truth --tests 100 --first 1000 --record 'NAME OF THE ROW'",
        conditions="independent motion and noise (NumPy): dividing head in the order of its angle, pauses of 30 s, 5 Hz; "
        "angle logs: 2.5e-5 rad, walk 1e-6 rad/√s; rate logs: walk 2e-5 rad/√s; colour of 3e-6 rad/s. Seen: coloured "
        "noise, drift or scatter in the covariance. Intervals: worst and best coefficient. Misses: records in which "
        "the interval of any coefficient misses. Warning: a doubt about the noise",
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*")
    parser.add_argument("--tests", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--record", action="store_true")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    known, rows = cases(), {}
    for name in [name for name in known if not given.cases or any(part in name for part in given.cases)]:
        row = rows[name] = judged(known[name], given.tests, given.first)
        low, high = row["intervals hold"]
        sys.stdout.write(
            f"{name}: {row['records']} records, seen {row['seen']} %, hold {low} ({row['worst']}) to {high} %, "
            f"{row['misses']} misses, warned {row[WARNED]} %, "
            f"degrees of freedom {row['degrees of freedom']}\n"
        )
        sys.stdout.flush()
        if given.record:
            put_down(
                rows,
                f"python -m tests.calibration.made.coloured_truth --tests {given.tests} --first {given.first} --record",
            )


if __name__ == "__main__":
    main()
