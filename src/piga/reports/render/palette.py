"""One palette for print, screen and dark screens: colour-blind safe, told apart in grey print too.

Roles, not colours, stand in a :class:`~piga.reports.render.figure.Figure`. The hues follow the idea of Okabe
and Ito (vermilion, blue, bluish green); lightness differs as well, so that a grey print keeps the order.
"""

from __future__ import annotations

from typing import Final

from piga.reports.render.figure import Role

INK: Final = "#1c2733"
SOFT: Final = "#56626f"
GRID: Final = "#dfe4ea"

LIGHT: Final[dict[Role, str]] = {
    "data": "#3b4e63",
    "model": "#0f7a5c",
    "before": "#d2691e",
    "after": "#10528a",
    "reference": "#23282e",
    "warning": "#a2700a",
    "x": "#c2491d",
    "y": "#12805f",
    "z": "#1e62b0",
    "muted": "#98a2ad",
}
"""Colour of each role on white paper."""

DARK: Final[dict[Role, str]] = {
    "data": "#b4c3d3",
    "model": "#4fcaa6",
    "before": "#f0995c",
    "after": "#6fbcf2",
    "reference": "#dfe5ec",
    "warning": "#efbb4a",
    "x": "#f38d68",
    "y": "#58cfa8",
    "z": "#86b6f7",
    "muted": "#6b7783",
}
"""Colour of each role on a dark screen."""

_CHROME: Final = {"ink": (INK, "#e6ebf1"), "soft": (SOFT, "#9fabb8"), "grid": (GRID, "#303b47")}


def css_names() -> dict[str, str]:
    """CSS variable of each light colour, e.g. ``{"#10528a": "--role-after"}``."""
    names = {light: f"--{name}" for name, (light, _) in _CHROME.items()}
    return names | {colour: f"--role-{role}" for role, colour in LIGHT.items()}


def light_colour(name: str) -> str:
    """Colour on white paper by its name: ``ink``, ``soft``, ``grid`` or ``role-`` and a role."""
    return _LIGHT_BY_NAME[name]


def css_variable(name: str) -> str:
    """The same as a variable of a page, which follows its theme."""
    return f"var(--{name})"


_LIGHT_BY_NAME = {name.removeprefix("--"): colour for colour, name in css_names().items()}


def css_variables(*, dark: bool) -> str:
    """Declarations of all colours, for the light or the dark theme of a page."""
    chrome = {f"--{name}": pair[dark] for name, pair in _CHROME.items()}
    roles = {f"--role-{role}": colour for role, colour in (DARK if dark else LIGHT).items()}
    return " ".join(f"{name}: {colour};" for name, colour in (chrome | roles).items())
