"""Small campaigns for tests: their files, the command as a child process, and processes that are killed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil

if TYPE_CHECKING:
    from piga.campaign import Campaign

ROOT = Path(__file__).parents[2]
COVERAGE = ROOT / "examples" / "campaigns" / "coverage.toml"

SMALL = """
[campaign]
title = "Small"
seed = 7
repeats = 10
bounds = 3
records_per_shard = 4

[[case]]
name = "white"
[case.constant_force]
tumble = { positions = 6 }
seconds = "4 s"
rate = "5 Hz"
white = "2.5e-5 rad"
truth = { k0 = 1.6e-3 }
terms = ["scale_factor", "k0"]

[[case]]
name = "walk"
repeats = 7
[case.constant_force]
tumble = { positions = 6 }
seconds = "4 s"
rate = "5 Hz"
white = "2.5e-5 rad"
walk = "2e-5 rad/sqrt(s)"
truth = { k0 = 1.6e-3 }
terms = ["scale_factor", "k0"]
"""
"""17 records in 5 shards; the third shard has records of both cases."""


def written(folder: Path, text: str = SMALL, name: str = "small.toml") -> Path:
    """A campaign file in ``folder``."""
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def one_case(name: str, repeats: int, **values: object) -> str:
    """One case of the coverage campaign, with other repeats; ``values`` are set in its table ``[campaign]``."""
    head, *cases = COVERAGE.read_text(encoding="utf-8").split("[[case]]\n")
    case = next(case for case in cases if case.startswith(f'name = "{name}"\n'))
    body = case.rpartition("\n#")[0] or case
    lines = [line for line in body.splitlines() if not line.startswith("repeats")]
    own = "".join(f"{key} = {json.dumps(value)}\n" for key, value in values.items())
    head = head.partition("[campaign]")[2].partition("\n#")[0]
    given = ("repeats", *values)
    kept = "\n".join(line for line in head.splitlines() if not line.startswith(given))
    return f"[campaign]{kept}\nrepeats = {repeats}\n{own}\n[[case]]\n" + "\n".join(lines) + "\n"


def start(*arguments: object, **variables: str) -> subprocess.Popen[str]:
    """The command ``piga campaign`` of this checkout, as a child process in a group of its own."""
    env = os.environ | {"PYTHONPATH": str(ROOT / "src"), "OPENBLAS_NUM_THREADS": "1"} | variables
    return subprocess.Popen(
        [sys.executable, "-m", "piga", "campaign", *map(str, arguments)],
        env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip


def call(*arguments: object, **variables: str) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of the command."""
    process = start(*arguments, **variables)
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


def children(process: subprocess.Popen[str]) -> list[psutil.Process]:
    """Processes below a process; an empty list if it is gone."""
    try:
        return psutil.Process(process.pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def workers(process: subprocess.Popen[str]) -> list[psutil.Process]:
    """Workers of the local pool (not the process that keeps track of resources)."""
    result = []
    for child in children(process):
        try:
            if "spawn_main" in " ".join(child.cmdline()):
                result.append(child)
        except psutil.Error:
            continue
    return result


def computed(path: Path, out: Path, shards: Iterable[int] | None = None) -> Campaign:
    """A campaign, all of it or some shards, computed in this process."""
    from piga.campaign import plan_campaign
    from piga.campaign.shard import run_shard

    campaign = plan_campaign(path, out)
    for shard in range(campaign.shards) if shards is None else shards:
        run_shard(str(out), shard)
    return campaign


def collected(folder: Path) -> dict[str, bytes]:
    """The files that ``collect`` writes, computed in this process."""
    from piga.campaign import collect, document, open_campaign
    from piga.campaign.collect import write_table
    from piga.campaign.page import campaign_page, collected_text
    from piga.reports.render.page import page_html

    result = collect(open_campaign(folder))
    table = folder / "table.csv"
    write_table(result, table)
    return {
        "json": json.dumps(document(result), sort_keys=True).encode(),
        "csv": table.read_bytes(),
        "page": page_html(campaign_page(result)).encode(),
        "text": collected_text(result).encode(),
    }


def rows(folder: Path, columns: list[str] | None = None) -> list[dict[str, Any]]:
    """All rows of the parts, in order."""
    from pyarrow import parquet

    paths = sorted((folder / "parts").glob("part-*.parquet"))
    return [row for path in paths for row in parquet.read_table(path, columns=columns).to_pylist()]
