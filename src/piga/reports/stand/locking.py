"""The figure of the lock zone: what transverse specific force does to the mean output rate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from piga.instrument import Instrument, dead_zone, mean_rate
from piga.reports.render.figure import Axis, Figure, Panel, Role, Series
from piga.units import ARCSEC, G0

_POINTS = 801
_ROLES: tuple[Role, ...] = ("x", "y", "z", "data")


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
