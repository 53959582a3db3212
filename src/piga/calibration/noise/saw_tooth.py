"""The saw-tooth of coarse counts along the path of a record: its waves, how it is correlated, whether it is white.

The waves ``exp(2 pi i m alpha/c)`` are summed over the bins of every stretch
(:class:`~piga.calibration.noise.stretches.Stretch`) once for a path. Their covariance follows from them for any random walk.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga._kernels.estimation.counting import add_waves, saw_tooth_covariance
from piga.calibration.model.design import Block, Design
from piga.calibration.model.solution import Solution
from piga.calibration.noise.stretches import Stretch, angle_pieces

Array = NDArray[np.float64]

HARMONICS = 8
"""Harmonics of the saw-tooth that white noise damps one by one."""
FINE, SHORT = 24, 10_000
"""Harmonics followed in stretches up to so many samples (else those above); the rest counts as white."""
SLOW, FINEST = 4.0, 96
"""Counts in a stretch up to which so many harmonics of the saw-tooth are followed."""
MOST_DAMPED = 0.5
"""Damping by the errors of the estimate that is taken out at most, as a share of that by the random walk."""
GROUPS, EVEN, RARE = 4, 0.6, 7.0
"""Slow to fast groups of contrasts in which the mean power of the saw-tooth over that of white noise is looked at, by
how much it may differ from one there, and how much of it any contrast may have beyond the logarithm of their number
(it is exponentially distributed)."""
LOOKED = 160
"""Contrasts in all stretches together that are looked at, where the stretches have as many."""


@dataclass(frozen=True)
class SawTooth:
    """The saw-tooth along the path of a stretch: sums over bins of cosines and sines (M, bins) of its harmonics."""

    stretch: Stretch
    count: float
    cosines: Array
    sines: Array

    @classmethod
    def of(cls, stretch: Stretch, count: float) -> SawTooth:
        """Nothing gathered yet."""
        followed = FINE if stretch.size <= SHORT else HARMONICS
        if stretch.span < SLOW * count:
            followed = FINEST
        shape = (followed, stretch.time.size)
        return cls(stretch, count, np.zeros(shape), np.zeros(shape))

    @property
    def power(self) -> Array:
        """Variance of each harmonic (M,) [rad^2]."""
        found: Array = self.count**2 / (2.0 * np.pi**2 * np.arange(1.0, len(self.cosines) + 1.0) ** 2)
        return found

    def covariance(self, walk: float, spread: float) -> Array:
        """Covariance of the contrasts by each harmonic, and all others (HARMONICS + 1, K, K) [rad^2].

        The path wanders by a random walk of ``walk`` [counts^2/s]: what is out of phase by then is not correlated. A
        line along it is uncertain by a further ``spread`` [counts^2] at the ends against each other; a negative one
        takes away damping that is already in the path. Harmonics beyond those followed are white.
        """
        stretch, phi, bins = self.stretch, self.stretch.contrasts, self.stretch.time.size
        times = stretch.mean(stretch.time)
        ramp = times / (stretch.limits[1] - stretch.limits[0])
        found = np.zeros((HARMONICS + 1, bins, bins))
        cosines, sines = stretch.mean(self.cosines), stretch.mean(self.sines)
        saw_tooth_covariance(cosines, sines, self.power, times, ramp, walk, spread, found)
        rest = self.count**2 / 12.0 - float(self.power.sum())
        found[-1].flat[:: bins + 1] += rest / np.diff(stretch.edges)
        return phi @ found @ phi.T

    def over_white(self) -> Array:
        """Power of the harmonics followed in each contrast (K,), over that of white noise of the same variance."""
        stretch, phi = self.stretch, self.stretch.contrasts
        waves = [phi @ stretch.mean(part).T for part in (self.cosines, self.sines)]
        white = (phi**2 / np.diff(stretch.edges)).sum(axis=1) * self.power.sum()
        return sum(wave**2 @ self.power for wave in waves) / white


def follow(design: Design, stretches: list[Stretch], count: float, values: Array) -> list[SawTooth]:
    """The saw-tooth of every stretch along the path that column coefficients ``values`` (segments, m) give."""
    found = {stretch.start: SawTooth.of(stretch, count) for stretch in stretches}
    output = design.run.output
    for stretch, first, rows, residual in angle_pieces(stretches, _residuals(design, values)):
        tooth = found[stretch.start]
        turned = (output[rows] - output[stretch.start] - residual) / count
        add_waves(turned, first, stretch.edges, tooth.cosines, tooth.sines)
    return list(found.values())


def _residuals(design: Design, values: Array) -> Iterator[tuple[Block, Array]]:
    """Blocks with their observed less modelled increments."""
    for block in design.blocks():
        yield block, block.columns[-1] - values[block.segment] @ block.columns[:-1]


def looks_white(teeth: list[SawTooth]) -> bool:
    """True where the saw-tooth along its path has the power that white noise has in slow and fast contrasts alike."""
    over = np.stack([tooth.over_white()[:-1] for tooth in teeth])
    even = all(abs(part.mean() - 1.0) < EVEN for part in np.array_split(over, GROUPS, axis=1))
    return bool(even and over.max() < RARE + math.log(over.size))


def counting_covariances(
    teeth: list[SawTooth], solution: Solution, groups: tuple[int, ...], walk: float, spread: float
) -> Array:
    """Covariances (HARMONICS + 1, S, K, K) by the counting along a path [rad^2].

    ``walk`` [rad^2/s] is the random walk, ``spread`` [counts] what the path is uncertain by beside the solution.
    """
    found = []
    for tooth in teeth:
        error = spread**2 - _damped(tooth.stretch, solution, groups, walk) / tooth.count**2
        found.append(tooth.covariance(walk / tooth.count**2, error))
    return np.stack(found, axis=1)


def _damped(stretch: Stretch, solution: Solution, groups: tuple[int, ...], walk: float) -> float:
    """Variance [rad^2] by which waves along the estimated path are damped already, on average."""
    jacobian = solution.jacobians[groups[stretch.segment]]
    far = stretch.end[:-1]
    damped = float(far @ (jacobian @ solution.covariance @ jacobian.T) @ far)
    return min(damped, MOST_DAMPED * walk * float(stretch.limits[1] - stretch.limits[0]))
