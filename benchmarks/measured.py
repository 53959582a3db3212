"""Figures of the documentation: ``docs/measured/*.json``, and the tables that the pages show of them.

``python benchmarks/measured.py`` writes the tables of all pages anew from the figures. A benchmark that is started with
``--record`` puts what it measured into its file; then write the pages. Each file is one table. What all its figures share
(version, commit, date, command, conditions) stands once, at the top.
"""

from __future__ import annotations

import datetime as dt
import json
import re
import subprocess
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "measured"
NEEDED = ("name", "value", "unit", "version", "commit", "date", "command", "conditions")
"""What every figure says of itself, alone or with its table."""
_TABLE = re.compile(
    r"(?P<head><!-- measured: (?P<name>[\w-]+) -->\n)(?P<body>.*?)(?P<end><!-- end -->)", re.DOTALL
)

Figure = dict[str, Any]
Value = float | tuple[float, float] | list[float]


def names() -> list[str]:
    """Names of all tables."""
    return sorted(path.stem for path in FOLDER.glob("*.json"))


def load(name: str) -> tuple[dict[str, Any], list[Figure]]:
    """Head of a table, and its figures with what they share filled in."""
    table = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    shared = {key: table[key] for key in NEEDED if key in table}
    return table, [shared | figure for figure in table["figures"]]


def record(name: str, values: Mapping[str, Value | Figure], **shared: Any) -> None:
    """Put the values that a table has figures for into it, by their names, with version, commit and date of now.

    A value is a number, the lowest and the highest, or several members of a figure. ``shared`` is more that is new for these
    figures, such as ``conditions``.
    """
    table = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    for figure in table["figures"]:
        if figure["name"] in values:
            figure.update(_members(values[figure["name"]]) | _now() | shared)
    _save(name, table)


def write(
    name: str,
    corner: str,
    rows: Mapping[str, Mapping[str, Value | Figure]],
    units: Mapping[str, str] | None = None,
    **shared: Any,
) -> None:
    """Write a whole table: for each row its values by column, with the unit of each column, 1 if it has none.

    ``corner`` is the head of the column that names the rows, ``shared`` what all figures share: ``command``, ``conditions``.
    """
    figures = [
        {"name": f"{row}: {column}", "unit": (units or {}).get(column, "1")}
        | _members(value)
        | {"row": row, "column": column}
        for row, cells in rows.items()
        for column, value in cells.items()
    ]
    columns = list(dict.fromkeys(figure["column"] for figure in figures))
    _save(name, _now() | shared | {"rows": corner, "columns": columns, "figures": figures})


def _members(value: Value | Figure) -> Figure:
    return value if isinstance(value, dict) else {"value": list(value) if isinstance(value, tuple) else value}


def _save(name: str, table: dict[str, Any]) -> None:
    text = json.dumps(table, indent=1, ensure_ascii=False) + "\n"
    (FOLDER / f"{name}.json").write_text(text, encoding="utf-8")
    print(f"recorded {name}")


def rounded(value: float, digits: int = 3) -> float:
    """A value with so many digits."""
    return float(f"{value:.{digits}g}")


def _now() -> dict[str, str]:
    """Version of the sources, the commit that is checked out, marked where files differ from it, and the day."""
    text = (ROOT / "src" / "piga" / "_version.py").read_text(encoding="utf-8")
    command = ["git", "describe", "--always", "--exclude", "*", "--dirty= and changes"]
    commit = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
    day = dt.datetime.now(dt.UTC).date().isoformat()
    return {"version": text.split('__version__ = "')[1].split('"')[0], "commit": commit, "date": day}


# --- tables ------------------------------------------------------------------------------------------


def render(name: str) -> str:
    """A table in Markdown, with a line below it that says how its figures were measured."""
    table, figures = load(name)
    rows = grid(table, figures) if "columns" in table else bars(figures)
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + f"\n\n{source(table, figures)}\n"


def bars(figures: list[Figure]) -> list[list[str]]:
    """One figure a row, beside what was asked; command and version where they are not those of most rows."""
    usual, usually = common(figures, "command"), common(figures, "version", "date")
    columns = {
        "what": [figure["name"] for figure in figures],
        "asked": [bar(figure) for figure in figures],
        "measured": [measured(figure) for figure in figures],
        "note": [figure.get("note", "") for figure in figures],
        "again by": ["" if (f["command"],) == usual else f"`{f['command']}`" for f in figures],
        "version": ["" if (f["version"], f["date"]) == usually else stamp([f]) for f in figures],
    }
    filled = {head: cells for head, cells in columns.items() if any(cells)}
    return [list(filled), ["---"] * len(filled), *map(list, zip(*filled.values(), strict=True))]


def grid(table: dict[str, Any], figures: list[Figure]) -> list[list[str]]:
    """Figures in rows and columns; several of one cell stand side by side."""
    columns, varied = table["columns"], not same(figures, "version", "date")
    rows = [
        [table["rows"], *columns, *["version"] * varied],
        ["---"] + ["---:"] * len(columns) + ["---"] * varied,
    ]
    for row in dict.fromkeys(figure["row"] for figure in figures):
        own = [figure for figure in figures if figure["row"] == row]
        cells = [", ".join(cell(f) for f in own if f["column"] == column) for column in columns]
        rows.append([row, *cells, *[stamp(own)] * varied])
    return rows


def cell(figure: Figure) -> str:
    """A figure of a grid, with what was asked where that was not met."""
    return measured(figure) if met(figure) else f"{measured(figure)} ({bar(figure)})"


def same(figures: list[Figure], *keys: str) -> bool:
    """True where all figures say the same."""
    return len({tuple(figure[key] for key in keys) for figure in figures}) == 1


def common(figures: list[Figure], *keys: str) -> tuple[Any, ...]:
    """What most figures say; empty where no answer has the half of them."""
    (answer, count), *_ = Counter(tuple(figure[key] for key in keys) for figure in figures).most_common(1)
    return answer if 2 * count >= len(figures) else ()


def ends(figure: Figure) -> tuple[float, float]:
    """Lowest and highest value."""
    value = figure["value"]
    return (value[0], value[-1]) if isinstance(value, list) else (value, value)


def met(figure: Figure) -> bool:
    """True where the worst value is within what was asked."""
    low, high = ends(figure)
    return high <= figure.get("at_most", high) and low >= figure.get("at_least", low)


def bar(figure: Figure) -> str:
    """What was asked, in words."""
    asked = [(key.replace("_", " "), figure[key]) for key in ("at_least", "at_most") if key in figure]
    words = " and ".join(f"{word} {number(value, figure)}" for word, value in asked)
    return with_unit(words, figure) if asked else ""


def measured(figure: Figure) -> str:
    """What was measured; where that is not what was asked, it says so."""
    low, high = ends(figure)
    text = number(low, figure, fixed=True)
    text += f" to {number(high, figure, fixed=True)}" if high != low else ""
    text = with_unit(text, figure)
    return text if met(figure) else f"**not met**: {text}"


def with_unit(text: str, figure: Figure) -> str:
    """A number and its unit; the unit 1 is not written."""
    return text if figure["unit"] == "1" else f"{text} {figure['unit']}"


def number(value: float, figure: Figure, *, fixed: bool = False) -> str:
    """A number as it is read: thousands in groups, with the decimals that its figure asks for."""
    if fixed and "decimals" in figure:
        return f"{value:,.{figure['decimals']}f}".replace(",", " ")
    if abs(value) >= 10_000 and value == int(value):
        return f"{value:,.0f}".replace(",", " ")
    return re.sub(r"e([-+])0", r"e\1", f"{value:.{figure.get('digits', 6)}g}")


def stamp(figures: list[Figure]) -> str:
    """Version and day of figures."""
    return "; ".join(dict.fromkeys(f"{figure['version']}, {figure['date']}" for figure in figures))


def source(table: dict[str, Any], figures: list[Figure]) -> str:
    """How the figures of a table were measured; in a table of bars, those that do not say it themselves."""
    shared = same if "columns" in table else common
    said = [keys for keys in (("command",), ("version", "date")) if shared(figures, *keys)]
    forms = {("command",): "`{}`", ("version", "date"): "version {}, {}"}
    parts = [forms[keys].format(*common(figures, *keys)) for keys in said]
    if not all(same(figures, *keys) for keys in said):
        parts[0] = f"rows without an entry of their own: {parts[0]}"
    parts += list(dict.fromkeys(figure["conditions"] for figure in figures))
    return f"*{'. '.join(part[:1].upper() + part[1:] for part in parts)}.*"


# --- pages -------------------------------------------------------------------------------------------


def pages() -> list[Path]:
    """Pages that show tables."""
    every = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [path for path in every if _TABLE.search(path.read_text(encoding="utf-8"))]


def shown(text: str) -> list[str]:
    """Names of the tables in the text of a page."""
    return [mark["name"] for mark in _TABLE.finditer(text)]


def filled(text: str) -> str:
    """The text of a page with its tables as the figures have them."""
    return _TABLE.sub(lambda mark: f"{mark['head']}{render(mark['name'])}{mark['end']}", text)


if __name__ == "__main__":
    for page in pages():
        page.write_text(filled(page.read_text(encoding="utf-8")), encoding="utf-8")
