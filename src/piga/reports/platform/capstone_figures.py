"""Figures of the capstone as data: gravity through the input axes, one passage, the navigation error."""

from __future__ import annotations

import numpy as np

from piga.platform.runs.capstone import Capstone
from piga.reports.platform.figures import HOUR, MINUTE, schuler_peak, time_axis
from piga.reports.render.figure import Axis, Figure, Panel, Role, Series


def force_day_figure(found: Capstone) -> Figure:
    """Specific force along each input axis over a sidereal day, with the locked zone marked."""
    times, along = found.day
    sensors = found.scenario.sensors.piga
    width = 9.8 * (sensors.tan_beta if sensors else 0.0)
    roles: tuple[Role, ...] = ("x", "y", "z")
    panel = Panel(
        Axis("time", "h"),
        Axis("force along the input axis", "m/s^2"),
        (
            *(Series(times / HOUR, along[:, k], f"instrument {k + 1}", "line", roles[k]) for k in range(3)),
            Series([0.0, times[-1] / HOUR], [0.0, 0.0], "locked zone", "line", "warning", dashed=True),
        ),
    )
    return Figure(
        "fig-day",
        "Gravity sweeps through every input axis",
        (panel,),
        "Three axes at right angles round the pole. Each crosses zero twice a day, "
        f"and is inside its locked zone within {1e3 * width:.1f} mm/s^2 of it.",
    )


def passage_figure(found: Capstone) -> Figure | None:
    """One passage through the locked zone: true force, raw output, solved output."""
    p = found.passage
    if p is None:
        return None
    minutes = (p.times - p.times[0]) / MINUTE
    centre = 1e3
    return Figure(
        "fig-passage",
        f"Instrument {p.instrument + 1} passes its locked zone",
        (
            Panel(
                Axis("time", "min"),
                Axis("force along the input axis", "mm/s^2"),
                (
                    Series(
                        minutes,
                        -p.half_width * centre * np.ones_like(minutes),
                        "locked zone",
                        "band",
                        "warning",
                        upper=p.half_width * centre * np.ones_like(minutes),
                    ),
                    Series(minutes, p.true * centre, "true", "line", "reference", dashed=True),
                    Series(minutes, p.raw * centre, "raw output", "line", "before"),
                ),
            ),
            Panel(
                Axis("time", "min"),
                Axis("error of the reading", "mm/s^2"),
                (
                    Series(minutes, (p.raw - p.true) * centre, "raw output", "line", "before"),
                    Series(minutes, (p.triad - p.true) * centre, "triad solved", "line", "after"),
                ),
            ),
        ),
        "The gimbal turns ever more slowly towards the zone, and its cross-coupling, else "
        "averaged over each turn, keeps one sign for minutes. Solving the three instruments with "
        "their effective axes gives the force back.",
        height=2.6,
    )


def capstone_figure(found: Capstone) -> Figure:
    """Horizontal position error over the run for every reading."""
    looks: dict[str, tuple[Role, bool]] = {
        "ideal": ("reference", True),
        "raw tripod": ("before", False),
        "raw skewed": ("warning", False),
        "triad": ("after", False),
        "triad skewed": ("model", True),
        "triad, calibrated": ("z", True),
    }
    axis, unit = time_axis(float(found.scenario.duration))
    series = tuple(
        Series(
            o.errors.times / unit,
            np.maximum(schuler_peak(o.errors.times, o.errors.horizontal), 1e-4),
            name,
            "line",
            looks[name][0],
            dashed=looks[name][1],
        )
        for name, o in found.outcomes.items()
    )
    return Figure(
        "fig-capstone",
        "Ten days with three gyro accelerometers",
        (Panel(axis, Axis("horizontal position error", "m", log=True), series),),
        "Largest error within each 84 minutes.",
        height=3.6,
    )
