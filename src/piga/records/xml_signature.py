"""Enveloped XML signature of a certificate, and its verification against an expected X.509 certificate.

The signature covers the whole document but itself. Verification trusts one thing: the X.509 certificate that
the reader was given by the laboratory. What the file says about its own key counts for nothing.
"""

from __future__ import annotations

import base64
import datetime as dt
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from piga.errors import DataError
from piga.records.limits import read_whole
from piga.records.xml_file import read_xml

if TYPE_CHECKING:
    from lxml import etree

_DS = "{http://www.w3.org/2000/09/xmldsig#}"
_MAX_PEM = 1 << 20


@dataclass(frozen=True)
class VerifiedSignature:
    """A signature that holds.

    Attributes
    ----------
    document:
        Root element of what was signed: the only part to be trusted.
    signer:
        Subject of the X.509 certificate.
    valid_from, valid_until:
        Validity of that certificate; whether it was in force when signing is not known without a time stamp.
    remarks:
        What is odd about parts that the signature does not cover.
    """

    document: etree._Element
    signer: str
    valid_from: dt.datetime
    valid_until: dt.datetime
    remarks: tuple[str, ...]


def sign_xml(
    root: etree._Element, key: Path, certificate: Path, passphrase: bytes | None = None
) -> etree._Element:
    """Sign a document with a private key and its X.509 certificate (PEM; RSA or elliptic curve).

    Raises
    ------
    DataError
        If key or certificate cannot be read, or do not belong together.
    """
    from cryptography.hazmat.primitives.asymmetric import ec, rsa
    from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat, load_pem_private_key
    from signxml.signer import XMLSigner

    try:
        private: Any = load_pem_private_key(read_whole(key, _MAX_PEM, "a PEM file"), passphrase)
    except (ValueError, TypeError) as error:
        raise DataError(f"{key}: no private key that can be used: {error}", remedy="give a PEM file") from None
    if not isinstance(private, rsa.RSAPrivateKey | ec.EllipticCurvePrivateKey):
        raise DataError(f"{key}: neither an RSA nor an elliptic-curve key", remedy="use one of these")
    public = load_certificate(certificate)
    form = (Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    if private.public_key().public_bytes(*form) != public.public_key().public_bytes(*form):
        raise DataError(f"{key}: is not the key of {certificate}", remedy="give the key and its certificate")
    algorithm = "rsa-sha256" if isinstance(private, rsa.RSAPrivateKey) else "ecdsa-sha256"
    return XMLSigner(signature_algorithm=algorithm).sign(root, key=private, cert=[public])


def verify_signature(path: Path, certificate: Path) -> VerifiedSignature:
    """Verify the signature of a file against the X.509 certificate that is expected.

    Raises
    ------
    DataError
        If the file is not signed, was changed, was signed by somebody else, or the signature does not cover
        the whole document.
    """
    raw, root = read_xml(path)
    expected = load_certificate(certificate)
    found = [child for child in root if child.tag == f"{_DS}Signature"]
    if not found:
        raise DataError(f"{path}: is not signed", remedy="ask the issuer for the signed certificate")
    if len(found) > 1 or sum(1 for _ in root.iter(f"{_DS}Signature")) > 1:
        raise DataError(f"{path}: holds more than one signature", remedy="ask the issuer for the certificate")
    references = found[0].findall(f"{_DS}SignedInfo/{_DS}Reference")
    if len(references) != 1 or references[0].get("URI") != "":
        raise DataError(
            f"{path}: the signature does not cover the whole document", remedy="do not use the file"
        )
    document = _verified(path, root, expected)
    if document.tag != root.tag:
        raise DataError(
            f"{path}: the signature does not cover the whole document", remedy="do not use the file"
        )
    return VerifiedSignature(
        document,
        expected.subject.rfc4514_string(),
        expected.not_valid_before_utc,
        expected.not_valid_after_utc,
        _remarks(raw, root, found[0], expected),
    )


def _verified(path: Path, root: etree._Element, expected: Any) -> etree._Element:
    """The signed part, after the check by the library."""
    from cryptography.exceptions import InvalidSignature
    from lxml import etree
    from signxml.algorithms import DigestAlgorithm, SignatureMethod
    from signxml.exceptions import SignXMLException
    from signxml.verifier import SignatureConfiguration, XMLVerifier

    methods = ("RSA_SHA256", "RSA_SHA384", "RSA_SHA512", "ECDSA_SHA256", "ECDSA_SHA384", "ECDSA_SHA512")
    configuration = SignatureConfiguration(
        location="./",
        expect_references=1,
        signature_methods=frozenset(SignatureMethod[name] for name in methods),
        digest_algorithms=frozenset(DigestAlgorithm[name] for name in ("SHA256", "SHA384", "SHA512")),
        verification_time=expected.not_valid_before_utc,
    )
    try:
        result = XMLVerifier().verify(etree.tostring(root), x509_cert=expected, expect_config=configuration)
    except (SignXMLException, InvalidSignature, etree.LxmlError, ValueError, KeyError, AssertionError) as error:
        raise DataError(
            f"{path}: the signature does not hold: {str(error) or type(error).__name__}",
            remedy="the file was changed or signed by somebody else: do not use it",
        ) from None
    if isinstance(result, list) or result.signed_xml is None:
        raise DataError(f"{path}: the signature does not hold", remedy="do not use the file")
    return result.signed_xml


def _remarks(raw: bytes, root: etree._Element, signature: etree._Element, expected: Any) -> tuple[str, ...]:
    """Differences in what no signature covers: the key named in the file, and how the XML is written."""
    from cryptography.hazmat.primitives.serialization import Encoding
    from lxml import etree

    found = []
    if any(node.tag in (etree.Comment, etree.PI) for node in root.iter()) or root.getprevious() is not None:
        found.append("the file holds comments, which no signature covers")
    body = expected.public_bytes(Encoding.PEM).decode().split("-----")[2].lstrip()
    named = [node.text or "" for node in signature.iter(f"{_DS}X509Certificate")]
    if ["".join(text.split()) for text in named] != ["".join(body.split())]:
        found.append(
            "the file names another X.509 certificate than the expected one; the signature is by the expected"
        )
    encoded = [node.text or "" for node in signature.iter(f"{_DS}SignatureValue", f"{_DS}DigestValue")]
    if written(root) != raw or named != [body] or any(text != _canonical(text) for text in encoded):
        found.append("the file is written in another way than piga writes it; what is signed is unchanged")
    return tuple(found)


def _canonical(text: str) -> str:
    """Base64 as an encoder writes it (decoders overlook stray letters)."""
    return base64.b64encode(base64.b64decode(text)).decode("ascii")


def written(root: etree._Element) -> bytes:
    """The bytes that piga writes for a document."""
    from lxml import etree

    return etree.tostring(root, xml_declaration=True, encoding="UTF-8") + b"\n"


def load_certificate(path: Path) -> Any:
    """The X.509 certificate of a PEM file.

    Raises
    ------
    DataError
        If it cannot be read.
    """
    from cryptography import x509

    try:
        return x509.load_pem_x509_certificate(read_whole(path, _MAX_PEM, "a PEM file"))
    except ValueError as error:
        raise DataError(f"{path}: no X.509 certificate in PEM: {error}", remedy="check the file") from None
