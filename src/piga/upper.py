"""What methods of results need from the rooms above: ``piga`` hands it down when it is imported.

Data are made on the lower floors and shown on the upper ones, so ``cal.report()`` has to reach upwards. No room imports one
above it: a method asks here for :mod:`piga.doors`, the module of the top floor that opens them.
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

HANDED: list[Callable[[], ModuleType]] = []
"""One function, which imports ``piga.doors`` when it is called and not before."""


def doors() -> ModuleType:
    """The module ``piga.doors``."""
    return HANDED[0]()
