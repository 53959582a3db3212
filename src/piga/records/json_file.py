"""JSON from outside: one decoder for all of it, strict about what other programs overlook."""

from __future__ import annotations

import json
from typing import Any, TypeVar

import msgspec

T = TypeVar("T")


class _Schema(msgspec.Struct, frozen=True):
    schema: Any = None


class JsonError(ValueError):
    """The bytes are no JSON of the kind that is needed; the message says why, in one line."""


def schema_of(raw: bytes) -> object:
    """The value of the key ``schema`` at the top level; None where there is none.

    Raises
    ------
    JsonError
        If the bytes are no JSON object.
    """
    return _decoded(raw, _Schema).schema


def decode_json(raw: bytes, kind: type[T]) -> T:
    """Decode and check ``raw`` as ``kind``.

    Raises
    ------
    JsonError
        If the bytes are no JSON (RFC 8259, UTF-8), a value has another type than ``kind`` says, or an object
        names a key twice: programs differ in which of the two they take.
    """
    document = _decoded(raw, kind)
    try:
        json.loads(raw.decode("utf-8"), object_pairs_hook=_refuse_twice, parse_int=float)
    except RecursionError:
        raise JsonError("nested too deeply") from None
    except UnicodeDecodeError as error:
        raise JsonError(f"byte {error.start} is not UTF-8") from None
    return document


def _decoded(raw: bytes, kind: type[T]) -> T:
    try:
        return msgspec.json.decode(raw, type=kind)
    except RecursionError:
        raise JsonError("nested too deeply") from None
    except (msgspec.MsgspecError, ValueError) as error:
        raise JsonError(str(error)) from None


def _refuse_twice(pairs: list[tuple[str, Any]]) -> None:
    """Called for every object, innermost first; keeps nothing of it."""
    names: set[str] = set()
    for name, _ in pairs:
        if name in names:
            raise JsonError(f"the key '{name[:60]}' is there twice in one object")
        names.add(name)
