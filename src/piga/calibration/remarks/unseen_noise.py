"""Remark on coloured noise of the rate that the record does not exclude.

If the record shows coloured noise, the uncertainties include it (:mod:`~piga.calibration.intervals.coloured_noise`). If the
noise is too small to be seen, they do not. A record of a few positions cannot show much of it: flicker noise or a drift moves a
coefficient mostly by the few slowest shapes of the record, and the model absorbs these. The remark therefore states the largest
noise that the record does not exclude, and how much larger it would make an expanded uncertainty. The remark changes no number
(own derivation, docs/theory/noise).

The slow rates of the record come from joined rows, so a long record costs no more than a short one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from piga.calibration.fit.one_run import Fit
from piga.calibration.intervals.coloured_noise import bins_of, contrasts_of
from piga.calibration.intervals.slow_noise import moved_by
from piga.calibration.model.solution import variances_of
from piga.calibration.noise.components import RATES, RateBins, markov_times
from piga.calibration.noise.likelihood import Contrasts, ProfileLikelihood
from piga.calibration.remarks.slow_changes import joined_factor
from piga.records.calibration import Coefficient
from piga.records.calibration.verdict import THRESHOLDS
from piga.results import Array
from piga.units import G0


@dataclass(frozen=True)
class UnseenSettings:
    """Limits for the remark on coloured noise that the record does not exclude."""

    confidence: float = 0.95
    """Probability [1] that the level is below its limit."""
    growth: float = 1.12
    """Ratio [1] of the expanded uncertainty with the noise to the reported one above which the remark is made. An
    interval that is too narrow by this ratio holds in 92 % instead of 95 %, the least that is asked of coloured noise."""
    size: float = 3e-6
    """Smallest noise [g] that is worth a remark (own choice: the tables of docs/accuracy have 3.4 micro-g). It is the
    noise of a decade of frequency (flicker), of the rate (Markov) or of the whole test (drift). Without it the remark
    would stand in records of any length: the limit of the noise falls with the length as the uncertainties do."""
    shuffled: float = 0.5
    """Largest share [1] of the excess of the growth that another order of the positions leaves for it to be named."""
    stride: float = 0.381966
    """Step from one position to the next in that order, as a share [1] of the positions (the golden section)."""


UNSEEN = UnseenSettings()

NOT_EXCLUDED = "the record does not exclude coloured noise of the rate"
"""Beginning of the remark."""


@dataclass(frozen=True)
class UnseenNoise:
    """Coloured noise of the rate that the record does not exclude.

    ``kind`` and ``time`` [s] are those of a component (:mod:`piga.calibration.noise.components`), ``size`` [g] the limit of its
    size. It would make the expanded uncertainty of ``coefficient`` ``growth`` times as large, ``shuffled`` times with the same
    positions in another order. ``seconds`` [s] is the duration of a position. It must be ``longer`` times as long for the limit
    to fall to the smallest size; nan where that is not known.
    """

    kind: str
    time: float
    size: float
    coefficient: str
    growth: float
    shuffled: float
    seconds: float
    longer: float
    positions: int

    @property
    def words(self) -> str:
        """The remark in one sentence, and the test that would show the noise."""
        size = f"{1e6 * self.size:.2g} ug" if math.isfinite(self.size) else "any size"
        noise = {
            "flicker": f"1/f noise up to {size} in a decade of frequency",
            "markov": f"first-order Markov noise of about {self.time:.2g} s up to {size}",
            "drift": f"a drift (random walk) up to {size} over the test",
        }[self.kind]
        return (
            f"{NOT_EXCLUDED}: {noise} (95 %) would make the expanded uncertainty of {self.coefficient} "
            f"{self.growth:.2g} times as large; {self._cure}"
        )

    @property
    def _cure(self) -> str:
        one = self.positions == 1
        cure = "record more revolutions" if one else "record longer at each position"
        if math.isfinite(self.longer):
            needed = f"about {float(f'{self.longer * self.seconds:.2g}'):g} s instead of {self.seconds:.3g} s"
            whole = f"a record of {needed}" if one else f"positions of {needed}"
            cure = f"{whole} would show such noise or exclude {1e6 * UNSEEN.size:.2g} ug of it"
        if one or self.shuffled - 1.0 > UNSEEN.shuffled * (self.growth - 1.0):
            return cure
        return (
            f"{cure}; in a shuffled order of the same positions it would be {max(self.shuffled, 1.0):.1f} times"
        )


@dataclass(frozen=True)
class SlowRates:
    """What a record says of slow rates: the finished ``fit``, that without slow noise, and the parts of the record.

    ``moved`` is the change of each parameter by a rate of one in each part.
    """

    fit: Fit
    plain: Fit
    bins: RateBins
    contrasts: Contrasts
    moved: Array


def slow_rates(fit: Fit, plain: Fit) -> SlowRates | None:
    """What the joined rows of a record say of slow rates; None for records that :func:`unseen_noise` is not made for.

    Those are records with a doubt about coloured noise, or with a drift or scatter in the uncertainties, given noise levels, a
    stated scatter or coarse counts, and methods other than whitened least squares in one go.
    """
    told = fit.noise.slow > 0.0 or (fit.colour is not None and fit.colour.gain > THRESHOLDS.coloured)
    if not fit.seeks_noise or fit.counted is not None or told or fit.noise.stated:
        return None
    bins = bins_of(fit, coarse=True)
    if bins is None:
        return None
    factor, rows = joined_factor(plain, bins)
    contrasts = contrasts_of(plain, factor, rows, bins)
    moved = moved_by(factor, bins, plain.solution.parameters)
    return None if contrasts is None or moved is None else SlowRates(fit, plain, bins, contrasts, moved)


def unseen_noise(seen: SlowRates | None, coefficients: tuple[Coefficient, ...]) -> UnseenNoise | None:
    """The coloured noise that a record does not exclude; None if it is small or would not widen an interval much.

    Parameters
    ----------
    seen:
        What the record says of slow rates.
    coefficients:
        Those of the result, with combined uncertainties.
    """
    if seen is None:
        return None
    fit, plain, bins, contrasts, moved = seen.fit, seen.plain, seen.bins, seen.contrasts, seen.moved
    walk = 0.0 if bins.point else plain.noise.walk
    profile = ProfileLikelihood.of(
        contrasts, contrasts.turned(walk * RATES["walk"](bins, 0.0)) if walk else None
    )
    expanded = np.array([c.expanded for c in coefficients]) / float(ndtri(0.5 + 0.5 * UNSEEN.confidence))
    white = variances_of(plain.design, plain.solution, plain.solution.covariance) * (
        plain.sample_variance if bins.point else 1.0
    )
    without = (
        np.array([c.std**2 for c in coefficients])
        - variances_of(fit.design, fit.solution, fit.covariance)
        + white
    )
    lost = walk * _shares(plain, moved, RATES["walk"](bins, 0.0))
    seconds = float(np.median(bins.edges[:, -1] - bins.edges[:, 0]))
    worst: UnseenNoise | None = None
    times = [("markov", float(time)) for time in markov_times(bins)]
    for kind, time in (("flicker", 0.0), *times, ("drift", 0.0)):
        rates = RATES[kind](bins, time)
        unit = contrasts.turned(rates)
        per_size = (fit.design.scale_factor * G0) ** 2 / (np.diag(rates).mean() if kind == "drift" else 1.0)
        if profile.excludes(unit, UNSEEN.size**2 * per_size, UNSEEN.confidence):
            continue
        limit = profile.limit(unit, UNSEEN.confidence)
        size = math.sqrt(limit.level / per_size)
        grown, other = (
            np.sqrt(np.maximum(without + limit.level * _shares(plain, one, rates) - limit.replaced * lost, 0.0))
            / expanded
            for one in (moved, moved[:, _shuffled(bins)])
        )
        at = int(grown.argmax())
        if size > UNSEEN.size and grown[at] > max(UNSEEN.growth, 0.0 if worst is None else worst.growth):
            worst = UnseenNoise(
                kind=kind,
                time=time,
                size=size,
                coefficient=coefficients[at].name,
                growth=float(grown[at]),
                shuffled=float(other[at]),
                seconds=seconds,
                longer=math.nan if kind == "markov" else (size / UNSEEN.size) ** 2,
                positions=len(fit.design.run.labels),
            )
    return worst


def _shares(fit: Fit, moved: Array, rates: Array) -> Array:
    """Variances of the coefficients by a covariance of the slow rates."""
    return variances_of(fit.design, fit.solution, moved @ rates @ moved.T)


def _shuffled(bins: RateBins) -> NDArray[np.int64]:
    """Parts of the record if the positions were visited in steps of ``stride``: the same parts of each, at other times."""
    count = bins.edges.shape[0]
    step = max(round(UNSEEN.stride * count), 1)
    while math.gcd(step, count) > 1:
        step += 1
    order = np.argsort((step * np.arange(count)) % count)
    return (bins.size * order[:, None] + np.arange(bins.size)).ravel()
