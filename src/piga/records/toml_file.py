"""TOML files read into typed tables, with messages that name file, table and key."""

from __future__ import annotations

import difflib
import re
import tomllib
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from piga.errors import RunFileError
from piga.records.limits import read_whole

T = TypeVar("T", bound=msgspec.Struct)

MAX_BYTES = 1 << 20
"""Largest TOML file read [bytes]; run files are a few kilobytes."""

KINDS = {
    "plan": "a plan: give it to 'piga plan'",
    "truth": "a scenario: 'piga simulate' makes a run file of it",
    "polar": "a platform scenario: give it to 'piga platform'",
    "laboratory": "what a certificate says: give it to 'piga certificate' as --data",
    "data": "a run file: give it to 'piga check' or 'piga calibrate'",
}
"""Top-level tables that tell one kind of file from another, and what takes that kind; the first that fits."""

_UNKNOWN = re.compile(r"unknown field `([^`]*)`")
_MISSING = re.compile(r"missing required field `([^`]*)`")
_PATH = re.compile(r" - at `(?:key in )?\$\.?([^`]*)`$")


def read_toml(path: Path, kind: type[T]) -> T:
    """Read ``path`` into ``kind``.

    Raises
    ------
    RunFileError
        If the file is missing, is no TOML (with line), has an unknown or missing key, or a value of
        the wrong type.
    """
    try:
        text = read_whole(path, MAX_BYTES, "the TOML file, not the data file", RunFileError).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RunFileError(
            f"{path}: byte {error.start} is not UTF-8", remedy="save the file as UTF-8"
        ) from None
    try:
        raw = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise RunFileError(
            f"{path}: not valid TOML: {error}", remedy="see https://toml.io for the syntax"
        ) from None
    try:
        return msgspec.convert(raw, kind)
    except msgspec.ValidationError as error:
        raise _explain(path, str(error), kind, raw) from None


def _explain(path: Path, message: str, kind: type[msgspec.Struct], raw: dict[str, Any]) -> RunFileError:
    """Turn a validation message into one that a test engineer understands."""
    where_match = _PATH.search(message)
    keys = [key for key in (where_match.group(1) if where_match else "").split(".") if key]
    where = f"[{'.'.join(keys)}]" if keys else "top level"
    unknown, missing = _UNKNOWN.search(message), _MISSING.search(message)
    if unknown:
        allowed = _field_names(kind, keys)
        near = difflib.get_close_matches(unknown.group(1), allowed, n=1)
        other = next((words for table, words in KINDS.items() if table in raw and table not in allowed), None)
        remedy = f"did you mean '{near[0]}'?" if near else f"allowed here: {', '.join(allowed)}"
        if other and not keys:
            remedy = f"it looks like {other}"
        return RunFileError(f"{path}: {where} has the unknown key '{unknown.group(1)}'", remedy=remedy)
    if missing:
        return RunFileError(f"{path}: {where} lacks the key '{missing.group(1)}'", remedy="add it")
    text = _PATH.sub("", message)
    return RunFileError(f"{path}: {where}: {text[:1].lower()}{text[1:]}", remedy="correct the value")


def _field_names(kind: type[msgspec.Struct], keys: list[str]) -> list[str]:
    """Names of the fields allowed at the place ``keys`` of a structure."""
    current: object = kind
    for key in keys:
        name = key.split("[")[0]
        fields = {field.encode_name: field.type for field in msgspec.structs.fields(current)}  # type: ignore[arg-type]
        found = _structs_of(fields.get(name))
        if not found:
            return []
        current = found[0]
    return [field.encode_name for field in msgspec.structs.fields(current)]  # type: ignore[arg-type]


def _structs_of(annotation: object) -> list[type[msgspec.Struct]]:
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        return [annotation]
    return [found for part in getattr(annotation, "__args__", ()) for found in _structs_of(part)]
