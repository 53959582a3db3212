"""Pages of the platform commands: simulate, align, identify, navigate, compare, and the capstone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from piga.reports.numbers import fixed, short
from piga.reports.page import Block, Cell, Column, FigureBlock, Notice, Page, Section, Table, Text, Tile
from piga.reports.platform_figures import (
    ARCMIN,
    capstone_figure,
    cone_figure,
    convergence_figure,
    force_day_figure,
    histories_figure,
    lines_figure,
    model_figure,
    passage_figure,
    position_figure,
    published_figure,
    readouts_figure,
    spectrum_figure,
)
from piga.stable_platform.alignment import Alignment
from piga.stable_platform.budget import BudgetRow, Scatter
from piga.stable_platform.capstone import Capstone
from piga.stable_platform.case_rotation import apparent_gyro, averaged_drift
from piga.stable_platform.chain import Comparison, Preparation
from piga.stable_platform.identification import Identification
from piga.stable_platform.observability import UNKNOWNS, Observability
from piga.stable_platform.scenario import Gyro, Scenario
from piga.stable_platform.simulate import Run
from piga.units import ARCSEC

_FOOTER = (
    "Simulated with the exact geometry of both nulled pick-offs; compensated with the small-angle matrices."
)


def simulation_page(run: Run) -> Page:
    """Page of ``piga platform simulate``."""
    s = run.scenario
    drift = abs(float(run.truth.eta[-1] - run.truth.eta[0]))
    tiles = (
        Tile("duration", short(s.duration / 86400.0), "d", f"{s.steps} steps of {short(s.step)} s"),
        Tile(
            "redundancy angle",
            short(np.degrees(run.truth.eta[-1])),
            "deg",
            f"grew by {short(np.degrees(drift))} deg",
        ),
        Tile("base", s.motion.kind, "", "motion of the vehicle"),
    )
    sections = (
        Section("What is read", "read", (FigureBlock(readouts_figure(run)),)),
        Section("What was put in", "truth", (_truth_table(s), _case_rotation_text(s))),
    )
    return _page("Platform simulation", s, tiles, sections)


def identification_page(
    run: Run, found: Identification, recursive: Identification | None, sources: Sequence[Observability]
) -> Page:
    """Page of ``piga platform identify``."""
    s = run.scenario
    m1, m2 = found["polar.misalignment"], found["equatorial.misalignment"]
    tiles = (
        Tile("polar misalignment", f"{m1.value / ARCMIN:.5f}", "arcmin", f"± {short(m1.std / ARCSEC)} arcsec"),
        Tile(
            "equatorial misalignment",
            f"{m2.value / ARCMIN:.5f}",
            "arcmin",
            f"± {short(m2.std / ARCSEC)} arcsec",
        ),
        Tile("condition", short(found.condition), "", " + ".join(found.sources)),
    )
    blocks: list[Block] = [_parameter_table(found, s)]
    blocks += [Notice("info", note) for note in found.notes]
    sections = [Section("Misalignments, phases and harmonics", "parameters", tuple(blocks))]
    if recursive is not None:
        sections.append(Section("Sample by sample", "recursive", (FigureBlock(convergence_figure(recursive)),)))
    sections.append(Section("What each source can tell", "observability", (_observability_table(sources),)))
    return _page("Platform identification", s, tiles, tuple(sections))


def alignment_page(run: Run, aligned: Alignment) -> Page:
    """Page of ``piga platform align``."""
    std = aligned.std / ARCSEC
    tiles = (
        Tile("triad attitude", short(float(std[:3].max())), "arcsec", "largest standard uncertainty of three"),
        Tile(
            "triad drift",
            short(float(np.degrees(aligned.std[3:6].max()) * 3600.0)),
            "deg/h",
            "largest standard uncertainty",
        ),
        Tile(
            "base heading",
            f"{np.degrees(aligned.base_angles[2]):.4f}",
            "deg",
            f"± {short(float(std[6:9].max()))} arcsec",
        ),
    )
    sections = (
        Section("Attitude and drift", "attitude", (_alignment_table(run, aligned),)),
        Section("How gravity tells it", "cone", (FigureBlock(cone_figure(run, aligned)),)),
    )
    return _page("Platform alignment", run.scenario, tiles, sections)


def navigation_page(comparison: Comparison) -> Page:
    """Page of ``piga platform navigate``."""
    tiles = tuple(
        Tile(_model_name(m), short(float(r.lines.position.max())), "m", "largest horizontal position error")
        for m, r in comparison.models.items()
    )
    sections = (
        Section(
            "Models over the run",
            "models",
            tuple(FigureBlock(model_figure(r)) for r in comparison.models.values()),
        ),
        Section("Position", "position", (FigureBlock(position_figure(comparison)),)),
        _preparation_section(comparison.run.scenario, comparison.preparation),
    )
    return _page("Platform navigation", comparison.run.scenario, tiles, sections)


def comparison_page(
    comparison: Comparison, budget: Sequence[BudgetRow] = (), scatter: Scatter | None = None
) -> Page:
    """Page of ``piga platform compare``."""
    s = comparison.run.scenario
    sections = [
        Section(
            "Lines at the case-rotation period",
            "lines",
            (
                Text(_lines_sentence(comparison), lead=True),
                FigureBlock(lines_figure(comparison)),
                _line_table(comparison, "east_velocity", "East velocity line", "mm/s", 1e3),
                _line_table(comparison, "heading", "Heading line", "arcmin", 1.0 / ARCMIN),
                _line_table(comparison, "roll", "Roll line", "arcmin", 1.0 / ARCMIN),
            ),
        ),
        Section(
            "Forty minutes and the whole run",
            "histories",
            (FigureBlock(published_figure(comparison)), FigureBlock(histories_figure(comparison))),
        ),
        Section(
            "Spectrum and position",
            "spectrum",
            (FigureBlock(spectrum_figure(comparison)), FigureBlock(position_figure(comparison))),
        ),
        _preparation_section(s, comparison.preparation),
    ]
    if budget:
        sections.append(Section("Error budget by source", "budget", (_budget_table(budget),)))
    if scatter is not None:
        sections.append(Section("Scatter over seeds", "scatter", (_scatter_table(scatter),)))
    return _page("Compensation models compared", s, _comparison_tiles(comparison), tuple(sections))


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
    return _page("Gyro accelerometers on the space-stable platform", found.scenario, tiles, sections)


def _page(title: str, s: Scenario, tiles: tuple[Tile, ...], sections: tuple[Section, ...]) -> Page:
    length = f"{s.duration / 86400.0:.4g} d at {s.step:g} s"
    where = f"{np.degrees(s.place.latitude):.3f} deg latitude, {length}, base {s.motion.kind}"
    return Page(title, where, tiles, sections, "piga platform", _FOOTER)


def _model_name(model: str) -> str:
    return "no model" if model == "none" else f"model {model}"


def _truth_table(s: Scenario) -> Table:
    rows = []
    for name, gyro, axes in (("polar", s.polar, "w1x, w1y"), ("equatorial", s.equatorial, "w2y, w2z")):
        rows.append((f"{name} misalignment", f"{gyro.misalignment / ARCMIN:.4f}", "arcmin"))
        rows.append((f"{name} phase", f"{np.degrees(gyro.phase):.3f}", "deg"))
        rows += [
            (
                f"{name} harmonic {h.order}",
                f"{h.amplitude / ARCMIN:.4f} at {np.degrees(h.phase):.1f} deg",
                "arcmin",
            )
            for h in gyro.harmonics
        ]
        rows.append((f"{name} drift {axes}", _pair(gyro.drift), "deg/h"))
        rows.append((f"{name} case-fixed drift", _pair(gyro.case_drift), "deg/h"))
    return Table((Column("quantity", align="text"), Column("value"), Column("unit", align="text")), tuple(rows))


def _pair(drift: tuple[float, float]) -> str:
    return ", ".join(f"{np.degrees(w) * 3600.0:.4g}" for w in drift)


def _case_rotation_text(s: Scenario) -> Text:
    at_rest = type(s.polar_rotation)(0.0)
    parts = []
    for name, gyro, rotation in (
        ("polar", s.polar, s.polar_rotation),
        ("equatorial", s.equatorial, s.equatorial_rotation),
    ):
        if any(gyro.case_drift):
            resting = averaged_drift(at_rest, gyro.case_drift, s.duration) / ARCMIN
            turning = averaged_drift(rotation, gyro.case_drift, s.duration) / ARCMIN
            parts.append(
                f"The case-fixed drift of the {name} gyro would turn its momentum by "
                f"{short(resting)} arcmin over the run with the "
                f"case at rest; with the case turning it stays within {short(turning)} arcmin."
            )
    return Text("\n\n".join(parts) or "No case-fixed drift was put in.")


def _parameter_table(found: Identification, s: Scenario) -> Table:
    truth = _truth_by_name(
        apparent_gyro(s.polar, s.polar_rotation), apparent_gyro(s.equatorial, s.equatorial_rotation)
    )
    rows = []
    for p in found.parameters:
        scale, unit = (ARCSEC, "arcsec") if p.unit == "rad" else (np.radians(1.0) / 3600.0, "deg/h")
        if p.name.endswith("phase"):
            scale, unit = np.radians(1.0), "deg"
        true = truth.get(p.name)
        difference = None if true is None else p.value - true
        if difference is not None and p.name.endswith("phase"):
            difference = float(np.remainder(difference + np.pi, 2.0 * np.pi) - np.pi)
        off = (
            "–"
            if difference is None
            else f"{difference / p.std:+.2f}"
            if p.std > 1e-11
            else f"{difference / scale:+.1e}"
        )
        rows.append((p.name.replace(".", " "), f"{p.value / scale:.5f}", f"{p.std / scale:.2g}", unit, off))
    columns = (
        Column("quantity", align="text"),
        Column("value"),
        Column("standard uncertainty"),
        Column("unit", align="text"),
        Column("off truth, in uncertainties"),
    )
    noise = ", ".join(f"{name} {_noise(name, level)}" for name, level in found.noise.items())
    return Table(
        columns,
        tuple(rows),
        notes=(f"Noise found in the residuals: {noise}. Truth includes the circle of case-fixed drift.",),
    )


def _noise(name: str, level: float) -> str:
    return f"{level:.2g} m/s^2" if name == "force" else f"{level / ARCSEC:.3g} arcsec"


def _truth_by_name(polar: Gyro, equatorial: Gyro) -> dict[str, float]:
    truth = {}
    for name, gyro in (("polar", polar), ("equatorial", equatorial)):
        truth[f"{name}.misalignment"], truth[f"{name}.phase"] = gyro.misalignment, gyro.phase
        for h in gyro.harmonics:
            truth[f"{name}.harmonic{h.order}.amplitude"] = h.amplitude
            truth[f"{name}.harmonic{h.order}.phase"] = h.phase
    return truth


def _observability_table(sources: Sequence[Observability]) -> Table:
    columns = (
        Column("source", align="text"),
        Column("condition"),
        *(Column(n, "arcsec") for n in UNKNOWNS),
        Column("verdict", align="text"),
    )
    rows: tuple[tuple[str | Cell, ...], ...] = tuple(
        (
            o.source,
            short(o.condition),
            *(short(float(v / ARCSEC)) if v < 1.0 else "–" for v in o.std),
            Cell(o.sentence, "good" if o.separable else "doubtful"),
        )
        for o in sources
    )
    return Table(
        columns,
        rows,
        notes=(
            "Uncertainties for white noise of one arc-second on every reading, at the redundancy angle found.",
        ),
    )


def _alignment_table(run: Run, aligned: Alignment) -> Table:
    from piga.frames import matrix_to_rotation_vector

    true = matrix_to_rotation_vector(run.truth.triad_start.T)
    rows: list[tuple[str | Cell, ...]] = []
    for k, axis in enumerate("xyz"):
        off = (aligned.triad_vector[k] - true[k]) / ARCSEC
        rows.append(
            (
                f"triad attitude {axis}",
                f"{aligned.triad_vector[k] / ARCSEC:.3f}",
                f"{aligned.std[k] / ARCSEC:.2g}",
                "arcsec",
                f"{off:+.3f}",
            )
        )
    for k, axis in enumerate("xyz"):
        scale = np.radians(1.0) / 3600.0
        rows.append(
            (
                f"triad drift {axis}",
                f"{aligned.drift[k] / scale:.2e}",
                f"{aligned.std[3 + k] / scale:.1e}",
                "deg/h",
                "–",
            )
        )
    for k, name in enumerate(("roll", "pitch", "heading")):
        rows.append((f"base {name}", fixed(float(np.degrees(aligned.base_angles[k])), 5), "–", "deg", "–"))
    columns = (
        Column("quantity", align="text"),
        Column("value"),
        Column("standard uncertainty"),
        Column("unit", align="text"),
        Column("off truth"),
    )
    return Table(
        columns,
        tuple(rows),
        notes=("Accelerometer bias is not seen: one micro-g across gravity tilts the result by 0.2 arcsec.",),
    )


def _preparation_section(s: Scenario, p: Preparation) -> Section:
    blocks: list[Block] = [Notice("info", note) for note in p.notes]
    if p.identification is not None:
        blocks.append(_parameter_table(p.identification, s))
    else:
        blocks.append(Text("The true misalignments were used."))
    return Section("What the models were given", "given", tuple(blocks))


def _comparison_tiles(c: Comparison) -> tuple[Tile, ...]:
    return tuple(
        Tile(
            _model_name(m),
            short(1e3 * float(r.lines.amplitude["east_velocity"][-1])),
            "mm/s",
            f"east velocity line, day {int(r.lines.day[-1])}",
        )
        for m, r in c.models.items()
    )


def _lines_sentence(c: Comparison) -> str:
    day = int(next(iter(c.models.values())).lines.day[-1])
    if "A" not in c.models:
        return f"Amplitudes at the case-rotation period, fitted over each of {day} days."
    left = float(c.models["A"].lines.amplitude["east_velocity"][-1])
    parts = [f"On day {day} model A leaves an east velocity line of {short(1e3 * left)} mm/s."]
    for m in ("B", "C"):
        if m in c.models:
            share = 1.0 - float(c.models[m].lines.amplitude["east_velocity"][-1]) / left
            parts.append(f"Model {m} removes {100.0 * share:.1f} % of it.")
    theory = c.models["A"].theory
    if theory is not None:
        ratio = left / float(theory.amplitude["east_velocity"][-1])
        parts.append(
            f"The closed form gives model A {100.0 * (ratio - 1.0):+.2f} % of what was navigated.".replace(
                "gives model A", "misses model A by"
            )
        )
    return " ".join(parts)


def _line_table(c: Comparison, channel: str, heading: str, unit: str, scale: float) -> Table:
    """One channel day by day: every model, and the theory of model A beside it."""
    columns, values = [Column("day", align="text")], []
    for m, r in c.models.items():
        columns.append(Column(_model_name(m), unit))
        values.append(r.lines.amplitude[channel] * scale)
        if r.theory is not None and m == "A":
            columns.append(Column("theory of A", unit))
            values.append(r.theory.amplitude[channel] * scale)
    days = next(iter(c.models.values())).lines.day
    rows = tuple((str(int(day)), *(short(float(v[k])) for v in values)) for k, day in enumerate(days))
    return Table(tuple(columns), rows, caption=heading)


def _budget_table(budget: Sequence[BudgetRow]) -> Table:
    columns = (
        Column("source", align="text"),
        Column("position, linear", "m"),
        Column("position, full run", "m"),
        Column("velocity, linear", "mm/s"),
        Column("velocity, full run", "mm/s"),
        Column("largest difference", "m"),
    )
    rows = tuple(
        (
            b.source,
            short(b.position_linear),
            short(b.position_full),
            short(1e3 * b.velocity_linear),
            short(1e3 * b.velocity_full),
            short(b.difference),
        )
        for b in budget
    )
    return Table(
        columns,
        rows,
        notes=("Largest horizontal error over the run: linear model against a run with the error put in.",),
    )


def _scatter_table(scatter: Scatter) -> Table:
    columns = (
        Column("model", align="text"),
        Column("position, median", "m"),
        Column("position, largest", "m"),
        Column("east line, mean", "mm/s"),
        Column("east line, scatter", "mm/s"),
    )
    rows = tuple(
        (
            _model_name(m),
            short(float(np.median(p))),
            short(float(p.max())),
            short(1e3 * float(scatter.east_line[m].mean())),
            short(1e3 * float(scatter.east_line[m].std())),
        )
        for m, p in scatter.position.items()
    )
    return Table(
        columns,
        rows,
        notes=(
            f"{len(scatter.seeds)} runs of the whole chain, seeds {scatter.seeds[0]} to {scatter.seeds[-1]}.",
        ),
    )


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
