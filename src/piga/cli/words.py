"""``piga terms``, ``piga methods`` and ``piga check --explain``: what words of the files mean."""

from __future__ import annotations

import difflib
import json
import re
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from importlib.resources import files
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import typer

from piga.cli.common import JsonOption, print_json, say
from piga.errors import ArgumentError

FILES: dict[str, tuple[str, str, str]] = {
    "run": ("run file", "piga.records.run_file", "RunFile"),
    "scenario": ("scenario", "piga.stand.scenario", "ScenarioTable"),
    "plan": ("plan", "piga.planning.plan_file", "PlanTable"),
    "platform": ("platform scenario", "piga.platform.model.scenario", "ScenarioFile"),
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


def places(file: str) -> list[KeyPlace]:
    """All keys of a kind of file, in order."""
    _, module, name = FILES[file]
    return _below(file, getattr(import_module(module), name), "", 0)


def _below(file: str, struct: Any, path: str, depth: int) -> list[KeyPlace]:
    import msgspec

    result: list[KeyPlace] = []
    for entry in msgspec.structs.fields(struct):
        inner = _structs(entry.type)
        words = words_of(struct.__name__, entry.encode_name)
        if words is None:
            words = KeyWords("", "", "")
        where = f"{path}{entry.encode_name}"
        result.append(KeyPlace(file, where, struct.__name__, type_words(entry.type), _default(entry), words))
        if depth < MOST_PARTS:
            for part in inner:
                result += _below(file, part, f"{where}.", depth + 1)
    return result


def _structs(annotation: Any) -> list[Any]:
    """All tables in a type."""
    import msgspec

    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        return [annotation]
    return [struct for part in get_args(annotation) for struct in _structs(part)]


def _default(entry: Any) -> str:
    import msgspec

    if entry.required:
        return "needed"
    if isinstance(entry.default, msgspec.Struct):
        return "its defaults"
    if entry.default is msgspec.NODEFAULT or entry.default in (None, (), {}, ""):
        return "none"
    return json.dumps(entry.default, ensure_ascii=False)


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
        return f"list of {type_words(next(part for part in parts if part is not Ellipsis))}"
    if origin is dict:
        return f"table of {type_words(parts[-1])}"
    if _structs(annotation):
        return "table"
    return {str: "text", float: "number", int: "whole number", bool: "true | false", Any: "any value"}.get(
        annotation, getattr(annotation, "__name__", str(annotation))
    )


def explain(key: str) -> list[KeyPlace]:
    """The places of a key in all files: ``terms``, ``data.time.stamp`` or ``[data] time``.

    Raises
    ------
    ArgumentError
        If no file has it. The message names similar keys.
    """
    wanted = ".".join(re.sub(r"[\[\]]", " ", key.replace(".", " ")).split())
    every = [place for file in FILES for place in places(file)]
    exact = [place for place in every if place.path == wanted]
    ends = [place for place in every if place.path.endswith(f".{wanted}")]
    hits = exact or ends
    if not hits:
        near = difflib.get_close_matches(
            wanted, sorted({p.path for p in every} | {p.path.rpartition(".")[2] for p in every}), n=4
        )
        raise ArgumentError(
            f"no file has the key '{key[:60]}'",
            remedy=f"did you mean {', '.join(near)}?" if near else "write e.g. data.time.stamp, or terms",
        )
    return hits


def say_keys(hits: list[KeyPlace]) -> None:
    """Print what keys mean. Places with the same meaning are named together."""
    groups: dict[tuple[str, str, str, str], list[KeyPlace]] = {}
    for place in hits:
        groups.setdefault((place.words.sentence, place.words.example, place.kind, place.default), []).append(
            place
        )
    for (sentence, example, kind, default), group in groups.items():
        names = dict.fromkeys(f"{place.path} ({FILES[place.file][0]})" for place in group)
        say("; ".join(list(names)[:4]) + (f"; and {len(names) - 4} more" if len(names) > 4 else ""))
        say(f"  {sentence}")
        unit = group[0].words.unit
        say(f"  value    {kind}" + (f", e.g. in {unit}" if unit not in ("", "own") else ""))
        say(f"  default  {default}")
        say(f"  example  {group[0].path.rpartition('.')[2]} = {example}")


def key_documents(hits: list[KeyPlace]) -> list[dict[str, str]]:
    """The same for ``--json``."""
    return [
        {
            "file": FILES[place.file][0],
            "key": place.path,
            "meaning": place.words.sentence,
            "unit": place.words.unit,
            "value": place.kind,
            "default": place.default,
            "example": place.words.example,
        }
        for place in hits
    ]


def terms(
    name: Annotated[str | None, typer.Argument(metavar="[TERM]", help="One term; all if left out.")] = None,
    as_json: JsonOption = False,
) -> None:
    """List the terms of the error model.

    For each: what it multiplies, its unit, its meaning, the test that shows it, and how large it usually is.
    """
    from piga.records.terms import TERM_WORDS, term_words, unit_of

    names = list(TERM_WORDS) if name is None else [name]
    try:
        chosen = {one: term_words(one) for one in names}
    except KeyError:
        raise ArgumentError(
            f"'{name}' is not a term", remedy=f"terms: {' '.join(TERM_WORDS)} (s1 c1 s2 c2 ...)"
        ) from None
    if as_json:
        keys = ("formula", "meaning", "shown_by", "usual")
        rows = [
            {"name": one, "unit": _unit(one, unit_of)} | {key: getattr(w, key) for key in keys}
            for one, w in chosen.items()
        ]
        print_json(rows)
        return
    for one, w in chosen.items():
        say(f"{one}  [{_unit(one, unit_of)}]  {w.meaning}")
        say(f"  adds     {w.formula}")
        say(f"  shown by {w.shown_by}")
        say(f"  usually  {w.usual}")


def _unit(name: str, unit_of: Any) -> str:
    return "g" if name in ("sn", "cn") else str(unit_of(name))


def methods(as_json: JsonOption = False) -> None:
    """List the methods of a calibration, and when to take which."""
    from piga.records.run_file import METHOD_WORDS

    if as_json:
        print_json([{"name": name, "meaning": what, "use": use} for name, (what, use) in METHOD_WORDS.items()])
        return
    for name, (what, use) in METHOD_WORDS.items():
        say(f"{name}: {what}")
        say(f"  use it   {use}")
