"""``piga certificate``: issue, verify and read back calibration certificates."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Annotated

import typer

from piga.cli.common import (
    App,
    ForceOption,
    JsonOption,
    argument,
    day_in,
    deliver,
    deliver_file,
    files_named_in,
    flag,
    note,
    option,
    tell,
)
from piga.errors import PigaError

RESULTS = ("certificate.html", "certificate.xml")
"""Names of the result files of ``issue``."""


app = App(
    "certificate", "Issue, verify and read back calibration certificates.\n\nBy ISO/IEC 17025, and as DCC."
)

PemOption = Annotated[Path | None, option("PEM", "X.509 certificate of the laboratory.")]
AtOption = Annotated[
    str | None, option("YYYY-MM-DD", "Day on which the X.509 certificate must be valid, instead of today.")
]


@app.command()
def issue(
    calibration: Annotated[Path, argument("CALIBRATION.json", "Calibration to certify.")],
    data: Annotated[Path, option("CERTIFICATE.toml", "Laboratory, customer, item, method and so on.")],
    out: Annotated[Path, option("DIR", "Folder for the certificate.")],
    issued: Annotated[
        str | None, option("YYYY-MM-DD|today", "Date of issue [default: that of the file, or today].")
    ] = None,
    dcc: Annotated[bool, flag("--dcc", "Also write certificate.xml (DCC 3.3.0).")] = False,
    key: Annotated[Path | None, option("PEM", "Private key that signs the XML.")] = None,
    certificate: PemOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write certificate.html (A4); with --dcc also certificate.xml.

    Refuses if anything is missing, and a number that another certificate in DIR has; keep a list of numbers for other folders.
    Prints the cautions of the calibration, for the person who authorises the certificate.
    """
    import hashlib

    from msgspec.structs import replace

    from piga.certificate.certificate_file import read_certificate_file
    from piga.certificate.dcc import dcc_document
    from piga.certificate.page import certificate_html, is_draft
    from piga.certificate.xml_signature import sign_xml, written
    from piga.output import check_results
    from piga.records.calibration.calibration import Calibration
    from piga.records.calibration.document import MOST_BYTES, calibration_from_bytes
    from piga.text_files import read_whole

    if (key is None) != (certificate is None):
        raise PigaError("--key and --certificate belong together", remedy="give both, or none")
    if key is not None and not dcc:
        raise PigaError("--key signs the XML, but no XML is written", remedy="add --dcc")
    file = read_certificate_file(data)
    if issued is not None or file.certificate.issued is None:
        today = issued in (None, "today")
        day = dt.datetime.now().astimezone() if today else day_in(str(issued), "--issued", ", or today")
        file = replace(file, certificate=replace(file.certificate, issued=day.date()))
    check_results(calibration.parent)
    raw = read_whole(calibration, MOST_BYTES, "a calibration.json", PigaError)  # once: its digest is shown
    certified = calibration_from_bytes(raw, calibration)
    former = file.adjustment.before
    before = Calibration.from_json(data.parent / former) if former else None
    html = certificate_html(file, certified, before, record_sha256=hashlib.sha256(raw).hexdigest())
    xml = None
    if dcc:
        root = dcc_document(file, certified, before)
        xml = written(root if key is None or certificate is None else sign_xml(root, key, certificate))
    if not force:
        _refuse_used_number(file.certificate.number, html, out)
    inputs = [calibration, *files_named_in(data), *(path for path in (key, certificate) if path is not None)]
    cautions = [doubt.words for doubt in certified.verdict.doubts]
    with deliver(out, "certificate", RESULTS, inputs, force=force, as_json=as_json) as to:
        (to / RESULTS[0]).write_bytes(html.encode())
        if xml is not None:
            (to / RESULTS[1]).write_bytes(xml)
        files = [f"{to.folder}/{name}" for name in RESULTS[: 1 if xml is None else 2]]
        document = {"number": file.certificate.number, "files": files, "cautions": cautions}
        to.tell(lambda: document, str)
    if is_draft(file):
        note("piga: DRAFT: named so, or laboratory or customer are those of the example; change them in --data")
    for words in [] if as_json else cautions:
        note(f"piga: caution: {words}")


def _refuse_used_number(number: str, html: str, out: Path) -> None:
    """Refuse a number that a different certificate in the folder or in one of its numbered folders has."""
    from markupsafe import escape

    line = f'<p class="number">{escape(number)}</p>'
    for path in [out / RESULTS[0], *sorted(out.glob(f"[0-9]*/{RESULTS[0]}"))]:
        if not path.is_file():
            continue
        there = path.read_text(encoding="utf-8", errors="replace")
        if line in there and there != html:
            raise PigaError(
                f"{path}: a different certificate has the number {number}",
                remedy="give a new number, and name the old one in [certificate] replaces; "
                "--force replaces a certificate that nobody has received",
            )


@app.command()
def verify(
    file: Annotated[Path, argument("CERTIFICATE.xml", "Signed DCC.")],
    certificate: Annotated[Path, option("PEM", "X.509 certificate that must have signed it.")],
    at: AtOption = None,
    as_json: JsonOption = False,
) -> None:
    """Verify a signed DCC.

    Checks the signature against the laboratory's certificate. For a DCC made by piga it also checks that all
    statements agree. If the certificate is not in force, the exit code is 2.
    """
    from piga.certificate.dcc import calibration_of, date_of_issue, is_ours
    from piga.certificate.xml_signature import verify_signature

    day = _day(at)
    signed = verify_signature(file, certificate)
    ours = is_ours(signed.document)
    serial = calibration_of(signed.document, file).serial if ours else None
    who = f"instrument {serial}" if ours else "not made by piga, so its statements were not compared"
    issued = date_of_issue(signed.document, file)
    why = signed.out_of_force(day)
    valid = f"{signed.valid_from:%Y-%m-%d} to {signed.valid_until:%Y-%m-%d}"
    was = "was" if signed.valid_from.date() <= issued <= signed.valid_until.date() else "was not"
    stated = f"on the date of issue that the file states, {issued}, it {was} in force"
    document = {
        "signature": "holds",
        "signer": signed.signer,
        "signer_in_force": not why,
        "judged_for": day.date().isoformat(),
        "certificate_valid": [signed.valid_from.isoformat(), signed.valid_until.isoformat()],
        "issued": issued.isoformat(),
        "made_by_piga": ours,
        "serial": serial,
        "remarks": list(signed.remarks),
    }
    when = "" if at is None else f" as of {day:%Y-%m-%d}"
    lines = [
        f"{file}: the signature holds{when}; {who}",
        f"  signed by  {signed.signer}",
        f"  whose certificate is valid {valid}",
    ]
    if why:
        first = f"{file}: the signer's X.509 certificate {why}; {stated}"
        lines = [first, f"  the signature itself holds; {who}", lines[1]]
    tell(as_json, document, lines)
    if was == "was not" and not why:
        note(f"piga: the signer's X.509 certificate is valid {valid}; {stated}")
    for remark in signed.remarks:
        note(f"piga: {remark}")
    if why:
        raise typer.Exit(2)


def _day(at: str | None) -> dt.datetime:
    """Now, or noon UTC of the given day."""
    if at is None:
        return dt.datetime.now(dt.UTC)
    return dt.datetime.combine(day_in(at, "--at").date(), dt.time(12), dt.UTC)


@app.command()
def read(
    file: Annotated[Path, argument("CERTIFICATE.xml", "DCC made by piga.")],
    out: Annotated[Path, option("CALIBRATION.json", "File for the calibration.")],
    certificate: PemOption = None,
    at: AtOption = None,
    force: ForceOption = False,
) -> None:
    """Read a DCC back into calibration.json.

    'piga compensate' takes the result. With --certificate the signature is verified first.
    """
    from piga.certificate.dcc import calibration_of
    from piga.certificate.xml_signature import SIGNATURE, read_xml, verify_signature

    inputs = [file, *([] if certificate is None else [certificate])]
    with deliver_file(out, "certificate-read", inputs, force=force) as to:
        day = _day(at)
        if certificate is None:
            root = read_xml(file)
            words = "not signed: anyone can have written it"
            if root.find(SIGNATURE) is not None:
                words = "its signature was not verified (--certificate does)"
        else:
            signed = verify_signature(file, certificate)
            why = signed.out_of_force(day)
            if why:
                raise PigaError(
                    f"{file}: the signer's X.509 certificate {why}",
                    remedy="ask the issuer; --at names the day for which it is to be judged",
                )
            root, words = signed.document, f"signed by {signed.signer}"
        calibration = calibration_of(root, file)
        calibration.to_json(to / out.name)
        count = len(calibration.coefficients)
        to.tell(dict, lambda: f"instrument {calibration.serial}, {count} coefficients; {words}")
