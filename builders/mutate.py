"""Mutation testing of the numerics: ``python builders/mutate.py [--sample N] [--seed S] [--minutes M] [FILE ...]``.

Each mutant is one small change of one source file (an operator, a comparison, a constant, a sign, sine for cosine). The tests
named for that file run on it, kernels with the JIT off and everything else with compiled kernels; a mutant that no test notices has
*survived*. mutmut and cosmic-ray rewrite the
installed package and start Python anew for each mutant; here the libraries are loaded once, and every mutant is a forked child that
imports the changed module, which is what makes kernels with seconds of imports affordable. The mutants of a sample are tried
in random order: stopped after ``--minutes``, those that were tried are a random sample, too.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import importlib.abc
import importlib.util
import itertools
import json
import math
import os
import random
import resource
import signal
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

NO_TESTS = 5
"""Exit code of pytest when none of the tests is to run in this mode."""
ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "piga"


def tests_of(room: str, *names: str) -> list[str]:
    """Paths of test files of a room or of a room inside it."""
    paths = {path.name: path for path in (ROOT / "tests" / room).rglob("test_*.py")}
    return [str(paths[f"test_{name}.py"].relative_to(ROOT)) for name in names]


EQUATIONS = ["tests/docs/test_equations.py"]
MOTION = [
    *tests_of("_kernels", "step", "arithmetic"),
    *tests_of("instrument", "closed_form", "motion_input_forms"),
    *EQUATIONS,
]
SAMPLES = [
    *MOTION,
    *tests_of("instrument", "sampled_motion_sensitivities", "motion_input_forms", "sampled_motion"),
]
ANALYSIS = [*tests_of("instrument", "regimes", "closed_form", "motion_input_forms"), *EQUATIONS]
TWIN = tests_of("instrument", "linear", "twin")
SUMS = [
    *tests_of("_kernels", "regressors", "noise"),
    *tests_of("calibration", "reduction", "levels", "residuals"),
    *EQUATIONS,
    *tests_of("calibration", "calibrate"),
]
FIT = tests_of(
    "calibration",
    "solution",
    "identifiability",
    "request",
    "recursive",
    "residuals",
    "levels",
    "calibrate",
    "model_choice",
)
JOINT = tests_of("calibration", "joint_small_records", "joint")
UNCERTAINTY = tests_of("calibration", "monte_carlo", "uncertainty", "calibrate", "joint_small_records")
COUNTED = tests_of("calibration", "stretches", "uncertainty", "calibrate_shipped_record")
PLANS = tests_of("planning", "planning", "plan_closed_forms", "plan")
TREND = tests_of("trend", "trend_line", "history")
CHOICE = tests_of("calibration", "model_choice")
REVOLUTIONS = [*tests_of("calibration", "revolutions"), *JOINT]
SIGNATURES = tests_of("calibration", "missing_terms", "all_remarks")
COMPENSATED = [
    *tests_of("compensation", "compensator", "set_compensator"),
    *tests_of("_kernels", "indication"),
    *tests_of("compensation", "compensator_stream", "compensation_refusals", "live"),
]
SETS = tests_of("compensation", "set_compensator", "file_to_file_columns")
PHASES = tests_of("compensation", "phase", "result")
GEOMETRY = tests_of("platform", "geometry", "simulate")
PLATFORM = [*GEOMETRY, *tests_of("platform", "scenario", "navigator")]
ERRORS = tests_of("platform", "budget", "navigator", "navigator_models")
IDENTIFIED = tests_of("platform", "identify", "alignment", "identify_intervals")
TRIADS = tests_of("platform", "chain", "simulate")
CALIBRATION = {
    "calibration/remarks/advice": tests_of("calibration", "advice"),
    "calibration/allan": tests_of("calibration", "allan", "weighting_drift"),
    "calibration/calibrate calibration/model/design "
    "calibration/fit/one_run calibration/noise/levels calibration/fit/residuals "
    "calibration/model/solution calibration/noise/weighting "
    "calibration/model/identifiability": FIT,
    "calibration/budget/uncertainty calibration/intervals/degrees_of_freedom "
    "calibration/budget/monte_carlo": UNCERTAINTY,
    "calibration/remarks/missing_terms calibration/remarks/all_remarks": SIGNATURES,
    "planning/candidates planning/criterion planning/mounting planning/plan planning/plan_file": PLANS,
    "calibration/fit/cleaning calibration/fit/outliers": tests_of("calibration", "cleaning", "outliers"),
    "trend/history trend/trend_line": TREND,
    "calibration/noise/counted calibration/noise/stretches": COUNTED,
    "calibration/choice/cross_validation calibration/choice/model_choice": CHOICE,
    "calibration/intervals/added_noise": tests_of("calibration", "added_noise", "added_noise_faint_walk"),
    "calibration/fit/servo": tests_of("calibration", "servo"),
    "calibration/remarks/left_out": tests_of("calibration", "servo", "left_out_runs"),
    "calibration/intervals/slow_noise": tests_of(
        "calibration", "slow_noise", "weighting_drift", "weighting_scatter"
    ),
    "calibration/joint/joint_fit calibration/joint/joint_result calibration/joint/summary": JOINT,
    "calibration/remarks/leverage": [
        *tests_of("calibration", "leverage"),
        *SIGNATURES,
    ],
    "calibration/classical/recursive calibration/model/request": FIT,
    "calibration/model/reduction": [*tests_of("calibration", "reduction"), *FIT],
    "calibration/classical/revolutions": REVOLUTIONS,
}
INSTRUMENT = {
    "instrument/motion/closed_form instrument/regimes": [*MOTION, *ANALYSIS],
    "instrument/twin/electronics": tests_of("instrument", "electronics"),
    "instrument/motion/function_input instrument/motion/sampled_motion": SAMPLES,
    "instrument/twin/run instrument/twin/linear instrument/twin/parameters": TWIN,
}
COMPENSATION = {
    "compensation/compensator compensation/model": COMPENSATED,
    "compensation/phase compensation/result": [
        *PHASES,
        *COMPENSATED,
        *tests_of("compensation", "file_to_file"),
    ],
    "compensation/sets/set_compensator compensation/sets/set_files": SETS,
}
PLATFORM_ROOM = {
    "platform/alignment platform/estimate platform/observation": IDENTIFIED,
    "platform/identify": [*IDENTIFIED, *ERRORS, *PLATFORM],
    "platform/analysis platform/budget": ERRORS,
    "platform/navigator": [*PLATFORM, *ERRORS],
    "platform/geometry": [*PLATFORM, *IDENTIFIED],
    "platform/scenario": PLATFORM,
    "platform/simulate": [*PLATFORM, *TRIADS],
    "platform/chain": [*TRIADS, *ERRORS],
    "platform/output": TRIADS,
}
KERNELS = {
    "_kernels/compensation/indication _kernels/compensation/layout _kernels/compensation/record "
    "_kernels/compensation/terms": [*COMPENSATED, *SETS],
    "_kernels/compensation/set": SETS,
    "_kernels/estimation/noise": [*COUNTED, *SUMS],
    "_kernels/arithmetic": [*SUMS, *PHASES, *tests_of("compensation", "file_to_file")],
    "_kernels/estimation/regressors": SUMS,
    "_kernels/estimation/sequential": [*SUMS, *FIT],
    "_kernels/motion/function_motion": SAMPLES,
    "_kernels/motion/step": SAMPLES,
    "_kernels/motion/samples": SAMPLES,
    "_kernels/estimation/outliers": [
        *tests_of("_kernels", "outliers"),
        *tests_of("calibration", "outliers"),
    ],
    "_kernels/platform/navigation": [*PLATFORM, *ERRORS],
    "_kernels/platform/motion": [*GEOMETRY, *EQUATIONS, *TRIADS],
    "_kernels/motion/servo": TWIN,
    "_kernels/estimation/trend": TREND,
}
TESTS = {
    f"{name}.py": tests
    for table in (CALIBRATION, INSTRUMENT, COMPENSATION, PLATFORM_ROOM, KERNELS)
    for names, tests in table.items()
    for name in names.split()
} | {
    "frames.py": ["tests/test_frames.py"],
    "earth.py": ["tests/test_earth.py"],
    "units.py": ["tests/test_units.py", "tests/instrument/test_parameters.py"],
}
"""Tests that have to notice a change of a file, the quickest first."""

OPERATORS: dict[type, type] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult,
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.And: ast.Or, ast.Or: ast.And, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
NAMES = {
    "sin": "cos",
    "cos": "sin",
    "sinh": "cosh",
    "cosh": "sinh",
    "max": "min",
    "min": "max",
    "rint": "floor",
}


@dataclass(frozen=True)
class Mutant:
    """A changed source: ``file`` within the package, ``line`` and ``change`` in words, the new ``text``."""

    file: str
    line: int
    change: str
    text: str


def places(tree: ast.Module) -> Iterator[tuple[ast.AST, int]]:
    """Nodes that can be changed, and how many ways; annotations, decorators and messages are passed over."""
    stack: list[ast.AST] = list(tree.body)
    while stack:
        node = stack.pop()
        if isinstance(node, ast.Import | ast.ImportFrom | ast.Raise | ast.JoinedStr):
            continue
        if ways(node):
            yield node, ways(node)
        skipped = {"annotation", "returns", "decorator_list", "type_comment"}
        for name, value in ast.iter_fields(node):
            if name in skipped:
                continue
            children = value if isinstance(value, list) else [value]
            stack += [child for child in children if isinstance(child, ast.AST)]


def ways(node: ast.AST) -> int:
    """How many changes of a node there are."""
    if isinstance(node, ast.BinOp | ast.AugAssign):
        return int(type(node.op) in OPERATORS)
    if isinstance(node, ast.BoolOp):
        return 1
    if isinstance(node, ast.Compare):
        return int(type(node.ops[0]) in OPERATORS)
    if isinstance(node, ast.UnaryOp):
        return int(isinstance(node.op, ast.USub | ast.Not))
    if isinstance(node, ast.Constant):
        return int(isinstance(node.value, int | float))
    return int(isinstance(node, ast.Attribute) and node.attr in NAMES)


def changed(node: ast.AST) -> str:
    """Change the node in place; returns the change in words."""
    before = ast.unparse(node)
    if isinstance(node, ast.BinOp | ast.AugAssign | ast.BoolOp):
        node.op = OPERATORS[type(node.op)]()
    elif isinstance(node, ast.Compare):
        node.ops[0] = OPERATORS[type(node.ops[0])]()
    elif isinstance(node, ast.UnaryOp):
        node.op = ast.UAdd() if isinstance(node.op, ast.USub) else ast.USub()
    elif isinstance(node, ast.Constant):
        value = node.value
        node.value = (
            (not value)
            if isinstance(value, bool)
            else value + 1
            if isinstance(value, int)
            else value * 1.001 + (value == 0)
        )
    elif isinstance(node, ast.Attribute):
        node.attr = NAMES[node.attr]
    return f"{before} -> {ast.unparse(node)}"


def mutants(file: str) -> int:
    """How many mutants of a file there are."""
    return sum(1 for _ in places(ast.parse((SOURCE / file).read_text(encoding="utf-8"))))


def make_mutant(file: str, index: int) -> Mutant:
    """The ``index``-th mutant of a file."""
    tree = ast.parse((SOURCE / file).read_text(encoding="utf-8"))
    node = next(itertools.islice(places(tree), index, None))[0]
    line, change = getattr(node, "lineno", 0), changed(node)
    return Mutant(file, line, change, ast.unparse(ast.fix_missing_locations(tree)))


class Changed(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Gives the changed text when its module is imported."""

    def __init__(self, mutant: Mutant) -> None:
        self.name = "piga." + mutant.file.removesuffix(".py").replace("/", ".")
        self.path, self.text = str(SOURCE / mutant.file), mutant.text

    def find_spec(self, name: str, _path: object, _target: object = None) -> object:
        return (
            importlib.util.spec_from_file_location(name, self.path, loader=self) if name == self.name else None
        )

    def create_module(self, _spec: object) -> None:
        return None

    def exec_module(self, module: object) -> None:
        exec(compile(self.text, self.path, "exec"), module.__dict__)


def run_tests(mutant: Mutant | None, tests: list[str], interpreted: bool, limit: float) -> tuple[int, float]:
    """Exit code of the tests in a forked child, and its processor time [s]; that is limited, so that no loop is endless.

    A child that is stopped by the limit, or that waits for thirty times as long, has a negative exit code.
    """
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(limit), math.ceil(limit) + 5))
        silent = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silent, 1)
        os.dup2(silent, 2)
        if interpreted:
            os.environ["NUMBA_DISABLE_JIT"] = "1"
            sys.modules["numba"].config.DISABLE_JIT = 1
        if mutant is not None:
            sys.meta_path.insert(0, Changed(mutant))
        import pytest  # noqa: PLC0415 - in the child: it reads the changed package

        marks = "not slow and not only_compiled" if interpreted else "not slow"
        plugins = ["-p", "no:cacheprovider", "-p", "no:xdist"]
        ignored = ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
        os._exit(int(pytest.main(["-x", "-q", *ignored, *plugins, "-m", marks, *tests])))
    late = threading.Timer(30.0 * limit, os.kill, (child, signal.SIGKILL))
    late.start()
    _, status, used = os.wait4(child, 0)
    late.cancel()
    return os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime


def is_interpreted(file: str) -> bool:
    """Kernels run with the JIT off: a compiled one would come from the cache, without the change."""
    return file.startswith("_kernels/")


@cache
def undisturbed(test: str, interpreted: bool) -> float:
    """Processor time [s] that a file of tests takes on the package as it is."""
    code, seconds = run_tests(None, [test], interpreted, 1200.0)
    if code not in (0, NO_TESTS):
        sys.exit(f"{test} fails without any change (exit code {code})")
    return seconds


def interval(killed: int, tried: int) -> tuple[float, float]:
    """95 % interval of a binomial share (Wilson 1927)."""
    z2 = 1.959964**2
    middle = (killed + 0.5 * z2) / (tried + z2)
    half = (z2 * (killed * (tried - killed) / tried + 0.25 * z2)) ** 0.5 / (tried + z2)
    return middle - half, middle + half


def main() -> None:
    """Run a sample of mutants, list the survivors, print the score of each file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", help="files within src/piga; all targets when none are named")
    parser.add_argument("--sample", type=int, default=300, help="mutants over all files; 0: every one")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--skip", type=int, default=0, help="go on behind so many of the sample")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after so long")
    parser.add_argument("--out", type=Path, help="JSON file for the result")
    arguments = parser.parse_args()
    os.chdir(ROOT)
    sys.path[:0] = [str(ROOT), str(ROOT / "src")]
    for name in (
        "hypothesis",
        "mpmath",
        "numba",
        "pytest",
        "scipy.integrate",
        "scipy.linalg",
        "scipy.optimize",
    ):
        importlib.import_module(name)  # once, for all children

    chosen = {file: mutants(file) for file in arguments.files or TESTS}
    pool = [(file, index) for file, number in chosen.items() for index in range(number)]
    random.Random(arguments.seed).shuffle(pool)
    pool = pool[: arguments.sample or len(pool)]
    score = {file: [0, 0, number] for file, number in chosen.items()}
    survivors, begun = [], time.monotonic()
    for number, (file, index) in enumerate(pool[arguments.skip :], arguments.skip + 1):
        if time.monotonic() - begun > 60.0 * arguments.minutes:
            break
        mutant = make_mutant(file, index)
        tests, interpreted = TESTS[file], is_interpreted(file)
        limit = 20.0 + 4.0 * sum(undisturbed(test, interpreted) for test in tests)
        code, _ = run_tests(mutant, tests, interpreted, limit)
        score[file][1] += 1
        score[file][0] += code != 0
        if code == 0:
            survivors.append({"file": mutant.file, "line": mutant.line, "change": mutant.change})
            print(f"survived {number}/{len(pool)}: {mutant.file}:{mutant.line}: {mutant.change}", flush=True)
        elif number % 20 == 0:
            print(f"tried {number}/{len(pool)}", flush=True)
    for file, (killed, tried, total) in score.items():
        if tried:
            print(f"{file:34} {killed:4} of {tried:4} noticed ({total} mutants in all)")
    killed, tried = (sum(counts[k] for counts in score.values()) for k in (0, 1))
    low, high = interval(killed, tried)
    print(f"{killed} of {tried} noticed, {killed / tried:.1%} (95 % interval {low:.1%} to {high:.1%})")
    if arguments.out:
        arguments.out.write_text(json.dumps({"score": score, "survivors": survivors}, indent=1))


if __name__ == "__main__":
    main()
