"""Elements of a Digital Calibration Certificate: certificate and quantity elements, text in English, dates."""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from piga._version import __version__
from piga.certificate.dcc.reader import DCC, SI

if TYPE_CHECKING:
    from lxml import etree

Parts = Iterable[Any]


def _element(
    namespace: str, name: str, parts: Parts | str, ref_type: str = "", **attributes: str
) -> etree._Element:
    from lxml import etree

    element = etree.Element(f"{{{namespace}}}{name}", attributes, nsmap={"dcc": DCC, "si": SI})
    if ref_type:
        element.set("refType", ref_type)
    if isinstance(parts, str):
        element.text = parts
    else:
        element.extend([part for part in parts if part is not None])
    return element


def dcc(name: str, parts: Parts | str, ref_type: str = "") -> etree._Element:
    """An element of the certificate, with parts or text."""
    return _element(DCC, name, parts, ref_type)


def si(name: str, parts: Parts | str) -> etree._Element:
    """An element of a quantity, with parts or text."""
    return _element(SI, name, parts)


def given(name: str, words: str) -> etree._Element | None:
    """An element with text, or None for none (white space made single, as the schema wants it)."""
    clean = " ".join(words.split())
    return dcc(name, clean) if clean else None


def text(name: str, words: str) -> etree._Element:
    """An element with content in English."""
    return dcc(name, [_element(DCC, "content", " ".join(words.split()), lang="en")])


def rich(name: str, words: str) -> etree._Element | None:
    """As :func:`text`, or None for white space."""
    return text(name, words) if words.strip() else None


def day(name: str, date: dt.date | None) -> etree._Element | None:
    """A date, or None for none."""
    return None if date is None else dcc(name, date.isoformat())


def software() -> etree._Element:
    """Name and release of piga."""
    release = re.match(r"\d{1,3}(\.\d{1,3}){0,3}", __version__)
    return dcc("software", [text("name", "piga"), dcc("release", f"v{release[0] if release else 0}")])
