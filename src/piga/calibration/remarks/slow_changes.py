"""Remarks on slow changes that a record does not show well: a wave of the rate, a bias that follows the temperature.

**A slow wave in a rate log.**
A bias that changes in a slow wave over a test of positions in the order of their angle looks like ``scale_factor``,
``m_Y`` and ``k0``. The residuals contain only the part of the wave that the model does not absorb. In an angle log this part
is seen as a drift or as coloured noise. A rate log has more white noise, and noise of any shape explains one wave badly. So the
mean rates of the parts of the segments, without the model, are compared with waves of each period (docs/theory/noise).

The gain in chi-square by cosine and sine together is exponentially distributed for white noise, with mean two. About two
periods per cycle in the record are independent.

The slow rates come from joined rows, so a long record costs no more than a short one.

The part of a wave that the model absorbs is in no residual, so a wave is often not seen. Where it is seen, the covariance
mostly includes coloured noise as well.

**A bias that follows the temperature.**
The record has a temperature, and the model has no ``k0_T``. Let g be the true ``k0_T`` and u_g its standard uncertainty
if it is added to the model. Let c be a coefficient with the standard uncertainty u without ``k0_T`` and u' with it. The
missing term then moves c by ``|g|/u_g sqrt(u'^2/u^2 - 1) u`` (docs/theory/calibration). A bias of less than four u_g is often not
seen in the residuals, and where ``u'`` is much larger than ``u`` it still moves c by more than u. No test can see it.
The remark therefore states the largest bias that the record does not exclude, and how far it would move c.

``|g|`` exceeds this bound in at most one record in twenty. A coefficient that is moved by more than u has a suggestion
of ``k0_T`` or this remark in 95 % of the records.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri, stdtrit

from piga.calibration.fit.one_run import Fit
from piga.calibration.intervals.coloured_noise import bins_of, contrasts_of
from piga.calibration.intervals.slow_noise import triangle
from piga.calibration.model.design import Joined
from piga.calibration.model.reduction import solve_upper
from piga.calibration.model.solution import name_coefficients
from piga.calibration.noise.components import RateBins
from piga.calibration.remarks.missing_terms import Tested, after_change, joined_rows, pieces_of, tested
from piga.records.calibration import Coefficient, MissingTerm
from piga.records.spool import extent, spans
from piga.records.terms import si_factor
from piga.results import Array
from piga.units import G0


@dataclass(frozen=True)
class WaveSettings:
    """Settings of the search for a slow wave (own choices)."""

    fewest: float = 0.3
    """Cycles in the record from which a wave is slow."""
    most: float = 6.0
    """Cycles in the record up to which a wave is slow."""
    spacing: float = 0.1
    """Distance of the waves that are tried [cycles in the record]."""
    undetermined: float = 1e-3
    """Smallest part of a wave that the model leaves for which the wave is tried."""
    chance: float = 0.01
    """Probability in a record of white noise below which a wave is a doubt."""


WAVE = WaveSettings()


@dataclass(frozen=True)
class SlowWave:
    """A wave of the rate: its ``period`` [s], its ``amplitude`` [g], and its probability in white noise."""

    period: float
    amplitude: float
    probability: float

    @property
    def words(self) -> str:
        """The doubt in one sentence, and what to do."""
        return (
            f"the rates have a slow wave of about {self.period:.2g} s and {1e6 * self.amplitude:.2g} ug that the model does "
            f"not hold (p = {self.probability:.1g} in white noise): part of such a wave looks like a coefficient, and the "
            "standard uncertainties do not hold that part; visit the positions again in another order, and record the temperature"
        )


def slow_wave(fit: Fit) -> SlowWave | None:
    """The likeliest slow wave of a rate log, if white noise alone hardly makes it.

    Parameters
    ----------
    fit:
        The fit without coloured noise.
    """
    if fit.mode != "samples" or fit.design.request.angle_rms is not None:
        return None
    bins = bins_of(fit)
    if bins is None:
        return None
    contrasts = contrasts_of(fit, *joined_factor(fit, bins), bins)
    if contrasts is None:
        return None
    white = contrasts.rest / contrasts.fast
    least = WAVE.undetermined * np.linalg.norm(contrasts.block)
    gain, period, amplitude = 0.0, 0.0, 0.0
    for cycles in np.arange(WAVE.fewest, WAVE.most + 0.5 * WAVE.spacing, WAVE.spacing):
        vectors, sizes, across = np.linalg.svd(
            contrasts.block @ _waves(bins, float(cycles)), full_matrices=False
        )
        along, seen = vectors.T @ contrasts.y, sizes > least
        own = float(np.sum(along[seen] ** 2) / white)
        if own > gain:
            size = np.linalg.norm(across[seen].T @ (along[seen] / sizes[seen]))
            gain, period = own, bins.span / float(cycles)
            amplitude = float(size) / fit.design.scale_factor / G0
    chance = -math.expm1(2.0 * WAVE.most * math.log1p(-math.exp(-0.5 * gain))) if gain > 0.0 else 1.0
    return SlowWave(period, amplitude, chance) if chance < WAVE.chance else None


def _waves(bins: RateBins, cycles: float) -> Array:
    """Mean rates of the parts by a cosine and a sine (parts, 2)."""
    turn = 2.0 * np.pi * cycles / bins.span
    kept = np.sinc(0.5 * turn * bins.widths / np.pi)
    at = turn * bins.middles
    waves: Array = kept[:, None] * np.stack([np.cos(at), np.sin(at)], axis=1)
    return waves


def joined_factor(fit: Fit, bins: RateBins) -> tuple[Array, int]:
    """Triangular factor of ``[slow rates | parameters | residual]``, and the number of joined rows."""
    design, m, size = fit.design, len(fit.design.names), bins.size

    def columns(joined: Joined) -> Array:
        t = np.asarray(design.run.t[joined.start : joined.stop])
        if not bins.point:
            return bins.increments(t[joined.last], joined.h)
        middles = 0.5 * (t[joined.starts] + t[joined.last])
        return np.asarray(np.maximum(joined.h, 0.0) * bins.increments(middles, joined.h))

    parts, total = [], 0
    for segment, rows, formed in joined_rows(fit, columns, size):
        turned = rows[:, :m] @ fit.solution.jacobians[design.groups[segment]]
        own = triangle(np.column_stack([rows[:, m : m + size], turned, rows[:, -1]]))
        parts.append(bins.placed(own, segment))
        total += formed
    factor = triangle(np.vstack(parts))
    kept = np.ones(factor.shape[1], dtype=bool)
    kept[bins.count : -1] = factor[:, bins.count : -1].any(axis=0)
    return factor[:, kept], total


TERM = "k0_T"


@dataclass(frozen=True)
class TemperatureSettings:
    """Limits for the remark on a bias that follows the temperature."""

    confidence: float = 0.95
    """Probability [1] that the bound holds the change of the bias with temperature."""
    bias: float = 5e-5
    """Largest change of the bias with temperature [g/K] that is taken to be possible (own choice). It keeps the remark
    away from temperatures that are held to some thousandths of a kelvin."""
    shift: float = 1.0
    """Change of a coefficient in its standard uncertainties above which the remark is made."""
    growth: float = 1.5
    """Ratio [1] of the fit's standard uncertainties with ``k0_T`` and without it above which ``k0_T`` alone helps
    little."""


TEMPERATURE = TemperatureSettings()


@dataclass(frozen=True)
class Unseen:
    """A bias that follows the temperature and that the record does not exclude.

    ``bias`` is its bound [g/K] and ``assumed`` is True if it is the largest that is assumed to be possible. It would move
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
    plain: Fit, coefficients: tuple[Coefficient, ...], suggestions: tuple[MissingTerm, ...]
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
    """Change of the parameters by a missing candidate of size one; None if they are not determined."""
    rows = np.vstack(pieces)[:, :-1]
    scale = np.linalg.norm(rows, axis=0)
    if not scale.all():
        return None
    R: Array = np.asarray(np.linalg.qr(rows / scale, mode="r"))
    m = R.shape[1] - 1
    if np.abs(np.diag(R)[:m]).min() == 0.0:
        return None
    return solve_upper(R[:m, :m], R[:m, m]) * (scale[m] / scale[:m])
