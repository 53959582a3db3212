"""Allan deviation of the residual rate of a calibration, beside the noise found."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga.calibration.allan import allan_deviation, drift_line, model_deviation
from piga.records.calibration import Residuals
from piga.reports.render.figure import Axis, Figure, Panel, Series
from piga.units import ARCSEC


def allan_figure(residuals: Residuals, noise: tuple[float, float], bias_drift: float = 0.0) -> Figure | None:
    """Overlapping Allan deviation with its 68 % band, the noise found, and the slope of a bias drift.

    ``residuals`` are angles [rad]; ``noise`` is the white angle noise [rad] and the random walk [rad/sqrt(s)],
    ``bias_drift`` that found [rad/s/sqrt(s)]; without one a line of its slope is drawn for comparison.
    """
    white, walk = noise[0] ** 2, noise[1] ** 2
    found = allan_deviation(
        np.asarray(residuals.after, dtype=float),
        np.asarray(residuals.t),
        _begins(residuals),
        white=white,
        walk=walk,
    )
    if found.tau.size < 2:
        return None
    tau = found.tau
    angle, wander = (part / ARCSEC for part in model_deviation(tau, white, walk))
    both = np.hypot(np.hypot(angle, wander), drift_line(tau, bias_drift / ARCSEC))
    level = bias_drift / ARCSEC or both[-1] / math.sqrt(tau[-1] / 3.0)
    drift = drift_line(tau, level)
    near = (tau >= 0.1 * tau[-1]) | (bias_drift > 0.0)
    band = Series(tau, found.lower / ARCSEC, "68 % band", "band", "muted", upper=found.upper / ARCSEC)
    series = [
        band,
        Series(tau, found.deviation / ARCSEC, "residual", "line+points", "after"),
        Series(tau, both, "noise found", role="model"),
    ]
    series += [Series(tau, angle, "white noise", role="x", dashed=True)] if white > 0.0 else []
    series += [Series(tau, wander, "random walk", role="y", dashed=True)] if walk > 0.0 else []
    series.append(
        Series(
            tau[near],
            drift[near],
            "bias drift" if bias_drift else "slope of a drift",
            role="warning",
            dashed=True,
        )
    )
    low = 0.3 * min(float((found.deviation / ARCSEC).min()), float(both.min()))
    high = 3.0 * max(float((found.upper / ARCSEC).max()), float(both.max()))
    y = Axis("Allan deviation of the rate", "arcsec/s", log=True, limits=(low, high))
    return Figure(
        key="allan",
        title="Allan deviation of the residual rate.",
        panels=(Panel(Axis("averaging time", "s", log=True), y, tuple(series)),),
        caption="Overlapping Allan deviation of what the calibration leaves, with its 68 % band. Stretches are pooled, "
        "not joined: nothing longer than a third of the longest one is seen. Good: the curve follows the noise found; "
        "one that turns upwards along the dashed slope, above it, shows a drift of the bias that was not found.",
        height=3.4,
    )


def _begins(residuals: Residuals) -> NDArray[np.bool_]:
    """Where a stretch begins: another segment, or an increment that was not formed and left a step."""
    begins = np.zeros(residuals.t.size, dtype=bool)
    begins[0] = True
    begins[1:] = np.diff(residuals.segment) != 0
    begins[1:] |= (residuals.innovation[1:] == 0.0) & (np.diff(residuals.after) != 0.0)
    return begins
