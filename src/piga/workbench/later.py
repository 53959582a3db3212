"""What comes after a calibration: certificate, compensation, the plan of the next test.

Also any TOML file as text with the commands that run it, and the regimes of the motion under constant input.
"""

from __future__ import annotations

import secrets
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.routing import Route

from piga.certificate.certificate_file import missing_items, read_certificate_file
from piga.certificate.page import is_draft
from piga.data import example_files
from piga.errors import ArgumentError, PigaError
from piga.instrument import Instrument
from piga.keys import places_of
from piga.reports import page_html
from piga.reports.stand import constant_input_page
from piga.text_files import toml_document, toml_text, toml_value
from piga.units import to_si
from piga.workbench.common import REPORT_POLICY, Bench, Field, Sent, bench_of, render, route, start
from piga.workbench.folder import CALIBRATION, TRIALS, ChangedError, Kept, OutsideError, plain_name
from piga.workbench.record import in_words, kept_of, left

CERTIFICATE, _PLAN = "certificate.toml", "plan-dividing-head.toml"
"""File of the laboratory's own entries; example that a plan begins with, as plans for other stands are written as text."""


def _form(
    request: Request, title: str, words: str, groups: dict[str, list[Field]], code: int = 200, **more: Any
) -> Response:
    shown = left(bench_of(request), kept_name=request.query_params.get("of", ""))
    usual = {"method": "post", "hidden": {}, "lamp": None, "buttons": {"": title}, "link": "", "shown": ""}
    return render(request, "form", title, code, words=words, groups=groups, **shown, **(usual | more))


def _entries(document: dict[str, Any], path: str = "") -> dict[str, Any]:
    result: dict[str, Any] = {}
    for name, value in document.items():
        result |= _entries(value, f"{path}{name}.") if isinstance(value, dict) else {f"{path}{name}": value}
    return result


_EXAMPLE = _entries(toml_document(Path(CERTIFICATE), example_files()[CERTIFICATE]))
"""The entries that the form asks for, with the values of the example."""
_LISTS = {key: value[0] for key, value in _EXAMPLE.items() if isinstance(value, list)}
"""First part of each list: a text, or a table."""
_MADE_LATER = ("[certificate] issued", "[adjustment] before")
"""What may be missing here: the command takes today, and a file that the form does not show."""


def _shown(key: str, value: Any) -> str:
    """An entry as it is typed; the parts of a list have a line each, the cells of a table a semicolon between them."""
    if key in _LISTS:
        part = _LISTS[key]
        rows = (one if isinstance(one, str) else "; ".join(one.get(name, "") for name in part) for one in value)
        return "\n".join(row.rstrip("; ") for row in rows)
    return value if isinstance(value, str) else toml_value(value)


def _typed(key: str, text: str) -> Any:
    """A typed entry as the file has it. A date is written as text, too."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    first = _LISTS.get(key)
    if isinstance(first, dict):
        rows = ([cell.strip() for cell in line.split(";", len(first) - 1)] for line in lines)
        return [{one: cell for one, cell in zip(first, row, strict=False) if cell} for row in rows]
    return {"true": True, "false": False}.get(text, text) if first is None else lines


def _document(document: dict[str, Any], entries: dict[str, Any]) -> str:
    """A certificate file with these entries. Others that it has stay."""
    for key, value in entries.items():
        table, (*path, last) = document, key.split(".")
        for part in path:
            table = table.setdefault(part, {})
        table.pop(last, None)
        table |= {} if value in ("", []) else {last: value}
    return toml_text(document)


def _own(bench: Bench, kept: Kept) -> tuple[dict[str, Any], str, dict[str, str]]:
    """The laboratory's certificate file, its text, and the entries of the form: those of the file, and what is known.

    While laboratory or customer are those of the example, no other entry of the example is the laboratory's own.
    """
    document, text, theirs = dict[str, Any](), "", dict[str, Any]()
    with suppress(OutsideError):  # there is none yet
        text = bench.folder.text(CERTIFICATE)
        document = toml_document(Path(CERTIFICATE), text.encode())
        theirs = _EXAMPLE if is_draft(read_certificate_file(CERTIFICATE, content=text)) else {}
    known = {key: value for key, value in _entries(document).items() if value != theirs.get(key)}
    known |= {"item.serial": kept.calibration.serial, "calibration.end": kept.created[:10]}
    numbers = (known.get("certificate.number"), *(f"{time.strftime('%Y')}-{n:04d}" for n in range(1, 10000)))
    places = ((one, bench.folder.root / f"certificate-{plain_name(one)}") for one in numbers if one)
    known["certificate.number"] = next(one for one, place in places if not place.exists())
    return document, text, {key: _shown(key, known.get(key, "")) for key in _EXAMPLE}


def _fault(key: str, missing: list[str]) -> str:
    """What is wrong with an entry: ``[people.authorised] name and role (...)``, or ``[calibration.begin]: ...``."""
    table, _, last = key.rpartition(".")
    heads = ((one, one.partition(" (")[0].split()) for one in missing)
    return next((one for one, head in heads if f"[{key}" in one or {f"[{table}]", last} <= {*head}), "")


def _certificate(request: Request, sent: Sent) -> Response:
    """The form of a certificate. What was sent is saved and shown as a draft; or issued, if nothing is missing."""
    bench, of = bench_of(request), request.query_params.get("of", "")
    kept, command = kept_of(bench, of), []
    document, text, values = _own(bench, kept)
    seen = sent.get("seen", bench.history.seen(text) if text else "")
    values |= {key: sent[key].strip() for key in _EXAMPLE if key in sent}
    entries = {key: _typed(key, value) for key, value in values.items()}
    text, number = _document(document, entries), values["certificate.number"]
    try:
        missing = missing_items(read_certificate_file(CERTIFICATE, content=text), kept.calibration)
        missing = [one for one in missing if not one.startswith(_MADE_LATER)]
        if sent.get("do") == "issue" and not missing:
            command = ["--data", CERTIFICATE, "--out", f"certificate-{plain_name(number)}"]
        elif sent.get("do") == "draft":  # the entries of the example stand where there are no own ones
            place = bench.folder.state_room("trials") / secrets.token_hex(8)
            shown = {key: value or _EXAMPLE[key] for key, value in entries.items()}
            shown["certificate.number"] = f"DRAFT {number}"
            if not entries["environment"]:  # the gravity of the example is not that of the laboratory
                shown["environment"] = [
                    one for one in shown["environment"] if "gravity" not in one["name"].lower()
                ]
            place.with_suffix(".toml").write_text(_document(document, shown), encoding="utf-8")
            command = ["--data", f"{TRIALS}{place.name}.toml", "--out", f"{TRIALS}{place.name}"]
    except PigaError as error:
        missing = [str(error)]
    if command:
        bench.history.write(CERTIFICATE, seen, text, "certificate entries")
        command += ["--dcc"] if sent.get("dcc") else []
        issue = ("certificate", "issue", f"{kept.name}/{CALIBRATION}", *command)
        return start(request, issue, "Certificate", kept.name, command[3])
    groups: dict[str, list[Field]] = {}
    places, marked = {place.path: place for place in places_of("certificate")}, set[str]()
    for key, example in _EXAMPLE.items():
        table, _, last = key.rpartition(".")
        first, fault = _LISTS.get(key), _fault(key, missing)
        kinds = [one.strip('"') for one in places[key].kind.split(" | ")]
        field = Field(
            key, last.replace("_", " "), _shown(key, example), typed=values[key], refusal=fault if sent else "",
            note=f"One line each: {'; '.join(first)}." if isinstance(first, dict) else places[key].words.sentence,
            choices=(("", "\u2013"), *zip(kinds, kinds, strict=True)) if len(kinds) > 1 else (),
            rows=0 if first is None else 2 if isinstance(first, str) else 5, css="missing" if fault else "",
        )  # fmt: skip
        marked.add(fault)
        groups.setdefault(table or key, []).append(field)
    dcc = Field("dcc", "as digital certificate too (DCC)", choices=(("", "no"), ("1", "yes")))
    groups["certificate"].append(dcc.with_sent(sent))
    advice = "An entry that is missing is marked below." if missing else "The certificate can be issued."
    words = f"{in_words(kept)}, made {kept.created[:10]}. Each entry must be your own; the grey words are an example."
    state = ("amber", f"DRAFT: {len(missing)} to settle") if missing else ("green", "Complete")
    return _form(
        request, f"Certificate of {kept.calibration.serial}", words, groups, 422 if sent else 200,
        hidden={"seen": seen}, buttons={"draft": "See the draft", "issue": "Issue"},
        lamp=(*state, "\n".join([advice, *(one for one in missing if one not in marked)])),
    )  # fmt: skip


def _asked(
    request: Request, sent: Sent, title: str, words: str, fields: list[Field], link: str = ""
) -> Sent | Response:
    """What was sent for the fields; else the page that asks for it."""
    asked = [field.with_sent(sent) if sent else field for field in fields]
    if sent and not any(field.refusal for field in asked):
        return {field.key: field.value for field in asked}
    return _form(request, title, words, {"": asked}, 422 if sent else 200, link=link)


def _compensation(request: Request, sent: Sent) -> Response:
    bench, of = bench_of(request), request.query_params.get("of", "")
    folder, calibration = bench.folder, f"{kept_of(bench, of).name}/{CALIBRATION}"
    words = f"The cross-coupling is taken off a record with {of}. Other rates and CSV: piga compensate."
    runs = tuple((entry.name, entry.name) for entry in folder.entries() if entry.state == "ready")
    phase = Field(
        "phase", "phase of the output zero, if it is known", "0.48 rad", like="rad", units=("rad", "deg")
    )
    rest = Field(
        "identify-phase", "or: estimate it from the first stretch at rest", "60 s", like="s", units=("s",)
    )
    asked = _asked(request, sent, "Compensate", words, [Field("run", "record", choices=runs), phase, rest])
    if isinstance(asked, Response):
        return asked
    run = folder.toml(asked["run"])
    out = run.with_name(f"{run.stem}-compensated.parquet")
    command = ["compensate", folder.name(run), "--calibration", calibration, "--out", folder.name(out)]
    command += ["--report", folder.name(out.with_suffix(".html")), "--force"]
    command += [f"--{one.key}={asked[one.key]}" for one in (phase, rest) if asked[one.key]]
    return start(request, command, "Compensate", folder.name(run), folder.name(out))


def _plan(request: Request, sent: Sent) -> Response:
    """The form of a plan; with what was sent, the plan for this instrument is written and run."""
    import tomlkit

    bench, kept = bench_of(request), kept_of(bench_of(request), request.query_params.get("of", ""))
    words = "Positions of a dividing head, and the uncertainty that they give. Example values can be changed as text afterwards."
    hours = Field("hours", "time at the stand", "2130 s", like="s", units=("s", "min", "h"), needed=True)
    asked = _asked(request, sent, "Plan the test", words, [hours], f"/text?example={_PLAN}")
    if isinstance(asked, Response):
        return asked
    document: Any = tomlkit.parse(example_files()[_PLAN].decode("utf-8"))
    document["plan"]["duration"] = asked["hours"]
    document["instrument"]["serial"] = kept.calibration.serial
    document["instrument"]["scale_factor"] = f"{kept.K:.9g} {kept.unit}"
    name = bench.folder.free(bench.folder.root, f"plan-{plain_name(kept.calibration.serial)}", ".toml").name
    bench.history.write(name, "", tomlkit.dumps(document), f"plan {name}")
    out = name.removesuffix(".toml")
    return start(request, ("plan", name, "--out", out, "--force"), "Plan", name, out)


_COMMANDS = {
    "plan": ("plan",),
    "truth": ("simulate",),
    "polar": tuple(f"platform {word}" for word in ("compare", "simulate", "identify", "align")),
    "data": ("check", "check --terms", "calibrate"),
}
"""Commands for a file by the table that tells its kind."""


def _commands(text: str) -> tuple[str, ...]:
    with suppress(PigaError):
        document = toml_document(Path("the text"), text.encode())
        return next((words for table, words in _COMMANDS.items() if table in document), ())
    return ()


def _text(request: Request, sent: Sent) -> Response:
    """A file as text, or an example to begin with; what was sent is saved, and a command is run on it."""
    bench, query = bench_of(request), request.query_params
    name, example, message = query.get("file", ""), query.get("example", ""), ""
    examples = {one: raw for one, raw in example_files().items() if one.endswith(".toml")}
    if example and example not in examples:
        raise OutsideError(f"{example[:80]!r}: is no example", remedy="choose one of the list")
    if sent:
        name, text = sent.get("file", ""), sent.get("text", "")
        name = name if name.endswith(".toml") else f"{name}.toml"
        try:
            seen = sent.get("seen", "") if name == sent.get("was") else ""
            bench.history.write(name, seen, text, f"save {name}")
        except (ChangedError, OutsideError):
            raise
        except PigaError as error:
            message = str(error)
        else:
            return _run(request, name, sent.get("do", ""), _commands(text))
    else:
        text = bench.folder.text(name) if name else examples.get(example, b"").decode("utf-8")
    there = bool(name) and bench.folder.path(name).is_file()
    names = [bench.folder.name(path) for path in bench.folder.files() if path.suffix == ".toml"]
    return render(
        request, "text", name or "Show as text", 422 if message else 200, **left(bench, name), file=name, text=text,
        message=message, commands=_commands(text), names=names[:500], example=example, examples=examples,
        seen=bench.history.seen(bench.folder.text(name)) if there else "",
    )  # fmt: skip


def _run(request: Request, name: str, word: str, commands: tuple[str, ...]) -> Response:
    if word == "save":
        return RedirectResponse(f"/text?file={name}", 303)
    if word not in commands:
        raise ArgumentError(f"{word[:40]!r}: is not a command for this file", remedy="use the buttons")
    folder, words = bench_of(request).folder, word.split()
    path = folder.toml(name)
    out = "" if words[0] == "check" else folder.name(path.with_name(f"{path.stem}-{words[-1]}"))
    command = [*words, name, *(["--out", out, "--force"] if out else [])]
    return start(request, command, word.capitalize(), name, out)


_EXPLORED = (
    Field("a_x", "specific force along the input axis", "0.02 g", typed="0.02 g", like="m/s^2", needed=True),
    Field("a_t", "transverse specific force", "5 g", typed="5 g", like="m/s^2", needed=True),
    Field("beta", "non-orthogonality \u03b2", "1000 arcsec", typed="1000 arcsec", like="rad", needed=True),
    Field("K", "scale factor K", "0.8884 rad/s/g", typed="0.8884 rad/s/g", like="rad/s/g", needed=True),
    Field("time", "time shown", "200 s", typed="200 s", like="s", needed=True),
)


def _explore(request: Request) -> Response:
    """The values of a constant input; with ``report``, the report on its motion that the page shows in a frame."""
    query = dict(request.query_params)
    fields = [field.with_sent(query) for field in _EXPLORED]
    is_refused = any(field.refusal for field in fields)
    if not is_refused:
        a_x, a_t, beta, K, shown = (field.value for field in fields)
        inst = Instrument(scale_factor=K, beta=beta)  # what no instrument has is refused here, not in the frame
        if "report" in query:
            page = constant_input_page(inst, to_si(a_x, "m/s^2"), to_si(a_t, "m/s^2"), abs(to_si(shown, "s")))
            return HTMLResponse(page_html(page), headers={"content-security-policy": REPORT_POLICY})
    words = "The motion of the gimbal under constant specific force. Every published case, computed and compared: piga reproduce."
    frame = "" if is_refused else f"/explore?report=1&{request.url.query}"
    code = 422 if is_refused else 200
    return _form(request, "Explore", words, {"": fields}, code, method="get", shown=frame)


ROUTES = [
    route("/certificate", _certificate),
    route("/compensate", _compensation),
    route("/plan", _plan),
    route("/text", _text),
    Route("/explore", _explore),
]
