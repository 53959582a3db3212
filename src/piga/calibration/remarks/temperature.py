"""Remark on a bias that follows the temperature and that the record does not exclude.

The record has a temperature, and the model has no ``k0_T``. Let g be the true ``k0_T``, u_g its standard uncertainty
beside the model, and c a coefficient with the standard uncertainty u without ``k0_T`` and u' with it. The missing term
then moves c by ``|g|/u_g sqrt(u'^2/u^2 - 1) u`` (docs/theory/calibration). A bias of less than four u_g is often not
seen in the residuals, and where ``u'`` is much larger than ``u`` it still moves c by more than u. No test can see it.
The remark therefore states the largest bias that the record does not exclude, and how far it would move c.

``|g|`` exceeds this bound in at most one record in twenty. A coefficient that is moved by more than u has a suggestion
of ``k0_T`` or this remark in 95 % of the records.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from piga.calibration.fit.one_run import Fit
from piga.calibration.model.reduction import solve_upper
from piga.calibration.model.solution import name_coefficients
from piga.calibration.remarks.missing_terms import Tested, after_change, pieces_of, tested
from piga.records.calibration import Coefficient, MissingTerm
from piga.records.spool import extent, spans
from piga.records.terms import si_factor

Array = NDArray[np.float64]
TERM = "k0_T"


@dataclass(frozen=True)
class TemperatureSettings:
    """Limits for the remark on a bias that follows the temperature.

    Attributes
    ----------
    confidence:
        Probability [1] that the bound holds the change of the bias with temperature.
    bias:
        Largest change of the bias with temperature [g/K] that is taken to be possible (own choice). It keeps the remark
        away from temperatures that are held to some thousandths of a kelvin.
    shift:
        Change of a coefficient in its standard uncertainties above which the remark is made.
    growth:
        Ratio [1] of the fit's standard uncertainties with ``k0_T`` and without it above which ``k0_T`` alone helps little.
    """

    confidence: float = 0.95
    bias: float = 5e-5
    shift: float = 1.0
    growth: float = 1.5


TEMPERATURE = TemperatureSettings()


@dataclass(frozen=True)
class Unseen:
    """A bias that follows the temperature and that the record does not exclude.

    ``bias`` is its bound [g/K] and ``assumed`` is True if it is the largest that is taken to be possible. It would move
    ``coefficient`` by ``shift`` standard uncertainties. ``growth`` is the ratio of the fit's standard uncertainties of
    this coefficient with ``k0_T`` and without it, inf where the record cannot tell them apart.
    """

    bias: float
    assumed: bool
    coefficient: str
    shift: float
    growth: float

    @property
    def words(self) -> str:
        """The remark in one sentence, and what to do."""
        size = f"{1e6 * self.bias:.2g} ug/K"
        bound = (
            f"up to {size}, the largest that is taken to be possible,"
            if self.assumed
            else f"up to {size} (95 %)"
        )
        held = "hold the temperature, take the positions in another order, or take them twice at different temperatures"
        beside = "; or add 'k0_T' to [model] terms"
        if self.growth < TEMPERATURE.growth:
            cure = (
                f"add 'k0_T' to [model] terms: the fit's standard uncertainty of {self.coefficient} is then "
                f"{self.growth:.3g} times as large; or {held}"
            )
        elif math.isinf(self.growth):
            cure = f"the temperature moves in step with the positions, so no term can separate them: {held}"
        else:
            cure = (
                "the temperature moves in step with the positions, and with 'k0_T' the fit's standard uncertainty of "
                f"{self.coefficient} is {self.growth:.2g} times as large: {held}{beside}"
            )
        return (
            f"the record does not exclude a bias that follows the temperature (k0_T): {bound} would move "
            f"{self.coefficient} by {self.shift:.2g} standard uncertainties; {cure}"
        )


def unseen_bias(
    plain: Fit, coefficients: tuple[Coefficient, ...], suggestions: tuple[MissingTerm, ...] = ()
) -> Unseen | None:
    """The bias that a record does not exclude; None if it moves nothing by more than its uncertainty.

    The reference of the temperature does not matter: the bias is that at the mean temperature of the record.

    Parameters
    ----------
    plain:
        The fit without slow noise. Slow noise would take up the signature of the term.
    coefficients:
        Those of the result, with combined standard uncertainties.
    suggestions:
        Missing terms that are suggested. Nothing is left to say where ``k0_T`` is one of them.
    """
    request, temperature = plain.design.request, plain.design.run.temperature
    if temperature is None or TERM in request.terms or request.phase_source != "output":
        return None
    low, high = extent(temperature)
    if low == high or any(TERM in entry.terms for entry in suggestions):
        return None
    pieces, rows = pieces_of(plain, [TERM, "k0"])
    mean = sum(float(np.sum(temperature[part])) for part in spans(temperature.size)) / temperature.size
    pieces = [_about_the_mean(piece, mean - request.temperature_reference) for piece in pieces]
    moved = moved_by_one(pieces)
    if moved is None:
        return None
    unit = plain.design.scale_factor * si_factor(TERM)
    test = tested(pieces, [TERM], (TERM,), rows)
    bound = math.inf if test is None else _bound(test) / unit
    bias = min(bound, TEMPERATURE.bias)
    before, after = after_change(plain, 0.0 * moved), after_change(plain, moved * (bias * unit))
    shifts = {c.key: abs(after[c.key] - before[c.key]) for c in coefficients if c.name != "phi" and c.std > 0.0}
    reported = {c.key: c.std for c in coefficients}
    key = max(shifts, key=lambda name: shifts[name] / reported[name], default=None)
    if key is None or shifts[key] <= TEMPERATURE.shift * reported[key]:
        return None
    growth = math.inf
    if test is not None:
        named, covariance = name_coefficients(plain.design, plain.solution, plain.covariance)
        own = math.sqrt(float(covariance.diagonal()[[c.key for c in named].index(key)]))
        growth = math.hypot(1.0, shifts[key] / bias * float(test.std[0]) / unit / own)
    return Unseen(bias, bound > TEMPERATURE.bias, key, shifts[key] / reported[key], growth)


def _bound(test: Tested) -> float:
    """Bound of the size of a candidate, by the noise or by the scatter of the parts, whichever is larger."""
    p = TEMPERATURE.confidence
    return abs(float(test.columns[0])) + max(
        float(ndtri(p)) * float(test.std[0]), float(stdtrit(test.freedom, p)) * float(test.spread[0])
    )


def _about_the_mean(piece: Array, offset: float) -> Array:
    """A factor ``[parameters | k0_T | k0 | residual]`` with the temperature less ``offset`` [K], without ``k0``."""
    held = piece.copy()
    held[:, -3] -= offset * held[:, -2]
    return np.delete(held, -2, axis=1)


def moved_by_one(pieces: list[Array]) -> Array | None:
    """Change of the parameters by a candidate of size one that the model lacks; None if they are not determined."""
    rows = np.vstack(pieces)[:, :-1]
    scale = np.linalg.norm(rows, axis=0)
    if not scale.all():
        return None
    R: Array = np.asarray(np.linalg.qr(rows / scale, mode="r"))
    m = R.shape[1] - 1
    if np.abs(np.diag(R)[:m]).min() == 0.0:
        return None
    return solve_upper(R[:m, :m], R[:m, m]) * (scale[m] / scale[:m])
