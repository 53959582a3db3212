"""Figure of docs/compensation.md: run ``python -m builders.build_triad_figure`` from the repository root."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tests.compensation.sets.twin_triad import run, spectrum

from piga.reports.render.figure import Axis, Figure, Panel, Series
from piga.reports.render.static import write_figure
from piga.units import G0

OUT = Path(__file__).parents[1] / "docs" / "figures"
ORDERS = np.arange(0.3, 5.01, 0.02)


def order_figure() -> Figure:
    """Error along an input axis by revolution order: raw, compensated, and the noise that was put in."""
    outcome = run(120.0)
    lines = (("before", "before", outcome.before), ("after", "after", outcome.after))
    series = tuple(
        Series(ORDERS, spectrum(outcome.psi, error, ORDERS) / (1e-6 * G0), name=name, role=role)
        for name, role, error in lines
    )
    noise = spectrum(outcome.psi, outcome.noise, ORDERS) / (1e-6 * G0)
    series += (Series(ORDERS, noise, name="noise put in", role="reference", dashed=True),)
    y = Axis("error along the input axis", "µg", log=True)
    return Figure(
        key="compensation-triad-orders",
        title="A triad of servo twins, before and after compensation.",
        panels=(Panel(Axis("revolution order", "cycles/rev"), y, series),),
        caption="Three twins on a cone, 120 s of slow swing. Order 1 is cross-coupling.",
        height=3.0,
    )


if __name__ == "__main__":
    figure = order_figure()
    write_figure(figure, OUT / f"{figure.key}.svg")
