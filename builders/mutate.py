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


def tests_named(module: str) -> list[str]:
    """Tests named for a module, as ``calibration/fit/servo``, and for its room as a whole; of a file of tests, itself."""
    if module.endswith(".py"):
        return [module]
    room, _, name = module.rpartition("/")
    folder = ROOT / "tests" / room
    modules = {path.stem for path in (SOURCE / room).glob("*.py")} | {folder.name}
    owners: dict[str, list[str]] = {}
    for path in sorted(folder.glob("test_*.py")):
        subject = path.stem.removeprefix("test_")
        owner = max((m for m in modules if f"{subject}_".startswith(f"{m}_")), key=len, default="")
        owners.setdefault(owner, []).append(str(path.relative_to(ROOT)))
    return owners.get(name, []) + owners.get(folder.name, [])


LINEAR = (
    "calibration/model/solution calibration/model/identifiability calibration/model/request calibration/classical/recursive "
    "calibration/fit/residuals calibration/noise/levels calibration/calibrate calibration/choice/model_choice"
)
SUMS = (
    "_kernels/estimation/regressors _kernels/estimation/noise calibration/model/reduction calibration/noise/levels "
    "calibration/fit/residuals tests/docs/test_equations.py calibration/calibrate"
)
MOTION = (
    "_kernels/motion/step _kernels/arithmetic instrument/motion/closed_form tests/docs/test_equations.py "
    "instrument/motion/sampled_motion"
)
COMPENSATED = "compensation/compensator compensation/sets/set_compensator _kernels/compensation/indication compensation/files/live"
PLATFORM = "platform/geometry platform/simulate platform/scenario platform/navigator platform/budget"
IDENTIFIED = "platform/identify platform/alignment"
ALSO = {
    "calibration/allan calibration/intervals/slow_noise": "calibration/noise/weighting",
    "calibration/calibrate calibration/model/design calibration/fit/one_run calibration/noise/levels "
    "calibration/fit/residuals calibration/model/solution calibration/noise/weighting "
    "calibration/model/identifiability calibration/classical/recursive calibration/model/request "
    "calibration/model/reduction": LINEAR,
    "calibration/budget/uncertainty calibration/budget/monte_carlo calibration/intervals/degrees_of_freedom": (
        "calibration/budget/monte_carlo calibration/budget/uncertainty calibration/calibrate calibration/joint/joint"
    ),
    "calibration/remarks/missing_terms calibration/remarks/all_remarks calibration/remarks/leverage": (
        "calibration/remarks/missing_terms calibration/remarks/all_remarks"
    ),
    "calibration/remarks/left_out": "calibration/fit/servo",
    "calibration/fit/cleaning calibration/fit/outliers": "calibration/fit/cleaning calibration/fit/outliers",
    "calibration/noise/counted calibration/noise/stretches": (
        "calibration/noise/stretches calibration/budget/uncertainty calibration/calibrate"
    ),
    "calibration/choice/cross_validation": "calibration/choice/model_choice",
    "calibration/choice/model_choice calibration/fit/servo calibration/intervals/added_noise "
    "calibration/joint/joint_fit calibration/joint/joint_result calibration/joint/summary calibration/remarks/advice": "",
    "calibration/classical/revolutions": "calibration/joint/joint",
    "planning/candidates planning/criterion planning/mounting planning/plan planning/plan_file": "planning/plan",
    "trend/history trend/trend_line _kernels/estimation/trend": "trend/trend_line trend/history",
    "instrument/motion/closed_form instrument/regimes": f"{MOTION} instrument/regimes",
    "instrument/motion/function_input instrument/motion/sampled_motion _kernels/motion/function_motion "
    "_kernels/motion/step _kernels/motion/samples": MOTION,
    "instrument/twin/electronics": "",
    "instrument/twin/run instrument/twin/linear instrument/twin/parameters _kernels/motion/servo": "instrument/twin/linear",
    "compensation/compensator compensation/model": COMPENSATED,
    "compensation/phase compensation/result": (
        f"compensation/phase compensation/result {COMPENSATED} compensation/files/file_to_file"
    ),
    "compensation/sets/set_compensator compensation/sets/set_files _kernels/compensation/set": (
        "compensation/sets/set_compensator tests/compensation/files/test_file_to_file_columns.py"
    ),
    "_kernels/compensation/indication _kernels/compensation/layout _kernels/compensation/record "
    "_kernels/compensation/terms": f"{COMPENSATED} tests/compensation/files/test_file_to_file_columns.py",
    "platform/alignment platform/estimate platform/observation": IDENTIFIED,
    "platform/identify platform/geometry": f"{IDENTIFIED} {PLATFORM}",
    "platform/analysis platform/budget": "platform/budget platform/navigator",
    "platform/navigator platform/scenario _kernels/platform/navigation": PLATFORM,
    "platform/simulate platform/chain": f"platform/chain {PLATFORM}",
    "platform/output": "platform/chain platform/simulate",
    "_kernels/platform/motion": "platform/geometry platform/simulate tests/docs/test_equations.py platform/chain",
    "_kernels/estimation/noise": f"calibration/noise/stretches calibration/budget/uncertainty {SUMS}",
    "_kernels/arithmetic": f"{SUMS} compensation/phase compensation/result compensation/files/file_to_file",
    "_kernels/estimation/regressors": SUMS,
    "_kernels/estimation/sequential": f"{SUMS} {LINEAR}",
    "_kernels/estimation/outliers": "calibration/fit/outliers",
    "frames earth": "",
    "units": "instrument/parameters",
}
"""Files that are changed, and the modules whose tests have to notice it beside those that are named for the file."""
TESTS = {
    f"{file}.py": list(
        dict.fromkeys(test for module in (file, *others.split()) for test in tests_named(module))
    )
    for files, others in ALSO.items()
    for file in files.split()
}
"""Tests that have to notice a change of a file, its own first."""

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
