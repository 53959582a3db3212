"""The parser for XML from outside, and the enveloped signature of a certificate.

The parser refuses document types, entities, network access and huge trees. The signature covers the whole document
except itself. Verification trusts only the X.509 certificate that the laboratory gave to the reader, and hands on only what is
signed. The inside of the signature element is not signed, so nothing is read from it.
"""

from __future__ import annotations

import base64
import copy
import datetime as dt
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from piga.errors import DataError
from piga.text_files import read_whole

if TYPE_CHECKING:
    from lxml import etree


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
    from cryptography.hazmat.primitives.asymmetric import ec, rsa
    from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat, load_pem_private_key
    from signxml.signer import XMLSigner

    try:
        private: Any = load_pem_private_key(read_whole(key, _MAX_PEM, "a PEM file"), passphrase)
    except (ValueError, TypeError) as error:
        raise DataError(f"{key}: is not a usable private key: {error}", remedy="give a PEM file") from None
    if not isinstance(private, rsa.RSAPrivateKey | ec.EllipticCurvePrivateKey):
        raise DataError(f"{key}: neither an RSA nor an elliptic-curve key", remedy="use one of these")
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
