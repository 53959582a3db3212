"""Figures of a simulated test: what the stand did, what the instrument did, and its servo loop."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga.instrument.twin.linear import analyse_loop, loop_poles, open_loop, step_response
from piga.instrument.twin.parameters import TwinParameters
from piga.reports.render.decimate import thin
from piga.reports.render.figure import Axis, Figure, Panel, Role, Series
from piga.reports.stand.locking import locking_figure
from piga.stand.simulate import SimulatedTest
from piga.units import ARCSEC, G0

Array = NDArray[np.float64]

_NAMES: tuple[tuple[str, Role], ...] = (("X0", "x"), ("Y0", "y"), ("Z0", "z"))
_MICRO_G = 1e-6 * G0


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


def _time(test: SimulatedTest) -> tuple[Array, str]:
    t = test.profile.t - test.profile.t[0]
    return (t / 3600.0, "h") if t[-1] > 3 * 3600.0 else (t, "s")


def _components(t: Array, values: Array) -> tuple[Series, ...]:
    return tuple(Series(*thin(t, values[:, k]), name=name, role=role) for k, (name, role) in enumerate(_NAMES))


def stand_figure(test: SimulatedTest) -> Figure:
    """Specific force and base rate of the reference."""
    t, unit = _time(test)
    force = Panel(
        Axis("time", unit),
        Axis("specific force", "g"),
        _components(t, test.profile.reference / G0),
        "Specific force",
    )
    degrees = np.degrees(test.profile.reference_rate)
    rate = Panel(Axis("time", unit), Axis("base rate", "deg/s"), _components(t, degrees), "Base rate")
    caption = (
        f"What the {test.stand.kind} does in base axes, as the lab's log states it; moves between segments "
        "are shown, but not recorded."
    )
    return Figure("stand", "The stand", (force, rate), caption, height=4.6)


def imperfection_figure(test: SimulatedTest) -> Figure:
    """Specific force that the instrument feels, less the reference."""
    t, unit = _time(test)
    change = (test.profile.force - test.profile.reference) / _MICRO_G
    panel = Panel(Axis("time", unit), Axis("true less reference", "ug"), _components(t, change))
    caption = "What the imperfections change: the instrument feels it, the log does not show it."
    return Figure("imperfections", "Imperfections of the stand", (panel,), caption)


def lock_zone_figure(test: SimulatedTest) -> Figure:
    """Mean rate against specific force at the largest transverse force that is recorded."""
    across = np.hypot(*test.profile.force[test.profile.recorded, 1:].T)
    return locking_figure(test.specimen.instrument, (float(across.max()),))


def output_figure(test: SimulatedTest) -> Figure:
    """Output angle, and the indicated specific force less the true one."""
    t, unit = _time(test)
    turns = Series(*thin(t, test.alpha / (2.0 * math.pi)), name="gimbal angle")
    p = test.profile
    error = test.rate / test.specimen.instrument.scale_factor - p.force[:, 0]
    recorded = np.where(p.recorded, error / _MICRO_G, np.nan)
    indicated = Series(*thin(t, recorded), name="indicated less true", role="model")
    return Figure(
        "output",
        "The output",
        (
            Panel(Axis("time", unit), Axis("gimbal angle", "rev"), (turns,), "Gimbal angle"),
            Panel(
                Axis("time", unit), Axis("rate/K less a_x", "ug"), (indicated,), "Error of the uncoupled model"
            ),
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
    t, unit = _time(test)
    tilt = (motion.beta - test.specimen.design.pick_off_null) / ARCSEC
    panels = [
        Panel(
            Axis("time", unit), Axis("tilt from null", "arcsec"), (Series(*thin(t, tilt), name="tilt"),), "Tilt"
        ),
        Panel(
            Axis("time", unit),
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
    limits = (float(hertz[0]), float(hertz[-1]))
    panels = (
        Panel(
            Axis("frequency", "Hz", log=True, limits=limits),
            Axis("gain", "dB"),
            (
                Series(hertz, gain, name="open loop"),
                Series(cross, [gain.min(), gain.max()], name="crossover", role="muted", dashed=True),
            ),
            "Gain",
        ),
        Panel(
            Axis("frequency", "Hz", log=True, limits=limits),
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
