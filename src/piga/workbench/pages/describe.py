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
from piga.describe.columns import TOLD, WORDS
from piga.errors import ArgumentError, PigaError
from piga.records.run_file import read_run_file
from piga.records.text_files import toml_document
from piga.reports.render.numbers import significant
from piga.workbench.folder import Folder
from piga.workbench.pages.common import bench_of, only, posted, quantity, redirect, render
from piga.workbench.pages.record import left

ROWS = 6
"""Rows of the preview."""
UNITS = {
    "instrument.scale_factor": ("rad/s/g", ("rad/s/g", "deg/s/g", "rev/s/g", "deg/h/g")),
    "data.sample_rate": ("Hz", ("Hz", "kHz")),
    "stand.latitude": ("deg", ("deg", "rad")),
    "stand.height": ("m", ("m", "km")),
    "stand.radius": ("m", ("m", "cm", "mm")),
    "instrument.counts_per_revolution": ("1", ()),
}
"""A unit of the kind that a question asks for, and the units of its menu."""
_COLUMN_UNITS = {
    "time": ("s", "ms", "us", "min", "h"),
    "counts": (),
    "angle": ("deg", "rad", "rev", "arcmin", "arcsec", "mrad"),
    "rate": ("deg/s", "rad/s", "rev/s", "rpm", "deg/h"),
    "force": ("g", "m/s^2", "mg", "ug"),
    "base-rate": ("deg/s", "rad/s", "deg/h", "rpm"),
    "temperature": ("degC", "K"),
    "stand-angle": ("deg", "rad"),
    "stand-speed": ("rpm", "rad/s", "deg/s"),
}
"""Units of the menu of a column, by its kind."""
AXES = ("force", "base-rate")
_TAKEN_OVER = ("instrument", "stand", "uncertainty")
"""Tables that an earlier run file can give."""


@dataclass(frozen=True)
class _Field:
    """A question: key, words, what was typed, the chosen unit and the menu, and why the entry is refused."""

    key: str
    words: str
    example: str
    typed: str = ""
    unit: str = ""
    units: tuple[str, ...] = ()
    refusal: str = ""


@dataclass
class _Sheet:
    """The page of a log: its description with corrected columns, the draft of its run file, and the questions."""

    described: LogDescription
    draft: RunFileDraft
    fields: list[_Field]
    message: str = ""

    @property
    def complete(self) -> bool:
        """True if the run file can be written."""
        return not self.draft.open and not self.message and not any(field.refusal for field in self.fields)


def roles() -> list[tuple[str, str]]:
    """The choices of a column's menu: a value and its words."""
    choices = []
    for kind, words in WORDS.items():
        choices += (
            [(f"{kind}:{i}", f"{words} {'XYZ'[i]}0") for i in range(3)] if kind in AXES else [(kind, words)]
        )
    return choices


def role(column: ColumnGuess) -> str:
    """The choice of a column."""
    return f"{column.kind}:{column.axis}" if column.kind in AXES and column.axis is not None else column.kind


def sheet(folder: Folder, name: str, fields: dict[str, list[str]]) -> _Sheet:
    """Describe a log with the corrections and answers of a form."""
    log = folder.file(name)
    described = describe_log(log)
    columns = []
    for index, guess in enumerate(described.columns):
        column: Any = guess
        kind, _, axis = only(fields, f"role:{index}", role(column)).partition(":")
        unit = only(fields, f"unit:{index}", column.unit)
        if kind in WORDS and (kind, axis) != tuple(role(column).partition(":")[::2]):
            column = replace(column, kind=kind, axis=int(axis) if axis in "012" and axis else None, reason=TOLD)
            unit = unit if unit in _COLUMN_UNITS.get(kind, ()) else ""
        columns.append(replace(column, unit=unit))
    described = replace(described, columns=tuple(columns))
    taken = only(fields, "take")
    settings: dict[str, Any] = _taken(folder, taken) if taken else {}
    asked: dict[str, _Field] = {}
    message = ""
    for key in [one.removeprefix("q:") for one in fields if one.startswith("q:")]:
        typed, unit = only(fields, f"q:{key}").strip(), only(fields, f"u:{key}")
        like, units = UNITS.get(key, ("1", ()))
        asked[key] = _Field(key, "", "", typed, unit, units)
        if typed:
            try:
                settings[key] = _value(key, quantity(typed, unit, like, key))
                draft_run_file(described, settings, folder=log.parent)
            except PigaError as error:
                settings.pop(key, None)
                words = (
                    f"{error.message}. {error.remedy[:1].upper()}{error.remedy[1:]}."
                    if error.remedy
                    else error.message
                )
                asked[key] = replace(asked[key], refusal=words)
    try:
        draft = draft_run_file(described, settings, folder=log.parent)
        read_run_file(log.with_suffix(".toml"), draft.completed().text().encode())
    except PigaError as error:
        message = str(error)
        draft = draft_run_file(describe_log(log), {}, folder=log.parent)
    questions = {one.key: one for one in draft.open if one.key in UNITS}
    if "stand.latitude" in asked | questions:
        questions |= {one.key: one for one in draft.optional}
    shown = []
    for key in dict.fromkeys((*asked, *questions)):
        field = asked.get(key, _Field(key, "", ""))
        words, example = _words(key)
        shown.append(replace(field, words=words, example=example, units=UNITS.get(key, ("1", ()))[1]))
    return _Sheet(described, draft, shown, message)


def _value(key: str, text: str) -> Any:
    """A value as the run file has it: a whole number for counts, else text."""
    if key == "instrument.counts_per_revolution":
        if not text.isdigit():
            raise ArgumentError(f"{text!r} is not a whole number", remedy="e.g. 72000")
        return int(text)
    return text


def _words(key: str) -> tuple[str, str]:
    from piga.describe.draft import QUESTIONS

    return (QUESTIONS[key].words, QUESTIONS[key].example) if key in QUESTIONS else (key, "")


def _taken(folder: Folder, name: str) -> dict[str, Any]:
    """Instrument, stand and uncertainties of another run file, as settings."""
    document = toml_document(folder.toml(name))
    return {
        f"{table}.{key}": value
        for table in _TAKEN_OVER
        for key, value in document.get(table, {}).items()
        if isinstance(document.get(table), dict)
    }


def show(request: Request) -> Response:
    """The page of a log."""
    return _page(request, request.path_params["name"], {})


def _page(
    request: Request, name: str, fields: dict[str, list[str]], message: str = "", code: int = 200
) -> Response:
    bench = bench_of(request)
    values = left(bench, name)
    try:
        made = sheet(bench.folder, name, fields)
    except PigaError as error:
        if not bench.folder.path(name).is_file():
            raise
        return render(request, "log-faulty.html.jinja", 422, **values, message=str(error))
    others = [entry.name for entry in bench.folder.entries() if entry.state in ("ready", "kept")]
    open_columns = [one for one in made.draft.open if one.key not in UNITS]
    notes = [line for lines in made.draft.comments.values() for line in lines if line.startswith("CHECK")]
    part = "log-part.html.jinja" if request.headers.get("hx-request") else "log.html.jinja"
    return render(
        request, part, code, **values, sheet=made, roles=roles(), role=role, column_units=_COLUMN_UNITS, rows=_preview(made),
        others=others, message=message or made.message, open_columns=open_columns, notes=notes, took=only(fields, "take"),
    )  # fmt: skip


def _preview(made: _Sheet) -> list[list[str]]:
    """The first values of each column, as they were read."""
    layout, numbers = made.described.layout, made.described.numbers
    columns = []
    for column in made.described.columns:
        if layout is not None and column.name in layout.sample:
            columns.append([str(cell)[:24] for cell in layout.sample[column.name][:ROWS]])
        elif column.name in numbers:
            columns.append([significant(float(value), 7) for value in numbers[column.name][:ROWS]])
        else:
            columns.append([column.example[:24]])
    return [
        [cells[row] if row < len(cells) else "" for cells in columns]
        for row in range(max(map(len, columns), default=0))
    ]


def change(request: Request, fields: dict[str, list[str]]) -> Response:
    """Draw the page anew with the corrections and answers, or write the run file."""
    bench, name = bench_of(request), request.path_params["name"]
    if only(fields, "do") != "write":
        return _page(request, name, fields)
    made = sheet(bench.folder, name, fields)
    if not made.complete:
        return _page(request, name, fields, code=422)
    log = bench.folder.file(name)
    target = _free(bench.folder, log)
    try:
        try_run_file(made.draft, target)
    except PigaError as error:
        return _page(request, name, fields, str(error), 422)
    bench.history.write(bench.folder.name(target), "", made.draft.text(), f"describe {log.name}")
    return redirect(request, f"/record/{quote(bench.folder.name(target))}")


def _free(folder: Folder, log: Path) -> Path:
    """A free name for the run file of a log."""
    stem = log.name.split(".")[0].encode()[:100].decode("utf-8", "ignore") or "run"
    names = (f"{stem}.toml", *(f"{stem}-{number}.toml" for number in range(2, 1000)))
    return next(
        path for path in (folder.path(folder.name(log.with_name(name))) for name in names) if not path.exists()
    )


ROUTES = [
    Route("/log/{name:path}", show, methods=["GET"]),
    Route("/log/{name:path}", posted(change), methods=["POST"]),
]
