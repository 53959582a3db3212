"""Self-contained pages: one HTML file with tiles, tables and figures that opens offline.

A page is plain data (:class:`Page`, :class:`Section` and blocks); :func:`page_html` turns it into text.
Figures are drawn by plotly.js, which stands in the page: when scrolled into view, and all of them before printing.
Nothing is loaded from elsewhere, and a content security policy admits only the page's own two scripts.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from importlib import resources
from itertools import pairwise
from pathlib import Path
from shutil import get_terminal_size
from typing import Any, ClassVar, Generic, Literal, Self, TypeVar

from piga._version import __version__
from piga.errors import MissingPackageError, needed
from piga.reports.render.figure import Figure, css_variables, figure_document
from piga.reports.render.numbers import aligned, ascii_text, printed
from piga.results import Plotted, Shown
from piga.units import wrapped

Tone = Literal["", "good", "doubtful", "bad", "quiet"]
Kind = Literal["info", "good", "warning", "problem"]
Align = Literal["text", "number"]
Item = TypeVar("Item")
Other = TypeVar("Other")
ALONE = "This file holds all it shows: it opens without a network, and prints on A4."
"""Last sentence of a page's footer."""


MOST_ROWS = 40
"""Rows of a table in a notebook."""


@dataclass(frozen=True)
class Tile:
    """One key number: ``label``, ``value`` with ``unit``, a line of ``detail``, and its tone."""

    label: str
    value: str
    unit: str = ""
    detail: str = ""
    tone: Tone = ""

    @property
    def words(self) -> str:
        """Value, unit and detail in one line."""
        value = f"{self.value} {self.unit}".rstrip()
        return f"{value}, {self.detail}" if self.detail else value


@dataclass(frozen=True)
class Text:
    """A paragraph of plain text. ``lead`` marks what the reader is to look for."""

    block: ClassVar = "text"

    text: str
    lead: bool = False


@dataclass(frozen=True)
class TableColumn:
    """Heading of a table column, its unit, and whether it holds numbers (set to the right)."""

    heading: str
    unit: str = ""
    align: Align = "number"


@dataclass(frozen=True)
class Cell:
    """Text of a cell with a tone. ``title``: shown when the pointer rests on the first cell of a row."""

    text: str
    tone: Tone = ""
    title: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of text or :class:`Cell`, as long as ``columns``. The first column names the row.

    ``code`` sets the cells of text columns in fixed-width letters (digests, options). ``upright`` turns the headings
    of number columns: a matrix with long names then fits the page. ``segments`` is the index of the segment of each row,
    for a table whose rows are segments: the reader can select one.
    """

    block: ClassVar = "table"

    columns: tuple[TableColumn, ...]
    rows: tuple[tuple[str | Cell, ...], ...]
    caption: str = ""
    notes: tuple[str, ...] = ()
    code: bool = False
    upright: bool = False
    segments: tuple[int | None, ...] = ()

    @property
    def cells(self) -> list[list[Cell]]:
        """All rows as cells."""
        return [[cell if isinstance(cell, Cell) else Cell(cell) for cell in row] for row in self.rows]

    def only(self, chosen: Sequence[int]) -> Table:
        """The table with these columns."""
        columns = tuple(self.columns[index] for index in chosen)
        return replace(self, columns=columns, rows=tuple(tuple(row[i] for i in chosen) for row in self.rows))

    def parts(self, fixed: int, across: int) -> tuple[Table, ...]:
        """Tables that fit the page: each has the first ``fixed`` columns and at most ``across`` of the others.

        The caption stands above the first part, the notes below the last.
        """
        count = len(self.columns) - fixed
        tables = max(1, math.ceil(count / across))
        edges = [fixed + round(index * count / tables) for index in range(tables + 1)]
        split = [self.only([*range(fixed), *range(*ends)]) for ends in pairwise(edges)]
        split = [split[0], *(replace(part, caption="") for part in split[1:])]
        return (*(replace(part, notes=()) for part in split[:-1]), split[-1])


class TableOf(Generic[Item]):
    """A table with a row for each item, made column by column: a heading, and the cell of an item.

    Examples
    --------
    >>> table = TableOf([1.0, 2.0]).text("x", str).number("square", lambda x: f"{x * x:g}", "m").table("Squares")
    >>> table.columns[1].unit, table.rows
    ('m', (('1.0', '1'), ('2.0', '4')))
    """

    def __init__(self, items: Iterable[Item]) -> None:
        self._columns: list[TableColumn] = []
        self._cells: list[Callable[[Item], str | Cell]] = []
        self._items = tuple(items)

    def text(self, heading: str, cell: Callable[[Item], str | Cell]) -> Self:
        """Add a column of text."""
        self._columns.append(TableColumn(heading, align="text"))
        self._cells.append(cell)
        return self

    def number(self, heading: str, cell: Callable[[Item], str | Cell], unit: str = "") -> Self:
        """Add a column of numbers."""
        self._columns.append(TableColumn(heading, unit))
        self._cells.append(lambda item: _printed(cell(item)))
        return self

    def across(
        self,
        others: Iterable[Other],
        heading: Callable[[Other], str],
        cell: Callable[[Item, Other], str | Cell],
        unit: Callable[[Other], str] = lambda _: "",
    ) -> Self:
        """Add a column of numbers for each of the others: its heading and unit, and the cell of an item."""
        for other in others:
            self.number(heading(other), lambda item, other=other: cell(item, other), unit(other))  # type: ignore[misc]
        return self

    def table(self, caption: str = "", notes: tuple[str, ...] = (), **more: Any) -> Table:
        """The table; ``more`` as for :class:`Table`."""
        rows = tuple(tuple(cell(item) for cell in self._cells) for item in self._items)
        return Table(tuple(self._columns), rows, caption, notes, **more)


def _printed(cell: str | Cell) -> str | Cell:
    return replace(cell, text=printed(cell.text)) if isinstance(cell, Cell) else printed(cell)


def named_values(
    name: str, value: str, rows: Mapping[str, str] | Iterable[tuple[str, str]], caption: str = "", **more: Any
) -> Table:
    """Table of two text columns with these headings; ``more`` as for :class:`Table`."""
    pairs = rows.items() if isinstance(rows, Mapping) else rows
    return TableOf(pairs).text(name, lambda row: row[0]).text(value, lambda row: row[1]).table(caption, **more)


@dataclass(frozen=True)
class FigureBlock:
    """A figure with its caption; given as a function it is made when it is shown."""

    block: ClassVar = "figure"

    given: Figure | Callable[[], Figure]

    @cached_property
    def figure(self) -> Figure:
        """The figure."""
        return self.given if isinstance(self.given, Figure) else self.given()


@dataclass(frozen=True)
class Notice:
    """An important remark: ``info``, ``good``, ``warning`` or ``problem``."""

    block: ClassVar = "notice"

    kind: Kind
    text: str


Block = Text | Table | FigureBlock | Notice
Content = Block | Figure | Callable[[], Figure] | str | None
"""What a section is given: a block; a figure, or a function that makes it; what the reader is to look for; None for nothing."""


def _block(content: Block | Figure | Callable[[], Figure] | str) -> Block:
    if isinstance(content, str):
        return Text(content, lead=True)
    return content if isinstance(content, Block) else FigureBlock(content)


@dataclass(frozen=True)
class Judgement:
    """The verdict box at the top of a page: one sentence with its remedy, further doubts, what was tested and what not."""

    tone: Tone
    headline: str
    remedy: str = ""
    problems: tuple[tuple[str, str], ...] = ()
    tested: tuple[str, ...] = ()
    not_tested: tuple[str, ...] = ()


@dataclass(frozen=True)
class Section:
    """A part of the page with its heading; ``anchor`` is the link target (letters, digits, hyphens)."""

    title: str
    anchor: str
    content: tuple[Content, ...]

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """What is shown, in order."""
        return tuple(_block(one) for one in self.content if one is not None)


def sections(*given: Section) -> tuple[Section, ...]:
    """Those sections that hold more than what the reader is to look for in them."""
    return tuple(one for one in given if any(not isinstance(part, str | None) for part in one.content))


def introduced(text: str, *tables: Table | None) -> tuple[Content, ...]:
    """Tables below what the reader is to look for in them; nothing without a table."""
    shown = [table for table in tables if table is not None]
    return (text, *shown) if shown else ()


@dataclass(frozen=True)
class Page:
    """A whole page. ``kicker`` is the small line above the title, ``footer`` the last line.

    ``segments`` are the names of the segments that figures and tables name by index. With two and more the reader can
    select one; it is then marked in all of them.
    """

    title: str
    subtitle: str = ""
    tiles: tuple[Tile, ...] = ()
    sections: tuple[Section, ...] = ()
    kicker: str = "piga"
    footer: str = f"Made by piga {__version__}. {ALONE}"
    judgement: Judgement | None = None
    segments: tuple[str, ...] = ()

    def drawn(self) -> Iterator[FigureBlock]:
        """The blocks of all figures in reading order."""
        for section in self.sections:
            yield from (block for block in section.blocks if isinstance(block, FigureBlock))

    def figures(self) -> tuple[Figure, ...]:
        """All figures in reading order."""
        return tuple(block.figure for block in self.drawn())

    def only(self, *anchors: str) -> Page:
        """The page with these sections alone."""
        return replace(self, sections=tuple(one for one in self.sections if one.anchor in anchors))


def origin(digests: Mapping[str, str]) -> Section:
    """The files that a result is from."""
    return Section("Origin", "origin", (named_values("file", "SHA-256", digests, "Files", code=True),))


def page_html(page: Page) -> str:
    """The page as HTML text: the same page always gives the same bytes."""
    figures = page.figures()
    scripts = (resource("assets", "plotly-basic.min.js"), resource("templates", "page.js")) if figures else ()
    return template("page.html.jinja").render(
        page=page,
        css=resource("templates", "page.css"),
        light=css_variables(dark=False),
        dark=css_variables(dark=True),
        scripts=scripts,
        policy=_policy(scripts),
        spec={figure.key: json_island(figure_document(figure)) for figure in figures},
    )


_MOST_COLUMNS, _FEWEST_COLUMNS = 100, 40
"""Widest and narrowest text of a page [letters]."""


def page_text(page: Page, *, width: int | None = None, plain: bool = True) -> str:
    """The page for a terminal ``width`` columns wide: verdict, title, tables, remarks. ``plain``: pure ASCII.

    Without a width it is that of the terminal, at most 100; 100 if there is none.
    """
    if width is None:
        width = min(max(get_terminal_size((_MOST_COLUMNS, 24)).columns, _FEWEST_COLUMNS), _MOST_COLUMNS)
    told = ascii_text if plain else str
    lines = []
    if page.judgement is not None:
        lines.append(f"verdict: {page.judgement.headline}")
        lines += [f"  what to do: {page.judgement.remedy}"] if page.judgement.remedy else []
        for what, remedy in page.judgement.problems:
            lines.append(f"  doubt: {what}" + (f": {remedy}" if remedy else ""))
        lines += [f"  tested: {what}" for what in page.judgement.tested]
        lines += [*(f"  not tested: {what}" for what in page.judgement.not_tested), ""]
    lines += [page.title, *(f"  {line}" for line in page.subtitle.splitlines())]
    lines += [f"  {tile.label}: {tile.words}" for tile in page.tiles]
    for number, section in enumerate(page.sections):
        inside: list[str] = []
        for block in section.blocks:
            inside += [""] if inside and isinstance(block, Table) else []
            inside += _block_lines(block, told, width)
        if inside:
            lines += [""] if number or section.title or page.subtitle else []
            lines += [*([section.title] if section.title else []), *inside]
    return "\n".join(part for line in lines for part in _wrapped(told(line), width)).strip("\n")


def _block_lines(block: Block, told: Callable[[str], str], width: int) -> list[str]:
    if isinstance(block, Text):
        return [] if block.lead else [f"  {block.text}"]
    if isinstance(block, Notice):
        return [{"warning": "remark: ", "problem": "problem: "}.get(block.kind, "") + block.text]
    if isinstance(block, FigureBlock):
        return []
    caption = [f"  {block.caption}"] if block.caption else []
    return [*caption, *_fitting_lines(block, told, width), *(f"  {note}" for note in block.notes)]


def _fitting_lines(table: Table, told: Callable[[str], str], width: int) -> list[str]:
    """Rows of a table; of a wide one in parts below each other, each with the first column and those that fit."""
    lines: list[str] = []
    chosen: list[int] = [0]
    best = _table_lines(table.only(chosen), told, width)
    for column in range(1, len(table.columns)):
        more = _table_lines(table.only([*chosen, column]), told, width)
        if len(chosen) > 1 and max(map(len, more), default=0) > width + len(_WHOLE):
            lines, chosen = [*lines, *best, ""], [0]
            more = _table_lines(table.only([0, column]), told, width)
        chosen, best = [*chosen, column], more
    return [*lines, *best]


_WHOLE = "\x00"
"""Begins a line that is not wrapped."""


def _table_lines(table: Table, told: Callable[[str], str], width: int) -> list[str]:
    """Rows with their columns below each other; a long text in the last column goes on below itself."""
    heads = [f"{column.heading} [{column.unit}]" if column.unit else column.heading for column in table.columns]
    rows = [list(map(told, row)) for row in (heads, *([cell.text for cell in row] for row in table.cells))]
    left = {k for k, column in enumerate(table.columns) if column.align == "text"}
    last = len(heads) - 1
    lines = []
    start = 2 + sum(max(len(row[k]) for row in rows) + 2 for k in range(last))
    for line in aligned(rows, left):
        whole = f"  {line}".rstrip()
        if last in left and start < width - 20 and len(whole) > width:
            lines += wrapped(whole[start:], width, whole[:start], " " * start)
        else:
            lines.append(whole)
    return [f"{_WHOLE}{line}" for line in (lines if any(heads) else lines[1:])]


def _wrapped(line: str, width: int) -> list[str]:
    """Lines of at most ``width`` letters, their continuations indented."""
    if line.startswith(_WHOLE) or len(line) <= width:
        return [line.removeprefix(_WHOLE)]
    indent = " " * (len(line) - len(line.lstrip()))
    return wrapped(line.strip(), width, indent, f"{indent}    ")


def brief(result: Shown) -> Page:
    """What a notebook shows of a result that no module shows: names and values, and its figure if it has one."""
    blocks: tuple[Block, ...] = (named_values("", "", result.in_brief()[:MOST_ROWS]),)
    if isinstance(result, Plotted):
        blocks += (FigureBlock(result.figure()),)
    return Page(result.heading(), sections=(Section("", "result", blocks),))


def card_html(page: Page) -> str:
    """A brief page as a piece of HTML, for a notebook. It needs no script and no network; its figure needs Matplotlib."""
    blocks = [block for section in page.sections for block in section.blocks]
    first = next(page.drawn(), None)
    picture = "" if first is None else _picture(first)
    text: str = template("card.html.jinja").render(page=page, blocks=blocks, svg=picture)
    return text


def _picture(block: FigureBlock) -> str:
    """The figure as SVG; empty where Matplotlib is not installed."""
    try:
        from piga.reports.render.axes import figure_svg
    except MissingPackageError:
        return ""
    return figure_svg(block.figure, width=5.0)


def write_page(page: Page, path: Path) -> Path:
    """Write the page as one HTML file."""
    path.write_bytes(page_html(page).encode("utf-8"))
    return path


def json_island(document: Any) -> str:
    """JSON that is safe inside a ``script`` element, with any text."""
    text = json.dumps(document, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for letter in "<>&\u2028\u2029":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return text


def _policy(scripts: tuple[str, ...]) -> str:
    """Content security policy: the page's own scripts by digest, its own styles, nothing from outside."""
    sources = " ".join(f"'sha256-{_digest(script)}'" for script in scripts) or "'none'"
    rules = ("default-src 'none'", f"script-src {sources}", "style-src 'unsafe-inline'", "img-src data: blob:")
    return "; ".join((*rules, "base-uri 'none'", "form-action 'none'"))


@lru_cache(maxsize=4)
def _digest(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")


@lru_cache(maxsize=8)
def resource(folder: str, name: str) -> str:
    """Text of a file that ships with this package."""
    return resources.files("piga.reports").joinpath(folder, name).read_text(encoding="utf-8")


@lru_cache(maxsize=4)
def template(name: str) -> Any:
    """A template of this package, ready to render: everything is escaped, unknown names are errors."""
    jinja2 = needed("jinja2")
    loader = jinja2.FunctionLoader(lambda name: resource("templates", name))
    environment = jinja2.Environment(
        loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    return environment.get_template(name)
