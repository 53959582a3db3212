"""Intervals by the scatter of positions: repeat the measurement and take the scatter.

The positions of a test are its repetitions. The standard uncertainty of a combination c of the parameters is that of the
bias-reduced sandwich [Bell2002] over the positions, with Satterthwaite's degrees of freedom; the interval uses Student's t.
No model of the noise enters, except in the weights. A position that alone determines a coefficient shows no
scatter of it: the record is refused, by name.

If positions scatter more than white noise and walk predict, the excess may also change slowly from position to position. The
standard uncertainty then grows by a factor that is a number of the plan: 1/f noise at the times of the positions moves the
coefficient by more than the residual rates show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from piga.calibration.model.design import Design
from piga.calibration.model.reduction import Reduction, triangle
from piga.calibration.model.solution import Estimate, Layout
from piga.calibration.weights import Noise, count_of, rate_share, root_mean_square
from piga.errors import IdentifiabilityError
from piga.records.calibration.coefficient import Level, Number
from piga.records.calibration.diagnostics import Diagnostics
from piga.results import Array
from piga.units import G0

_ALONE = 1e-3
"""Largest remainder ``1 - leverage`` of a position that counts as determining a combination alone."""
_CONCERNED = 1e-2
"""Share of a coefficient's variance in such a combination from which on the coefficient is refused."""
_SHARE = 1e-3
"""Addition to the variance of a position in its weight, relative to the mean."""
_EXCESS = 0.05
"""Probability of the F test below which the positions scatter more than noise within them predicts."""
_SPACING = 0.5
"""Distance of the correlation times that make 1/f noise [decades]."""
_BETWEEN = 0.01
"""Probability of the F test below which runs scatter more than the positions within them."""
_SHORTEST = 6.0
"""Positions per shortest of these times."""
_FEWEST_SEGMENTS = 4
"""Fewest segments whose scatter is told."""


@dataclass(frozen=True)
class Repetition:
    """One position: a repetition of the measurement.

    ``part`` is its triangle ``[columns of its phase group | rate | y]`` of whitened rows, without scatter. ``variance`` is that
    of its rate, and ``stated`` the part of it that the run file states. ``begin`` and ``end`` [s] are its times. ``run`` is the
    number of its run; slow changes connect positions of one run only. ``block``: it is a part of a continuous record.
    """

    part: Reduction
    group: int
    variance: Level
    name: str
    begin: Number
    end: Number
    run: int = 0
    block: bool = False
    stated: Level = 0.0


@dataclass(frozen=True)
class Interval:
    """Covariance of the internal parameters ``[amplitudes, phases]`` of an estimate, and their degrees of freedom.

    ``growth`` is the factor of the order of the positions on each standard uncertainty. ``excess`` is the scatter of the mean
    rates over what white noise and walk predict (a ratio of variances); nan if unknown.
    """

    covariance: Array
    degrees: Array
    growth: Array
    excess: float


class LeverageError(IdentifiabilityError):
    """One position alone determines a coefficient; ``position`` is its name."""

    position: str = ""


def find_interval(
    layout: Layout, estimate: Estimate, repetitions: Sequence[Repetition], *, stated: bool = False
) -> Interval:
    """Covariance and degrees of freedom of an estimate by the scatter of its repetitions.

    Standard uncertainties are those of the rule, correlations those of the weights. A phase that one position alone has is
    local: it is taken out of the position's rows, and its standard uncertainty is that of these rows. ``stated``: the run
    file states a scatter of the positions; the larger expanded uncertainty of model and rule then counts.

    Raises
    ------
    LeverageError
        If one position alone determines a coefficient.
    """
    from scipy.special import stdtrit

    size, members = layout.size, np.bincount([r.group for r in repetitions], minlength=estimate.phases.size)
    common = [g for g in range(estimate.phases.size) if members[g] > 1]
    at = [*range(size), *(size + g for g in common)]
    words = [name if run is None else f"{name}[{run}]" for name, run in layout.amplitude_keys] + ["phi"] * len(
        common
    )
    rows = [
        parameter_rows(layout, estimate, r, at, local=layout.coupled and members[r.group] == 1)
        for r in repetitions
    ]
    variances = [r.variance for r in repetitions]
    scattered = [without_rate(part, variance) for part, variance in zip(rows, variances, strict=True)]
    u, degrees = sandwich(scattered, repetitions, words)
    excess, probability, slow = _order(rows, repetitions)
    growth = np.ones(u.size)
    if slow is not None and probability < _EXCESS:
        growth = np.sqrt(1.0 + (slow**2 - 1.0) * (1.0 - 1.0 / excess))
    wide, few = np.zeros_like(u), degrees
    if len({r.run for r in repetitions}) > 1:
        wide, few = _between_runs(scattered, repetitions, u, degrees)
    u, degrees = np.maximum(u * growth, wide), np.where(wide > u * growth, few, degrees)
    model = np.sqrt(np.maximum(np.diag(estimate.inverse), 0.0))
    rest = triangle(np.vstack(scattered))[-1, -1] ** 2 / max(sum(r.part.count for r in repetitions) - u.size, 1)
    scale = max(float(rest), 1.0)
    whole = model * np.sqrt(scale)
    freedom, grown = np.full(model.size, np.inf), np.ones(model.size)
    whole[at], freedom[at], grown[at] = u, degrees, growth
    if stated:
        smaller = stdtrit(np.minimum(freedom, 1e9), 0.975) * whole < stdtrit(1e9, 0.975) * model
        whole, freedom = np.where(smaller, model, whole), np.where(smaller, np.inf, freedom)
    ratio = np.divide(whole, model, out=np.zeros_like(model), where=model > 0.0)
    covariance = estimate.inverse * np.outer(ratio, ratio)
    if estimate.shift is not None:
        covariance = covariance + scale * np.outer(estimate.shift, estimate.shift)
    return Interval(covariance, freedom, grown, excess)


def parameter_rows(
    layout: Layout, estimate: Estimate, repetition: Repetition, at: list[int], *, local: bool
) -> Array:
    """Triangle ``[parameters | rate | more | residual]`` of a position, linear about the fit; a ``local`` phase is taken out."""
    group, factor = repetition.group, repetition.part.factor
    phase = float(estimate.phases[group]) if estimate.phases.size else 0.0
    m = len(estimate.jacobians[group])
    missed = factor[:, -1] - factor[:, :m] @ layout.linear(estimate.amplitudes, phase, group)
    turned = factor[:, :m] @ estimate.jacobians[group]
    both = np.column_stack([turned[:, at], factor[:, m:-1], missed])
    own = turned[:, layout.size + group] if local else np.zeros(len(factor))
    if not own.any():
        return triangle(both)
    return triangle(np.column_stack([own, both]))[1:, 1:]


def without_rate(rows: Array, variance: float) -> Array:
    """Triangle ``[parameters | residual]`` of a position whose rate has this variance."""
    names = (*map(str, range(rows.shape[1] - 2)), "rate")
    return Reduction(names, rows).without(("rate",), variance).factor


def sandwich(
    parts: Sequence[Array], repetitions: Sequence[Repetition], names: Sequence[str]
) -> tuple[Array, Array]:
    """Standard uncertainties and degrees of freedom from triangles ``[parameters | residual]`` of the positions.

    Raises
    ------
    LeverageError
        If one position alone determines one of the parameters, by their ``names``.
    """
    u, degrees, alone = scatter_of(parts)
    for repetition, shares in zip(repetitions, alone.T, strict=True):
        terms = tuple(dict.fromkeys(n for n, own in zip(names, shares, strict=True) if own > _CONCERNED))
        if terms:
            what = "part" if repetition.block else "position"
            remedy = "visit this position again, or add positions that also show it, or leave terms out"
            error = LeverageError(
                f"{what} '{repetition.name}' alone determines {', '.join(terms)}: its scatter cannot be seen, so its "
                "uncertainty is unknown",
                remedy="record longer, or leave terms out" if repetition.block else remedy,
                terms=terms,
            )
            error.position = repetition.name
            raise error
    return u, degrees


def scatter_of(parts: Sequence[Array]) -> tuple[Array, Array, Array]:
    """Standard uncertainties by the scatter of triangles ``[parameters | residual]``, and their degrees of freedom.

    In coordinates in which the information of all positions together is one, ``B_j`` is the information of position j and
    ``g_j`` its score. The variance of the combination d is a weighted mean over the positions of
    ``(d (1 - B_j)^-1/2 g_j)^2``, over that of their variances ``P_jj`` if the weights are right, with the weights
    ``P_jj^-1/2`` (own choice). The last result is the share (parameters, positions) of each variance in directions that a
    position alone determines.
    """
    inverse, value, vector, score = unit_information(parts)
    known = (inverse**2).sum(axis=1)
    turned = np.einsum("ca,jab->cjb", inverse, vector)
    alone = np.where(value > 1.0 - _ALONE, turned**2, 0.0).sum(axis=2) / known[:, None]
    d = turned * (1.0 - np.minimum(value, 1.0 - _ALONE)) ** -0.5
    z = np.einsum("cjb,jb->cj", d, score)
    dB = np.einsum("cjb,jab->cja", d * value, vector)
    P, at = -np.einsum("cja,cka->cjk", dB, dB), np.arange(len(parts))
    P[:, at, at] += (d**2 * value).sum(axis=2)
    variance = P[:, at, at]
    weight = np.maximum(variance + _SHARE * variance.mean(axis=1, keepdims=True), 1e-300) ** -0.5
    trace = (weight * variance).sum(axis=1)
    # nan where as few runs as coefficients leave no scatter
    with np.errstate(invalid="ignore", divide="ignore"):
        u = np.sqrt(known * (weight * z**2).sum(axis=1) / trace)
        degrees = trace**2 / np.einsum("cj,cjk,ck,cjk->c", weight, P, weight, P)
    return u, degrees, alone


def unit_information(parts: Sequence[Array]) -> tuple[Array, Array, Array, Array]:
    """Information of triangles ``[parameters | residual]`` in coordinates in which that of all together is one.

    The results are L with ``L L'`` the inverse information, the eigenvalues (j, b) and eigenvectors (j, a, b) of the information
    of each part, and its score (j, b) along these.
    """
    p = parts[0].shape[1] - 1
    inverse = inverse_root(parts, p)
    x, missed = np.array([part[:, :p] @ inverse for part in parts]), np.array([part[:, p] for part in parts])
    missed = missed - x @ np.einsum("jka,jk->a", x, missed)
    value, vector = np.linalg.eigh(np.einsum("jka,jkb->jab", x, x))
    return inverse, value, vector, np.einsum("jab,jka,jk->jb", vector, x, missed)


def inverse_root(parts: Sequence[Array], p: int) -> Array:
    """L with ``L L' = (sum of information)^-1`` of the first p columns."""
    stacked = np.vstack([part[:, :p] for part in parts])
    scale = np.linalg.norm(stacked, axis=0)
    scale[scale == 0.0] = 1.0
    inverse: Array = np.linalg.solve(triangle(stacked / scale), np.eye(p)) / scale[:, None]
    return inverse


def _between_runs(
    parts: Sequence[Array], repetitions: Sequence[Repetition], u: Array, degrees: Array
) -> tuple[Array, Array]:
    """Standard uncertainties and degrees of freedom where runs scatter more than the positions within them; elsewhere 0.

    The same sandwich with runs in place of positions; it counts where its variance is larger beyond chance (F test), and
    not for a coefficient that one run alone determines. ``u`` and ``degrees`` are those of the positions.
    """
    from scipy.special import fdtrc

    runs = [r.run for r in repetitions]
    together = [
        triangle(np.vstack([part for part, own in zip(parts, runs, strict=True) if own == k]))
        for k in sorted(set(runs))
    ]
    wide, few, alone = scatter_of(together)
    chance = fdtrc(few, degrees, (wide / np.maximum(u, 1e-300)) ** 2)
    taken = (alone.max(axis=1) < _CONCERNED) & (wide > u) & (chance < _BETWEEN)
    return np.where(taken, wide, 0.0), few


def _order(rows: Sequence[Array], repetitions: Sequence[Repetition]) -> tuple[float, float, Array | None]:
    """Excess scatter of the rates, its probability by chance, and the factor by a slow change of the rates.

    A scatter that the run file states is new at each position: it is in the weights here, and no excess. The factor is None
    where the order does not matter: blocks of one record, or too few positions.
    """
    from scipy.special import fdtrc

    p, whole = rows[0].shape[1] - 2, np.array(rows)
    b = whole[:, :, p]
    share = rate_share([r.stated for r in repetitions], (b**2).sum(axis=1))
    whole -= np.einsum("j,jk,ji,jil->jkl", share, b, b, whole)
    inverse, b, y = inverse_root(list(whole), p), whole[:, :, p], whole[:, :, p + 1]
    x, unit = whole[:, :, :p] @ inverse, (b**2).sum(axis=1)
    if (unit <= 0.0).any():
        return np.nan, 1.0, None
    moved, along = np.einsum("jka,jk->a", x, y), np.einsum("jka,jk->ja", x, b)
    rate = (b * (y - x @ moved)).sum(axis=1)
    count, square = sum(r.part.count for r in repetitions), float((y**2).sum() - moved @ moved)
    hat = along / unit[:, None] @ along.T
    freedom = len(rows) - float(np.trace(hat))
    rest = count - p - freedom
    if freedom < 1.0 or rest < 1.0 or square <= 0.0:
        return np.nan, 1.0, None
    scattered = float((rate**2 / unit).sum())
    within = max(square - scattered, 1e-300) / rest
    excess = scattered / freedom / within
    probability = float(fdtrc(freedom, rest, excess))
    if any(r.block for r in repetitions):
        return excess, probability, None
    return excess, probability, _slow_factor(repetitions, hat, inverse @ along.T, freedom)


def _slow_factor(repetitions: Sequence[Repetition], hat: Array, effect: Array, freedom: float) -> Array:
    """How much more 1/f noise moves a parameter than the residual rates show (at least 1): a number of the plan.

    ``effect`` (c, j) is the change of a parameter by a rate error in each position, ``hat`` (j, j) the change of the fitted rates.
    """
    begin, end = (np.array([getattr(r, name) for r in repetitions]) for name in ("begin", "end"))
    run = np.array([r.run for r in repetitions])
    longest = max(float(end[run == k].max() - begin[run == k].min()) for k in set(run.tolist()))
    usual = float(np.median(end - begin))
    covariance = np.zeros_like(hat)
    for exponent in np.arange(0.0, np.log10(_SHORTEST * longest / usual), _SPACING):
        time = usual / _SHORTEST * 10.0**exponent
        for one, other, sign in ((end, begin, 1), (begin, end, 1), (end, end, -1), (begin, begin, -1)):
            lag = np.abs(one[:, None] - other[None, :]) / time  # covariance of the means of first-order noise
            covariance += sign * time**2 * (lag + np.exp(-lag))
    covariance /= np.outer(end - begin, end - begin)
    covariance *= run[:, None] == run[None, :]
    rest = np.eye(len(hat)) - hat
    shown = float(np.trace(rest @ covariance @ rest.T)) / freedom
    moved = np.einsum("ci,ij,cj->c", effect, covariance, effect)
    factor: Array = np.sqrt(np.maximum(moved / ((effect**2).sum(axis=1) * shown), 1.0))
    return factor


def segment_scatter(
    positions: Sequence[Repetition], values: Array, noise: Noise, design: Design
) -> Diagnostics:
    """Scatter of the mean rates of the positions, over the scatter that the noise explains.

    ``values`` (positions, m) are the column coefficients. The ratio is the root mean square of a residual rate over the
    standard deviation that its rows give it; where these are rates, which share their readings, the first and the last reading and
    the random walk between them give it. A scatter of the segments, stated or estimated, adds its own variance. Where the
    output turns by m counts beside whole ones in each reading, m readings share their rounding.
    """
    if len(positions) < _FEWEST_SEGMENTS or positions[0].block:
        return Diagnostics()
    m, run = values.shape[1], design.run
    rows = np.array([p.part.factor for p in positions])
    along, missed = rows[:, :, m], rows[:, :, -1] - np.einsum("jkm,jm->jk", rows[:, :, :m], values)
    known, count = (along**2).sum(axis=1), count_of(run)
    if not known.all():
        return Diagnostics()
    duration = np.array([p.end - p.begin for p in positions])
    rate, variance = (along * missed).sum(axis=1) / known, 1.0 / known
    if design.mode == "rates":
        variance = 2.0 * noise.white / duration**2 + noise.walk / duration
    variance += [p.variance for p in positions]
    if count > 0.0 and design.mode != "rates":
        edges = run.segment_edges()
        turned, rows = run.output[edges[1:] - 1] - run.output[edges[:-1]], np.diff(edges)
        beside = np.abs(turned / count - rows * np.round(turned / count / rows))
        variance += min(12.0 * noise.white, count**2) / np.maximum(1.0, beside) / duration**2
    return Diagnostics(
        root_mean_square(rate / np.sqrt(variance)),
        root_mean_square(rate) / run.scale_factor / G0,
        root_mean_square(rate / np.sqrt(variance - noise.scatter)) if noise.scatter > 0.0 else None,
    )
