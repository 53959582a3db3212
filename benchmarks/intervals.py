"""The table of intervals on the page 'Accuracy and limits', from a collected campaign.

Run ``piga campaign run examples/campaigns/coverage.toml --out DIR``, ``piga campaign collect DIR``, then
``python -m benchmarks.intervals DIR``. A row is replaced only by a campaign of at least as many tests.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from benchmarks import measured

COMMAND = "piga campaign run examples/campaigns/coverage.toml --out DIR"


def row_values(group: dict[str, Any]) -> dict[str, measured.Value]:
    """The columns of a row, from the document of a group."""
    coefficients = group["coefficients"]
    share = [100.0 * c["coverage"] for c in coefficients]
    ratio = [c["variance_over_bound"] for c in coefficients]
    values: dict[str, measured.Value] = {
        "tests": group["records"],
        "coverage": (round(min(share), 1), round(max(share), 1)),
        "largest bias / sigma": round(max(abs(c["bias_over_sigma"]) for c in coefficients), 3),
        "NEES": round(group["nees"], 3),
        "NEES expected": round(group["nees_expected"], 3),
    }
    if None not in ratio:
        values["variance / bound"] = (round(min(ratio), 2), round(max(ratio), 2))
    return values


def put_down(collected: dict[str, Any], folder: Path = measured.FOLDER) -> list[str]:
    """Replace the rows that this campaign knows at least as well; says what became of every group."""
    figures = measured.load("intervals", folder)[1]
    rows = {figure["scenario"]: figure["row"] for figure in figures}
    known = {figure["name"] for figure in figures}
    tests = {figure["scenario"]: figure["value"] for figure in figures if figure["column"] == "tests"}
    said = []
    for group in collected["groups"]:
        name = group["name"]
        if name not in rows:
            said.append(f"{name}: has no row in docs/measured/intervals.json")
        elif group["failed"] or not collected["complete"]:
            said.append(f"{name}: records are missing or failed; the row stays")
        elif group["records"] < tests[name]:
            said.append(f"{name}: {group['records']} tests; the row of {tests[name]} tests stays")
        else:
            new = {f"{rows[name]}: {column}": value for column, value in row_values(group).items()}
            new = {figure: value for figure, value in new.items() if figure in known}
            measured.record("intervals", new, folder, command=COMMAND)
            said.append(f"{name}: {group['records']} tests put down")
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
