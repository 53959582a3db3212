"""Figures of one platform run as data: readouts, recursive identification, gravity cone; what others share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piga.platform.identification.alignment import Alignment
from piga.platform.identification.identified import Identification
from piga.platform.model.simulate import Run
from piga.reports.render.figure import Axis, Figure, Panel, Role, Series
from piga.units import ARCSEC

Array = NDArray[np.float64]

DAY, HOUR, MINUTE = 86400.0, 3600.0, 60.0
ARCMIN = 60.0 * ARCSEC


def time_axis(span: float) -> tuple[Axis, float]:
    """Axis of time in a unit that suits the span [s], and that unit in seconds."""
    for unit, seconds in (("d", DAY), ("h", HOUR), ("min", MINUTE)):
        if span > 2.0 * seconds:
            return Axis("time", unit), seconds
    return Axis("time", "s"), 1.0


def model_name(model: str) -> str:
    """What the pages call a compensation model."""
    return "no model" if model == "none" else f"model {model}"


def schuler_peak(times: Array, values: Array) -> Array:
    """Largest value within 42 minutes either side."""
    from scipy.ndimage import maximum_filter1d

    return maximum_filter1d(values, size=max(1, round(84.4 * MINUTE / float(times[1] - times[0]))))


def averaged(values: Array, over: int) -> Array:
    """Running mean of ``values`` (n,) or (n, k) over ``over`` samples, (n - over + 1, ...)."""
    start = values[:1]
    total = np.cumsum(np.concatenate([0.0 * start, values - start]), axis=0)
    return start + (total[over:] - total[:-over]) / over


def readouts_figure(run: Run) -> Figure:
    """What is read: specific force, gimbal angles, pick-off, over the run and its first minutes."""
    r = run.readouts
    axis, unit = time_axis(float(r.times[-1]))
    early = slice(0, max(2, min(len(r.times), int(40.0 * MINUTE / r.step))))
    minutes = Axis("time", "min")
    middle = 0.5 * (r.times[1:] + r.times[:-1])
    force = r.increments / r.step
    angles = np.unwrap(r.gimbals, axis=0)
    gimbals, axes = ("outer", "middle", "inner"), ("x", "y", "z")
    over = 1 if run.truth.motion.at_rest else max(1, round(MINUTE / r.step))
    close = "" if over == 1 else ", 1 min mean"
    pickoff = np.stack([r.pickoff, run.truth.eta], axis=1) / ARCMIN
    panels = (
        _three(axis, Axis("specific force", "m/s^2"), middle / unit, force, axes),
        _three(
            minutes,
            Axis(f"force{close}", "mm/s^2"),
            *_course_out(middle[early], 1e3 * force[early], over),
            axes,
        ),
        _three(axis, Axis("gimbal angle", "deg"), r.times / unit, np.degrees(angles), gimbals),
        _three(
            minutes,
            Axis(f"gimbal{close}", "arcmin"),
            *_course_out(r.times[early], angles[early] / ARCMIN, over),
            gimbals,
        ),
        _pickoff(axis, r.times / unit, pickoff),
        _pickoff(minutes, r.times[early] / MINUTE, pickoff[early]),
    )
    return Figure(
        "fig-readouts",
        "What is read on the platform",
        panels,
        "Left: the whole run. Right: the first minutes, force and gimbal angles less a parabola, so that what "
        "turns with the cases shows"
        + (
            "."
            if over == 1
            else "; averaged over a minute, so that the motion of the vehicle does not hide it."
        ),
        columns=2,
        height=2.4,
    )


def _three(x: Axis, y: Axis, at: Array, values: Array, labels: tuple[str, str, str]) -> Panel:
    """Three columns against one axis of time, in the colours of the axes."""
    roles: tuple[Role, ...] = ("x", "y", "z")
    return Panel(x, y, tuple(Series(at, values[:, k], labels[k], "line", roles[k]) for k in range(3)))


def _pickoff(x: Axis, at: Array, values: Array) -> Panel:
    read = Series(at, values[:, 0], "read", "line", "data")
    true = Series(at, values[:, 1], "redundancy angle", "line", "model")
    return Panel(x, Axis("pick-off", "arcmin"), (read, true))


def _course_out(times: Array, values: Array, over: int) -> tuple[Array, Array]:
    """Time [min] and columns of ``values`` (n, 3), averaged over ``over`` samples and freed of a parabola."""
    t, mean = averaged(times, over), averaged(values, over)
    basis = np.polynomial.polynomial.polyvander((t - t.mean()) / (t[-1] - t[0]), 2)
    fitted, *_ = np.linalg.lstsq(basis, mean, rcond=None)
    return t / MINUTE, mean - basis @ fitted


def convergence_figure(found: Identification) -> Figure:
    """Recursive estimates against time with their 95 % band, relative to the last one."""
    t = found.history["time"] / MINUTE
    values, stds = found.history["values"], found.history["stds"]
    half = (len(found.names) - 2 * ("eta0" in found.names)) // 2
    panels = []
    roles: tuple[Role, Role] = ("x", "y")
    for at, title in ((0, "polar"), (half, "equatorial")):
        last = values[-1, at : at + 2]
        series: list[Series] = []
        for k, role in enumerate(roles):
            late = slice(len(t) // 8, None)
            y, s = (values[late, at + k] - last[k]) / ARCSEC, 1.96 * stds[late, at + k] / ARCSEC
            series.append(Series(t[late], -s, "95 % band" if k == 0 else "", "band", "muted", upper=s))
            series.append(Series(t[late], y, f"m {'cos' if k == 0 else 'sin'}(phase)", "line", role))
        panels.append(Panel(Axis("time", "min"), Axis(f"{title}, off its end", "arcsec"), tuple(series)))
    return Figure(
        "fig-convergence",
        "Recursive identification",
        tuple(panels),
        "Estimates sample by sample, less the last one; the band is the filter's own 95 % interval.",
        columns=2,
        height=2.6,
    )


def cone_figure(run: Run, aligned: Alignment) -> Figure:
    """Gravity in platform axes over the alignment, and the cone it runs on."""
    r = run.readouts.first(run.scenario.calibration_time)
    force = r.increments / r.step
    block = max(1, len(force) // 240)
    mean = force[: len(force) // block * block].reshape(-1, block, 3).mean(axis=1)
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    inertial = mean[0] @ aligned.triad.T
    radius = float(np.hypot(inertial[0], inertial[1]))
    cone = (
        np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full_like(turn, inertial[2])], axis=1)
        @ aligned.triad
    )
    return Figure(
        "fig-cone",
        "The gravity cone",
        (
            Panel(
                Axis("specific force x", "m/s^2"),
                Axis("specific force y", "m/s^2"),
                (
                    Series(cone[:, 0], cone[:, 1], "cone about the Earth's axis", "line", "muted"),
                    Series(mean[:, 0], mean[:, 1], "measured", "points", "data"),
                ),
                equal=True,
            ),
        ),
        "On a platform fixed in inertial space gravity runs once round this cone in a sidereal "
        "day; the measured arc gives the Earth's axis.",
    )
