"""Do the 95 % intervals hold? The tables of intervals on the page 'Accuracy and limits'.

``python -m benchmarks.intervals coverage [--case NAME ...] [--repeats N] [--workers N] [--record]`` simulates and
calibrates the cases of ``benchmarks/cases/coverage.toml``. It prints a row for each case. ``--record`` puts the rows into
``docs/measured``.
"""

from __future__ import annotations

import argparse
import tomllib
import warnings
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from benchmarks import measured
from benchmarks.constant_force import ConstantForce, Joint, read_cases

from piga.campaign.shards import Outcome, of_calibration

CASES = Path(__file__).parent / "cases" / "coverage.toml"


class Plan(NamedTuple):
    """Tests to compute of one case: its number, name, records, and records with a Cramer-Rao bound."""

    number: int
    name: str
    repeats: int
    bounds: int


Tested = tuple[Outcome, np.ndarray]
"""The numbers of a record, and the Cramer-Rao bounds of its coefficients (nan where there is none)."""


def plans(repeats: int | None = None) -> tuple[int, list[Plan]]:
    """Seed and cases of the file."""
    document = tomllib.loads(CASES.read_text(encoding="utf-8"))
    head, cases = document["campaign"], enumerate(document["case"])
    return head["seed"], [
        Plan(
            k, case["name"], repeats or case.get("repeats", head["repeats"]), case.get("bounds", head["bounds"])
        )
        for k, case in cases
    ]


@cache
def scenarios() -> dict[str, ConstantForce | Joint]:
    """The tests of the file, read once in each process."""
    return read_cases(CASES)


def one(seed: int, plan: Plan, number: int) -> Tested:
    """Simulate and calibrate one record; its random numbers depend on seed, case and number alone."""
    test: Any = scenarios()[plan.name]
    run = test.record(np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(plan.number, number))))
    calibration = test.calibrate(run)
    bound = np.full(len(calibration.coefficients), np.nan)
    if number < plan.bounds and isinstance(test, ConstantForce):
        bound = np.sqrt(np.diag(test.bound(run)))
    return of_calibration(calibration, test.truths(calibration)), bound


def row(tests: list[Tested]) -> dict[str, measured.Value]:
    """The columns of a case: worst and best coefficient, bias, variance over the bound, NEES."""
    outcomes, bound = [outcome for outcome, _ in tests], np.array([bound for _, bound in tests])
    low, high, truth, error = (
        np.array([[row[key] for row in outcome.rows] for outcome in outcomes])
        for key in ("low", "high", "truth", "deviation")
    )
    held = (low <= truth) & (truth <= high)
    share, spread = 100.0 * held.mean(axis=0), error.std(axis=0, ddof=1)
    values: dict[str, measured.Value] = {
        "tests": len(outcomes),
        "coverage": (round(share.min(), 1), round(share.max(), 1)),
        "largest bias / sigma": round(np.abs(error.mean(axis=0) / spread).max(), 3),
        "NEES": round(float(np.mean([outcome.nees for outcome in outcomes])), 3),
        "NEES expected": round(float(np.mean([outcome.nees_expected for outcome in outcomes])), 3),
    }
    if np.isfinite(bound).any():
        ratio = spread**2 / np.nanmean(bound**2, axis=0)
        values["variance / bound"] = (round(ratio.min(), 2), round(ratio.max(), 2))
    return values


def put_down(rows: dict[str, dict[str, measured.Value]]) -> None:
    """Replace the figures of these cases in the table of intervals."""
    figures = measured.load("intervals")[1]  # without bounds, those of former runs stay, with their version
    new = {
        f["name"]: rows[f["scenario"]][f["column"]]
        for f in figures
        if f["column"] in rows.get(f["scenario"], {})
    }
    measured.record("intervals", new, command="python -m benchmarks.intervals coverage")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=["coverage"])
    parser.add_argument("--case", action="append", help="only this case; may be given again")
    parser.add_argument("--repeats", type=int)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--record", action="store_true")
    chosen = parser.parse_args()
    warnings.simplefilter("ignore")
    seed, every = plans(chosen.repeats)
    rows = {}
    with ProcessPoolExecutor(chosen.workers) as pool:
        for plan in [plan for plan in every if not chosen.case or plan.name in chosen.case]:
            outcomes = list(pool.map(one, repeat(seed), repeat(plan), range(plan.repeats), chunksize=4))
            rows[plan.name] = row(outcomes)
            print(plan.name, rows[plan.name], flush=True)
    if chosen.record:
        put_down(rows)


if __name__ == "__main__":
    main()
