"""Do the 95 % intervals hold? The tables of intervals on the page 'Accuracy and limits'.

``python -m benchmarks.intervals coverage [--case NAME ...] [--repeats N] [--workers N] [--record]`` simulates and
calibrates the cases of ``benchmarks/cases/coverage.toml``. It prints a row for
each case. ``--record`` puts the rows into ``docs/measured``.
"""

from __future__ import annotations

import argparse
import tomllib
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from benchmarks import measured
from benchmarks.constant_force import ConstantForce, Joint, read_cases

from piga.campaign.subjects import NOISE_DOUBTED, Outcome, of_calibration

CASES = Path(__file__).with_name("cases")
TABLES = {"coverage": "intervals"}


class Plan(NamedTuple):
    """Tests to compute of one case: its number, name, records, and records with a Cramer-Rao bound."""

    number: int
    name: str
    repeats: int
    bounds: int


def plans(name: str, repeats: int | None = None) -> tuple[int, list[Plan]]:
    """Seed and cases of a file."""
    document = tomllib.loads((CASES / f"{name}.toml").read_text(encoding="utf-8"))
    head = document["campaign"]
    return head["seed"], [
        Plan(
            number,
            case["name"],
            repeats or case.get("repeats", head["repeats"]),
            case.get("bounds", head["bounds"]),
        )
        for number, case in enumerate(document["case"])
    ]


@cache
def tests_of(name: str) -> dict[str, ConstantForce | Joint]:
    """The tests of a file, read once in each process."""
    return read_cases(CASES / f"{name}.toml")


def one(name: str, seed: int, plan: Plan, number: int) -> Outcome:
    """Simulate and calibrate one record; its random numbers depend on seed, case and number alone."""
    test: Any = tests_of(name)[plan.name]
    run = test.record(np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(plan.number, number))))
    calibration = test.calibrate(run)
    bound = np.sqrt(np.diag(test.bound(run))) if number < plan.bounds else None
    return of_calibration(calibration, test.truths(calibration), bound)


def row(outcomes: list[Outcome]) -> dict[str, measured.Value]:
    """The columns of a case: worst and best coefficient, bias, variance over the bound, NEES, misses."""
    low, high, truth, error, bound = (
        np.array([getattr(outcome, key) for outcome in outcomes])
        for key in ("low", "high", "truth", "error", "bound")
    )
    held = (low <= truth) & (truth <= high)
    share, spread = 100.0 * held.mean(axis=0), error.std(axis=0, ddof=1)
    missed = [outcome for outcome, all_held in zip(outcomes, held.all(axis=1), strict=True) if not all_held]
    warned = np.mean([NOISE_DOUBTED in outcome.seen for outcome in missed]) if missed else 1.0
    values: dict[str, measured.Value] = {
        "tests": len(outcomes),
        "records": len(outcomes),
        "coverage": (round(share.min(), 1), round(share.max(), 1)),
        "intervals hold": (round(share.min(), 1), round(share.max(), 1)),
        "intervals hold, on average": round(share.mean(), 1),
        "worst coefficient": round(share.min(), 1),
        "largest bias / sigma": round(np.abs(error.mean(axis=0) / spread).max(), 3),
        "NEES": round(float(np.mean([outcome.nees for outcome in outcomes])), 3),
        "NEES expected": round(float(np.mean([outcome.nees_expected for outcome in outcomes])), 3),
        "misses": len(missed),
        "misses with a warning": round(100.0 * float(warned)),
    }
    if np.isfinite(bound).any():
        ratio = spread**2 / np.nanmean(bound**2, axis=0)
        values["variance / bound"] = (round(ratio.min(), 2), round(ratio.max(), 2))
    return values


def put_down(name: str, rows: dict[str, tuple[dict[str, measured.Value], list[Outcome]]]) -> None:
    """Replace the figures of these cases in their table."""
    table = TABLES[name]
    new: dict[str, measured.Value] = {}
    for figure in measured.load(table)[1]:
        case = next((c for c in rows if figure.get("scenario") == c), None)
        if case is None:
            continue
        values, outcomes = rows[case]
        if "reported" in figure:
            new[figure["name"]] = round(100.0 * np.mean([figure["reported"] in o.seen for o in outcomes]), 1)
        elif figure["column"] in values:
            new[figure["name"]] = values[figure["column"]]
    measured.record(table, new, command=f"python -m benchmarks.intervals {name}")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=TABLES)
    parser.add_argument("--case", action="append", help="only this case; may be given again")
    parser.add_argument("--repeats", type=int)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--record", action="store_true")
    chosen = parser.parse_args()
    seed, every = plans(chosen.name, chosen.repeats)
    rows = {}
    with ProcessPoolExecutor(chosen.workers) as pool:
        for plan in [plan for plan in every if not chosen.case or plan.name in chosen.case]:
            made = pool.map(
                one, repeat(chosen.name), repeat(seed), repeat(plan), range(plan.repeats), chunksize=4
            )
            outcomes = list(made)
            rows[plan.name] = row(outcomes), outcomes
            print(
                plan.name, ", ".join(f"{key} {value}" for key, value in rows[plan.name][0].items()), flush=True
            )
    if chosen.record:
        put_down(chosen.name, rows)


if __name__ == "__main__":
    main()
