"""Freeze the numbers of piga, and compare a later state with them.

``python -m builders.freeze write FILE`` runs the commands below with the sources that Python imports. It writes every number of
their JSON documents and output files, with the standard uncertainty where one stands beside it.
``python -m builders.freeze compare FILE`` runs them again. It prints what moved, in units of u where there is one, and which keys
came or went. Exit code 1: something moved by more than ``--tolerance`` of itself. One case: ``--only calibrate``.
"""

from __future__ import annotations

import argparse
import gzip
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pyarrow.compute as pc
import pyarrow.parquet as pq

import piga

ROOT = Path(__file__).resolve().parents[1]
STANDS = ("dividing-head", "centrifuge", "rate-table", "vibration-table")
HISTORY = (1, 2, 3, 4)
EXAMPLE_OF_PLATFORM = "examples/platform-*.toml"
CASES: dict[str, list[str]] = {
    "check": ["check tumble-a.toml --terms"],
    "calibrate": ["calibrate tumble-a.toml --no-report --out c"],
    "calibrate-servo": [
        "calibrate tumble-a.toml --no-report --out c --terms scale_factor,tan_beta,k0,m_Y,servo,servo_damping"
    ],
    "calibrate-per-segment": [
        "calibrate tumble-a.toml --no-report --out c --phases per-segment --terms scale_factor,tan_beta,k0,m_Y"
    ],
    "compensate": [
        "calibrate tumble-a.toml --no-report --out c",
        "compensate tumble-a.toml --calibration c/calibration.json --out out.parquet",
    ],
    **{
        name: [
            f"simulate examples/{name}.toml --out s",
            "calibrate s/run.toml --no-report --out c",
            "compensate s/run.toml --calibration c/calibration.json --out out.parquet",
        ]
        for name in STANDS
    },
    "twin": ["simulate examples/twin.toml --out s", "calibrate s/run.toml --no-report --out c"],
    "joint": [
        "simulate examples/joint-dividing-head.toml --out a",
        "simulate examples/joint-centrifuge.toml --out b",
        "calibrate a/run.toml b/run.toml --no-report --out c",
    ],
    "trend": [
        *(
            f"simulate examples/dividing-head.toml --seed {seed} --out s{seed}; "
            f"calibrate s{seed}/run.toml --no-report --out c{seed}"
            for seed in HISTORY
        ),
        "records trend " + " ".join(f"c{seed}/calibration.json" for seed in HISTORY),
    ],
    "plan": ["plan examples/plan-dividing-head.toml --out p"],
    "reproduce": ["reproduce"],
    "terms": ["terms"],
    **{
        f"platform-{task}-{name}": [f"platform {task} {EXAMPLE_OF_PLATFORM.replace('*', name)} --out p"]
        for task in ("simulate", "align", "identify", "compare")
        for name in ("published", "piga", "moving", "wobble")
        if (task, name) != ("align", "moving")
    },
}
WITHOUT_JSON = ("compensate",)
PASSING = ("created", "sha256", "version", "seconds", "date", "tumble", "path", "file", "time_s_of_run")
"""Parts of keys that change from run to run or from machine to machine."""
UNCERTAINTY = ("standard_uncertainty", "std", "u", "uncertainty")


def flat(node: object, path: str, numbers: dict[str, list[float]], u: float = math.nan) -> None:
    """Write every number below a node of JSON under its path; the items of a list by name where they have one."""
    if isinstance(node, dict):
        beside = next((node[key] for key in UNCERTAINTY if isinstance(node.get(key), int | float)), math.nan)
        for key, value in node.items():
            if not any(part in key for part in PASSING):
                flat(value, f"{path}.{key}", numbers, beside)
    elif isinstance(node, list):
        for k, value in enumerate(node):
            keys = [key for key in ("id", "name", "segment") if isinstance(value, dict) and key in value]
            flat(value, f"{path}[{'/'.join(str(value[key]) for key in keys) or k}]", numbers, u)
    else:
        number = isinstance(node, int | float) and not isinstance(node, bool)
        numbers[path] = [float(node), float(u)] if number else []


def columns(path: Path, numbers: dict[str, list[float]]) -> None:
    """Write mean, smallest and largest value of every column of numbers of a Parquet file."""
    table = pq.ParquetFile(path).read(use_threads=False)
    for name in table.column_names:
        column = table[name]
        if str(column.type) in {"double", "float"}:
            for what, value in (("mean", pc.mean(column)), ("min", pc.min(column)), ("max", pc.max(column))):
                numbers[f"{path.name}.{name}.{what}"] = [value.as_py(), math.nan]


def run(name: str) -> dict[str, list[float]]:
    """Run the commands of a case in a folder of its own; return its numbers by path."""
    numbers: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        data = ROOT / "src" / "piga" / "data"
        shutil.copytree(ROOT / "examples", folder / "examples")
        shutil.copy(data / "tumble-a.toml", folder)
        (folder / "tumble-a.csv").write_bytes(gzip.decompress((data / "tumble-a.csv.gz").read_bytes()))
        for step, line in enumerate(CASES[name]):
            for command in line.split("; "):
                words = command.split() + ([] if command.startswith(WITHOUT_JSON) else ["--json"])
                done = subprocess.run(
                    [sys.executable, "-m", "piga", *words], cwd=folder, capture_output=True, text=True, check=False,
                    env=os.environ | {"PYTHONPATH": str(Path(piga.__file__).parents[1])},
                )  # fmt: skip
                if done.returncode:
                    sys.exit(f"{name}: piga {command}: exit {done.returncode}\n{done.stderr}")
                if done.stdout.lstrip().startswith(("{", "[")):
                    flat(json.loads(done.stdout), f"{step}:{command.split()[0]}", numbers)
        for path in folder.glob("out.parquet"):
            columns(path, numbers)
        for path in folder.glob("*/calibration.json"):
            flat(json.loads(path.read_text("utf-8")), f"{path.parent.name}/{path.name}", numbers)
    return numbers


def compare(name: str, before: dict[str, list[float]], after: dict[str, list[float]], tolerance: float) -> int:
    """Print what moved in a case; return how many numbers did."""
    for what, paths in (("gone", before.keys() - after.keys()), ("new ", after.keys() - before.keys())):
        print(*(f"{name}: {what} {path}\n" for path in sorted(paths)), sep="", end="")
    moved = 0
    for path in before.keys() & after.keys():
        if not before[path] or not after[path]:
            continue
        (old, u), (new, _) = before[path], after[path]
        change = abs(new - old)
        if change > tolerance * max(abs(old), abs(new)):
            moved += 1
            size = f"{change / u:.3g} u" if u > 0 else f"{change / max(abs(old), abs(new)):.3g} of itself"
            print(f"{name}: {path}: {old!r} -> {new!r} ({size})")
    return moved


def main() -> None:
    """Write the numbers, or compare them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", choices=("write", "compare"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--only", action="append", help="cases whose name begins so")
    parser.add_argument("--tolerance", type=float, default=1e-12)
    given = parser.parse_args()
    names = [name for name in CASES if not given.only or name.startswith(tuple(given.only))]
    results = {name: run(name) for name in names}
    if given.task == "write":
        given.file.write_text(json.dumps(results, indent=0), "utf-8")
        return
    frozen = json.loads(given.file.read_text("utf-8"))
    sys.exit(1 if sum(compare(name, frozen[name], results[name], given.tolerance) for name in names) else 0)


if __name__ == "__main__":
    main()
