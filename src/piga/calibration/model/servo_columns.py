"""The columns behind the terms of the servo, and what they are combined at."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.instrument.twin.predictions import ServoParameters, servo_terms
from piga.records.run import Run
from piga.records.spool import square_sum

Array = NDArray[np.float64]
Names = tuple[str, ...]

STIFFNESS_COLUMNS = ("servo_mean", "servo_cosine", "servo_sine")
DAMPING_COLUMNS = ("damping_cosine", "damping_sine")
PHASELESS = (*STIFFNESS_COLUMNS, *DAMPING_COLUMNS)
"""Columns that know nothing of the phase, in the order of the kernel."""


@dataclass(frozen=True)
class ServoState:
    """What the columns are combined at.

    ``phases`` [rad] of each segment (each phase group, in :func:`find_state`); ``stiffness``, ``damping`` are K times the
    coefficients (SI), ``inverse`` is one over ``K tan_beta``, or 0 where the phase is held. Without ``turning`` there is no
    phase, and only the mean of the stiffness is left.
    """

    phases: tuple[float, ...]
    stiffness: float
    damping: float
    inverse: float
    turning: bool = True

    def term_rows(self, phase: float) -> dict[str, Array]:
        """The columns of ``PHASELESS`` (5,) that make up each term at a phase."""
        if not self.turning:
            return {"servo": np.array([-1.0, 0.0, 0.0, 0.0, 0.0]), "servo_damping": np.zeros(5)}
        return {
            "servo": np.array([-1.0, np.cos(2.0 * phase), -np.sin(2.0 * phase), 0.0, 0.0]),
            "servo_damping": np.array([0.0, 0.0, 0.0, -np.cos(phase), -np.sin(phase)]),
        }

    def phase_row(self, phase: float) -> Array:
        """Those that make up the derivative of both terms by the phase, times one over ``K tan_beta``."""
        s, d = self.stiffness * self.inverse, self.damping * self.inverse
        return np.array(
            [
                0.0,
                -2.0 * s * np.sin(2.0 * phase),
                -2.0 * s * np.cos(2.0 * phase),
                d * np.sin(phase),
                -d * np.cos(phase),
            ]
        )


def phaseless_columns(terms: Sequence[str]) -> Names:
    """Columns that hold the asked terms of the servo without a phase."""
    held = STIFFNESS_COLUMNS if "servo" in terms else ()
    return held + (DAMPING_COLUMNS if "servo_damping" in terms else ())


def given_servo(run: Run) -> dict[str, float]:
    """Coefficients of the servo [1/(m/s^2)^2] that the run file's ``[instrument] servo`` predicts; none without it.

    At the root-mean-square rate of the record. ``servo_damping`` is among them where the damping is given.
    """
    if not run.servo:
        return {}
    given = {parameter.name: parameter.value for parameter in run.servo}
    lever = given.get("pendulosity", run.scale_factor * given.get("angular_momentum", 0.0))
    plain = {
        name: given.get(name, 0.0) for name in ("integral_gain", "proportional_gain", "rate_gain", "damping")
    }
    rate = run.scale_factor * math.sqrt(square_sum(np.ascontiguousarray(run.f[:, 0])) / run.size)
    terms = servo_terms(ServoParameters(run.scale_factor, lever, **plain), rate=rate)
    damping = {"servo_damping": terms.servo_damping} if "damping" in given else {}
    return {"servo": terms.servo} | damping
