"""The bench of one instrument: its records and kept calibrations, a record as a picture, the answer beside it."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import shutil
import tempfile
from dataclasses import asdict, dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote, urlencode

import msgspec
import numpy as np
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from piga.errors import ArgumentError, CalibrationError, PigaError
from piga.output import put_in_place, write_whole
from piga.records.calibration import Calibration
from piga.records.run_file import RunFile, read_run_file
from piga.records.terms import GYRO, UNITS, check_terms, meaning_of, shown_output, shown_unit, turns
from piga.records.text_files import files_named_in
from piga.reports.render.numbers import rounded
from piga.units import G0
from piga.workbench.folder import CALIBRATION, STATE_FOLDER, Entry, Kept, OutsideError, results_of
from piga.workbench.history import ChangedError
from piga.workbench.jobs import BusyError, Job
from piga.workbench.pages.common import (
    Bench,
    TooLargeError,
    bench_of,
    only,
    posted,
    redirect,
    render,
    result_file,
)
from piga.workbench.signals import Outline, cache_key, picture, read_outline, rows_between

MOST_UPLOAD = 4 << 30
"""Largest file [bytes] that may be dropped in. Larger ones are copied into the folder."""
SMALL = 20_000_000
"""Size of a log [bytes] up to which a faulty run file is answered with lines that repair it. They are tried on the log."""
_ALWAYS = "scale_factor"
TERMS = tuple(term for term in UNITS if term not in ("phi", "k1"))
"""Terms that have a box of their own."""
_MOST_TAGS = 200
_ENDED = ("failed", "stopped")
KEY = r"[0-9a-f]{16}"
"""Names of answers."""


# --- the left side --------------------------------------------------------------------------------


def _tags_of(bench: Bench) -> dict[str, list[str]]:
    """The tags of records."""
    with contextlib.suppress(PigaError, msgspec.MsgspecError):
        return msgspec.json.decode(
            bench.folder.read(bench.folder.state_room() / "tags.json", 1 << 20), type=dict[str, list[str]]
        )
    return {}


def left(bench: Bench, name: str = "") -> dict[str, Any]:
    """Records and calibrations of the instrument that a page is about."""
    entries = bench.folder.entries()
    serials = sorted({entry.serial for entry in entries if entry.serial})
    here = next((entry.serial for entry in entries if entry.name == name and entry.serial), "")
    serial = here or next((entry.serial for entry in entries if entry.serial), "")
    mine = [entry for entry in entries if entry.serial in (serial, "") or entry.name == name]
    kept = sorted((one for entry in mine for one in entry.kept), key=lambda one: one.created)
    firsts = {one: next((e.name for e in reversed(entries) if e.serial == one), "") for one in serials}
    tags = _tags_of(bench)
    return {
        "entries": mine, "serial": serial, "serials": firsts, "kept": kept, "line": _time_line(kept), "name": name,
        "tags": {entry.name: tags.get(entry.name, []) for entry in mine},
    }  # fmt: skip


def _time_line(kept: list[Kept]) -> list[dict[str, Any]]:
    """Kept calibrations as points: percent of the width and height of the picture, and the length of the bar of u."""
    if not kept:
        return []
    low = min(one.ppm - 1e6 * one.u / one.nominal for one in kept)
    high = max(one.ppm + 1e6 * one.u / one.nominal for one in kept)
    size = max(high - low, 1e-3)
    points = []
    for index, one in enumerate(kept):
        u = 1e6 * one.u / one.nominal
        y = 85.0 - 70.0 * (one.ppm - low) / size
        points.append({"kept": one, "x": 8.0 + 84.0 * (index + 0.5) / len(kept), "y": y, "u": 70.0 * u / size})
    return points


def home(request: Request) -> Response:
    """The first screen, or the newest record."""
    bench = bench_of(request)
    shown = left(bench)
    if not shown["entries"]:
        return render(request, "first.html.jinja")
    entry = next((entry for entry in shown["entries"] if entry.state != "log"), shown["entries"][0])
    return redirect(request, _address_of(entry))


def _address_of(entry: Entry) -> str:
    """The page of a record or log."""
    return f"/{'log' if entry.state == 'log' else 'record'}/{quote(entry.name)}"


async def try_shipped(request: Request) -> Response:
    """Copy the shipped record into the folder."""
    import gzip

    folder = bench_of(request).folder
    data = files("piga.data")
    for name, raw in (
        ("tumble-a.csv", gzip.decompress(data.joinpath("tumble-a.csv.gz").read_bytes())),
        ("tumble-a.toml", data.joinpath("tumble-a.toml").read_bytes()),
    ):
        with contextlib.suppress(PigaError):  # it is there already
            write_whole(folder.path(name), lambda part, raw=raw: part.write_bytes(raw), replace=False)  # type: ignore[misc]
    return redirect(request, "/record/tumble-a.toml")


async def take(request: Request) -> Response:
    """A file that was dropped in. Its bytes are the body; its name is in the address."""
    folder = bench_of(request).folder
    target = folder.free_name(request.query_params.get("name", ""))
    too_large = TooLargeError(
        f"{target.name}: is larger than {MOST_UPLOAD >> 30} GiB", remedy="copy it into the folder"
    )
    with tempfile.NamedTemporaryFile(dir=folder.state_room("parts"), delete=False) as stream:
        part = Path(stream.name)
        try:
            declared = request.headers.get("content-length", "0")
            if declared.isdigit() and len(declared) < 19 and int(declared) > MOST_UPLOAD:
                raise too_large
            async for piece in request.stream():
                stream.write(piece)
                if stream.tell() > MOST_UPLOAD:
                    raise too_large
            stream.flush()
            part.chmod(0o644)
            await run_in_threadpool(put_in_place, part, target, replace=False)
        finally:
            part.unlink(missing_ok=True)
    place = "record" if target.suffix == ".toml" else "log"
    return JSONResponse({"name": folder.name(target), "address": f"/{place}/{quote(folder.name(target))}"})


def tag(request: Request, fields: dict[str, list[str]]) -> Response:
    """Set the tags of a record."""
    bench = bench_of(request)
    name, words = only(fields, "name"), only(fields, "tags").replace(",", " ").split()
    bench.folder.path(name)
    with bench.history.lock:
        tags = _tags_of(bench) | {name: [word[:30] for word in words[:8]]}
        raw = msgspec.json.encode(dict(list(tags.items())[-_MOST_TAGS * 10 :]))
        write_whole(bench.folder.state_room() / "tags.json", lambda part: part.write_bytes(raw))
    return redirect(request, f"/record/{quote(name)}")


# --- the picture ----------------------------------------------------------------------------------


def _cache_of(bench: Bench, name: str) -> Path:
    """Folder of the envelopes of a record, whether they exist or not."""
    record = hashlib.sha256(name.encode()).hexdigest()[:12]
    return bench.folder.state_room("signals") / f"{record}-{cache_key(files_named_in(bench.folder.toml(name)))}"


def reading(bench: Bench, name: str, *, again: bool = False) -> tuple[Outline | None, Job | None]:
    """The outline of a record. If it is not read yet: the job that reads it, or that failed."""
    cache = _cache_of(bench, name)
    outline = read_outline(cache)
    if outline is not None:
        return outline, None
    mark = f"signals/{cache.name}"
    last = bench.jobs.latest(name, mark)
    if last is not None:
        state = bench.jobs.status(last).state
        outline = read_outline(cache)  # the job may have ended meanwhile
        if outline is not None:
            return outline, None
        if state == "running" or (state in _ENDED and not again):
            return None, last
    return None, bench.jobs.start(("envelopes", name, str(cache)), "Read the record", name, mark)


def show(request: Request) -> Response:
    """The page of a record."""
    bench, name = bench_of(request), request.path_params["name"]
    entry = bench.folder.entry(name)
    if entry.state == "log":
        return redirect(request, _address_of(entry))
    values = left(bench, name) | {"entry": entry, "query": request.url.query}
    return render(request, "record.html.jinja", **values, **_picture(request, entry))


def _show_picture(request: Request) -> Response:
    """The picture alone; the page asks for it while the record is read."""
    bench, name = bench_of(request), request.path_params["name"]
    entry = bench.folder.entry(name)
    return render(request, "picture.html.jinja", entry=entry, **_picture(request, entry))


def _picture(request: Request, entry: Entry) -> dict[str, Any]:
    bench = bench_of(request)
    values: dict[str, Any] = {"outline": None, "job": None, "message": entry.message, "repairs": [], "seen": ""}
    values["waits"] = ""
    if entry.state == "faulty":
        values["repairs"] = _repairs(bench, entry)
        with contextlib.suppress(PigaError):
            values["seen"] = bench.history.seen(bench.folder.text(entry.name))
        return values
    values["seen"] = bench.history.seen(bench.folder.text(entry.name))
    try:
        outline, job = reading(bench, entry.name, again="again" in request.query_params)
    except BusyError as error:
        return values | {"waits": error.message}
    if outline is not None:
        drawn = {"signals": [asdict(one) for one in outline.signals], "duration": outline.duration}
        drawn |= {
            key: [asdict(one) for one in getattr(outline, key)] for key in ("positions", "left_out", "moves")
        }
        drawn["findings"] = [one.time for one in outline.findings if one.time]
        return values | {"outline": outline, "drawn": json.dumps(drawn)}
    assert job is not None  # noqa: S101  a record is read, or a job reads it
    status = bench.jobs.status(job)
    if status.state in _ENDED:
        message = bench.jobs.text(job, "err").removeprefix("piga: ") or "The reading was stopped."
        return values | {"message": message, "repairs": _repairs(bench, entry)}
    return values | {"job": job, "status": status}


def _repairs(bench: Bench, entry: Entry) -> list[Any]:
    """Lines that repair a run file; each was tried on the log."""
    from piga.describe import suggestions

    if entry.size > SMALL:
        return []
    try:
        return suggestions(bench.folder.toml(entry.name))
    except (PigaError, OSError):
        return []


def data(request: Request) -> Response:
    """Rows of time, then least and largest value of each asked signal, as 64-bit floats."""
    bench, name = bench_of(request), request.path_params["name"]
    cache = _cache_of(bench, name)
    outline = read_outline(cache)
    query = request.query_params
    try:
        first, last, width = float(query["from"]), float(query["to"]), int(query["width"])
    except (KeyError, ValueError):
        raise ArgumentError("the span of the picture is not valid", remedy="reload the page") from None
    if outline is None:  # the record was changed; the page asks for its picture again
        return Response(status_code=204)
    signals = {signal.key: signal for signal in outline.signals}
    columns: list[Any] = []
    for key in query.get("keys", "").split(","):
        try:
            rows = picture(cache, key, first, last, width)
        except (ArgumentError, OSError):
            if read_outline(cache) is None:  # it was removed meanwhile
                return Response(status_code=204)
            raise
        shown = rows[:, 1:] * signals[key].factor + signals[key].offset
        columns += [shown] if columns else [rows[:, :1], shown]
    table = np.ascontiguousarray(np.hstack(columns), dtype="<f8")
    headers = {"x-columns": str(table.shape[1])}
    return Response(table.tobytes(), media_type="application/octet-stream", headers=headers)


def change(request: Request, fields: dict[str, list[str]]) -> Response:
    """Answer a question about a record: leave rows out, use them again, or set a key of its run file."""
    import tomlkit
    from tomlkit.exceptions import TOMLKitError

    bench, name = bench_of(request), request.path_params["name"]
    try:
        document = tomlkit.parse(bench.folder.text(name))
        words = _changed(bench, name, document, fields)
        text = tomlkit.dumps(document)
    except (TOMLKitError, ValueError, TypeError, AttributeError, KeyError) as error:
        if isinstance(error, PigaError):
            raise
        raise ArgumentError(f"{name}: this cannot be put into the file", remedy="change it as text") from None
    bench.history.write(name, only(fields, "seen"), text, words)
    return redirect(request, f"/record/{quote(name)}{_query(only(fields, 'query'))}")


def _changed(bench: Bench, name: str, document: Any, fields: dict[str, list[str]]) -> str:
    """Make the change in the document; what was done, in words."""
    import tomlkit

    word = only(fields, "do")
    table = document.setdefault("data", tomlkit.table())
    if word == "again":
        index = int(only(fields, "index")) if only(fields, "index").isdigit() else -1
        if not 0 <= index < len(table.get("leave_out", ())):
            raise ArgumentError("these rows are used already", remedy="reload the page")
        words = f"use again: {table['leave_out'][index]['reason']}"
        del table["leave_out"][index]
        return words
    if word in ("leave", "moves"):
        return _leave_out(bench, name, table, fields, word)
    if word != "set":
        raise ArgumentError(f"{word[:40]!r}: is not a command of this page", remedy="use its buttons")
    place, _, key = only(fields, "key").partition(".")
    document.setdefault(place, tomlkit.table())[key] = tomlkit.value(only(fields, "value"))
    return f"set {key} = {only(fields, 'value')}"


def _query(text: str) -> str:
    return f"?{text}" if re.fullmatch(r"terms=[\w%,.+]*", text) else ""


def _leave_out(bench: Bench, name: str, table: Any, fields: dict[str, list[str]], word: str) -> str:
    """Add entries to ``[data] leave_out``; what was done, in words."""
    import tomlkit

    outline = read_outline(_cache_of(bench, name))
    if outline is None:
        raise ArgumentError(f"{name}: is not read yet", remedy="reload the page")
    if word == "moves":
        spans, reason = [one.rows for one in outline.moves], "the stand moves"
    else:
        try:
            ends = float(only(fields, "from").replace(",", ".")), float(only(fields, "to").replace(",", "."))
        except ValueError:
            raise ArgumentError("the marked span is not valid", remedy="mark it again") from None
        reason = " ".join(only(fields, "reason").split())
        if not reason:
            raise ArgumentError("a reason is needed", remedy="say why these rows are left out")
        spans = [rows_between(_cache_of(bench, name), *ends)]
    if sum(last - first + 1 for first, last in spans) >= outline.rows:
        raise ArgumentError("these are all rows of the record", remedy="mark a part of it")
    if "leave_out" not in table:
        table["leave_out"] = tomlkit.array()
    for rows in spans:
        entry = tomlkit.inline_table()
        entry.update({"rows": list(rows), "reason": reason})
        table["leave_out"].append(entry)
    table["leave_out"].multiline(multiline=True)
    return f"leave out {len(spans)} spans: {reason}" if len(spans) > 1 else f"leave out: {reason}"


# --- the answer -----------------------------------------------------------------------------------

_LIGHTS: dict[str, tuple[Literal["green", "amber", "red"], str]] = {
    "clear": ("green", "Good"),
    "doubt": ("amber", "Look first"),
    "do not use": ("red", "Do not use"),
}
"""Colour and words of each grade."""


@dataclass(frozen=True)
class Light:
    """``grade`` and its words: what to do, the reason, and the other doubts."""

    grade: Literal["green", "amber", "red"]
    words: str
    reason: str
    more: tuple[str, ...] = ()

    @property
    def may_keep(self) -> bool:
        """False if the result must not be used."""
        return self.grade != "red"


def light(calibration: Calibration) -> Light:
    """The light of a calibration."""
    verdict = calibration.verdict
    first, *others = [doubt.words for doubt in verdict.doubts] or [verdict.reason]
    return Light(*_LIGHTS[verdict.grade], first, (*others, *calibration.remarks))


@dataclass(frozen=True)
class Answer:
    """A calibration that is not kept: its folder, and the calibration if it is done. ``every``: thinned by so much."""

    key: str
    place: Path
    calibration: Calibration | None = None
    every: int = 1

    @property
    def light(self) -> Light | None:
        """The light of the calibration."""
        return None if self.calibration is None else light(self.calibration)

    @property
    def K(self) -> tuple[float, float, float]:
        """K and its standard uncertainty [rad/s/g], and the difference from the nominal value [ppm]."""
        assert self.calibration is not None  # noqa: S101  asked of an answer that is done
        nominal = self.calibration.scale_factor_nominal * G0
        values = {one.name: one for one in self.calibration.coefficients}
        K = values["scale_factor"]
        return K.value, K.std, 1e6 * (K.value / nominal - 1.0)

    def rows(self, former: Answer | None) -> list[dict[str, Any]]:
        """The coefficients in the units of every page, with those of the former answer."""
        assert self.calibration is not None  # noqa: S101
        before = (
            {}
            if former is None or former.calibration is None
            else {c.key: c.value for c in former.calibration.coefficients}
        )
        rows = []
        for one in self.calibration.coefficients[:60]:
            factor, unit = shown_unit(one.name, one.unit)
            was = before.get(one.key)
            ghost = "" if was is None or was == one.value else rounded(factor * was, factor * one.std).value
            rows.append(
                {"key": one.key, "value": factor * one.value, "u": factor * one.std, "unit": unit, "was": ghost}
            )
        return rows


def _asked(run_file: RunFile, text: str) -> tuple[str, ...]:
    terms = tuple(term for term in text.split(",") if term) or run_file.model.terms
    check_terms(terms, output=run_file.unit)
    return terms


def _answer(bench: Bench, name: str, terms: tuple[str, ...], outline: Outline) -> tuple[Answer, Job | None]:
    """The best answer so far, and the job of a better one."""
    run = bench.folder.toml(name)
    state = f"{cache_key(files_named_in(run))} {name} {' '.join(terms)}"
    key = hashlib.sha256(state.encode()).hexdigest()[:16]
    whole = _made(bench, key)
    if whole.calibration is not None:
        return whole, None
    if outline.thinned == 1:
        return whole, _fit(bench, name, name, key, terms)
    first = replace(_made(bench, f"{key}-first"), every=outline.thinned)
    if first.calibration is None:  # the thinned record alone first: both at once would take longer
        thinned = bench.folder.name(_cache_of(bench, name) / "thinned.toml")
        job = _fit(bench, name, thinned, first.key, terms, "--no-report")
        if bench.jobs.status(job).state in ("running", "stopped"):
            return replace(first, key=key), job
        first = replace(_made(bench, first.key), every=outline.thinned)
    return replace(first, key=key), _fit(bench, name, name, key, terms)


def _trial(key: str) -> str:
    return f"{STATE_FOLDER}/trials/{key}"


def _fit(bench: Bench, name: str, run: str, key: str, terms: tuple[str, ...], *options: str) -> Job:
    """The job of an answer. Answers for other terms that nobody waits for any more are stopped."""
    last = bench.jobs.latest(name, _trial(key))
    if last is not None:
        return last
    old = [
        job
        for job in bench.jobs.running()
        if job.subject == name and job.title == "Fit" and key[:16] not in job.result
    ]
    bench.jobs.stop(*old, patience=0.0)
    bench.folder.state_room("trials")
    command = ("calibrate", run, "--terms", ",".join(terms), "--out", _trial(key), *options)
    return bench.jobs.start(command, "Fit", name, _trial(key))


def _made(bench: Bench, key: str) -> Answer:
    place = bench.folder.state_room("trials") / key
    try:
        return Answer(key, place, Calibration.from_json(place / CALIBRATION))
    except (PigaError, OSError):
        return Answer(key, place)


def _show_answer(request: Request) -> Response:
    """The answer for a choice of terms. The page asks again while a better one is computed."""
    bench, name = bench_of(request), request.path_params["name"]
    entry = bench.folder.entry(name)
    asked = request.query_params.getlist("term")
    text = ",".join(asked) if asked else request.query_params.get("terms", "")
    outline, waits = None, ""
    try:
        outline = None if entry.state in ("faulty", "log") else reading(bench, name)[0]
    except BusyError as error:
        waits = error.message
    if outline is None:
        return _no_answer(request, entry, text, waits)
    run_file = read_run_file(bench.folder.toml(name))
    terms = _asked(run_file, text)
    if asked and "again" not in request.query_params:
        terms = tuple(dict.fromkeys((_ALWAYS, *terms)))
    text = ",".join(terms)
    if "again" in request.query_params:
        for old in bench.jobs.all():
            if old.subject == name and old.title == "Fit":
                bench.jobs.forget(old)
    try:
        answer, job = _answer(bench, name, terms, outline)
    except BusyError as error:
        return _no_answer(request, entry, text, error.message)
    last = bench.answers.setdefault(name, [])
    if answer.calibration is not None and answer.key not in last[:1]:
        bench.answers[name] = last = [answer.key, *last][:2]
    former = next((_made(bench, key) for key in last if key != answer.key), None)
    status = None if job is None else bench.jobs.status(job)
    message = (
        bench.jobs.text(job, "err") if job is not None and status is not None and status.state in _ENDED else ""
    )
    response = render(
        request, "answer.html.jinja", entry=entry, answer=answer, job=job, status=status, message=message, former=former,
        rows=[] if answer.calibration is None else answer.rows(former), query=text,
        terms=[
            (term, meaning_of(term), term in terms)
            for term in dict.fromkeys((*TERMS, *terms))
            if run_file.unit == GYRO or not turns(term)
        ],
        usual=set(terms) == set(run_file.model.terms), output_unit=shown_output,
        seen=bench.history.seen(bench.folder.text(name)), mark=_mark(entry),
    )  # fmt: skip
    if asked:
        response.headers["hx-push-url"] = f"/record/{quote(name)}?{urlencode({'terms': text})}"
    return response


def _no_answer(request: Request, entry: Entry, text: str, waits: str) -> Response:
    """The answer before its fit can begin, and what it waits for. The page asks again."""
    values: dict[str, Any] = {"entry": entry, "answer": None, "status": None, "message": "", "query": text}
    return render(request, "answer.html.jinja", waits=waits, **values)


def _mark(entry: Entry) -> str:
    """What the newest kept result of a record is; it tells whether another tab kept one meanwhile."""
    return f"{entry.kept[0].created} {entry.kept[0].K!r} {len(entry.kept)}" if entry.kept else "none"


def keep(request: Request, fields: dict[str, list[str]]) -> Response:
    """Keep an answer: its files go where the command writes them. An older result becomes a version of its own."""
    bench, name, key = bench_of(request), request.path_params["name"], only(fields, "key")
    answer = _made(bench, key) if re.fullmatch(KEY, key) else None
    if answer is None or answer.calibration is None or key not in bench.answers.get(name, ()):
        raise CalibrationError("this answer is not there any more", remedy="reload the page")
    judged = light(answer.calibration)
    if not judged.may_keep:
        raise CalibrationError(f"this result cannot be kept: {judged.reason}", remedy="settle this first")
    with bench.history.lock:
        entry = bench.folder.entry(name)
        if _mark(entry) != only(fields, "mark"):
            newest = (
                f"+ kept: K = {rounded(entry.kept[0].K, entry.kept[0].u).value} {entry.kept[0].unit}"
                if entry.kept
                else "- discarded"
            )
            raise ChangedError(f"the kept results of {name}", [newest], _mark(entry))
        target = bench.folder.path(bench.folder.name(results_of(bench.folder.toml(name))))
        former = None
        if target.exists():
            number = 1 + max(
                (int(one.name.rpartition("-v")[2]) for one in entry.kept if one.version), default=0
            )
            former = bench.folder.path(bench.folder.name(target.with_name(f"{target.name}-v{number}")))
            target.rename(former)
        part = bench.folder.state_room("parts") / key
        shutil.copytree(answer.place, part, dirs_exist_ok=True)
        part.rename(target)
        K, u, _ = answer.K
        bench.history.note(f"keep K = {rounded(K, u).value} {answer.calibration.unit}/g", (target, former))
    return redirect(request, f"/record/{quote(name)}{_query(only(fields, 'query'))}")


# --- kept results ---------------------------------------------------------------------------------


def kept_of(bench: Bench, name: str) -> Kept:
    """A kept calibration by its folder."""
    kept = bench.folder.kept(bench.folder.path(name))
    if kept is None:
        raise OutsideError(f"{name[:200]}: holds no calibration that can be read", remedy="choose a listed one")
    return kept


def _show_kept(request: Request) -> Response:
    """A kept calibration: its report and files."""
    bench, name = bench_of(request), request.path_params["name"]
    kept = kept_of(bench, name)
    shown = left(bench)
    entry = next((one for one in bench.folder.entries() if name in [k.name for k in one.kept]), None)
    names = [path.name for path in bench.folder.files() if bench.folder.name(path.parent) == name]
    values = left(bench, entry.name) if entry is not None else shown
    return render(request, "kept.html.jinja", **values, one=kept, entry=entry, files=names)


def _kept_file(request: Request) -> Response:
    """A file of a kept calibration."""
    bench = bench_of(request)
    kept = kept_of(bench, request.path_params["name"])
    return result_file(bench, bench.folder.file(f"{kept.name}/{request.path_params['file']}"))


def _trial_report(request: Request) -> Response:
    """The report of an answer."""
    bench, key = bench_of(request), request.path_params["key"]
    if not re.fullmatch(KEY, key):
        raise OutsideError("there is no such answer", remedy="reload the page of the record")
    return result_file(bench, bench.folder.state_room("trials") / key / "report.html")


def discard(request: Request) -> Response:
    """Remove a kept calibration; Undo brings it back."""
    bench, name = bench_of(request), request.path_params["name"]
    with bench.history.lock:
        kept = kept_of(bench, name)
        path = bench.folder.path(kept.name)
        bench.history.note(f"discard K = {rounded(kept.K, kept.u).value}", (path, bench.history.put_away(path)))
    return redirect(request, "/")


def undo(request: Request) -> Response:
    """Take the last change back."""
    bench = bench_of(request)
    bench.history.undo()
    path = "/" + request.headers.get("referer", "").partition("//")[2].partition("/")[2]
    return redirect(request, path if path.startswith("/record/") else "/")


def compare(request: Request) -> Response:
    """Two kept calibrations side by side."""
    bench = bench_of(request)
    names = list(dict.fromkeys(request.query_params.getlist("of")))[:2]
    if len(names) != 2:
        raise ArgumentError("two results are needed", remedy="tick two kept results at the left")
    pair = [kept_of(bench, name) for name in names]
    both = [Calibration.from_json(bench.folder.file(f"{one.name}/{CALIBRATION}")) for one in pair]
    table = []
    for key in dict.fromkeys(one.key for calibration in both for one in calibration.coefficients):
        coefficients = [
            next((c for c in calibration.coefficients if c.key == key), None) for calibration in both
        ]
        one, other = coefficients
        factor, unit = shown_unit(key, next(c.unit for c in coefficients if c is not None))
        row: dict[str, Any] = {
            "key": key,
            "unit": unit,
            "cells": [None if c is None else (factor * c.value, factor * c.std) for c in coefficients],
        }
        if one is not None and other is not None:
            u = float(np.hypot(one.std, other.std))
            row |= {
                "difference": factor * (other.value - one.value),
                "u": factor * u,
                "ratio": abs(other.value - one.value) / u if u else 0.0,
            }
        table.append(row)
    lights = [light(calibration) for calibration in both]
    return render(request, "compare.html.jinja", **left(bench), pair=pair, table=table, lights=lights)


ROUTES = [
    Route("/", home),
    Route("/try", try_shipped, methods=["POST"]),
    Route("/upload", take, methods=["POST"]),
    Route("/tag", posted(tag), methods=["POST"]),
    Route("/undo", undo, methods=["POST"]),
    Route("/record/{name:path}", show, methods=["GET"]),
    Route("/record/{name:path}", posted(change), methods=["POST"]),
    Route("/picture/{name:path}", _show_picture),
    Route("/signal-data/{name:path}", data),
    Route("/answer/{name:path}", _show_answer),
    Route("/keep/{name:path}", posted(keep), methods=["POST"]),
    Route("/trial/{key:str}/report.html", _trial_report),
    Route("/compare", compare),
    Route("/kept/{name:path}/file/{file}", _kept_file),
    Route("/kept/{name:path}/discard", discard, methods=["POST"]),
    Route("/kept/{name:path}", _show_kept),
]
