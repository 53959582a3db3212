"""Certificate: its administrative part as form and text, a preview, the certificate itself, and the proof of a signed one."""

from __future__ import annotations

from contextlib import suppress
from urllib.parse import quote

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from piga.data import example_files
from piga.errors import ArgumentError, PigaError
from piga.records.text_files import toml_document
from piga.workbench.folder import Folder
from piga.workbench.forms import form_of_text, sent_text, typed_text
from piga.workbench.pages.common import Workbench, bench_of, only, redirect, render, sent_form, start_job
from piga.workbench.pages.records import calibrations, plain

PEM = (".pem", ".crt", ".cer")
"""Endings of keys and X.509 certificates."""
LARGEST_PEM = 1 << 20
"""Largest such file [bytes]."""
TITLES = ("Preview of the certificate", "Certificate", "Verify the certificate")


def administrative_parts(folder: Folder) -> list[str]:
    """Files of the folder that hold the administrative part of a certificate."""
    return [
        name
        for name in folder.listed("*.toml")
        if "[laboratory]" in (folder.root / name).read_text(encoding="utf-8", errors="replace")
    ]


def keys_and_certificates(folder: Folder) -> tuple[list[str], list[str]]:
    """Files of the folder that hold a private key, and those that hold an X.509 certificate. One may hold both."""
    keys, certificates = [], []
    for name in (name for name in folder.listed("*") if name.endswith(PEM)):
        path = folder.file(name)
        text = b""
        with suppress(OSError):  # others cannot read the key of a careful person
            text = path.read_bytes() if path.stat().st_size <= LARGEST_PEM else b""
        is_key = b"PRIVATE KEY-----" in text
        if is_key:
            keys.append(name)
        if not is_key or b"BEGIN CERTIFICATE-----" in text:
            certificates.append(name)
    return keys, certificates


def show(request: Request) -> Response:
    """The form of a certificate."""
    folder, query = bench_of(request).folder, request.query_params
    names = administrative_parts(folder)
    name = query.get("data", names[0] if names else "")
    text = (
        folder.file(name).read_text(encoding="utf-8", errors="replace")
        if name
        else example_files()["certificate.toml"].decode("utf-8")
    )
    return _page(request, name, text, query.get("calibration", ""))


def _page(
    request: Request, name: str, text: str, calibration: str, message: str = "", code: int = 200
) -> Response:
    bench = bench_of(request)
    jobs = bench.listed(lambda job: job.title in TITLES)
    keys, x509 = keys_and_certificates(bench.folder)
    return render(
        request, "certificate.html.jinja", code, form=form_of_text(text, "certificate", message), name=name,
        names=administrative_parts(bench.folder), calibration=calibration, calibrations=calibrations(bench.folder),
        keys=keys, x509=x509, signed=bench.folder.listed("**/*.xml"), jobs=jobs[:20],
    )  # fmt: skip


async def issue(request: Request) -> Response:
    """Save the administrative part; show a preview or issue the certificate."""
    fields = await sent_form(request)
    return await run_in_threadpool(_issue, request, fields)


def _issue(request: Request, fields: dict[str, list[str]]) -> Response:
    bench, word = bench_of(request), only(fields, "do")
    name, chosen = only(fields, "name"), only(fields, "calibration")
    text = typed_text(fields)
    if word not in ("save", "preview", "issue"):
        raise ArgumentError(f"{word!r}: is not a command of this page", remedy="use its buttons")
    try:
        text = sent_text(fields, "certificate")
        name = name if name.endswith(".toml") else f"{name}.toml"
        bench.folder.write_toml(bench.folder.path(name), text, toml_document)
    except PigaError as error:
        return _page(request, name, text, chosen, str(error), 422)
    if word == "save":
        return redirect(request, f"/certificate?data={quote(name)}&calibration={quote(chosen)}")
    calibration = bench.folder.file(chosen)
    subject = calibration.parent.name
    out = bench.new_trial() if word == "preview" else f"certificate-{plain(subject)}"
    command = ["certificate", "issue", bench.folder.name(calibration), "--data", name, "--out", out, "--force"]
    command += ["--dcc"] if only(fields, "dcc") else []
    for option in ("key", "certificate"):
        value = only(fields, option)
        command += [f"--{option}={bench.folder.name(bench.folder.file(value))}"] if value else []
    title = TITLES[0] if word == "preview" else TITLES[1]
    job = bench.start(command, title, subject, out, [bench.folder.path(name), calibration])
    return redirect(request, f"/jobs/{job.key}")


async def verify(request: Request) -> Response:
    """Verify a signed certificate of the folder."""
    bench: Workbench = bench_of(request)
    fields = await sent_form(request)
    signed = bench.folder.name(bench.folder.file(only(fields, "signed")))
    by = bench.folder.name(bench.folder.file(only(fields, "certificate")))
    command = ("certificate", "verify", signed, f"--certificate={by}")
    return await start_job(request, command, TITLES[2], signed)


ROUTES = [
    Route("/certificate", show, methods=["GET"]),
    Route("/certificate", issue, methods=["POST"]),
    Route("/certificate/verify", verify, methods=["POST"]),
]
