"""How often do remarks on model and data come without a cause, and how often do they find one?

Run as ``python -m tests.calibration.made.alarms --sound 1000 --faulty 100 --processes 2``: Markdown on the screen.
Scenarios are those of the coverage, and one that shows all axes and terms.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np

import piga
from piga.errors import PigaError
from tests.calibration.made.scenarios import EVERYWHERE, SCENARIOS, with_term

SHOWN = SCENARIOS | {"everywhere": EVERYWHERE}
SOUND = ("static", "centrifuge", "everywhere")
ADDED = {
    "k2": 1e-4, "k3": 1e-4, "k2o": 1e-4, "m_Y": 1e-4, "m_Z": 1e-4, "k_XY": 1e-4, "k_XZ": 1e-4, "k_YY": 1e-4,
    "k_ZZ": -1e-4, "k_YZ": 1e-4, "k0_t": 1e-7, "s1": 2e-4, "c2": 2e-4,
}  # fmt: skip
"""Terms added to the records of ``everywhere`` (file units), the model without them."""
OMITTED = {
    "static": ("tan_beta", "k0", "k2", "m_Y"),
    "centrifuge": ("tan_beta", "k0", "k2", "k3"),
    "everywhere": ("tan_beta", "k0"),
}
"""Terms of a scenario's truth that are left out of its model in turn."""


def _columns(order: list[int], run: piga.Run) -> piga.Run:
    return replace(run, f=np.ascontiguousarray(run.f[:, order]))


def _reference(factor: float | tuple[int, int, int], run: piga.Run) -> piga.Run:
    return replace(run, f=run.f * np.array(factor, dtype=float))


def _output(factor: float, run: piga.Run) -> piga.Run:
    return replace(run, output=run.output * factor)


FAULTS: dict[str, tuple[Callable[[piga.Run], piga.Run], str]] = {
    "X0 and Y0 swapped": (partial(_columns, [1, 0, 2]), "X0 and Y0 swapped"),
    "X0 and Z0 swapped": (partial(_columns, [2, 1, 0]), "X0 and Z0 swapped"),
    "Y0 and Z0 swapped": (partial(_columns, [0, 2, 1]), "Y0 and Z0 swapped"),
    "X0 negative": (partial(_reference, (-1, 1, 1)), "X0 of the reference"),
    "Y0 negative": (partial(_reference, (1, -1, 1)), "Y0 negative"),
    "output negative": (partial(_output, -1.0), "the output"),
    "g said to be m/s²": (partial(_reference, 1 / 9.80665), "f (wanted in m/s^2) multiplied by 9.80665"),
    "mg said to be g": (partial(_reference, 1e3), "f (wanted in m/s^2) divided by 1000"),
    "degrees said to be rad": (partial(_output, 180 / np.pi), "output unit = 'deg' where it says 'rad'"),
    "rad said to be degrees": (partial(_output, np.pi / 180), "output unit = 'rad' where it says 'deg'"),
}
"""What is done to a record, and words that name it."""


def outcome(run: piga.Run, terms: tuple[str, ...], words: str = "", term: str = "") -> str:
    """ "named" if the remarks hold the words or suggest the term; else the kind of the first remark."""
    try:
        calibration = piga.calibrate(run, terms)
    except PigaError as error:
        text = str(error)
        return "named" if words and words in text else "advice" if "not applied" in text else "none"
    advice, missing = calibration.diagnostics.advice, calibration.diagnostics.missing_terms
    moved = [note for note in calibration.notes if "without segment" in note]
    suggested = [name for entry in missing[:1] for name in (*entry.terms, *", ".join(entry.alike).split(", "))]
    if (words and words in " | ".join(advice or moved)) or (term and term in suggested):
        return "named"
    return "advice" if advice else "term" if missing else "segment" if moved else "none"


def sound(name: str, seed: int) -> str:
    """Kind of remark on a sound record."""
    scenario = SHOWN[name]
    return outcome(scenario.record(np.random.default_rng([seed, 11])), scenario.terms)


def omitted(name: str, term: str, seed: int) -> str:
    """Of a record whose truth has a term that is not in the model."""
    scenario = SHOWN[name]
    run = scenario.record(np.random.default_rng([seed, 12]))
    if name == "everywhere" and term in ADDED:
        return outcome(with_term(run, term, ADDED[term]), scenario.terms, term=term)
    return outcome(run, tuple(t for t in scenario.terms if t != term), term=term)


def faulty(name: str, fault: str, seed: int) -> str:
    """Of a record whose data are read wrongly."""
    scenario = SHOWN[name]
    change, words = FAULTS[fault]
    return outcome(change(scenario.record(np.random.default_rng([seed, 13]))), scenario.terms, words)


def count_all(
    jobs: list[tuple[Callable[..., str], tuple[str, ...]]], tests: int, processes: int = 1
) -> list[Counter[str]]:
    """Kinds of remarks of every job, ``tests`` records each."""
    if processes == 1:
        return [Counter(function(*words, seed) for seed in range(tests)) for function, words in jobs]
    with ProcessPoolExecutor(processes) as pool:
        return [
            Counter(pool.map(partial(function, *words), range(tests), chunksize=5)) for function, words in jobs
        ]


OMISSIONS = [
    *((name, term) for name, terms in OMITTED.items() for term in terms),
    *(("everywhere", term) for term in ADDED),
]
"""Scenarios, and the terms that are left out of their models."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sound", type=int, default=1000)
    parser.add_argument("--faulty", type=int, default=100)
    parser.add_argument("--processes", type=int, default=2)
    chosen = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    kinds = ("named", "advice", "term", "segment", "none")
    for jobs, tests in (
        ([(sound, (name,)) for name in SOUND], chosen.sound),
        ([(omitted, pair) for pair in OMISSIONS], chosen.faulty),
        ([(faulty, (name, fault)) for name in SOUND for fault in FAULTS], chosen.faulty),
    ):
        sys.stdout.write(f"| record | tests | {' | '.join(kinds)} |\n|---|---|---|---|---|---|---|\n")
        for (_, arguments), counted in zip(jobs, count_all(jobs, tests, chosen.processes), strict=True):
            figures = " | ".join(f"{100 * counted[kind] / tests:.1f} %" for kind in kinds)
            sys.stdout.write(f"| {', '.join(arguments)} | {tests} | {figures} |\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
