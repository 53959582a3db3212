"""docs/figures/architecture.svg: the rooms of the package and who imports whom, from the code itself.

Run ``python builders/build_architecture.py`` after adding a room or an import between rooms. The graph that is drawn
stands as JSON in the picture's metadata; a test compares it with the code.
"""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from xml.sax.saxutils import escape

import grimp

ROOT = Path(__file__).parents[1]
TARGET = ROOT / "docs" / "figures" / "architecture.svg"
SENTENCES = {
    "cli": "the command line",
    "campaign": "thousands of tests, one machine or many",
    "workbench": "the same in the browser",
    "studies": "the publications reproduced",
    "certificate": "ISO/IEC 17025, DCC",
    "ledger": "calibrations kept and recomputed",
    "reports": "figures as data, tables, pages",
    "platform": "the platform that carries the instruments",
    "planning": "tests to come",
    "trend": "years of one instrument",
    "calibration": "coefficients from runs",
    "compensation": "force from output, live too",
    "stand": "test stands as machines with errors",
    "instrument": "motion, regimes, servo twin",
    "describe": "what an unknown log holds",
    "reading": "raw columns to a checked run",
    "formats": "one reader for each file format",
    "records": "plain data: runs, terms, calibrations",
    "_kernels": "compiled arithmetic",
    "output": "files whole or not there",
    "progress": "how far a long call is",
    "results": "what every result does in a notebook",
    "frames": "rotations",
    "earth": "gravity, Earth rate",
    "units": "units at the edges",
    "errors": "messages",
    "threads": "one thread of linear algebra",
}
"""What each room is, in a few words; a room without them is drawn with its name alone."""

NAME, STEP, ROW, TOP, MARGIN = 470.0, 30.0, 52.0, 160.0, 16.0
"""Width of the boxes, of a column, height of a row, top and edge of the picture."""
INK, PALE, LINE = "#12324a", "#5a6b78", "#2b5f8a"


def layers() -> list[list[str]]:
    """Rooms from top to bottom, as the import contract in ``pyproject.toml`` orders them."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    wanted = next(contract for contract in contracts if contract["type"] == "layers")
    rows = [[part.strip().removeprefix("piga.") for part in re.split("[:|]", row)] for row in wanted["layers"]]
    return [row for row in rows if row != ["__main__"]]


def graph() -> dict[str, list[str]]:
    """Each room with the rooms that it imports, lazy imports included, imports for types alone not."""
    modules = grimp.build_graph("piga", cache_dir=None, exclude_type_checking_imports=True)
    rooms = [room for row in layers() for room in row]
    result: dict[str, set[str]] = {room: set() for room in rooms}
    for module in modules.modules:
        for imported in modules.find_modules_directly_imported_by(module):
            here, there = room_of(module), room_of(imported)
            if here in result and there in result and here != there:
                result[here].add(there)
    return {room: sorted(result[room]) for room in rooms}


def shown() -> dict[str, dict[str, list[str]]]:
    """What the picture shows: the graph, and the rooms inside each room."""
    edges = graph()
    return {"imports": edges, "inside": {room: sub_rooms(room) for room in edges}}


def room_of(module: str) -> str:
    """``piga.instrument.twin.run`` is in the room ``instrument``."""
    return [*module.split("."), ""][1]


def sub_rooms(room: str) -> list[str]:
    """Rooms inside a room, the highest first where the import contract orders them."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    inside = [path.parent.name for path in sorted((ROOT / "src" / "piga" / room).glob("*/__init__.py"))]
    inside = [
        name for name in inside if (ROOT / "src" / "piga" / room / name / "__init__.py").read_text().strip()
    ]
    orders = [contract["layers"] for contract in contracts if contract.get("containers") == [f"piga.{room}"]]
    order = [part.strip() for row in (orders[0] if orders else []) for part in re.split("[:|]", row)]
    return sorted(inside, key=lambda name: (order.index(name) if name in order else len(order), name))


def text(x: float, y: float, words: str, size: int, colour: str, extra: str = "") -> str:
    """A line of text."""
    return f'<text x="{x:.0f}" y="{y:.0f}" font-size="{size}" fill="{colour}" {extra}>{escape(words)}</text>'


def row_lines(room: str, k: int, rooms: list[str], below: list[str]) -> list[str]:
    """A room's box, its diagonal cell, and a dot in the column of each room that it imports."""
    y, inside = TOP + k * ROW, sub_rooms(room)
    lines = [
        f'<rect x="{MARGIN}" y="{y + 4}" width="{NAME}" height="{ROW - 8}" rx="6" fill="#f1f6fa" stroke="{LINE}"/>',
        text(MARGIN + 14, y + (23 if inside else 31), room, 16, INK, 'font-weight="600"'),
        text(
            MARGIN + NAME - 12,
            y + (23 if inside else 31),
            SENTENCES.get(room, ""),
            12,
            PALE,
            'text-anchor="end"',
        ),
    ]
    if inside:
        lines.append(text(MARGIN + 14, y + 40, " \u203a ".join(inside), 11, LINE))
    for column, other in enumerate(rooms):
        x = MARGIN + NAME + (column + 0.75) * STEP
        if column == k:
            lines.append(
                f'<rect x="{x - 9}" y="{y + ROW / 2 - 9}" width="18" height="18" rx="3" fill="#c9d8e4"/>'
            )
        elif other in below:
            lines.append(
                f'<circle cx="{x}" cy="{y + ROW / 2}" r="7" fill="{LINE}">'
                f"<title>{escape(room)} imports {escape(other)}</title></circle>"
            )
    return lines


def svg(what: dict[str, dict[str, list[str]]]) -> str:
    """The picture: a row for each room, highest layer first, and a column for each room that can be imported."""
    edges = what["imports"]
    rooms = list(edges)
    width, height = 2 * MARGIN + NAME + (len(rooms) + 0.5) * STEP, TOP + len(rooms) * ROW + MARGIN
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" role="img" font-family="sans-serif">',
        f'<title>Rooms of piga and their imports</title><metadata id="graph">{escape(json.dumps(what))}</metadata>',
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="#ffffff"/>',
        text(MARGIN, 34, "Rooms of piga", 20, INK, 'font-weight="600"'),
        text(MARGIN, 62, "Highest layer first; layers are set apart by lines.", 13, PALE),
        text(MARGIN, 82, "A dot: the room of the row imports the room of the column.", 13, PALE),
        text(MARGIN, 102, "All dots lie right of the diagonal: nothing imports upwards.", 13, PALE),
        text(
            MARGIN, 122, "Small names are rooms inside a room; each imports only those to its right.", 13, PALE
        ),
    ]
    for column, room in enumerate(rooms):
        x = MARGIN + NAME + (column + 0.75) * STEP
        lines.append(text(x, TOP - 8, room, 13, INK, f'transform="rotate(-50 {x:.0f} {TOP - 8:.0f})"'))
        lines += row_lines(room, column, rooms, edges[room])
    at = TOP
    for layer in layers()[:-1]:
        at += ROW * len(layer)
        lines.append(f'<path d="M{MARGIN} {at} H{width - MARGIN}" stroke="#b8c4ce" stroke-width="1"/>')
    return "\n".join(lines) + "\n</svg>\n"


def drawn() -> dict[str, dict[str, list[str]]]:
    """What the committed picture shows."""
    text = TARGET.read_text(encoding="utf-8")
    match = re.search(r'<metadata id="graph">(.*?)</metadata>', text)
    return json.loads(match[1].replace("&quot;", '"').replace("&amp;", "&")) if match else {}


def main() -> None:
    """Draw the picture anew."""
    TARGET.write_text(svg(shown()), encoding="utf-8")
    print(f"wrote {TARGET.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
