"""Meaning of the keys of the TOML files, from one table: ``piga/data/keys.txt``."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import import_module
from importlib.resources import files
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

FILES: dict[str, tuple[str, str, str]] = {
    "run": ("run file", "piga.records.run_file", "RunFile"),
    "scenario": ("scenario", "piga.stand.scenario", "ScenarioTable"),
    "plan": ("plan", "piga.planning.plan_file", "PlanTable"),
    "platform": ("platform scenario", "piga.platform.scenario", "ScenarioFile"),
    "certificate": ("certificate file", "piga.certificate.certificate_file", "CertificateFile"),
    "triad": ("triad file", "piga.compensation.sets.set_files", "TriadFile"),
}
"""Kinds of TOML files: name, module and class of the whole file."""
MOST_PARTS = 6
"""Most parts of a key's path."""


@dataclass(frozen=True)
class KeyWords:
    """What a key means: its sentence, unit and an example of its value in TOML."""

    sentence: str
    unit: str
    example: str


@dataclass(frozen=True)
class KeyPlace:
    """A key of a file: its path, the class that holds it, its type and default in words, and what it means."""

    file: str
    path: str
    table: str
    kind: str
    default: str
    words: KeyWords


@lru_cache(maxsize=1)
def key_table() -> dict[str, dict[str, KeyWords]]:
    """The words of every key, by class of the table and key. ``*``: keys that mean the same in several tables."""
    table: dict[str, dict[str, KeyWords]] = {}
    section = ""
    for line in files("piga.data").joinpath("keys.txt").read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            section = line.strip("[] ")
            table[section] = {}
        elif line.strip() and not line.startswith("#"):
            key, unit, example, sentence = re.split(r" ?\| ?", line)
            table[section][key] = KeyWords(sentence, unit, example)
    return table


def words_of(table: str, key: str) -> KeyWords | None:
    """The words of a key of a table, by the name of its class."""
    known = key_table()
    own = known.get(table, {})
    if table == "PlanTable" and key not in own:
        own = known["ScenarioTable"]
    if table == "SpecimenTable" and key not in own:
        own = known.get("InstrumentTable", {})
    return own.get(key) or known["*"].get(key)


@cache
def places_of(file: str) -> tuple[KeyPlace, ...]:
    """All keys of a kind of file, in order."""
    _, module, name = FILES[file]
    return tuple(places_in(file, getattr(import_module(module), name)))


def places_in(file: str, struct: Any) -> list[KeyPlace]:
    """All keys of a kind of file, in order.

    Parameters
    ----------
    file:
        Name of the kind, for the places.
    struct:
        Class of the whole file.
    """
    return _below(file, struct, "", 0)


def _below(file: str, struct: Any, path: str, depth: int) -> list[KeyPlace]:
    import msgspec

    result: list[KeyPlace] = []
    for entry in msgspec.structs.fields(struct):
        inner = structs_in(entry.type)
        words = words_of(struct.__name__, entry.encode_name)
        if words is None:
            words = KeyWords("", "", "")
        where = f"{path}{entry.encode_name}"
        result.append(KeyPlace(file, where, struct.__name__, type_words(entry.type), _default(entry), words))
        if depth < MOST_PARTS:
            for part in inner:
                result += _below(file, part, f"{where}.", depth + 1)
    return result


def structs_in(annotation: Any) -> list[Any]:
    """All tables in a type."""
    import msgspec

    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        return [annotation]
    return [struct for part in get_args(annotation) for struct in structs_in(part)]


def _default(entry: Any) -> str:
    import msgspec

    if entry.required:
        return "needed"
    if isinstance(entry.default, msgspec.Struct):
        return "its defaults"
    if entry.default is msgspec.NODEFAULT or entry.default in (None, (), {}, ""):
        return "none"
    return json.dumps(entry.default, ensure_ascii=False)


_PLURALS = {
    "quantity": "quantities",
    "number": "numbers",
    "whole number": "whole numbers",
    "text": "texts",
    "table": "tables",
}


def _plural(words: str) -> str:
    """Types in words, in the plural."""
    if words.startswith(("list of ", "table of ")):
        return f"{words.partition(' ')[0]}s {words.partition(' ')[2]}"
    return " or ".join(_PLURALS.get(word, word) for word in words.split(" or "))


def type_words(annotation: Any) -> str:
    """A type in words."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return type_words(parts[0])
    if origin is Literal:
        return " | ".join(f'"{part}"' for part in parts)
    if origin in (Union, UnionType):
        real = [part for part in parts if part is not type(None)]
        words = ["quantity"] if {str, float} <= set(real) else []
        words += [type_words(part) for part in real if not words or part not in (str, float, int)]
        return " or ".join(dict.fromkeys(words))
    if origin in (tuple, list):
        return f"list of {_plural(type_words(next(part for part in parts if part is not Ellipsis)))}"
    if origin is dict:
        return f"table of {_plural(type_words(parts[-1]))}"
    if structs_in(annotation):
        return "table"
    return {str: "text", float: "number", int: "whole number", bool: "true | false", Any: "any value"}.get(
        annotation, getattr(annotation, "__name__", str(annotation))
    )
