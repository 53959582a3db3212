"""The tables of intervals on the page 'Accuracy and limits', from a collected campaign.

Run ``piga campaign run examples/campaigns/coverage.toml --out DIR`` and ``piga campaign collect DIR``, then
``python -m benchmarks.intervals DIR``; likewise with ``interval-cases.toml`` and ``coloured.toml``. A row is replaced by a
campaign of at least as many tests. A row of another version is also replaced by fewer, but at least ``FEWEST`` tests.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from benchmarks import measured

from piga.campaign.subjects import NOISE_DOUBTED

TABLES = {"coverage.toml": "intervals", "interval-cases.toml": "interval-cases"}
COLOURED = {
    "head-flicker": "angle log, flicker of 3e-6 rad/s a decade",
    "head-markov": "angle log, Markov noise of 3e-6 rad/s and 5 s",
    "head-cycle": "angle log, wave of 5 µg and 1500 s",
    "rate-flicker": "rate log, flicker of 3e-6 rad/s a decade",
    "rate-markov": "rate log, Markov noise of 3e-6 rad/s and 5 s",
    "rate-cycle": "rate log, wave of 5 µg and 1500 s",
}
"""Rows of the table of coloured noise by the cases of ``coloured.toml``. The table is written as a whole."""
COMMAND = "piga campaign run examples/campaigns/{} --out DIR"
FEWEST = 300
"""Fewest tests that replace a row of another version."""


def row_values(group: dict[str, Any]) -> dict[str, measured.Value]:
    """The columns of a row, from the document of a group."""
    coefficients = group["coefficients"]
    share = [100.0 * c["coverage"] for c in coefficients]
    ratio = [c["variance_over_bound"] for c in coefficients]
    values: dict[str, measured.Value] = {
        "tests": group["records"],
        "records": group["records"],
        "coverage": (round(min(share), 1), round(max(share), 1)),
        "intervals hold, on average": round(sum(share) / len(share), 1),
        "worst coefficient": round(min(share), 1),
        "largest bias / sigma": round(max(abs(c["bias_over_sigma"]) for c in coefficients), 3),
        "NEES": round(group["nees"], 3),
        "NEES expected": round(group["nees_expected"], 3),
    }
    if None not in ratio:
        values["variance / bound"] = (round(min(ratio), 2), round(max(ratio), 2))
    return values


def put_down(collected: dict[str, Any], folder: Path = measured.FOLDER) -> list[str]:
    """Replace the rows that this campaign knows at least as well; says what became of every group."""
    campaign = collected["campaign"]
    name = TABLES.get(campaign, "intervals")
    figures: dict[str, list[measured.Figure]] = {}
    for figure in measured.load(name, folder)[1]:
        if "scenario" in figure:
            figures.setdefault(figure["scenario"], []).append(figure)
    said = []
    for group in collected["groups"]:
        label, records = group["name"], group["records"]
        row = figures.get(label, [])
        shown = next((f for f in row if f["column"] in ("tests", "records")), None)
        if shown is None:
            said.append(f"{label}: has no row in docs/measured/{name}.json")
        elif group["failed"] or records < group["planned"]:
            said.append(f"{label}: records are missing or failed; the row stays")
        elif records < shown["value"] and (shown["version"] == collected["version"] or records < FEWEST):
            said.append(f"{label}: {records} tests; the row of {shown['value']} tests stays")
        else:
            values = row_values(group)
            new = {f["name"]: values[f["column"]] for f in row if f["column"] in values}
            for figure in row:
                if "reported" in figure:
                    new[figure["name"]] = round(100.0 * group["seen"].get(figure["reported"], 0.0), 1)
            measured.record(name, new, folder, command=COMMAND.format(campaign))
            said.append(f"{label}: {records} tests put down")
    return said


def coloured_row(group: dict[str, Any]) -> dict[str, measured.Value]:
    """The columns of a row of coloured noise; shares in percent, of the misses 100 if there are none."""
    share = [100.0 * c["coverage"] for c in group["coefficients"]]
    warned = group["seen_where_missed"].get(NOISE_DOUBTED, 0.0) if group["missed"] else 1.0
    return {
        "records": group["records"],
        "intervals hold": (round(min(share), 1), round(max(share), 1)),
        "misses": group["missed"],
        "misses with a warning": round(100.0 * warned),
    }


def put_down_coloured(collected: dict[str, Any], folder: Path = measured.FOLDER) -> list[str]:
    """Replace the table of coloured noise, if the campaign is complete and has as many tests as the table."""
    groups = {group["name"]: group for group in collected["groups"]}
    shown = [f["value"] for f in measured.load("coloured-intervals", folder)[1] if f["column"] == "records"]
    short = [
        name
        for name in COLOURED
        if (group := groups.get(name)) is None or group["failed"] or group["records"] < group["planned"]
    ]
    if short:
        return [f"{', '.join(short)}: records are missing or failed; the table stays"]
    records = min(groups[name]["records"] for name in COLOURED)
    if records < min(shown):
        return [f"{records} tests; the table of {min(shown)} tests stays"]
    rows = {row: coloured_row(groups[name]) for name, row in COLOURED.items()}
    measured.write(
        "coloured-intervals",
        "record",
        rows,
        {column: "%" for column in next(iter(rows.values())) if column not in ("records", "misses")},
        folder=folder,
        command=COMMAND.format("coloured.toml"),
        conditions="dividing head, 24 positions of 60 s in the order of their angle, 5 Hz; angle logs with 2.5e-5 rad of white "
        "noise and a walk of 1e-6 rad/√s, rate logs with a walk of 2e-5 rad/√s. Intervals: worst and best coefficient. "
        "Misses: records in which the interval of any coefficient misses. Warning: a doubt about the noise. Remark: share of "
        "all records that have no doubt about the noise, but the remark on coloured noise that is not excluded",
    )
    return [f"{row}: {groups[name]['records']} tests put down" for name, row in COLOURED.items()]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of the campaign, collected")
    chosen = parser.parse_args()
    document = json.loads((chosen.folder / "collected" / "collect.json").read_text(encoding="utf-8"))
    put = put_down_coloured if document["campaign"] == "coloured.toml" else put_down
    print("\n".join(put(document)))


if __name__ == "__main__":
    main()
