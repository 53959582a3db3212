"""The components of the noise of a record: their meaning, their rules, and their covariance on the slow rates.

The slow rates are the means of the rate over a few parts of every segment (:class:`RateBins`). A component is a
covariance of these rates; :mod:`piga.calibration.noise.likelihood` estimates its level. All differences between the
components are in this table. To add a component, add a row with its covariance.

The rules say when the program searches for a component, and from which gain it enters covariance and weights.
``python -m piga.calibration.noise.components`` prints the table of docs/theory/noise.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from piga.calibration.noise.settings import NOISE
from piga.records.run import Run
from piga.results import Array


@dataclass(frozen=True)
class RateBins:
    """The rate has one value in each of ``size`` parts of every segment; ``edges`` (segments, size + 1) [s]."""

    edges: Array = field(repr=False)
    point: bool = False

    @classmethod
    def of(cls, run: Run, *, coarse: bool = False) -> RateBins:
        """Parts for one run: some ``colour_bins`` in all segments together; more where they are longer than ``colour_part``.

        ``coarse``: not more, for the quick test of a long record.
        """
        limits = run.segment_edges()
        count = limits.size - 1
        longest = float(np.max(run.t[limits[1:] - 1] - run.t[limits[:-1]]))
        wanted = 0 if coarse else min(math.ceil(longest / NOISE.colour_part), NOISE.colour_bins_long // count)
        size = int(np.clip(max(NOISE.colour_bins // count, wanted), 2, NOISE.colour_most))
        edges = [np.linspace(float(run.t[a]), float(run.t[b - 1]), size + 1) for a, b in pairwise(limits)]
        return cls(np.array(edges), run.kind == "rate")

    @property
    def size(self) -> int:
        """Parts of a segment."""
        return self.edges.shape[1] - 1

    @property
    def count(self) -> int:
        """Parts of all segments."""
        return self.edges.shape[0] * self.size

    @property
    def widths(self) -> Array:
        """Duration of each part (count,) [s]."""
        return np.diff(self.edges).ravel()

    @property
    def middles(self) -> Array:
        """Middle of each part (count,), from the middle of the record [s]."""
        middle = 0.5 * (self.edges[:, 1:] + self.edges[:, :-1]).ravel()
        return np.asarray(middle - 0.5 * (self.edges[0, 0] + self.edges[-1, -1]))

    @property
    def span(self) -> float:
        """Duration of the record [s]."""
        return float(self.edges[-1, -1] - self.edges[0, 0])

    def _limits(self, t: Array) -> tuple[Array, Array]:
        own = np.maximum(np.searchsorted(self.edges[:, 0], t, side="right") - 1, 0)
        return self.edges[own, :-1].T, self.edges[own, 1:].T

    def angle(self, t: Array) -> Array:
        """Angle (size, n) at the times ``t`` (n,) since the beginning of the segment if the rates are one."""
        low, high = self._limits(t)
        angle: Array = np.clip(t - low, 0.0, high - low)
        return angle

    def increments(self, t: Array, h: Array) -> Array:
        """Columns (size, n) of the increments that end at ``t`` and last ``h``; of samples for a rate log."""
        if self.point:
            low, high = self._limits(t)
            inside = (t >= low) & (t < high)
            inside[-1] |= t >= high[-1]
            return np.asarray(inside * (h > 0.0), dtype=float)
        formed = h > 0.0
        columns: Array = (self.angle(t) - self.angle(t - h * formed)) * formed
        return columns

    def placed(self, factor: Array, segment: int) -> Array:
        """The columns of a segment among those of all segments."""
        own = np.zeros((len(factor), self.count))
        own[:, segment * self.size : (segment + 1) * self.size] = factor[:, : self.size]
        return np.hstack([own, factor[:, self.size :]])


@dataclass(frozen=True)
class Component:
    """A component of the noise.

    ``unit`` is the unit of its level. The rules of the search: :mod:`piga.calibration.noise.components`.
    """

    name: str
    meaning: str
    unit: str


def _walk(bins: RateBins, _time: float) -> Array:
    """White rate noise: independent means."""
    return np.diag(1.0 / bins.widths)


def _markov(bins: RateBins, time: float) -> Array:
    """First-order Markov rate noise of unit variance: means of ``exp(-lag/time)`` over pairs of parts."""
    x = bins.widths / time
    grown = np.log(-np.expm1(-x) / x) + 0.5 * x
    lag = np.abs(np.subtract.outer(bins.middles, bins.middles)) / time
    covariance = np.exp(np.minimum(np.add.outer(grown, grown) - lag, 0.0))
    covariance[np.diag_indices(x.size)] = _own(x)
    result: Array = covariance
    return result


def _own(x: Array) -> Array:
    """Variance of the mean of a unit Markov process over ``x`` correlation times: ``2 (x - 1 + exp(-x))/x^2``."""
    small = x < 1e-3
    size = np.where(small, 1.0, x)
    return np.where(small, 1.0 - x / 3.0, 2.0 * (size + np.expm1(-size)) / size**2)


def _flicker(bins: RateBins, _time: float) -> Array:
    """1/f rate noise of unit variance in a decade: Markov processes, ``per_decade`` a decade, up to the record."""
    shortest = float(np.median(bins.widths)) / 3.0
    count = math.ceil(NOISE.per_decade * math.log10(bins.span / shortest)) + 1
    times = bins.span * 10.0 ** (-np.arange(count) / NOISE.per_decade)
    total: Array = sum((_markov(bins, float(time)) for time in times), start=np.zeros((bins.count,) * 2))
    return total / NOISE.per_decade


def _drift(bins: RateBins, _time: float) -> Array:
    """Random walk of the rate from the middle of the record."""
    t = bins.middles
    together: Array = np.minimum.outer(np.abs(t), np.abs(t)) * (np.multiply.outer(t, t) > 0.0)
    return together


def _scatter(bins: RateBins, _time: float) -> Array:
    """A rate of its own in every segment."""
    return np.asarray(np.kron(np.eye(bins.edges.shape[0]), np.ones((bins.size, bins.size))))


COMPONENTS = {
    component.name: component
    for component in (
        Component("white", "white noise of the angle, or of the samples of a rate log", "rad²"),
        Component("walk", "white noise of the rate: the angle walks", "rad²/s"),
        Component("counting", "the angle is read in whole counts", "rad²"),
        Component("flicker", "1/f noise of the rate", "rad²/s² a decade"),
        Component("markov", "noise of the rate that is forgotten within a time", "rad²/s²"),
        Component("drift", "random walk of the rate", "rad²/s³"),
        Component("scatter", "each segment has a rate of its own", "rad²/s²"),
    )
}
"""The components of the noise of a record, in the order of the rules."""

Rates = Callable[[RateBins, float], Array]
RATES: dict[str, Rates] = {
    "walk": _walk,
    "flicker": _flicker,
    "markov": _markov,
    "drift": _drift,
    "scatter": _scatter,
}
"""Covariance of the slow rates by a unit of a component, for a correlation time [s] that only ``markov`` has."""


def markov_times(bins: RateBins) -> Array:
    """Correlation times to try [s]: from a third of a part to ``colour_longest`` of the record."""
    shortest, longest = float(np.median(bins.widths)) / 3.0, NOISE.colour_longest * bins.span
    count = max(int(math.log(longest / shortest) / math.log(NOISE.colour_spacing)) + 1, 1)
    return np.asarray(shortest * NOISE.colour_spacing ** np.arange(count))


ALWAYS, NEVER = "always", "never"


@dataclass(frozen=True)
class Rule:
    """When a component is searched for and used. Gains are those of twice the log-likelihood.

    ``looked_for``: the records in which it is searched for. ``covariance``, ``weights``: the gain from which it enters them.
    ``evidence``: the source of the numbers.
    """

    component: str
    looked_for: str
    covariance: str
    weights: str
    evidence: str


def _over(gain: float) -> str:
    return f"gain above {gain:g}"


RULES = (
    Rule("white", "every record", ALWAYS, ALWAYS, "by definition"),
    Rule(
        "walk",
        "angle logs",
        f"always, of either sign; up to {NOISE.restricted_rows} increments",
        _over(NOISE.walk_in_weights),
        "scenarios `white`, `faint`: 93.7 % with a limit of zero, 95 % without",
    ),
    Rule(
        "counting",
        f"white noise below {NOISE.counting_white:g} and walk below {NOISE.counting_walk:g} squared counts",
        ALWAYS,
        ALWAYS,
        "scenarios `coarse`, `mix`",
    ),
    Rule(
        "flicker",
        f"{NOISE.colour_least} increments a part, up to {NOISE.most_segments} segments",
        f"{_over(NOISE.colour_in_covariance)}, {NOISE.colour_ahead:g} ahead of drift and scatter",
        NEVER,
        "scenarios `head-flicker`, `rate-flicker`; sound records: one in twenty",
    ),
    Rule("markov", "as flicker", "as flicker", NEVER, "scenarios `head-markov`, `rate-markov`"),
    Rule(
        "drift",
        "angle logs; in rate logs as flicker",
        _over(NOISE.slow_in_covariance),
        f"{_over(NOISE.slow_in_weights)}; never beside counts",
        "scenario `drift`; weights for a drift that is not there cost six times the variance",
    ),
    Rule(
        "scatter",
        f"{NOISE.fewest_segments} to {NOISE.most_segments} segments; in rate logs as flicker",
        _over(NOISE.slow_in_covariance),
        f"{_over(NOISE.slow_in_weights)}; never beside counts",
        "scenario `scatter`",
    ),
)


def table() -> str:
    """The components and their rules as Markdown."""
    lines = [
        "| component | what it is | level | looked for in | in the covariance | in the weights | evidence |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for rule in RULES:
        part = COMPONENTS[rule.component]
        cells = (
            part.name,
            part.meaning,
            part.unit,
            rule.looked_for,
            rule.covariance,
            rule.weights,
            rule.evidence,
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(table())
