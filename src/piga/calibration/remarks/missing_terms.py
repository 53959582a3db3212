"""Terms that are missing in the model and that the residuals suggest: an added-variable test of every candidate.

All candidates are reduced together with the model in one square-root reduction. The factor then gives the decrease of
the sum of squares by a candidate and its estimate: ``(x.e)^2/(x.x)`` and ``(x.e)/(x.x)``. Here x and e are candidate
and residual after the model is projected out (own derivation, docs/theory). A candidate must pass two tests: against
the noise, and against the scatter between segments. Errors of single positions are then not mistaken for a term. If
the record is smooth over a few samples, the trapezoidal rule integrates the columns of candidates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from piga.calibration.fit.one_run import Fit
from piga.calibration.model.design import Design, Joined
from piga.calibration.model.reduction import solve_upper
from piga.calibration.model.solution import layout_of, name_coefficients, parameter_rows
from piga.calibration.weights import Whitener, rate_share
from piga.records.calibration import Coefficient, MissingTerm
from piga.records.run import Run
from piga.records.terms import SERVO_TERMS, harmonic, si_factor, unit_of
from piga.results import Array

Names = tuple[str, ...]


@dataclass(frozen=True)
class CandidateSettings:
    """Limits for suggesting a missing term, and rows used for the test (own choices)."""

    false_alarms: float = 0.002
    """Probability that a record of a right model gets any suggestion, Bonferroni over the candidates."""
    thermal_alarms: float = 0.005
    """The same for a bias that follows a recorded temperature: one candidate, expected in advance."""
    sample_turn: float = 0.1
    """Turn of the output between the samples of a candidate [rad]: the error of the trapezoid is 1e-3."""
    confounded: float = 1e-3
    """Smallest independent part of a candidate, relative to its size, for the candidate to be determined."""
    notable: float = 0.01
    """Chi-square reduction (relative) above which a term is always reported."""
    like_a_cube: float = 0.5
    """Share of the best candidate's decrease above which the servo's stiffness is suggested instead of a cube
    of a_x."""
    alike: float = 0.9
    """Share of the best candidate's decrease above which another candidate is called similar."""
    suggestions: int = 3
    """Most terms suggested."""
    pieces: int = 24
    """Parts of a record of few segments, for the scatter between parts."""
    spare: int = 3
    """Segments beyond the number of parameters above which the scatter between segments is used."""
    constant: float = 1e-3
    """Largest relative change of a squared force that counts as constant."""
    force_samples: int = 4096
    """Samples used for this."""
    windows: int = 8
    """Windows of the record in which its smoothness is tested."""
    window_samples: int = 1024
    """Samples of such a window."""
    longest_step: int = 64
    """Most samples spanned by a step."""
    straight: float = 1e-3
    """Largest distance of the force from a straight line, over the largest force, that counts as none."""


CANDIDATES = CandidateSettings()


def smooth_step(run: Run, turn: float) -> int:
    """Step in samples over which the output turns by less than ``turn`` [rad] and the force is a straight line."""
    starts = np.unique(
        np.linspace(0, max(run.size - CANDIDATES.window_samples, 0), CANDIDATES.windows).astype(np.int64)
    )
    return min(_step(run, slice(int(start), int(start) + CANDIDATES.window_samples), turn) for start in starts)


def _step(run: Run, window: slice, turn: float) -> int:
    inside = ~run.begins[window][1:]
    turned = np.abs(np.diff(run.output[window]))[inside]
    largest = float(np.quantile(turned, 0.95)) if turned.size else 0.0
    step = int(min(turn / largest, CANDIDATES.longest_step)) if largest > 0.0 else 1
    f = run.f[window]
    limit = CANDIDATES.straight * max(float(np.abs(f).max()), 1e-300)
    while step > 1:
        ends = f[: f.shape[0] - f.shape[0] % step : step]
        middle = f[step // 2 :: step][: ends.shape[0] - 1]
        line = ends[:-1] + (ends[1:] - ends[:-1]) * ((step // 2) / step)
        if middle.size and np.quantile(np.abs(middle - line), 0.9) < limit:
            break
        step //= 2
    return max(step, 1)


SINGLE = (
    "k0", "k1", "k2", "k3", "k2o", "m_Y", "m_Z", "k_XY", "k_XZ", "k_YY", "k_ZZ", "k_YZ", "k0_t", "k0_T", "k1_T",
    *SERVO_TERMS,
)  # fmt: skip
CUBIC = ("servo", "k3", "k2o")
"""Terms that take up an odd signature of a_x, most plausible first."""
PAIRS = (("tan_beta", ("p", "q")), ("s1", ("s1", "c1")), ("s2", ("s2", "c2")))
"""Candidates that turn with the output: their term and columns."""


def candidate_terms(design: Design) -> list[tuple[str, ...]]:
    """Columns of every candidate that is missing in the model and that the record can determine.

    Candidates that turn with the output are skipped unless the zero of its angle is known in all segments.
    """
    terms, run = design.request.terms, design.run
    low, high = (
        (0.0, 0.0) if run.temperature is None else (float(run.temperature.min()), float(run.temperature.max()))
    )
    left_out = set(terms) | ({"k1"} if "scale_factor" in terms else set())
    left_out |= {"k0_T", "k1_T"} if low == high else set()
    left_out |= servo_out_of_reach(design)
    candidates: list[tuple[str, ...]] = [(name,) for name in SINGLE if name not in left_out]
    if design.request.phases == "shared" or "tan_beta" in terms:
        candidates += [columns for name, columns in PAIRS if name not in terms]
    return candidates


def servo_out_of_reach(design: Design) -> set[str]:
    """Terms that a record cannot separate from the servo terms of the model, and servo terms that it cannot determine."""
    total, across = constant_squares(design.run)
    terms = design.request.terms
    scaled = "scale_factor" in terms or "k1" in terms
    names = set(design.turning_servo) if "tan_beta" in terms else set(SERVO_TERMS)
    if scaled and total is not None:
        names |= {"k3"} if "servo" in terms else set()
        names |= {"servo"} if "k3" in terms else set()
    if scaled and across is not None:
        names |= {"servo"}
    return names


def constant_squares(run: Run) -> tuple[float | None, float | None]:
    """``a_x^2 + a_t^2`` and ``a_t^2`` [m^2/s^4] of a record; None for one that changes."""
    f = run.f[np.unique(np.linspace(0, run.size - 1, CANDIDATES.force_samples).astype(np.int64))]
    across = f[:, 1] ** 2 + f[:, 2] ** 2
    squares: list[float | None] = []
    for square in (across + f[:, 0] ** 2, across):
        low, middle, high = np.quantile(square, (0.005, 0.5, 0.995))
        squares.append(float(middle) if high - low <= CANDIDATES.constant * middle else None)
    return squares[0], squares[1]


def candidate_sums(fit: Fit, joined: Joined, names: list[str], step: int) -> Array:
    """Integrals of the candidates over joined intervals (sums of their values, for a log of rates), (names, n).

    Parameters
    ----------
    fit, joined, names:
        The fit, a block of its design and the columns wanted.
    step:
        Samples between evaluations, where the record is smooth. A log of rates is evaluated at all samples.
    """
    design, run = fit.design, fit.design.run
    size, starts = joined.stop - joined.start, joined.starts
    first = joined.start if design.point else joined.start - 1
    at = np.arange(size)
    if not design.point:
        looked = np.zeros(size + 1, dtype=bool)
        looked[::step] = looked[starts] = looked[size] = True
        at = np.flatnonzero(looked)
    rows = first + at
    phase = fit.solution.phases
    group = joined.segment if phase.size > 1 else 0
    alpha = design.phase_angle[rows] + (phase[group] if phase.size else 0.0)
    a = np.ascontiguousarray(run.f[rows].T)
    t = run.t[rows] - design.time_reference
    warm = t if run.temperature is None else run.temperature[rows] - design.request.temperature_reference
    turning = a if run.base_rate is None else a - run.base_rate[rows].T / design.scale_factor
    values = term_values(names, a, t, warm, turning, alpha)
    if design.point:
        return np.asarray(np.add.reduceat(values, starts, axis=1))
    half = 0.5 * np.where(run.begins[first + 1 + at[:-1]], 0.0, np.diff(t))
    return np.asarray(
        np.add.reduceat(half * (values[:, 1:] + values[:, :-1]), np.searchsorted(at, starts), axis=1)
    )


PRODUCTS = {
    "k0": "", "k1": "x", "k2": "xx", "k3": "xxx", "m_Y": "y", "m_Z": "z",
    "k_XY": "xy", "k_XZ": "xz", "k_YY": "yy", "k_ZZ": "zz", "k_YZ": "yz",
}  # fmt: skip
"""Terms that are products of the axes of the force."""


def term_values(names: Sequence[str], a: Array, t: Array, warm: Array, turning: Array, alpha: Array) -> Array:
    """Integrands (names, n) of the columns of terms at the samples.

    Parameters
    ----------
    names:
        Terms, or ``p``, ``q`` of the coupling.
    a:
        (3, n) specific force [m/s^2].
    t, warm:
        (n,) time [s] and temperature [K] from their references.
    turning:
        (3, n) specific force less base rate over K [m/s^2].
    alpha:
        (n,) angle that the column turns with [rad].
    """
    turns = any(name in ("p", "q", "s1", "c1", "s2", "c2", *SERVO_TERMS) for name in names)
    sine, cosine = (np.sin(alpha), np.cos(alpha)) if turns else (t, t)
    along, across = turning[1] * cosine + turning[2] * sine, turning[1] * sine - turning[2] * cosine
    values = np.empty((len(names), t.size))
    others: dict[str, Callable[[], Array]] = {
        "s1": lambda: sine,
        "c1": lambda: cosine,
        "s2": lambda: 2.0 * sine * cosine,
        "c2": lambda: cosine * cosine - sine * sine,
        "p": lambda: across,
        "q": lambda: along,
        "servo": lambda: -2.0 * turning[0] * across**2,
        "servo_damping": lambda: -(turning[0] ** 2) * along,
        "k2o": lambda: a[0] * np.abs(a[0]),
        "k0_t": lambda: t,
        "k0_T": lambda: warm,
        "k1_T": lambda: a[0] * warm,
    }
    for name, value in zip(names, values, strict=True):
        order = harmonic(name)
        if name in others:
            value[:] = others[name]()
        elif order:
            value[:] = np.sin(order[1] * alpha) if order[0] == "s" else np.cos(order[1] * alpha)
        else:
            value[:] = 1.0
            for axis in PRODUCTS[name]:
                np.multiply(value, a["xyz".index(axis)], out=value)
    return values


@dataclass(frozen=True)
class Tested:
    """A candidate (one column, or a pair that turns with the output) against the model.

    ``columns`` are its column coefficients with ``std`` by the noise and ``spread`` by the scatter between the parts of
    the record. ``freedom`` is the number of degrees of freedom of the scatter. ``fall`` is the relative decrease of the
    sum of squares. ``probability`` is that of such a decrease by chance (the larger of both tests). ``change`` is the
    change of the parameters when the candidate is added.
    """

    names: Names
    columns: Array
    std: Array
    spread: Array
    freedom: int
    fall: float
    probability: float
    change: Array


@dataclass(frozen=True)
class Candidates:
    """A fit without slow noise, and the columns of all terms that may be missing in it.

    Slow noise would absorb the signature of a missing term. The columns are computed when they are first used.
    """

    fit: Fit

    @cached_property
    def order(self) -> list[str]:
        """Names of the columns: candidates for a suggestion, and signatures of the servo."""
        names = [name for names in candidate_terms(self.fit.design) for name in names]
        return names + [name for name in ("k3", "servo_damping") if name not in names]

    @cached_property
    def pieces(self) -> tuple[list[Array], int]:
        """Factors of the parts of the record, and the number of rows."""
        return pieces_of(self.fit, self.order)


def suggest_terms(candidates: Candidates, coefficients: tuple[Coefficient, ...]) -> tuple[MissingTerm, ...]:
    """The few missing terms whose signature is in the residuals, best first; none is added to the model.

    Parameters
    ----------
    candidates:
        Those of the finished fit.
    coefficients:
        The result, with combined standard uncertainties.
    """
    fit = candidates.fit
    left = candidate_terms(fit.design)
    if fit.design.request.phase_source != "output" or not left:
        return ()
    order = candidates.order
    pieces, rows = candidates.pieces
    suggestions: list[MissingTerm] = []
    limit = CANDIDATES.false_alarms / len(left)
    square = constant_squares(fit.design.run)[0]
    for _ in range(CANDIDATES.suggestions):
        tests = [
            t
            for names in left
            if (t := tested(pieces, order, names, rows))
            and t.probability < (CANDIDATES.thermal_alarms if names == ("k0_T",) else limit)
        ]
        shifts = [_largest_shift(fit, coefficients, t) for t in tests]
        worth = [
            (test, shift)
            for test, shift in zip(tests, shifts, strict=True)
            if shift[0] > 1.0 or test.fall > CANDIDATES.notable
        ]
        if not worth:
            break
        best, shift = max(worth, key=lambda item: item[0].fall)
        if best.names == ("k0_t",):
            warm = [
                item
                for item in worth
                if item[0].names == ("k0_T",) and item[0].fall > CANDIDATES.alike * best.fall
            ]
            best, shift = (warm or [(best, shift)])[0]
        best, shift = _servo_first(best, shift, worth, square)
        alike = [
            ", ".join(terms_of(t.names))
            for t in tests
            if t is not best and t.fall > CANDIDATES.alike * best.fall
        ]
        entry = _suggestion(best, shift, alike, fit.design.scale_factor)
        if square is not None and best.names[0] in ("servo", "k3"):
            after = after_change(fit, best.change)
            under = _both_meanings(best, after, square, fit.design.scale_factor)
            entry = replace(entry, scale_factor_under=under)
        suggestions.append(entry)
        pieces = [with_term(piece, order, best.names) for piece in pieces]
        order = [name for name in order if name not in best.names]
        taken = CUBIC[:2] if square is not None and best.names[0] in CUBIC[:2] else best.names
        left = [names for names in left if names != best.names and names[0] not in taken]
    return tuple(suggestions)


def _servo_first(
    best: Tested, shift: tuple[float, str], worth: list[tuple[Tested, tuple[float, str]]], square: float | None
) -> tuple[Tested, tuple[float, str]]:
    """The servo's stiffness in place of a cube of a_x with a similar fit, if the record cannot separate them."""
    if square is None or best.names[0] not in CUBIC:
        return best, shift
    servo = [(t, s) for t, s in worth if t.names == ("servo",) and t.fall > CANDIDATES.like_a_cube * best.fall]
    return servo[0] if servo else (best, shift)


def _both_meanings(
    test: Tested, after: dict[str, float], square: float, scale_factor: float
) -> dict[str, float]:
    """K with each meaning of a cubic signature; they differ by the coefficient times ``a_x^2 + a_t^2``."""
    size, scale = float(test.columns[0]) / scale_factor * square, after.get("scale_factor")
    if scale is None:
        return {}
    under = (scale, scale * (1.0 - size)) if test.names == ("servo",) else (scale * (1.0 + size), scale)
    return dict(zip(CUBIC[:2], under, strict=True))


def terms_of(names: Names) -> Names:
    """Terms of the columns of a candidate."""
    return ("tan_beta",) if names == ("p", "q") else names


def pieces_of(fit: Fit, extra: list[str]) -> tuple[list[Array], int]:
    """Factors ``[parameters | extra | residual]`` of the parts of the record, and the number of rows."""
    design, layout = fit.design, layout_of(fit.design)
    segments = len(design.run.labels)
    parameters = len(layout.columns) + len(extra[:2])
    parts = 1 if segments >= parameters + CANDIDATES.spare else math.ceil(CANDIDATES.pieces / segments)
    collected: list[list[Array]] = [[] for _ in range(segments)]
    total, step = 0, smooth_step(design.run, CANDIDATES.sample_turn)

    for segment, weighted, formed in joined_rows(
        fit, lambda one: candidate_sums(fit, one, extra, step), len(extra)
    ):
        total += formed
        collected[segment].append(weighted)
    pieces = []
    for segment, chunks in enumerate(collected):
        rows = np.concatenate(chunks) if chunks else np.zeros((0, 0))
        if chunks and _stated(fit):
            own, rows = rows[:, 0], rows[:, 1:]
            rows = rows - float(rate_share(fit.noise.stated[segment], own @ own)) * np.outer(own, own @ rows)
        split = np.array_split(rows, parts) if chunks else []
        pieces += [parameter_rows(design, fit.solution, segment, piece) for piece in split]
    return pieces, total


def _stated(fit: Fit) -> bool:
    """True if the weights include a stated scatter of the segments."""
    return bool(fit.noise.stated) and fit.mode == "increments"


def joined_rows(fit: Fit, others: Callable[[Joined], Array], size: int) -> Iterator[tuple[int, Array, int]]:
    """Segment, weighted rows ``[columns | others | residual]`` and number of formed rows, block by block.

    Neighbouring increments are joined, because few rows are enough. ``others`` are ``size`` further columns
    (size, n) of the joined intervals. With a stated scatter of the segments, the intervals are the first column.
    """
    design, mode = fit.design, "samples" if fit.mode == "samples" else "increments"
    stated = _stated(fit)
    whitener = Whitener(mode, fit.noise, len(design.names) + size + 1 + stated, design.run.median_step)
    for joined in design.joined():
        model, h = joined.columns, joined.h
        values = fit.solution.values[joined.segment]
        columns = np.vstack([model[:-1], others(joined), model[-1] - values @ model[:-1]])
        if mode == "samples":
            columns = columns / np.sqrt(np.maximum(h, 1.0))
        if stated:
            columns = np.vstack([h, columns])
        weighted = whitener.apply(np.ascontiguousarray(columns), h)
        kept = h > 0.0
        yield joined.segment, np.ascontiguousarray(weighted[:, kept].T), int(np.count_nonzero(kept))


def tested(pieces: list[Array], order: list[str], names: Names, rows: int) -> Tested | None:
    """Test of a candidate; None if it has no independent part."""
    from scipy.special import fdtrc

    m, q = pieces[0].shape[1] - len(order) - 1, len(names)
    chosen = [*range(m), *(m + order.index(name) for name in names), -1]
    parts = [piece[:, chosen] for piece in pieces]
    stacked = np.vstack(parts)
    scale = np.linalg.norm(stacked[:, :-1], axis=0)
    if not scale.all():
        return None
    R: Array = np.asarray(np.linalg.qr(stacked / np.append(scale, 1.0), mode="r"))
    own = R[m : m + q, m : m + q]
    if np.linalg.svd(own, compute_uv=False)[-1] < CANDIDATES.confounded or np.abs(np.diag(R)[:m]).min() == 0.0:
        return None
    z = R[m : m + q, -1]
    fall, rest = float(z @ z), float(R[m + q, -1] ** 2)
    freedom = rows - m - q
    if freedom < 1 or fall + rest == 0.0:
        return None
    size = solve_upper(own, z)
    model = solve_upper(R[:m, :m], R[:m, m : m + q])
    variance = rest / freedom
    by_noise = float(fdtrc(q, freedom, fall / q / max(variance, 1e-300)))
    by_parts, spread, count = _scatter(parts, scale, model, R, size)
    std = np.sqrt(variance * np.sum(solve_upper(own, np.eye(q)) ** 2, axis=1))
    change = -(model @ size) / scale[:m]
    chance = max(by_noise, by_parts)
    columns, std, spread = size / scale[m:], std / scale[m:], spread / scale[m:]
    return Tested(names, columns, std, spread, count, fall / (fall + rest), chance, change)


def _scatter(parts: list[Array], scale: Array, model: Array, R: Array, size: Array) -> tuple[float, Array, int]:
    """Probability of the estimate, given the scatter of its score between the parts of the record.

    With it come the standard uncertainties of the estimate by this scatter, and their degrees of freedom.
    """
    from scipy.special import fdtrc

    m, q = model.shape
    own = R[m : m + q, m : m + q]
    fitted = solve_upper(R[: m + q, : m + q], R[: m + q, -1])
    scatter = np.zeros((q, q))
    for part in parts:
        x = part[:, :-1] / scale
        score = (x[:, m:] - x[:, :m] @ model).T @ (part[:, -1] - x @ fitted)
        scatter += np.outer(score, score)
    count = len(parts)
    freedom = max(count - m - q, 4)
    information = own.T @ own
    scatter *= count / freedom
    weight = information @ size
    ratio = float(weight @ np.linalg.pinv(scatter) @ weight) / q
    inverse = np.linalg.inv(information)
    spread = np.sqrt(np.maximum(np.diag(inverse @ scatter @ inverse), 0.0))
    return float(fdtrc(q, freedom, ratio)), spread, freedom


def after_change(fit: Fit, change: Array) -> dict[str, float]:
    """Coefficients (file units) by key after a change of the parameters: column coefficients, or amplitudes with several phases."""
    layout = layout_of(fit.design, max(len(fit.solution.phases), 1))
    if fit.design.has_phases:
        moved = replace(fit.solution, amplitudes=fit.solution.amplitudes + change[: layout.size])
    else:
        linear = fit.solution.values[0] + change[: len(layout.columns)]
        phase = math.atan2(linear[1], linear[0]) if layout.coupled else 0.0
        moved = replace(
            fit.solution,
            amplitudes=layout.from_linear(linear, phase),
            phases=np.array([phase]) if layout.coupled else fit.solution.phases,
        )
    named, _ = name_coefficients(fit.design, moved, fit.solution.covariance)
    return {c.key: c.value for c in named}


def _largest_shift(fit: Fit, coefficients: tuple[Coefficient, ...], test: Tested) -> tuple[float, str]:
    """Largest change of a reported coefficient in its standard uncertainties, and its name.

    The phase is included if the candidate affects it by nature.
    """
    after = after_change(fit, test.change)
    left_out = () if test.names == ("servo_damping",) else ("phi",)
    shifts = [
        (abs(_difference(c, after[c.key])) / c.std, c.name)
        for c in coefficients
        if c.name not in left_out and c.std > 0.0
    ]
    return max(shifts, default=(0.0, ""))


def _difference(coefficient: Coefficient, value: float) -> float:
    change = value - coefficient.value
    return math.remainder(change, 2.0 * math.pi) if coefficient.name == "phi" else change


def with_term(piece: Array, order: list[str], names: Names) -> Array:
    """The factor with the columns of a candidate among the parameters."""
    m = piece.shape[1] - len(order) - 1
    taken = [m + order.index(name) for name in names]
    rest = [m + k for k, name in enumerate(order) if name not in names]
    return piece[:, [*range(m), *taken, *rest, piece.shape[1] - 1]]


def _suggestion(test: Tested, shift: tuple[float, str], alike: list[str], scale_factor: float) -> MissingTerm:
    size, std = test.columns / scale_factor, test.std / scale_factor
    if test.names == ("p", "q"):
        size, std = np.array([math.hypot(*size)]), std[:1]
    terms = terms_of(test.names)
    units = np.array([si_factor(name) for name in terms])
    return MissingTerm(
        terms=terms,
        estimate=tuple((size / units).tolist()),
        standard_uncertainty=tuple((std / units).tolist()),
        unit=tuple(unit_of(name) for name in terms),
        chi2_fall=test.fall,
        probability=test.probability,
        largest_shift=shift[0],
        coefficient=shift[1],
        alike=tuple(alike),
    )


def suggestions_in_words(
    suggestions: tuple[MissingTerm, ...], *, held: bool = False, turned: bool = False
) -> tuple[str, ...]:
    """One sentence for each suggestion.

    ``held``, ``turned``: both meanings of a cube, and what ``servo_damping`` would change, are in the budget.
    """
    notes = []
    for entry in suggestions:
        sizes = ", ".join(
            f"{name} = {value:.3g} +/- {std:.1g}{'' if unit == '1' else f' {unit}'}"
            for name, value, std, unit in zip(
                entry.terms, entry.estimate, entry.standard_uncertainty, entry.unit, strict=True
            )
        )
        under = entry.scale_factor_under
        meaning = (
            "; no record of this stand can separate servo from k3, because a_x^2 + a_t^2 never changes: "
            "scale_factor becomes "
            + " and ".join(f"{value:.8g} with {name}" for name, value in under.items())
            + f" {unit_of('scale_factor')}, a choice of meaning"
            + (", and its uncertainty here covers both" if held else "")
            + "; a servo of finite stiffness has 'servo', and 'servo_damping' with it"
            if under
            else ""
        )
        alike = f"; {', '.join(entry.alike)} would explain nearly as much" if entry.alike else ""
        if turned and entry.terms == ("servo_damping",):
            meaning += "; the uncertainties cover this shift"
        notes.append(
            f"the residuals have the signature of a missing term: {sizes} would lower their sum of squares by "
            f"{_two_digits(100.0 * entry.chi2_fall)} % and move {entry.coefficient} by {_two_digits(entry.largest_shift)} "
            f"standard uncertainties{alike}{meaning}; not applied: add it to [model] terms if it makes sense"
        )
    return tuple(notes)


def _two_digits(value: float) -> str:
    """Two digits without a power of ten: 0.93, 12, 340."""
    return f"{value:.2g}" if abs(value) < 99.5 else f"{float(f'{value:.2g}'):.0f}"
