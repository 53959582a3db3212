"""What comes after a calibration: certificate, compensation, the plan of the next test, ledger, trend.

Also any TOML file as text with the commands that run it, and jobs: how far they are, what they printed and wrote; stop one.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import secrets
import shlex
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from piga.data import example_files
from piga.describe.draft import places_of
from piga.errors import ArgumentError, PigaError
from piga.records.text_files import files_named_in, toml_document
from piga.workbench.folder import CALIBRATION, STATE_FOLDER, ChangedError, Kept, OutsideError, results_of
from piga.workbench.jobs import Job
from piga.workbench.pages.common import (
    Bench,
    Field,
    Sent,
    bench_of,
    in_line,
    is_part,
    only,
    posted,
    redirect,
    render,
    result_file,
    start,
)
from piga.workbench.pages.record import kept_of, left

CERTIFICATE = "certificate.toml"
"""File of the laboratory's own entries."""
_LARGEST_PEM = 1 << 20
_STORES = (".sqlite", ".db")
"""Endings of ledgers."""
_USUAL = (
    "calibration.place", "method.deviations", "method.sampling", "method.external_results", "adjustment.performed",
    "item.description",
)  # fmt: skip
"""Entries of the example that any laboratory may have, too."""
_TABLES = ("environment", "traceability.standard")
"""Lists of tables; they are typed as text."""
_PLAN = "plan-dividing-head.toml"
"""Example that a plan begins with. Plans for other stands are written as text."""


def _plain(name: str) -> str:
    """The letters and digits of a name, for a folder."""
    text = "".join(letter if letter.isalnum() else "-" for letter in name).strip("-")
    return text.encode()[:80].decode("utf-8", "ignore") or "instrument"


# --- certificate ----------------------------------------------------------------------------------


def _example() -> dict[str, Any]:
    return toml_document(Path(CERTIFICATE), example_files()[CERTIFICATE])


def _entries(document: dict[str, Any], path: str = "") -> dict[str, Any]:
    """Single entries by ``table.key``; a list of tables is one entry, as text."""
    import tomlkit

    result: dict[str, Any] = {}
    for name, value in document.items():
        key = f"{path}{name}"
        if isinstance(value, dict):
            result |= _entries(value, f"{key}.")
        elif key in _TABLES:
            table, _, inner = key.rpartition(".")
            text = tomlkit.dumps({table: {inner: value}} if table else {inner: value})
            result[key] = text.replace(f"[{table}]\n", "")
        else:
            result[key] = value
    return result


def _shown(value: Any) -> str:
    """An entry as it is typed."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "; ".join(map(str, value)) if isinstance(value, list) else str(value)


def _typed(key: str, text: str, example: Any) -> Any:
    """A typed entry in the type of the example."""
    if key in _TABLES:
        document: Any = toml_document(Path(CERTIFICATE), text.encode())
        if list(_entries(document)) != [key]:
            raise ArgumentError(f"is not [[{key}]] alone", remedy=f"write tables that begin with [[{key}]]")
        for name in key.split("."):
            document = document[name]
        return document
    if isinstance(example, bool):
        return text.lower() in ("yes", "true", "1")
    if isinstance(example, dt.date):
        try:
            return dt.date.fromisoformat(text)
        except ValueError:
            raise ArgumentError("is not a date", remedy="write year-month-day, e.g. 2026-03-04") from None
    return [part.strip() for part in text.split(";") if part.strip()] if isinstance(example, list) else text


def _own(bench: Bench, kept: Kept | None) -> dict[str, str]:
    """What is known already: the laboratory's own entries, and those of the calibration."""
    example, mine = _entries(_example()), {}
    with contextlib.suppress(PigaError):
        mine = _entries(toml_document(Path(CERTIFICATE), bench.folder.text(CERTIFICATE).encode()))
    own = {key: example[key] for key in _USUAL if key in example}
    own |= {key: value for key, value in mine.items() if key in _USUAL or value != example.get(key)}
    entries = {key: _shown(value) for key, value in own.items()}
    if kept is not None:
        entries |= {"item.serial": kept.serial, "calibration.end": kept.created[:10]}
    if not entries.get("certificate.number") or _is_used(bench, entries["certificate.number"]):
        entries["certificate.number"] = _next_number(bench)
    return entries


def _is_used(bench: Bench, number: str) -> bool:
    return (bench.folder.root / f"certificate-{_plain(number)}").exists()


def _next_number(bench: Bench) -> str:
    year = time.strftime("%Y")
    return next(one for one in (f"{year}-{count:04d}" for count in range(1, 10000)) if not _is_used(bench, one))


def _items(bench: Bench, values: dict[str, str]) -> list[Field]:
    """The entries of a certificate with the laboratory's own values, and why one is refused."""
    notes = {place.path: place.words.sentence for place in places_of("certificate")}
    items = []
    for key, example in _entries(_example()).items():
        value, refusal = values.get(key, "").strip(), ""
        try:
            _ = value and _typed(key, value, example)
        except PigaError as error:
            refusal = in_line(error)
        if key == "certificate.number" and value and _is_used(bench, value):
            refusal = f"this number was used; the next free one is {_next_number(bench)}"
        note = notes.get(key, key) + (" Separate several by semicolons." if isinstance(example, list) else "")
        words = key.partition(".")[2].replace("_", " ").replace(".", ", ") or key
        rows = 7 if key in _TABLES else 0
        items.append(Field(key, words, _shown(example), note, value, refusal=refusal, rows=rows))
    return items


def _document(values: dict[str, str], *, whole: bool) -> str:
    """The certificate file. ``whole``: with the example's entries where there are no own ones, for a draft."""
    import tomlkit

    document: dict[str, Any] = {}
    for key, example in _entries(_example()).items():
        text = values.get(key, "").strip()
        if text or whole:
            *path, last = key.split(".")
            table = document
            for part in path:
                table = table.setdefault(part, {})
            table[last] = _typed(key, text or example, example) if text or key in _TABLES else example
    return str(tomlkit.dumps(document))


def _certificate(
    request: Request, values: dict[str, str] | None = None, of: str = "", message: str = ""
) -> Response:
    """The form of a certificate: as it was sent, or filled from the calibration and from the laboratory's own entries."""
    bench, of = bench_of(request), of or request.query_params.get("of", "")
    kept = kept_of(bench, of) if of else None
    seen = ""
    with contextlib.suppress(PigaError):
        seen = bench.history.seen(bench.folder.text(CERTIFICATE))
    keys, x509 = _pem_files(bench)
    drafts = (job for job in bench.jobs.all() if (job.title, job.subject) == ("DRAFT certificate", of))
    return render(
        request, "certificate.html.jinja", 422 if message else 200, **left(bench), one=kept, message=message, seen=seen,
        items=_items(bench, _own(bench, kept) if values is None else values), keys=keys, x509=x509,
        signed=bench.folder.listed(".xml"), draft=next(drafts, None),
    )  # fmt: skip


def _issue(request: Request, sent: Sent) -> Response:
    """Save the laboratory's entries; show a draft, or issue the certificate if nothing is missing."""
    bench = bench_of(request)
    kept = kept_of(bench, only(sent, "of"))
    values = {key.removeprefix("c:"): typed[-1] for key, typed in sent.items() if key.startswith("c:")}
    items, is_draft = _items(bench, values), only(sent, "do") != "issue"
    if any(item.refusal or not (item.typed or is_draft) for item in items):
        words = "Some entries are missing or cannot be used; each says why."
        return _certificate(request, values, kept.name, words)
    text = _document(values, whole=False)
    bench.history.write(CERTIFICATE, only(sent, "seen"), text, "certificate entries", "any")
    out, source, title = f"certificate-{_plain(values['certificate.number'])}", CERTIFICATE, "Certificate"
    if is_draft:
        place = bench.folder.state_room("trials") / secrets.token_hex(8)
        data = place.with_suffix(".toml")
        data.write_text(_document(values, whole=True), encoding="utf-8")
        out, source, title = bench.folder.name(place), bench.folder.name(data), "DRAFT certificate"
    else:
        bench.folder.path(out)
    command = ["certificate", "issue", f"{kept.name}/{CALIBRATION}", "--data", source, "--out", out]
    command += ["--dcc"] if only(sent, "dcc") else []
    for option in ("key", "certificate"):
        if only(sent, option):
            command.append(f"--{option}={bench.folder.name(bench.folder.file(only(sent, option)))}")
    job = bench.jobs.start(command, title, kept.name, out)
    return redirect(request, f"/jobs/{job.key}")


def _pem_files(bench: Bench) -> tuple[list[str], list[str]]:
    """Files of the folder that hold a private key, and those that hold an X.509 certificate. One may hold both."""
    keys, certificates = [], []
    for name in bench.folder.listed(".pem", ".crt", ".cer"):
        text = b""
        with contextlib.suppress(PigaError):  # others cannot read the key of a careful person
            text = bench.folder.read(bench.folder.file(name), _LARGEST_PEM)
        is_key = b"PRIVATE KEY-----" in text
        keys += [name] if is_key else []
        certificates += [name] if not is_key or b"BEGIN CERTIFICATE-----" in text else []
    return keys, certificates


def _verify(request: Request, sent: Sent) -> Response:
    """Verify a signed certificate of the folder."""
    folder = bench_of(request).folder
    signed, by = (folder.name(folder.file(only(sent, one))) for one in ("signed", "certificate"))
    command = ("certificate", "verify", signed, f"--certificate={by}")
    return start(request, command, "Verify the certificate", signed)


# --- compensation, plan, ledger: forms of one command ----------------------------------------------


def _asked(
    request: Request, sent: Sent | None, title: str, words: str, fields: list[Field], *, ready: bool = True, **more: Any
) -> tuple[dict[str, Field], Response | None]:  # fmt: skip
    """The options of a command as sent; and the page that asks for them, unless all are sent and none is refused.

    ``ready``: False if there is nothing yet to do it with.
    """
    typed = fields if sent is None else [field.with_sent(sent) for field in fields]
    by_key = {field.key: field for field in typed}
    if sent is not None and not any(field.refusal for field in typed):
        return by_key, None
    values = {"title": title, "words": words, "fields": typed if ready else [], "stores": (), "link": ""}
    code = 200 if sent is None else 422
    return by_key, render(request, "form.html.jinja", code, **left(bench_of(request)) | values | more)


def _same(names: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """A menu whose values are their words."""
    return tuple((name, name) for name in names)


def _compensation(request: Request, sent: Sent | None = None) -> Response:
    """The form of a compensation; with what was sent, its start."""
    bench = bench_of(request)
    folder, shown = bench.folder, left(bench)
    kept = tuple((one.name, f"{one.name}: {one.created[:10]}") for one in shown["kept"])
    fields = [
        Field(
            "run", "record", choices=_same([e.name for e in folder.entries() if e.state in ("ready", "kept")])
        ),
        Field("of", "calibration", choices=kept, typed=request.query_params.get("of", "")),
        Field("phase", "phase of the output zero, if it is known (else empty)", "0.48 rad", like="rad"),
        Field("identify-phase", "or: estimate it from the first stretch at rest", "60 s", like="s"),
        Field("rate", "output rate (empty: that of the record)", "10 Hz", like="Hz"),
        Field("format", "file", choices=_same(("parquet", "csv"))),
        Field(
            "other-serial", "accept a calibration of another serial number", choices=(("", "no"), ("1", "yes"))
        ),
    ]
    words = (
        "The cross-coupling is taken off the record with the coefficients of a kept calibration. "
        "The file is written beside the record."
    )
    asked, page = _asked(request, sent, "Compensate", words, fields, ready=bool(kept))
    if page is not None:
        return page
    run, calibration = (
        folder.toml(asked["run"].typed),
        f"{kept_of(bench, asked['of'].typed).name}/{CALIBRATION}",
    )
    out = run.with_name(f"{run.stem}-compensated.{'csv' if asked['format'].typed == 'csv' else 'parquet'}")
    command = ["compensate", folder.name(run), "--calibration", calibration, "--out", folder.name(out)]
    command += ["--report", folder.name(out.with_suffix(".html")), "--force"]
    command += [f"--{field.key}={field.value}" for field in asked.values() if field.like and field.typed]
    command += ["--other-serial"] if asked["other-serial"].typed else []
    reads = [*files_named_in(run), folder.file(calibration)]
    return start(request, command, "Compensate", folder.name(run), folder.name(out), reads)


def _plan(request: Request, sent: Sent | None = None) -> Response:
    """The form of a plan; with what was sent, the plan for this instrument is written and run."""
    import tomlkit

    bench = bench_of(request)
    of = request.query_params.get("of", "")
    time_field = Field("hours", "time at the stand", "2130 s", like="s", units=("s", "min", "h"), needed=True)
    words = (
        "Which positions of a dividing head, how long in each, and which uncertainty that gives. The plan begins "
        f"with example values of stand and instrument{', and with its serial number and K' if of else ''}; every entry "
        "can be changed as text afterwards."
    )
    link = f"/text?example={_PLAN}"
    asked, page = _asked(request, sent, "Plan the test", words, [time_field], link=link)
    if page is not None:
        return page
    document: Any = tomlkit.parse(example_files()[_PLAN].decode("utf-8"))
    document["plan"]["duration"] = asked["hours"].value
    if of:
        kept = kept_of(bench, of)
        document["instrument"]["serial"] = kept.serial
        document["instrument"]["scale_factor"] = f"{kept.K:.9g} {kept.unit}"
    stem = f"plan-{_plain(str(document['instrument']['serial']))}"
    name = next(n for n in (f"{stem}-{i}.toml" for i in range(1, 10000)) if not bench.folder.path(n).exists())
    bench.history.write(name, "", tomlkit.dumps(document), f"plan {name}", "any")
    out = name.removesuffix(".toml")
    return start(request, ("plan", name, "--out", out, "--force"), "Plan", name, out)


def _ledger(request: Request, sent: Sent | None = None) -> Response:
    """Ledgers of the folder; keep a result in one, list, verify or export it."""
    bench = bench_of(request)
    stores, word = bench.folder.listed(*_STORES), only(sent or {}, "do")
    if word in ("list", "verify", "export"):
        store = _store(bench, only(sent or {}, "store"))
        out = f"{store.stem}-{time.strftime('%Y%m%d-%H%M%S')}.zip" if word == "export" else ""
        command = ["records", word, *([out] if out else []), "--store", store.name]
        return start(request, command, f"{word.capitalize()} the ledger", store.name, out)
    fields = [
        Field("run", "record", choices=_same([entry.name for entry in bench.folder.entries() if entry.kept])),
        Field("store", "ledger", "lab.sqlite", typed=stores[0] if stores else "lab.sqlite", needed=True),
        Field("operator", "operator", "who keeps the record", needed=True),
        Field("reason", "reason", "why it is kept", needed=True),
    ]
    words = (
        "A ledger keeps inputs, results and report of a calibration, so that nothing can be changed unnoticed."
    )
    ready = bool(fields[0].choices)
    asked, page = _asked(request, sent, "Add to the ledger", words, fields, ready=ready, stores=stores)
    if page is not None:
        return page
    store, run = _store(bench, asked["store"].typed), bench.folder.toml(asked["run"].typed)
    results = bench.folder.name(bench.folder.path(bench.folder.name(results_of(run))))
    command = ["records", "add", bench.folder.name(run), "--store", store.name, "--results", results]
    command += [f"--{key}={' '.join(asked[key].typed.split())}" for key in ("operator", "reason")]
    return start(request, command, "Add to the ledger", bench.folder.name(run))


def _store(bench: Bench, name: str) -> Path:
    store = bench.folder.path(name)
    if store.parent != bench.folder.root or store.suffix not in _STORES:
        raise ArgumentError(f"{store.name[:80]!r}: cannot be the name of a ledger", remedy="e.g. lab.sqlite")
    return store


def _trend(request: Request, sent: Sent) -> Response:
    """How the coefficients of one instrument drift."""
    serial = only(sent, "serial")
    kept = [
        one.name for entry in bench_of(request).folder.entries() for one in entry.kept if one.serial == serial
    ]
    if len(kept) < 2:
        raise ArgumentError("a trend needs two kept calibrations", remedy="keep another calibration first")
    out = f"trend-{_plain(serial)}"
    command = ["records", "trend", *(f"{name}/{CALIBRATION}" for name in kept), "--out", out, "--force"]
    return start(request, command, "Trend", serial, out)


def _prospects(request: Request, _sent: Sent) -> Response:
    """What the record says of each term, before a fit."""
    name = bench_of(request).folder.name(bench_of(request).folder.toml(request.path_params["name"]))
    return start(request, ("check", name, "--terms"), "Which terms the record tells", name)


# --- show as text ----------------------------------------------------------------------------------

_COMMANDS: dict[str, dict[str, str]] = {
    "run file": {"check": "Check", "calibrate": "Calibrate"},
    "plan": {"plan": "Plan the test"},
    "platform": {
        "platform navigate": "Navigate", "platform compare": "Compare models", "platform simulate": "Simulate",
        "platform identify": "Identify", "platform align": "Align",
    },
    "scenario": {"simulate": "Simulate the test"},
    "other file": {},
}  # fmt: skip
"""Commands by kind of file."""


def _kind_of(document: dict[str, Any]) -> str:
    """Kind of a file by its tables."""
    for table, kind in (("data", "run file"), ("plan", "plan"), ("case_rotation", "platform")):
        if table in document:
            return kind
    return "scenario" if {"stand", "electronics"} <= document.keys() else "other file"


def _show_text(request: Request) -> Response:
    """A file, or an example to begin with."""
    folder, query = bench_of(request).folder, request.query_params
    name, example = query.get("file", ""), query.get("example", "")
    if name:
        return _text_page(request, name, folder.text(name))
    if example and example not in _examples():
        raise OutsideError(f"{example[:80]!r}: is no example", remedy="choose one of the list")
    return _text_page(request, "", _examples()[example].decode("utf-8") if example else "", example=example)


def _examples() -> dict[str, bytes]:
    return {name: raw for name, raw in sorted(example_files().items()) if name.endswith(".toml")}


def _text_page(
    request: Request, name: str, text: str, message: str = "", code: int = 200, example: str = ""
) -> Response:
    bench, kind = bench_of(request), "other file"
    with contextlib.suppress(PigaError):
        kind = _kind_of(toml_document(Path(name or "the text"), text.encode()))
    seen = bench.history.seen(bench.folder.text(name)) if name and bench.folder.path(name).is_file() else ""
    return render(
        request, "text.html.jinja", code, **left(bench, name), file=name, text=text, message=message, seen=seen,
        commands=_COMMANDS[kind].items(), names=bench.folder.listed(".toml")[:500], example=example, examples=_examples(),
    )  # fmt: skip


def _save_text(request: Request, sent: Sent) -> Response:
    """Save the file; run a command on it."""
    bench, word = bench_of(request), only(sent, "do")
    name, text = only(sent, "file"), only(sent, "text").replace("\r\n", "\n")
    name = name if name.endswith(".toml") else f"{name}.toml"
    path = bench.folder.path(name)
    try:
        kind = _kind_of(toml_document(path, text.encode()))
        seen = only(sent, "seen") if name == only(sent, "was") else ""
        bench.history.write(name, seen, text, f"save {name}", "run" if kind == "run file" else kind)
    except ChangedError:
        raise
    except PigaError as error:
        return _text_page(request, name, text, str(error), 422)
    if word == "save":
        return redirect(request, f"/text?file={name}")
    if word not in _COMMANDS[kind]:
        raise ArgumentError(f"{word[:40]!r}: is not a command for this file", remedy="use the buttons")
    words = word.split()
    out = "" if word == "check" else bench.folder.name(path.with_name(f"{path.stem}-{words[-1]}"))
    command = [*words, name, *(["--out", out, "--force"] if out else [])]
    return start(request, command, word.capitalize(), name, out, files_named_in(path))


# --- jobs --------------------------------------------------------------------------------------------


def _job_of(request: Request) -> tuple[Bench, Job]:
    """The job that the address names."""
    bench = bench_of(request)
    job = bench.jobs.get(request.path_params["key"])
    if job is None:
        raise OutsideError("there is no such job; jobs end with the server", remedy="start it again")
    return bench, job


def _show_jobs(request: Request) -> Response:
    jobs = bench_of(request).jobs
    return render(request, "jobs.html.jinja", jobs=jobs.all())


def _show_job(request: Request) -> Response:
    """One job: its state, what it printed, its files. The page asks for it again while the job runs."""
    bench, job = _job_of(request)
    state = job.state
    response = render(
        request, "job-part.html.jinja" if is_part(request) else "job.html.jinja", job=job, state=state,
        line=f"piga {shlex.join(job.command)}", out=job.text("out"), err=job.text("err"),
        files=[path.name for path in _result_files(bench, job)] if state == "done" else [],
    )  # fmt: skip
    if is_part(request) and state != "running":
        response.headers["hx-refresh"] = "true"
    return response


def _stop_job(request: Request) -> Response:
    bench, job = _job_of(request)
    bench.jobs.stop(job)
    return redirect(request, request.headers.get("referer") or f"/jobs/{job.key}")


def _job_file(request: Request) -> Response:
    """A result file of a job."""
    bench, job = _job_of(request)
    name = request.path_params["file"]
    path = next((item for item in _result_files(bench, job) if item.name == name), None)
    if path is None:
        raise OutsideError(f"{name}: is not a result of this job", remedy="choose a listed file")
    return result_file(bench, path, draft=job.title.startswith("DRAFT"))


def _result_files(bench: Bench, job: Job) -> list[Path]:
    """The files that a job wrote: those of its folder, or its file and the page beside it."""
    if not job.result or job.result.startswith("signals/"):
        return []
    is_trial = job.result.startswith(f"{STATE_FOLDER}/trials/")
    place = bench.folder.root / job.result if is_trial else bench.folder.path(job.result)
    files = [place, place.with_suffix(".html")]
    if place.is_dir() and not place.is_symlink():
        files = sorted(path for path in place.iterdir() if not path.name.startswith("."))
    return [path for path in files if path.is_file() and not path.is_symlink()]


ROUTES = [
    Route("/certificate", _certificate, methods=["GET"]),
    Route("/certificate", posted(_issue), methods=["POST"]),
    Route("/certificate/verify", posted(_verify), methods=["POST"]),
    *(
        route
        for address, page in (("/compensate", _compensation), ("/plan", _plan), ("/ledger", _ledger))
        for route in (Route(address, page, methods=["GET"]), Route(address, posted(page), methods=["POST"]))
    ),
    Route("/trend", posted(_trend), methods=["POST"]),
    Route("/prospects/{name:path}", posted(_prospects), methods=["POST"]),
    Route("/text", _show_text, methods=["GET"]),
    Route("/text", posted(_save_text), methods=["POST"]),
    Route("/jobs", _show_jobs),
    Route("/jobs/{key}", _show_job),
    Route("/jobs/{key}/stop", _stop_job, methods=["POST"]),
    Route("/jobs/{key}/file/{file}", _job_file),
]
