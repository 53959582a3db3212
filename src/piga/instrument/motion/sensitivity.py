"""Derivatives of angle and rate with respect to the instrument's parameters and biases."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels.motion.blocks import GOOD
from piga._kernels.motion.sensitivity import PARAMETERS, propagate_sensitivities
from piga.instrument.checks import explain, float_array
from piga.instrument.motion.sampled_motion import initial_state, sampled_input
from piga.instrument.parameters import Instrument

Array = NDArray[np.float64]

SENSITIVITY_NAMES = ("scale_factor", "beta", "alpha0", "a_x", "a_Y", "a_Z")
"""Parameters of :class:`Sensitivities`, in the order of its columns; the last three are biases [m/s^2]."""


@dataclass(frozen=True)
class Sensitivities:
    """A motion and how it changes with each parameter.

    Attributes
    ----------
    alpha, rate:
        Unwrapped angle [rad] and rate [rad/s] at the samples, shape (n,).
    d_alpha, d_rate:
        Derivatives, shape (n, 6), columns in the order of ``names``: per (rad/s)/(m/s^2) of
        ``scale_factor``, per rad of ``beta`` and ``alpha0``, per m/s^2 of a constant bias added to
        ``a_x``, ``a_Y``, ``a_Z``. A bias of the base rate [rad/s] is ``-1/K`` times that of the force.
    """

    alpha: Array
    rate: Array
    d_alpha: Array
    d_rate: Array
    names: tuple[str, ...] = SENSITIVITY_NAMES

    def of_alpha(self, name: str) -> Array:
        """Derivative of the angle with respect to one parameter, shape (n,)."""
        return np.asarray(self.d_alpha[:, self.names.index(name)])

    def of_rate(self, name: str) -> Array:
        """Derivative of the rate with respect to one parameter, shape (n,)."""
        return np.asarray(self.d_rate[:, self.names.index(name)])


def sensitivities(
    inst: Instrument, t: ArrayLike, f: ArrayLike, base_rate: ArrayLike | None = None
) -> Sensitivities:
    """Motion under recorded specific force with its derivatives, from the same matrices.

    The derivatives are those of the discrete motion that :func:`piga.propagate` computes, exact to
    rounding: no differences are taken.

    Parameters
    ----------
    inst, t, f, base_rate:
        As in :func:`piga.propagate`.

    Raises
    ------
    ArgumentError
        As in :func:`piga.propagate`; also if a single step turns the gimbal by more than 1e5 rad.
    """
    record = sampled_input(inst, t, f, base_rate)
    n = record.t.size
    omega = record.base_rate if record.base_rate.size else float_array("base_rate", np.zeros((n, 3)))
    alpha, rate = np.empty(n), np.empty(n)
    d_alpha, d_rate = np.empty((n, PARAMETERS)), np.empty((n, PARAMETERS))
    with np.errstate(all="ignore"):
        status = propagate_sensitivities(
            record.t, record.f, omega, record.K, record.tan_beta, initial_state(inst.alpha0),
            alpha, rate, d_alpha, d_rate,
        )  # fmt: skip
    if status != GOOD:
        explain(record.t, status, f=record.f, base_rate=record.base_rate)
    alpha[0] = inst.alpha0
    return Sensitivities(alpha, rate, d_alpha, d_rate)
