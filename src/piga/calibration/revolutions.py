"""Whole-revolution averaging: the mean rate of each position over whole turns, corrected for pulling.

What laboratories do: averaged over whole turns the cross-coupling's ripple is gone, but its pulling is not,
the mean rate is ``sign(u) sqrt(u^2 - tan(beta)^2 u_t^2)`` (physics.md). Uncertainty comes from the
scatter of single turns. For comparison: the angle inside the turns is not used, so it is less certain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from piga._version import __version__
from piga.calibration.coefficients import name_parameters
from piga.calibration.design import Design
from piga.calibration.fit import fit_run, phase_groups
from piga.calibration.identifiability import Examination, examine, refuse_if_confounded
from piga.calibration.reduction import Reduction
from piga.calibration.request import Request
from piga.calibration.solution import Estimate, Layout
from piga.calibration.summary import now, residual_figures, validity_ranges
from piga.errors import CalibrationError, IdentifiabilityError
from piga.records.calibration import Calibration, Coefficient, Event, Provenance, Residuals, SegmentSummary
from piga.records.run import Run

Array = NDArray[np.float64]

TURN = 2.0 * np.pi
STEADY = 2e-3
"""Change of the specific force in a position, relative to its size, that whole-turn averaging allows."""
STEPS = 8
"""Gauss-Newton steps; the pulling is a small correction."""
CLEAR = 4.0
"""Standard uncertainties that the pulling must stand out by to give tan_beta."""
LEAST_FREEDOM = 3


@dataclass(frozen=True)
class Positions:
    """Mean rates over whole turns: one point per position, with its turns and the angle scatter of a turn [rad].

    ``run`` is the record of these means, as a log of rates; ``left_out`` the labels of positions that do
    not turn once, or whose force is not constant; ``freedom`` the degrees of freedom of the scatter.
    """

    run: Run
    turns: Array
    rows: NDArray[np.int64]
    duration: Array
    scatter: float
    freedom: int
    short: tuple[str, ...]
    unsteady: tuple[str, ...]

    @property
    def std(self) -> Array:
        """Standard deviation of each mean rate [rad/s]: that of a turn, over the root of their number."""
        return self.scatter * np.sqrt(self.turns) / self.duration


@dataclass(frozen=True)
class RevolutionFit:
    """Estimate over positions: linear parameters, ``tan(beta)^2`` (None when not fitted), their covariance."""

    positions: Positions
    design: Design
    linear: Array
    square: float | None
    covariance: Array
    rate: Array
    examination: Examination


def find_positions(run: Run) -> Positions:
    """Mean rate, force and base rate over whole turns of every position."""
    points, durations, turns, rows, short, unsteady = [], [], [], [], [], []
    squares, freedom = 0.0, 0
    used = []
    for index, label in enumerate(run.labels):
        part = _longest_stretch(run, index)
        x = np.abs(run.output[part] - run.output[part][0])
        count = int(np.maximum.accumulate(x)[-1] / TURN) if x.size else 0
        if count < 1:
            short.append(label)
            continue
        at = np.interp(TURN * np.arange(count + 1), np.maximum.accumulate(x), run.t[part])
        inside = slice(part.start, part.start + int(np.searchsorted(run.t[part], at[-1])) + 1)
        force = run.f[inside]
        if np.ptp(force, axis=0).max() > STEADY * np.linalg.norm(force, axis=1).max():
            unsteady.append(label)
            continue
        span = at[-1] - at[0]
        squares += float(np.sum((np.diff(at) * (TURN * count / span) - TURN) ** 2))
        freedom += count - 1
        sign = np.sign(run.output[part][-1] - run.output[part][0])
        points.append((0.5 * (at[0] + at[-1]), sign * TURN * count / span, *force.mean(axis=0), part.start))
        durations.append(span)
        turns.append(float(count))
        rows.append(part.stop - part.start)
        used.append((index, inside))
    if freedom < LEAST_FREEDOM:
        raise CalibrationError(
            f"method 'revolutions' finds {freedom + len(points)} whole turns of the output in {len(points)} positions"
            + (f"; not one in {', '.join(short[:6])}" if short else ""),
            remedy="record longer, name the positions in [data] segment, or use method 'information'",
        )
    table = np.array(points)
    return Positions(
        _mean_run(run, table, used),
        np.array(turns),
        np.array(rows, dtype=np.int64),
        np.array(durations),
        float(np.sqrt(squares / freedom)),
        freedom,
        tuple(short),
        tuple(unsteady),
    )


def _longest_stretch(run: Run, segment: int) -> slice:
    """The longest part of a segment without a gap."""
    inside = np.flatnonzero(run.segment == segment)
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
        segment=np.arange(size, dtype=np.int32),
        labels=tuple(run.labels[index] for index, _ in used),
        begins=np.ones(size, dtype=bool),
        phase_group=(0,) * size,
        row=run.row[table[:, 5].astype(int)],
        left_out=None,
    )


def clean_record(run: Run, request: Request) -> tuple[Run, tuple]:
    """The record without gross errors of the output, found as for method 'information', and what they were."""
    wish = replace(request, method="information", phase="per-segment", phase_source="output")
    try:
        fit = fit_run(run, wish, *phase_groups(run, wish))
    except (CalibrationError, IdentifiabilityError):
        return run, ()
    return fit.design.run, fit.outliers


def fit_revolutions(run: Run, request: Request) -> RevolutionFit:
    """Weighted least squares of the mean rates, pulling included.

    Raises
    ------
    CalibrationError
        If a harmonic is asked for (whole turns average it out), or there are too few positions.
    IdentifiabilityError
        If the positions cannot separate the terms.
    """
    if request.harmonics:
        raise CalibrationError(
            "method 'revolutions' averages harmonics of the output angle out", remedy="use method 'information'"
        )
    positions = find_positions(run)
    linear_terms = tuple(name for name in request.terms if name != "tan_beta")
    if not linear_terms:
        raise CalibrationError(
            "method 'revolutions' needs a term besides tan_beta", remedy="add scale_factor, k0"
        )
    design = Design(positions.run, replace(request, terms=linear_terms), run.scale_factor)
    columns = np.concatenate([block.columns for block in design.blocks()], axis=1)
    weighted = columns / positions.std
    summary = Reduction.empty(design.names)
    summary.absorb(weighted)
    examination = examine(design, [summary], per_segment=False)
    refuse_if_confounded(examination)
    pulled = "tan_beta" in request.terms
    if columns.shape[1] < len(linear_terms) + pulled:
        raise CalibrationError(
            f"{columns.shape[1]} positions with whole turns for {len(linear_terms) + pulled} coefficients",
            remedy="record more positions",
        )
    return _gauss_newton(positions, design, columns, summary.solve()[0], pulled, examination)


def _gauss_newton(
    positions: Positions, design: Design, columns: Array, linear: Array, pulled: bool, examination: Examination
) -> RevolutionFit:
    run = positions.run
    x, y = columns[:-1].T, columns[-1]
    omega = np.zeros((run.size, 3)) if run.base_rate is None else run.base_rate
    known = np.zeros(run.size) if design.estimates_scale_factor else run.scale_factor * run.f[:, 0]
    square, sign = 0.0, np.sign(run.output)
    weight = 1.0 / positions.std
    for _ in range(STEPS):
        K = (
            float(linear[design.names.index("scale_factor")])
            if design.estimates_scale_factor
            else run.scale_factor
        )
        transverse = np.sum((K * run.f[:, 1:] - omega[:, 1:]) ** 2, axis=1)
        u = x @ linear + known - omega[:, 0]
        mean = np.sqrt(np.maximum(u**2 - square * transverse, 0.25 * u**2))
        model = sign * mean + omega[:, 0] - known
        jacobian = x * (np.abs(u) / mean)[:, None]
        if pulled:
            jacobian = np.column_stack([jacobian, -sign * transverse / (2.0 * mean)])
        scaled = jacobian * weight[:, None]
        norm = np.linalg.norm(scaled, axis=0)
        norm[norm == 0.0] = 1.0
        step = np.linalg.lstsq(scaled / norm, (y - model) * weight, rcond=1e-12)[0] / norm
        linear = linear + step[: linear.size]
        square += float(step[-1]) if pulled else 0.0
    covariance = np.linalg.pinv((scaled / norm).T @ (scaled / norm), rcond=1e-14) / np.outer(norm, norm)
    return RevolutionFit(
        positions, design, linear, square if pulled else None, covariance, y - model, examination
    )


def name_revolutions(fit: RevolutionFit, request: Request) -> tuple[tuple[Coefficient, ...], Array, str]:
    """Coefficients with covariance (Type A), and a note where the pulling does not show."""
    names = fit.design.names
    keys: list[tuple[str, str | None]] = [(name, None) for name in names]
    amplitudes, covariance, note = fit.linear, fit.covariance, ""
    if fit.square is not None:
        std = float(np.sqrt(fit.covariance[-1, -1]))
        if fit.square > CLEAR * std > 0.0:
            amplitudes, covariance = _with_tangent(fit, keys)
        else:
            covariance = fit.covariance[:-1, :-1]
            note = (
                f"the pulling of the mean rate does not show tan_beta (tan_beta^2 = {fit.square:.2g}, standard "
                f"uncertainty {std:.2g}): it is not in the result; use method 'information'"
            )
    tail = np.arange(len(keys))
    layout = Layout(False, (), tuple(keys), (tail,))
    estimate = Estimate(amplitudes, np.zeros(0), covariance, 0.0, (np.eye(tail.size),))
    terms = request.terms
    named, result = name_parameters(layout, estimate, covariance, fit.design.run.scale_factor, terms, [])
    return named, result, note


def _with_tangent(fit: RevolutionFit, keys: list[tuple[str, str | None]]) -> tuple[Array, Array]:
    """Parameters with ``K tan_beta`` for ``tan_beta^2``."""
    tangent = float(np.sqrt(fit.square or 0.0))
    names = fit.design.names
    at = names.index("scale_factor") if "scale_factor" in names else None
    K = fit.design.run.scale_factor if at is None else float(fit.linear[at])
    jacobian = np.eye(len(names) + 1)
    jacobian[-1, -1] = K / (2.0 * tangent)
    if at is not None:
        jacobian[-1, at] = tangent
    keys.append(("tan_beta", None))
    return np.append(fit.linear, K * tangent), jacobian @ fit.covariance @ jacobian.T


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
    budget: tuple,
    notes: tuple[str, ...],
) -> Calibration:
    """The result, with one residual per position."""
    positions, means = fit.positions, fit.positions.run
    before = means.output - run.scale_factor * means.f[:, 0]
    before += 0.0 if means.base_rate is None else means.base_rate[:, 0]
    residuals = Residuals(
        means.row, means.t, fit.design.phase_angle, means.f[:, 0], before, fit.rate, fit.rate / positions.std,
        means.segment,
    )  # fmt: skip
    figures = residual_figures(residuals)
    quality = cleaned[0].quality
    events = (*quality.events, *_events(positions))
    return Calibration(
        serial=run.serial,
        scale_factor_nominal=run.scale_factor,
        terms=tuple(name for name in request.terms if any(c.name == name for c in coefficients)),
        phase=request.phase,
        phase_source=request.phase_source,
        method="revolutions",
        coefficients=coefficients,
        covariance=covariance,
        surplus_observations=float(means.size - len(coefficients)),
        angle_rms=positions.scatter / float(np.sqrt(2.0)),
        angle_random_walk=0.0,
        residual_rms=figures["residual_rms"],
        residual_rms_before=figures["residual_rms_before"],
        residual_max_before=figures["residual_max_before"],
        residual_max_after=figures["residual_max_after"],
        quality=replace(quality, events=events),
        condition=fit.examination.condition,
        notes=notes,
        budget=budget,
        diagnostics={
            "residual_kind": "rate",
            "range": validity_ranges(run),
            "turns": int(positions.turns.sum()),
            "scatter_of_a_turn": positions.scatter,
        },
        segments=tuple(
            SegmentSummary(label, int(n), float(d), float(a), float(c), abs(float(r)), abs(float(b)), abs(float(r)))
            for label, n, d, a, c, r, b in zip(
                means.labels, positions.rows, positions.duration, means.f[:, 0],
                np.sign(means.output) * positions.turns, fit.rate, before, strict=True,
            )
        ),
        provenance=Provenance(dict(run.input_sha256), f"piga {__version__}", now(), {"source": run.source}),
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
    ):
        if labels:
            listed = ", ".join(labels[:8]) + (" ..." if len(labels) > 8 else "")
            events.append(Event(kind, len(labels), None, f"positions {listed}: {words}; left out"))
    return events
