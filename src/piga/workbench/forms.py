"""A TOML file as a form: its keys with what they mean, and the same text with other values.

The keys come from the classes of the files and from ``piga/data/keys.txt``, as those of ``piga check --explain`` do.
"""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from piga.describe.draft import places_of
from piga.errors import ArgumentError, PigaError
from piga.records.text_files import toml_document, toml_value


@dataclass(frozen=True)
class Field:
    """A key in the form: its path, what it means, and its value as TOML; ``choices`` are the values that it may have."""

    path: str
    sentence: str
    unit: str
    example: str
    value: str
    choices: tuple[str, ...] = ()


@dataclass(frozen=True)
class Form:
    """Text and form of a file, and what is wrong with the text.

    Attributes
    ----------
    file:
        Kind of file, one of :data:`piga.describe.draft.FILES`.
    text:
        The text.
    tables:
        The keys by table, with their values.
    message:
        Why the text has no form; empty if it has.
    """

    file: str
    text: str
    tables: dict[str, list[Field]]
    message: str = ""

    @property
    def mark(self) -> str:
        """Digest of the text that the form shows."""
        return digest(self.text)


def digest(text: str) -> str:
    """Digest of a text."""
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def form_of_text(text: str, file: str, message: str = "") -> Form:
    """The form of a text; if the text is not TOML, its message."""
    try:
        return Form(file, text, form_fields(text, file), message)
    except PigaError as error:
        return Form(file, text, {}, message or str(error))


def form_fields(text: str, file: str = "run") -> dict[str, list[Field]]:
    """The keys of a kind of file by table, with their values in ``text``.

    Lists of tables stand in the text only.

    Raises
    ------
    RunFileError
        If the text is not TOML.
    """
    document = _parsed(text)
    tables: dict[str, list[Field]] = {}
    for place in places_of(file):
        table, _, key = place.path.partition(".")
        held = document.get(table)
        if not key or "." in key or (held is not None and not isinstance(held, dict)):
            continue
        value = toml_value(held[key]) if isinstance(held, dict) and key in held else ""
        words = place.words
        choices = tuple(place.kind.split(" | ")) if " | " in place.kind else ()
        entry = Field(place.path, words.sentence, words.unit, words.example, value, choices)
        fields = tables.setdefault(table, [])
        if all(field.path != entry.path for field in fields):
            fields.append(entry)
    for table, held in document.items():
        fields = tables.get(table, [])
        known = {field.path for field in fields}
        of_table = next((place.words.sentence for place in places_of(file) if place.path == table), "")
        for key, value in held.items() if isinstance(held, dict) and of_table else ():
            if f"{table}.{key}" not in known and "." not in key:
                tables.setdefault(table, []).insert(
                    0, Field(f"{table}.{key}", of_table, "", "", toml_value(value))
                )
    return tables


def text_with(text: str, values: Mapping[str, str], file: str = "run") -> str:
    """The text of a file with other values; comments and all other keys stay as they are.

    Parameters
    ----------
    text:
        The file.
    values:
        TOML values by ``table.key``. An empty one removes the key. A value that is not TOML is taken as text.
    file:
        Kind of file.

    Raises
    ------
    RunFileError
        If the text is not TOML, or a value cannot stand in a TOML file.
    ArgumentError
        If a value cannot be put in its place without moving others.
    """
    import tomlkit

    expected = copy.deepcopy(_parsed(text))
    document: Any = tomlkit.parse(text)
    known = {field.path: field.value for fields in form_fields(text, file).values() for field in fields}
    for path, value in values.items():
        table, _, key = path.partition(".")
        if path not in known or value.strip() == known[path]:
            continue
        if not value.strip():
            document[table].pop(key, None)
            expected[table].pop(key, None)
            continue
        if table not in document:
            document[table] = tomlkit.table()
        written = _toml(value.strip())
        document[table][key] = written
        expected.setdefault(table, {})[key] = written.unwrap()
    changed = str(tomlkit.dumps(document))
    if _parsed(changed) != expected:
        raise ArgumentError(
            "this value cannot be put in its place from the form",
            remedy="write it into the text beside the form",
        )
    return changed


def _parsed(text: str) -> dict[str, Any]:
    return toml_document(Path("the text"), text.encode("utf-8"))


def _toml(value: str) -> Any:
    """A value as TOML; words that are none are text."""
    import tomlkit
    from tomlkit.exceptions import TOMLKitError

    try:
        return tomlkit.value(value)
    except (TOMLKitError, ValueError):
        return tomlkit.string(value)


def typed_text(fields: Mapping[str, list[str]]) -> str:
    """The text of a sent form as it was typed."""
    return fields.get("text", [""])[-1].replace("\r\n", "\n")


def form_values(fields: Mapping[str, list[str]]) -> dict[str, str]:
    """The values of a sent form by ``table.key``."""
    return {key.removeprefix("key:"): held[-1] for key, held in fields.items() if key.startswith("key:")}


def sent_text(fields: Mapping[str, list[str]], file: str) -> str:
    """The text of a sent form.

    The values of the form are put in if the text was not edited after the form was drawn: somebody typed into a field
    and pressed a button at once. If it was edited, the text holds.
    """
    text, values = typed_text(fields), form_values(fields)
    drawn = fields.get("drawn", [""])[-1]
    return text_with(text, values, file) if values and digest(text) == drawn else text
