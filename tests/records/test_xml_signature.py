"""XML from outside, signatures and their verification: what changes is found, what attacks is refused."""

from __future__ import annotations

import contextlib
import random
import re

import pytest

from piga.errors import DataError, PigaError
from tests.reports.certificate_data import complete, key_pair

etree = pytest.importorskip("lxml.etree")
pytest.importorskip("signxml")

from piga.records import xml_file  # noqa: E402
from piga.records.dcc_reader import calibration_of, read_dcc  # noqa: E402
from piga.records.xml_signature import sign_xml, verify_signature, written  # noqa: E402
from piga.reports.dcc import dcc_document  # noqa: E402
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
    found = verify_signature(put(tmp_path, raw), keys[name][1])
    assert found.signer == f"CN={name}"
    assert found.remarks == ()
    assert (found.valid_until - found.valid_from).days == 730
    assert calibration_of(found.document, tmp_path).coefficients == cal.coefficients


def test_the_expected_signer_alone_counts(signed, keys, tmp_path):
    with pytest.raises(DataError, match="signature does not hold"):
        verify_signature(put(tmp_path, signed), keys["other"][1])


def test_signed_again_by_somebody_else(cal, keys, tmp_path):
    """A forger who signs a changed document with a key of their own, under any name."""
    raw = written(sign_xml(dcc_document(complete(), cal), *keys["other"]))
    with pytest.raises(DataError, match="signature does not hold"):
        verify_signature(put(tmp_path, raw), keys["ours"][1])


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"2026-0117-PIGA", b"2026-0118-PIGA"),
        (b"<si:value>0.0906", b"<si:value>0.0907"),
        (b"basic_measuredValue", b"basic_measuredvalue"),
        (b"Example Navigation Ltd", b"Example Navigation Inc"),
    ],
)
def test_a_change_breaks_it(signed, keys, tmp_path, old, new):
    assert old in signed
    with pytest.raises(DataError, match="does not hold: Digest mismatch"):
        verify_signature(put(tmp_path, signed.replace(old, new, 1)), keys["ours"][1])


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
    with pytest.raises(DataError, match="whole document"):
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


def test_what_no_signature_covers_is_remarked(signed, keys, tmp_path):
    comment = signed.replace(b"<dcc:coreData>", b"<!-- k0 is 3 mg --><dcc:coreData>", 1)
    found = verify_signature(put(tmp_path, comment), keys["ours"][1])
    assert "comments" in found.remarks[0]
    assert b"3 mg" not in etree.tostring(found.document)
    spaced = signed.replace(b'schemaVersion="3.3.0"', b"schemaVersion='3.3.0'", 1)
    assert "another way" in verify_signature(put(tmp_path, spaced), keys["ours"][1]).remarks[0]
    named = re.sub(rb"(<ds:X509Certificate>)\s*\S", rb"\1N", signed)
    assert "names another" in verify_signature(put(tmp_path, named), keys["ours"][1]).remarks[0]


def mutations(raw, count, seed):
    rng = random.Random(seed)  # noqa: S311
    for _ in range(count):
        at = rng.randrange(len(raw))
        kind = rng.randrange(4)
        if kind == 0:
            yield raw[:at] + bytes([raw[at] ^ (1 << rng.randrange(8))]) + raw[at + 1 :]
        elif kind == 1:
            yield raw[:at] + raw[at + 1 :]
        elif kind == 2:
            yield raw[:at] + bytes([rng.randrange(256)]) + raw[at:]
        else:
            end = min(len(raw), at + rng.randrange(1, 40))
            yield raw[:at] + raw[at:end][::-1] + raw[end:]


def hunted_part(raw, at, keys, tmp_path, count):
    """As :func:`hunted`, for the bytes from ``at`` on."""
    tail = [raw[:at] + mutant for mutant in mutations(raw[at:], count, 5)]
    return missed_among(raw, tail, keys, tmp_path)


def hunted(raw, keys, tmp_path, count, seed):
    """Mutations that verification neither refuses nor remarks."""
    return missed_among(raw, mutations(raw, count, seed), keys, tmp_path)


def missed_among(raw, mutants, keys, tmp_path):
    missed = []
    for mutant in mutants:
        if mutant == raw:
            continue
        try:
            found = verify_signature(put(tmp_path, mutant), keys["ours"][1])
            calibration_of(found.document, tmp_path)
        except PigaError:
            continue
        if not found.remarks:
            missed.append(mutant)
    return missed


def test_mutations_are_found(signed, keys, tmp_path):
    assert hunted(signed, keys, tmp_path, 150, 1) == []


def test_mutations_of_the_signature_itself_are_found(signed, keys, tmp_path):
    at = signed.index(b"<ds:Signature ")
    missed = hunted_part(signed, at, keys, tmp_path, 150)
    assert missed == []


@pytest.mark.slow
def test_many_mutations_are_found(signed, keys, tmp_path):
    assert hunted(signed, keys, tmp_path, 10_000, 2) == []
    assert hunted_part(signed, signed.index(b"<ds:Signature "), keys, tmp_path, 3000) == []


def test_fuzzed_unsigned_certificates_end_in_words(cal, tmp_path):
    """Whatever the bytes: a calibration, or one clear error; never anything else."""
    raw = written(dcc_document(complete(), cal))
    for mutant in mutations(raw, 300, 3):
        with contextlib.suppress(PigaError):
            read_dcc(put(tmp_path, mutant))


def test_keys_that_do_not_fit(cal, keys, tmp_path):
    root = dcc_document(complete(), cal)
    with pytest.raises(DataError, match="is not the key of"):
        sign_xml(root, keys["ours"][0], keys["other"][1])
    with pytest.raises(DataError, match="no private key"):
        sign_xml(root, keys["ours"][1], keys["ours"][1])
    with pytest.raises(DataError, match=r"no X.509 certificate"):
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
        xml_file.read_xml(path)


def test_damaged_large_and_missing_files(tmp_path, monkeypatch):
    with pytest.raises(DataError, match="not valid XML"):
        read_dcc(put(tmp_path, b"<a><b></a>"))
    with pytest.raises(DataError, match="not valid XML"):
        read_dcc(put(tmp_path, b""))
    with pytest.raises(DataError, match="not valid XML"):
        read_dcc(put(tmp_path, b"<a>" * 3000))
    with pytest.raises(DataError, match="cannot be read"):
        read_dcc(tmp_path / "none.xml")
    monkeypatch.setattr(xml_file, "MAX_BYTES", 10)
    with pytest.raises(DataError, match="larger than"):
        read_dcc(put(tmp_path, b"<a>" + b" " * 20 + b"</a>"))


def test_keys_of_another_kind_and_files_too_large(cal, keys, tmp_path):
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

    root = dcc_document(complete(), cal)
    form = (Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    (tmp_path / "ed.pem").write_bytes(Ed25519PrivateKey.generate().private_bytes(*form))
    with pytest.raises(DataError, match="neither an RSA nor an elliptic-curve key"):
        sign_xml(root, tmp_path / "ed.pem", keys["ours"][1])
    (tmp_path / "large.pem").write_bytes(keys["ours"][0].read_bytes() + bytes(1 << 20))
    with pytest.raises(DataError, match=r"large\.pem: larger than 1048576 bytes"):
        sign_xml(root, tmp_path / "large.pem", keys["ours"][1])


def test_a_record_of_other_coefficients_inside(cal, tmp_path):
    """The list in SI and the attached record are both sound, but not of the same calibration."""
    import base64
    from dataclasses import replace

    from piga.records.calibration_json import calibration_to_bytes

    fewer = replace(
        cal, coefficients=cal.coefficients[:-1], covariance=cal.covariance[:-1, :-1], terms=cal.terms[:-1]
    )
    root = dcc_document(complete(), cal)
    data = root.find(".//{*}byteData[@refType='piga_calibrationRecord']/{*}dataBase64")
    data.text = base64.b64encode(calibration_to_bytes(fewer)).decode()
    with pytest.raises(DataError, match="the attached record holds other coefficients"):
        read_dcc(put(tmp_path, written(root)))
