"""Coverage of the intervals: simulated tests with every kind of noise, calibrated as a user would.

Run with ``python -m benchmarks.scatter_rule [CASE ...] [--seeds N]``; without a case, all. Prints, for each case, the share of
95 % intervals that hold the truth, the standard deviation of the errors over the median standard uncertainty, and the
median expanded uncertainty. The simulator is NumPy alone: steps of fourth order for the motion, noise added to the angle.
"""

from __future__ import annotations

import sys
import warnings
from dataclasses import dataclass, replace

import numpy as np

import piga
from piga.units import G0

K, TANGENT, PHASE, BIAS = 0.8884 / G0, 1e-3, 0.7, 1e-3
TRUTH = {"scale_factor": 0.8884, "tan_beta": TANGENT, "k0": BIAS, "k2": 0.0, "m_Y": 0.0}
H = 0.1


@dataclass(frozen=True)
class Case:
    """A plan and its noise: standard deviations [rad, rad/sqrt(s), rad/s]; ``count`` in readings a turn (0: none)."""

    positions: int = 24
    dwell: float = 60.0
    white: float = 2e-5
    walk: float = 2e-5
    scatter: float = 0.0
    flicker: float = 0.0
    markov: float = 0.0
    count: int = 0
    phases: str = "shared"
    runs: int = 1
    terms: tuple[str, ...] = ("scale_factor", "tan_beta", "k0", "k2", "m_Y")


PLAIN = Case()
CASES = {
    "white": replace(PLAIN, walk=0.0),
    "walk": PLAIN,
    "scatter": replace(PLAIN, scatter=3e-6),
    "flicker": replace(PLAIN, flicker=2e-6),
    "markov": replace(PLAIN, markov=3e-6),
    "counts 3600": replace(PLAIN, count=3600, white=0.0),
    "white, 12": replace(PLAIN, positions=12, walk=0.0),
    "counts 3600, 12": replace(PLAIN, positions=12, count=3600, white=0.0),
    "counts 36000, 12": replace(PLAIN, positions=12, count=36000, white=0.0),
    "phases, 12": replace(PLAIN, positions=12, phases="per-segment"),
    "four": replace(PLAIN, positions=4, terms=("scale_factor", "tan_beta", "k0")),
    "joint": replace(PLAIN, positions=12, runs=2),
}
SWAYING = replace(PLAIN, positions=1, dwell=150.0, white=0.0, terms=("scale_factor", "tan_beta", "k0", "k2"))
CASES |= {
    f"continuous {count}, walk {walk:g}": replace(SWAYING, count=count, walk=walk)
    for count in (3600, 36000, 360000)
    for walk in (1e-6, 1e-5, 1e-4)
}


def motion(force: np.ndarray, start: float) -> np.ndarray:
    """Angle (n + 1,) under (2 n + 1, 2) ``a_x, a_Y`` at half steps of H, by the classical Runge-Kutta rule."""

    def rate(at: int, angle: float) -> float:
        a, b = force[at]
        return K * (a + BIAS * G0 + b * TANGENT * np.sin(angle))

    angle = np.empty(len(force) // 2 + 1)
    angle[0] = start
    for i in range(angle.size - 1):
        one = rate(2 * i, angle[i])
        two = rate(2 * i + 1, angle[i] + 0.5 * H * one)
        three = rate(2 * i + 1, angle[i] + 0.5 * H * two)
        four = rate(2 * i + 2, angle[i] + H * three)
        angle[i + 1] = angle[i] + H / 6.0 * (one + 2.0 * two + 2.0 * three + four)
    return angle


def plan(
    case: Case, order: np.random.Generator, start: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times, force (n, 3), angle and position of each sample; the gimbal begins at the angle ``start``."""
    n = round(case.dwell / H)
    if case.positions == 1:
        half = 0.5 * H * np.arange(2 * n + 1)
        force = G0 * np.column_stack(
            [1.5 * np.sin(2.0 * np.pi * half / 50.0) + 0.7, np.cos(2.0 * np.pi * half / 70.0)]
        )
        return (
            half[::2],
            np.column_stack([force[::2], np.zeros(n + 1)]),
            motion(force, start),
            np.zeros(n + 1, int),
        )
    tilt = order.permutation(2.0 * np.pi * (np.arange(case.positions) + 0.2) / case.positions)
    times, forces, angles = [], [], []
    for index, x in enumerate(tilt):
        force = G0 * np.array([np.cos(x), -np.sin(x)])
        angles.append(motion(np.tile(force, (2 * n + 1, 1)), start))
        start = angles[-1][-1] + K * force[0] * 5.0
        times.append(index * (case.dwell + 5.0) + H * np.arange(n + 1))
        forces.append(np.tile([*force, 0.0], (n + 1, 1)))
    position = np.repeat(np.arange(case.positions), n + 1)
    return np.concatenate(times), np.vstack(forces), np.concatenate(angles), position


def rates(case: Case, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Slow error of the rate at the times ``t``, sampled every second over the whole test."""
    grid = np.arange(0.0, t[-1] + 2.0)
    total = np.zeros(grid.size)
    times = 2.0 * 10.0 ** np.arange(0.0, 3.1, 0.5) if case.flicker else ()
    for time, size in [(60.0, case.markov)] * bool(case.markov) + [(time, case.flicker) for time in times]:
        kept, x = np.exp(-1.0 / time), rng.standard_normal()
        noise = np.sqrt(1.0 - kept**2) * rng.standard_normal(grid.size)
        for i in range(grid.size):
            x = kept * x + noise[i]
            total[i] += size * x
    return np.interp(t, grid, total)


def record(case: Case, seed: int, number: int = 0) -> piga.Run:
    """One simulated record.

    It begins at a random angle. From one angle the errors of coarse counts would be nearly the same in every record: coverage
    would be that of this one motion (a continuous record of 36 000 counts: 85 % for K, 99 % for tan_beta).
    """
    rng = np.random.default_rng([seed, number])
    start = np.random.default_rng([seed, number, 1]).uniform(0.0, 2.0 * np.pi)
    t, force, angle, position = plan(case, np.random.default_rng(number), start)
    h = np.diff(t, prepend=t[0])
    begins = np.diff(position, prepend=-1) != 0
    noise = case.walk * np.sqrt(h) * rng.standard_normal(t.size)
    noise += h * (rates(case, t, rng) + case.scatter * rng.standard_normal(case.positions)[position])
    noise[begins] = 0.0
    output = angle - PHASE + np.cumsum(noise) + case.white * rng.standard_normal(t.size)
    if case.phases == "per-segment":
        output += rng.uniform(0.0, 6.0, case.positions)[position]
    count = 2.0 * np.pi / case.count if case.count else 0.0
    if count:
        start = rng.uniform(0.0, count)
        output = np.round((output + start) / count) * count - start
    return piga.Run.from_arrays(
        t,
        output,
        force,
        uncertainty={"waived": {"earth_rate": "simulated at rest", "servo": "simulated without"}},
        scale_factor="0.8884 rad/s/g",
        segment=position,
        resolution=count,
        serial="S1",
        model={"terms": list(case.terms), "phases": case.phases},
        units="SI",
    )


def campaign(name: str, seeds: int) -> str:
    """Calibrate ``seeds`` records of a case; a row of the table."""
    case, rows, noisy, refused = CASES[name], [], 0, 0
    for seed in range(seeds):
        runs = [record(case, seed, number) for number in range(case.runs)]
        try:
            result = piga.calibrate(runs if case.runs > 1 else runs[0])
        except piga.PigaError:
            refused += 1
            continue
        noisy += bool(result.verdict.warns_of_noise)
        rows += [
            (c.name, c.value - TRUTH[c.name], c.std, c.coverage_factor * c.std)
            for c in result.coefficients
            if c.name in TRUTH
        ]
    cells = []
    for term in case.terms:
        own = np.array([row[1:] for row in rows if row[0] == term])
        if own.size:
            held = np.mean(np.abs(own[:, 0]) <= own[:, 2])
            cells.append(
                f"{100.0 * held:.0f} ({own[:, 0].std() / np.median(own[:, 1]):.2f}, {np.median(own[:, 2]) * 1e6:.3g})"
            )
    return f"| {name} | {' | '.join(cells)} | {noisy} | {refused} |"


def main() -> None:
    """Print the table."""
    warnings.simplefilter("ignore")
    arguments = sys.argv[1:]
    seeds = int(arguments.pop(arguments.index("--seeds") + 1)) if "--seeds" in arguments else 100
    names = [name for name in arguments if not name.startswith("--")] or list(CASES)
    print(
        f"# {seeds} records a case: % of intervals that hold (spread of errors over u, median U in 1e-6 of the unit)"
    )
    print(f"| case | {' | '.join(PLAIN.terms)} | noise warned of | refused |")
    print("|---|---|---|---|---|---|---|---|")
    for name in names:
        print(campaign(name, seeds), flush=True)


if __name__ == "__main__":
    main()
