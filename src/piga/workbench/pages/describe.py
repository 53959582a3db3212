"""A log that no run file describes: what each column seems to hold, and the questions that the log leaves open.

The guesses are those of ``piga init``. A column is corrected at the column, a question is answered at its field.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from piga.describe import ColumnGuess, LogDescription, RunFileDraft, describe_log, draft_run_file, try_run_file
from piga.describe.columns import TOLD, UNITS, WORDS
from piga.describe.draft import QUESTIONS
from piga.errors import ArgumentError, PigaError
from piga.records.run_file import read_run_file
from piga.records.text_files import toml_document
from piga.reports.render.numbers import significant
from piga.workbench.folder import Folder
from piga.workbench.pages.common import (
    Field,
    Sent,
    bench_of,
    in_line,
    is_part,
    only,
    posted,
    redirect,
    render,
)
from piga.workbench.pages.record import left

_ROWS = 6
"""Rows of the preview."""
_UNITS = {
    "instrument.scale_factor": ("rad/s/g", ("rad/s/g", "deg/s/g", "rev/s/g", "deg/h/g")),
    "data.sample_rate": ("Hz", ("Hz", "kHz")),
    "stand.latitude": ("deg", ("deg", "rad")),
    "stand.height": ("m", ("m", "km")),
    "stand.radius": ("m", ("m", "cm", "mm")),
    "instrument.counts_per_revolution": ("1", ()),
}
"""A unit of the kind that a question asks for, and the units of its menu."""
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
    """The choices of a column's menu: a value and its words."""
    choices = []
    for kind, words in WORDS.items():
        axes = [(f"{kind}:{i}", f"{words} {'XYZ'[i]}0") for i in range(3)]
        choices += axes if kind in _AXES else [(kind, words)]
    return choices


def _role(column: ColumnGuess) -> str:
    """The choice of a column."""
    return f"{column.kind}:{column.axis}" if column.kind in _AXES and column.axis is not None else column.kind


def _corrected(column: Any, index: int, sent: Sent) -> Any:
    """The guess of a column with what was chosen at the column."""
    chosen, unit = only(sent, f"role:{index}", _role(column)), only(sent, f"unit:{index}", column.unit)
    kind, _, axis = chosen.partition(":")
    if kind in WORDS and chosen != _role(column):
        column = replace(column, kind=kind, axis=int(axis) if axis in ("0", "1", "2") else None, reason=TOLD)
        unit = unit if unit in UNITS.get(kind, ()) else ""
    return replace(column, unit=unit)


def sheet(folder: Folder, name: str, sent: Sent) -> _Sheet:
    """Describe a log with the corrections and answers of a form."""
    log = folder.file(name)
    plain = describe_log(log)
    columns = (_corrected(column, index, sent) for index, column in enumerate(plain.columns))
    described = replace(plain, columns=tuple(columns))
    settings = _taken(folder, only(sent, "take"))
    asked: dict[str, Field] = {}
    for key in [one.removeprefix("q:") for one in sent if one.startswith("q:")]:
        field = asked[key] = _question(key).with_sent(sent, "q:")
        if field.typed and not field.refusal:
            try:
                value = _value(key, field.value)
                draft_run_file(described, settings | {key: value}, folder=log.parent)
                settings[key] = value
            except PigaError as error:
                asked[key] = replace(field, refusal=in_line(error))
    message = ""
    try:
        draft = draft_run_file(described, settings, folder=log.parent)
        read_run_file(log.with_suffix(".toml"), draft.completed().text().encode())
    except PigaError as error:
        message = str(error)
        draft = draft_run_file(plain, {}, folder=log.parent)
    questions = [one.key for one in draft.open if one.key in _UNITS]
    if "stand.latitude" in (*asked, *questions):
        questions += [one.key for one in draft.optional]
    fields = [asked.get(key) or _question(key) for key in dict.fromkeys((*asked, *questions))]
    return _Sheet(described, draft, fields, message)


def _question(key: str) -> Field:
    like, units = _UNITS.get(key, ("1", ()))
    known = QUESTIONS.get(key)
    words, example = (known.words, known.example) if known else (key, "")
    return Field(key, words, example, like=like, units=units)


def _value(key: str, text: str) -> Any:
    """A value as the run file has it: a whole number for counts, else text."""
    if key != "instrument.counts_per_revolution":
        return text
    if not text.isdigit():
        raise ArgumentError(f"{text!r} is not a whole number", remedy="e.g. 72000")
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


def _page(request: Request, sent: Sent, message: str = "", code: int = 200) -> Response:
    bench, name = bench_of(request), request.path_params["name"]
    values = left(bench, name)
    try:
        made = sheet(bench.folder, name, sent)
    except PigaError as error:
        if not bench.folder.path(name).is_file():
            raise
        return render(request, "log-faulty.html.jinja", 422, **values, message=str(error))
    return render(
        request, "log-part.html.jinja" if is_part(request) else "log.html.jinja", code, **values, sheet=made,
        roles=_roles(), role=_role, column_units=UNITS, rows=_preview(made),
        others=[entry.name for entry in bench.folder.entries() if entry.state in ("ready", "kept")],
        message=message or made.message, took=only(sent, "take"),
        open_columns=[one for one in made.draft.open if one.key not in _UNITS],
        notes=[line for lines in made.draft.comments.values() for line in lines if line.startswith("CHECK")],
    )  # fmt: skip


def _preview(made: _Sheet) -> list[list[str]]:
    """The first values of each column, as they were read."""
    layout, numbers = made.described.layout, made.described.numbers
    columns = []
    for column in made.described.columns:
        cells = [column.example]
        if layout is not None and column.name in layout.sample:
            cells = [str(cell) for cell in layout.sample[column.name][:_ROWS]]
        elif column.name in numbers:
            cells = [significant(float(value), 7) for value in numbers[column.name][:_ROWS]]
        columns.append([cell[:24] for cell in cells] + [""] * (_ROWS - len(cells)))
    return [list(row) for row in zip(*columns, strict=True) if any(row)]


def _show(request: Request) -> Response:
    """The page of a log."""
    return _page(request, {})


def _change(request: Request, sent: Sent) -> Response:
    """Draw the page anew with the corrections and answers, or write the run file."""
    bench, name = bench_of(request), request.path_params["name"]
    if only(sent, "do") != "write":
        return _page(request, sent)
    made = sheet(bench.folder, name, sent)
    if not made.complete:
        return _page(request, sent, code=422)
    log = bench.folder.file(name)
    target = _free(bench.folder, log)
    try:
        try_run_file(made.draft, target)
    except PigaError as error:
        return _page(request, sent, str(error), 422)
    written = bench.folder.name(target)
    bench.history.write(written, "", made.draft.text(), f"describe {log.name}")
    return redirect(request, f"/record/{quote(written)}")


def _free(folder: Folder, log: Path) -> Path:
    """A free name for the run file of a log."""
    stem = log.name.split(".")[0].encode()[:100].decode("utf-8", "ignore") or "run"
    names = (f"{stem}{number}.toml" for number in ("", *(f"-{one}" for one in range(2, 1000))))
    paths = (folder.path(folder.name(log.with_name(name))) for name in names)
    return next(path for path in paths if not path.exists())


ROUTES = [
    Route("/log/{name:path}", _show, methods=["GET"]),
    Route("/log/{name:path}", posted(_change), methods=["POST"]),
]
