"""A run file that is not complete yet: its tables, their comments, the open questions, and its text as TOML.

The meaning of the keys is in one table: ``piga/data/keys.txt``.
"""

from __future__ import annotations

import difflib
import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, lru_cache
from importlib import import_module
from importlib.resources import files
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from piga.describe.log import Guess
from piga.errors import ArgumentError, UnitError
from piga.text_files import si_unit, structs_in, toml_text, toml_value
from piga.units import to_si

FILES: dict[str, tuple[str, str, str]] = {
    "run": ("run file", "piga.records.run_file", "RunFile"),
    "scenario": ("scenario", "piga.stand.scenario", "ScenarioTable"),
    "plan": ("plan", "piga.planning.plan_file", "PlanTable"),
    "platform": ("platform scenario", "piga.platform.scenario", "ScenarioFile"),
    "campaign": ("campaign file", "piga.campaign.campaign_file", "CampaignFile"),
    "certificate": ("certificate file", "piga.certificate.certificate_file", "CertificateFile"),
    "set": ("run file of a set", "piga.gravity_norm.estimate", "SetFile"),
    "triad": ("triad file", "piga.compensation.sets", "TriadFile"),
}
"""Kinds of TOML files: name, module and class of the whole file."""
_MOST_PARTS = 6
"""Most parts of a key's path."""


HEIGHT = (
    "CHECK: how high is the laboratory? Without [stand] height (or gravity) 500 m are assumed as its uncertainty: "
    "155 ppm of the scale factor"
)
"""Comment of a draft that has neither height nor local gravity."""


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
    import msgspec

    for entry in msgspec.structs.fields(struct):
        where = f"{path}{entry.encode_name}"
        words = words_of(struct, entry.encode_name)
        yield KeyPlace(file, where, _type_words(entry.type), _default(entry), words)
        for part in structs_in(entry.type) if depth < _MOST_PARTS else ():
            yield from _below(file, part, f"{where}.", depth + 1)


def _default(entry: Any) -> str:
    import msgspec

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


@dataclass(frozen=True)
class Question:
    """A value that the log does not hold: the key of the run file, the question, an example."""

    key: str
    words: str
    example: str

    @property
    def toml(self) -> bool:
        """True if the example is written in TOML, not a text."""
        return self.example[:1] in "{[" or self.example.isdigit()


_ASKED = (
    ("instrument.scale_factor", "nominal scale factor (pendulosity over angular momentum)", "0.8884 rad/s/g"),
    ("instrument.counts_per_revolution", "counts of the output per revolution of the outer gimbal", "72000"),
    ("data.output", "column of the output", '{ column = "n", kind = "counts" }'),
    ("data.sample_rate", "rate of the samples, since no column holds the time", "20 Hz"),
    (
        "data.reference",
        "columns of the specific force along X0, Y0 and Z0",
        '{ columns = ["fx", "fy", "fz"], unit = "g" }',
    ),
    ("stand.latitude", "latitude of the laboratory", "40 deg"),
    ("stand.height", "height of the laboratory above sea level (if you know it)", "320 m"),
    ("stand.radius", "radius of the centrifuge at the instrument", "1 m"),
)
QUESTIONS = {key: Question(key, words, example) for key, words, example in _ASKED}
"""Values that no log need hold, by key of the run file."""


@dataclass
class RunFileDraft:
    """A run file that is not complete yet.

    Attributes
    ----------
    document:
        Its tables.
    comments:
        Lines before a table or key: the reason of each guess, and the alternatives.
    open:
        Questions that the log does not answer. The run file is complete when there are none.
    optional:
        Questions without which a result is worse.
    """

    document: dict[str, dict[str, Any]]
    comments: dict[str, list[str]] = field(default_factory=dict)
    open: list[Question] = field(default_factory=list)
    optional: list[Question] = field(default_factory=list)

    def put(self, key: str, value: Any, *reasons: str) -> None:
        """Set ``table.key`` and the comment on it."""
        table, _, name = key.partition(".")
        self.document.setdefault(table, {})[name] = value
        if reasons:
            self.comments[key] = list(reasons)

    def put_guess(self, key: str, guess: Guess) -> None:
        """Set ``table.key`` to a guess; the comment names the reason and the alternatives."""
        name = key.rpartition(".")[2]
        others = [f"  or: {name} = {toml_value(other)}" for other in guess.alternatives]
        self.put(key, guess.value, guess.reason, *others)

    def put_fact(self, facts: Mapping[str, Guess], key: str, unit: str) -> bool:
        """Set ``table.key`` to the quantity that the preamble of the log states. False if it states none."""
        if key in facts:
            self.put(key, quantity_text(facts[key].value, unit), facts[key].reason)
        return key in facts

    def text(self) -> str:
        """The run file."""
        order: list[str] = [name for name in ("instrument", "data", "stand", "model") if name in self.document]
        order += [name for name in self.document if name not in order]
        comments = dict(self.comments)
        for one in (*self.open, *self.optional):
            table, _, key = one.key.partition(".")
            comments[f"{table}."] = [
                *comments.get(f"{table}.", []),
                f"OPEN: {one.words}. Correct the next line and remove its #.",
                f"{key} = {one.example if one.toml else toml_value(one.example)}",
            ]
        return toml_text({name: self.document[name] for name in order}, comments)

    def completed(self) -> RunFileDraft:
        """A draft in which every open question has its example as the answer: to check all that is not open."""
        whole = RunFileDraft({table: dict(part) for table, part in self.document.items()})
        for one in self.open:
            whole.put(one.key, setting(f"{one.key}={one.example}")[1])
        output = whole.document["data"].get("output")
        if isinstance(output, Mapping) and output.get("kind") in ("counts", "pulses"):
            whole.document["instrument"].setdefault("counts_per_revolution", 72000)
        return whole

    def give(self, key: str, value: Any) -> None:
        """Set a value that the user gave, also inside an inline table."""
        if key in ("stand.height", "stand.gravity") and HEIGHT in self.comments.get("stand.kind", []):
            self.comments["stand.kind"].remove(HEIGHT)
        parts = key.split(".")
        at: dict[str, Any] = self.document.setdefault(parts[0], {})
        for part in parts[1:-1]:
            inner = at.get(part)
            at[part] = dict(inner) if isinstance(inner, Mapping) else {}
            at = at[part]
        at[parts[-1]] = value
        if parts[0] == "data" and parts[1] in ("time", "sample_rate"):
            at_data = self.document["data"]
            at_data.pop("sample_rate" if parts[1] == "time" else "time", None)
        if parts[-1] == "stamp":
            at.pop("unit", None)
        self.comments[".".join(parts[:2])] = ["as given"]

    def ask(self) -> None:
        """Ask all questions that are still open."""
        document = self.document
        own, data, stand = document["instrument"], document["data"], document.get("stand")
        missing = []
        if "output" not in data:
            missing.append("data.output")
        if "time" not in data and "sample_rate" not in data:
            missing.append("data.sample_rate")
        if "scale_factor" not in own:
            missing.append("instrument.scale_factor")
        counted = isinstance(data.get("output"), Mapping) and data["output"].get("kind") in ("counts", "pulses")
        if counted and "counts_per_revolution" not in own and "instrument.scale_factor" not in missing:
            missing.append("instrument.counts_per_revolution")
        if stand is not None:
            missing += ["stand.latitude"] if "latitude" not in stand else []
            missing += ["stand.radius"] if stand.get("kind") == "centrifuge" and "radius" not in stand else []
        elif "reference" not in data:
            missing.append("data.reference")
        self.open = [QUESTIONS[key] for key in missing]
        if own.get("kind") == "direct" and "scale_factor" not in own:
            unit = data["output"].get("unit", "V")
            words = "nominal scale factor: its output for 1 g"
            self.open[0] = Question("instrument.scale_factor", words, f"1.3 {unit}/g")
        known = stand is None or "height" in stand or "gravity" in stand
        self.optional = [] if known else [QUESTIONS["stand.height"]]


def setting(text: str) -> tuple[str, Any]:
    """Key and value of ``instrument.scale_factor="0.8884 rad/s/g"``. A value that is not TOML is text."""
    key, equals, written = text.partition("=")
    key = key.strip()
    if not equals or "." not in key or not all(key.split(".")):
        raise ArgumentError(
            f"--set {text}: is not table.key=value",
            remedy="e.g. --set instrument.scale_factor='0.8884 rad/s/g'",
        )
    _check_key(key)
    try:
        return key, tomllib.loads(f"value = {written.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        return key, written.strip()


def _check_key(key: str) -> None:
    """Refuse a key that no run file has. The tables of a stand are those of a scenario."""
    stand = [place for place in places_of("scenario") if place.path.startswith("stand")]
    kinds = {place.path: place.kind for place in (*places_of("run"), *stand)} | {"stand.kind": "text"}
    above = [kinds.get(key[: at.start()], "") for at in re.finditer(r"\.", key)]
    if key in kinds or re.search(r"any value|each key|list", " ".join(above)):
        return
    beside = [path for path in kinds if path.rpartition(".")[0] == key.rpartition(".")[0]]
    near = difflib.get_close_matches(key, kinds, n=4) or beside or [path for path in kinds if "." not in path]
    raise ArgumentError(
        f"--set {key}: a run file has no such key", remedy=f"the nearest keys: {', '.join(near)}"
    )


def number_in(text: Any) -> float:
    """The number at the beginning of a text, with a decimal comma or point; 0 if there is none."""
    try:
        return float(str(text).split()[0].replace(",", "."))
    except (ValueError, IndexError):
        return 0.0


def quantity_text(text: Any, unit: str) -> str:
    """A quantity as a preamble writes it: a decimal comma becomes a point; a plain number gets the usual unit."""
    number, _, rest = str(text).strip().partition(" ")
    number = number.replace(",", ".")
    rest = rest.strip().removesuffix("N").strip()
    for written in (f"{number} {rest or unit}", number):
        try:
            to_si(written, unit)
        except UnitError:
            continue
        return written
    return str(text)
