"""Files from outside: limits and checks; TOML and JSON read into typed tables; TOML written.

Messages name file, table and key.
"""

from __future__ import annotations

import difflib
import json
import math
import os
import re
import stat
import tomllib
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from io import BufferedReader
from pathlib import Path
from threading import Lock
from typing import Any, Literal, TypeVar, get_args, get_origin

import msgspec

from piga.errors import ArgumentError, DataError, PigaError, RunFileError, Where
from piga.units import LARGEST

T = TypeVar("T", bound=msgspec.Struct)
_Converted = TypeVar("_Converted")

_MAX_UNPACKED = 2 << 30
"""Largest unpacked size of the wanted part of a container [bytes]."""
LARGEST_SAMPLE = 1e30
"""Largest absolute value of a sample in any unit. A larger value is damage. Squares of smaller values stay finite."""
MAX_SEGMENTS = 100_000
"""Largest number of different labels in the segment column of a record."""
_MOST_NAME_LETTERS = 200
"""Most characters of a name. A file name may have 255 bytes."""
_MOST_TOML_BYTES = 1 << 20
"""Largest TOML file that is read [bytes]. Run files have a few kilobytes."""

_KINDS = {
    "plan": "a plan: give it to 'piga plan'",
    "truth": "a scenario: 'piga simulate' makes a run file of it",
    "polar": "a platform scenario: give it to 'piga platform'",
    "laboratory": "what a certificate says: give it to 'piga certificate' as --data",
    "campaign": "a campaign: give it to 'piga campaign plan'",
    "triad": "a set of calibrated instruments: give it to 'piga compensate'",
    "data": "a run file: give it to 'piga check' or 'piga calibrate'",
}
"""Top-level tables that identify a kind of file, and the command that takes it. The first match is used."""

MAX_NAME = 256
"""Longest text that may be a file name [characters]."""
_BARE = re.compile(r"[A-Za-z0-9_-]+")
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]")
_UNKNOWN = re.compile(r"unknown field `([^`]*)`")
_MISSING = re.compile(r"missing required field `([^`]*)`")
_PATH = re.compile(r" - at `(?:key in )?\$\.?([^`]*)`$")


def open_regular(
    path: Path, wanted: str = "the file itself", error: type[PigaError] = DataError
) -> BufferedReader:
    """Open a file for reading. Every file from outside is opened here.

    A device, a pipe or a folder is refused before anything is read from it: reading it might never end. ``wanted`` and
    ``error`` are for the message: the file that the user should name instead, and the class of the error.
    """
    remedy = f"check the file name: name {wanted}"
    try:
        mode = path.stat().st_mode
        if stat.S_ISREG(mode):
            return path.open("rb")
    except OSError as reason:
        raise error(f"{path}: cannot be read ({reason.strerror})", remedy=remedy, where=Where(path)) from None
    except ValueError:
        raise error(f"{str(path)!r}: is not a file name", remedy=remedy) from None
    kind = "a folder" if stat.S_ISDIR(mode) else "a pipe or a device"
    raise error(f"{path}: is not a regular file, but {kind}", remedy=remedy, where=Where(path))


def read_whole(path: Path, most: int, wanted: str, error: type[PigaError] = DataError) -> bytes:
    """All bytes of a file of at most ``most`` bytes; arguments and errors as for :func:`open_regular`."""
    with open_regular(path, wanted, error) as stream:
        size = os.fstat(stream.fileno()).st_size
        data = stream.read(most + 1) if size <= most else b""
    if max(size, len(data)) > most:
        raise error(f"{path}: larger than {most} bytes", remedy=f"name {wanted}", where=Where(path))
    return data


def check_label(text: str, what: str) -> None:
    """Refuse a name of an instrument, run or segment that does not fit into a list, a file name and a page."""
    if not text.strip():
        raise DataError(f"{what} is empty", remedy="give it a name")
    if len(text) > _MOST_NAME_LETTERS:
        raise DataError(f"{what} has {len(text)} characters", remedy=f"use {_MOST_NAME_LETTERS} or fewer")
    odd = next((letter for letter in text if not letter.isprintable() and letter != "\u3000"), None)
    if odd is not None:
        raise DataError(
            f"{what} {text[:40]!r} holds the control character {odd!r}", remedy="use letters, digits and signs"
        )


def first_line(error: BaseException) -> str:
    """First line of a library's error message; the class of the error if the message is empty."""
    text = str(error)
    return text.splitlines()[0] if text else type(error).__name__


def check_unpacked(path: Path, unpacked: int) -> None:
    """Refuse a container whose unpacked size is too large, with a :class:`DataError` that states the limit."""
    if unpacked > _MAX_UNPACKED:
        raise DataError(
            f"{path}: unpacks to more than {_MAX_UNPACKED >> 20} MiB", remedy="export as Parquet, or in parts"
        )


def toml_bytes(path: Path) -> bytes:
    """The bytes of a TOML file."""
    wanted = "the TOML file, not the data file; for the log of a test 'piga init' drafts it"
    return read_whole(path, _MOST_TOML_BYTES, wanted, RunFileError)


def toml_document(path: Path, raw: bytes | None = None) -> dict[str, Any]:
    """The tables of a TOML file as plain values. ``raw``: its bytes, if they were read before."""
    try:
        document = tomllib.loads((toml_bytes(path) if raw is None else raw).decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        fault, remedy = f"not valid TOML: {str(error)[:300]}", "see https://toml.io for the syntax"
        if isinstance(error, UnicodeDecodeError):
            fault, remedy = f"byte {error.start} is not UTF-8", "save the file as UTF-8"
        if path.suffix.lower() not in (".toml", ""):
            remedy = "give a TOML file; for the log of a test 'piga init' drafts the run file"
        raise RunFileError(f"{path}: {fault}", remedy=remedy) from None
    _check_values(path, document, "")
    model = document.get("model")
    if isinstance(model, dict) and "phase" in model:  # the name of phases until 0.1
        model.setdefault("phases", model.pop("phase"))
    estimation = document.get("estimation")
    if isinstance(estimation, dict) and estimation.get("method") == "recursive":  # a former name
        estimation["method"] = "information"
    return document


def _check_values(path: Path, value: object, where: str) -> None:
    """Refuse values that TOML allows but piga cannot use."""
    parts = value.items() if isinstance(value, dict) else ()
    for key, part in parts:
        _check_values(path, key, where)
        _check_values(path, part, f"{where}.{key}" if where else key)
    for part in value if isinstance(value, list) else ():
        _check_values(path, part, where)
    fault = ""
    if isinstance(value, str) and _CONTROL.search(value):
        fault = f"{value[:40]!r} holds a control character"
    elif isinstance(value, float) and LARGEST < abs(value) < math.inf:
        fault = f"{value:g} is too large to compute with"
    elif isinstance(value, int) and not -(1 << 63) <= value < 1 << 63:
        fault = "an integer of more than 64 bits"
    if fault:
        raise RunFileError(f"{path}: [{where}]: {fault}", remedy="correct the value")


def files_named_in(path: Path) -> list[Path]:
    """The TOML file and all files that it names, directly or through other TOML files. A command may read these.

    Any text that is the name of a file beside the TOML file counts. A file that cannot be read adds no names.
    """
    named = [path]
    for at in named:  # grows in the loop
        if at.suffix == ".toml":
            with suppress(RunFileError, OSError):
                near = [
                    at.parent / word for word in texts_of(toml_document(at)) if word and len(word) < MAX_NAME
                ]
                named += [file for file in dict.fromkeys(near) if file not in named and file.is_file()]
    return named


def texts_of(value: object) -> list[str]:
    """All texts of a document."""
    if isinstance(value, str):
        return [value]
    parts = list(value.values()) if isinstance(value, dict) else value if isinstance(value, list) else []
    return [word for part in parts for word in texts_of(part)]


def read_toml(path: Path, kind: type[T], raw: bytes | None = None) -> T:
    """Read a TOML file into ``kind``. ``raw``: its bytes, if they were read before.

    Raises
    ------
    RunFileError
        If the file is missing, is not TOML (the message names the line), has an unknown or missing key, or a value of
        the wrong type.
    """
    return convert_toml(path, toml_document(path, raw), kind)


_ONE_AT_A_TIME = Lock()


def converted(
    value: object, kind: type[_Converted], dec_hook: Callable[[type, Any], Any] | None = None
) -> _Converted:
    """:func:`msgspec.convert` of a table or a record, by one thread at a time.

    Two threads that use a type for the first time at the same time would crash the interpreter.
    """
    with _ONE_AT_A_TIME:
        return msgspec.convert(value, kind, dec_hook=dec_hook)


def convert_toml(path: Path, document: dict[str, Any], kind: type[T]) -> T:
    """Convert the tables of a TOML file into ``kind``. ``path`` is named in messages."""
    try:
        return converted(document, kind)
    except msgspec.ValidationError as error:
        text, remedy = explained(str(error), kind, document)
        if not document:
            text, remedy = (
                "the file is empty",
                "name a file with content; 'piga examples' writes one of each kind",
            )
        raise RunFileError(f"{path}: {text}", remedy=remedy) from None


def convert_table(name: str, table: object, kind: Any) -> Any:
    """Convert one table, called ``name`` in messages, into ``kind``."""
    holder = msgspec.defstruct("Tables", [(name, kind)])
    try:
        return getattr(converted({name: table}, holder), name)
    except msgspec.ValidationError as error:
        text, remedy = explained(str(error), holder, {name: table})
        raise ArgumentError(text, remedy=remedy) from None


def explained(message: str, kind: type[msgspec.Struct], raw: dict[str, Any]) -> tuple[str, str]:
    """A message of msgspec as a test engineer understands it, and its remedy; ``raw``: the tables that do not fit ``kind``."""
    where_match = _PATH.search(message)
    keys = [key for key in (where_match.group(1) if where_match else "").split(".") if key]
    where = f"[{'.'.join(keys)}]" if keys else "top level"
    unknown, missing = _UNKNOWN.search(message), _MISSING.search(message)
    if unknown:
        allowed = list(_types_at(kind, keys, raw))
        near = difflib.get_close_matches(unknown.group(1), allowed, n=1)
        other = next((words for table, words in _KINDS.items() if table in raw and table not in allowed), None)
        remedy = f"did you mean '{near[0]}'?" if near else f"allowed here: {', '.join(allowed)}"
        if other and not keys:
            remedy = f"it looks like {other}"
        return f"{where} has the unknown key '{unknown.group(1)}'", remedy
    if missing:
        return (
            f"{where} lacks the key '{missing.group(1)}'",
            f"add it; see piga check --explain {missing.group(1)}",
        )
    text = _TYPES.sub(_in_words, _PATH.sub("", message))
    wrong = re.match(r"Invalid (?:enum )?value ('.*')", text)
    text = f"{wrong.group(1)} is not one of the allowed values" if wrong else text.strip()
    last = keys[-1].split("[")[0] if keys else ""
    remedy = f"correct the value; piga check --explain {last} shows an example" if last else "correct the value"
    remedy = f"one of: {', '.join(_choices(kind, keys, raw))}" if wrong else remedy
    return f"{where}: {text[:1].lower()}{text[1:]}", remedy


_TYPES = re.compile(r"`([a-z]+(?: \| [a-z]+)*)`")
_TYPE_WORDS = {
    "object": "a table { ... }", "array": "a list [ ... ]", "str": "text", "int": "a whole number", "float": "a number",
    "bool": "true or false",
}  # fmt: skip


def _in_words(match: re.Match[str]) -> str:
    """Types of a message of msgspec in words: ``object | null`` is a table."""
    words = [_TYPE_WORDS.get(kind, kind) for kind in match.group(1).split(" | ") if kind != "null"]
    return " or ".join(words) if len(words) < 3 or "a number" not in words else "a number or text"


def _types_at(kind: type[msgspec.Struct], keys: list[str], raw: object) -> dict[str, Any]:
    """Types by name of the fields at the place ``keys`` of a structure. Where there are several, ``kind`` in the file decides."""
    current: object = kind
    for key in keys:
        name, _, place = key.rstrip("]").partition("[")
        raw = raw.get(name) if isinstance(raw, dict) else None
        if isinstance(raw, list):
            raw = raw[int(place)] if place.isdigit() and int(place) < len(raw) else None
        tag = raw.get("kind") if isinstance(raw, dict) else None
        fields = {field.encode_name: field.type for field in msgspec.structs.fields(current)}  # type: ignore[arg-type]
        inside = structs_in(fields.get(name))
        if not inside:
            return {}
        current = next((struct for struct in inside if struct.__struct_config__.tag == tag), inside[0])
    return {field.encode_name: field.type for field in msgspec.structs.fields(current)}  # type: ignore[arg-type]


def _choices(kind: type[msgspec.Struct], keys: list[str], raw: object) -> list[str]:
    """The values that the key at this place may have: those of its type, or the kinds of its table."""
    fixed = _literals_in(_types_at(kind, keys[:-1], raw).get(keys[-1].partition("[")[0]))
    tables = (
        structs_in(_types_at(kind, keys[:-2], raw).get(keys[-2].partition("[")[0])) if len(keys) > 1 else []
    )
    return fixed or [str(one.__struct_config__.tag) for one in tables]


def _literals_in(annotation: Any) -> list[str]:
    """All fixed values in a type."""
    if get_origin(annotation) is Literal:
        return [str(one) for one in get_args(annotation)]
    return [value for part in get_args(annotation) for value in _literals_in(part)]


def structs_in(annotation: Any) -> list[Any]:
    """All tables in a type."""
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        return [annotation]
    return [struct for part in get_args(annotation) for struct in structs_in(part)]


def si_unit(annotation: Any) -> str:
    """The unit that the type of a key declares (:func:`piga.records.run_file.in_unit`); empty if it has none."""
    notes = [note for part in (annotation, *get_args(annotation)) for note in getattr(part, "__metadata__", ())]
    return next((note.extra["unit"] for note in notes if getattr(note, "extra", None)), "")


class JsonError(ValueError):
    """The bytes are not JSON of the wanted kind. The message says why, in one line."""


def json_object(raw: bytes) -> dict[str, Any]:
    """A JSON object (RFC 8259, UTF-8) in which no object has a key twice: programs differ in which value they take."""
    try:
        document = msgspec.json.decode(raw, type=dict[str, Any])
        json.loads(raw, object_pairs_hook=_refuse_twice, parse_int=float)
    except RecursionError:
        raise JsonError("nested too deeply") from None
    except (msgspec.MsgspecError, ValueError) as error:
        raise JsonError(str(error)) from None
    return document


def _refuse_twice(pairs: list[tuple[str, Any]]) -> None:
    if len(dict(pairs)) < len(pairs):
        name = Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise JsonError(f"the key '{name[:60]}' occurs twice in one object")


def toml_key(name: str) -> str:
    """A key, in quotes where it needs them."""
    return name if _BARE.fullmatch(name) else toml_value(name)


def toml_value(value: Any) -> str:
    """A value on one line."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(float(value))
    if isinstance(value, (str, int, float)):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        given = ((toml_key(str(name)), part) for name, part in value.items() if part is not None)
        inside = ", ".join(f"{key} = {toml_value(part)}" for key, part in given)
        return f"{{ {inside} }}" if inside else "{}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(toml_value, value))}]"
    return str(value)  # dates and times write themselves in ISO 8601


def toml_text(document: Mapping[str, Any], comments: Mapping[str, list[str]] | None = None) -> str:
    """A document of tables as text, without keys that have no value (None).

    ``comments``: lines to stand before ``table`` or ``table.key``.
    """
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
            lines += [] if value is None else [f"{toml_key(key)} = {toml_value(value)}"]
        lines += [f"# {line}" for line in comments.get(f"{table}.", [])]
    return "\n".join(lines).lstrip("\n") + "\n"
