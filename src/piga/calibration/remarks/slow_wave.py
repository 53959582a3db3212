"""Doubt about a slow wave of the rate in a rate log.

A bias that changes in a slow wave over a test of positions in the order of their angle looks like ``scale_factor``,
``m_Y`` and ``k0``. Only what the model leaves of the wave is in the residuals. In an angle log that is seen as a drift or as
coloured noise. A rate log has more white noise, and noise of any shape explains one wave badly. So the mean rates of the parts
of the segments, without the model, are compared with waves of each period (docs/theory/noise).

The gain in chi-square by cosine and sine together is exponentially distributed for white noise, with mean two. About two
periods per cycle in the record are independent.

The slow rates come from joined rows, so a long record costs no more than a short one.

What the model takes up of a wave is in no residual, so a wave is often not seen. Where it is seen, coloured noise is mostly in the
covariance as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.calibration.fit.one_run import Fit
from piga.calibration.intervals.coloured_noise import contrasts_of
from piga.calibration.intervals.slow_noise import triangle
from piga.calibration.model.design import Block
from piga.calibration.noise.components import RateBins
from piga.calibration.noise.settings import NOISE
from piga.calibration.remarks.missing_terms import joined_rows
from piga.units import G0

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WaveSettings:
    """Settings of the search for a slow wave (own choices).

    Attributes
    ----------
    fewest, most:
        Cycles in the record from which and up to which a wave is slow.
    spacing:
        Distance of the waves that are tried [cycles in the record].
    undetermined:
        Smallest part of a wave that the model leaves for which the wave is tried.
    chance:
        Probability in a record of white noise below which a wave is a doubt.
    """

    fewest: float = 0.3
    most: float = 6.0
    spacing: float = 0.1
    undetermined: float = 1e-3
    chance: float = 0.01


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
    run = fit.design.run
    if (
        fit.mode != "samples"
        or fit.design.request.angle_rms is not None
        or len(run.labels) > NOISE.most_segments
    ):
        return None
    bins = RateBins.of(run)
    if fit.design.rows < NOISE.colour_least * bins.count or bins.widths.min() <= 0.0:
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

    def columns(block: Block, starts: NDArray[np.int64], h: Array) -> Array:
        ends = np.append(starts[1:], block.h.size) - 1
        t = design.run.t[block.start : block.stop]
        if not bins.point:
            return bins.increments(np.asarray(t[ends]), h)
        middles: Array = np.maximum(h, 0.0) * bins.increments(0.5 * (t[starts] + t[ends]), h)
        return middles

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
