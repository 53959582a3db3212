"""``piga terms``, ``methods``, ``examples`` and ``check --explain``: what helps to write files and commands."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from piga.cli.common import ForceOption, JsonOption, argument, deliver, option, tell
from piga.data import example_files
from piga.errors import ArgumentError

if TYPE_CHECKING:
    from piga.describe.draft import KeyPlace


def explain(key: str) -> list[KeyPlace]:
    """The places of a key in all files: ``terms``, ``data.time.stamp`` or ``[data] time``."""
    from piga.describe.draft import FILES, places_of

    wanted = ".".join(re.sub(r"[\[\]]", " ", key.replace(".", " ")).split())
    every = [place for file in FILES for place in places_of(file)]
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


def explain_key(key: str, as_json: bool) -> None:
    """Say what a key means; places with the same meaning are named together."""
    from piga.describe.draft import FILES

    rows = [
        {
            "file": FILES[place.file][0],
            "key": place.path,
            "meaning": place.words.sentence,
            "unit": place.words.unit,
            "value": place.kind,
            "default": place.default,
            "example": place.words.example,
        }
        for place in explain(key)
    ]
    groups: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in ("meaning", "example", "value", "default")), []).append(
            row
        )
    tell(as_json, rows, (line for group in groups.values() for line in _key_lines(group)))


def _key_lines(group: list[dict[str, str]]) -> Iterator[str]:
    names, first = dict.fromkeys("{key} ({file})".format(**row) for row in group), group[0]
    yield "; ".join(list(names)[:4]) + (f"; and {len(names) - 4} more" if len(names) > 4 else "")
    yield f"  {first['meaning']}"
    plain = first["unit"] in ("", "1", "own", "as the value", "row", "rows")
    yield f"  value    {first['value']}" + ("" if plain else f", e.g. in {first['unit']}")
    yield f"  default  {first['default']}"
    yield f"  example  {first['key'].rpartition('.')[2]} = {first['example']}"


def terms(
    name: Annotated[str | None, argument("TERM", "One term; all if left out.")] = None,
    as_json: JsonOption = False,
) -> None:
    """List the terms of the error model.

    For each: what it multiplies, its unit, its meaning, the test that shows it, and a size from the literature where there is one.
    """
    from piga.records.terms import TERM_WORDS, known_terms, term_words, unit_of

    names = list(TERM_WORDS) if name is None else [name]
    try:
        chosen = {one: term_words(one) for one in names}
    except KeyError:
        raise ArgumentError(f"'{name}' is not a term", remedy=known_terms(str(name))) from None
    units = {one: "g" if one in ("sn", "cn") else unit_of(one) for one in chosen}
    keys = ("formula", "meaning", "shown_by", "known")
    rows = [
        {"name": one, "unit": units[one]} | {key: getattr(w, key) for key in keys} for one, w in chosen.items()
    ]
    tell(as_json, rows, (line for row in rows for line in _term_lines(**row)))


def _term_lines(name: str, unit: str, formula: str, meaning: str, shown_by: str, known: str) -> Iterator[str]:
    yield f"{name}  [{unit}]  {meaning}"
    yield f"  adds     {formula}"
    yield f"  shown by {shown_by}"
    if known:
        yield f"  e.g.     {known}"


def methods(as_json: JsonOption = False) -> None:
    """List the methods of a calibration, and when to take which."""
    from piga.records.run_file import METHOD_WORDS

    rows = [{"name": name, "meaning": what, "use": use} for name, (what, use) in METHOD_WORDS.items()]
    tell(as_json, rows, ("{name}: {meaning}\n  use it   {use}".format(**row) for row in rows))


def examples(
    out: Annotated[Path, option("DIR", "Folder for the files.")] = Path("examples"), force: ForceOption = False
) -> None:
    """Write all example files, as the how-tos use them.

    Run the commands of the how-tos in the folder that holds DIR.
    """
    texts = example_files()
    with deliver(out, "examples", tuple(texts), (), force=force, as_json=False) as to:
        for name, content in texts.items():
            path = to / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        first = f"{to.folder}/dividing-head.toml"
        to.tell(dict, lambda: f"Try: piga simulate {first} --out head; piga calibrate head/run.toml")
