"""Write a Digital Calibration Certificate, and read one back (DCC 3.3.0, D-SI 2.2.1, SI only).

The certificate states the coefficients one by one with expanded uncertainty for people, and as one vector with its covariance
matrix for programs. Three attachments hold all that piga wrote it from: the calibration, the data of the certificate, and the
calibration before adjustment if there is one. So reading is writing again: the two documents must be equal, and the first
difference is named by its place.
The parser refuses document types, entities, network access and huge trees. The signature covers the whole document except
itself. Verification trusts only the X.509 certificate that the laboratory gave to the reader, and hands on only what is signed.
"""

from __future__ import annotations

import base64
import binascii
import copy
import datetime as dt
import math
import re
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import msgspec

from piga._version import __version__
from piga.certificate.certificate_file import (
    CertificateFile,
    ConditionTable,
    quantity_text,
    statement_facts,
    title_of,
    verdicts,
)
from piga.errors import DataError
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.coefficient import PROBABILITY, joint_factor
from piga.records.calibration.document import calibration_from_bytes, calibration_to_bytes
from piga.reports.render.page import template
from piga.text_files import converted, read_whole
from piga.units import offset_to_si, parse_unit

if TYPE_CHECKING:
    from lxml import etree

DCC, SI = "https://ptb.de/dcc", "https://ptb.de/si"
NAMES = {"dcc": DCC, "si": SI}
RECORD, DATA, _BEFORE = "piga_calibrationRecord", "piga_certificateData", "piga_calibrationBefore"
"""``refType`` of the attached calibration, of the data of the certificate, and of the calibration before adjustment."""
_AGAIN = "do not use the file; get it again from the issuer"
_ROUNDED = ("valueExpandedMU", "coverageFactor", "coverageFactorXMLList")
"""Numbers that hold a quantile. Libraries differ in its last digits."""
_SLACK = Decimal("1e-6")
"""Relative difference allowed in them."""
_CONDITIONS = {"air temperature": "basic_temperature", "relative humidity": "basic_humidityRelative"}


def dcc_document(
    data: CertificateFile, calibration: Calibration, before: Calibration | None = None, release: str = ""
) -> etree._Element:
    """The certificate as XML, as piga of this or of another release writes it.

    ``data`` must be complete (:func:`piga.certificate.certificate_file.missing_items`).
    """
    from lxml import etree

    rendered = template("dcc.xml.jinja").render(
        data=data,
        calibration=calibration,
        before=before,
        release=release or _own_release(),
        facts=statement_facts(data, calibration),
        conditions=[_condition(condition) for condition in data.environment],
        marks={verdict.key: verdict.status for verdict in verdicts(data, calibration)},
        joint_factor=joint_factor(calibration.coefficients),
        probability=PROBABILITY,
        written_data=base64.b64encode(msgspec.json.encode(data)).decode(),
        record=lambda one: base64.b64encode(calibration_to_bytes(one)).decode(),
        line=lambda words: " ".join(words.split()),
        si=to_dsi,
        unit=dsi_unit,
        label=label_of,
        title_of=title_of,
    )
    try:
        root = etree.fromstring(rendered.encode(), etree.XMLParser(remove_blank_text=True))
    except etree.XMLSyntaxError as error:
        raise DataError(
            f"certificate: a text of the data or of the calibration cannot stand in XML: {error}",
            remedy="write it with letters, digits and signs; with a huge calibration: phases = 'shared', or fewer segments",
        ) from None
    etree.indent(root)
    return root


def _condition(condition: ConditionTable) -> dict[str, str]:
    """A condition of the environment in SI, as texts: 20.1 degC gives 293.25 K."""
    number, unit = quantity_text(condition.value)
    spread = quantity_text(condition.uncertainty) if condition.uncertainty else None
    return {
        "name": condition.name,
        "kind": _CONDITIONS.get(condition.name.lower(), ""),
        "value": f"{number * parse_unit(unit).factor + offset_to_si(unit):.12g}",
        "unit": dsi_unit(unit),
        "uncertainty": f"{spread[0] * parse_unit(spread[1]).factor:.12g}" if spread else "",
    }


def read_dcc(path: str | Path) -> Calibration:
    """Read a certificate in XML, made by piga, back into a calibration. One that contradicts itself is refused."""
    path = Path(path)
    return calibration_of(read_xml(path), path)


def calibration_of(root: etree._Element, path: Path) -> Calibration:
    """The calibration in a certificate. Messages name ``path``. Errors as in :func:`read_dcc`."""
    if root.tag != f"{{{DCC}}}digitalCalibrationCertificate":
        raise DataError(f"{path}: is not a Digital Calibration Certificate", remedy="name a certificate in XML")
    if len(root) and root[-1].tag == SIGNATURE:
        root = copy.deepcopy(root)
        root.remove(root[-1])
    version = root.get("schemaVersion", "")
    if not version.startswith("3."):
        remedy = "ask the issuer for one of version 3" if version[:2] in ("1.", "2.") else "update piga"
        raise DataError(f"{path}: DCC version '{version[:20]}' is not known", remedy=remedy)
    raw, data = _attached(root, RECORD, path), _attached(root, DATA, path)
    if raw is None:
        raise DataError(
            f"{path}: holds no calibration record of piga",
            remedy="only certificates made by piga can be read back",
        )
    if data is None:
        raise DataError(
            f"{path}: lacks the attached data of the certificate",
            remedy="read a certificate of piga 0.2 with that version; for any other, get the file again from the issuer",
        )
    calibration = calibration_from_bytes(raw, path)
    release = root.findtext("dcc:administrativeData/dcc:dccSoftware/dcc:software/dcc:release", "", NAMES)
    before = _attached(root, _BEFORE, path)
    former = None if before is None else calibration_from_bytes(before, path)
    try:
        file = converted(msgspec.json.decode(data), CertificateFile)
        again = dcc_document(file, calibration, former, release)
    except (msgspec.MsgspecError, AttributeError, LookupError, OverflowError, TypeError, ValueError) as error:
        raise DataError(
            f"{path}: the attached data are damaged, or do not fit the attached calibration ({error})",
            remedy=_AGAIN,
        ) from None
    _compare_trees(root, again, path, words=release == _own_release())
    return calibration


def _own_release() -> str:
    release = re.match(r"\d{1,3}(\.\d{1,3}){0,3}", __version__)
    return f"v{release[0] if release else 0}"


def _attached(root: etree._Element, kind: str, path: Path) -> bytes | None:
    """The bytes of an attachment; None if there is none."""
    attachments = root.findall(f"dcc:measurementResults//dcc:byteData[@refType='{kind}']/dcc:dataBase64", NAMES)
    if not attachments:
        return None
    try:
        if len(attachments) > 1:
            raise DataError(f"{path}: holds {len(attachments)} attachments {kind}", remedy=_AGAIN)
        return base64.b64decode("".join((attachments[0].text or "").split()), validate=True)
    except (binascii.Error, ValueError):
        raise DataError(f"{path}: the attached record is damaged", remedy=_AGAIN) from None


def is_ours(root: etree._Element) -> bool:
    """True if a certificate holds a calibration record of piga."""
    return root.find(f"dcc:measurementResults//dcc:byteData[@refType='{RECORD}']", NAMES) is not None


def date_of_issue(root: etree._Element, path: Path) -> dt.date:
    """The date of issue of a certificate. Messages name ``path``."""
    text = root.findtext("dcc:administrativeData/dcc:coreData/dcc:issueDate", "", NAMES)
    try:
        return dt.date.fromisoformat(text)
    except ValueError:
        raise DataError(f"{path}: issueDate '{text[:40]}' is not a date", remedy=_AGAIN) from None


def _compare_trees(stated: etree._Element, again: etree._Element, path: Path, *, words: bool) -> None:
    """Refuse a certificate ``stated`` that differs from what piga writes ``again``. The first difference is named.

    Without ``words`` sentences are not compared: another release of piga may word them otherwise.
    """
    if any(True for before in (True, False) for _ in stated.itersiblings(preceding=before)):
        raise DataError(f"{path}: holds comments or instructions, which piga does not write", remedy=_AGAIN)
    for one, other in zip(stated.iter(), again.iter(), strict=False):
        beside = "" if one is stated else (one.tail or "").strip()
        if (one.tag, dict(one.attrib), len(one), beside) != (other.tag, dict(other.attrib), len(other), ""):
            raise _contradiction(path, other, "is not there as piga writes it, alone and with its parts")
        text, expected = (one.text or "").strip(), (other.text or "").strip()
        if (words or one.tag != f"{{{DCC}}}content") and not _equal(text, expected, one.tag.rpartition("}")[2]):
            raise _contradiction(path, one, f"is '{text[:60]}', by the attached records '{expected[:60]}'")


def _equal(text: str, expected: str, name: str) -> bool:
    if text == expected or name not in _ROUNDED:
        return " ".join(text.split()) == " ".join(expected.split())
    try:
        return abs(Decimal(text) - Decimal(expected)) <= _SLACK * abs(Decimal(expected))
    except InvalidOperation:
        return False


def _contradiction(path: Path, node: etree._Element, what: str) -> DataError:
    return DataError(
        f"{path}: contradicts itself: {_place(node)} {what}", remedy="do not use the file; ask the issuer"
    )


def _place(node: etree._Element) -> str:
    """Names of an element and of the elements around it, with the label of the quantity that it belongs to."""
    around = [node, *node.iterancestors()]
    names = [str(one.tag).rpartition("}")[2] for one in reversed(around)]
    labels = (one.findtext("si:real/si:label", None, NAMES) for one in around)
    label = next((label for label in labels if label), "")
    return "/".join(names[1:][-4:] or names) + (f" of {label[:60]}" if label else "")


def label_of(key: str) -> str:
    """A coefficient's key without spaces (segment labels may contain spaces)."""
    return quote(key, safe="[]_.,:;+-=()/*")


_BASE = (r"\metre", r"\second", r"\radian", r"\kilogram", r"\kelvin", r"\volt", "", r"\ampere")
"""D-SI names of the base units of piga. A count is a plain number."""


@lru_cache(maxsize=256)
def dsi_unit(*units: str) -> str:
    r"""D-SI text of a unit, or of the product of several units.

    Examples
    --------
    >>> dsi_unit("g/g^2"), dsi_unit("g", "rad")
    ('\\metre\\tothe{-1}\\second\\tothe{2}', '\\metre\\second\\tothe{-2}\\radian')
    """
    totals = [sum(column) for column in zip(*(parse_unit(unit).dimension for unit in units), strict=True)]
    parts = [_powered(name, power) for name, power in zip(_BASE, totals, strict=True) if power and name]
    return "".join(parts) or r"\one"


def _powered(name: str, power: float) -> str:
    return name if power == 1.0 else f"{name}\\tothe{{{power:g}}}"


def to_dsi(value: float, *units: str) -> str:
    """SI text of a number in the product of these units."""
    return repr(float(value) * math.prod(parse_unit(unit).factor for unit in units))


# -- XML from outside and its signature ---------------------------------------------------------------

MOST_XML_BYTES = 32 << 20
"""Largest XML file read [bytes]."""


def read_xml(path: Path) -> etree._Element:
    """Root element of an XML file."""
    return parse_xml(read_whole(path, MOST_XML_BYTES, "a certificate in XML"), path)


def parse_xml(raw: bytes, path: Path) -> etree._Element:
    """Root element of XML bytes. Messages name ``path``."""
    from lxml import etree

    if raw[:1] == b"\x30":
        raise DataError(
            f"{path}: is an envelope (CMS, PKCS #7), not XML: the certificate is inside it",
            remedy=f"take it out: openssl cms -verify -inform DER -in {path.name} -CAfile AUTHORITY.pem -out certificate.xml",
        )
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, dtd_validation=False, huge_tree=False
    )
    try:
        root = etree.fromstring(raw, parser)
    except (etree.XMLSyntaxError, ValueError) as error:
        raise DataError(f"{path}: not valid XML: {error}", remedy="get the file again") from None
    info = root.getroottree().docinfo
    if info.internalDTD is not None or info.doctype or any(node.tag is etree.Entity for node in root.iter()):
        raise DataError(
            f"{path}: declares a document type, which a certificate does not need and which can hide attacks",
            remedy="ask the issuer for the plain certificate",
        )
    return root


_DS = "{http://www.w3.org/2000/09/xmldsig#}"
_MAX_PEM = 1 << 20
_LEAST_BITS = {"RSA": 2048, "EC": 256}
"""Shortest accepted key of each kind [bits]."""
_C14N = "http://www.w3.org/2006/12/xml-c14n11"
_METHODS = tuple(f"{kind}_SHA{bits}" for kind in ("RSA", "ECDSA") for bits in (256, 384, 512))
_DIGESTS = ("SHA256", "SHA384", "SHA512")
"""Accepted algorithms, by their names in signxml."""
SIGNATURE = f"{_DS}Signature"
_XADES = "{http://uri.etsi.org/01903/v1.3.2#}QualifyingProperties"
_NOT_VERIFIED = (
    "the signature holds properties by XAdES (time stamps, revocation data), which were not verified: ask the signer's "
    "authority whether its certificate was revoked"
)


@dataclass(frozen=True)
class _VerifiedSignature:
    """A valid signature. Only ``document``, the root element of the signed part, can be trusted.

    ``signer`` is the subject of the X.509 certificate, valid from ``valid_from`` until ``valid_until``; without a time stamp
    it is unknown whether it was in force at signing. ``remarks``: what else the signature holds, and was not verified.
    """

    document: etree._Element
    signer: str
    valid_from: dt.datetime
    valid_until: dt.datetime
    remarks: tuple[str, ...]

    def out_of_force(self, at: dt.datetime) -> str:
        """The reason why the X.509 certificate was not in force at a time, with its dates; empty if it was."""
        return _out_of_force(self.valid_from, self.valid_until, at)


def sign_xml(
    root: etree._Element, key: Path, certificate: Path, passphrase: bytes | None = None
) -> etree._Element:
    """Sign a document with a private key and its X.509 certificate (PEM; RSA or elliptic curve)."""
    from cryptography.hazmat.primitives.asymmetric import rsa
    from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat, load_pem_private_key
    from signxml.signer import XMLSigner

    try:
        private: Any = load_pem_private_key(read_whole(key, _MAX_PEM, "a PEM file"), passphrase)
    except (ValueError, TypeError) as error:
        raise DataError(f"{key}: is not a usable private key: {error}", remedy="give a PEM file") from None
    public = load_certificate(certificate)
    form = (Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    if private.public_key().public_bytes(*form) != public.public_key().public_bytes(*form):
        raise DataError(f"{key}: is not the key of {certificate}", remedy="give the key and its certificate")
    why = _out_of_force(public.not_valid_before_utc, public.not_valid_after_utc, dt.datetime.now(dt.UTC))
    if why:
        raise DataError(f"{certificate}: the X.509 certificate {why}", remedy="sign with one that is in force")
    algorithm = "rsa-sha256" if isinstance(private, rsa.RSAPrivateKey) else "ecdsa-sha256"
    signer = XMLSigner(signature_algorithm=algorithm, digest_algorithm="sha256", c14n_algorithm=_C14N)
    return signer.sign(root, key=private, cert=[public])


def verify_signature(path: Path, certificate: Path) -> _VerifiedSignature:
    """Verify the signature of a file against the expected X.509 certificate.

    Refused is one that is not signed, was changed, has another signer, one on a revocation list in the file, or whose signature
    does not cover the whole document.
    """
    root = read_xml(path)
    expected = load_certificate(certificate)
    if not len(root) or root[-1].tag != SIGNATURE:
        raise DataError(f"{path}: is not signed", remedy="ask the issuer for the signed certificate")
    if len(list(root.iter(SIGNATURE))) > 1:
        raise DataError(
            f"{path}: holds more than one signature: the signature does not hold", remedy="do not use the file"
        )
    document, revoked = _verified(path, root, expected), _revoked(root[-1], expected)
    if revoked is not None:
        raise DataError(
            f"{path}: the X.509 certificate of the signer was revoked on {revoked:%Y-%m-%d}, by the list of its authority in "
            "the file",
            remedy="do not use the file, and ask the laboratory",
        )
    return _VerifiedSignature(
        document,
        expected.subject.rfc4514_string(),
        expected.not_valid_before_utc,
        expected.not_valid_after_utc,
        () if root[-1].find(f".//{_XADES}") is None else (_NOT_VERIFIED,),
    )


def _out_of_force(start: dt.datetime, end: dt.datetime, at: dt.datetime) -> str:
    if start <= at <= end:
        return ""
    word = "is not yet valid" if at < start else "has expired"
    return f"{word}: valid from {start:%Y-%m-%d} to {end:%Y-%m-%d}, judged for {at:%Y-%m-%d}"


def _verified(path: Path, root: etree._Element, expected: Any) -> etree._Element:
    """The signed part, after the library has verified it."""
    from cryptography.exceptions import InvalidSignature
    from lxml import etree
    from signxml.algorithms import DigestAlgorithm, SignatureMethod
    from signxml.exceptions import SignXMLException
    from signxml.verifier import SignatureConfiguration, XMLVerifier

    for transform in root[-1].iterfind(f"{_DS}SignedInfo/{_DS}Reference/{_DS}Transforms/{_DS}Transform"):
        kind = transform.get("Algorithm", "")
        if not kind.endswith("xmldsig#enveloped-signature") and "c14n" not in kind:
            raise DataError(
                f"{path}: is signed after the transform {kind[:80]}, which piga does not verify",
                remedy="verify it with the program of its issuer",
            )
    configuration = SignatureConfiguration(
        location="./",
        expect_references=True,
        signature_methods=frozenset(getattr(SignatureMethod, name) for name in _METHODS),
        digest_algorithms=frozenset(getattr(DigestAlgorithm, name) for name in _DIGESTS),
        verification_time=expected.not_valid_before_utc,
    )
    try:
        results = XMLVerifier().verify(etree.tostring(root), x509_cert=expected, expect_config=configuration)
    except (SignXMLException, InvalidSignature, etree.LxmlError, ValueError, KeyError, AssertionError) as error:
        raise DataError(
            f"{path}: the signature does not hold: {str(error) or type(error).__name__}",
            remedy="the file was changed or signed by somebody else: do not use it",
        ) from None
    whole = copy.deepcopy(root)  # comments are not signed, and not handed on
    whole.remove(whole[-1])
    text = etree.tostring(whole, method="c14n", with_comments=False)
    for result in results if isinstance(results, list) else [results]:
        signed = result.signed_xml
        if signed is not None and etree.tostring(signed, method="c14n", with_comments=False) == text:
            return signed
    raise DataError(f"{path}: the signature does not cover the whole document", remedy="do not use the file")


def _revoked(signature: etree._Element, expected: Any) -> dt.datetime | None:
    """When the signer's certificate was revoked, by a list of its authority among the XAdES properties; None if none says so.

    The signature of the list is not verified: a false list can only have a good file refused.
    """
    from cryptography import x509

    for node in signature.iter("{*}EncapsulatedCRLValue"):
        try:
            found = x509.load_der_x509_crl(base64.b64decode(node.text or ""))
            entry = found.get_revoked_certificate_by_serial_number(expected.serial_number)
        except ValueError:
            continue
        if entry is not None and found.issuer == expected.issuer:
            return entry.revocation_date_utc
    return None


def written(root: etree._Element) -> bytes:
    """The bytes that piga writes for a document."""
    from lxml import etree

    return etree.tostring(root, xml_declaration=True, encoding="UTF-8") + b"\n"


def load_certificate(path: Path) -> Any:
    """The X.509 certificate of a PEM file."""
    from cryptography import x509
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.asymmetric import ec, rsa

    try:
        certificate = x509.load_pem_x509_certificate(read_whole(path, _MAX_PEM, "a PEM file"))
        key = certificate.public_key()
    except (ValueError, UnsupportedAlgorithm) as error:
        raise DataError(
            f"{path}: is not an X.509 certificate in PEM: {error}", remedy="check the file"
        ) from None
    if not isinstance(key, rsa.RSAPublicKey | ec.EllipticCurvePublicKey):
        raise DataError(f"{path}: its key is neither RSA nor on an elliptic curve", remedy="use one of these")
    kind = "RSA" if isinstance(key, rsa.RSAPublicKey) else "EC"
    if key.key_size < _LEAST_BITS[kind]:
        raise DataError(
            f"{path}: its {kind} key has {key.key_size} bits, fewer than {_LEAST_BITS[kind]}",
            remedy=f"use a key of {_LEAST_BITS[kind]} bits or more",
        )
    return certificate
