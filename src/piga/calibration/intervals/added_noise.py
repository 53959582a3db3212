"""Noise that is in the covariance of a run but not in its weights, for a joint calibration.

The weights W are those of the significant noise; the estimate is ``A^-1 X'W y``. Further noise of covariance ``v B B'``
adds ``v A^-1 (X'W B)(X'W B)' A^-1`` to the covariance, where A is the information of all runs together. ``X'W B`` of
a run, its *scores*, is a small matrix. It does not depend on the other runs (own derivation, docs/theory).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from piga.calibration.fit.one_run import Colour, Fit, whitened_rows, without_slow
from piga.calibration.intervals.faint_walk import include_faint_walk
from piga.calibration.model.design import Design
from piga.calibration.noise.components import RATES, RateBins
from piga.calibration.noise.levels import Noise
from piga.calibration.noise.settings import NOISE
from piga.calibration.noise.slow_bases import BesideStated, DriftBasis, NoiseColumns, SegmentBasis
from piga.calibration.noise.weighting import reduce_segments

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AddedNoise:
    """A noise that is in the covariance only: its variance (may be negative), the uncertainty of that, and its scores.

    ``scores`` (m, K) per phase group, for unit variance. ``together``: True if one noise acts on all groups, False if each
    group has its own. ``shared`` is the covariance of its variance with that of the noise before it. ``gain`` is the gain of
    twice the log-likelihood by the coloured noise of the run; 0 for other noise. ``otherwise``: True if the noise counts
    only where the coloured noise of the run does not.
    """

    name: str
    variance: float
    deviation: float
    together: bool
    scores: tuple[Array, ...] = field(repr=False)
    shared: float = 0.0
    gain: float = 0.0
    otherwise: bool = False

    def select(self, held: tuple[str, ...], columns: tuple[str, ...]) -> AddedNoise:
        """The noise for some of the columns."""
        at = [held.index(name) for name in columns]
        return replace(self, scores=tuple(part[at] for part in self.scores))

    def mixed(self, matrices: list[Array]) -> AddedNoise:
        """The noise for combinations of the columns: ``matrices`` (m, wanted) of the phase groups."""
        return replace(
            self, scores=tuple(matrix.T @ part for matrix, part in zip(matrices, self.scores, strict=True))
        )

    def scaled(self, information: float) -> AddedNoise:
        """The noise for rows with ``information`` times the weight."""
        return replace(self, scores=tuple(part * information for part in self.scores))

    def per_unit(self, jacobians: list[Array]) -> Array:
        """Sum of ``J' S S' J``, where J are the derivatives of the column coefficients in each group by the parameters."""
        moved = [jacobian.T @ part for jacobian, part in zip(jacobians, self.scores, strict=True)]
        whole = sum(moved) if self.together else np.hstack(moved)
        added: Array = whole @ np.transpose(whole)
        return added


def added_noise(fit: Fit, design: Design) -> tuple[AddedNoise, ...]:
    """The noise that is in the covariance of a fit but not in its weights, for the columns of ``design``."""
    noises = []
    if fit.slow_part is not None:
        drifting = fit.noise.drift > 0.0
        basis = DriftBasis.of(design.run) if drifting else SegmentBasis.of(design.run)
        scores = _grouped(
            _slow_scores(fit, design, basis, np.sqrt(basis.unit()) * np.eye(basis.count)), design.groups
        )
        name = "drift" if drifting else "scatter"
        noises.append(AddedNoise(name, fit.noise.slow, fit.slow_deviation, True, scores))
    if fit.colour is not None:
        noises += _coloured(fit, fit.colour, design)
        plain = include_faint_walk(without_slow(fit))
        noises += [replace(noise, otherwise=True) for noise in _faint(plain, design)]
    return (*noises, *_faint(fit, design))


def _faint(fit: Fit, design: Design) -> list[AddedNoise]:
    """A random walk that is not significant; empty without one."""
    if fit.faint is None:
        return []
    deviation = float(np.sqrt(np.linalg.inv(fit.faint.information)[1, 1]))
    scores = _walk_scores(design, fit.mode, fit.weights, NOISE.degrees_probe * deviation)
    return [AddedNoise("walk", fit.faint.walk - fit.noise.walk, deviation, False, scores)]


def _coloured(fit: Fit, colour: Colour, design: Design) -> list[AddedNoise]:
    """The likeliest coloured noise, and what it changes in the random walk."""
    bins = RateBins.of(design.run)
    root = _root(RATES[colour.name](bins, colour.time))
    weight = 1.0 / fit.sample_variance if fit.mode == "samples" else 1.0
    scores = tuple(weight * part for part in _grouped(_slow_scores(fit, design, bins, root), design.groups))
    noises = [AddedNoise(colour.name, colour.variance, colour.deviation, True, scores, gain=colour.gain)]
    if not bins.point:
        walk = _grouped(_slow_scores(fit, design, bins, _root(RATES["walk"](bins, 0.0))), design.groups)
        deviation, shared = colour.walk_deviation, colour.walk_shared
        noises.append(AddedNoise("walk", colour.walk, deviation, True, walk, shared, colour.gain))
    return noises


def _grouped(parts: list[Array], groups: tuple[int, ...]) -> tuple[Array, ...]:
    """Sums over the segments of every phase group."""
    return tuple(
        np.sum([part for part, own in zip(parts, groups, strict=True) if own == group], axis=0)
        for group in range(max(groups) + 1)
    )


def _slow_scores(fit: Fit, design: Design, basis: NoiseColumns, root: Array) -> list[Array]:
    """``X'W B`` (m, k) of every segment for unit slow noise; ``root`` (count, k) is that of the covariance of its numbers.

    If the weights include a stated scatter ``d b b'`` of a segment, ``W = V^-1 - V^-1 b b' V^-1 / (1/d + b' V^-1 b)``.
    """
    m, stated = len(design.names), fit.weights.stated if fit.counted is None else ()
    wide: NoiseColumns = BesideStated(SegmentBasis.of(design.run), basis) if stated else basis
    products = [np.zeros((m + wide.size, wide.size)) for _ in design.run.labels]
    for segment, columns in whitened_rows(fit, design, fit.weights, wide):
        products[segment] += columns[:-1] @ columns[m:-1].T
    scores = []
    for segment, product in enumerate(products):
        if stated:
            own = product[:, 0] / (1.0 / max(stated[segment], 1e-300) + product[m, 0])
            weighted = product[:m, 1:] - np.outer(own[:m], product[m, 1:])
        else:
            weighted = product[:m]
        scores.append(basis.placed(weighted, segment) @ root)
    return scores


def _walk_scores(design: Design, mode: str, noise: Noise, probe: float) -> tuple[Array, ...]:
    """A root of ``X'W H W X`` (m, m) of every group; H is the covariance of unit walk. It is minus d(``X'W X``)/d(walk)."""
    m = len(design.names)
    near = [
        _grouped([part.factor[:, :m].T @ part.factor[:, :m] for part in parts], design.groups)
        for parts in (
            reduce_segments(design, mode, replace(noise, walk=noise.walk + moved)) for moved in (probe, -probe)
        )
    ]
    return tuple(_root((below - above) / (2.0 * probe)) for above, below in zip(*near, strict=True))


def _root(matrix: Array) -> Array:
    """S with ``S S'`` equal to a positive semidefinite matrix; the diagonal is scaled to one for the computation."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    scale[scale == 0.0] = 1.0
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    root: Array = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return root
