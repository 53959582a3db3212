"""Print the measures of the house: lines, files, imports, names, and the walk of one calibration.

``python builders/house.py`` (with ``PYTHONPATH=src`` for the sources of a checkout). The walk counts the files and
functions of piga that one ``piga.calibrate(run)`` of the shipped record enters. Modules are loaded before.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path
from types import CodeType, FrameType

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "piga"


def python_files(folder: Path) -> list[Path]:
    """All Python files below a folder."""
    return sorted(folder.rglob("*.py"))


def lines(folder: Path) -> int:
    """Physical lines of all Python files below a folder."""
    return sum(path.read_text("utf-8").count("\n") for path in python_files(folder))


def own_imports(tree: ast.Module) -> int:
    """Modules of piga that a module imports."""
    from_names = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
    return sum(name.split(".")[0] == "piga" for name in from_names)


def public_names(tree: ast.Module) -> int:
    """Public functions and classes at the level of a module."""
    kinds = (ast.FunctionDef, ast.ClassDef)
    return sum(isinstance(node, kinds) and not node.name.startswith("_") for node in tree.body)


def walk() -> tuple[int, int]:
    """Files and functions of piga that one calibration of the shipped record enters."""
    import piga

    entered: set[CodeType] = set()

    def enter(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and "piga" in frame.f_code.co_filename and not frame.f_code.co_name.startswith("<"):
            entered.add(frame.f_code)

    run = piga.example_run()
    piga.calibrate(run)
    sys.setprofile(enter)
    piga.calibrate(run)
    sys.setprofile(None)
    place = str(Path(piga.__file__).parent)
    inside = [code for code in entered if code.co_filename.startswith(place)]
    return len({code.co_filename for code in inside}), len(inside)


def main() -> None:
    """Print the table."""
    files = python_files(SOURCE)
    trees = [ast.parse(path.read_text("utf-8")) for path in files]
    filled = [tree for tree in trees if own_imports(tree)]
    rows = [
        ("lines of src/piga", lines(SOURCE), 44_000),
        ("files of src/piga", len(files), 180),
        ("builders + benchmarks", lines(ROOT / "builders") + lines(ROOT / "benchmarks"), 2_300),
        ("lines of tests", lines(ROOT / "tests"), 30_000),
        ("imports of own modules per file", round(sum(map(own_imports, trees)) / len(filled), 1), 4.0),
        ("public names of modules", sum(map(public_names, trees)), 900),
        ("files, functions walked by calibrate", walk(), (22, 200)),
    ]
    for name, value, goal in rows:
        print(f"| {name} | {value} | {goal} |")


if __name__ == "__main__":
    main()
