"""A simulated test shown: its page, its figures, and what terminal and notebook show."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from itertools import cycle

import numpy as np

from piga._version import __version__
from piga.instrument import (
    Instrument,
    closed_form,
    dead_zone,
    fixed_points,
    mean_rate,
    regime,
    revolution_period,
)
from piga.instrument.twin import TwinMotion, TwinParameters, analyse_loop, open_loop
from piga.records.terms import integral_unit, shown_unit
from piga.reports.render.figure import XYZ, Axis, Figure, Plot, Role
from piga.reports.render.numbers import count, pretty_unit, short, significant
from piga.reports.render.page import Notice, Page, Section, Table, TableOf, Tile
from piga.results import Array
from piga.stand.simulate import SimulatedTest
from piga.stand.write_run import TrueValue, coefficients, imperfection_values
from piga.units import ARCSEC, G0, MICRO_G

_POINTS = 801
_ROLES: tuple[Role, ...] = (*XYZ, "data")


def locking_figure(*curves: tuple[Instrument, float]) -> Figure:
    """Mean output rate against specific force along the input axis, with its locked plateau.

    A curve is an instrument and its transverse specific force [m/s^2]; the ideal line is that of the first.
    """
    borders = [float(dead_zone(one, force, 0.0)[1]) for one, force in curves]
    limit = 2.0 * (max(borders) or 1e-3 * G0)
    plot = Plot(
        "locking", "Locking of the output rate by transverse specific force",
        "specific force along the input axis a_x [mg]", "mean output rate [deg/s]", height=3.6,
    )  # fmt: skip
    ends = np.array([-limit, limit])
    plot.dashed(ends / G0 * 1e3, np.degrees(curves[0][0].scale_factor * ends), "ideal: K a_x")
    for (one, force), border, role in zip(curves, borders, cycle(_ROLES), strict=False):
        outside = (
            border + (limit - border) * np.linspace(0.0, 1.0, _POINTS // 2) ** 2
        )  # dense where the plateau ends
        a_x = np.concatenate((-outside[::-1], outside))
        name = f"a_t = {force / G0:.3g} g, beta = {one.beta / ARCSEC:.4g} arcsec"
        plot.line(a_x / G0 * 1e3, np.degrees(mean_rate(one, a_x, force, 0.0)), name, role)
    return plot.caption(
        "Inside the dead zone |a_x| < a_t tan(beta) the gimbal comes to rest although there is specific "
        f"force along the input axis; the widest plateau reaches to {max(borders) / G0 * 1e3:.3g} mg. Outside, the mean "
        "rate is K sqrt(a_x^2 - a_t^2 tan^2(beta)) and approaches the ideal line from below."
    )


def constant_input_page(inst: Instrument, a_x: float, a_t: float, seconds: float) -> Page:
    """Regime, lock zone and motion under constant input: ``a_x``, ``a_t`` [m/s^2] along and across the input axis."""
    forces, degree, turn = (a_x, a_t, 0.0), 180.0 / np.pi, 2.0 * np.pi
    name, border = regime(inst, *forces), float(dead_zone(inst, a_t, 0.0)[1])
    alpha, t = np.linspace(-np.pi, np.pi, _POINTS), np.linspace(0.0, seconds, _POINTS)
    rates = Plot("rates", "Rate against angle.", "output angle \u03b1 [deg]", "output rate [deg/s]")
    rate = degree * inst.scale_factor * (a_x + inst.tan_beta * a_t * np.sin(alpha))
    rates.line(degree * alpha, rate, "rate", "after").level(degree * alpha, 0.0, "at rest", "muted")
    tiles = [
        Tile("regime", name),
        Tile("locked zone of a_x", f"\u00b1 {significant(border / (1e-3 * G0), 4)}", "mg"),
        Tile("mean output rate", significant(degree * float(mean_rate(inst, *forces)), 4), "deg/s"),
    ]
    if name == "running":
        tiles.append(Tile("one revolution", significant(float(revolution_period(inst, *forces)), 4), "s"))
    if name == "locked":
        stable, unstable = (degree * float(at) for at in fixed_points(inst, *forces))
        tiles.append(Tile("rest angle", significant(stable, 4), "deg"))
        rates.points([stable], [0.0], "stable rest", "model")
        rates.points([unstable], [0.0], "unstable rest", "warning")
    motion = Plot("motion", "Output angle against time.", "time [s]", "output angle \u03b1 [rev]")
    motion.line(t, closed_form(inst, t, *forces)[0] / turn, "with cross-coupling", "after")
    motion.dashed(t, inst.scale_factor * a_x * t / turn, "without")
    content = (
        rates.caption("Where the curve crosses zero the gimbal can rest."),
        locking_figure((inst, a_t)),
        motion.caption("The exact closed form, from \u03b1 = 0."),
    )
    sections = (Section("Motion", "the-motion", content),)
    return Page("Constant input", "", tuple(tiles), sections, "piga \u00b7 explore")


def figures(test: SimulatedTest) -> dict[str, Callable[[], Figure]]:
    """All figures of a simulated test by name, in reading order."""
    drawn: dict[str, Callable[[], Figure]] = {"stand": partial(_stand_figure, test)}
    if np.any(test.profile.force - test.profile.reference):
        drawn["imperfections"] = partial(_imperfection_figure, test)
    drawn["output"] = partial(_output_figure, test)
    if test.specimen.instrument.tan_beta:
        across = np.hypot(*test.profile.force[test.profile.recorded, 1:].T)
        drawn["locking"] = partial(locking_figure, (test.specimen.instrument, float(across.max())))
    if test.motion is not None:
        drawn["servo"] = partial(servo_figure, test, test.motion)
        drawn["bode"] = partial(bode_figure, test.specimen.design)
    return drawn


def _time(test: SimulatedTest) -> tuple[Array, str]:
    """Time since the start, and the text of its axis."""
    t = test.profile.t - test.profile.t[0]
    scale, unit = (3600.0, "h") if t[-1] > 3 * 3600.0 else (1.0, "s")
    return t / scale, f"time [{unit}]"


def _components(plot: Plot, t: Array, values: Array) -> Plot:
    for k, role in enumerate(XYZ):
        plot.line(t, values[:, k], f"{role.upper()}0", role)
    return plot


def _stand_figure(test: SimulatedTest) -> Figure:
    t, time = _time(test)
    plot = Plot("stand", "The stand", height=4.6)
    _components(plot.panel(time, "specific force [g]", "Specific force"), t, test.profile.reference / G0)
    _components(plot.panel(time, "base rate [deg/s]", "Base rate"), t, np.degrees(test.profile.reference_rate))
    return plot.caption(
        f"What the {test.stand.kind} does in base axes, as the lab's log states it; moves between segments "
        "are shown, but not recorded."
    )


def _imperfection_figure(test: SimulatedTest) -> Figure:
    t, time = _time(test)
    plot = Plot("imperfections", "Imperfections of the stand", time, "true less reference [µg]")
    _components(plot, t, (test.profile.force - test.profile.reference) / MICRO_G)
    return plot.caption("What the imperfections change: the instrument feels it, the log does not show it.")


def _output_figure(test: SimulatedTest) -> Figure:
    (t, time), p = _time(test), test.profile
    error = test.rate / test.specimen.instrument.scale_factor - p.force[:, 0]
    words, unit, scale, what = "gimbal angle", "rev", 2.0 * math.pi, "Revolutions of the outer gimbal"
    if test.specimen.direct:
        words, unit, scale, what = "integral of the output", integral_unit(test.specimen.unit), 1.0, "The count"
    plot = Plot("output", "The output", height=4.6)
    plot.panel(time, f"{words} [{unit}]", words.capitalize()).line(t, test.alpha / scale, words)
    plot.panel(time, "rate/K less a_x [µg]", "Error of the uncoupled model")
    plot.line(t, np.where(p.recorded, error / MICRO_G, np.nan), "indicated less true", "model")
    return plot.caption(
        f"{what}, and what calibration has to explain: the rate over K less the true specific force along the input "
        "axis (recorded segments; base rate and all errors included)."
    )


def servo_figure(test: SimulatedTest, motion: TwinMotion) -> Figure:
    """Tilt from pick-off null and torque of the motor."""
    t, time = _time(test)
    tilt = (motion.beta - test.specimen.design.pick_off_null) / ARCSEC
    plot = Plot("servo", "The servo", height=4.6)
    plot.panel(time, "tilt from null [arcsec]", "Tilt").line(t, tilt, "tilt")
    plot.panel(time, "motor torque [mNm]", "Torque motor")
    plot.line(t, 1e3 * motion.torque, "torque", "model")
    changes = motion.lock_changes()
    lost = f" Lock is lost {sum(c == 'lost' for _, c in changes)} times." if changes else ""
    return plot.caption(
        f"The gravity torque on the outer axis ripples the tilt once a revolution; the motor holds it.{lost}"
    )


def bode_figure(p: TwinParameters) -> Figure:
    """Open-loop gain and phase with the margins."""
    analysis = analyse_loop(p)
    hertz = np.geomspace(1e-2 * max(analysis.crossover, 1.0), 30.0 * p.nutation, 600) / (2.0 * math.pi)
    response = open_loop(p, 2.0 * math.pi * hertz)
    cross = analysis.crossover / (2.0 * math.pi)
    gain, phase = 20.0 * np.log10(np.abs(response)), np.degrees(np.unwrap(np.angle(response)))
    across = Axis("frequency", "Hz", log=True, limits=(float(hertz[0]), float(hertz[-1])))
    plot = Plot("loop-bode", "Open servo loop", height=4.6)
    plot.panel(across, "gain [dB]", "Gain").line(hertz, gain, "open loop")
    plot.dashed([cross, cross], [gain.min(), gain.max()], "crossover", "muted")
    plot.panel(across, "phase [deg]", "Phase").line(hertz, phase, "open loop")
    plot.level(hertz, -180.0, "-180 deg", "warning")
    margin = analysis.gain_margin
    gain_margin = f"{20.0 * math.log10(margin):.3g} dB" if math.isfinite(margin) else "unlimited"
    return plot.caption(
        f"Crossover {cross:.3g} Hz, phase margin {math.degrees(analysis.phase_margin):.3g} deg, gain margin "
        f"{gain_margin}, nutation {analysis.nutation / (2 * math.pi):.3g} Hz."
    )


def page(test: SimulatedTest, serial: str = "simulated") -> Page:
    """The page of a simulated test."""
    drawn, values, twin = figures(test), imperfection_values(test.imperfections), test.motion is not None
    off = _values_table(values, "Imperfections of the stand: true less assumed value.") if values else None
    seen = "The lab sees the output only. The lower panel is the truth that a calibration has to find."
    true = _values_table(coefficients(test), "True coefficients, under the names and units of a calibration.")
    duration = test.profile.segments[-1].stop - test.profile.segments[0].start
    model = "direct instrument" if test.specimen.direct else "servo twin" if twin else "quasi-steady model"
    return Page(
        title="Simulated test" if serial == "simulated" else f"Simulated test of {serial}",
        subtitle=f"{test.stand.kind}, {model}, {short(duration)} s, seed {test.seed}.",
        tiles=_tiles(test),
        sections=(
            Section("The stand", "the-stand", (drawn["stand"], drawn.get("imperfections"), off)),
            Section("The output", "the-output", (seen, drawn["output"], drawn.get("locking"))),
            *([_servo_section(test, drawn), _design_section(test.specimen.design)] if twin else []),
            Section("The truth", "the-truth", (true,)),
        ),
        kicker="piga · simulated test",
        footer=f"Made by piga {__version__}. All data on this page are simulated.",
    )


def _tiles(test: SimulatedTest) -> tuple[Tile, ...]:
    e, log, direct = test.electronics, test.log, test.specimen.direct
    counted = f"{short(e.counts_per_revolution)} per revolution" if e.kind == "counts" and not direct else ""
    recorded = f"{len(log.labels)} segments at {short(e.sample_rate)} Hz"
    tiles = [Tile("Rows in the log", count(log.t.size), "", recorded), Tile("Output", e.kind, "", counted)]
    if not direct:
        turns = float(test.alpha[-1] - test.alpha[0]) / (2.0 * math.pi)
        tiles.append(Tile("Net turn of the gimbal", short(turns), "rev"))
    if test.motion is None:
        return tuple(tiles)
    loop, error = analyse_loop(test.specimen.design), test.motion.local_error
    nutation, crossover = (short(rate / (2.0 * math.pi)) for rate in (loop.nutation, loop.crossover))
    margin = short(math.degrees(loop.phase_margin))
    lost = sum(word == "lost" for _, word in test.motion.lock_changes())
    return (
        *tiles,
        Tile("Lock", f"lost {lost} times" if lost else "kept", tone="bad" if lost else ""),
        Tile("Nutation", nutation, "Hz"),
        Tile("Phase margin", margin, "°", f"crossover {crossover} Hz", "good" if loop.stable else "bad"),
        Tile("Integration error", short(error), "rad", "sum of local errors, at most"),
    )


def _servo_section(test: SimulatedTest, drawn: dict[str, Callable[[], Figure]]) -> Section:
    changes = test.motion.lock_changes() if test.motion is not None else ()
    when = ", ".join(f"{word} at {short(t, 4)} s" for t, word in changes[:6])
    lost = Notice("warning", f"Pick-off or torque motor left their range: lock {when}.") if changes else None
    return Section("The servo loop", "the-servo", (lost, drawn["servo"], drawn["bode"]))


def _design_section(p: TwinParameters) -> Section:
    def number(value: float) -> str:
        return "unlimited" if math.isinf(value) else significant(value, 5)

    table = (
        TableOf(fields(TwinParameters))
        .text("parameter", lambda entry: entry.metadata["meaning"])
        .text("symbol", lambda entry: entry.metadata["symbol"])
        .number("value", lambda entry: number(getattr(p, entry.name)))
        .text("unit", lambda entry: pretty_unit(entry.metadata["unit"]))
        .number("plausible range", lambda entry: " to ".join(map(number, entry.metadata["range"])))
        .table("Parameters of the twin. Example values describe no real instrument.")
    )
    return Section("The design", "the-design", (table,))


def _values_table(values: tuple[TrueValue, ...], caption: str) -> Table:
    return (
        TableOf([(value, *shown_unit(value.name, value.unit)) for value in values])
        .text("name", lambda row: row[0].name + (f"[{row[0].segment}]" if row[0].segment else ""))
        .number("value", lambda row: significant(row[0].value * row[1], 8))
        .text("unit", lambda row: pretty_unit(row[2]))
        .text("", lambda row: row[0].note)
        .table(caption)
    )


def brief(test: SimulatedTest) -> Page:
    """What was simulated, and the truth, for terminal and notebook."""
    return page(test).only("the-stand", "the-truth")
