"""Do the intervals hold? Many simulated tests of one scenario, and the figures that say so.

Run as ``python -m tests.calibration.coverage --scenario static --tests 10000 --processes 2 --out FILE``:
one JSON object per scenario, and a line of Markdown on the screen. ``--record`` puts the figures into
``docs/measured/intervals.json``.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks import measured
from scipy.stats import binom, chi2

from tests.calibration.scenarios import FAINT, SCENARIOS, Array

CASES = SCENARIOS | FAINT

HEAD = (
    "| scenario | tests | coverage | bias/sigma | variance/bound | NEES (expected) |\n|---|---|---|---|---|---|"
)

BOUNDS = 200
"""Records over which the Cramer-Rao bound is averaged: the gimbal starts anywhere."""


Found = tuple[Array, Array, Array, Array]


def one_test(name: str, seed: int) -> tuple[Array, Array, float, float]:
    """Errors (file units), half-widths of the 95 % intervals, NEES of one simulated test, and what is expected of that.

    Errors over standard uncertainties of nu degrees of freedom are Student's: their mean square is nu/(nu - 2).
    """
    scenario = CASES[name]
    found = scenario.calibrate(scenario.record(np.random.default_rng([seed, 2026])))
    errors = scenario.errors(found)
    half = np.array([c.expanded for c in found.coefficients])
    degrees = np.array([c.degrees_of_freedom or np.inf for c in found.coefficients])
    squares = 1.0 / (1.0 - 2.0 / np.maximum(degrees, 3.0))
    return errors, half, float(errors @ np.linalg.solve(found.covariance, errors)), float(squares.mean())


def _part(name: str, seeds: range) -> Found:
    rows = [one_test(name, seed) for seed in seeds]
    return (
        np.array([row[0] for row in rows]),
        np.array([row[1] for row in rows]),
        np.array([row[2] for row in rows]),
        np.array([row[3] for row in rows]),
    )


def run_tests(name: str, tests: int, processes: int = 1, first: int = 0) -> Found:
    """Errors (tests, terms), half-widths (tests, terms), NEES (tests,) and its expectation of many tests."""
    if processes == 1:
        return _part(name, range(first, first + tests))
    size = max(1, min(100, tests // (2 * processes)))
    parts = [range(first + at, first + min(at + size, tests)) for at in range(0, tests, size)]
    with ProcessPoolExecutor(processes) as pool:
        found = list(pool.map(_part, [name] * len(parts), parts))
    return tuple(np.concatenate([part[i] for part in found]) for i in range(4))  # type: ignore[return-value]


def figures(name: str, errors: Array, half: Array, nees: Array, expected: Array) -> dict[str, Any]:
    """Coverage, bias, variance over the Cramer-Rao bound and NEES per coefficient, with their bands."""
    scenario = CASES[name]
    tests, size = errors.shape
    records = (scenario.record(np.random.default_rng([seed, 1])) for seed in range(BOUNDS))
    bound = np.sqrt(np.mean([np.diag(scenario.bound(run)) for run in records], axis=0))
    inside = (np.abs(errors) <= half).mean(axis=0)
    spread = errors.std(axis=0, ddof=1)
    band = chi2.ppf([0.0005, 0.9995], tests * size) / (tests * size)
    return {
        "scenario": name,
        "tests": tests,
        "coefficients": list(scenario.names),
        "coverage": inside.tolist(),
        "coverage_band": (binom.ppf([0.0005, 0.9995], tests, 0.95) / tests).tolist(),
        "bias_over_sigma": (errors.mean(axis=0) / spread).tolist(),
        "variance_over_bound": (spread**2 / bound**2).tolist(),
        "mean_half_width_over_sigma": (half.mean(axis=0) / spread).tolist(),
        "nees": float(nees.mean() / size),
        "nees_expected": float(expected.mean()),
        "nees_band": band.tolist(),
    }


def line(found: dict[str, Any]) -> str:
    """A row of a Markdown table: scenario, tests, coverage, bias, variance over bound, NEES."""
    cover, bias, ratio = (np.array(found[k]) for k in ("coverage", "bias_over_sigma", "variance_over_bound"))
    return (
        f"| {found['scenario']} | {found['tests']} | {100 * cover.min():.1f} to {100 * cover.max():.1f} % | "
        f"{np.abs(bias).max():.3f} | {ratio.min():.2f} to {ratio.max():.2f} | {found['nees']:.3f} "
        f"({found['nees_expected']:.3f}) |"
    )


def record(results: list[dict[str, Any]]) -> None:
    """Put the figures into the table of the documentation; a scenario without a row there has none to put."""
    rows = {figure["scenario"]: figure["row"] for figure in measured.load("intervals")[1]}
    for found in results:
        row = rows.get(found["scenario"])
        if row is None:
            sys.stdout.write(f"{found['scenario']} has no row in docs/measured/intervals.json\n")
            continue
        cover, ratio = 100.0 * np.array(found["coverage"]), np.array(found["variance_over_bound"])
        values = {
            "tests": found["tests"],
            "coverage": (round(cover.min(), 1), round(cover.max(), 1)),
            "largest bias / sigma": round(float(np.abs(found["bias_over_sigma"]).max()), 3),
            "variance / bound": (round(ratio.min(), 2), round(ratio.max(), 2)),
            "NEES": round(found["nees"], 3),
            "NEES expected": round(found["nees_expected"], 3),
        }
        known = {figure["name"] for figure in measured.load("intervals")[1]}
        new = {f"{row}: {column}": value for column, value in values.items() if f"{row}: {column}" in known}
        command = (
            f"python -m tests.calibration.coverage --scenario {found['scenario']} --tests {found['tests']}"
        )
        measured.record("intervals", new, command=command)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", default="all", help=f"all or one of: {', '.join(CASES)}")
    parser.add_argument("--tests", type=int, default=1000)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=None, help="JSON file, one object per scenario")
    parser.add_argument(
        "--record", action="store_true", help="put the figures into docs/measured/intervals.json"
    )
    chosen = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    results = []
    sys.stdout.write(f"{HEAD}\n")
    for name in CASES if chosen.scenario == "all" else chosen.scenario.split(","):
        began = time.perf_counter()
        found = figures(name, *run_tests(name, chosen.tests, chosen.processes))
        results.append(found | {"seconds": round(time.perf_counter() - began, 1)})
        sys.stdout.write(f"{line(found)}\n")
        sys.stdout.flush()
    if chosen.record:
        record(results)
    if chosen.out is not None:
        chosen.out.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
