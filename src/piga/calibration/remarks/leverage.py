"""Leverage: how strongly each segment (position, level) determines the coefficients, and how it moves them.

``B_j`` is the information of segment j and ``g_j`` its score, in coordinates in which the information of all segments is one
(:mod:`piga.calibration.intervals`). Without segment j the parameters change by ``-(1 - B_j)^-1 g_j``, and their covariance is
``(1 - B_j)^-1``. This is exact where the fit is linear, and needs no second reading of the record.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from piga.calibration.intervals import inverse_root, parameter_rows, without_rate
from piga.calibration.joint import JointFit
from piga.calibration.outliers import NORMAL_MEDIAN
from piga.records.calibration.coefficient import Coefficient
from piga.records.calibration.diagnostics import SegmentLeverage
from piga.results import Array

_DETERMINES = 0.9
"""Share of a coefficient's information above which one segment determines it: without it u is three times larger."""
_INFLUENTIAL = 3.0
"""A segment is influential if it shifts a coefficient by more than this many standard uncertainties."""
_MOVED = 1.0
"""The same for a segment whose rate is an outlier among rates that scatter."""
_UNLIKELY = 4.5
"""Least shift in standard deviations of such a shift by noise: 1 in 150 000."""
_MOST_SEGMENTS = 500
"""Most segments for leaving out one at a time."""
_SENTENCES = 4
"""Most sentences of a kind."""
_ALONE = 1e-9
"""Remainder ``1 - B_j`` below which a segment alone has a combination of the parameters."""


def find_leverage(
    fit: JointFit, quiet: JointFit, coefficients: tuple[Coefficient, ...]
) -> tuple[dict[str, SegmentLeverage], tuple[str, ...], tuple[tuple[float, str], ...]]:
    """Leverage of every segment for ``diagnostics``, and sentences about it.

    Parameters
    ----------
    fit, quiet:
        The fit of one run, and the same without the scatter of the positions. If they scatter, all segments move coefficients
        by more than the noise explains. A segment is then named only if its rate is an outlier among the others.
    coefficients:
        The result, with combined standard uncertainties. The shifts of the table and of the sentences are in these.

    Returns
    -------
    tuple
        Leverage by label, sentences on segments that alone determine a coefficient, and sentences on segments that move
        one, each with the shift. The leverages are together the number of parameters; a share is
        ``1 - (u/u_without)^2``. Empty for one segment, and beyond ``_MOST_SEGMENTS``.
    """
    layout, estimate, repetitions = quiet.layout, quiet.estimate, quiet.repetitions(quiet.servo)
    labels = quiet.only.run.labels if quiet.only else ()
    if not 1 < len(labels) <= _MOST_SEGMENTS:
        return {}, (), ()
    local = estimate.phases.size > 1
    at = list(range(layout.size + (0 if local else estimate.phases.size)))
    rows = [parameter_rows(layout, estimate, r, at, local=local) for r in repetitions]
    parts = [without_rate(part, r.variance) for part, r in zip(rows, repetitions, strict=True)]
    inverse = inverse_root(parts, len(at))
    x = np.array([part[:, :-1] @ inverse for part in parts])
    missed = np.array([part[:, -1] for part in parts])
    missed = missed - x @ np.einsum("jka,jk->a", x, missed)
    value, vector = np.linalg.eigh(np.einsum("jka,jkb->jab", x, x))
    score = np.einsum("jab,jka,jk->jb", vector, x, missed)
    root = inverse @ vector
    rest = 1.0 / np.maximum(1.0 - value, _ALONE)
    changes = -np.einsum("jab,jb->ja", root, rest * score)
    kept = [i for i, c in enumerate(coefficients) if c.segment is None]
    common = [coefficients[i] for i in kept]
    std = [_std(quiet, at, one)[kept] for one in np.einsum("jab,jb,jcb->jac", root, rest, root)]
    whole = _std(quiet, at, inverse @ inverse.T)[kept]
    table: dict[str, SegmentLeverage] = {}
    for j, label in enumerate(labels):
        change = np.zeros(layout.size + estimate.phases.size)
        change[at] = changes[j]
        moved, share = quiet.moved(change)[kept], np.maximum(1.0 - (whole / std[j]) ** 2, 0.0)
        only = value[j].max() > 1.0 - _ALONE
        table[label] = SegmentLeverage(
            float(value[j].sum()) + local,
            {c.name: float(own) for c, own in zip(common, share, strict=True)},
            {c.name: None if only else float(own) / c.std for c, own in zip(common, moved, strict=True)},
        )
    named, least = (labels, _INFLUENTIAL) if quiet is fit else (_odd_segments(rows, labels), _MOVED)
    noise = (whole / [c.std for c in common]).tolist()
    return table, *_in_words(table, common, noise, named, least)


def _in_words(
    table: dict[str, SegmentLeverage],
    common: list[Coefficient],
    noise: list[float],
    named: Sequence[str],
    least: float,
) -> tuple[tuple[str, ...], tuple[tuple[float, str], ...]]:
    """Segments that determine a coefficient alone, and those of ``named`` that move one by more than ``least``, beyond noise.

    ``noise``: the part of the noise in the standard uncertainty of each coefficient.
    """
    alone, moving = list[tuple[float, str]](), list[tuple[float, str]]()
    for label, row in table.items():
        sole = [c.name for c in common if row.share[c.name] > _DETERMINES]
        if sole:
            words = (
                f"{', '.join(sole)} {'rests' if len(sole) == 1 else 'rest'} on segment '{label}' alone (more than "
                f"{100.0 * _DETERMINES:.0f} % of the information): no residual shows an error there; "
                "add a position or level like it"
            )
            alone.append((0.0, words))
        for c, part in zip(common, noise, strict=True):
            share, shift = row.share[c.name], row.shift[c.name]
            if label not in named or shift is None or share > _DETERMINES or abs(shift) <= least:
                continue
            usual = part * math.sqrt(share / (1.0 - share))
            if abs(shift) > _UNLIKELY * usual:
                words = (
                    f"without segment '{label}' {c.name} changes by {shift:+.1f} standard uncertainties (noise would "
                    f"explain {usual:.1g}): look at that segment"
                )
                moving.append((abs(shift), words))
    moving.sort(key=lambda item: -item[0])
    return tuple(words for _, words in _few(alone)), tuple(_few(moving))


def _std(fit: JointFit, at: list[int], covariance: Array) -> Array:
    """Standard uncertainties of the coefficients (file units) from the covariance of some parameters."""
    whole = np.zeros((fit.layout.size + fit.estimate.phases.size,) * 2)
    whole[np.ix_(at, at)] = covariance
    return np.array([c.std for c in fit.named(fit.estimate, whole)[0]])


def _odd_segments(rows: Sequence[Array], labels: Sequence[str]) -> tuple[str, ...]:
    """Labels of the segments whose residual rate is far from the others, in terms of their median deviation."""
    rate = np.array(
        [part[:, -2] @ part[:, -1] / max(float(part[:, -2] @ part[:, -2]), 1e-300) for part in rows]
    )
    away = np.abs(rate - np.median(rate))
    odd = away > _UNLIKELY * np.median(away) / NORMAL_MEDIAN
    return tuple(label for label, far in zip(labels, odd, strict=True) if far)


def _few(sentences: list[tuple[float, str]]) -> list[tuple[float, str]]:
    """The first sentences, and the number of those left out."""
    more = len(sentences) - _SENTENCES
    rest = (
        [(sentences[0][0], f"{more} more such remarks: see the leverage of the segments")] if more > 0 else []
    )
    return sentences[:_SENTENCES] + rest
