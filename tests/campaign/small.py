"""Small campaigns for tests: their files, and the command as a child process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

if TYPE_CHECKING:
    from piga.campaign import Campaign, CampaignPlan
    from piga.campaign.campaign_file import RecordName

ROOT = Path(__file__).parents[2]

STAND = """
[instrument]
serial = "s"
scale_factor = "0.8884 rad/s/g"
[truth]
beta = "74 arcsec"
alpha0 = "0.8 rad"
k0 = "3e-4 g"
[electronics]
sample_rate = "10 Hz"
output = "angle"
angle_noise = "5 arcsec"
angle_random_walk = "4 arcsec/sqrt(s)"
[stand]
kind = "dividing-head"
latitude = "40 deg"
positions = "0:360:60 deg"
dwell = "6 s"
move = "2 s"
settling_time = "0.5 s"
[run]
format = "csv"
[model]
terms = ["scale_factor", "k0"]
"""
"""A short test on a dividing head."""
SMALL = """
scenario = "stand.toml"
[campaign]
title = "Small"
seed = 7
repeats = 10
records_per_shard = 4

[[case]]
name = "walk"

[[case]]
name = "white"
repeats = 7
set = { "electronics.angle_random_walk" = "0 arcsec/sqrt(s)" }
"""
"""17 records in 5 shards; the third shard has records of both cases."""


def written(folder: Path, text: str = SMALL, name: str = "small.toml") -> Path:
    """A file in ``folder``, beside the scenario of the small campaigns."""
    if not (folder / "stand.toml").exists():
        (folder / "stand.toml").write_text(STAND, encoding="utf-8")
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def find(plan: CampaignPlan, case: int, repeat: int) -> RecordName:
    """A record by case and repeat."""
    records = map(plan.record, range(plan.records))
    return next(record for record in records if (record.case, record.repeat) == (case, repeat))


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
    out, err = process.communicate(timeout=600)
    return process.returncode, out, err


def computed(path: Path, out: Path, shards: Iterable[int] | None = None) -> Campaign:
    """A campaign, all of it or some shards, computed in this process."""
    from piga.campaign import plan_campaign
    from piga.campaign.shards import run_shard

    campaign = plan_campaign(path, out)
    for shard in range(campaign.shards) if shards is None else shards:
        run_shard(str(out), shard)
    return campaign


def collected(folder: Path) -> dict[str, bytes]:
    """The files that ``collect`` writes, computed in this process."""
    from piga.campaign import collect, open_campaign
    from piga.campaign.collect import campaign_page, write_table
    from piga.reports.render.page import page_html, page_text

    result = collect(open_campaign(folder))
    table = folder / "table.csv"
    write_table(result, table)
    return {
        "json": json.dumps(msgspec.to_builtins(result), sort_keys=True).encode(),
        "csv": table.read_bytes(),
        "page": page_html(campaign_page(result)).encode(),
        "text": page_text(campaign_page(result)).encode(),
    }


def rows(folder: Path) -> list[dict[str, Any]]:
    """All records of the parts in order; each has its row and the lists of its coefficients' columns."""
    from pyarrow import parquet

    lists = ("name", "unit", "value", "u", "low", "high", "truth", "deviation", "z")
    records: list[dict[str, Any]] = []
    for path in sorted((folder / "parts").glob("part-*")):
        for row in parquet.read_table(path).to_pylist():
            if row["name"] is None:
                records.append(row | {column: [] for column in lists})
            else:
                for column in lists:
                    records[-1][column].append(row[column])
    return records
