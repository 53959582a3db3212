"""Pages of ``piga platform``: simulate, align, identify, navigate and compare."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from piga.platform.alignment import Alignment
from piga.platform.analysis import case_rates
from piga.platform.chain import BudgetRow, LineRow, ModelComparisonRun, Preparation, last_east_lines
from piga.platform.geometry import apparent_gyro, averaged_drift, wrapped
from piga.platform.identify import (
    UNKNOWN_PHASE,
    UNKNOWNS,
    GrowingIdentification,
    Identification,
    Observability,
    Parameter,
)
from piga.platform.scenario import Gyro, Model, PlatformScenario
from piga.platform.simulate import PlatformRun
from piga.reports.platform.figures import (
    WITH_THEORY,
    Case,
    cone_figure,
    convergence_figure,
    histories_figure,
    lines_figure,
    model_name,
    position_figure,
    published_figure,
    readouts_figure,
    spectrum_figure,
)
from piga.reports.render.numbers import fixed, short
from piga.reports.render.page import Cell, Content, Notice, Page, Section, Table, TableOf, Text, Tile
from piga.units import ARCMIN, ARCSEC, DAY

_FOOTER = (
    "Simulated with the exact geometry of both nulled pick-offs; compensated with the small-angle matrices."
)


def page(title: str, s: PlatformScenario, tiles: tuple[Tile, ...], sections: tuple[Section, ...]) -> Page:
    """A page with the run in its subtitle."""
    length = f"{s.duration / DAY:.4g} d at {s.step:g} s"
    where = f"{np.degrees(s.place.latitude):.3f} deg latitude, {length}, base {s.motion.kind}"
    return Page(title, where, tiles, sections, "piga platform", _FOOTER)


def _parameter_table(identification: Identification, s: PlatformScenario) -> Table:
    truth = _truth_by_name(
        apparent_gyro(s.polar, s.polar_rotation), apparent_gyro(s.equatorial, s.equatorial_rotation)
    )
    rows = [_parameter_row(p, truth.get(p.name)) for p in identification.parameters]
    noise = ", ".join(
        f"force {level:.2g} m/s^2" if name == "force" else f"{name} {level / ARCSEC:.3g} arcsec"
        for name, level in identification.noise.items()
    )
    note = f"Noise found in the residuals: {noise}. Truth includes the circle of case-fixed drift."
    return _quantities(rows, "off truth, in uncertainties", note)


def _quantities(rows: Iterable[tuple[str, ...]], off: str, note: str) -> Table:
    """Quantities with value, standard uncertainty, unit, and how far they are ``off`` the truth."""
    table = TableOf(rows).text("quantity", lambda row: row[0]).number("value", lambda row: row[1])
    table.number("standard uncertainty", lambda row: row[2]).text("unit", lambda row: row[3])
    return table.number(off, lambda row: row[4]).table(notes=(note,))


def _parameter_row(p: Parameter, true: float | None) -> tuple[str, ...]:
    phase = p.name.endswith("phase")
    scale, unit = (ARCSEC, "arcsec") if p.unit == "rad" else (np.radians(1.0) / 3600.0, "deg/h")
    scale, unit = (np.radians(1.0), "deg") if phase else (scale, unit)
    name = p.name.replace(".", " ").replace("harmonic", "harmonic ")
    if phase and p.std > 0.25 * UNKNOWN_PHASE:
        return name, "not determined", "–", unit, "–"
    off = "–"
    if true is not None:
        difference = p.value - true
        difference = float(wrapped(difference)) if phase else difference
        off = f"{difference / p.std:+.2f}" if p.std > 1e-11 else f"{difference / scale:+.1e}"
    return name, f"{p.value / scale:.5f}", f"{p.std / scale:.2g}", unit, off


def _truth_by_name(polar: Gyro, equatorial: Gyro) -> dict[str, float]:
    truth = {}
    for name, gyro in (("polar", polar), ("equatorial", equatorial)):
        truth[f"{name}.misalignment"], truth[f"{name}.phase"] = gyro.misalignment, gyro.phase
        for h in gyro.harmonics:
            truth[f"{name}.harmonic{h.order}.amplitude"] = h.amplitude
            truth[f"{name}.harmonic{h.order}.phase"] = h.phase
    return truth


def simulation_page(run: PlatformRun) -> Page:
    """Page of ``piga platform simulate``."""
    s = run.scenario
    drift = abs(float(run.truth.eta[-1] - run.truth.eta[0]))
    tiles = (
        Tile("duration", short(s.duration / DAY), "d", f"{s.steps} steps of {short(s.step)} s"),
        Tile(
            "redundancy angle",
            short(np.degrees(run.truth.eta[-1])),
            "deg",
            f"grew by {short(np.degrees(drift))} deg",
        ),
        Tile("base", s.motion.kind, "", "motion of the vehicle"),
    )
    sections = (
        Section("What is read", "read", (partial(readouts_figure, run),)),
        Section("What was put in", "truth", (_truth_table(s), _case_rotation_text(s))),
    )
    return page("Platform simulation", s, tiles, sections)


def identification_page(
    run: PlatformRun, growing: GrowingIdentification, sources: Sequence[Observability]
) -> Page:
    """Page of ``piga platform identify``."""
    s, identification = run.scenario, growing.parts[-1]
    tiles = []
    for gyro in ("polar", "equatorial"):
        m = identification[f"{gyro}.misalignment"]
        spread = f"± {short(m.std / ARCSEC)} arcsec"
        tiles.append(Tile(f"{gyro} misalignment", f"{m.value / ARCMIN:.5f}", "arcmin", spread))
    tiles.append(Tile("condition", short(identification.condition), "", " + ".join(identification.sources)))
    notes = (Notice("info", note) for note in identification.notes)
    found: tuple[Content, ...] = (_parameter_table(identification, s), *notes)
    sections = (
        Section("Misalignments, phases and harmonics", "parameters", found),
        Section("As the record grows", "growing", (partial(convergence_figure, growing),)),
        Section("What each source can tell", "observability", (_observability_table(sources),)),
    )
    return page("Platform identification", s, tuple(tiles), sections)


def alignment_page(run: PlatformRun, aligned: Alignment) -> Page:
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
            f"± {short(float(aligned.base_stds[2] / ARCSEC))} arcsec",
        ),
    )
    note = "Accelerometer bias is not seen: one micro-g across gravity tilts the result by 0.2 arcsec."
    table = _quantities(_alignment_rows(run, aligned), "off truth", note)
    sections = (
        Section("Attitude and drift", "attitude", (table,)),
        Section("How gravity tells it", "cone", (partial(cone_figure, run, aligned),)),
    )
    return page("Platform alignment", run.scenario, tiles, sections)


def _truth_table(s: PlatformScenario) -> Table:
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
    table = TableOf(rows).text("quantity", lambda row: row[0]).number("value", lambda row: row[1])
    return table.text("unit", lambda row: row[2]).table()


def _pair(drift: tuple[float, float]) -> str:
    return ", ".join(f"{np.degrees(w) * 3600.0:.4g}" for w in drift)


def _case_rotation_text(s: PlatformScenario) -> Text:
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
                f"The case-fixed drift of the {name} gyro would turn its momentum by {short(resting)} arcmin over the "
                f"run with the case at rest; with the case turning it stays within {short(turning)} arcmin."
            )
    return Text("\n\n".join(parts) or "No case-fixed drift was put in.")


def _observability_table(sources: Sequence[Observability]) -> Table:
    table = TableOf(sources).text("source", lambda o: o.source)
    table.number("condition", lambda o: short(o.condition))
    table.across(
        range(len(UNKNOWNS)),
        lambda k: UNKNOWNS[k],
        lambda o, k: short(float(o.std[k] / ARCSEC)) if o.std[k] < 1.0 else "–",
        lambda _: "arcsec",
    )
    table.text("verdict", lambda o: Cell(o.sentence, "good" if o.separable else "doubtful"))
    return table.table(
        notes=(
            "u and v are m cos(phase) and m sin(phase).",
            "Uncertainties for white noise of one arc-second on every reading, at the redundancy angle found.",
            "On the specific force that is 48 µm/s², one arc-second of its direction.",
        )
    )


def _alignment_rows(run: PlatformRun, aligned: Alignment) -> Iterator[tuple[str, ...]]:
    from piga.frames import matrix_to_rotation_vector

    true, motion = matrix_to_rotation_vector(run.truth.triad_start.T), run.scenario.motion
    for k, axis in enumerate("xyz"):
        value, std = aligned.triad_vector[k] / ARCSEC, aligned.std[k] / ARCSEC
        off = (aligned.triad_vector[k] - true[k]) / ARCSEC
        yield f"triad attitude {axis}", f"{value:.3f}", f"{std:.2g}", "arcsec", f"{off:+.3f}"
    degree_per_hour = np.radians(1.0) / 3600.0
    for k, axis in enumerate("xyz"):
        value, std = aligned.drift[k] / degree_per_hour, aligned.std[3 + k] / degree_per_hour
        yield f"triad drift {axis}", f"{value:.2e}", f"{std:.1e}", "deg/h", "–"
    put_in = {"roll": motion.roll, "pitch": motion.pitch, "heading": motion.heading}
    for k, (name, angle) in enumerate(put_in.items()):
        value, std = float(np.degrees(aligned.base_angles[k])), np.degrees(aligned.base_stds[k])
        off = float(np.remainder(value - np.degrees(angle) + 180.0, 360.0) - 180.0)
        yield f"base {name}", fixed(value, 5), f"{std:.1e}", "deg", f"{off:+.1e}"


def navigation_page(comparison: ModelComparisonRun) -> Page:
    """Page of ``piga platform navigate``."""
    tiles = tuple(
        Tile(model_name(m), short(float(r.lines.position.max())), "m", "largest horizontal position error")
        for m, r in comparison.models.items()
    )
    whole = comparison_page(comparison).only("histories", "spectrum", "notes", "given")
    return replace(whole, title="Platform navigation", tiles=tiles)


def comparison_page(
    comparison: ModelComparisonRun, budget: Sequence[BudgetRow] = (), lines: Sequence[LineRow] = ()
) -> Page:
    """Page of ``piga platform compare``."""
    s = comparison.run.scenario
    histories = (partial(published_figure, comparison), partial(histories_figure, comparison))
    whole = (partial(spectrum_figure, comparison), partial(position_figure, comparison))
    sections = [
        *_line_sections(comparison),
        Section("Forty minutes and the whole run", "histories", histories),
        Section("Spectrum and position", "spectrum", whole),
        *_preparation_section(s, comparison.preparation),
    ]
    if budget:
        tables = (_budget_table(budget), *((_line_budget_table(lines),) if lines else ()))
        sections.append(Section("Error budget by source", "budget", tables))
    return page("Compensation models compared", s, _comparison_tiles(comparison), tuple(sections))


def _line_sections(c: ModelComparisonRun) -> list[Section]:
    """Lines at the polar case's rate and, at another speed, at the equatorial one's."""
    if not _unequal(c):
        return [Section("Lines at the case-rotation period", "lines", _line_content(c, "amplitude"))]
    periods = [2.0 * np.pi / rate if rate > 0.0 else np.inf for rate in case_rates(c.run.scenario)]
    titles = [
        f"Lines of the {gyro} gyro's case, period {short(period)} s"
        for gyro, period in zip(("polar", "equatorial"), periods, strict=True)
    ]
    return [
        Section(titles[0], "lines", _line_content(c, "amplitude")),
        Section(titles[1], "equatorial-lines", _line_content(c, "equatorial")),
    ]


def _unequal(c: ModelComparisonRun) -> bool:
    return any(r.lines.equatorial for r in c.models.values())


def _line_content(c: ModelComparisonRun, which: Case) -> tuple[Content, ...]:
    tables = (
        _line_table(c, which, "east_velocity", "East velocity line", "mm/s", 1e3),
        _line_table(c, which, "north_velocity", "North velocity line", "mm/s", 1e3),
        _line_table(c, which, "heading", "Heading line", "arcmin", 1.0 / ARCMIN),
        _line_table(c, which, "roll", "Roll line", "arcmin", 1.0 / ARCMIN),
    )
    figure = partial(lines_figure, c, which) if _days(c) > 1 else None
    return (_lines_sentence(c, which), figure, *tables)


def _preparation_section(s: PlatformScenario, p: Preparation) -> tuple[Section, ...]:
    notes = tuple(Notice("info", f"note: {note}") for note in p.notes)
    known = Text("The true misalignments were used.")
    table = known if p.identification is None else _parameter_table(p.identification, s)
    given = Section("What the models were given", "given", (table,))
    return (Section("Notes", "notes", notes), given) if notes else (given,)


def _comparison_tiles(c: ModelComparisonRun) -> tuple[Tile, ...]:
    whose = " (polar, equatorial case)" if _unequal(c) else ""
    return tuple(
        Tile(
            model_name(m),
            ", ".join(short(1e3 * line) for line in last_east_lines(r.lines)),
            "mm/s",
            f"east velocity line{whose}, day {int(r.lines.day[-1])}",
        )
        for m, r in c.models.items()
    )


def _days(c: ModelComparisonRun) -> int:
    return int(next(iter(c.models.values())).lines.day[-1])


def _lines_sentence(c: ModelComparisonRun, which: Case) -> str:
    day = _days(c)
    shown: Model = next((m for m in WITH_THEORY[which] if m in c.models), "none")
    east = {m: float(getattr(r.lines, which)["east_velocity"][-1]) for m, r in c.models.items()}
    left = east.get(shown, np.nan)
    if not np.isfinite(left):
        return f"Amplitudes at the case-rotation period, fitted over each of {day} days."
    whose = "no model leaves" if shown == "none" else f"model {shown} leaves"
    parts = [f"On day {day} {whose} an east velocity line of {short(1e3 * left)} mm/s."]
    removed = {m: 100.0 * (1.0 - line / left) for m, line in east.items() if m not in ("none", shown)}
    parts += [f"Model {m} removes {share:.1f} % of it." for m, share in removed.items()]
    theory = c.models[shown].theory
    if theory is not None:
        ratio = float(getattr(theory, which)["east_velocity"][-1]) / left
        name = "no model" if shown == "none" else f"model {shown}"
        parts.append(f"The closed form for {name} is {100.0 * (ratio - 1.0):+.2f} % off what was navigated.")
    return " ".join(parts)


def _line_table(
    c: ModelComparisonRun, which: Case, channel: str, heading: str, unit: str, scale: float
) -> Table:
    """One channel day by day: every model, and the theory beside those that have it."""
    curves = []
    for m, r in c.models.items():
        curves.append((model_name(m), getattr(r.lines, which)[channel] * scale))
        if r.theory is not None and m in WITH_THEORY[which]:
            curves.append((f"theory, {model_name(m)}", getattr(r.theory, which)[channel] * scale))
    days = next(iter(c.models.values())).lines.day
    table = TableOf(range(len(days))).text("day", lambda k: str(int(days[k])))
    table.across(curves, lambda curve: curve[0], lambda k, curve: short(float(curve[1][k])), lambda _: unit)
    return table.table(heading)


def _budget_table(budget: Sequence[BudgetRow]) -> Table:
    return (
        TableOf(budget)
        .text("source", lambda b: b.source)
        .number("position, linear", lambda b: short(b.position_linear_m), "m")
        .number("position, full run", lambda b: short(b.position_full_m), "m")
        .number("velocity, linear", lambda b: short(1e3 * b.velocity_linear_m_s), "mm/s")
        .number("velocity, full run", lambda b: short(1e3 * b.velocity_full_m_s), "mm/s")
        .number("largest difference", lambda b: short(b.largest_difference_m), "m")
        .table(
            notes=("Largest horizontal error over the run: linear model against a run with the error put in.",)
        )
    )


def _line_budget_table(budget: Sequence[LineRow]) -> Table:
    """Lines of each misalignment alone: closed form and full run."""
    shown = (("east_velocity", "mm/s", 1e3), ("north_velocity", "mm/s", 1e3), ("heading", "arcsec", 1.0 / ARCSEC),
             ("roll", "arcsec", 1.0 / ARCSEC))  # fmt: skip
    table = TableOf(budget).text("source", lambda b: b.source).number("period", lambda b: f"{b.period:g}", "s")
    columns = [(*one, how) for one in shown for how in ("linear", "full run")]
    table.across(
        columns,
        lambda one: f"{one[0].replace('_', ' ')}, {one[3]}",
        lambda b, one: short(one[2] * (b.theory if one[3] == "linear" else b.full)[one[0]]),
        lambda one: one[1],
    )
    return table.table(
        "Lines at the case-rotation periods by misalignment",
        ("Last day; the misalignment is wrong by its standard uncertainty (or one arc-second), base at rest.",),
    )
