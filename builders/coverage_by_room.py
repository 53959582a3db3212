"""The coverage that ``python3 dev.py coverage`` measured, by room; ends with 1 where a room of the promise is below it.

``--record`` writes it into ``docs/measured``; then run ``python benchmarks/measured.py``.
"""

from __future__ import annotations

import sys
from collections import defaultdict

from coverage import Coverage

PROMISE = 95.0
ROOMS = {
    "_kernels",
    "instrument",
    "frames",
    "earth",
    "units",
    "formats",
    "reading",
    "records",
    "stand",
    "calibration",
    "compensation",
    "planning",
    "platform",
    "trend",
}
"""Numerics and readers: branch coverage of at least ``PROMISE`` percent."""


def main() -> None:
    """Print the table, and keep it."""
    measured = Coverage()
    measured.load()
    sums: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0, 0])
    for path in measured.get_data().measured_files():
        room = path.replace("\\", "/").split("/piga/")[-1].split("/")[0].removesuffix(".py")
        numbers = measured._analyze(path).numbers
        for k, value in enumerate(
            (numbers.n_statements, numbers.n_missing, numbers.n_branches, numbers.n_missing_branches)
        ):
            sums[room][k] += value
    rows, low = {}, []
    for room, (statements, missing, branches, missed) in sorted(sums.items()):
        if (room.startswith("_") and room != "_kernels") or not statements:
            continue
        share = 100.0 * (statements - missing + branches - missed) / max(statements + branches, 1)
        rows[f"`{room}`"] = {
            "statements": statements,
            "branches": branches,
            "covered": {"value": round(share, 1), "decimals": 1, "unit": "%"},
        }
        print(f"{room:14} {statements:6} {branches:6} {share:6.1f} %")
        if room in ROOMS and share < PROMISE:
            low.append(room)
    if "--record" in sys.argv:
        from benchmarks import measured  # noqa: PLC0415 - only here: it needs the checkout on the path

        measured.write(
            "coverage",
            "room",
            rows,
            command="python3 dev.py coverage",
            conditions="lines and branches together; the default tests with the JIT off, then the tests that only run compiled",
        )
    if low:
        sys.exit(f"below {PROMISE:g} %: {', '.join(low)}")


if __name__ == "__main__":
    main()
