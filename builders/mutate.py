"""Mutation testing of the numerics: ``python builders/mutate.py [--sample N] [--seed S] [--minutes M] [FILE ...]``.

Each mutant is one small change of one source file (an operator, a comparison, a constant, a sign, sine for cosine). The tests
named for that file run on it with the JIT off; a mutant that no test notices has *survived*. mutmut and cosmic-ray rewrite the
installed package and start Python anew for each mutant; here the libraries are loaded once, and every mutant is a forked child that
imports the changed module, which is what makes kernels with seconds of imports affordable. The mutants of a sample are tried
in random order: stopped after ``--minutes``, those that were tried are a random sample, too.
"""

from __future__ import annotations

import argparse
import ast
import copy
import importlib
import importlib.abc
import importlib.util
import json
import os
import random
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

os.environ["NUMBA_DISABLE_JIT"] = "1"
ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "piga"
MOTION = [
    "tests/kernels/test_motion_kernels.py",
    "tests/instrument/test_closed_form.py",
    "tests/instrument/test_borders.py",
    "tests/docs/test_equations.py",
]
SAMPLES = [
    *MOTION,
    "tests/instrument/test_sensitivity.py",
    "tests/instrument/test_step_sizes.py",
    "tests/instrument/test_short_records.py",
    "tests/instrument/test_propagate.py",
    "tests/instrument/test_input_forms.py",
]
FIT = [
    "tests/calibration/test_kernels.py",
    "tests/calibration/test_reduction.py",
    "tests/docs/test_equations.py",
    "tests/calibration/test_interpreted.py",
]
GROUND = ["tests/foundations"]
TESTS = {
    "_kernels/motion.py": SAMPLES,
    "_kernels/motion_blocks.py": SAMPLES,
    "_kernels/motion_increments.py": SAMPLES,
    "_kernels/motion_samples.py": [*SAMPLES, "tests/instrument/test_fleet.py"],
    "_kernels/motion_sensitivity.py": SAMPLES,
    "_kernels/transfer.py": SAMPLES,
    "instrument/constant_motion.py": MOTION,
    "_kernels/regressors.py": FIT,
    "_kernels/square_root.py": FIT,
    "frames.py": GROUND,
    "earth.py": GROUND,
    "units.py": [
        "tests/foundations/test_unit_table.py",
        "tests/records/test_units.py",
        "tests/instrument/test_parameters.py",
    ],
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


def mutants(file: str) -> list[Mutant]:
    """All mutants of a file."""
    text = (SOURCE / file).read_text(encoding="utf-8")
    found = []
    for index in range(len(list(places(ast.parse(text))))):
        tree = ast.parse(text)
        node = list(places(tree))[index][0]
        original = copy.deepcopy(node)
        found.append(
            Mutant(
                file,
                getattr(original, "lineno", 0),
                changed(node),
                ast.unparse(ast.fix_missing_locations(tree)),
            )
        )
    return found


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


def run_tests(mutant: Mutant | None, tests: list[str], limit: float) -> tuple[int, float]:
    """Exit code of the tests in a forked child, and seconds; 99 when it took longer than ``limit``."""
    start = time.monotonic()
    child = os.fork()
    if child == 0:
        silent = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silent, 1)
        os.dup2(silent, 2)
        if mutant is not None:
            sys.meta_path.insert(0, Changed(mutant))
        import pytest  # noqa: PLC0415 - in the child: it reads the changed package

        options = [
            "-x",
            "-q",
            "-W",
            "ignore::pytest.PytestAssertRewriteWarning",
            "-p",
            "no:cacheprovider",
            "-p",
            "no:xdist",
            "-m",
            "not slow and not only_compiled",
        ]
        os._exit(int(pytest.main([*options, *tests])))
    while time.monotonic() - start < limit:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status), time.monotonic() - start
        time.sleep(0.02)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return 99, limit


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
    pool = [mutant for found in chosen.values() for mutant in found]
    random.Random(arguments.seed).shuffle(pool)
    pool = pool[: arguments.sample or len(pool)]
    limits: dict[tuple[str, ...], float] = {}
    for tests in {tuple(TESTS[file]) for file in chosen}:
        code, seconds = run_tests(None, list(tests), 1200.0)
        assert code == 0, f"{', '.join(tests)}: fail without any change (exit code {code})"
        limits[tests] = 4.0 * seconds + 20.0
    score = {file: [0, 0, len(found)] for file, found in chosen.items()}
    survivors, begun = [], time.monotonic()
    for number, mutant in enumerate(pool, 1):
        if time.monotonic() - begun > 60.0 * arguments.minutes:
            break
        tests = tuple(TESTS[mutant.file])
        code, _ = run_tests(mutant, list(tests), limits[tests])
        score[mutant.file][1] += 1
        score[mutant.file][0] += code != 0
        if code == 0:
            survivors.append({"file": mutant.file, "line": mutant.line, "change": mutant.change})
            print(f"survived {number}/{len(pool)}: {mutant.file}:{mutant.line}: {mutant.change}", flush=True)
    for file, (killed, tried, total) in score.items():
        print(f"{file:34} {killed:4} of {tried:4} noticed ({total} mutants in all)")
    killed, tried = (sum(counts[k] for counts in score.values()) for k in (0, 1))
    low, high = interval(killed, tried)
    print(f"{killed} of {tried} noticed, {killed / tried:.1%} (95 % interval {low:.1%} to {high:.1%})")
    if arguments.out:
        arguments.out.write_text(json.dumps({"score": score, "survivors": survivors}, indent=1))


if __name__ == "__main__":
    main()
