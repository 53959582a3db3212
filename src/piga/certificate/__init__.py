"""ISO/IEC 17025 certificates and DCC: make and read them.

>>> from piga.certificate import missing_items
>>> missing_items.__name__
'missing_items'
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from piga.certificate.certificate_file import CertificateFile, missing_items, read_certificate_file
    from piga.certificate.page import certificate_html, require_complete, write_certificate

_LAZY = {
    "CertificateFile": "certificate_file",
    "certificate_html": "page",
    "missing_items": "certificate_file",
    "read_certificate_file": "certificate_file",
    "require_complete": "page",
    "write_certificate": "page",
}

__all__ = [
    "CertificateFile",
    "certificate_html",
    "missing_items",
    "read_certificate_file",
    "require_complete",
    "write_certificate",
]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(f"piga.certificate.{_LAZY[name]}"), name)
    raise AttributeError(f"module 'piga.certificate' has no attribute '{name}'")
