"""What the keys of all TOML files mean: in words, with type, default and an example.

The words are in one table: ``piga/data/keys.txt``. Commands, forms and the documentation show them.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import import_module
from importlib.resources import files
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import msgspec

from piga.errors import ArgumentError
from piga.text_files import si_unit, structs_in

FILES: dict[str, tuple[str, str, str]] = {
    "run": ("run file", "piga.records.run_file", "RunFile"),
    "scenario": ("scenario", "piga.stand.scenario", "ScenarioTable"),
    "plan": ("plan", "piga.planning.candidates", "PlanTable"),
    "platform": ("platform scenario", "piga.platform.scenario", "ScenarioFile"),
    "campaign": ("campaign file", "piga.campaign.campaign_file", "CampaignFile"),
    "certificate": ("certificate file", "piga.certificate.certificate_file", "CertificateFile"),
    "set": ("run file of a set", "piga.gravity_norm", "SetFile"),
    "triad": ("triad file", "piga.compensation.sets", "TriadFile"),
}
"""Kinds of TOML files: name, module and class of the whole file."""
_MOST_PARTS = 6
"""Most parts of a key's path."""


@dataclass(frozen=True)
class _KeyWords:
    """What a key means: its sentence, unit and an example of its value in TOML."""

    sentence: str
    unit: str
    example: str


@dataclass(frozen=True)
class KeyPlace:
    """A key of a file: its path, its type and default in words, and what it means."""

    file: str
    path: str
    kind: str
    default: str
    words: _KeyWords


@lru_cache(maxsize=1)
def _key_table() -> dict[tuple[str, str], _KeyWords]:
    """The words of every key, by class of the table and key. ``*``: keys that mean the same in several tables."""
    table: dict[tuple[str, str], _KeyWords] = {}
    section = ""
    for line in files("piga.data").joinpath("keys.txt").read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            section = line.strip("[] ")
        elif line.strip() and not line.startswith("#"):
            key, unit, example, sentence = re.split(r" ?\| ?", line)
            table[section, key] = _KeyWords(sentence, unit, example)
    return table


def words_of(struct: type, key: str) -> _KeyWords:
    """The words of a key of a table, also of one that it extends; empty if it has none."""
    known = _key_table()
    names = [*(one.__name__ for one in struct.__mro__), "*"]
    return next((known[name, key] for name in names if (name, key) in known), _KeyWords("", "", ""))


@cache
def places_of(file: str) -> tuple[KeyPlace, ...]:
    """All keys of a kind of file, in order."""
    _, module, name = FILES[file]
    return tuple(_below(file, getattr(import_module(module), name), "", 0))


def _below(file: str, struct: Any, path: str, depth: int) -> Iterator[KeyPlace]:
    for entry in msgspec.structs.fields(struct):
        where = f"{path}{entry.encode_name}"
        words = words_of(struct, entry.encode_name)
        yield KeyPlace(file, where, _type_words(entry.type), _default(entry), words)
        parts = structs_in(entry.type) if depth < _MOST_PARTS else []
        kinds = [f'"{part.__struct_config__.tag}"' for part in parts if part.__struct_config__.tag]
        if kinds:
            yield KeyPlace(file, f"{where}.kind", " | ".join(kinds), "needed", words_of(parts[0], "kind"))
        for part in parts:
            yield from _below(file, part, f"{where}.", depth + 1)


def _default(entry: Any) -> str:
    if entry.required:
        return "needed"
    if isinstance(entry.default, msgspec.Struct):
        return "its defaults"
    if entry.default is msgspec.NODEFAULT or entry.default in (None, (), {}, ""):
        return "none"
    if isinstance(entry.default, float) and (unit := si_unit(entry.type)):
        return f"{entry.default:.6g} {unit}".removesuffix(" 1")
    return json.dumps(entry.default, ensure_ascii=False)


_TYPES: dict[Any, str] = {
    str: "text",
    float: "number",
    int: "whole number",
    bool: "true | false",
    Any: "any value",
}


def _type_words(annotation: Any) -> str:
    """A type in words."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        plain = si_unit(annotation) and not structs_in(parts[0])
        return "quantity" if plain else _type_words(parts[0])
    if origin is Literal:
        return " | ".join(f'"{part}"' for part in parts)
    if origin in (Union, UnionType):
        real = [part for part in parts if part is not type(None)]
        words = ["quantity"] if {str, float} <= set(real) else []
        words += [_type_words(part) for part in real if not words or part not in (str, float, int)]
        return " or ".join(dict.fromkeys(words))
    if origin in (tuple, list):
        return f"list, each a {_type_words(parts[0])}"
    if origin is dict:
        return f"table, each key a {_type_words(parts[-1])}"
    if structs_in(annotation):
        return "table"
    is_tuple = isinstance(annotation, type) and issubclass(annotation, tuple)
    return "list" if is_tuple else _TYPES.get(annotation, getattr(annotation, "__name__", str(annotation)))


def check_setting(key: str, value: Any) -> None:
    """Refuse a key that no run file has, and a value that is not of its list. The tables of a stand are those of a scenario."""
    stand = [place for place in places_of("scenario") if place.path.startswith("stand")]
    kinds = {place.path: place.kind for place in (*places_of("run"), *stand)}
    above = [kinds.get(key[: at.start()], "") for at in re.finditer(r"\.", key)]
    choices = [word.strip('"') for word in kinds.get(key, "").split(" | ")]
    if kinds.get(key, "").startswith('"') and value not in choices:
        raise ArgumentError(f"--set {key}: {value!r} is not known", remedy=f"one of: {', '.join(choices)}")
    if key in kinds or re.search(r"any value|each key|list", " ".join(above)):
        return
    beside = [path for path in kinds if path.rpartition(".")[0] == key.rpartition(".")[0]]
    near = difflib.get_close_matches(key, kinds, n=4) or beside or [path for path in kinds if "." not in path]
    raise ArgumentError(
        f"--set {key}: a run file has no such key", remedy=f"the nearest keys: {', '.join(near)}"
    )
