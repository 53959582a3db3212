"""Do the 95 % intervals hold? The tables of intervals on the page 'Accuracy and limits'.

``python -m benchmarks.intervals coverage [--case NAME ...] [--repeats N] [--workers N] [--record]`` simulates and
calibrates the cases of ``benchmarks/cases/coverage.toml``. It prints a row for
each case. ``--record`` puts the rows into ``docs/measured``.

``--write FILE`` keeps coverage, width and bias of each coefficient. With ``PYTHONPATH`` at the sources of another version the
same records are calibrated by it. ``python -m benchmarks.intervals compare OLD NEW`` puts both into ``docs/measured``.
"""

from __future__ import annotations

import argparse
import json
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

import piga
from piga.campaign.subjects import Outcome, of_calibration

CASES = Path(__file__).parent / "cases" / "coverage.toml"


class Plan(NamedTuple):
    """Tests to compute of one case: its number, name, records, and records with a Cramer-Rao bound."""

    number: int
    name: str
    repeats: int
    bounds: int


def plans(repeats: int | None = None) -> tuple[int, list[Plan]]:
    """Seed and cases of the file."""
    document = tomllib.loads(CASES.read_text(encoding="utf-8"))
    head, cases = document["campaign"], enumerate(document["case"])
    return head["seed"], [
        Plan(k, case["name"], repeats or case.get("repeats", head["repeats"]), head["bounds"])
        for k, case in cases
    ]


@cache
def scenarios() -> dict[str, ConstantForce | Joint]:
    """The tests of the file, read once in each process."""
    return read_cases(CASES)


def one(seed: int, plan: Plan, number: int) -> Outcome:
    """Simulate and calibrate one record; its random numbers depend on seed, case and number alone."""
    test: Any = scenarios()[plan.name]
    run = test.record(np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(plan.number, number))))
    calibration = test.calibrate(run)
    bound = np.sqrt(np.diag(test.bound(run))) if number < plan.bounds else None
    return of_calibration(calibration, test.truths(calibration), bound)


def row(outcomes: list[Outcome]) -> dict[str, measured.Value]:
    """The columns of a case: worst and best coefficient, bias, variance over the bound, NEES."""
    low, high, truth, error, bound = (
        np.array([outcome.columns[key] for outcome in outcomes])
        for key in ("low", "high", "truth", "deviation", "bound")
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


def by_coefficient(outcomes: list[Outcome]) -> dict[str, dict[str, float]]:
    """Share of intervals that hold, median half width, and mean error over its standard deviation, of each coefficient."""
    low, high, truth, error = (
        np.array([one.columns[key] for one in outcomes]) for key in ("low", "high", "truth", "deviation")
    )
    held = 100.0 * ((low <= truth) & (truth <= high)).mean(axis=0)
    width, bias = np.median(0.5 * (high - low), axis=0), error.mean(axis=0) / error.std(axis=0, ddof=1)
    columns = zip(outcomes[0].columns["name"], held.tolist(), width.tolist(), bias.tolist(), strict=True)
    return {name: {"held": h, "width": w, "bias": b} for name, h, w, b in columns}


def compare(old: str, new: str) -> None:
    """Write the table of two versions on the same records."""
    before, after = (json.loads(Path(file).read_text(encoding="utf-8")) for file in (old, new))
    rows: dict[str, dict[str, measured.Value]] = {}
    units = {}
    for case, result in after["cases"].items():
        former = before["cases"][case]
        ratio = [c["width"] / former[name]["width"] for name, c in result.items()]
        rows[case] = {"records": after["repeats"]}
        for whole, values in ((before["version"], former), (after["version"], result)):
            version = ".".join(whole.split(".")[:2])
            held, bias = ([c[key] for c in values.values()] for key in ("held", "bias"))
            units[f"hold, {version}"] = "%"
            rows[case][f"hold, {version}"] = (round(min(held), 1), round(max(held), 1))
            rows[case][f"largest bias / sigma, {version}"] = round(max(map(abs, bias)), 2)
        rows[case]["new width / old"] = (round(min(ratio), 2), round(max(ratio), 2))
    deviation = 100.0 * (0.05 * 0.95 / after["repeats"]) ** 0.5
    conditions = (
        "the same simulated records by both versions; worst and best coefficient; half widths of the 95 % intervals; "
        f"the binomial standard deviation of a coverage is {deviation:.1f} %"
    )
    command = "python -m benchmarks.intervals compare"
    measured.write("versions", "scenario", rows, units, conditions=conditions, command=command)


def put_down(rows: dict[str, dict[str, measured.Value]]) -> None:
    """Replace the figures of these cases in the table of intervals."""
    every = measured.load("intervals")[1]  # without bounds, those of former runs stay, with their version
    figures = [f for f in every if f["column"] in rows.get(f["scenario"], {})]
    new = {figure["name"]: rows[figure["scenario"]][figure["column"]] for figure in figures}
    measured.record("intervals", new, command="python -m benchmarks.intervals coverage")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=["coverage", "compare"])
    parser.add_argument("files", nargs="*", help="of compare: results of the old and the new version")
    parser.add_argument("--case", action="append", help="only this case; may be given again")
    parser.add_argument("--repeats", type=int)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--write", metavar="FILE")
    chosen = parser.parse_args()
    if chosen.name == "compare":
        compare(*chosen.files)
        return
    warnings.simplefilter("ignore")
    seed, every = plans(chosen.repeats)
    rows, cases = {}, {}
    with ProcessPoolExecutor(chosen.workers) as pool:
        for plan in [plan for plan in every if not chosen.case or plan.name in chosen.case]:
            asked = plan._replace(bounds=0) if chosen.write else plan
            outcomes = list(pool.map(one, repeat(seed), repeat(asked), range(plan.repeats), chunksize=4))
            rows[plan.name], cases[plan.name] = row(outcomes), by_coefficient(outcomes)
            print(plan.name, rows[plan.name], flush=True)
    if chosen.write:
        document = {"version": piga.__version__, "repeats": chosen.repeats, "cases": cases}
        Path(chosen.write).write_text(json.dumps(document), encoding="utf-8")
    if chosen.record:
        put_down(rows)


if __name__ == "__main__":
    main()
