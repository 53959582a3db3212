"""ISO/IEC 17025 certificates and DCC: make and read them.

>>> from piga.certificate import missing_items
>>> missing_items.__name__
'missing_items'
"""

from piga.certificate.certificate_file import CertificateFile, missing_items, read_certificate_file
from piga.certificate.page import certificate_html, require_complete

__all__ = ["CertificateFile", "certificate_html", "missing_items", "read_certificate_file", "require_complete"]
