"""Leverage: how strongly each segment (position, level) determines the coefficients, and how it moves them.

Summaries of segments can be added. To get the estimate without one segment, the others are merged. This is exact and needs
no second reading of the record. (With a phase per segment the step is linear about the estimate.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from piga.calibration.fit import Fit
from piga.calibration.model.identifiability import NAMED_WEIGHT, RANK, term_of
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.solution import (
    Estimate,
    Layout,
    layout_of,
    name_coefficients,
    parameter_rows,
    solve_parts,
)
from piga.calibration.outliers import NORMAL_MEDIAN
from piga.calibration.weights import Positions
from piga.records.calibration import Coefficient, SegmentLeverage
from piga.records.calibration.coefficient import short_way

_DETERMINES = 0.9
"""Share of a coefficient's information above which one segment determines it: without it u is three times larger."""
_INFLUENTIAL = 3.0
"""A segment is influential if it shifts a coefficient by more than this many standard uncertainties."""
_UNLIKELY = 4.5
"""Least shift in standard deviations of such a shift by noise: 1 in 150 000."""
_MOST_SEGMENTS = 500
"""Most segments for leaving out one at a time."""
_SENTENCES = 4
"""Most sentences of a kind."""


@dataclass(frozen=True)
class _JackknifeFit:
    """Coefficients (values and Type A standard uncertainties) without one segment; names of those lost."""

    values: dict[str, float]
    std: dict[str, float]
    lost: frozenset[str]


def find_leverage(
    fit: Fit,
    coefficients: tuple[Coefficient, ...],
    slow: bool,
    reported: dict[str, float],
) -> tuple[dict[str, SegmentLeverage], tuple[str, ...], tuple[tuple[float, str], ...]]:
    """Leverage of every segment for ``diagnostics``, and sentences about it.

    Parameters
    ----------
    fit:
        The finished fit.
    coefficients:
        The result, with combined standard uncertainties without slow noise.
    slow:
        True if there is slow noise. All segments then move coefficients by more than the angle noise explains. A
        segment is named only if its rate is an outlier among the others.
    reported:
        Reported standard uncertainty of each coefficient. The shifts of the table and of the sentences are in its units.

    Returns
    -------
    tuple
        Leverage by label, sentences on segments that alone determine a coefficient, and sentences on segments that move
        one, each with the shift. The leverages are together the number of parameters; a share is
        ``1 - (u/u_without)^2``. Empty for one segment, and beyond ``_MOST_SEGMENTS``.
    """
    labels = fit.design.run.labels
    if not 1 < len(labels) <= _MOST_SEGMENTS:
        return {}, (), ()
    layout, linear = layout_of(fit.design), fit.design.has_phases
    parts = _amplitude_parts(layout, fit) if linear else fit.summaries
    common = [c for c in coefficients if c.segment is None]
    whole = _named(fit, layout, Reduction.stacked(parts), linear)
    table: dict[str, SegmentLeverage] = {}
    for label, traced, rest in zip(labels, leverages(parts), all_but_one(parts), strict=True):
        left = _named(fit, layout, rest, linear)
        table[label] = SegmentLeverage(traced + (1.0 if linear else 0.0), *_influence(common, whole, left))
    alone, named = _sole_words(table, common), _odd_segments(fit) if slow else labels
    unit = "standard uncertainties" + (f" by the noise of the {fit.design.run.quantity}" if slow else "")
    moved = _shift_words({k: table[k] for k in named}, common, whole, unit, reported)
    for row in table.values():
        for c in common:
            shift = row.shift.get(c.name)
            if shift is not None and c.std != reported[c.name]:
                row.shift[c.name] = shift * (c.std / reported[c.name])
    return table, alone, moved


def _odd_segments(fit: Fit) -> tuple[str, ...]:
    """Labels of the segments whose residual rate is far from the others, in terms of their median deviation."""
    m, size = len(fit.design.names), len(fit.design.run.labels)
    product, square = np.zeros(size), np.zeros(size)
    for part, segment in zip(fit.positions, Positions.of(fit.design.run).segments.tolist(), strict=True):
        y = part.factor[:, -1] - part.factor[:, :m] @ fit.solution.values[segment]
        product[segment] += part.factor[:, m] @ y
        square[segment] += part.factor[:, m] @ part.factor[:, m]
    rate = np.divide(product, square, out=np.zeros(size), where=square > 0.0)
    away = np.abs(rate - np.median(rate))
    odd = away > _UNLIKELY * np.median(away) / NORMAL_MEDIAN
    return tuple(label for label, far in zip(fit.design.run.labels, odd, strict=True) if far)


def _amplitude_parts(layout: Layout, fit: Fit) -> list[Reduction]:
    """Summaries over the amplitudes, the phase of each segment taken out; observed is the residual."""
    names = tuple(name for name, _ in layout.amplitude_keys)
    parts = []
    for segment, summary in enumerate(fit.summaries):
        rows = summary.factor.copy()
        rows[:, -1] -= rows[:, :-1] @ fit.solution.values[segment]
        own = parameter_rows(fit.design, fit.solution, segment, rows)
        parts.append(Reduction.of_rows(names, own, len(own)))
    return parts


def all_but_one(parts: list[Reduction]) -> list[Reduction]:
    """For each part, the merger of all other parts; running mergers from both ends."""
    before = [Reduction.empty(parts[0].names)]
    for part in parts[:-1]:
        before.append(Reduction.stacked([before[-1], part]))
    mergers, after = [], Reduction.empty(parts[0].names)
    for part, first in zip(reversed(parts), reversed(before), strict=True):
        mergers.append(Reduction.stacked([first, after]))
        after.merge(part)
    return mergers[::-1]


def leverages(parts: list[Reduction]) -> list[float]:
    """Trace of each part's information in the total."""
    covariance = Reduction.stacked(parts).solve()[1]
    factors = [part.factor[:, :-1] for part in parts]
    return [float(np.einsum("ij,jk,ik->", f, covariance, f)) for f in factors]


def _lost(total: Reduction) -> frozenset[str]:
    """Terms of the directions in which a summary contains no information."""
    factor = total.factor[:-1, :-1]
    norms = np.linalg.norm(factor, axis=0)
    lost = {term_of(name) for name, norm in zip(total.names, norms, strict=True) if norm == 0.0}
    _, singular, right = np.linalg.svd(factor / np.where(norms > 0.0, norms, 1.0))
    for direction in np.abs(right[singular <= RANK * singular[0]]):
        lost |= {
            term_of(n)
            for n, w in zip(total.names, direction, strict=True)
            if w > NAMED_WEIGHT * direction.max()
        }
    return frozenset(lost | ({"phi"} if "tan_beta" in lost else set()))


def _named(fit: Fit, layout: Layout, total: Reduction, linear: bool) -> _JackknifeFit:
    """Coefficients of a merger; ``linear``: the merger contains corrections of the amplitudes."""
    lost = _lost(total)
    if lost:
        return _JackknifeFit({}, {}, lost)
    if linear:
        change, covariance, _ = total.solve()
        padded = np.zeros_like(fit.solution.covariance)
        padded[: layout.size, : layout.size] = covariance
        estimate: Estimate = replace(
            fit.solution, amplitudes=fit.solution.amplitudes + change, covariance=padded
        )
    else:
        estimate = solve_parts(replace(layout, tails=layout.tails[:1]), [total])
    named, _ = name_coefficients(fit.design, estimate, estimate.covariance)
    common = [c for c in named if c.segment is None]
    return _JackknifeFit({c.name: c.value for c in common}, {c.name: c.std for c in common}, lost)


def _influence(
    common: list[Coefficient], whole: _JackknifeFit, left: _JackknifeFit
) -> tuple[dict[str, float], dict[str, float | None]]:
    """Share and shift of each coefficient."""
    share: dict[str, float] = {}
    shift: dict[str, float | None] = {}
    for c in common:
        if c.name in left.lost:
            share[c.name], shift[c.name] = 1.0, None
        elif left.lost:
            share[c.name], shift[c.name] = 0.0, None
        else:
            change = left.values[c.name] - whole.values[c.name]
            change = float(short_way(change)) if c.name == "phi" else change
            share[c.name] = max(0.0, 1.0 - (whole.std[c.name] / left.std[c.name]) ** 2)
            shift[c.name] = change / c.std
    return share, shift


def _sole_words(table: dict[str, SegmentLeverage], common: list[Coefficient]) -> tuple[str, ...]:
    """Segments that determine a coefficient alone."""
    sentences = []
    for label, row in table.items():
        sole = [c.name for c in common if row.share[c.name] > _DETERMINES]
        if sole:
            verb = "rests" if len(sole) == 1 else "rest"
            sentences.append(
                f"{', '.join(sole)} {verb} on segment '{label}' alone (more than "
                f"{100.0 * _DETERMINES:.0f} % of the information): no residual shows an error there; "
                "add a position or level like it"
            )
    return _few(sentences)


def _shift_words(
    table: dict[str, SegmentLeverage],
    common: list[Coefficient],
    whole: _JackknifeFit,
    unit: str,
    reported: dict[str, float],
) -> tuple[tuple[float, str], ...]:
    """Segments that move a coefficient by more than noise would, each with the shift in reported uncertainties."""
    sentences: list[tuple[float, float, str]] = []
    for label, row in table.items():
        for c in common:
            share, shift = row.share[c.name], row.shift[c.name]
            if shift is None or share > _DETERMINES or abs(shift) <= _INFLUENTIAL:
                continue
            usual = whole.std[c.name] * math.sqrt(share / (1.0 - share)) / c.std
            if abs(shift) > _UNLIKELY * usual:
                words = (
                    f"without segment '{label}' {c.name} changes by {shift:+.1f} {unit} (noise would "
                    f"explain {usual:.1g}): look at that segment"
                )
                sentences.append((abs(shift), abs(shift) * c.std / reported[c.name], words))
    sentences.sort(key=lambda item: -item[0])
    largest = max((shift for _, shift, _ in sentences), default=0.0)
    few = _few([words for *_, words in sentences])
    shifts = [shift for _, shift, _ in sentences[:_SENTENCES]] + [largest]
    return tuple(zip(shifts, few, strict=False))


def _few(sentences: list[str]) -> tuple[str, ...]:
    """The first sentences, and the number of those left out."""
    more = len(sentences) - _SENTENCES
    rest = (f"{more} more such remarks: see the leverage of the segments",) if more > 0 else ()
    return (*sentences[:_SENTENCES], *rest)
