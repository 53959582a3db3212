"""The bench of one instrument: its records and kept calibrations, a record as a picture, the answer beside it."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import secrets
import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote, urlencode

import msgspec
import numpy as np
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from piga.data import copy_example
from piga.errors import ArgumentError, CalibrationError, PigaError
from piga.output import put_in_place, write_whole
from piga.records.calibration import Calibration
from piga.records.run_file import read_run_file
from piga.records.terms import GYRO, UNITS, check_terms, meaning_of, shown_output, shown_unit, turns
from piga.records.text_files import files_named_in
from piga.reports.render.numbers import rounded
from piga.workbench.folder import (
    CALIBRATION,
    STATE_FOLDER,
    ChangedError,
    Entry,
    Kept,
    OutsideError,
    results_of,
)
from piga.workbench.jobs import BusyError, Job
from piga.workbench.pages.common import (
    Bench,
    Sent,
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
_SMALL = 20_000_000
"""Size of a log [bytes] up to which a faulty run file is answered with lines that repair it. They are tried on the log."""
_ALWAYS = "scale_factor"
_TERMS = tuple(term for term in UNITS if term not in ("phi", "k1"))
"""Terms that have a box of their own."""
_MOST_TAGS = 2000
_ENDED = ("failed", "stopped")
_KEY = r"[0-9a-f]{16}"
"""Names of answers."""


# --- the left side --------------------------------------------------------------------------------


def _tags_of(bench: Bench) -> dict[str, list[str]]:
    """The tags of records."""
    with contextlib.suppress(PigaError, msgspec.MsgspecError):
        raw = bench.folder.read(bench.folder.state_room() / "tags.json", 1 << 20)
        return msgspec.json.decode(raw, type=dict[str, list[str]])
    return {}


def left(bench: Bench, name: str = "") -> dict[str, Any]:
    """Records and calibrations of the instrument that a page is about."""
    entries = bench.folder.entries()
    firsts = {entry.serial: entry.name for entry in entries if entry.serial}
    here = next((entry.serial for entry in entries if entry.name == name), "")
    serial = here or next((entry.serial for entry in entries if entry.serial), "")
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
    places = ((one, 8.0 + 84.0 * (index + 0.5) / len(kept)) for index, one in enumerate(kept))
    return [
        {"kept": one, "x": x, "y": 85.0 - scale * (one.ppm - low), "u": scale * one.u_ppm} for one, x in places
    ]


def _home(request: Request) -> Response:
    """The first screen, or the newest record."""
    entries = left(bench_of(request))["entries"]
    if not entries:
        return render(request, "first.html.jinja")
    return redirect(request, _address_of(next((e for e in entries if e.state != "log"), entries[0])))


def _address_of(entry: Entry) -> str:
    """The page of a record or log."""
    return f"/{'log' if entry.state == 'log' else 'record'}/{quote(entry.name)}"


def _try_shipped(request: Request) -> Response:
    """Copy the shipped record into the folder."""
    folder = bench_of(request).folder
    with tempfile.TemporaryDirectory(dir=folder.state_room("parts")) as part:
        run = copy_example(Path(part))
        for path in (run.with_suffix(".csv"), run):
            with contextlib.suppress(FileExistsError):
                put_in_place(path, folder.path(path.name), replace=False)
    return redirect(request, f"/record/{run.name}")


async def _take(request: Request) -> Response:
    """A file that was dropped in. Its bytes are the body; its name is in the address."""
    folder = bench_of(request).folder
    target = folder.free_name(request.query_params.get("name", ""))
    words = f"{target.name}: is larger than {MOST_UPLOAD >> 30} GiB"
    too_large = TooLargeError(words, remedy="copy it into the folder")
    if int(request.headers.get("content-length", "0")) > MOST_UPLOAD:
        raise too_large
    part = folder.state_room("parts") / secrets.token_hex(8)
    try:
        with part.open("xb") as stream:
            async for piece in request.stream():
                stream.write(piece)
                if stream.tell() > MOST_UPLOAD:
                    raise too_large
        await run_in_threadpool(put_in_place, part, target, replace=False)
    finally:
        part.unlink(missing_ok=True)
    name = folder.name(target)
    kind = "record" if target.suffix == ".toml" else "log"
    return JSONResponse({"name": name, "address": f"/{kind}/{quote(name)}"})


def _tag(request: Request, sent: Sent) -> Response:
    """Set the tags of a record."""
    bench = bench_of(request)
    name, words = only(sent, "name"), only(sent, "tags").replace(",", " ").split()
    bench.folder.path(name)
    with bench.history.lock:
        tags = _tags_of(bench) | {name: [word[:30] for word in words[:8]]}
        raw = msgspec.json.encode(dict(list(tags.items())[-_MOST_TAGS:]))
        write_whole(bench.folder.state_room() / "tags.json", lambda part: part.write_bytes(raw))
    return redirect(request, f"/record/{quote(name)}")


# --- the picture ----------------------------------------------------------------------------------


def _cache_of(bench: Bench, name: str) -> Path:
    """Folder of the envelopes of a record, whether they exist or not."""
    record = hashlib.sha256(name.encode()).hexdigest()[:12]
    return bench.folder.state_room("signals") / f"{record}-{cache_key(files_named_in(bench.folder.toml(name)))}"


def _reading(bench: Bench, name: str, *, again: bool = False) -> tuple[Outline | None, Job | None]:
    """The outline of a record. If it is not read yet: the job that reads it, or that failed."""
    cache = _cache_of(bench, name)
    mark = f"signals/{cache.name}"
    last = bench.jobs.latest(name, mark)
    state = last.state if last else ""
    outline = read_outline(cache)  # after the state: the job may end meanwhile
    if outline is not None:
        return outline, None
    if last is not None and (state == "running" or (state in _ENDED and not again)):
        return None, last
    return None, bench.jobs.start(("envelopes", name, str(cache)), "Read the record", name, mark)


def _show(request: Request) -> Response:
    """The page of a record."""
    bench, name = bench_of(request), request.path_params["name"]
    entry = bench.folder.entry(name)
    if entry.state == "log":
        return redirect(request, _address_of(entry))
    values = left(bench, name) | {"query": request.url.query}
    return render(request, "record.html.jinja", **values, **_picture(request, entry))


def _show_picture(request: Request) -> Response:
    """The picture alone; the page asks for it while the record is read."""
    entry = bench_of(request).folder.entry(request.path_params["name"])
    return render(request, "picture.html.jinja", **_picture(request, entry))


_DRAWN = ("signals", "duration", "positions", "left_out", "moves", "findings")
"""Parts of an outline that the script draws."""


def _picture(request: Request, entry: Entry) -> dict[str, Any]:
    """What the picture shows: the outline, the job that reads the record, what it waits for, or why it cannot be read."""
    bench = bench_of(request)
    values: dict[str, Any] = {"entry": entry, "outline": None, "job": None, "message": "", "repairs": []}
    values |= {"waits": "", "seen": ""}
    with contextlib.suppress(PigaError):
        values["seen"] = bench.history.seen(bench.folder.text(entry.name))
    if entry.state == "faulty":
        return values | {"message": entry.message, "repairs": _repairs(bench, entry)}
    try:
        outline, job = _reading(bench, entry.name, again="again" in request.query_params)
    except BusyError as error:
        return values | {"waits": error.message}
    if outline is not None:
        drawn = {key: value for key, value in msgspec.to_builtins(outline).items() if key in _DRAWN}
        drawn["findings"] = [one.time for one in outline.findings if one.time]
        return values | {"outline": outline, "drawn": json.dumps(drawn)}
    if job is None or job.state not in _ENDED:
        return values | {"job": job}
    message = job.text("err").removeprefix("piga: ") or "The reading was stopped."
    return values | {"message": message, "repairs": _repairs(bench, entry)}


def _repairs(bench: Bench, entry: Entry) -> list[Any]:
    """Lines that repair a run file; each was tried on the log."""
    from piga.describe.run_file import suggestions

    with contextlib.suppress(PigaError, OSError):
        return suggestions(bench.folder.toml(entry.name)) if entry.size <= _SMALL else []
    return []


def _data(request: Request) -> Response:
    """Rows of time, then least and largest value of each asked signal, as 64-bit floats."""
    cache, query = _cache_of(bench_of(request), request.path_params["name"]), request.query_params
    try:
        span = float(query["from"]), float(query["to"]), int(query["width"])
    except (KeyError, ValueError):
        raise ArgumentError("the span of the picture is not valid", remedy="reload the page") from None
    try:
        table = picture(cache, query.get("keys", "").split(","), *span)
    except (ArgumentError, OSError):
        if read_outline(cache) is None:  # the record was changed; the page asks for its picture again
            return Response(status_code=204)
        raise
    headers = {"x-columns": str(table.shape[1])}
    return Response(table.astype("<f8").tobytes(), media_type="application/octet-stream", headers=headers)


# --- what is said of a record ---------------------------------------------------------------------


def _change(request: Request, sent: Sent) -> Response:
    """Answer a question about a record: leave rows out, use them again, or set a key of its run file."""
    import tomlkit
    from tomlkit.exceptions import TOMLKitError

    bench, name = bench_of(request), request.path_params["name"]
    changes = {"set": _set, "again": _use_again, "leave": _leave_out, "moves": _leave_out}
    change = changes.get(only(sent, "do"))
    if change is None:
        raise ArgumentError(
            f"{only(sent, 'do')[:40]!r}: is not a command of this page", remedy="use its buttons"
        )
    try:
        document = tomlkit.parse(bench.folder.text(name))
        words = change(bench, name, document, sent)
        text = tomlkit.dumps(document)
    except PigaError:
        raise
    except (TOMLKitError, ValueError, TypeError, AttributeError, KeyError):
        raise ArgumentError(f"{name}: this cannot be put into the file", remedy="change it as text") from None
    bench.history.write(name, only(sent, "seen"), text, words)
    return redirect(request, f"/record/{quote(name)}{_query(sent)}")


def _query(sent: Sent) -> str:
    """The terms that the page showed, for its address."""
    text = only(sent, "query")
    return f"?{text}" if re.fullmatch(r"terms=[\w%,.+]*", text) else ""


def _set(_bench: Bench, _name: str, document: Any, sent: Sent) -> str:
    import tomlkit

    place, _, key = only(sent, "key").partition(".")
    document.setdefault(place, tomlkit.table())[key] = tomlkit.value(only(sent, "value"))
    return f"set {key} = {only(sent, 'value')}"


def _use_again(_bench: Bench, _name: str, document: Any, sent: Sent) -> str:
    entries, index = document.get("data", {}).get("leave_out", []), only(sent, "index")
    if not index.isdigit() or int(index) >= len(entries):
        raise ArgumentError("these rows are used already", remedy="reload the page")
    reason = entries[int(index)]["reason"]
    del entries[int(index)]
    return f"use again: {reason}"


def _leave_out(bench: Bench, name: str, document: Any, sent: Sent) -> str:
    import tomlkit

    cache = _cache_of(bench, name)
    outline = read_outline(cache)
    if outline is None:
        raise ArgumentError(f"{name}: is not read yet", remedy="reload the page")
    if only(sent, "do") == "moves":
        spans, reason = [one.rows for one in outline.moves], "the stand moves"
    else:
        try:
            first, last = (float(only(sent, end).replace(",", ".")) for end in ("from", "to"))
        except ValueError:
            raise ArgumentError("the marked span is not valid", remedy="mark it again") from None
        reason = " ".join(only(sent, "reason").split())
        if not reason:
            raise ArgumentError("a reason is needed", remedy="say why these rows are left out")
        spans = [rows_between(cache, first, last)]
    if sum(last - first + 1 for first, last in spans) >= outline.rows:
        raise ArgumentError("these are all rows of the record", remedy="mark a part of it")
    table = document["data"]
    entries = table.setdefault("leave_out", tomlkit.array())
    for rows in spans:
        entry = tomlkit.inline_table()
        entry.update({"rows": list(rows), "reason": reason})
        entries.append(entry)
    entries.multiline(multiline=True)
    return f"leave out {len(spans)} spans: {reason}" if len(spans) > 1 else f"leave out: {reason}"


# --- the answer -----------------------------------------------------------------------------------

_LIGHTS = {"clear": ("green", "Clear"), "doubt": ("amber", "Doubt"), "do not use": ("red", "Do not use")}
"""Colour and words of each grade."""


class Light(NamedTuple):
    """``grade`` (green, amber or red) and its words: what to do, the reason, and the other doubts."""

    grade: str
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
class _Answer:
    """A calibration that is not kept: its folder; if it is done, the calibration and its K. ``every``: thinned by so much."""

    key: str
    place: Path
    every: int = 1
    calibration: Calibration | None = None
    kept: Kept | None = None

    @property
    def light(self) -> Light | None:
        """The light of the calibration."""
        return None if self.calibration is None else light(self.calibration)

    def rows(self, former: _Answer | None) -> list[dict[str, Any]]:
        """The coefficients in the units of every page, with those of the former answer."""
        calibrations = [one and one.calibration for one in (self, former)]
        now, before = ({c.key: c for c in one.coefficients} if one else {} for one in calibrations)
        rows = []
        for key, one in list(now.items())[:60]:
            factor, unit = shown_unit(one.name, one.unit)
            value, u, was = factor * one.value, factor * one.std, factor * before.get(key, one).value
            ghost = "" if was == value else rounded(was, u).value
            rows.append({"key": key, "value": value, "u": u, "unit": unit, "was": ghost})
        return rows


def _made(bench: Bench, key: str, every: int = 1) -> _Answer:
    """An answer, with its calibration if it is done."""
    place = bench.folder.state_room("trials") / key
    with contextlib.suppress(PigaError, OSError):
        return _Answer(key, place, every, Calibration.from_json(place / CALIBRATION), bench.folder.kept(place))
    return _Answer(key, place, every)


def _answer(bench: Bench, name: str, terms: tuple[str, ...], outline: Outline) -> tuple[_Answer, Job | None]:
    """The best answer so far, and the job of a better one."""
    state = f"{cache_key(files_named_in(bench.folder.toml(name)))} {name} {' '.join(terms)}"
    key = hashlib.sha256(state.encode()).hexdigest()[:16]
    answer = _made(bench, key)
    if answer.calibration is not None:
        return answer, None
    if outline.thinned > 1:  # the thinned record alone first: both at once would take longer
        early = f"{key}-first"
        answer = _made(bench, early, outline.thinned)
        if answer.calibration is None:
            thinned = bench.folder.name(_cache_of(bench, name) / "thinned.toml")
            job = _fit(bench, name, thinned, early, terms, "--no-report")
            if job.state in ("running", "stopped"):
                return replace(answer, key=key), job
            answer = _made(bench, early, outline.thinned)
    return replace(answer, key=key), _fit(bench, name, name, key, terms)


def _fit(bench: Bench, name: str, run: str, key: str, terms: tuple[str, ...], *options: str) -> Job:
    """The job of an answer. Answers for other terms that nobody waits for any more are stopped."""
    place = f"{STATE_FOLDER}/trials/{key}"
    last = bench.jobs.latest(name, place)
    if last is not None:
        return last
    bench.jobs.stop(*(job for job in _fits(bench, name) if key[:16] not in job.result), patience=0.0)
    command = ("calibrate", run, "--terms", ",".join(terms), "--out", place, *options)
    return bench.jobs.start(command, "Fit", name, place)


def _fits(bench: Bench, name: str) -> list[Job]:
    return [job for job in bench.jobs.all() if (job.subject, job.title) == (name, "Fit")]


def _show_answer(request: Request) -> Response:
    """The answer for a choice of terms. The page asks again while a better one is computed."""
    bench, name, query = bench_of(request), request.path_params["name"], request.query_params
    entry = bench.folder.entry(name)
    ticked = query.getlist("term")
    text = ",".join(ticked) or query.get("terms", "")
    values: dict[str, Any] = {
        "entry": entry,
        "answer": None,
        "state": "",
        "message": "",
        "waits": "",
        "query": text,
    }
    if entry.state in ("faulty", "log"):
        return render(request, "answer.html.jinja", **values)
    for old in _fits(bench, name) if ticked or "again" in query else ():  # what was stopped is asked for again
        bench.jobs.forget(old)
    try:
        outline, _ = _reading(bench, name)
        if outline is None:
            return render(request, "answer.html.jinja", **values)
        run_file = read_run_file(bench.folder.toml(name))
        terms = tuple(term for term in text.split(",") if term) or run_file.model.terms
        if ticked:
            terms = tuple(dict.fromkeys((_ALWAYS, *terms)))
        check_terms(terms, output=run_file.unit)
        answer, job = _answer(bench, name, terms, outline)
    except BusyError as error:  # the page asks again
        return render(request, "answer.html.jinja", **values | {"waits": error.message})
    last = bench.answers.setdefault(name, [])
    if answer.calibration is not None and answer.key not in last[:1]:
        bench.answers[name] = last = [answer.key, *last][:2]
    former = next((_made(bench, key) for key in last if key != answer.key), None)
    values["state"] = job.state if job else ""
    if job and values["state"] in _ENDED:
        values["message"] = job.text("err") or "The fit was stopped."
    boxes = [one for one in dict.fromkeys((*_TERMS, *terms)) if run_file.unit == GYRO or not turns(one)]
    values |= {"answer": answer, "query": ",".join(terms), "job": job, "mark": _mark(entry)}
    response = render(
        request,
        "answer.html.jinja",
        **values,
        rows=answer.rows(former),
        output_unit=shown_output,
        terms=[(one, meaning_of(one), one in terms) for one in boxes],
        usual=set(terms) == set(run_file.model.terms),
        seen=bench.history.seen(bench.folder.text(name)),
    )
    if ticked:
        response.headers["hx-push-url"] = f"/record/{quote(name)}?{urlencode({'terms': values['query']})}"
    return response


# --- kept results ---------------------------------------------------------------------------------


def _mark(entry: Entry) -> str:
    """What the newest kept result of a record is; it tells whether another tab kept one meanwhile."""
    return f"{entry.kept[0].created} {entry.kept[0].K!r} {len(entry.kept)}" if entry.kept else "none"


def _in_words(kept: Kept) -> str:
    return f"K = {rounded(kept.K, kept.u).value} {kept.unit}"


def _keep(request: Request, sent: Sent) -> Response:
    """Keep an answer: its files go where the command writes them. An older result becomes a version of its own."""
    bench, name, key = bench_of(request), request.path_params["name"], only(sent, "key")
    answer = _made(bench, key) if re.fullmatch(_KEY, key) and key in bench.answers.get(name, ()) else None
    if answer is None or answer.calibration is None or answer.kept is None:
        raise CalibrationError("this answer is not there any more", remedy="reload the page")
    judged = light(answer.calibration)
    if not judged.may_keep:
        raise CalibrationError(f"this result cannot be kept: {judged.reason}", remedy="settle this first")
    with bench.history.lock:
        entry = bench.folder.entry(name)
        if _mark(entry) != only(sent, "mark"):
            words = f"+ kept: {_in_words(entry.kept[0])}" if entry.kept else "- discarded"
            raise ChangedError(f"the kept results of {name}", [words])
        target = bench.folder.path(bench.folder.name(results_of(bench.folder.toml(name))))
        former = None
        if target.exists():
            number = 1 + max((-one.version for one in entry.kept), default=0)
            older = target.with_name(f"{target.name}-v{number}")
            former = target.rename(bench.folder.path(bench.folder.name(older)))
        part = bench.folder.state_room("parts") / key
        shutil.copytree(answer.place, part, dirs_exist_ok=True)
        part.rename(target)
        bench.history.note(f"keep {_in_words(answer.kept)}", (target, former))
    return redirect(request, f"/record/{quote(name)}{_query(sent)}")


def kept_of(bench: Bench, name: str) -> Kept:
    """A kept calibration by its folder."""
    kept = bench.folder.kept(bench.folder.path(name))
    if kept is None:
        raise OutsideError(f"{name[:200]}: holds no calibration that can be read", remedy="choose a listed one")
    return kept


def _show_kept(request: Request) -> Response:
    """A kept calibration: its report and files."""
    bench, name = bench_of(request), request.path_params["name"]
    kept, entries = kept_of(bench, name), bench.folder.entries()
    entry = next((one for one in entries if kept in one.kept), None)
    names = [path.name for path in bench.folder.files() if bench.folder.name(path.parent) == name]
    values = left(bench, entry.name if entry else "")
    return render(request, "kept.html.jinja", **values, one=kept, entry=entry, files=names)


def _kept_file(request: Request) -> Response:
    """A file of a kept calibration."""
    bench = bench_of(request)
    kept = kept_of(bench, request.path_params["name"])
    return result_file(bench, bench.folder.file(f"{kept.name}/{request.path_params['file']}"))


def _trial_report(request: Request) -> Response:
    """The report of an answer."""
    bench, key = bench_of(request), request.path_params["key"]
    if not re.fullmatch(_KEY, key):
        raise OutsideError("there is no such answer", remedy="reload the page of the record")
    return result_file(bench, bench.folder.state_room("trials") / key / "report.html")


def _discard(request: Request) -> Response:
    """Remove a kept calibration; Undo brings it back."""
    bench = bench_of(request)
    with bench.history.lock:
        kept = kept_of(bench, request.path_params["name"])
        path = bench.folder.path(kept.name)
        bench.history.note(f"discard {_in_words(kept)}", (path, bench.history.put_away(path)))
    return redirect(request, "/")


def _undo(request: Request) -> Response:
    """Take the last change back."""
    bench_of(request).history.undo()
    path = "/" + request.headers.get("referer", "").partition("//")[2].partition("/")[2]
    return redirect(request, path if path.startswith("/record/") else "/")


def _compare(request: Request) -> Response:
    """Two kept calibrations side by side."""
    bench = bench_of(request)
    names = list(dict.fromkeys(request.query_params.getlist("of")))[:2]
    if len(names) != 2:
        raise ArgumentError("two results are needed", remedy="tick two kept results at the left")
    pair = [kept_of(bench, name) for name in names]
    both = [Calibration.from_json(bench.folder.file(f"{one.name}/{CALIBRATION}")) for one in pair]
    one, other = ({c.key: c for c in calibration.coefficients} for calibration in both)
    table = []
    for key in dict.fromkeys((*one, *other)):
        there = [c[key] for c in (one, other) if key in c]
        factor, unit = shown_unit(key, there[0].unit)
        row: dict[str, Any] = {"key": key, "unit": unit}
        row["cells"] = [
            (factor * c[key].value, factor * c[key].std) if key in c else None for c in (one, other)
        ]
        if len(there) == 2:
            (first, u), (second, v) = row["cells"]
            row |= {"difference": second - first, "u": float(np.hypot(u, v))}
        table.append(row)
    lights = [light(calibration) for calibration in both]
    return render(request, "compare.html.jinja", **left(bench), pair=pair, table=table, lights=lights)


ROUTES = [
    Route("/", _home),
    Route("/try", _try_shipped, methods=["POST"]),
    Route("/upload", _take, methods=["POST"]),
    Route("/tag", posted(_tag), methods=["POST"]),
    Route("/undo", _undo, methods=["POST"]),
    Route("/record/{name:path}", _show, methods=["GET"]),
    Route("/record/{name:path}", posted(_change), methods=["POST"]),
    Route("/picture/{name:path}", _show_picture),
    Route("/signal-data/{name:path}", _data),
    Route("/answer/{name:path}", _show_answer),
    Route("/keep/{name:path}", posted(_keep), methods=["POST"]),
    Route("/trial/{key:str}/report.html", _trial_report),
    Route("/compare", _compare),
    Route("/kept/{name:path}/file/{file}", _kept_file),
    Route("/kept/{name:path}/discard", _discard, methods=["POST"]),
    Route("/kept/{name:path}", _show_kept),
]
