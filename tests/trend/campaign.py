"""Coverage of the intervals of a trend over simulated histories: ``python -m tests.trend.campaign [--tests N] [--record]``."""

from __future__ import annotations

import argparse
import math

import numpy as np
from benchmarks import measured

from piga.trend.history import find_trend
from tests.trend.history import history

COLUMNS = ("drift", "coefficient", "further record")


def simulate(rng, days, per_day, excess, within, own, shared, drift, course=None):
    """One history with known truth; returns it and the truth at 1.3 times its length, and a further record.

    ``course`` makes the slow part of the coefficient at the times of the days and at the later time.
    """
    t, y, s = [], [], []
    scale = rng.normal(0, shared) if shared else 0.0
    span = 4.0
    later = 1.3 * span
    dates = [round(365.25 * span * day / (days - 1)) / 365.25 for day in range(days)]
    slow = np.zeros(days + 1) if course is None else course(rng, np.array([*dates, later]))
    for day, at in enumerate(dates):
        effect = rng.normal(0, excess)
        for run in range(per_day):
            std = own * (0.6 + 0.8 * ((day + run) % 3) / 2)
            t.append(at + run * 1e-4)
            value = 5.0 + drift * at + slow[day] + effect + rng.normal(0, within)
            y.append(value + rng.normal(0, std) + scale)
            s.append(math.hypot(std, shared))
    coefficient = 5.0 + drift * later + slow[-1] + rng.normal(0, excess) + rng.normal(0, within)
    further = coefficient + scale + rng.normal(0, math.sqrt(max(s[-1] ** 2 - shared**2, 0.0)))
    common = {"reference": {"k0": shared}} if shared else None
    return history(t, y, s, common=common), later, coefficient, further


def walk(rng, times):
    """A random walk with a standard deviation of 5 after a year."""
    return 5.0 * np.cumsum(rng.normal(0, 1, times.size) * np.sqrt(np.diff(times, prepend=0.0)))


def ageing(rng, times):
    """Ageing by 20 with a time constant of one to four years."""
    return 20.0 * (1.0 - np.exp(-times / rng.uniform(1.0, 4.0)))


SCENARIOS = {
    "8 days, stated scatter only": (8, 1, 0.0, 0.0, 1.0, 0.0),
    "8 days, instability as large": (8, 1, 1.0, 0.0, 1.0, 0.0),
    "6 days, instability five times as large": (6, 1, 5.0, 0.0, 1.0, 0.0),
    "4 days, instability as large": (4, 1, 1.0, 0.0, 1.0, 0.0),
    "24 days, instability half as large": (24, 1, 0.5, 0.0, 1.0, 0.0),
    "7 days of 3 turn-ons, instability and turn-on": (7, 3, 1.0, 2.0, 1.0, 0.0),
    "10 days, shared standard three times as large": (10, 1, 1.0, 0.0, 1.0, 3.0),
    "12 days, random walk": (12, 1, 0.0, 0.0, 1.0, 0.0),
    "12 days, ageing": (12, 1, 0.0, 0.0, 1.0, 0.0),
}
COURSES = {"12 days, random walk": walk, "12 days, ageing": ageing}


def covered(scenario, repeats, seed):
    """Shares of histories whose 95 % intervals hold drift, coefficient and further record.

    The drift is that of the line. It has no true value where the coefficient walks or ages.
    """
    rng = np.random.default_rng(seed)
    hits, course = np.zeros(3), COURSES.get(scenario)
    for _ in range(repeats):
        entries, later, coefficient, further = simulate(rng, *SCENARIOS[scenario], drift=0.7, course=course)
        trend = find_trend(entries)["k0"]
        pairs = (
            (trend.drift, 0.7 if course is None else math.nan),
            (trend.coefficient_at(later), coefficient),
            (trend.next_record(later), further),
        )
        hits += [abs(f.value - truth) <= f.half_width() for f, truth in pairs]
    return np.where([course is not None, False, False], math.nan, hits / repeats)


def main():
    """Run all scenarios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tests", type=int, default=300)
    parser.add_argument("--record", action="store_true", help="write them into docs/measured")
    arguments = parser.parse_args()
    rows = {}
    for scenario in SCENARIOS:
        shares = covered(scenario, arguments.tests, 11)
        rows[scenario] = {
            column: {"value": round(100 * float(share), 1), "decimals": 1, "unit": "%"}
            for column, share in zip(COLUMNS, shares, strict=True)
            if not math.isnan(share)
        }
        print(scenario, *(cell["value"] for cell in rows[scenario].values()), flush=True)
    if arguments.record:
        conditions = (
            f"coverage of 95 % intervals over {arguments.tests} simulated histories each, seed 11; "
            "the stated uncertainties differ by a factor of 2.3 within each history"
        )
        measured.write(
            "trend-intervals",
            "history",
            rows,
            command="python -m tests.trend.campaign",
            conditions=conditions,
        )


if __name__ == "__main__":
    main()
