"""The parser for XML from outside, and the enveloped signature of a certificate.

The parser refuses document types, entities, network access and huge trees. The signature covers the whole document
except itself. Verification trusts only the X.509 certificate that the laboratory gave to the reader. A signature does
not cover the inside of its own element, so that element must match a profile (:func:`check_profile`): exactly what
piga writes.
"""

from __future__ import annotations

import base64
import binascii
import datetime as dt
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from piga.errors import DataError
from piga.records.limits import read_whole

if TYPE_CHECKING:
    from lxml import etree


MOST_XML_BYTES = 32 << 20
"""Largest XML file read [bytes]."""


def read_xml(path: Path) -> tuple[bytes, etree._Element]:
    """Bytes and root element of an XML file.

    Raises
    ------
    DataError
        If the file cannot be read, is too large, is not XML, or declares a document type or entities.
    """
    raw = read_whole(path, MOST_XML_BYTES, "a certificate in XML")
    return raw, parse_xml(raw, path)


def parse_xml(raw: bytes, path: Path) -> etree._Element:
    """Root element of XML bytes. Messages name ``path``. Errors as in :func:`read_xml`."""
    from lxml import etree

    if b"<!DOCTYPE" in raw:
        raise _forbidden(path)
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, dtd_validation=False, huge_tree=False
    )
    try:
        root = etree.fromstring(raw, parser)
    except (etree.XMLSyntaxError, ValueError) as error:
        raise DataError(f"{path}: not valid XML: {error}", remedy="get the file again") from None
    info = root.getroottree().docinfo
    if info.internalDTD is not None or info.doctype or any(node.tag is etree.Entity for node in root.iter()):
        raise _forbidden(path)
    return root


def _forbidden(path: Path) -> DataError:
    return DataError(
        f"{path}: declares a document type, which a certificate does not need and which can hide attacks",
        remedy="ask the issuer for the plain certificate",
    )


_DS = "{http://www.w3.org/2000/09/xmldsig#}"
_MAX_PEM = 1 << 20
_LEAST_BITS = {"RSA": 2048, "EC": 256}
"""Shortest accepted key of each kind [bits]."""
_C14N = "http://www.w3.org/2006/12/xml-c14n11"
_METHODS = (
    "http://www.w3.org/2001/04/xmldsig-more#rsa-sha256",
    "http://www.w3.org/2001/04/xmldsig-more#ecdsa-sha256",
)
_PROFILE: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("Signature", "", ()),
    ("Signature/SignedInfo", "", ()),
    ("Signature/SignedInfo/CanonicalizationMethod", "Algorithm", (_C14N,)),
    ("Signature/SignedInfo/SignatureMethod", "Algorithm", _METHODS),
    ("Signature/SignedInfo/Reference", "URI", ("",)),
    ("Signature/SignedInfo/Reference/Transforms", "", ()),
    (
        "Signature/SignedInfo/Reference/Transforms/Transform",
        "Algorithm",
        ("http://www.w3.org/2000/09/xmldsig#enveloped-signature",),
    ),
    ("Signature/SignedInfo/Reference/Transforms/Transform", "Algorithm", (_C14N,)),
    (
        "Signature/SignedInfo/Reference/DigestMethod",
        "Algorithm",
        ("http://www.w3.org/2001/04/xmlenc#sha256",),
    ),
    ("Signature/SignedInfo/Reference/DigestValue", "", ()),
    ("Signature/SignatureValue", "", ()),
    ("Signature/KeyInfo", "", ()),
    ("Signature/KeyInfo/X509Data", "", ()),
    ("Signature/KeyInfo/X509Data/X509Certificate", "", ()),
)
"""The elements of a signature in order, each with its only attribute and the allowed values."""
_WITH_TEXT = ("DigestValue", "SignatureValue", "X509Certificate")


@dataclass(frozen=True)
class VerifiedSignature:
    """A valid signature.

    Attributes
    ----------
    document:
        Root element of the signed part. Only this part can be trusted.
    signer:
        Subject of the X.509 certificate.
    valid_from, valid_until:
        Validity of that certificate. Without a time stamp it is unknown whether it was in force at signing.
    remarks:
        Remarks on unusual formatting of the file.
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
    """Sign a document with a private key and its X.509 certificate (PEM; RSA or elliptic curve).

    Raises
    ------
    DataError
        If key or certificate cannot be read, the key is too short, they do not belong together, or the certificate
        is not in force now.
    """
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


def verify_signature(path: Path, certificate: Path) -> VerifiedSignature:
    """Verify the signature of a file against the expected X.509 certificate.

    Raises
    ------
    DataError
        If the file is not signed, was changed, was signed with another certificate, or the signature does not cover
        the whole document.
    """
    raw, root = read_xml(path)
    expected = load_certificate(certificate)
    signature = check_profile(root, path)
    if signature is None:
        raise DataError(f"{path}: is not signed", remedy="ask the issuer for the signed certificate")
    _check_named(path, signature, expected)
    document = _verified(path, root, expected)
    if document.tag != root.tag or _without_signature(root) != _without_signature(document):
        raise DataError(
            f"{path}: the signature does not cover the whole document", remedy="do not use the file"
        )
    return VerifiedSignature(
        document,
        expected.subject.rfc4514_string(),
        expected.not_valid_before_utc,
        expected.not_valid_after_utc,
        _remarks(raw, root, signature, expected),
    )


def check_profile(root: etree._Element, path: Path) -> etree._Element | None:
    """Check the signature element of a document against the profile, and return it; None if there is no signature.

    The profile: The document has one signature, as its last child. It has exactly the elements, attributes and
    algorithms that :func:`sign_xml` writes, once each and in order: one reference to the whole document (URI ""),
    two transforms (enveloped signature, Canonical XML 1.1), SHA-256, one X.509 certificate. Three elements hold
    Base64 text, the others no text. A signed document has no comments, because no signature covers them. Messages
    name ``path``.

    Raises
    ------
    DataError
        If the document does not match the profile.
    """
    from lxml import etree

    ours = list(root.iter(f"{_DS}*"))
    if not ours:
        return None
    tops = [node for node in ours if node.tag == f"{_DS}Signature"]
    if len(tops) > 1:
        raise _outside(path, "holds more than one signature")
    signature = root[-1]
    if not tops or tops[0] is not signature:
        raise _outside(path, "the signature is not the last element of the document")
    if len(ours) != sum(1 for _ in signature.iter()):
        raise _outside(path, "holds what is not part of a signature in it, or parts of a signature outside it")
    if root.getprevious() is not None or root.getnext() is not None:
        raise _outside(path, "holds comments or instructions, which the signature does not cover")
    if any(node.tag is etree.Comment for node in root.iter()):
        raise _outside(path, "holds comments, which the signature does not cover")
    _check_elements(path, signature)
    return signature


def _check_elements(path: Path, signature: etree._Element) -> None:
    """Check elements, attributes and texts of a signature one by one against the profile."""
    seen = [(_place(node), node) for node in signature.iter()]
    for index, (place, node) in enumerate(seen):
        name = place.rpartition("/")[2]
        if index >= len(_PROFILE) or place != _PROFILE[index][0]:
            raise _outside(path, f"the signature holds '{name[:40]}' where it should not")
        _, attribute, values = _PROFILE[index]
        if sorted(map(str, node.attrib)) != ([attribute] if attribute else []) or node.nsmap != signature.nsmap:
            raise _outside(path, f"'{name}' of the signature has other attributes")
        if attribute == "URI" and node.get("URI") != "":
            raise _outside(path, "the signature does not cover the whole document")
        if attribute and node.get(attribute) not in values:
            raise _outside(path, f"'{name}' of the signature names {(node.get(attribute) or 'nothing')[:80]}")
        text = node.text or ""
        if (name in _WITH_TEXT and not _is_base64(text)) or (name not in _WITH_TEXT and text.strip()):
            raise _outside(path, f"'{name}' of the signature holds other text")
        if (node.tail or "").strip():
            raise _outside(path, f"text stands behind '{name}' of the signature")
    if len(seen) != len(_PROFILE):
        raise _outside(path, f"the signature lacks '{_PROFILE[len(seen)][0].rpartition('/')[2]}'")


def _outside(path: Path, what: str) -> DataError:
    return DataError(
        f"{path}: {what}: the signature does not hold", remedy="do not use the file; ask the issuer"
    )


def _place(node: etree._Element) -> str:
    """Names of an element of the signature and of its parents."""
    name = str(node.tag).removeprefix(_DS)
    around = node.getparent()
    at_top = around is None or not str(around.tag).startswith(_DS)
    return name if at_top or around is None else f"{_place(around)}/{name}"


def _is_base64(text: str) -> bool:
    """True for Base64 as an encoder writes it, with or without line breaks. Decoders ignore stray characters."""
    joined = "".join(text.split())
    try:
        return bool(joined) and base64.b64encode(base64.b64decode(joined, validate=True)).decode() == joined
    except (binascii.Error, ValueError):
        return False


def _check_named(path: Path, signature: etree._Element, expected: Any) -> None:
    """Check that the X.509 certificate in the file is the expected one."""
    from cryptography.hazmat.primitives.serialization import Encoding

    text = signature.findtext(f"{_DS}KeyInfo/{_DS}X509Data/{_DS}X509Certificate") or ""
    if base64.b64decode("".join(text.split())) != expected.public_bytes(Encoding.DER):
        raise _outside(
            path, "was signed by somebody else: it names another X.509 certificate than the expected one"
        )


def _without_signature(root: etree._Element) -> bytes:
    """Canonical XML of a document without its signature."""
    from lxml import etree

    copied = etree.fromstring(etree.tostring(root, with_tail=False))
    for node in copied.findall(f"{_DS}Signature"):
        copied.remove(node)
    return bytes(etree.tostring(copied, method="c14n", with_comments=True))


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

    configuration = SignatureConfiguration(
        location="./",
        expect_references=1,
        signature_methods=frozenset((SignatureMethod.RSA_SHA256, SignatureMethod.ECDSA_SHA256)),
        digest_algorithms=frozenset((DigestAlgorithm.SHA256,)),
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
    """Remarks on the formatting of the XML, which no signature covers."""
    from cryptography.hazmat.primitives.serialization import Encoding

    body = expected.public_bytes(Encoding.PEM).decode().split("-----")[2].lstrip()
    texts = [(str(node.tag).removeprefix(_DS), node.text or "") for node in signature.iter()]
    lines = all(
        text == body if name == "X509Certificate" else text == "".join(text.split())
        for name, text in texts
        if name in _WITH_TEXT
    )
    if written(root) == raw and lines:
        return ()
    return ("the file is written in another way than piga writes it; what is signed is unchanged",)


def written(root: etree._Element) -> bytes:
    """The bytes that piga writes for a document."""
    from lxml import etree

    return etree.tostring(root, xml_declaration=True, encoding="UTF-8") + b"\n"


def load_certificate(path: Path) -> Any:
    """The X.509 certificate of a PEM file.

    Raises
    ------
    DataError
        If it cannot be read, or its key is neither RSA (at least 2048 bits) nor elliptic curve (at least 256 bits).
    """
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
