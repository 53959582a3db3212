"""Write tables of a run file as TOML, with comments."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from typing import Any

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def toml_key(name: str) -> str:
    """A key, in quotes where it needs them."""
    return name if _BARE.fullmatch(name) else toml_value(name)


def toml_value(value: Any) -> str:
    """A value on one line."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            return "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"
        return repr(value)
    if isinstance(value, Mapping):
        inside = ", ".join(f"{toml_key(str(name))} = {toml_value(part)}" for name, part in value.items())
        return f"{{ {inside} }}" if inside else "{}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(toml_value, value))}]"
    return str(value)  # dates and times write themselves in ISO 8601


def toml_text(document: Mapping[str, Any], comments: Mapping[str, list[str]] | None = None) -> str:
    """A document of tables as text. ``comments``: lines to stand before ``table`` or ``table.key``."""
    comments = comments or {}
    lines = [f"# {line}" for line in comments.get("", [])]
    lines += [
        f"{toml_key(name)} = {toml_value(part)}"
        for name, part in document.items()
        if not isinstance(part, Mapping)
    ]
    for table, part in document.items():
        if not isinstance(part, Mapping):
            continue
        lines += ["", *(f"# {line}" for line in comments.get(table, [])), f"[{toml_key(table)}]"]
        for key, value in part.items():
            lines += [f"# {line}" for line in comments.get(f"{table}.{key}", [])]
            lines.append(f"{toml_key(key)} = {toml_value(value)}")
        lines += [f"# {line}" for line in comments.get(f"{table}.", [])]
    return "\n".join(lines).lstrip("\n") + "\n"
