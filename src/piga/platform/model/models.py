"""Compensation models none, A, B and C: the misalignment that the navigator assumes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga._kernels.platform.motion import follow
from piga.platform.model.scenario import Gyro, Model, PlatformScenario
from piga.platform.model.simulate import Readouts
from piga.results import Result

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Knowledge:
    """The misalignments of the two gyros and the redundancy angle, from identification or truth.

    ``polar, equatorial``: misalignment, phase, harmonics; ``eta0`` [rad] at the start of the run (the
    value 'at calibration' that model A holds), ``eta_rate`` [rad/s].
    """

    polar: Gyro
    equatorial: Gyro
    eta0: float
    eta_rate: float


def true_knowledge(scenario: PlatformScenario) -> Knowledge:
    """The true values of the simulation."""
    rate = scenario.equatorial.drift[0] - scenario.polar.drift[1]
    return Knowledge(scenario.polar, scenario.equatorial, scenario.redundancy, rate)


def encoder_harmonics(gyro: Gyro, orders: int) -> tuple[Array, Array]:
    """Harmonics of the misalignment over the *encoder* angle: cosine and sine, order 1 to ``orders``.

    With ``c = theta + phase``: ``a cos(k c + p) = A cos(k theta) + B sin(k theta)``,
    ``A = a cos(k phase + p)``, ``B = -a sin(k phase + p)``.
    """
    cosines, sines = np.zeros(orders), np.zeros(orders)
    for h in gyro.harmonics:
        if h.order <= orders:
            angle = h.order * gyro.phase + h.phase
            cosines[h.order - 1] += h.amplitude * np.cos(angle)
            sines[h.order - 1] -= h.amplitude * np.sin(angle)
    return cosines, sines


@dataclass(frozen=True, eq=False, repr=False)
class CaseCompensator(Result):
    """One model prepared for the navigator: kernel constants, redundancy angle per node (n + 1,) or (1,)."""

    model: Model
    tips: Array
    harmonics: tuple[Array, Array, Array, Array]
    eta: Array

    def tangent_secant(self) -> tuple[Array, Array]:
        """tan(eta) and sec(eta) at the nodes."""
        tangent = np.tan(self.eta)
        return tangent, np.sqrt(1.0 + tangent * tangent)


def modelled_angles(made: CaseCompensator, readouts: Readouts) -> Array:
    """Small angles e (n + 1, 3) [rad] of the platform against the triad at the nodes, as the model has them."""
    (c1, s1), (c2, s2) = (case.T for case in readouts.case_nodes)
    m1 = made.tips[4] + _series(made.harmonics[0], made.harmonics[1], c1, s1)
    m2 = made.tips[5] + _series(made.harmonics[2], made.harmonics[3], c2, s2)
    tangent, secant = made.tangent_secant()
    ex = m1 * (c1 * made.tips[0] - s1 * made.tips[1])
    ey = m1 * (s1 * made.tips[0] + c1 * made.tips[1])
    ez = m2 * (s2 * made.tips[2] + c2 * made.tips[3]) * secant - ex * tangent
    return np.stack([ex, ey, ez], axis=1)


def compensator(
    model: Model, known: Knowledge, readouts: Readouts, *, redundancy: str = "pick-off"
) -> CaseCompensator:
    """Prepare a model.

    Parameters
    ----------
    model:
        ``none``; ``A`` redundancy angle held at ``known.eta0``; ``B`` followed; ``C`` followed and with
        the harmonics of the misalignments [He2014 for A and B; C is this project's own].
    known:
        Misalignments, phases and redundancy angle to compensate.
    readouts:
        Readouts of the run. They give the pick-off and the times.
    redundancy:
        Source of the redundancy angle for B and C: ``pick-off`` or ``drift-model`` (``eta0 + rate t``).
    """
    nothing = np.zeros(0)
    if model == "none":
        return CaseCompensator(model, np.array([1.0, 0.0, 1.0, 0.0, 0.0, 0.0]), (nothing,) * 4, np.zeros(1))
    p, e = known.polar, known.equatorial
    tips = np.array(
        [np.cos(p.phase), np.sin(p.phase), np.cos(e.phase), np.sin(e.phase), p.misalignment, e.misalignment]
    )
    orders = max((h.order for h in (*p.harmonics, *e.harmonics)), default=0) if model == "C" else 0
    harmonics = (*encoder_harmonics(p, orders), *encoder_harmonics(e, orders))
    if model == "A":
        eta = np.array([known.eta0])
    elif redundancy == "drift-model":
        eta = known.eta0 + known.eta_rate * readouts.times
    else:
        eta = follow_redundancy(readouts, tips, harmonics, known)
    return CaseCompensator(model, tips, harmonics, eta)


def follow_redundancy(
    readouts: Readouts, tips: Array, harmonics: tuple[Array, Array, Array, Array], known: Knowledge
) -> Array:
    """Redundancy angle (n + 1,) [rad] from the pick-off minus ``m2 cos c2 - m1 sin c1``, smoothed without lag.

    The filter is a critically damped second-order tracker. Its time constant is four case turns (eight minutes
    if the cases rest), so errors of the model at the case-rotation period are averaged out.
    """
    (c1, s1), (c2, s2) = (case.T for case in readouts.case_nodes)
    m1 = tips[4] + _series(harmonics[0], harmonics[1], c1, s1)
    m2 = tips[5] + _series(harmonics[2], harmonics[3], c2, s2)
    expected = m2 * (c2 * tips[2] - s2 * tips[3]) - m1 * (s1 * tips[0] + c1 * tips[1])
    turned = abs(readouts.encoder1[min(len(c1) - 1, 64)] - readouts.encoder1[0]) / (
        min(len(c1) - 1, 64) * readouts.step
    )
    constant = 4.0 * 2.0 * np.pi / turned if turned > 0.0 else 480.0
    decay = np.exp(-readouts.step / constant)
    eta = np.empty(len(c1))
    follow(
        readouts.pickoff, expected, known.eta0, known.eta_rate, readouts.step,
        1.0 - decay * decay, (1.0 - decay) ** 2 / readouts.step, eta,
    )  # fmt: skip
    return eta


def _series(cosines: Array, sines: Array, c: Array, s: Array) -> Array:
    total, ck, sk = np.zeros_like(c), np.ones_like(c), np.zeros_like(c)
    for a, b in zip(cosines, sines, strict=True):
        ck, sk = ck * c - sk * s, sk * c + ck * s
        total += a * ck + b * sk
    return total
