"""Figures of the documentation: ``docs/measured/*.json``, and the tables that the pages show of them.

``python benchmarks/measured.py`` writes the tables of all pages anew from the figures; ``--check`` only compares. A
benchmark that is started with ``--record`` puts what it measured into its file (:func:`record`); then write the pages.
Each file is one table. What all its figures share (version, commit, date, command, conditions) stands once, at the top.
"""

from __future__ import annotations

import datetime as dt
import json
import re
import subprocess
import sys
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


def names(folder: Path = FOLDER) -> list[str]:
    """Names of all tables."""
    return sorted(path.stem for path in folder.glob("*.json"))


def load(name: str, folder: Path = FOLDER) -> tuple[dict[str, Any], list[Figure]]:
    """Head of a table, and its figures with what they share filled in."""
    table = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
    shared = {key: table[key] for key in NEEDED if key in table}
    return table, [shared | figure for figure in table["figures"]]


def record(name: str, values: Mapping[str, Value | Figure], folder: Path = FOLDER, **shared: Any) -> None:
    """Put measured values into a table, with version, commit and date of now.

    Parameters
    ----------
    name : str
        The table.
    values : Mapping
        Value, lowest and highest value, or several members of a figure, by its name. An unknown name is an error.
    folder : Path
        Where the tables are.
    **shared
        More that is new for these figures, such as ``conditions``.
    """
    path = folder / f"{name}.json"
    table = json.loads(path.read_text(encoding="utf-8"))
    figures = {figure["name"]: figure for figure in table["figures"]}
    unknown = sorted(set(values) - set(figures))
    if unknown:
        raise KeyError(f"{path.name} has no figures {unknown}; add them there with their units")
    now = {"version": version(), "commit": commit(), "date": dt.datetime.now(dt.UTC).date().isoformat()}
    for key, value in values.items():
        new = (
            value if isinstance(value, dict) else {"value": list(value) if isinstance(value, tuple) else value}
        )
        figures[key].pop("least", None)
        figures[key].update(new | now | shared)
    path.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    print(f"recorded in {path.relative_to(ROOT) if path.is_relative_to(ROOT) else path}")


def write(
    name: str,
    corner: str,
    rows: Mapping[str, Mapping[str, Value | Figure]],
    units: Mapping[str, str] | None = None,
    *,
    folder: Path = FOLDER,
    **shared: Any,
) -> None:
    """Write a whole table of rows and columns, with version, commit and date of now.

    Parameters
    ----------
    name : str
        The table.
    corner : str
        Head of the column that names the rows.
    rows : Mapping
        For each row its values by column: a value, lowest and highest value, or several members of a figure.
    units : Mapping
        Unit of each column, by its name; none is 1.
    folder : Path
        Where the tables are.
    **shared
        What all figures share: ``command`` and ``conditions``.
    """
    columns = list(dict.fromkeys(column for cells in rows.values() for column in cells))
    figures = []
    for row, cells in rows.items():
        for column, value in cells.items():
            new = (
                value
                if isinstance(value, dict)
                else {"value": list(value) if isinstance(value, tuple) else value}
            )
            own = {"name": f"{row}: {column}", "unit": (units or {}).get(column, "1")}
            figures.append(own | new | {"row": row, "column": column})
    now = {"version": version(), "commit": commit(), "date": dt.datetime.now(dt.UTC).date().isoformat()}
    table = now | shared | {"rows": corner, "columns": columns, "figures": figures}
    text = json.dumps(table, indent=1, ensure_ascii=False) + "\n"
    (folder / f"{name}.json").write_text(text, encoding="utf-8")
    print(f"recorded {name}")


def rounded(value: float, digits: int = 3) -> float:
    """A value with so many digits."""
    return float(f"{value:.{digits}g}")


def version() -> str:
    """Version of the sources."""
    text = (ROOT / "src" / "piga" / "_version.py").read_text(encoding="utf-8")
    return text.split('__version__ = "')[1].split('"')[0]


def commit() -> str:
    """The commit that is checked out; marked where files differ from it."""
    said = [
        subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
        for words in (
            ["rev-parse", "--short", "HEAD"],
            ["status", "--porcelain", "--untracked-files=no", "src"],
        )
    ]
    return said[0] + (" and changes" if said[1] else "")


# --- tables ------------------------------------------------------------------------------------------


def render(name: str, folder: Path = FOLDER) -> str:
    """A table in Markdown, with a line below it that says how its figures were measured."""
    table, figures = load(name, folder)
    rows = grid(table, figures) if "columns" in table else bars(figures)
    return "\n".join(rows) + "\n\n" + source(table, figures) + "\n"


def bars(figures: list[Figure]) -> list[str]:
    """One figure a row, beside what was asked; command and version where they are not those of most rows."""
    usual, usually = common(figures, "command"), common(figures, "version", "date")
    varied = not same(figures, "version", "date")
    asked = any({"at_most", "at_least"} & set(figure) for figure in figures)
    noted = any("note" in figure for figure in figures)
    commands = not same(figures, "command")
    head = [
        "what",
        *["asked"] * asked,
        "measured",
        *["note"] * noted,
        *["again by"] * commands,
        *["version"] * varied,
    ]
    rows = [line(head), line(["---"] * len(head))]
    for figure in figures:
        cells = [figure["name"], *[bar(figure)] * asked, measured(figure), *[figure.get("note", "")] * noted]
        again = "" if (figure["command"],) == usual else f"`{figure['command']}`"
        version = "" if (figure["version"], figure["date"]) == usually else stamp([figure])
        rows.append(line([*cells, *[again] * commands, *[version] * varied]))
    return rows


def grid(table: dict[str, Any], figures: list[Figure]) -> list[str]:
    """Figures in rows and columns; several of one cell stand side by side."""
    columns, varied = table["columns"], not same(figures, "version", "date")
    head = [table["rows"], *columns, *["version"] * varied]
    rows = [line(head), line(["---"] + ["---:"] * len(columns) + ["---"] * varied)]
    for row in dict.fromkeys(figure["row"] for figure in figures):
        own = [figure for figure in figures if figure["row"] == row]
        cells = [", ".join(cell(f) for f in own if f["column"] == column) for column in columns]
        rows.append(line([row, *cells, *[stamp(own)] * varied]))
    return rows


def cell(figure: Figure) -> str:
    """A figure of a grid, with what was asked where that was not met."""
    return measured(figure) if met(figure) else f"{measured(figure)} ({bar(figure)})"


def line(cells: list[str]) -> str:
    """A row of a table."""
    return "| " + " | ".join(cells) + " |"


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
    words = [(key.replace("_", " "), figure[key]) for key in ("at_least", "at_most") if key in figure]
    return (
        with_unit(" and ".join(f"{word} {number(value, figure)}" for word, value in words), figure)
        if words
        else ""
    )


def measured(figure: Figure) -> str:
    """What was measured; where that is not what was asked, it says so."""
    low, high = ends(figure)
    text = number(low, figure, fixed=True)
    text += f" to {number(high, figure, fixed=True)}" if high != low else ""
    text = with_unit(text, figure)
    if "least" in figure:
        text += f" (least {number(figure['least'], figure)})"
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
    text = ". ".join(part[:1].upper() + part[1:] for part in parts)
    return f"*{text}.*"


# --- pages -------------------------------------------------------------------------------------------


def pages() -> list[Path]:
    """Pages that show tables."""
    every = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [path for path in every if _TABLE.search(path.read_text(encoding="utf-8"))]


def shown(text: str) -> list[str]:
    """Names of the tables in the text of a page."""
    return [mark["name"] for mark in _TABLE.finditer(text)]


def filled(text: str, folder: Path = FOLDER) -> str:
    """The text of a page with its tables as the figures have them."""
    return _TABLE.sub(lambda mark: f"{mark['head']}{render(mark['name'], folder)}{mark['end']}", text)


def main() -> None:
    """Write or check all pages."""
    for path in pages():
        text = path.read_text(encoding="utf-8")
        if filled(text) == text:
            continue
        if "--check" in sys.argv:
            sys.exit(f"{path.relative_to(ROOT)} differs from docs/measured; run: python benchmarks/measured.py")
        path.write_text(filled(text), encoding="utf-8")
        print(path.relative_to(ROOT))


if __name__ == "__main__":
    main()
