"""A record, from its log to kept calibrations: the questions that the log leaves open, its picture, the answer beside it."""

from __future__ import annotations

import hashlib
import secrets
import shutil
import tempfile
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any
from urllib.parse import quote

import msgspec
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.routing import Route

from piga.data import copy_example
from piga.describe import ColumnGuess, LogDescription, RunFileDraft, describe_log, draft_run_file, try_run_file
from piga.describe.columns import UNITS as COLUMN_UNITS
from piga.describe.columns import WORDS
from piga.describe.draft import QUESTIONS, Question
from piga.describe.run_file import suggestions
from piga.errors import ArgumentError, CalibrationError, PigaError
from piga.output import put_in_place, write_whole
from piga.records.calibration.calibration import Calibration
from piga.records.run_file import read_run_file
from piga.records.terms import GYRO, UNITS, check_terms, shown_unit, term_words, turns
from piga.reports.render.numbers import rounded, significant
from piga.text_files import files_named_in, toml_document, toml_value
from piga.workbench.common import FIT, Bench, Field, Job, Sent, bench_of, in_line, render, route
from piga.workbench.folder import TRIALS, Folder, Kept, OutsideError, results_of
from piga.workbench.signals import Outline, cache_key, picture, read_outline, rows_between

MOST_UPLOAD, _SMALL = 4 << 30, 20_000_000
"""Largest file [bytes] that may be dropped in; largest log on which lines are tried that repair a faulty run file."""
_TERMS = tuple(term for term in UNITS if term not in ("phi", "k1"))
"""Terms that have a box of their own."""


def _tags_of(bench: Bench) -> dict[str, list[str]]:
    with suppress(PigaError, msgspec.MsgspecError):
        raw = bench.folder.read(bench.folder.state_room() / "tags.json", 1 << 20)
        return msgspec.json.decode(raw, type=dict[str, list[str]])
    return {}


def left(bench: Bench, name: str = "", kept_name: str = "") -> dict[str, Any]:
    """Records and calibrations of the instrument that a page is about: that of a record or of a kept calibration."""
    entries = bench.folder.entries()
    firsts = {entry.serial: entry.name for entry in entries if entry.serial}
    here = (e.serial for e in entries if e.name == name or kept_name in [one.name for one in e.kept])
    serial = next(here, "") or next(iter(firsts), "")
    mine = [entry for entry in entries if entry.serial in (serial, "") or entry.name == name]
    kept = sorted((one for entry in mine for one in entry.kept), key=lambda one: one.created)
    tags = _tags_of(bench)
    return {
        "entries": mine, "serial": serial, "serials": dict(sorted(firsts.items())), "kept": kept, "name": name,
        "line": _time_line(kept), "tags": {entry.name: tags.get(entry.name, []) for entry in mine},
    }  # fmt: skip


def _time_line(kept: list[Kept]) -> list[dict[str, Any]]:
    """Kept calibrations as points: percent of the width and height of the picture, and the length of the bar of u."""
    low = min((one.ppm - one.u_ppm for one in kept), default=0.0)
    scale = 70.0 / max([1e-3, *(one.ppm + one.u_ppm - low for one in kept)])
    places = [8.0 + 84.0 * (index + 0.5) / len(kept) for index in range(len(kept))]
    heights = [(85.0 - scale * (one.ppm - low), scale * one.u_ppm) for one in kept]
    return [{"kept": one, "x": x, "y": y, "u": u} for one, x, (y, u) in zip(kept, places, heights, strict=True)]


def _home(request: Request) -> Response:
    entries = left(bench_of(request))["entries"]
    if not entries:
        return render(request, "first", "From a log to a calibration in three steps")
    first = next((entry for entry in entries if entry.state != "log"), entries[0])
    return RedirectResponse(f"/record/{quote(first.name)}", 303)


def _try_shipped(request: Request) -> Response:
    folder = bench_of(request).folder
    with tempfile.TemporaryDirectory(dir=folder.state_room("parts")) as part:
        run = copy_example(Path(part))
        for path in (run.with_suffix(".csv"), run):
            with suppress(FileExistsError):
                put_in_place(path, folder.path(path.name), replace=False)
    return RedirectResponse(f"/record/{run.name}", 303)


async def _take(request: Request) -> Response:
    """A file that was dropped in. Its bytes are the body; its name is in the address."""
    folder = bench_of(request).folder
    target = folder.free_for(request.query_params.get("name", ""))
    part = folder.state_room("parts") / secrets.token_hex(8)
    try:
        with part.open("xb") as stream:
            async for piece in request.stream():
                stream.write(piece)
                if stream.tell() > MOST_UPLOAD:
                    words = f"{target.name}: is larger than {MOST_UPLOAD >> 30} GiB"
                    raise ArgumentError(words, remedy="copy it into the folder")
        await run_in_threadpool(put_in_place, part, target, replace=False)
    finally:
        part.unlink(missing_ok=True)
    return JSONResponse({"name": target.name, "address": f"/record/{quote(target.name)}"})


def _tag(request: Request, sent: Sent) -> Response:
    bench, name = bench_of(request), sent.get("name", "")
    bench.folder.path(name)
    words = [word[:30] for word in sent.get("tags", "").replace(",", " ").split()[:8]]
    with bench.history.lock:
        raw = msgspec.json.encode(_tags_of(bench) | {name: words})
        write_whole(bench.folder.state_room() / "tags.json", lambda part: part.write_bytes(raw))
    return RedirectResponse(f"/record/{quote(name)}", 303)


def _back(request: Request, otherwise: str) -> Response:
    """Go back to the page of the record, with the terms that it shows."""
    path = "/" + request.headers.get("referer", "").partition("//")[2].partition("/")[2]
    return RedirectResponse(path if path.startswith("/record/") else otherwise, 303)


_MENUS = {
    "rad/s/g": ("rad/s/g", "deg/s/g", "rev/s/g", "deg/h/g"),
    "Hz": ("Hz", "kHz"),
    "deg": ("deg", "rad"),
    "m": ("m", "km", "cm", "mm"),
    "1": (),
}
"""Units of the menu of a question, by the unit of its example."""
_ROLES = [
    (f"{kind} {axis}".strip(), f"{words} {axis.upper()}0" if axis else words)
    for kind, words in WORDS.items()
    for axis in ("xyz" if kind in ("force", "base-rate") else ("",))
]
"""Choices of a column's menu: a value as ``piga init --column`` takes it, and its words."""


@dataclass
class Sheet:
    """The page of a log: its description with corrected columns, the draft of its run file, and the questions."""

    described: LogDescription
    draft: RunFileDraft
    fields: list[Field]
    message: str = ""

    @property
    def complete(self) -> bool:
        """True if the run file can be written."""
        return not self.draft.open and not self.message and not any(field.refusal for field in self.fields)


def _role(column: ColumnGuess) -> str:
    return column.kind if column.axis is None else f"{column.kind} {'xyz'[column.axis]}"


def _told(columns: tuple[ColumnGuess, ...], sent: Sent) -> dict[str, str]:
    told = {}
    for index, column in enumerate(columns):
        role, unit = sent.get(f"role:{index}", _role(column)), sent.get(f"unit:{index}", column.unit)
        if (role, unit) != (_role(column), column.unit):
            fits = unit in COLUMN_UNITS.get(role.partition(" ")[0], ())
            told[column.name] = f"{role} [{unit}]" if fits else role
    return told


def sheet(folder: Folder, name: str, sent: Sent) -> Sheet:
    """Describe a log, as ``piga init`` does, with the corrections and answers of a form."""
    log = folder.file(name)
    described, fields, message = describe_log(log), list[Field](), ""
    draft = draft_run_file(described)
    try:
        told = _told(described.columns, sent)
        described = describe_log(log, told) if told else described
    except PigaError as error:
        message = str(error).removeprefix("--column ")
    try:
        settings = _taken(folder, sent.get("take", ""))
        draft = draft_run_file(described, settings)
        asked = QUESTIONS | {one.key: one for one in (*draft.open, *draft.optional)}
        fields = [_answered(one, described, settings, sent) for one in asked.values() if one.example[0] != "{"]
        draft = draft_run_file(described, settings)
        read_run_file(log.with_suffix(".toml"), draft.completed().text().encode())
    except PigaError as error:
        message = message or str(error)
    unanswered = [one.key for one in (*draft.open, *draft.optional)]
    return Sheet(described, draft, [one for one in fields if one.typed or one.key in unanswered], message)


def _answered(question: Question, described: LogDescription, settings: dict[str, Any], sent: Sent) -> Field:
    """The field of a question; ``settings`` takes its answer: a whole number for counts, else text."""
    key, example = question.key, question.example
    like = example.partition(" ")[2] or "1"
    units = _MENUS.get(like, (like,))
    field = Field(key, question.words, example, like=like, units=units, css="notice question").with_sent(sent)
    try:
        if field.typed and not field.refusal:
            value: Any = field.value
            if example.isdigit():
                if not value.isdigit():
                    raise ArgumentError(f"{value!r} is not a whole number", remedy=f"e.g. {example}")
                value = int(value)
            draft_run_file(described, settings | {key: value})
            settings[key] = value
    except PigaError as error:
        return replace(field, refusal=in_line(error))
    return field


def _taken(folder: Folder, name: str) -> dict[str, Any]:
    """Instrument, stand and uncertainties of another run file, as settings."""
    document = toml_document(folder.toml(name)) if name else {}
    tables = {one: document.get(one) for one in ("instrument", "stand", "uncertainty")}
    parts = ((table, part) for table, part in tables.items() if isinstance(part, dict))
    return {f"{table}.{key}": value for table, part in parts for key, value in part.items()}


def _preview(described: LogDescription) -> list[tuple[str, ...]]:
    """The first six values of each column, as they were read."""
    cells = {name: [significant(float(one), 7) for one in some[:6]] for name, some in described.numbers.items()}
    cells |= described.layout.sample if described.layout else {}
    return list(zip_longest(*(cells.get(one.name, [])[:6] for one in described.columns), fillvalue=""))


def _show_log(request: Request, sent: Sent) -> Response:
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
            return RedirectResponse(f"/record/{quote(bench.folder.name(target))}", 303)
    except PigaError as error:
        fault = str(error)
    code = 422 if fault or sent.get("do") == "write" else 200
    values = left(bench, name) | {"sheet": made, "message": fault or (made.message if made else "")}
    if made is not None:
        values |= {
            "roles": _ROLES, "role": _role, "column_units": COLUMN_UNITS, "took": sent.get("take", ""),
            "rows": _preview(made.described),
            "others": [entry.name for entry in bench.folder.entries() if entry.state == "ready"],
            "open_columns": [one for one in made.draft.open if one.example[0] == "{"],
            "notes": [line for lines in made.draft.comments.values() for line in lines if line.startswith("CHECK")],
        }  # fmt: skip
    return render(request, "log", name, code, **values)


def _show(request: Request) -> Response:
    bench, name = bench_of(request), request.path_params["name"]
    entry = bench.folder.entry(name)
    if entry.state == "log":
        return RedirectResponse(f"/log/{quote(name)}", 303)
    outline, job = (None, None) if entry.state == "faulty" else _reading(bench, name)
    message, seen, repairs = job.fault if job else entry.message, "", list[Any]()
    with suppress(PigaError, OSError):
        seen = bench.history.seen(bench.folder.text(name))
        path = bench.folder.toml(name)
        if message and (path.parent / entry.log).stat().st_size <= _SMALL:
            repairs = suggestions(path)
    return render(
        request, "record", name, **left(bench, name), entry=entry, query=request.url.query, message=message, seen=seen,
        outline=outline, job=job, repairs=repairs, drawn=msgspec.json.encode(outline).decode(),
        right=_answer(bench, name, outline.every, request.query_params.getlist("term")) if outline else {},
    )  # fmt: skip


def _cache_of(bench: Bench, name: str) -> Path:
    """Folder of the envelopes of a record, whether they exist or not."""
    record = hashlib.sha256(name.encode()).hexdigest()[:12]
    return bench.folder.state_room("signals") / f"{record}-{cache_key(files_named_in(bench.folder.toml(name)))}"


def _reading(bench: Bench, name: str) -> tuple[Outline | None, Job | None]:
    """The outline of a record; or the job that reads it, or that failed."""
    cache = _cache_of(bench, name)
    command, mark = ("envelopes", name, str(cache)), f"signals/{cache.name}"
    return bench.jobs.made(lambda: read_outline(cache), command, "Read the record", name, mark)


def _data(request: Request) -> Response:
    """Rows of time, then least and largest value of each asked signal, as 64-bit floats."""
    cache, query = _cache_of(bench_of(request), request.path_params["name"]), request.query_params
    try:
        span = float(query["from"]), float(query["to"]), int(query["width"])
    except (KeyError, ValueError):
        raise ArgumentError("the span of the picture is not valid", remedy="reload the page") from None
    if read_outline(cache) is None:  # the record was changed; the page asks for its picture again
        return Response(status_code=204)
    table = picture(cache, query.get("keys", "").split(","), *span)
    headers = {"x-columns": str(table.shape[1])}
    return Response(table.astype("<f8").tobytes(), media_type="application/octet-stream", headers=headers)


def _change(request: Request, sent: Sent) -> Response:
    """Answer a question about a record: leave rows out, use them again, or set a key of its run file."""
    import tomlkit
    from tomlkit.exceptions import TOMLKitError

    bench, name, do = bench_of(request), request.path_params["name"], sent.get("do", "")
    try:
        document: Any = tomlkit.parse(bench.folder.text(name))
        if do == "set":
            place, _, key = sent["key"].partition(".")
            document.setdefault(place, {})[key] = tomlkit.value(sent["value"])
            words = f"set {key} = {sent['value']}"
        elif do == "again":
            entry = document["data"]["leave_out"].pop(int(sent["index"]))
            words = f"use again: {entry['reason']}"
        elif do in ("leave", "moves"):
            spans, reason = _spans(bench, name, sent)
            entries = document["data"].setdefault("leave_out", tomlkit.array())
            for rows in spans:
                entries.append(tomlkit.value(toml_value({"rows": list(rows), "reason": reason})))
            entries.multiline(multiline=True)
            words = f"leave out {len(spans)} span{'s' * (len(spans) > 1)}: {reason}"
        else:
            raise ArgumentError(f"{do[:40]!r}: is not a command of this page", remedy="use its buttons")
        text = tomlkit.dumps(document)
    except PigaError:
        raise
    except (TOMLKitError, ValueError, TypeError, AttributeError, LookupError):
        remedy = "reload the page, or change the file as text"
        raise ArgumentError(f"{name}: this cannot be put into the file", remedy=remedy) from None
    bench.history.write(name, sent.get("seen", ""), text, words)
    return _back(request, f"/record/{quote(name)}")


def _spans(bench: Bench, name: str, sent: Sent) -> tuple[list[tuple[int, int]], str]:
    """The rows that are left out, and why: those of a marked span, or in which the stand moves."""
    cache = _cache_of(bench, name)
    outline = read_outline(cache)
    if outline is None:
        raise ArgumentError(f"{name}: is not read yet", remedy="reload the page")
    if sent["do"] == "moves":
        return [one.rows for one in outline.moves], "the stand moves"
    rows = rows_between(cache, *(float(sent[end].replace(",", ".")) for end in ("from", "to")))
    if rows[1] - rows[0] + 1 >= outline.rows:
        raise ArgumentError("these are all rows of the record", remedy="mark a part of it")
    return [rows], " ".join(sent["reason"].split())


def _trial(bench: Bench, key: str) -> Kept | None:
    return bench.folder.kept(bench.folder.root / TRIALS / key)


def _answer(bench: Bench, name: str, every: int, ticked: list[str]) -> dict[str, Any]:
    """The answer for a choice of terms, or the job that computes it, or why there is none.

    Of a long record that of each so many (``every``) samples comes first, alone: both at once would take longer.
    """
    run_file = read_run_file(bench.folder.toml(name))
    usual = run_file.model.terms
    always = "k1" if "k1" in usual else "scale_factor"
    terms = tuple(dict.fromkeys((always, *ticked))) if ticked else usual
    boxes = [one for one in dict.fromkeys((always, *_TERMS, *usual)) if run_file.unit == GYRO or not turns(one)]
    shown = [(one, term_words(one).meaning, one in terms) for one in boxes if one != "k1" or one == always]
    values: dict[str, Any] = {
        "terms": shown, "always": always, "chosen": terms, "usual": set(terms) == set(usual),
        "answer": None, "former": None, "fit": None, "every": 1,
    }  # fmt: skip
    try:
        check_terms(terms, output=run_file.unit)
    except PigaError as error:
        return values | {"message": str(error)}
    cache = _cache_of(bench, name)
    key = hashlib.sha256(f"{cache.name} {' '.join(terms)}".encode()).hexdigest()[:16]

    def made(run: str, to: str) -> tuple[Kept | None, Job | None]:
        command = ("calibrate", run, "--terms", ",".join(terms), "--out", f"{TRIALS}{to}")
        return bench.jobs.made(lambda: _trial(bench, to), command, FIT, name, f"{TRIALS}{to}")

    early, fit, answer = None, None, _trial(bench, key)
    if answer is None and every > 1:
        early, fit = made(bench.folder.name(cache / "thinned.toml"), f"{key}-thinned")
    if answer is None and (fit is None or fit.state == "failed"):
        answer, fit = made(name, key)
    if answer is None and early is not None:
        values |= {"every": every, "rows": _rows(early.calibration, early.calibration)}
    last = [one for one in bench.answers.get(name, []) if one != key]
    former = next((kept for one in last if (kept := _trial(bench, one))), None)
    if answer is not None:
        bench.answers[name] = [key, *last][:2]
        values |= {"key": key, "rows": _rows(answer.calibration, (former or answer).calibration)}
    values["message"] = fit.fault if fit else ""
    return values | {"answer": answer or early, "former": former, "fit": fit}


def _rows(one: Calibration, other: Calibration) -> list[dict[str, Any]]:
    """The coefficients of two calibrations in the units of every page: ``cells`` are value and u, or None."""
    rows = []
    for key in dict.fromkeys((*one, *other)):
        pair = [made.get(key) for made in (one, other)]
        name, unit = next((c.name, c.unit) for c in pair if c)
        factor, unit = shown_unit(name, unit)
        cells = [c and (factor * c.value, factor * c.std) for c in pair]
        rows.append({"key": key, "unit": unit, "cells": cells})
    return rows


def in_words(kept: Kept) -> str:
    """K and its unit."""
    return f"K = {rounded(kept.K, kept.u).value} {kept.unit}"


def _keep(request: Request, sent: Sent) -> Response:
    """Keep an answer: its files go where the command writes them. An older result becomes a version of its own."""
    bench, name, key = bench_of(request), request.path_params["name"], sent.get("key", "")
    answer = _trial(bench, key) if key in bench.answers.get(name, ()) else None
    if answer is None:
        raise CalibrationError("this answer is not there any more", remedy="reload the page")
    verdict = answer.calibration.verdict
    if verdict.grade == "do not use":
        raise CalibrationError(f"this result cannot be kept: {verdict.reason}", remedy="settle this first")
    with bench.history.lock:
        kept = bench.folder.entry(name).kept
        if not (kept and kept[0].calibration == answer.calibration):  # else the button was pressed twice
            target = bench.folder.path(bench.folder.name(results_of(bench.folder.toml(name))))
            number = 1 + max((-one.version for one in kept), default=0)
            older = bench.folder.path(f"{bench.folder.name(target)}-v{number}")
            part = bench.folder.state_room("parts") / key
            shutil.copytree(bench.folder.root / TRIALS / key, part, dirs_exist_ok=True)
            bench.history.put(target, part, f"keep {in_words(answer)}", older)
    return _back(request, f"/record/{quote(name)}")


def kept_of(bench: Bench, name: str) -> Kept:
    """A kept calibration by its folder."""
    kept = bench.folder.kept(bench.folder.path(name))
    if kept is None:
        raise OutsideError(f"{name[:200]}: holds no calibration that can be read", remedy="choose a listed one")
    return kept


def _show_kept(request: Request) -> Response:
    bench, name = bench_of(request), request.path_params["name"]
    kept, values = kept_of(bench, name), left(bench, kept_name=name)
    entry = next((one for one in values["entries"] if kept in one.kept), None)
    names = [path.name for path in bench.folder.files() if bench.folder.name(path.parent) == name]
    return render(request, "kept", f"Kept: {kept.name}", **values, one=kept, entry=entry, files=names)


def _discard(request: Request) -> Response:
    bench = bench_of(request)
    with bench.history.lock:
        kept = kept_of(bench, request.path_params["name"])
        bench.history.put(bench.folder.path(kept.name), None, f"discard {in_words(kept)}")
    return RedirectResponse("/", 303)


def _undo(request: Request) -> Response:
    bench_of(request).history.undo()
    return _back(request, "/")


def _compare(request: Request) -> Response:
    bench = bench_of(request)
    names = list(dict.fromkeys(request.query_params.getlist("of")))[:2]
    if len(names) != 2:
        raise ArgumentError("two results are needed", remedy="tick two kept results at the left")
    pair = [kept_of(bench, name) for name in names]
    table = _rows(*(kept.calibration for kept in pair))
    return render(request, "compare", "Two results side by side", **left(bench), pair=pair, table=table)


ROUTES = [
    Route("/", _home),
    Route("/try", _try_shipped, methods=["POST"]),
    Route("/upload", _take, methods=["POST"]),
    route("/tag", _tag, "POST"),
    Route("/undo", _undo, methods=["POST"]),
    route("/log/{name:path}", _show_log),
    Route("/record/{name:path}", _show, methods=["GET"]),
    route("/record/{name:path}", _change, "POST"),
    Route("/signal-data/{name:path}", _data),
    route("/keep/{name:path}", _keep, "POST"),
    Route("/compare", _compare),
    Route("/kept/{name:path}/discard", _discard, methods=["POST"]),
    Route("/kept/{name:path}", _show_kept),
]
