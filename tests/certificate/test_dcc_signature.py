"""XML from outside, signatures and their verification: what changes is found, what attacks is refused."""

from __future__ import annotations

import base64
import contextlib
import datetime as dt
import re

import pytest

from piga.errors import DataError, PigaError
from tests.certificate.certificate_data import complete, key_pair
from tests.formats.test_formats_fuzz import mutated, seeded

etree = pytest.importorskip("lxml.etree")
pytest.importorskip("signxml")

from piga.certificate import dcc  # noqa: E402
from piga.certificate.dcc import (  # noqa: E402
    calibration_of,
    dcc_document,
    read_dcc,
    sign_xml,
    verify_signature,
    written,
)
from tests.reports.example import calibration  # noqa: E402


@pytest.fixture(scope="module")
def cal():
    return calibration(with_residuals=False)


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    folder = tmp_path_factory.mktemp("keys")
    return {
        "ours": key_pair(folder, "ours"),
        "rsa": key_pair(folder, "rsa", elliptic=False),
        "other": key_pair(folder, "other"),
    }


@pytest.fixture(scope="module")
def signed(cal, keys):
    return written(sign_xml(dcc_document(complete(), cal), *keys["ours"]))


def put(tmp_path, raw):
    path = tmp_path / "certificate.xml"
    path.write_bytes(raw)
    return path


@pytest.mark.parametrize("name", ["ours", "rsa"])
def test_signed_and_verified(cal, keys, tmp_path, name):
    raw = written(sign_xml(dcc_document(complete(), cal), *keys[name]))
    signature = verify_signature(put(tmp_path, raw), keys[name][1])
    assert signature.signer == f"CN={name}"
    assert signature.remarks == ()
    assert (signature.valid_until - signature.valid_from).days == 730
    assert calibration_of(signature.document, tmp_path).coefficients == cal.coefficients


@pytest.mark.parametrize(("serial", "authority", "refused"), [(0, 0, True), (1, 0, False), (0, 1, False)])
def test_a_signer_on_a_revocation_list_in_the_file_is_refused(
    signed, keys, tmp_path, serial, authority, refused
):
    """The list must be of the authority of the signer, and name the signer: 1 stands for another one."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization

    key, pem = (path.read_bytes() for path in keys["ours"])
    signer = x509.load_pem_x509_certificate(pem)
    day = dt.datetime(2026, 5, 4, tzinfo=dt.UTC)
    entry = (
        x509.RevokedCertificateBuilder()
        .serial_number(signer.serial_number + serial)
        .revocation_date(day)
        .build()
    )
    name = x509.load_pem_x509_certificate(keys["other"][1].read_bytes()).subject if authority else signer.issuer
    made = x509.CertificateRevocationListBuilder(name, day, day + dt.timedelta(days=9), [], [entry])
    der = made.sign(serialization.load_pem_private_key(key, None), hashes.SHA256()).public_bytes(
        serialization.Encoding.DER
    )
    properties = (
        b'<x:QualifyingProperties xmlns:x="http://uri.etsi.org/01903/v1.3.2#"><x:EncapsulatedCRLValue>'
        + base64.b64encode(der)
        + b"</x:EncapsulatedCRLValue></x:QualifyingProperties>"
    )
    root = etree.fromstring(signed)
    etree.SubElement(root[-1], f"{dcc._DS}Object").append(etree.fromstring(properties))
    path = put(tmp_path, written(root))
    if refused:
        with pytest.raises(DataError, match="of the signer was revoked on 2026-05-04"):
            verify_signature(path, keys["ours"][1])
    else:
        assert "XAdES" in verify_signature(path, keys["ours"][1]).remarks[0]


def test_an_envelope_and_an_old_version_are_named(tmp_path):
    with pytest.raises(DataError, match="is an envelope") as caught:
        read_dcc(put(tmp_path, b"\x30\x82\x8a\x9d\x06"))
    assert "openssl cms" in caught.value.remedy
    old = b'<d:digitalCalibrationCertificate xmlns:d="https://ptb.de/dcc" schemaVersion="2.4.0"/>'
    with pytest.raises(DataError, match=r"version '2\.4\.0' is not known") as caught:
        read_dcc(put(tmp_path, old))
    assert "one of version 3" in caught.value.remedy


def test_signed_again_by_somebody_else(cal, keys, tmp_path):
    """A forger who signs a changed document with a key of their own, under any name."""
    raw = written(sign_xml(dcc_document(complete(), cal), *keys["other"]))
    with pytest.raises(DataError, match="signature does not hold"):
        verify_signature(put(tmp_path, raw), keys["ours"][1])


def test_unsigned_twice_signed_and_partly_signed(cal, signed, keys, tmp_path):
    plain = written(dcc_document(complete(), cal))
    with pytest.raises(DataError, match="is not signed"):
        verify_signature(put(tmp_path, plain), keys["ours"][1])
    root = etree.fromstring(signed)
    root.append(etree.fromstring(etree.tostring(root[-1])))
    with pytest.raises(DataError, match="more than one signature"):
        verify_signature(put(tmp_path, written(root)), keys["ours"][1])
    partly = signed.replace(b'<ds:Reference URI="">', b'<ds:Reference URI="#a">')
    assert partly != signed
    with pytest.raises(DataError, match=r"does not hold|whole document"):
        verify_signature(put(tmp_path, partly), keys["ours"][1])


def test_a_signed_document_wrapped_in_another(signed, keys, tmp_path):
    root = etree.fromstring(signed)
    wrapper = etree.Element(root.tag, nsmap=root.nsmap, schemaVersion="3.3.0")
    wrapper.append(root)
    with pytest.raises(DataError, match="is not signed"):
        verify_signature(put(tmp_path, written(wrapper)), keys["ours"][1])
    signature = root[-1]
    wrapper.append(signature)
    with pytest.raises(DataError, match="does not hold"):
        verify_signature(put(tmp_path, written(wrapper)), keys["ours"][1])


def test_weak_algorithms_are_refused(signed, keys, tmp_path):
    weak = signed.replace(b"xmlenc#sha256", b"xmldsig#sha1")
    with pytest.raises(DataError, match="does not hold"):
        verify_signature(put(tmp_path, weak), keys["ours"][1])


FORGED = (
    b'<dcc:measurementResults xmlns:dcc="https://ptb.de/dcc"><dcc:measurementResult/></dcc:measurementResults>'
)
FORGERIES = {
    "results in an object": (b"</ds:Signature>", b"<ds:Object>" + FORGED + b"</ds:Object></ds:Signature>"),
    "results in the key": (b"</ds:X509Data>", b"</ds:X509Data>" + FORGED),
    "name of a key": (b"<ds:KeyInfo>", b"<ds:KeyInfo><ds:KeyName>PTB</ds:KeyName>"),
    "second certificate": (b"</ds:X509Data>", b"<ds:X509Certificate>AAAA</ds:X509Certificate></ds:X509Data>"),
    "identifier": (b"<ds:SignatureValue>", b'<ds:SignatureValue Id="a">'),
    "name space": (b"<ds:KeyInfo>", b'<ds:KeyInfo xmlns:x="PTB">'),
    "text behind the signature": (b"</ds:Signature>", b"</ds:Signature>k0 is 3 mg"),
    "comment": (b"<dcc:coreData>", b"<!-- k0 is 3 mg --><dcc:coreData>"),
    "instruction before": (b"<dcc:digital", b"<?xml-stylesheet href='x.xsl'?><dcc:digital"),
    "comment behind": (b"</dcc:digitalCalibrationCertificate>", b"</dcc:digitalCalibrationCertificate><!-- x -->"),
    "key value outside": (b"<dcc:coreData>", b'<dcc:coreData><ds:KeyInfo xmlns:ds="http://www.w3.org/2000/09/xmldsig#"/>'),
    "another certificate named": (re.compile(rb"(<ds:X509Certificate>\s*M)."), rb"\1J"),
    "nothing named": (re.compile(rb"<ds:KeyInfo>.*</ds:KeyInfo>", re.DOTALL), b""),
    "stray letters in the value": (b"<ds:DigestValue>", b"<ds:DigestValue>!"),
    "other transform": (b"2006/12/xml-c14n11", b"2001/10/xml-exc-c14n#"),
    "no transform": (re.compile(rb"<ds:Transform Algorithm=\"[^\"]*c14n11\"/>"), b""),
    "path as transform": (b"<ds:Transforms>", b'<ds:Transforms><ds:Transform Algorithm="http://www.w3.org/TR/1999/REC-xpath-19991116"/>'),
    "two references": (b"</ds:SignedInfo>", b'<ds:Reference URI=""/></ds:SignedInfo>'),
}  # fmt: skip


@pytest.mark.parametrize("forgery", FORGERIES)
def test_nothing_that_is_not_signed_is_read(cal, signed, keys, tmp_path, forgery):
    """What stands in the signature is not signed, so it must not count: refused, or without any effect."""
    old, new = FORGERIES[forgery]
    forged = signed.replace(old, new, 1) if isinstance(old, bytes) else old.sub(new, signed, count=1)
    assert forged != signed
    with contextlib.suppress(DataError):
        unchanged(forged, cal, keys, tmp_path)


def unchanged(raw, cal, keys, tmp_path):
    """Verify and read a file; what is handed on must be what was signed."""
    signature = verify_signature(put(tmp_path, raw), keys["ours"][1])
    assert calibration_of(signature.document, tmp_path).coefficients == cal.coefficients
    assert etree.tostring(signature.document, method="c14n") == etree.tostring(
        dcc_document(complete(), cal), method="c14n"
    )


@pytest.mark.parametrize(("elliptic", "bits"), [(False, 1024), (False, 2047), (True, 192)])
def test_short_keys_are_refused(cal, signed, tmp_path, elliptic, bits):
    short = key_pair(tmp_path, "short", elliptic=elliptic, bits=bits)
    with pytest.raises(DataError, match=f"key has {bits} bits"):
        sign_xml(dcc_document(complete(), cal), *short)
    with pytest.raises(DataError, match=f"key has {bits} bits"):
        verify_signature(put(tmp_path, signed), short[1])


@pytest.mark.parametrize(("start", "words"), [(-800, "has expired"), (10, "is not yet valid")])
def test_a_certificate_out_of_force_does_not_sign(cal, tmp_path, start, words):
    with pytest.raises(DataError, match=words):
        sign_xml(dcc_document(complete(), cal), *key_pair(tmp_path, "late", start=start))


def test_force_at_a_time(signed, keys, tmp_path):
    checked = verify_signature(put(tmp_path, signed), keys["ours"][1])
    day = dt.timedelta(days=1)
    assert checked.out_of_force(checked.valid_from) == checked.out_of_force(checked.valid_until) == ""
    assert "is not yet valid" in checked.out_of_force(checked.valid_from - day)
    expired = checked.out_of_force(checked.valid_until + day)
    assert "has expired" in expired
    assert f"to {checked.valid_until:%Y-%m-%d}" in expired


def mutations(raw, count, seed):
    draw = seeded(seed)
    return (mutated(raw, draw) for _ in range(count))


def hunt(mutants, cal, keys, tmp_path):
    """Every mutant is refused, or read as what was signed. Returns how many were refused."""
    refused = 0
    for mutant in mutants:
        try:
            unchanged(mutant, cal, keys, tmp_path)
        except PigaError:
            refused += 1
    return refused


def test_mutations_are_found(cal, signed, keys, tmp_path):
    assert hunt(mutations(signed, 150, 1), cal, keys, tmp_path) > 130


def test_mutations_of_the_signature_itself(cal, signed, keys, tmp_path):
    at = signed.index(b"<ds:Signature ")
    hunt((signed[:at] + mutant for mutant in mutations(signed[at:], 150, 5)), cal, keys, tmp_path)


def test_keys_that_do_not_fit(cal, keys, tmp_path):
    root = dcc_document(complete(), cal)
    with pytest.raises(DataError, match="is not the key of"):
        sign_xml(root, keys["ours"][0], keys["other"][1])
    with pytest.raises(DataError, match="not a usable private key"):
        sign_xml(root, keys["ours"][1], keys["ours"][1])
    with pytest.raises(DataError, match=r"not an X.509 certificate"):
        sign_xml(root, keys["ours"][0], keys["ours"][0])
    with pytest.raises(DataError, match="cannot be read"):
        sign_xml(root, tmp_path / "none.pem", keys["ours"][1])


ATTACKS = {
    "external entity": '<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/passwd">]><x>&e;</x>',
    "billion laughs": '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;">]><x>&b;</x>',
    "external document type": '<!DOCTYPE x SYSTEM "http://localhost/x.dtd"><x/>',
    "parameter entity": '<!DOCTYPE x [<!ENTITY % p SYSTEM "file:///etc/passwd"> %p;]><x/>',
}


@pytest.mark.parametrize("attack", ATTACKS)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-16-le"])
def test_document_types_are_refused(tmp_path, attack, encoding):
    path = put(tmp_path, ATTACKS[attack].encode(encoding))
    with pytest.raises(DataError, match=r"document type|not valid XML"):
        dcc.read_xml(path)


def test_damaged_large_and_missing_files(tmp_path, monkeypatch):
    with pytest.raises(DataError, match="not valid XML"):
        read_dcc(put(tmp_path, b"<a><b></a>"))
    with pytest.raises(DataError, match="not valid XML"):
        read_dcc(put(tmp_path, b""))
    with pytest.raises(DataError, match="not valid XML"):
        read_dcc(put(tmp_path, b"<a>" * 3000))
    with pytest.raises(DataError, match="cannot be read"):
        read_dcc(tmp_path / "none.xml")
    monkeypatch.setattr(dcc, "MOST_XML_BYTES", 10)
    with pytest.raises(DataError, match="larger than"):
        read_dcc(put(tmp_path, b"<a>" + b" " * 20 + b"</a>"))
