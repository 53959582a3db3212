"""Docstrings of the public names: present, more than the name, and naming every argument or field."""

from __future__ import annotations

import inspect
import re
from importlib import import_module
from types import ModuleType

import pytest

ROOMS = ["instrument", "stand", "records", "calibration", "compensation", "platform", "reports"]
MODULES = ["units", "frames", "earth", "errors"]
STRICT = {"instrument", "stand", "records", "reports", "units", "frames", "earth", "calibration"}
"""Rooms whose functions name every argument in the docstring."""
CONVENTIONAL = {"inst", "path", "t", "f", "a_x", "a_Y", "a_Z", "base_rate"}
"""Arguments that the conventions of the package explain."""


def public(room: ModuleType) -> list[str]:
    """Names that a room offers."""
    own = [name for name, value in vars(room).items() if getattr(value, "__module__", "") == room.__name__]
    return list(getattr(room, "__all__", [name for name in own if not name.startswith("_")]))


def callables() -> list[tuple[str, object]]:
    collected = []
    for name in ROOMS + MODULES:
        room = import_module(f"piga.{name}")
        collected += [(f"{name}.{n}", getattr(room, n)) for n in public(room) if callable(getattr(room, n))]
    return collected


@pytest.mark.parametrize(
    ("name", "thing"), callables(), ids=lambda value: value if isinstance(value, str) else ""
)
def test_docstring(name: str, thing: object) -> None:
    if not (inspect.isfunction(thing) or inspect.isclass(thing)):
        return  # a type alias
    text = inspect.getdoc(thing) or ""
    words = set(re.findall(r"\w+", text.lower()))
    said = words - set(re.findall(r"[a-z]+", name.rpartition(".")[2].lower()))
    assert len(said) >= 3, f"{name}: repeats its name"
    if (
        inspect.isclass(thing)
        or name.partition(".")[0] not in STRICT
        or re.search(r"\bas in\b", text, re.IGNORECASE)
    ):
        return
    missing = [
        parameter
        for parameter in inspect.signature(thing).parameters
        if parameter not in CONVENTIONAL and not {parameter.lower(), *parameter.lower().split("_")} & words
    ]
    assert not missing, f"{name}: {', '.join(missing)}"
