"""Schematron with query binding xslt2: the rules become an XSLT stylesheet that Saxon runs.

Patterns become modes; in each, a node is judged by the first rule whose context matches it (ISO/IEC 19757-3, 6.5).
"""

from __future__ import annotations

from pathlib import Path

from lxml import etree

SCH = "{http://purl.oclc.org/dsdl/schematron}"
XSL = "{http://www.w3.org/1999/XSL/Transform}"


def stylesheet(rules: Path) -> str:
    schema = etree.parse(str(rules)).getroot()
    names = {ns.get("prefix"): ns.get("uri") for ns in schema.iter(f"{SCH}ns")}
    names |= {"xsl": XSL[1:-1], "xs": "http://www.w3.org/2001/XMLSchema"}
    sheet = etree.Element(f"{XSL}stylesheet", nsmap=names, version="2.0")
    root = etree.SubElement(sheet, f"{XSL}template", match="/")
    findings = etree.SubElement(root, "findings")
    for at, pattern in enumerate(schema.iter(f"{SCH}pattern")):
        mode = f"m{at}"
        lets = pattern.findall(f"{SCH}let")
        for let in lets:
            etree.SubElement(sheet, f"{XSL}variable", name=let.get("name"), select=let.get("value"))
        etree.SubElement(findings, f"{XSL}apply-templates", select="//* | //@*", mode=mode)
        for rank, rule in enumerate(pattern.findall(f"{SCH}rule")):
            context = rule.get("context")
            one = etree.SubElement(
                sheet, f"{XSL}template", match=context.removeprefix("//") if "|" not in context else context,
                mode=mode, priority=str(1000 - rank),
            )  # fmt: skip
            _rule(one, rule)
        etree.SubElement(sheet, f"{XSL}template", match="node() | @*", mode=mode, priority="-1")
    return etree.tostring(sheet, encoding="unicode")


def _rule(template: etree._Element, rule: etree._Element) -> None:
    for part in rule:
        if part.tag == f"{SCH}let":
            etree.SubElement(template, f"{XSL}variable", name=part.get("name"), select=part.get("value"))
        elif part.tag in (f"{SCH}assert", f"{SCH}report"):
            test = part.get("test") if part.tag.endswith("report") else f"not({part.get('test')})"
            result = etree.SubElement(etree.SubElement(template, f"{XSL}if", test=test), "finding")
            result.set("role", part.get("role", "error"))
            result.text = " ".join("".join(part.itertext()).split())


def findings(rules: Path, document: bytes) -> dict[str, list[str]]:
    """Messages by role (error, warning, information)."""
    from saxonche import PySaxonProcessor

    with PySaxonProcessor(license=False) as saxon:
        compiled = saxon.new_xslt30_processor().compile_stylesheet(stylesheet_text=stylesheet(rules))
        result = compiled.transform_to_string(xdm_node=saxon.parse_xml(xml_text=document.decode()))
    values: dict[str, list[str]] = {}
    for finding in etree.fromstring(result.encode()).iter("finding"):
        values.setdefault(finding.get("role"), []).append(finding.text or "")
    return values
