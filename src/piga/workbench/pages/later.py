"""What comes after a calibration: certificate, compensation, the plan of the next test, trend, ledger, prospects of terms."""

from __future__ import annotations

import contextlib
import datetime as dt
import re
import secrets
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from piga.data import example_files
from piga.describe.draft import places_of
from piga.errors import ArgumentError, PigaError
from piga.records.run_file import read_run_file
from piga.records.text_files import files_named_in, toml_document
from piga.workbench.folder import CALIBRATION, STATE_FOLDER, Kept, results_of
from piga.workbench.pages.common import Bench, bench_of, only, posted, quantity, redirect, render
from piga.workbench.pages.record import kept_of, left
from piga.workbench.signals import cache_key

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
TABLES = ("environment", "traceability.standard")
"""Lists of tables; they are typed as text."""
PLAN = "plan-dividing-head.toml"
"""Example that a plan begins with. Plans for other stands are written as text."""


def start(
    request: Request, command: Sequence[str], title: str, subject: str, result: str = "", reads: Any = None
) -> Response:
    """Start a job and go to its page."""
    bench = bench_of(request)
    if result and not result.startswith(f"{STATE_FOLDER}/trials/"):
        bench.folder.path(result)
    job = bench.jobs.start(command, title, subject, result, reads)
    return redirect(request, f"/jobs/{job.key}")


def plain(name: str) -> str:
    """The letters and digits of a name, for a folder."""
    text = "".join(letter if letter.isalnum() else "-" for letter in name).strip("-")
    return text.encode()[:80].decode("utf-8", "ignore") or "instrument"


# --- certificate ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Item:
    """An entry of the certificate: key, what it means, an example, the laboratory's own value, why it is refused."""

    key: str
    words: str
    example: str
    value: str
    refusal: str = ""

    @property
    def group(self) -> str:
        """Table of the entry."""
        return self.key.partition(".")[0]


def _example() -> dict[str, Any]:
    return toml_document(Path(CERTIFICATE), example_files()[CERTIFICATE])


def _flat(document: dict[str, Any], path: str = "") -> dict[str, Any]:
    """Single entries by ``table.key``."""
    result: dict[str, Any] = {}
    for key, value in document.items():
        if isinstance(value, dict):
            result |= _flat(value, f"{path}{key}.")
        elif not (isinstance(value, list) and value and isinstance(value[0], dict)):
            result[f"{path}{key}"] = value
    return result


def _shown(value: Any) -> str:
    """An entry as it is typed."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _typed(text: str, example: Any) -> Any:
    """A typed entry in the type of the example."""
    if isinstance(example, bool):
        return text.strip().lower() in ("yes", "true", "1")
    if isinstance(example, dt.date):
        try:
            return dt.date.fromisoformat(text.strip())
        except ValueError:
            raise ArgumentError("is not a date", remedy="write year-month-day, e.g. 2026-03-04") from None
    return [part.strip() for part in text.split(",")] if isinstance(example, list) else text.strip()


def _table_text(document: dict[str, Any], key: str) -> str:
    """A list of tables as text."""
    import tomlkit

    table, _, inner = key.rpartition(".")
    items = (document.get(table, {}) if table else document).get(inner)
    return (
        str(tomlkit.dumps({table: {inner: items}} if table else {inner: items})).replace(f"[{table}]\n", "")
        if items
        else ""
    )


def _own(bench: Bench, kept: Kept | None) -> dict[str, str]:
    """What is known already: the laboratory's own entries, and those of the calibration."""
    example = _example()
    flat = _flat(example)
    entries = {key: _shown(flat[key]) for key in _USUAL if key in flat}
    try:
        mine = toml_document(Path(CERTIFICATE), bench.folder.text(CERTIFICATE).encode())
    except PigaError:
        mine = {}
    entries |= {
        key: _shown(value) for key, value in _flat(mine).items() if key in _USUAL or value != flat.get(key)
    }
    tables = {key: _table_text(mine, key) for key in TABLES}
    entries |= {key: text for key, text in tables.items() if text != _table_text(example, key)}
    if kept is not None:
        entries |= {"item.serial": kept.serial, "calibration.end": kept.created[:10]}
    if _is_used(bench, entries.get("certificate.number", "")) or "certificate.number" not in entries:
        entries["certificate.number"] = _next_number(bench)
    return entries


def _is_used(bench: Bench, number: str) -> bool:
    return bool(number) and (bench.folder.root / f"certificate-{plain(number)}").exists()


def _next_number(bench: Bench) -> str:
    year = time.strftime("%Y")
    return next(one for one in (f"{year}-{count:04d}" for count in range(1, 10000)) if not _is_used(bench, one))


def _items(bench: Bench, values: dict[str, str]) -> list[Item]:
    example = _example()
    flat = {key: _shown(value) for key, value in _flat(example).items()}
    flat |= {key: _table_text(example, key) for key in TABLES}
    words = {place.path: place.words.sentence for place in places_of("certificate")}
    items = []
    for key, shown in flat.items():
        value, refusal = values.get(key, "").strip(), ""
        if value and key not in TABLES:
            try:
                _typed(value, _flat(example)[key])
            except PigaError as error:
                refusal = f"{error.message}: {error.remedy}"
        elif value:
            try:
                toml_document(Path(CERTIFICATE), value.encode())
            except PigaError as error:
                refusal = str(error)
        if key == "certificate.number" and _is_used(bench, value):
            refusal = f"this number was used; the next free one is {_next_number(bench)}"
        items.append(Item(key, words.get(key, key), shown, value, refusal))
    return items


def _document(values: dict[str, str], *, whole: bool) -> str:
    """The certificate file. ``whole``: with the example's entries where there are no own ones, for a draft."""
    import tomlkit

    example = _example()
    document: dict[str, Any] = {}
    for key, shown in _flat(example).items():
        text = values.get(key, "").strip()
        if text or whole:
            *path, last = key.split(".")
            table = document
            for part in path:
                table = table.setdefault(part, {})
            table[last] = _typed(text, shown) if text else shown
    for key in TABLES:
        text = values.get(key, "").strip() or (_table_text(example, key) if whole else "")
        parsed = toml_document(Path(CERTIFICATE), text.encode())
        for name, part in parsed.items():
            document[name] = document.get(name, {}) | part if isinstance(part, dict) else part
    return str(tomlkit.dumps(document))


def certificate(request: Request) -> Response:
    """The form of a certificate, filled from the calibration and from the laboratory's own entries."""
    bench = bench_of(request)
    name = request.query_params.get("of", "")
    kept = kept_of(bench, name) if name else None
    return _certificate_page(request, kept, _own(bench, kept))


def _certificate_page(
    request: Request, kept: Kept | None, values: dict[str, str], message: str = "", code: int = 200
) -> Response:
    bench = bench_of(request)
    shown = left(bench)
    seen = ""
    with contextlib.suppress(PigaError):
        seen = bench.history.seen(bench.folder.text(CERTIFICATE))
    keys, x509 = pem_files(bench)
    drafts = [
        job
        for job in bench.jobs.all()
        if job.title == "DRAFT certificate" and kept is not None and job.subject == kept.name
    ]
    return render(
        request, "certificate.html.jinja", code, **shown, one=kept, items=_items(bench, values), tables=TABLES, seen=seen,
        message=message, keys=keys, x509=x509, signed=bench.folder.listed(".xml"), draft=drafts[0] if drafts else None,
    )  # fmt: skip


def issue(request: Request, fields: dict[str, list[str]]) -> Response:
    """Save the laboratory's entries; show a draft, or issue the certificate if nothing is missing."""
    bench = bench_of(request)
    kept = kept_of(bench, only(fields, "of"))
    values = {key.removeprefix("c:"): sent[-1] for key, sent in fields.items() if key.startswith("c:")}
    items = _items(bench, values)
    wrong = [item for item in items if item.refusal]
    draft = only(fields, "do") != "issue"
    if wrong or (not draft and any(not item.value for item in items)):
        return _certificate_page(
            request, kept, values, "Some entries are missing or cannot be used; each says why.", 422
        )
    try:
        bench.history.write(
            CERTIFICATE, only(fields, "seen"), _document(values, whole=False), "certificate entries", "any"
        )
        text = _document(values, whole=True)
    except ArgumentError:
        raise
    except PigaError as error:
        return _certificate_page(request, kept, values, str(error), 422)
    calibration = f"{kept.name}/{CALIBRATION}"
    if draft:
        place = bench.folder.state_room("trials") / secrets.token_hex(8)
        data = place.with_suffix(".toml")
        data.write_text(text, encoding="utf-8")
        out, source, title = bench.folder.name(place), bench.folder.name(data), "DRAFT certificate"
    else:
        out, source, title = f"certificate-{plain(values['certificate.number'])}", CERTIFICATE, "Certificate"
        bench.folder.path(out)
    command = ["certificate", "issue", calibration, "--data", source, "--out", out]
    command += ["--dcc"] if only(fields, "dcc") else []
    for option in ("key", "certificate"):
        value = only(fields, option)
        command += [f"--{option}={bench.folder.name(bench.folder.file(value))}"] if value else []
    job = bench.jobs.start(command, title, kept.name, out)
    return redirect(request, f"/jobs/{job.key}")


def pem_files(bench: Bench) -> tuple[list[str], list[str]]:
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


def verify(request: Request, fields: dict[str, list[str]]) -> Response:
    """Verify a signed certificate of the folder."""
    folder = bench_of(request).folder
    signed, by = (folder.name(folder.file(only(fields, one))) for one in ("signed", "certificate"))
    return start(
        request, ("certificate", "verify", signed, f"--certificate={by}"), "Verify the certificate", signed
    )


# --- compensation, plan, trend, ledger -------------------------------------------------------------


def compensation(request: Request) -> Response:
    """The form of a compensation."""
    return _compensation_page(request, request.query_params.get("of", ""), {}, {})


def _compensation_page(
    request: Request, of: str, typed: dict[str, str], refusals: dict[str, str], code: int = 200
) -> Response:
    bench = bench_of(request)
    runs = [entry for entry in bench.folder.entries() if entry.state in ("ready", "kept")]
    values = left(bench) | {"runs": runs, "of": of, "refusals": refusals, "typed": typed}
    return render(request, "compensate.html.jinja", code, **values)


def compensate(request: Request, fields: dict[str, list[str]]) -> Response:
    """Start a compensation."""
    folder = bench_of(request).folder
    run, kept = folder.toml(only(fields, "run")), kept_of(bench_of(request), only(fields, "of"))
    form = "csv" if only(fields, "format") == "csv" else "parquet"
    out = run.with_name(f"{run.stem}-compensated.{form}")
    calibration = f"{kept.name}/{CALIBRATION}"
    command = ["compensate", folder.name(run), "--calibration", calibration, "--out", folder.name(out)]
    command += ["--report", folder.name(out.with_suffix(".html")), "--force"]
    typed, refusals = {key: only(fields, key).strip() for key in ("phase", "identify-phase", "rate")}, {}
    for option, like in (("phase", "rad"), ("identify-phase", "s"), ("rate", "Hz")):
        try:
            command += [f"--{option}={quantity(typed[option], '', like, option)}"] if typed[option] else []
        except PigaError as error:
            refusals[option] = str(error).replace("\n  remedy: ", ": ")
    if refusals:
        return _compensation_page(request, kept.name, typed, refusals, 422)
    command += ["--other-serial"] if only(fields, "other-serial") else []
    reads = [*files_named_in(run), folder.file(calibration)]
    return start(request, command, "Compensate", folder.name(run), folder.name(out), reads)


def plan(request: Request) -> Response:
    """The form of a plan."""
    return _plan_page(request, request.query_params.get("of", ""))


def _plan_page(
    request: Request, of: str, typed: str = "", unit: str = "", refusal: str = "", code: int = 200
) -> Response:
    values = left(bench_of(request)) | {"of": of, "typed": typed, "unit": unit, "refusal": refusal}
    return render(request, "plan.html.jinja", code, **values)


def make_plan(request: Request, fields: dict[str, list[str]]) -> Response:
    """Write a plan for this instrument and run it."""
    import tomlkit

    bench = bench_of(request)
    document: Any = tomlkit.parse(example_files()[PLAN].decode("utf-8"))
    of, typed, unit = (only(fields, name) for name in ("of", "hours", "unit"))
    try:
        document["plan"]["duration"] = quantity(typed, unit, "s", "time at the stand")
    except PigaError as error:
        return _plan_page(request, of, typed, unit, str(error).replace("\n  remedy: ", ": "), 422)
    if of:
        kept = kept_of(bench, of)
        document["instrument"]["serial"] = kept.serial
        document["instrument"]["scale_factor"] = f"{kept.K:.9g} {kept.unit}"
    stem = f"plan-{plain(str(document['instrument']['serial']))}"
    name = next(n for n in (f"{stem}-{i}.toml" for i in range(1, 10000)) if not bench.folder.path(n).exists())
    bench.history.write(name, "", tomlkit.dumps(document), f"plan {name}", "any")
    out = name.removesuffix(".toml")
    return start(request, ("plan", name, "--out", out, "--force"), "Plan", name, out)


def trend(request: Request, fields: dict[str, list[str]]) -> Response:
    """How the coefficients of one instrument drift."""
    bench = bench_of(request)
    serial = only(fields, "serial")
    kept = [one.name for entry in bench.folder.entries() for one in entry.kept if one.serial == serial]
    if len(kept) < 2:
        raise ArgumentError("a trend needs two kept calibrations", remedy="keep another calibration first")
    out = f"trend-{plain(serial)}"
    command = ["records", "trend", *(f"{name}/{CALIBRATION}" for name in kept), "--out", out, "--force"]
    at = only(fields, "at").strip()
    return start(request, [*command, *([f"--at={at}"] if at else [])], "Trend", serial, out)


def _ledger_page(request: Request) -> Response:
    """Ledgers of the folder."""
    bench = bench_of(request)
    runs = [entry for entry in bench.folder.entries() if entry.kept]
    return render(request, "ledger.html.jinja", **left(bench), stores=bench.folder.listed(*_STORES), runs=runs)


def ledger(request: Request, fields: dict[str, list[str]]) -> Response:
    """Keep a result in a ledger; list, verify or export it."""
    bench = bench_of(request)
    word, store = only(fields, "do"), bench.folder.path(only(fields, "store"))
    if store.parent != bench.folder.root or store.suffix not in _STORES:
        raise ArgumentError(f"{store.name[:80]!r}: cannot be the name of a ledger", remedy="e.g. lab.sqlite")
    if word == "add":
        run = bench.folder.toml(only(fields, "run"))
        results = bench.folder.name(bench.folder.path(bench.folder.name(results_of(run))))
        command = ["records", "add", bench.folder.name(run), "--store", store.name, "--results", results]
        for option in ("operator", "reason"):
            value = " ".join(only(fields, option).split())
            if not value:
                raise ArgumentError(f"{option}: is missing", remedy="say who keeps the record, and why")
            command.append(f"--{option}={value}")
        return start(request, command, "Add to the ledger", bench.folder.name(run))
    if word not in ("list", "verify", "export"):
        raise ArgumentError(f"{word[:40]!r}: is not a command of this page", remedy="use its buttons")
    out = f"{store.stem}-{time.strftime('%Y%m%d-%H%M%S')}.zip" if word == "export" else ""
    command = ["records", word, *([out] if out else []), "--store", store.name]
    return start(request, command, f"{word.capitalize()} the ledger", store.name, out)


# --- what a record can determine ------------------------------------------------------------------


def prospects(request: Request) -> Response:
    """What the record says of each term, before a fit."""
    bench, name = bench_of(request), request.path_params["name"]
    files = files_named_in(bench.folder.toml(name))
    read_run_file(files[0])
    mark = f"check/{cache_key(files)}"
    job = bench.jobs.latest(name, mark) or bench.jobs.start(
        ("check", name, "--terms", "--json"), "Ask for each term", name, mark
    )
    status = bench.jobs.status(job)
    rows: list[Any] = []
    if status.state == "done":
        with contextlib.suppress(OSError, ValueError):
            rows = bench.jobs.document(job)["terms"]
    message = bench.jobs.text(job, "err") if status.state not in ("running", "done") else ""
    return render(
        request,
        "prospects.html.jinja",
        name=name,
        status=status,
        rows=rows,
        message=re.sub(r"^piga: ", "", message),
    )


ROUTES = [
    Route("/certificate", certificate, methods=["GET"]),
    Route("/certificate", posted(issue), methods=["POST"]),
    Route("/certificate/verify", posted(verify), methods=["POST"]),
    Route("/compensate", compensation, methods=["GET"]),
    Route("/compensate", posted(compensate), methods=["POST"]),
    Route("/plan", plan, methods=["GET"]),
    Route("/plan", posted(make_plan), methods=["POST"]),
    Route("/trend", posted(trend), methods=["POST"]),
    Route("/ledger", _ledger_page, methods=["GET"]),
    Route("/ledger", posted(ledger), methods=["POST"]),
    Route("/prospects/{name:path}", prospects),
]
