"""XML from outside: one parser for all of it, without document types, entities, network or huge trees."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from piga.errors import DataError
from piga.records.limits import read_whole

if TYPE_CHECKING:
    from lxml import etree

MAX_BYTES = 32 << 20
"""Largest XML file read [bytes]."""


def read_xml(path: Path) -> tuple[bytes, etree._Element]:
    """Bytes and root element of an XML file.

    Raises
    ------
    DataError
        If the file cannot be read, is too large, is no XML, or declares a document type or entities.
    """
    raw = read_whole(path, MAX_BYTES, "a certificate in XML")
    return raw, parse_xml(raw, path)


def parse_xml(raw: bytes, path: Path) -> etree._Element:
    """Root element of XML bytes; ``path`` is for messages. Errors as :func:`read_xml`."""
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
