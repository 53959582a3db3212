"""A log that no run file describes: what each column seems to hold, and the questions that the log leaves open.

The guesses are those of ``piga init``. A column is corrected at the column, a question is answered at its field.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import Any
from urllib.parse import quote

from starlette.requests import Request
from starlette.responses import Response

from piga.describe import ColumnGuess, LogDescription, RunFileDraft, describe_log, draft_run_file, try_run_file
from piga.describe.columns import UNITS, WORDS
from piga.describe.draft import Question
from piga.errors import ArgumentError, PigaError
from piga.records.run_file import read_run_file
from piga.reports.render.numbers import significant
from piga.text_files import toml_document
from piga.workbench.common import Field, Sent, bench_of, form, in_line, redirect, render
from piga.workbench.folder import Folder
from piga.workbench.record import left

_ROWS = 6
"""Rows of the preview."""
_MENUS = {
    "rad/s/g": ("rad/s/g", "deg/s/g", "rev/s/g", "deg/h/g"),
    "Hz": ("Hz", "kHz"),
    "deg": ("deg", "rad"),
    "m": ("m", "km", "cm", "mm"),
    "1": (),
}
"""Units of the menu of a question, by the unit of its example."""
_AXES = ("force", "base-rate")
_TAKEN_OVER = ("instrument", "stand", "uncertainty")
"""Tables that an earlier run file can give."""


@dataclass
class _Sheet:
    """The page of a log: its description with corrected columns, the draft of its run file, and the questions."""

    described: LogDescription
    draft: RunFileDraft
    fields: list[Field]
    message: str = ""

    @property
    def complete(self) -> bool:
        """True if the run file can be written."""
        return not self.draft.open and not self.message and not any(field.refusal for field in self.fields)


def _roles() -> list[tuple[str, str]]:
    """The choices of a column's menu: a value as ``piga init --column`` takes it, and its words."""
    choices = []
    for kind, words in WORDS.items():
        axes = [(f"{kind} {axis}", f"{words} {axis.upper()}0") for axis in "xyz"]
        choices += axes if kind in _AXES else [(kind, words)]
    return choices


def _role(column: ColumnGuess) -> str:
    return column.kind if column.axis is None else f"{column.kind} {'xyz'[column.axis]}"


def _told(columns: tuple[ColumnGuess, ...], sent: Sent) -> dict[str, str]:
    """What was corrected at the columns, by name."""
    told = {}
    for index, column in enumerate(columns):
        role, unit = sent.get(f"role:{index}", _role(column)), sent.get(f"unit:{index}", column.unit)
        if (role, unit) != (_role(column), column.unit):
            fits = unit in UNITS.get(role.partition(" ")[0], ())
            told[column.name] = f"{role} [{unit}]" if fits else role
    return told


def sheet(folder: Folder, name: str, sent: Sent) -> _Sheet:
    """Describe a log with the corrections and answers of a form."""
    log = folder.file(name)
    described, fields, message = describe_log(log), dict[str, Field](), ""
    draft = draft_run_file(described)
    try:
        told = _told(described.columns, sent)
        described = describe_log(log, told) if told else described
    except PigaError as error:
        message = str(error).removeprefix("--column ")
    try:
        draft = _answered(described, _taken(folder, sent.get("take", "")), sent, fields)
        read_run_file(log.with_suffix(".toml"), draft.completed().text().encode())
    except PigaError as error:
        message = message or str(error)
    return _Sheet(described, draft, list(fields.values()), message)


def _answered(
    described: LogDescription, settings: dict[str, Any], sent: Sent, fields: dict[str, Field]
) -> RunFileDraft:
    """The draft with the answers of a form. ``fields`` takes the questions; an answer may lead to another one."""
    while True:
        draft = draft_run_file(described, settings)
        asked = [one for one in (*draft.open, *draft.optional) if _is_field(one) and one.key not in fields]
        if not asked:
            return draft
        for question in asked:
            key, like = question.key, question.example.partition(" ")[2] or "1"
            units = _MENUS.get(like, (like,))
            field = Field(key, question.words, question.example, like=like, units=units).with_sent(sent, "q:")
            try:
                value = _value(question, field.value) if field.typed and not field.refusal else None
                if value is not None:
                    draft_run_file(described, settings | {key: value})
                    settings[key] = value
            except PigaError as error:
                field = replace(field, refusal=in_line(error))
            fields[key] = field


def _is_field(question: Question) -> bool:
    """False if a question is answered at the columns."""
    return not question.example.startswith("{")


def _value(question: Question, text: str) -> Any:
    """A value as the run file has it: a whole number for counts, else text."""
    if not question.example.isdigit():
        return text
    if not text.isdigit():
        raise ArgumentError(f"{text!r} is not a whole number", remedy=f"e.g. {question.example}")
    return int(text)


def _taken(folder: Folder, name: str) -> dict[str, Any]:
    """Instrument, stand and uncertainties of another run file, as settings."""
    document = toml_document(folder.toml(name)) if name else {}
    tables = {table: document.get(table) for table in _TAKEN_OVER}
    return {
        f"{table}.{key}": value
        for table, part in tables.items()
        for key, value in (part.items() if isinstance(part, dict) else ())
    }


def _preview(described: LogDescription) -> list[tuple[str, ...]]:
    """The first values of each column, as they were read."""
    layout = described.layout

    def cells(column: ColumnGuess) -> list[str]:
        if layout is not None and column.name in layout.sample:
            return layout.sample[column.name][:_ROWS]
        numbers = described.numbers.get(column.name, ())[:_ROWS]
        return [significant(float(value), 7) for value in numbers]

    return list(zip_longest(*map(cells, described.columns), fillvalue=""))


def _page(request: Request, sent: Sent) -> Response:
    """The page with the corrections and answers; or, if nothing is open, the run file is written."""
    bench, name = bench_of(request), request.path_params["name"]
    log = bench.folder.file(name)
    made, fault = None, ""
    try:
        made = sheet(bench.folder, name, sent)
        if sent.get("do") == "write" and made.complete:
            target = bench.folder.free(log.parent, log.name.partition(".")[0] or "run", ".toml")
            try_run_file(made.draft, target)
            bench.history.write(bench.folder.name(target), "", made.draft.text(), f"describe {log.name}")
            return redirect(f"/record/{quote(bench.folder.name(target))}")
    except PigaError as error:
        fault = str(error)
    code = 422 if fault or sent.get("do") == "write" else 200
    values = left(bench, name) | {"sheet": made, "message": fault or (made.message if made else "")}
    if made is not None:
        values |= {
            "roles": _roles(), "role": _role, "column_units": UNITS, "rows": _preview(made.described), "took": sent.get("take", ""),
            "others": [entry.name for entry in bench.folder.entries() if entry.state in ("ready", "kept")],
            "open_columns": [one for one in made.draft.open if not _is_field(one)],
            "notes": [line for lines in made.draft.comments.values() for line in lines if line.startswith("CHECK")],
        }  # fmt: skip
    return render(request, "log.html.jinja", code, **values)


ROUTES = form("/log/{name:path}", _page)
