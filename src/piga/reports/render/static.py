"""Figures on paper: SVG for pages and files, PNG and PDF for print. Same input, same bytes."""

from __future__ import annotations

import html
import re
from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from piga.errors import ArgumentError, PigaError
from piga.reports.render.figure import Figure, css_variable, light_colour
from piga.reports.render.scene import POINT, Box, Scene, SceneGroup, Shape, Words, figure_scene

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.transforms import Transform

WIDTH = 7.2
"""Width of a figure [inch]: two columns of a journal."""
DASH = (4.0, 2.0)
"""Stroke and space of a dashed line, in widths of the line."""
_FONTS = "'DejaVu Sans', Verdana, 'Segoe UI', Helvetica, Arial, sans-serif"

Colours = Callable[[str], str]


def figure_svg(figure: Figure, *, width: float = WIDTH) -> str:
    """The figure as an SVG element, ``width`` [inch], for a page: text stays text, colours follow its theme."""
    return _svg(figure, figure_scene(figure, width / POINT), css_variable, "")


def picture_svg(figure: Figure) -> str:
    """The figure as an SVG element on white paper, for a notebook."""
    return _svg(figure, figure_scene(figure, WIDTH / POINT), light_colour, f' font-family="{_FONTS}"')


def write_figure(figure: Figure, path: Path, *, width: float = WIDTH, dpi: int = 300) -> Path:
    """Write the figure as ``.svg``, ``.pdf`` or ``.png``; the last two need Matplotlib.

    ``width`` [inch]; ``dpi`` counts for ``.png``. Text stays text in ``.svg`` and ``.pdf``.

    Raises
    ------
    ArgumentError
        If the file name ends otherwise.
    PigaError
        If Matplotlib is needed and not installed.
    """
    kind = path.suffix.lower().removeprefix(".")
    scene = figure_scene(figure, width / POINT)
    if kind == "svg":
        size = f' width="{_number(scene.width)}pt" height="{_number(scene.height)}pt" font-family="{_FONTS}"'
        path.write_bytes((_svg(figure, scene, light_colour, size) + "\n").encode("utf-8"))
    elif kind in _NO_METADATA:
        _save(scene, path, kind, dpi)
    else:
        raise ArgumentError(
            f"{path}: figures are written as .svg, .pdf or .png", remedy="choose one of these endings"
        )
    return path


# -- SVG -----------------------------------------------------------------------------------------------


def _svg(figure: Figure, scene: Scene, colours: Colours, size: str) -> str:
    """``size``: attributes of a file of its own, which has white paper."""
    box = f"0 0 {_number(scene.width)} {_number(scene.height)}"
    names = f"{figure.key}-title {figure.key}-desc"
    clips = list(dict.fromkeys(group.clip for group in scene.groups if group.clip is not None))
    look = f'viewBox="{box}"{size} stroke-linejoin="round" role="img" aria-labelledby="{names}"'
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {look}>',
        f'<title id="{figure.key}-title">{_text(figure.title)}</title>',
        f'<desc id="{figure.key}-desc">{_text(description(figure))}</desc>',
        '<rect width="100%" height="100%" fill="#ffffff"/>' if size else "",
        *(_clip_svg(figure, number, clip) for number, clip in enumerate(clips)),
        *(_group_svg(figure, group, clips, colours) for group in scene.groups),
        f'<g style="fill:{colours("ink")}">{"".join(map(_words_svg, scene.words))}</g>',
        "</svg>",
    ]
    return ("\n" if size else "").join(filter(None, parts))


def description(figure: Figure) -> str:
    """What is drawn, in words: of each panel its axes and the names of its series."""
    parts = []
    for panel in figure.panels:
        names = list(dict.fromkeys(series.name for series in panel.series if series.name))
        axes = f"{panel.y.label} against {panel.x.label}"
        parts.append(
            (f"{panel.title}: " if panel.title else "") + axes + (f": {', '.join(names)}" if names else "")
        )
    return ". ".join([*parts, ""]).strip()


def _clip_svg(figure: Figure, number: int, box: Box) -> str:
    place = f'x="{_number(box.left)}" y="{_number(box.top)}"'
    size = f'width="{_number(box.width)}" height="{_number(box.height)}"'
    return f'<clipPath id="{figure.key}-clip{number}"><rect {place} {size}/></clipPath>'


def _group_svg(figure: Figure, group: SceneGroup, clips: list[Box], colours: Colours) -> str:
    name = f' id="{group.key}"' if group.key else ""
    clip = "" if group.clip is None else f' clip-path="url(#{figure.key}-clip{clips.index(group.clip)})"'
    return f"<g{name}{clip}>{''.join(_shape_svg(shape, colours) for shape in group.shapes)}</g>"


def _shape_svg(shape: Shape, colours: Colours) -> str:
    colour = colours(shape.colour)
    if shape.kind == "area":
        opacity = "" if shape.opacity == 1.0 else f' fill-opacity="{_number(shape.opacity)}"'
        return f'<path d="{"".join(_line(p) + "Z" for p in shape.paths)}"{opacity} style="fill:{colour}"/>'
    look = f'fill="none" stroke-width="{_number(shape.size)}" style="stroke:{colour}"'
    if shape.kind == "dots":
        # A dot is a line without length and with round ends: a few bytes each.
        spots = "".join(f"M{_pair(x, y)}h0" for path in shape.paths for x, y in path.tolist())
        return f'<path d="{spots}" stroke-linecap="round" {look}/>'
    dash = f' stroke-dasharray="{_number(DASH[0] * shape.size)} {_number(DASH[1] * shape.size)}"'
    return f'<path d="{"".join(map(_line, shape.paths))}" {look}{dash if shape.dashed else ""}/>'


def _line(path: np.ndarray) -> str:
    return "M" + "L".join(_pair(x, y) for x, y in path.tolist())


def _words_svg(words: Words) -> str:
    place = f'x="{_number(words.x)}" y="{_number(words.y)}"'
    if words.turned:
        place = f'transform="translate({_pair(words.x, words.y)}) rotate(-90)"'
    anchor = "" if words.anchor == "start" else f' text-anchor="{words.anchor}"'
    bold = ' font-weight="bold"' if words.bold else ""
    return f'<text {place} font-size="{_number(words.size)}"{anchor}{bold}>{_text(words.text)}</text>'


def _pair(x: float, y: float) -> str:
    return f"{_number(x)} {_number(y)}"


def _number(value: float) -> str:
    """A coordinate to a hundredth of a point."""
    return f"{round(value, 2) + 0.0:.12g}"


def _text(text: str) -> str:
    """Text that XML can hold: marked signs escaped, characters without a place in XML replaced."""
    return html.escape(_NOT_XML.sub("\ufffd", text), quote=False)


_NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


# -- PNG and PDF ---------------------------------------------------------------------------------------

_NO_METADATA: dict[str, dict[str, None]] = {
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    "png": {"Software": None},
}
_STYLE: dict[str, Any] = {
    "font.family": ["DejaVu Sans"],
    "text.usetex": False,
    "pdf.fonttype": 42,
    "savefig.bbox": "standard",
}


def _save(scene: Scene, path: Path, kind: str, dpi: int) -> None:
    """Let Matplotlib draw the shapes and words of the scene where they are."""
    try:
        import matplotlib as mpl
    except ImportError:
        message = "PNG and PDF figures need Matplotlib, which is not installed"
        raise PigaError(message, remedy="choose .svg, or install it with: pip install 'piga[report]'") from None
    from matplotlib.figure import Figure as Canvas
    from matplotlib.transforms import Affine2D, Bbox, TransformedBbox

    style: Any = _STYLE
    with mpl.rc_context(style):
        canvas = Canvas(figsize=(scene.width * POINT, scene.height * POINT), facecolor="white")
        place = (
            Affine2D().scale(1.0 / scene.width, -1.0 / scene.height).translate(0.0, 1.0) + canvas.transFigure
        )
        shapes = ((group.clip, shape) for group in scene.groups for shape in group.shapes if shape.paths)
        for order, (clip, shape) in enumerate(shapes):
            artist = canvas.add_artist(_artist(shape, place))
            artist.set_zorder(order)
            if clip is not None:
                artist.set_clip_box(TransformedBbox(Bbox.from_extents(*astuple(clip)), place))
        for words in scene.words:
            canvas.text(
                words.x,
                words.y,
                words.text,
                fontsize=words.size,
                color=light_colour("ink"),
                fontweight="bold" if words.bold else "normal",
                horizontalalignment=_ANCHORS[words.anchor],
                verticalalignment="baseline",
                rotation=90.0 if words.turned else 0.0,
                rotation_mode="anchor",
                parse_math=False,
                transform=place,
            )
        canvas.savefig(path, format=kind, dpi=dpi, metadata=_NO_METADATA[kind])


_ANCHORS = {"start": "left", "middle": "center", "end": "right"}


def _artist(shape: Shape, place: Transform) -> Artist:
    from matplotlib.lines import Line2D
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    colour = light_colour(shape.colour)
    if shape.kind == "dots":
        x, y = np.concatenate(shape.paths).T
        return Line2D(
            x,
            y,
            linestyle="",
            marker="o",
            markersize=shape.size,
            markeredgewidth=0.0,
            color=colour,
            transform=place,
        )
    area = shape.kind == "area"
    outline = Outline.make_compound_path(*(Outline(path, closed=False) for path in shape.paths))
    return PathPatch(
        outline,
        facecolor=colour if area else "none",
        edgecolor="none" if area else colour,
        alpha=shape.opacity,
        linewidth=0.0 if area else shape.size,
        linestyle=(0.0, DASH) if shape.dashed else "-",
        joinstyle="round",
        capstyle="butt",
        transform=place,
    )
