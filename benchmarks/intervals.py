"""The two tables of intervals on the page 'Accuracy and limits', from a collected campaign.

Run ``piga campaign run examples/campaigns/coverage.toml --out DIR`` and ``piga campaign collect DIR``, then
``python -m benchmarks.intervals DIR``; likewise with ``interval-cases.toml``. A row is replaced by a campaign of at
least as many tests. A row of another version is also replaced by fewer, but at least ``FEWEST`` tests.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from benchmarks import measured

TABLES = {"coverage.toml": "intervals", "interval-cases.toml": "interval-cases"}
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


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of the campaign, collected")
    chosen = parser.parse_args()
    document = json.loads((chosen.folder / "collected" / "collect.json").read_text(encoding="utf-8"))
    print("\n".join(put_down(document)))


if __name__ == "__main__":
    main()
