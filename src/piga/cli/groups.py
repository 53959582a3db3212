"""Groups of commands whose help comes quickly."""

from __future__ import annotations

from typing import Any

from typer.core import TyperGroup, TyperOption


class Group(TyperGroup):
    """A group that does not load pydantic to learn that ``--help`` was not given.

    Typer converts every value that is not of its type yet through pydantic (0.1 s to import). A flag that was not given
    is None, no truth value, so that ``piga check --help`` paid for the ``--help`` that ``piga`` was not given.
    """

    def get_help_option(self, ctx: Any) -> TyperOption | None:
        """The option ``--help``, False when it is not given."""
        option = super().get_help_option(ctx)
        if option is not None:
            option.default = False
        return option
