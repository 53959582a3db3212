"""A complete administrative part for the made-up calibration, and what the tests need to sign."""

from __future__ import annotations

import datetime as dt
import ipaddress
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import msgspec

from piga.certificate.certificate_file import CertificateFile, read_certificate_file
from piga.records.calibration.coefficient import Amount, BudgetEntry

EXAMPLE = Path(__file__).parents[2] / "examples" / "certificate.toml"
SCHEMAS = Path(__file__).parents[3] / "shared" / "reference" / "dcc"


def complete(serial="G-0417", gravity="9.80166") -> CertificateFile:
    """The example, with another serial number and local gravity [m/s^2]."""
    data = read_certificate_file(EXAMPLE)
    site = tuple(
        msgspec.structs.replace(one, value=f"{gravity} m/s^2") if one.name == "Local gravity" else one
        for one in data.environment
    )
    data = msgspec.structs.replace(data, environment=site)
    return changed(data, certificate={"issued": dt.date(2026, 3, 9)}, item={"serial": serial})


def changed(data: CertificateFile, **tables) -> CertificateFile:
    """The data with some keys of some tables replaced."""
    put = msgspec.structs.replace
    return put(data, **{name: put(getattr(data, name), **keys) for name, keys in tables.items()})


def budgeted(cal):
    """The calibration with a budget that adds up: type A and one source of type B for every coefficient."""
    names = ("fit residuals (repeatability)", "A", 0.8), ("reference_scale", "B", 0.6)
    rows = tuple(
        BudgetEntry(
            source=name,
            type=kind,
            standard_uncertainty=None if kind == "A" else Amount(0.5, "ppm"),
            contributions={c.key: part * c.std for c in cal.coefficients},
        )
        for name, kind, part in names
    )
    return replace(cal, budget=rows)


def key_pair(
    folder: Path, name: str, *, elliptic: bool = True, bits: int = 2048, start: int = -365, days: int = 730,
    hosts: Sequence[str] = (),
) -> tuple[Path, Path]:  # fmt: skip
    """Private key and self-signed X.509 certificate, PEM; valid ``days`` from the day ``start`` days from now.

    ``hosts``: names and addresses of a TLS server that has it.
    """
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec, rsa
    from cryptography.x509.oid import NameOID

    curve = ec.SECP256R1() if bits >= 256 else ec.SECP192R1()
    key = ec.generate_private_key(curve) if elliptic else rsa.generate_private_key(65537, bits)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    first = dt.datetime.now(dt.UTC).replace(microsecond=0) + dt.timedelta(days=start)
    builder = (
        x509.CertificateBuilder(subject, subject, key.public_key(), x509.random_serial_number())
        .not_valid_before(first)
        .not_valid_after(first + dt.timedelta(days=days))
    )
    if hosts:
        names = [
            x509.IPAddress(ipaddress.ip_address(host)) if host[0].isdigit() else x509.DNSName(host)
            for host in hosts
        ]
        builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    certificate = builder.sign(key, hashes.SHA256())
    form = (serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    paths = folder / f"{name}-key.pem", folder / f"{name}-cert.pem"
    paths[0].write_bytes(key.private_bytes(*form))
    paths[1].write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    return paths
