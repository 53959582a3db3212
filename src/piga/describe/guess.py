"""A guess: a value, the reason for it, and what else it may be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Guess:
    """A value, the reason for it in a few words, and the ``alternatives``, likelier ones first."""

    value: Any
    reason: str
    alternatives: tuple[Any, ...] = ()
