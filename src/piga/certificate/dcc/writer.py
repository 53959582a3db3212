"""The Digital Calibration Certificate: DCC 3.3.0 in XML with D-SI 2.2.1 quantities, SI only."""

from __future__ import annotations

from typing import TYPE_CHECKING

from piga.certificate.certificate_file import CertificateFile
from piga.certificate.dcc.administration import administrative_data
from piga.certificate.dcc.elements import dcc
from piga.certificate.dcc.reader import DCC, SI
from piga.certificate.dcc.results import measurement_result
from piga.errors import DataError
from piga.records.calibration import Calibration

if TYPE_CHECKING:
    from lxml import etree

MOST_TEXT = 9_900_000
"""Characters of one text in the XML; libxml2 refuses more than 10 million, and so do programs built on it."""
VERSION = "3.3.0"
_SCHEMA = "http://www.w3.org/2001/XMLSchema-instance"


def dcc_document(
    data: CertificateFile, calibration: Calibration, before: Calibration | None = None
) -> etree._Element:
    """The certificate as XML; ``data`` must be complete (:func:`piga.certificate.certificate_file.missing_items`).

    Raises
    ------
    DataError
        If a text holds what XML cannot, or the attached record is longer than readers of XML take.
    """
    from lxml import etree

    root = etree.Element(
        f"{{{DCC}}}digitalCalibrationCertificate",
        nsmap={"dcc": DCC, "si": SI, "xsi": _SCHEMA},
        schemaVersion=VERSION,
    )
    root.set(f"{{{_SCHEMA}}}schemaLocation", f"{DCC} {DCC}/v{VERSION}/dcc.xsd")
    try:
        root.append(administrative_data(data, calibration))
        root.append(dcc("measurementResults", [measurement_result(data, calibration, before)]))
    except ValueError as error:
        raise DataError(
            f"certificate: a text of the data or of the calibration cannot stand in XML: {error}",
            remedy="write it with letters, digits and signs",
        ) from None
    longest = max(len(node.text or "") for node in root.iter())
    if longest > MOST_TEXT:
        raise DataError(
            f"certificate: the attached calibration has {longest} characters with its {len(calibration.coefficients)} "
            f"coefficients; readers of XML take {MOST_TEXT}",
            remedy="calibrate with phase = 'shared', or with fewer segments",
        )
    etree.indent(root)
    return root
