"""The SVG of a figure, read as XML: what is drawn lies where the labels of its axes say."""

from __future__ import annotations

import datetime as dt
import re
from dataclasses import replace
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from numpy.typing import NDArray

from piga.reports.render.figure import Axis, Figure, Panel, Series, css_names
from piga.reports.render.scene import figure_scene, series_key, text_width
from piga.reports.render.static import figure_svg, write_figure

SVG = "{http://www.w3.org/2000/svg}"
NEAR = 0.1
"""Largest distance of a drawn point from its place [pt]."""
SUPERSCRIPT = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
MARKS = ("line", "points", "line+points", "bars", "steps", "band")

Array = NDArray[np.float64]


def one_panel(x: Array, y: Array, x_axis: Axis, y_axis: Axis, **more: object) -> Figure:
    return Figure("one", "One.", (Panel(x_axis, y_axis, (Series(x, y, name="curve", **more),)),))  # type: ignore[arg-type]


def read(figure: Figure) -> ET.Element:
    return ET.fromstring(figure_svg(figure))  # noqa: S314


def numbers(path: str) -> Array:
    """All points of a path, in order."""
    values = re.findall(r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?", re.sub(r"h0|Z", " ", path))
    return np.array(values, dtype=float).reshape(-1, 2)


def drawn(root: ET.Element, key: str, shape: int = -1) -> Array:
    """Points of a shape of a series: the curve or the dots come last."""
    group = next(node for node in root.iter(f"{SVG}g") if node.get("id") == key)
    return numbers(group.findall(f"{SVG}path")[shape].get("d") or "")


def value_of(word: str) -> float | None:
    """Number or date that a tick label states."""
    if re.fullmatch(r"\d{4}(-\d\d){1,2}( \d\d:\d\d)?", word):
        moment = dt.datetime.fromisoformat(word if word.count("-") == 2 else f"{word}-01")
        return moment.replace(tzinfo=dt.UTC).timestamp() / 86400.0
    parts = re.fullmatch(r"(?:(−?[\d\u202f.]+)(?:\u00a0×\u00a0)?)?(?:10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+))?", word)
    if not word or parts is None:
        return None
    size = float((parts[1] or "1").replace("−", "-").replace("\u202f", ""))
    return size * 10.0 ** float((parts[2] or "0").translate(SUPERSCRIPT))


def labels(root: ET.Element) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Position and value of every tick label of the x axis and of the y axis, of a figure with one panel."""
    x, y = [], []
    for node in root.iter(f"{SVG}text"):
        value = value_of(node.text or "")
        if value is not None and node.get("text-anchor") == "middle":
            x.append((float(node.get("x", "nan")), value))
        if value is not None and node.get("text-anchor") == "end":
            y.append((float(node.get("y", "nan")) - 0.36 * 8.0, value))
    return x, y


def placed(ticks: list[tuple[float, float]], values: Array, *, log: bool) -> Array:
    """Where values lie on an axis, by its first and its last label alone."""
    (p0, v0), (p1, v1) = ticks[0], ticks[-1]
    if log:
        v0, v1, values = np.log(v0), np.log(v1), np.log(values)
    return p0 + (values - v0) * (p1 - p0) / (v1 - v0)


AXES = {
    "plain": (Axis("time", "s"), Axis("angle", "arcsec"), np.linspace(0.0, 7.0, 60), 1.0, 0.0),
    "logarithmic": (
        Axis("time", "s", log=True), Axis("angle", "rad", log=True), np.logspace(-3.0, 6.0, 60), 1.0, 2.0,
    ),
    "less than a decade": (
        Axis("time", "s", log=True), Axis("angle", "rad", log=True), np.linspace(1.3, 4.1, 60), 1e-7, 1.5,
    ),
    "far from zero": (Axis("time", "s"), Axis("k", "1", log=True), np.linspace(100.0, 101.0, 60), 0.01, 3.0),
    "negative": (Axis("time", "s"), Axis("k", "1"), np.linspace(-1e5, -2e4, 60), 40.0, -1.0),
    "limits": (
        Axis("time", "s", limits=(-1.0, 9.0)), Axis("k", "1", limits=(-3.0, 3.0)), np.linspace(0.0, 7.0, 60), 1.0, 0.0,
    ),
    "degrees": (Axis("angle", "deg"), Axis("k", "1"), np.linspace(0.0, 360.0, 60), 1.0, 0.0),
    "dates": (Axis("date", "", dates=True), Axis("k", "1"), 19000.0 + np.linspace(0.0, 150.0, 60), 1.0, 0.0),
    "months": (Axis("date", "", dates=True), Axis("k", "1"), 19000.0 + np.linspace(0.0, 700.0, 60), 1.0, 0.0),
    "hours": (Axis("date", "", dates=True), Axis("k", "1"), 19000.0 + np.linspace(0.0, 1.5, 60), 1.0, 0.0),
}  # fmt: skip


@pytest.mark.parametrize("mark", ["line", "points", "line+points"])
@pytest.mark.parametrize("name", AXES)
def test_points_lie_where_the_labels_say(name: str, mark: str) -> None:
    """Two labels of each axis are read off the picture; every point of the data then has one place."""
    x_axis, y_axis, x, scale, lift = AXES[name]
    y = scale * (np.sin(np.arange(x.size)) + lift)
    root = read(one_panel(x, y, x_axis, y_axis, mark=mark))
    across, up = labels(root)
    assert min(len(across), len(up)) >= 2
    for ticks, axis in ((across, x_axis), (up, y_axis)):
        places, values = np.array(ticks).T
        assert placed(ticks, values, log=axis.log) == pytest.approx(places, abs=NEAR)
    expected = np.column_stack((placed(across, x, log=x_axis.log), placed(up, y, log=y_axis.log)))
    assert drawn(root, "one-p0-s0") == pytest.approx(expected, abs=NEAR)


@pytest.mark.parametrize(
    ("y", "unit", "label"),
    [
        (np.array([0.0, 4.2e-7]), "rad", "angle [10⁻⁹ rad]"),
        (np.array([-3e7, 8e8]), "1", "angle [10⁶]"),
        (np.array([1.5e-9, 9e-9]), "10⁻⁶/K", "angle [10⁻⁹ × 10⁻⁶/K]"),
        (np.array([4321.0, 4321.0 + 2e-5]), "m", "angle − 4321 m [10⁻⁶ m]"),
        (np.array([-4321.0, -4321.0 - 2e-5]), "", "angle + 4321 [10⁻⁶]"),
    ],
)
def test_what_labels_leave_out_is_named(y: Array, unit: str, label: str) -> None:
    """Powers of ten and a common origin of the tick labels stand in the label of the axis."""
    root = read(one_panel(np.array([0.0, 1.0]), y, Axis("time", "s"), Axis("angle", unit)))
    words = [node.text for node in root.iter(f"{SVG}text")]
    assert label in words, words
    power = re.search(r"\[10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)", label)
    assert power is not None
    origin = re.search(r"angle ([−+]) ([\d.]+)", label)
    zero = 0.0 if origin is None else float(origin[2]) * (1.0 if origin[1] == "−" else -1.0)
    seen = (y - zero) / 10.0 ** float(power[1].translate(SUPERSCRIPT))
    expected = placed(labels(root)[1], seen, log=False)
    assert drawn(root, "one-p0-s0")[:, 1] == pytest.approx(expected, abs=NEAR)


def test_bars_bands_steps_and_errors_have_their_own_places() -> None:
    x, y = np.array([1.0, 2.0, 4.0]), np.array([3.0, -1.0, 2.0])
    series = (
        Series(x, y, mark="bars"),
        Series(x, y, mark="band", upper=y + 1.0),
        Series(x, y, mark="steps"),
        Series(x, y, mark="points", error=np.array([0.5, 0.25, 1.0])),
    )
    root = read(Figure("four", "Four.", (Panel(Axis("time", "s"), Axis("angle", "rad"), series),)))
    across, up = labels(root)

    def at(places: list[tuple[float, float]]) -> Array:
        a, b = np.array(places).T
        return np.column_stack((placed(across, a, log=False), placed(up, b, log=False)))

    corners = [((a - 0.4, 0.0), (a - 0.4, b), (a + 0.4, b), (a + 0.4, 0.0)) for a, b in zip(x, y, strict=True)]
    assert drawn(root, "four-p0-s0") == pytest.approx(at([c for bar in corners for c in bar]), abs=NEAR)
    band = [*zip(x, y, strict=True), *zip(x[::-1], (y + 1.0)[::-1], strict=True)]
    assert drawn(root, "four-p0-s1") == pytest.approx(at(band), abs=NEAR)
    steps = [(1.0, 3.0), (1.5, 3.0), (1.5, -1.0), (3.0, -1.0), (3.0, 2.0), (4.0, 2.0)]
    assert drawn(root, "four-p0-s2") == pytest.approx(at(steps), abs=NEAR)
    assert drawn(root, "four-p0-s3") == pytest.approx(at(list(zip(x, y, strict=True))), abs=NEAR)
    ends = [(1.0, 2.5), (1.0, 3.5), (2.0, -1.25), (2.0, -0.75), (4.0, 1.0), (4.0, 3.0)]
    bars = drawn(root, "four-p0-s3", 0).reshape(3, 6, 2)[:, 2:4].reshape(-1, 2)
    assert bars == pytest.approx(at(ends), abs=NEAR)


def test_gaps_are_left_out_and_a_log_axis_has_no_place_below_zero() -> None:
    y = np.array([1.0, 2.0, np.nan, np.nan, 4.0, 5.0, -1.0, 7.0, 8.0, np.inf, -1.0])
    root = read(one_panel(np.arange(11.0), y, Axis("time", "s"), Axis("angle", "rad", log=True)))
    group = next(node for node in root.iter(f"{SVG}g") if node.get("id") == "one-p0-s0")
    (path,) = group
    assert (path.get("d") or "").count("M") == 3
    assert len(drawn(root, "one-p0-s0")) == 6
    axes = Axis("t", "s"), Axis("y", "1", log=True)
    ten = np.array([10.0, 10.0])
    low = read(one_panel(np.arange(2.0), np.array([-1.0, 1.0]), *axes, mark="band", upper=ten))
    up = labels(low)[1]
    floor = drawn(low, "one-p0-s0")[0, 1]
    assert floor > placed(up, np.array([1.0]), log=True)[0]


def hostile() -> Figure:
    names = (
        "</text><script>alert(1)</script>",
        "$\\frac{1}{0$ %s & \"'",
        "nul \x00 esc \x1b",
        "half \ud800",
        "日本語" * 20,
    )
    x = np.linspace(0.0, 1.0, 5)
    series = tuple(Series(x, x + i, name=name) for i, name in enumerate(names))
    axes = Axis("<b>time</b> " + "long " * 40, "]]>"), Axis("W" * 200, "&amp;")
    return Figure("bad", "<title>", (Panel(*axes, series, title="<!-- " + "title " * 60),) * 2, columns=2)


def test_labels_of_data_are_text_and_nothing_else() -> None:
    svg = figure_svg(hostile())
    svg.encode("utf-8")
    root = ET.fromstring(svg)  # noqa: S314
    known = {"svg", "title", "desc", "g", "path", "text", "clipPath", "rect"}
    assert {node.tag.removeprefix(SVG) for node in root.iter()} <= known
    words = "".join(node.text or "" for node in root.iter(f"{SVG}text"))
    assert "</text><script>alert(1)</script>" in words
    assert "$\\frac{1}{0$ %s & \"'" in words
    assert "nul \ufffd esc \ufffd" in words
    assert root.find(f"{SVG}title") is not None
    assert next(root.iter(f"{SVG}title")).text == "<title>"


def test_pictures_take_the_same_labels(tmp_path) -> None:  # type: ignore[no-untyped-def]
    figure = hostile()
    kept = tuple(replace(p, series=p.series[:2]) for p in figure.panels)
    assert write_figure(replace(figure, panels=kept), tmp_path / "a.png", dpi=40).stat().st_size > 1000


def every_figure() -> list[Figure]:
    rng = np.random.default_rng(1)
    figures = [hostile()]
    for columns, count in ((1, 1), (1, 3), (2, 4), (3, 3)):
        panels = []
        for index in range(count):
            x = np.sort(rng.uniform(0.0, 10.0 ** rng.integers(-8, 9), 20))
            y = rng.normal(10.0 ** rng.integers(-3, 7), 10.0 ** rng.integers(-4, 5), 20)
            series = tuple(
                Series(x, y, f"{mark} {index}", mark=mark, upper=y + 1.0 if mark == "band" else None)  # type: ignore[arg-type]
                for mark in MARKS
            )
            axes = Axis("averaging time", "s"), Axis("whitened residual of the rate", "arcsec/s")
            panels.append(Panel(*axes, series, title=f"Panel {index}"))
        figures.append(Figure("many", "Many.", tuple(panels), columns=columns, height=2.1))
    return figures


@pytest.mark.parametrize("figure", every_figure(), ids=lambda figure: f"{len(figure.panels)}-{figure.columns}")
def test_no_word_is_cut_off_and_none_lies_on_another(figure: Figure) -> None:
    """All words lie within the figure; tick labels of an axis and lines of text stand apart."""
    scene = figure_scene(figure, 518.4)
    boxes = []
    for word in scene.words:
        wide = text_width(word.text, word.size, bold=word.bold)
        left = -wide * {"start": 0.0, "middle": 0.5, "end": 1.0}[word.anchor]
        x0, x1, y0, y1 = left, left + wide, -0.75 * word.size, 0.2 * word.size
        if word.turned:
            x0, x1, y0, y1 = y0, y1, -x1, -x0
        boxes.append((word.x + x0, word.y + y0, word.x + x1, word.y + y1))
        assert boxes[-1][0] >= -0.5, word
        assert boxes[-1][1] >= -0.5, word
        assert boxes[-1][2] <= scene.width + 0.5, word
        assert boxes[-1][3] <= scene.height + 0.5, word
    for index, (a, one) in enumerate(zip(boxes, scene.words, strict=True)):
        for b, other in zip(boxes[:index], scene.words, strict=False):
            apart = a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]
            assert apart, (one, other)


@pytest.mark.parametrize("figure", every_figure(), ids=lambda figure: f"{len(figure.panels)}-{figure.columns}")
def test_every_series_and_every_unit_is_there_and_bytes_repeat(figure: Figure) -> None:
    svg = figure_svg(figure)
    assert svg == figure_svg(figure)
    root = ET.fromstring(svg)  # noqa: S314
    ids = [node.get("id") for node in root.iter() if node.get("id")]
    assert len(ids) == len(set(ids))
    assert all(str(name).startswith(f"{figure.key}-") for name in ids)
    for index, panel in enumerate(figure.panels):
        for order in range(len(panel.series)):
            assert drawn(root, series_key(figure, index, order)).size
    for target in re.findall(r"url\(#([^)]+)\)", svg) + (root.get("aria-labelledby") or "").split():
        assert target in ids
    words = " ".join(node.text or "" for node in root.iter(f"{SVG}text"))
    for unit, below in (
        ("s", 1 if figure.columns == 1 else len(figure.panels)),
        ("arcsec/s", len(figure.panels)),
    ):
        labelled = len(re.findall(rf"\[(10\S+ )?{unit}\]", words))
        assert labelled == (below if figure.key == "many" else 0), words


def test_colours_follow_the_theme_of_the_page_and_are_fixed_in_a_file(tmp_path) -> None:  # type: ignore[no-untyped-def]
    figure = every_figure()[1]
    svg, file = figure_svg(figure), write_figure(figure, tmp_path / "a.svg").read_text(encoding="utf-8")
    assert not [colour for colour in css_names() if colour in svg]
    assert "#" not in re.sub(r"url\(#", "", svg)
    assert "var(--role-data)" in svg
    assert "<style" not in svg
    assert "var(" not in file
    assert {colour for colour in css_names() if colour in file} >= {"#1c2733", "#56626f", "#dfe4ea", "#3b4e63"}


def test_equal_panels_have_one_scale() -> None:
    turn = np.linspace(0.0, 6.0, 40)
    axes = Axis("x", "m"), Axis("y", "m")
    curve = (Series(3.0 * np.cos(turn), np.sin(turn)),)
    fixed = Axis("x", "m", limits=(-4.0, 4.0)), Axis("y", "m", limits=(-2.0, 2.0))
    for x, y in (axes, fixed):
        scene = figure_scene(Figure("e", "E.", (Panel(x, y, curve, equal=True),)), 518.4)
        ((across, up),) = scene.scales
        unit = (across.end - across.start) / (across.high - across.low)
        assert (up.start - up.end) / (up.high - up.low) == pytest.approx(unit, rel=1e-12)
        assert 0.0 < up.end < up.start < scene.height
        assert across.low <= -3.0 < 3.0 <= across.high
        assert up.low <= -1.0 < 1.0 <= up.high
        if x.limits:
            assert (across.low, across.high, up.low, up.high) == (-4.0, 4.0, -2.0, 2.0)


def test_a_series_without_points_leaves_an_empty_frame(tmp_path) -> None:  # type: ignore[no-untyped-def]
    none = np.zeros(0)
    series = tuple(
        Series(none, none, mark, mark=mark, upper=none if mark == "band" else None) for mark in MARKS
    )  # type: ignore[arg-type]
    figure = Figure("none", "None.", (Panel(Axis("t", "s"), Axis("y", "1"), series),))
    root = read(figure)
    assert min(map(len, labels(root))) >= 2
    assert all(node.get("d") == "" for group in root.iter(f"{SVG}g") if group.get("id") for node in group)
    assert write_figure(figure, tmp_path / "a.png", dpi=40).stat().st_size > 500
