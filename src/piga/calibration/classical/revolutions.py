"""Whole-revolution averaging: mean rate of each position over whole turns, corrected for pulling.

This is common laboratory practice. The average over whole turns removes the ripple of the cross-coupling but not
its pulling: the mean rate is ``sign(u) sqrt(u^2 - tan(beta)^2 u_t^2)`` (docs/theory/locking). The uncertainty
comes from the scatter of single turns. Near lock the output stays long at one angle. Small disturbances at this
angle change the time of a turn strongly. The scatter is weighted by this amplification, which is computed from the output.
The method is kept for comparison. It does not use the angle within the turns, so its uncertainty is larger.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from piga.calibration.fit.one_run import fit_run
from piga.calibration.fit.servo import with_mean_servo
from piga.calibration.joint.summary import provenance, residual_figures, validity_ranges
from piga.calibration.model.design import Design
from piga.calibration.model.identifiability import Examination, examine, refuse_if_confounded
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.request import Request
from piga.calibration.model.solution import Estimate, Layout, name_parameters
from piga.errors import CalibrationError, IdentifiabilityError
from piga.records.calibration import (
    BudgetEntry,
    BudgetTable,
    Calibration,
    Coefficient,
    Diagnostics,
    Event,
    Residuals,
    SegmentSummary,
)
from piga.records.run import Run
from piga.results import Array

FULL_TURN = 2.0 * np.pi


@dataclass(frozen=True)
class RevolutionSettings:
    """Settings of the method of whole turns (own choices)."""

    steady: float = 2e-3
    """Largest change of the specific force in a position, relative to its size."""
    phases: int = 32
    """Parts of a turn whose durations give the amplification."""
    locking: float = 10.0
    """Amplification of the variance of a turn above which a position is left out: a/b below 1.08."""
    clear: float = 4.0
    """Ratio of the pulling to its standard uncertainty above which tan_beta is estimated."""
    least_freedom: int = 3
    """Fewest degrees of freedom of a result."""
    walk_shares: int = 41
    """Trial values for the share of the random walk in the scatter of turns."""
    steps: int = 50
    """Most Gauss-Newton steps."""
    settled: float = 1e-12
    """Relative size of the step that ends them."""


REVOLUTIONS = RevolutionSettings()


@dataclass(frozen=True)
class TurnScatter:
    """Scatter of single turns: the variance of a turn is ``shape @ levels`` [rad^2], cautious in its mean.

    ``shape`` (positions, 2): a random walk adds up over a turn and is amplified by pulling. Reading noise enters at
    both ends and is amplified where the output is slow. ``levels`` are the variances of walk [rad^2/s] and reading
    [rad^2]; ``covariance`` (2, 2) is that of the levels. ``pooled`` [rad] is the root mean square of all turns.
    """

    shape: Array
    levels: Array
    covariance: Array
    pooled: float

    @property
    def variance(self) -> Array:
        """Variance of a turn in every position [rad^2]."""
        variance: Array = self.shape @ self.levels
        return variance


@dataclass(frozen=True)
class Positions:
    """Mean rates over whole turns: one point per position, with its turns and their scatter.

    ``run`` contains the means as a rate log. ``short``, ``unsteady`` and ``locking`` are labels of positions that
    are left out: less than one turn, specific force not constant, or too near to lock.
    """

    run: Run
    turns: Array
    rows: NDArray[np.int64]
    duration: Array
    scatter: TurnScatter
    freedom: int
    short: tuple[str, ...]
    unsteady: tuple[str, ...]
    locking: tuple[str, ...]

    @property
    def std(self) -> Array:
        """Standard deviation of each mean rate [rad/s]: that of one turn over the root of the number of turns."""
        return np.sqrt(self.scatter.variance * self.turns) / self.duration


@dataclass(frozen=True)
class RevolutionFit:
    """Estimate over positions: linear parameters, ``tan(beta)^2`` (None when not fitted), their covariance.

    ``gain`` is their derivative by the mean rates; ``rate`` is the residual of the mean rates [rad/s].
    """

    positions: Positions
    design: Design
    linear: Array
    square: float | None
    covariance: Array
    gain: Array
    rate: Array
    examination: Examination

    @property
    def shows_pulling(self) -> bool:
        """True when ``tan(beta)^2`` exceeds ``REVOLUTIONS.clear`` standard uncertainties."""
        return (
            self.square is not None
            and self.square > REVOLUTIONS.clear * float(np.sqrt(self.covariance[-1, -1])) > 0.0
        )


def find_positions(run: Run) -> Positions:
    """Mean rate, force and base rate over whole turns of every position."""
    points, durations, turns, rows = [], [], [], []
    short, unsteady, locking = [], [], []
    squares, shapes = [], []
    used = []
    for index, label in enumerate(run.labels):
        part = _longest_stretch(run, index)
        x = np.maximum.accumulate(np.abs(run.output[part] - run.output[part][0]))
        count = int(x[-1] / FULL_TURN) if x.size else 0
        if count < 1:
            short.append(label)
            continue
        at = np.interp(FULL_TURN * np.arange(count + 1), x, run.t[part])
        inside = slice(part.start, part.start + int(np.searchsorted(run.t[part], at[-1])) + 1)
        force = run.f[inside]
        if np.ptp(force, axis=0).max() > REVOLUTIONS.steady * np.linalg.norm(force, axis=1).max():
            unsteady.append(label)
            continue
        span = at[-1] - at[0]
        pulled, slow = _amplification(x, run.t[part], count)
        if pulled > REVOLUTIONS.locking:
            locking.append(label)
            continue
        squares.append(float(np.sum((np.diff(at) * (FULL_TURN * count / span) - FULL_TURN) ** 2)))
        shapes.append((span / count * pulled, 2.0 * slow))
        sign = np.sign(run.output[part][-1] - run.output[part][0])
        points.append(
            (0.5 * (at[0] + at[-1]), sign * FULL_TURN * count / span, *force.mean(axis=0), part.start)
        )
        durations.append(span)
        turns.append(float(count))
        rows.append(part.stop - part.start)
        used.append((index, inside))
    freedom = int(sum(turns)) - len(turns)
    if freedom < REVOLUTIONS.least_freedom:
        raise CalibrationError(
            f"method 'revolutions' finds {freedom + len(points)} whole turns of the output in {len(points)} positions"
            + (f"; not one in {', '.join(short[:6])}" if short else "")
            + (f"; too near to lock in {', '.join(locking[:6])}" if locking else ""),
            remedy="record longer, name the positions in [data] segment, or use method 'information'",
        )
    table = np.array(points)
    return Positions(
        run=_mean_run(run, table, used),
        turns=np.array(turns),
        rows=np.array(rows, dtype=np.int64),
        duration=np.array(durations),
        scatter=_scatter_levels(np.array(squares), np.array(turns) - 1.0, np.array(shapes)),
        freedom=freedom,
        short=tuple(short),
        unsteady=tuple(unsteady),
        locking=tuple(locking),
    )


def _amplification(x: Array, t: Array, count: int) -> tuple[float, float]:
    """Amplification of the variance of a turn by pulling: for a random walk, and for reading noise at its ends.

    Where the output turns at the rate r, a disturbance of the angle shifts the time by its value over r. As an
    angle at the mean rate w this is ``w/r`` times the disturbance. A walk collects ``(w/r)^2`` over the time of a
    turn: ``w^3/(2 pi) integral d(angle)/r^3``, which is ``(1 + r0^2/2)/(1 - r0^2)`` for ``r0 = b/a``. For reading
    noise, r is the rate where turns begin and end.
    """
    inner = np.interp(FULL_TURN / REVOLUTIONS.phases * np.arange(REVOLUTIONS.phases * count + 1), x, t)
    times = np.diff(inner).reshape(count, REVOLUTIONS.phases).mean(axis=0)
    slowness = times / times.mean()
    return float(np.mean(slowness**3)), float(0.5 * (slowness[0] + slowness[-1])) ** 2


def _scatter_levels(squares: Array, freedom: Array, shape: Array) -> TurnScatter:
    """Levels of walk and reading noise from the sums of squares of the turns of each position.

    Each sum over its variance is chi-square with ``freedom``. Maximum likelihood with no level below zero, on a
    grid of their ratio. The covariance of the levels is the inverse Fisher information.
    """
    usable = freedom > 0.0
    own, sums, degrees = shape[usable], squares[usable], freedom[usable]
    scale = shape.mean(axis=0)
    best, levels = np.inf, np.zeros(2)
    for share in np.linspace(0.0, 1.0, REVOLUTIONS.walk_shares):
        mixed = own @ (np.array([share, 1.0 - share]) / scale)
        level = float(np.sum(sums / mixed) / degrees.sum())
        cost = float(np.sum(degrees * np.log(mixed))) + degrees.sum() * np.log(max(level, 1e-300))
        if cost < best:
            best, levels = cost, level * np.array([share, 1.0 - share]) / scale
    variance = np.maximum(own @ levels, 1e-300)
    relative = own * scale / variance[:, None]
    information = (relative * (0.5 * degrees)[:, None]).T @ relative
    covariance = np.linalg.pinv(information, rcond=1e-9) * np.outer(scale, scale)
    pooled = float(np.sqrt(squares.sum() / degrees.sum()))
    return TurnScatter(shape, levels, covariance, pooled)


def _longest_stretch(run: Run, segment: int) -> slice:
    """The longest part of a segment without a gap."""
    inside = np.flatnonzero(run.segment_index == segment)
    starts = np.append(inside[run.begins[inside]], inside[-1] + 1)
    if starts[0] != inside[0]:
        starts = np.insert(starts, 0, inside[0])
    longest = int(np.argmax(np.diff(starts)))
    return slice(int(starts[longest]), int(starts[longest + 1]))


def _mean_run(run: Run, table: Array, used: list[tuple[int, slice]]) -> Run:
    """The means as a log of rates, one sample per position."""

    def mean(values: Array) -> Array:
        return np.array([values[inside].mean(axis=0) for _, inside in used])

    size = len(used)
    return replace(
        run,
        kind="rate",
        t=table[:, 0],
        output=table[:, 1],
        f=np.ascontiguousarray(table[:, 2:5]),
        base_rate=None if run.base_rate is None else mean(run.base_rate),
        temperature=None if run.temperature is None else mean(run.temperature),
        segment_index=np.arange(size, dtype=np.int32),
        labels=tuple(run.labels[index] for index, _ in used),
        begins=np.ones(size, dtype=bool),
        phase_group=(0,) * size,
        row=run.row[table[:, 5].astype(int)],
        left_out=None,
    )


def clean_record(run: Run, request: Request) -> tuple[Run, tuple]:
    """The record without gross errors of the output, found as in method 'information', and the list of them."""
    wish = replace(request, method="information", phases="per-segment", phase_source="output")
    try:
        fit = fit_run(run, wish)
    except (CalibrationError, IdentifiabilityError):
        return run, ()
    return fit.design.run, fit.outliers


def fit_revolutions(run: Run, request: Request) -> RevolutionFit:
    """Weighted least squares of the mean rates, including pulling.

    Raises
    ------
    CalibrationError
        If a harmonic is asked for (whole turns average it out), or there are too few positions.
    IdentifiabilityError
        If the positions cannot separate the terms.
    """
    if request.harmonics:
        raise CalibrationError(
            "method 'revolutions' cannot estimate harmonics of the output angle: they average out over "
            "whole turns",
            remedy="use method 'information'",
        )
    positions = find_positions(run)
    linear_terms = tuple(name for name in request.terms if name != "tan_beta")
    if not linear_terms:
        raise CalibrationError(
            "method 'revolutions' needs a term besides tan_beta", remedy="add scale_factor, k0"
        )
    design = with_mean_servo(Design(positions.run, replace(request, terms=linear_terms), run.scale_factor))
    columns = np.concatenate([block.columns for block in design.blocks()], axis=1)
    weighted = columns / positions.std
    summary = Reduction.empty(design.names)
    summary.absorb(weighted)
    examination = examine(design, [summary])
    refuse_if_confounded(examination)
    pulled = "tan_beta" in request.terms
    if columns.shape[1] < len(linear_terms) + pulled:
        raise CalibrationError(
            f"{columns.shape[1]} positions with whole turns are too few for {len(linear_terms) + pulled} "
            "coefficients",
            remedy="record more positions, or leave terms out",
        )
    return _gauss_newton(positions, design, columns, summary.solve()[0], pulled, examination)


def _gauss_newton(
    positions: Positions, design: Design, columns: Array, linear: Array, pulled: bool, examination: Examination
) -> RevolutionFit:
    run = positions.run
    x = columns[:-1].T
    omega = np.zeros((run.size, 3)) if run.base_rate is None else run.base_rate
    known = np.zeros(run.size) if design.estimates_scale_factor else run.scale_factor * run.f[:, 0]
    if design.turning_servo:
        known = run.output + omega[:, 0] - columns[-1]
    square, size = 0.0, np.abs(run.output)
    weight, sign = 1.0 / positions.std, np.sign(run.output)
    for _ in range(REVOLUTIONS.steps):
        K = (
            float(linear[design.names.index("scale_factor")])
            if design.estimates_scale_factor
            else run.scale_factor
        )
        transverse = np.sum((K * run.f[:, 1:] - omega[:, 1:]) ** 2, axis=1)
        u = x @ linear + known - omega[:, 0]
        # squared rates are compared, so intermediate steps may lie in the dead zone
        miss = (size**2 - u**2 + square * transverse) / (2.0 * size)
        jacobian = x * (u / size)[:, None]
        if pulled:
            jacobian = np.column_stack([jacobian, -transverse / (2.0 * size)])
        scaled = jacobian * weight[:, None]
        norm = np.linalg.norm(scaled, axis=0)
        norm[norm == 0.0] = 1.0
        change = np.linalg.lstsq(scaled / norm, miss * weight, rcond=1e-12)[0] / norm
        linear = linear + change[: linear.size]
        square += float(change[-1]) if pulled else 0.0
        if np.abs(change * norm).max() <= REVOLUTIONS.settled * np.linalg.norm(size * weight):
            break
    covariance = np.linalg.pinv((scaled / norm).T @ (scaled / norm), rcond=1e-14) / np.outer(norm, norm)
    pulling = square if pulled else None
    gain = covariance @ (jacobian * weight[:, None] ** 2).T
    return RevolutionFit(positions, design, linear, pulling, covariance, gain, sign * miss, examination)


def name_revolutions(fit: RevolutionFit, request: Request) -> tuple[tuple[Coefficient, ...], Array, str]:
    """Coefficients with covariance (Type A), and a note if the pulling is not significant."""
    note = ""
    if fit.square is not None and not fit.shows_pulling:
        std = float(np.sqrt(fit.covariance[-1, -1]))
        note = (
            f"the mean rates do not show tan_beta (tan_beta^2 = {fit.square:.2g}, standard uncertainty "
            f"{std:.2g}): it is not in the result; use method 'information'"
        )
    return (*_named(fit, request, fit.covariance), note)


def revolutions_degrees(fit: RevolutionFit, request: Request) -> Array:
    """Degrees of freedom of the Type A uncertainty of each coefficient, from the uncertainty of the scatter levels.

    The variance v of a coefficient is linear in the levels. The result is ``2 v^2 / var(v)``, first order (JCGM 100,
    G.4).
    """
    scatter, positions = fit.positions.scatter, fit.positions
    parts = []
    for column in scatter.shape.T:
        variance = column * positions.turns / positions.duration**2
        parts.append(np.diag(_named(fit, request, (fit.gain * variance) @ fit.gain.T)[1]))
    share = np.array(parts)
    doubt = np.einsum("ik,ij,jk->k", share, scatter.covariance, share)
    degrees: Array = 2.0 * (scatter.levels @ share) ** 2 / np.maximum(doubt, 1e-300)
    return np.clip(degrees, REVOLUTIONS.least_freedom, positions.freedom)


def _named(fit: RevolutionFit, request: Request, covariance: Array) -> tuple[tuple[Coefficient, ...], Array]:
    """Coefficients and their covariance, if ``covariance`` is that of the parameters."""
    names, amplitudes = fit.design.names, fit.linear
    if fit.shows_pulling:
        names = (*names, "tan_beta")
        amplitudes, covariance = _with_tangent(fit, covariance)
    elif fit.square is not None:
        covariance = covariance[:-1, :-1]
    layout = Layout.of_one(False, (), names)
    estimate = Estimate(amplitudes, np.zeros(0), covariance, 0.0, (np.eye(len(names)),))
    return name_parameters(layout, estimate, covariance, fit.design.run.scale_factor, request.terms, [])


def _with_tangent(fit: RevolutionFit, covariance: Array) -> tuple[Array, Array]:
    """Parameters with ``tan_beta^2`` converted to ``K tan_beta``."""
    tangent = float(np.sqrt(fit.square or 0.0))
    names = fit.design.names
    at = names.index("scale_factor") if "scale_factor" in names else None
    K = fit.design.run.scale_factor if at is None else float(fit.linear[at])
    jacobian = np.eye(len(names) + 1)
    jacobian[-1, -1] = K / (2.0 * tangent)
    if at is not None:
        jacobian[-1, at] = tangent
    return np.append(fit.linear, K * tangent), jacobian @ covariance @ jacobian.T


def estimate_again(run: Run, request: Request, keys: list[str]) -> Array:
    """Values of the same coefficients from a moved record (file units)."""
    fit = fit_revolutions(run, request)
    values = {c.key: c.value for c in name_revolutions(fit, request)[0]}
    return np.array([values.get(key, np.nan) for key in keys])


def revolutions_result(
    run: Run,
    cleaned: tuple[Run, tuple],
    request: Request,
    fit: RevolutionFit,
    coefficients: tuple[Coefficient, ...],
    covariance: Array,
    budget: tuple[BudgetEntry, ...],
    notes: tuple[str, ...],
) -> Calibration:
    """The result, with one residual per position."""
    positions, means = fit.positions, fit.positions.run
    before = means.output - run.scale_factor * means.f[:, 0]
    before += 0.0 if means.base_rate is None else means.base_rate[:, 0]
    residuals = Residuals(
        means.row, means.t, fit.design.phase_angle, means.f[:, 0], before, fit.rate, fit.rate / positions.std,
        means.segment_index, unit="rad/s",
    )  # fmt: skip
    figures = residual_figures(residuals)
    quality = cleaned[0].quality
    events = (*quality.events, *_events(positions))
    return Calibration(
        serial=run.serial,
        scale_factor_nominal=run.scale_factor,
        terms=tuple(name for name in request.terms if any(c.name == name for c in coefficients)),
        phases=request.phases,
        phase_source=request.phase_source,
        method="revolutions",
        coefficients=coefficients,
        covariance=covariance,
        surplus_observations=float(means.size - len(coefficients)),
        angle_rms=float(np.sqrt(positions.scatter.levels[1])),
        angle_random_walk=float(np.sqrt(positions.scatter.levels[0])),
        residual_rms=figures["residual_rms"],
        residual_rms_before=figures["residual_rms_before"],
        residual_max_before=figures["residual_max_before"],
        residual_max_after=figures["residual_max_after"],
        quality=replace(quality, events=events),
        condition=fit.examination.condition,
        notes=notes,
        budget=BudgetTable(budget),
        diagnostics=Diagnostics(
            residual_kind="rate",
            range=validity_ranges(run),
            turns=int(positions.turns.sum()),
            scatter_of_a_turn=positions.scatter.pooled,
        ),
        segments=tuple(
            SegmentSummary(label, int(n), float(d), float(a), float(c), abs(float(r)), abs(float(b)), abs(float(r)))
            for label, n, d, a, c, r, b in zip(
                means.labels, positions.rows, positions.duration, means.f[:, 0],
                np.sign(means.output) * positions.turns, fit.rate, before, strict=True,
            )
        ),
        provenance=provenance(dict(run.input_sha256), {"source": run.source}),
        temperature_reference=request.temperature_reference,
        time_reference=fit.design.time_reference,
        residuals=residuals,
        outliers=cleaned[1],
    )  # fmt: skip


def _events(positions: Positions) -> list[Event]:
    events = []
    for kind, labels, words in (
        ("no-whole-revolution", positions.short, "the output does not turn once"),
        ("force-not-constant", positions.unsteady, "the specific force changes while the output turns"),
        (
            "near-lock",
            positions.locking,
            f"pulling amplifies the scatter of a turn more than {REVOLUTIONS.locking:g} times",
        ),
    ):
        if labels:
            listed = ", ".join(labels[:8]) + (" ..." if len(labels) > 8 else "")
            events.append(Event(kind, len(labels), None, f"positions {listed}: {words}; left out"))
    return events
