"""The page of the capstone: three gyro accelerometers on the platform."""

from __future__ import annotations

from piga.platform.runs.capstone import Capstone
from piga.reports.platform.capstone_figures import capstone_figure, force_day_figure, passage_figure
from piga.reports.platform.parts import page
from piga.reports.render.numbers import short
from piga.reports.render.page import Block, Column, FigureBlock, Page, Section, Table, Text, Tile


def capstone_page(found: Capstone) -> Page:
    """The page that tells what the locked zone does on the platform and what recovers it."""
    raw, solved = found.outcomes["raw tripod"], found.outcomes["triad"]
    skewed = found.outcomes["raw skewed"]
    tiles = (
        Tile("raw output", short(raw.position), "m", "largest horizontal error, axes at right angles", "bad"),
        Tile("skewed mounting", short(skewed.position), "m", "raw output, axes near the pole", "doubtful"),
        Tile("triad solved", short(solved.position), "m", "effective axes, per sample", "good"),
    )
    story = (
        "The platform stands still in inertial space and the Earth turns under it. Each input "
        "axis crosses the horizontal twice "
        "a sidereal day and is inside its locked zone for "
        f"{short(float(raw.locked_per_day.max()))} s a day. {_passage_words(found)} "
        f"Read as alpha'/K, the three instruments put the navigator {short(raw.position)} m off.\n\n"
        "Mounted within the latitude of the pole the axes never come to the horizontal: "
        f"{short(skewed.position)} m, with "
        f"{short(skewed.noise_gain)} times the noise. Solved together with their effective axes "
        "the three instruments give the force "
        f"back in any mounting: {short(solved.position)} m, against "
        f"{short(found.outcomes['ideal'].position)} m with ideal ones."
    )
    passage = passage_figure(found)
    day: tuple[Block, ...] = (FigureBlock(force_day_figure(found)),)
    if passage is not None:
        day = (*day, FigureBlock(passage))
    sections = (
        Section(
            "What happens",
            "story",
            (Text(story, lead=True), FigureBlock(capstone_figure(found)), _capstone_table(found)),
        ),
        Section("Why", "why", day),
    )
    return page("Gyro accelerometers on the space-stable platform", found.scenario, tiles, sections)


def _passage_words(found: Capstone) -> str:
    p = found.passage
    if p is None:
        return "No instrument passes its locked zone here."
    return (
        f"A passage is too short to lock, which takes {short(p.lock_time / 60.0)} min; but about "
        "it the gimbal turns so slowly that "
        f"its cross-coupling does not average out: each passage leaves up to {short(p.velocity_error)} m/s."
    )


def _capstone_table(found: Capstone) -> Table:
    columns = (
        Column("reading", align="text"),
        Column("position error", "m"),
        Column("velocity error", "mm/s"),
        Column("locked", "s/day"),
        Column("noise gain"),
        Column("what it is", align="text"),
    )
    rows = tuple(
        (
            name,
            short(o.position),
            short(1e3 * o.velocity),
            short(float(o.locked_per_day.max())),
            short(o.noise_gain),
            o.reading.sentence,
        )
        for name, o in found.outcomes.items()
    )
    return Table(
        columns,
        rows,
        notes=("Locked: longest of the three. Noise gain: against three axes at right angles.",),
    )
