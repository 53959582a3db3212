"""The page of a simulated test, its figures, and its summary for the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from piga._version import __version__
from piga.instrument import Instrument, dead_zone, mean_rate
from piga.instrument.twin.linear import analyse_loop, loop_poles, open_loop, step_response
from piga.instrument.twin.parameters import TwinParameters
from piga.records.terms import shown_unit
from piga.reports.render.decimate import thin
from piga.reports.render.figure import XYZ, Axis, Figure, Panel, Role, Series
from piga.reports.render.numbers import count, pretty_unit, printed, short, significant
from piga.reports.render.page import (
    Block,
    FigureBlock,
    Notice,
    Page,
    Section,
    Table,
    TableOf,
    Text,
    Tile,
    write_page,
)
from piga.stand.simulate import SimulatedTest
from piga.stand.write_run import TrueValue, coefficients, imperfection_values, predictions
from piga.units import ARCSEC, G0, MICRO_G

_POINTS = 801
_ROLES: tuple[Role, ...] = (*XYZ, "data")


def locking_figure(
    inst: Instrument,
    a_t: Sequence[float] = (5.0 * G0,),
    beta: Sequence[float] | None = None,
    *,
    reach: float = 2.0,
) -> Figure:
    """Mean output rate against specific force along the input axis, with its locked plateau.

    Parameters
    ----------
    inst:
        The instrument; its ``beta`` is used where ``beta`` is None.
    a_t:
        Transverse specific force of each curve [m/s^2].
    beta:
        Non-orthogonality of each curve [rad]; as many as ``a_t``, or one for all.
    reach:
        The axis extends this many half-widths of the widest dead zone to each side.

    Returns
    -------
    Figure
        One panel: mean rate and the ideal rate [deg/s] against ``a_x`` [mg].
    """
    angles = list(beta) if beta is not None else [inst.beta]
    curves = list(zip(a_t, angles * len(a_t) if len(angles) == 1 else angles, strict=True))
    instruments = [Instrument(inst.scale_factor, angle) for _, angle in curves]
    borders = [
        float(dead_zone(one, force, 0.0)[1]) for one, (force, _) in zip(instruments, curves, strict=True)
    ]
    limit = reach * (max(borders) or 1e-3 * G0)
    series = [_ideal(inst, limit)]
    for k, (one, (force, angle)) in enumerate(zip(instruments, curves, strict=True)):
        a_x = _spread(limit, borders[k])
        rate = np.degrees(mean_rate(one, a_x, force, 0.0))
        name = f"a_t = {force / G0:.3g} g, beta = {angle / ARCSEC:.4g} arcsec"
        series.append(Series(a_x / G0 * 1e3, rate, name, role=_ROLES[k % len(_ROLES)]))
    widest = max(borders) / G0 * 1e3
    panel = Panel(
        Axis("specific force along the input axis a_x", "mg"), Axis("mean output rate", "deg/s"), tuple(series)
    )
    return Figure(
        "locking",
        "Locking of the output rate by transverse specific force",
        (panel,),
        caption=(
            "Inside the dead zone |a_x| < a_t tan(beta) the gimbal comes to rest although there is specific "
            f"force along the input axis; the widest plateau reaches to {widest:.3g} mg. Outside, the mean "
            "rate is K sqrt(a_x^2 - a_t^2 tan^2(beta)) and approaches the ideal line from below."
        ),
        height=3.6,
    )


def _ideal(inst: Instrument, limit: float) -> Series:
    a_x = np.array([-limit, limit])
    return Series(
        a_x / G0 * 1e3, np.degrees(inst.scale_factor * a_x), "ideal: K a_x", role="reference", dashed=True
    )


def _spread(limit: float, border: float) -> NDArray[np.float64]:
    """Forces from ``-limit`` to ``limit``, dense where the rate leaves the plateau like a square root."""
    outside = border + (limit - border) * np.linspace(0.0, 1.0, _POINTS // 2) ** 2
    return np.concatenate((-outside[::-1], outside))


Array = NDArray[np.float64]


def simulation_figures(test: SimulatedTest) -> tuple[Figure, ...]:
    """All figures of a simulated test, in reading order."""
    figures = [stand_figure(test), output_figure(test)]
    if test.specimen.instrument.tan_beta:
        figures.append(lock_zone_figure(test))
    change = test.profile.force - test.profile.reference
    if np.any(change):
        figures.insert(1, imperfection_figure(test))
    if test.motion is not None:
        figures += [servo_figure(test), *loop_figures(test.specimen.design)]
    return tuple(figures)


def _time(test: SimulatedTest) -> tuple[Array, Axis]:
    """Time since the start, and its axis."""
    t = test.profile.t - test.profile.t[0]
    scale, unit = (3600.0, "h") if t[-1] > 3 * 3600.0 else (1.0, "s")
    return t / scale, Axis("time", unit)


def _components(t: Array, values: Array) -> tuple[Series, ...]:
    return tuple(Series(*thin(t, values[:, k]), f"{role.upper()}0", role=role) for k, role in enumerate(XYZ))


def stand_figure(test: SimulatedTest) -> Figure:
    """Specific force and base rate of the reference."""
    t, time = _time(test)
    force = Panel(
        time,
        Axis("specific force", "g"),
        _components(t, test.profile.reference / G0),
        "Specific force",
    )
    degrees = np.degrees(test.profile.reference_rate)
    rate = Panel(time, Axis("base rate", "deg/s"), _components(t, degrees), "Base rate")
    caption = (
        f"What the {test.stand.kind} does in base axes, as the lab's log states it; moves between segments "
        "are shown, but not recorded."
    )
    return Figure("stand", "The stand", (force, rate), caption, height=4.6)


def imperfection_figure(test: SimulatedTest) -> Figure:
    """Specific force that the instrument feels, less the reference."""
    t, time = _time(test)
    change = (test.profile.force - test.profile.reference) / MICRO_G
    panel = Panel(time, Axis("true less reference", "ug"), _components(t, change))
    caption = "What the imperfections change: the instrument feels it, the log does not show it."
    return Figure("imperfections", "Imperfections of the stand", (panel,), caption)


def lock_zone_figure(test: SimulatedTest) -> Figure:
    """Mean rate against specific force at the largest transverse force that is recorded."""
    across = np.hypot(*test.profile.force[test.profile.recorded, 1:].T)
    return locking_figure(test.specimen.instrument, (float(across.max()),))


def output_figure(test: SimulatedTest) -> Figure:
    """Output angle, and the indicated specific force less the true one."""
    t, time = _time(test)
    turns = Series(*thin(t, test.alpha / (2.0 * math.pi)), name="gimbal angle")
    p = test.profile
    error = test.rate / test.specimen.instrument.scale_factor - p.force[:, 0]
    recorded = np.where(p.recorded, error / MICRO_G, np.nan)
    indicated = Series(*thin(t, recorded), name="indicated less true", role="model")
    return Figure(
        "output",
        "The output",
        (
            Panel(time, Axis("gimbal angle", "rev"), (turns,), "Gimbal angle"),
            Panel(time, Axis("rate/K less a_x", "ug"), (indicated,), "Error of the uncoupled model"),
        ),
        "Revolutions of the outer gimbal, and what calibration has to explain: the rate over K less the true "
        "specific force along the input axis (recorded segments; base rate and all errors included).",
        height=4.6,
    )


def servo_figure(test: SimulatedTest) -> Figure:
    """Tilt from pick-off null and torque of the motor."""
    motion = test.motion
    if motion is None:
        raise ValueError("the quasi-steady model has no servo")
    t, time = _time(test)
    tilt = (motion.beta - test.specimen.design.pick_off_null) / ARCSEC
    panels = [
        Panel(time, Axis("tilt from null", "arcsec"), (Series(*thin(t, tilt), name="tilt"),), "Tilt"),
        Panel(
            time,
            Axis("motor torque", "mNm"),
            (Series(*thin(t, 1e3 * motion.torque), name="torque", role="model"),),
            "Torque motor",
        ),
    ]
    changes = motion.lock_changes()
    words = f" Lock is lost {sum(c == 'lost' for _, c in changes)} times." if changes else ""
    return Figure(
        "servo",
        "The servo",
        tuple(panels),
        "The gravity torque on the outer axis ripples the tilt once a revolution; the motor holds it." + words,
        height=4.6,
    )


def loop_figures(p: TwinParameters) -> tuple[Figure, ...]:
    """Bode diagram, step response and poles of the servo loop."""
    return bode_figure(p), step_figure(p), pole_figure(p)


def bode_figure(p: TwinParameters) -> Figure:
    """Open-loop gain and phase with the margins."""
    analysis = analyse_loop(p)
    hertz = np.geomspace(1e-2 * max(analysis.crossover, 1.0), 30.0 * p.nutation, 600) / (2.0 * math.pi)
    response = open_loop(p, 2.0 * math.pi * hertz)
    cross = np.full(2, analysis.crossover / (2.0 * math.pi))
    gain = 20.0 * np.log10(np.abs(response))
    phase = np.degrees(np.unwrap(np.angle(response)))
    across = Axis("frequency", "Hz", log=True, limits=(float(hertz[0]), float(hertz[-1])))
    panels = (
        Panel(
            across,
            Axis("gain", "dB"),
            (
                Series(hertz, gain, name="open loop"),
                Series(cross, [gain.min(), gain.max()], name="crossover", role="muted", dashed=True),
            ),
            "Gain",
        ),
        Panel(
            across,
            Axis("phase", "deg"),
            (
                Series(hertz, phase, name="open loop"),
                Series(hertz[[0, -1]], [-180.0, -180.0], name="-180 deg", role="warning", dashed=True),
            ),
            "Phase",
        ),
    )
    caption = (
        f"Crossover {analysis.crossover / (2 * math.pi):.3g} Hz, phase margin "
        f"{math.degrees(analysis.phase_margin):.3g} deg, gain margin {_margin(analysis.gain_margin)}, "
        f"nutation {analysis.nutation / (2 * math.pi):.3g} Hz."
    )
    return Figure("loop-bode", "Open servo loop", panels, caption, height=4.6)


def _margin(gain_margin: float) -> str:
    return f"{20.0 * math.log10(gain_margin):.3g} dB" if math.isfinite(gain_margin) else "unlimited"


def step_figure(p: TwinParameters) -> Figure:
    """Response of the output rate to a step of specific force."""
    slowest = -float(np.max(loop_poles(p).real))
    t = np.linspace(0.0, min(8.0 / slowest, 60.0 / p.nutation) if slowest > 0.0 else 30.0 / p.nutation, 800)
    response = Series(1e3 * t, step_response(p, t), name="rate/(K a)")
    final = Series([0.0, 1e3 * t[-1]], [1.0, 1.0], name="quasi-steady", role="muted", dashed=True)
    panel = Panel(Axis("time after the step", "ms"), Axis("rate/(K a_x)", "1"), (response, final))
    return Figure(
        "loop-step",
        "Step response",
        (panel,),
        "Output rate after a step of specific force along the input axis.",
    )


def pole_figure(p: TwinParameters) -> Figure:
    """Closed-loop poles in the complex plane."""
    poles = loop_poles(p)
    bound = 1.15 * float(np.max(np.abs(poles.imag), initial=0.2 * float(np.max(np.abs(poles)))))
    stable, other = poles[poles.real < 0.0], poles[poles.real >= 0.0]
    series = [Series(stable.real, stable.imag, name="stable pole", mark="points")]
    if other.size:
        series.append(Series(other.real, other.imag, name="unstable pole", mark="points", role="warning"))
    series.append(Series([0.0, 0.0], [-bound, bound], name="stability border", role="muted", dashed=True))
    panel = Panel(Axis("real part", "1/s"), Axis("imaginary part", "1/s"), tuple(series))
    caption = "All poles lie left of the border: the loop is stable."
    if other.size:
        caption = "A pole lies on or right of the border: the loop is unstable."
    return Figure("loop-poles", "Poles of the closed loop", (panel,), caption)


_MODELS = {"quasi-steady": "quasi-steady model", "twin": "servo twin"}


def write_simulation_report(test: SimulatedTest, serial: str, path: Path) -> None:
    """Write the page of a simulated test as one HTML file that opens offline."""
    write_page(simulation_page(test, serial), path)


def simulation_page(test: SimulatedTest, serial: str) -> Page:
    """The page of a simulated test."""
    figures = {figure.key: figure for figure in simulation_figures(test)}
    sections = [_stand_section(test, figures), _output_section(figures)]
    if test.motion is not None:
        sections += [_servo_section(test, figures), _design_section(test.specimen.design)]
    sections.append(_truth_section(test))
    duration = test.profile.segments[-1].stop - test.profile.segments[0].start
    return Page(
        title=f"Simulated test of {serial}",
        subtitle=f"{test.stand.kind}, {_MODELS[test.model]}, {short(duration)} s, seed {test.seed}.",
        tiles=_tiles(test),
        sections=tuple(sections),
        kicker="piga · simulated test",
        footer=f"Made by piga {__version__}. All data on this page are simulated.",
    )


def _tiles(test: SimulatedTest) -> tuple[Tile, ...]:
    e, log = test.electronics, test.log
    turns = (test.alpha[-1] - test.alpha[0]) / (2.0 * math.pi)
    tiles = [
        Tile(
            "Rows in the log",
            count(log.t.size),
            detail=f"{len(log.labels)} segments at {short(e.sample_rate)} Hz",
        ),
        Tile(
            "Output",
            e.kind,
            detail=f"{short(e.counts_per_revolution)} per revolution" if e.kind == "counts" else "",
        ),
        Tile("Net turn of the gimbal", short(float(turns)), "rev"),
    ]
    if test.motion is not None:
        analysis = analyse_loop(test.specimen.design)
        tiles.append(Tile("Nutation", short(analysis.nutation / (2.0 * math.pi)), "Hz"))
        tiles.append(
            Tile(
                "Phase margin",
                short(math.degrees(analysis.phase_margin)),
                "°",
                f"crossover {short(analysis.crossover / (2.0 * math.pi))} Hz",
                "good" if analysis.stable else "bad",
            )
        )
        tiles.append(
            Tile("Integration error", short(test.motion.local_error), "rad", "sum of local errors, at most")
        )
    return tuple(tiles)


def _blocks(figures: dict[str, Figure], *keys: str) -> tuple[Block, ...]:
    return tuple(FigureBlock(figures[key]) for key in keys if key in figures)


def _stand_section(test: SimulatedTest, figures: dict[str, Figure]) -> Section:
    values = imperfection_values(test.imperfections)
    table: tuple[Block, ...] = ()
    if values:
        table = (_values_table(values, "Imperfections of the stand: true less assumed value."),)
    return Section("The stand", "the-stand", (*_blocks(figures, "stand", "imperfections"), *table))


def _output_section(figures: dict[str, Figure]) -> Section:
    lead = Text(
        "The lab sees the counts only. The lower panel is the truth that a calibration has to find.", lead=True
    )
    return Section("The output", "the-output", (lead, *_blocks(figures, "output", "locking")))


def _servo_section(test: SimulatedTest, figures: dict[str, Figure]) -> Section:
    blocks: list[Block] = []
    changes = test.motion.lock_changes() if test.motion is not None else ()
    if changes:
        when = ", ".join(f"{word} at {short(t, 4)} s" for t, word in changes[:6])
        blocks.append(Notice("warning", f"Pick-off or torque motor left their range: lock {when}."))
    blocks += _blocks(figures, "servo", "loop-bode", "loop-step", "loop-poles")
    blocks.append(
        _values_table(
            predictions(test),
            "What finite servo stiffness does beyond the quasi-steady model (linear prediction).",
        )
    )
    return Section("The servo loop", "the-servo", tuple(blocks))


def _design_section(p: TwinParameters) -> Section:
    table = (
        TableOf(fields(TwinParameters))
        .text("parameter", lambda entry: entry.metadata["meaning"])
        .text("symbol", lambda entry: entry.metadata["symbol"])
        .number("value", lambda entry: _number(getattr(p, entry.name)))
        .text("unit", lambda entry: pretty_unit(entry.metadata["unit"]))
        .number("plausible range", lambda entry: " to ".join(_number(end) for end in entry.metadata["range"]))
        .text("source of the default", lambda entry: entry.metadata["source"])
        .table("Parameters of the twin. Example values describe no real instrument.")
    )
    return Section("The design", "the-design", (table,))


def _number(value: float) -> str:
    return "unlimited" if math.isinf(value) else printed(significant(value, 5))


def _truth_section(test: SimulatedTest) -> Section:
    caption = "True coefficients, under the names and units of a calibration."
    return Section("The truth", "the-truth", (_values_table(coefficients(test), caption),))


def _name(value: TrueValue) -> str:
    return value.name if value.segment is None else f"{value.name}[{value.segment}]"


def _values_table(values: tuple[TrueValue, ...], caption: str) -> Table:
    shown = [(value, *shown_unit(value.name, value.unit)) for value in values]
    return (
        TableOf(shown)
        .text("name", lambda row: _name(row[0]))
        .number("value", lambda row: printed(significant(row[0].value * row[1], 8)))
        .text("unit", lambda row: pretty_unit(row[2]))
        .text("", lambda row: row[0].note)
        .table(caption)
    )


def simulation_text(test: SimulatedTest) -> str:
    """A few lines for the terminal: what was simulated, and the truth."""
    log = test.log
    lines = [f"{test.stand.kind}, {_MODELS[test.model]}: {count(log.t.size)} rows, {len(log.labels)} segments"]
    for value in coefficients(test):
        scale, unit = shown_unit(value.name, value.unit)
        lines.append(f"  {_name(value):<16}{significant(value.value * scale, 8):>16} {unit}")
    if test.motion is not None:
        changes = test.motion.lock_changes()
        lines.append(
            f"  lock lost {sum(word == 'lost' for _, word in changes)} times" if changes else "  lock kept"
        )
    return "\n".join(lines)
