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


def by_coefficient(outcomes: list[Outcome]) -> dict[str, dict[str, float]]:
    """Share of intervals that hold, median half width, and mean error over its standard deviation, of each coefficient."""
    low, high, truth, error = (
        np.array([getattr(one, key) for one in outcomes]) for key in ("low", "high", "truth", "error")
    )
    held = 100.0 * ((low <= truth) & (truth <= high)).mean(axis=0)
    width, bias = np.median(0.5 * (high - low), axis=0), error.mean(axis=0) / error.std(axis=0, ddof=1)
    columns = zip(outcomes[0].names, held.tolist(), width.tolist(), bias.tolist(), strict=True)
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
    parser.add_argument("name", choices=[*TABLES, "compare"])
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
    seed, every = plans(chosen.name, chosen.repeats)
    if chosen.write:
        every = [plan._replace(bounds=0) for plan in every]
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
            if chosen.write:
                cases = {case: by_coefficient(outcomes) for case, (_, outcomes) in rows.items()}
                document = {"version": piga.__version__, "repeats": chosen.repeats, "cases": cases}
                Path(chosen.write).write_text(json.dumps(document), encoding="utf-8")
    if chosen.record:
        put_down(chosen.name, rows)


if __name__ == "__main__":
    main()
