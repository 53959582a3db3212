"""What each source of observation can tell apart, said in words before anything is estimated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga import earth
from piga.platform.identification.estimate import in_words
from piga.platform.identification.identified import Identification
from piga.platform.identification.observation import Tip, Unknowns, misalignment_regressors
from piga.platform.model.simulate import Readouts
from piga.units import ARCSEC

Array = NDArray[np.float64]

UNKNOWNS = ("polar.u", "polar.v", "equatorial.u", "equatorial.v")
_SEPARABLE = 100.0
"""Condition number above which unknowns count as not told apart: their uncertainty has grown a hundredfold."""


@dataclass(frozen=True)
class Observability:
    """One source: condition number, standard uncertainty (4,) [rad] of :data:`UNKNOWNS`, and a sentence.

    ``std`` is for white noise of one arc-second on every reading (infinite: not seen at all); on the specific
    force that is one arc-second of its direction, 48 um/s^2.
    """

    source: str
    condition: float
    std: Array
    separable: bool
    sentence: str


def observability(readouts: Readouts, known: Identification) -> tuple[Observability, ...]:
    """Observability of the two misalignments from each source alone and together.

    ``known`` gives the redundancy angle at which it is judged. With both cases turning at one speed the
    z angle alone carries ``m2 sin(c2) - m1 tan(eta) cos(c1)`` as one line, and the pick-off alone
    ``m2 cos(c2) - m1 sin(c1)``: each leaves two of the four unknowns free.
    """
    every = max(1, len(readouts.times) // 4000)
    t = readouts.times[::every]
    encoders = (readouts.encoder1[::every], readouts.encoder2[::every])
    x = Unknowns(
        Tip.of(known.polar, 0),
        Tip.of(known.equatorial, 0),
        known.eta0,
        known.eta_rate,
        np.eye(3),
        np.zeros(3),
        np.eye(3),
    )
    e, pick = misalignment_regressors(x, t, *encoders)
    felt = np.cross(_gravity(readouts)[::every][: len(t), :, None], e, axis=1)
    rows = {"x": e[:, 0, :4], "y": e[:, 1, :4], "z": e[:, 2, :4], "Y": pick[:, :4]}
    rows |= {name: felt[:, k, :4] for k, name in enumerate("123")}
    equal = np.allclose(np.diff(encoders[0][:64]), np.diff(encoders[1][:64]))
    chosen = {
        "gimbals, z only": "z",
        "redundancy-axis pick-off only": "Y",
        "gimbals, x and y": "xy",
        "gimbals, z, with pick-off": "zY",
        "gimbals, all": "xyz",
        "gimbals with pick-off": "xyzY",
        "specific force": "123",
        "specific force with pick-off": "123Y",
    }
    weight = np.sqrt(every) * ARCSEC
    return tuple(_judge(name, [rows[k] for k in keys], t, equal, weight) for name, keys in chosen.items())


def _gravity(readouts: Readouts) -> Array:
    """Direction (n + 1, 3) of gravity in the triad at the nodes: a cone about the Earth's axis."""
    angle = earth.EARTH_RATE * readouts.times
    cone = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=1)
    fitted, *_ = np.linalg.lstsq(0.5 * (cone[1:] + cone[:-1]), readouts.increments, rcond=None)
    gravity = cone @ fitted
    direction: Array = gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
    return direction


def _judge(source: str, rows: list[Array], t: Array, equal: bool, sigma: float) -> Observability:
    slow = np.stack([np.ones_like(t), t / t[-1]], axis=1)
    basis, _ = np.linalg.qr(slow)
    clean = np.concatenate([r - basis @ (basis.T @ r) for r in rows])
    _, values, right = np.linalg.svd(clean, full_matrices=False)
    condition = float(values[0] / values[-1]) if values[-1] > 0.0 else np.inf
    separable = condition < _SEPARABLE
    weak = values < values[0] / _SEPARABLE
    scatter = (right.T / np.where(values > 0.0, values, np.nan)) * sigma
    std = np.sqrt(np.sum(scatter**2, axis=1))
    std = np.where(np.isfinite(std), std, np.inf)
    return Observability(source, condition, std, separable, _sentence(separable, right[weak], clean, equal))


def _sentence(separable: bool, hidden: Array, clean: Array, equal: bool) -> str:
    if separable:
        return "tells both misalignments and both phases"
    unseen = [n for n, column in zip(UNKNOWNS, clean.T, strict=True) if not column.any()]
    if unseen:
        return f"does not see {', '.join(unseen)} at all; add the z axis or the pick-off"
    mixed = "; ".join(in_words(direction, UNKNOWNS) for direction in hidden)
    why = ": both cases turn at one speed, so that the two lines coincide" if equal else ""
    cure = "add the other gimbal axes or the pick-off" + (
        ", or turn the cases at unequal speeds" if equal else ""
    )
    return f"cannot tell apart {mixed}{why}; {cure}"
