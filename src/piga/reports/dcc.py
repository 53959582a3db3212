"""The Digital Calibration Certificate: DCC 3.3.0 in XML with D-SI 2.2.1 quantities, SI only."""

from __future__ import annotations

from typing import TYPE_CHECKING

from piga.records.calibration import Calibration
from piga.records.certificate_file import CertificateFile
from piga.records.dcc_reader import DCC, SI
from piga.reports.dcc_administration import administrative_data
from piga.reports.dcc_elements import dcc
from piga.reports.dcc_results import measurement_result

if TYPE_CHECKING:
    from lxml import etree

VERSION = "3.3.0"
_SCHEMA = "http://www.w3.org/2001/XMLSchema-instance"


def dcc_document(
    data: CertificateFile, calibration: Calibration, before: Calibration | None = None
) -> etree._Element:
    """The certificate as XML; ``data`` must be complete (:func:`piga.records.certificate_file.missing_items`)."""
    from lxml import etree

    root = etree.Element(
        f"{{{DCC}}}digitalCalibrationCertificate",
        nsmap={"dcc": DCC, "si": SI, "xsi": _SCHEMA},
        schemaVersion=VERSION,
    )
    root.set(f"{{{_SCHEMA}}}schemaLocation", f"{DCC} {DCC}/v{VERSION}/dcc.xsd")
    root.append(administrative_data(data, calibration))
    root.append(dcc("measurementResults", [measurement_result(data, calibration, before)]))
    etree.indent(root)
    return root
