"""Certificate: the files that the page offers."""

from __future__ import annotations

from pathlib import Path

from piga.workbench.folder import Folder
from piga.workbench.pages.certificate import keys_and_certificates
from tests.certificate.certificate_data import key_pair


def test_keys_and_certificates_are_told_apart(tmp_path: Path) -> None:
    key, certificate = key_pair(tmp_path, "lab")
    (tmp_path / "both.pem").write_bytes(certificate.read_bytes() + key.read_bytes())
    (tmp_path / "binary.cer").write_bytes(b"\x30\x82")
    (tmp_path / "link.pem").symlink_to(key)
    assert keys_and_certificates(Folder(tmp_path)) == (
        ["both.pem", "lab-key.pem"],
        ["binary.cer", "both.pem", "lab-cert.pem"],
    )
