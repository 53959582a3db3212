"""Terms that are missing in the model and that the residuals suggest: an added-variable test of every candidate.

All candidates are reduced together with the model in one square-root reduction. The factor then gives the decrease of
the sum of squares by a candidate and its estimate: ``(x.e)^2/(x.x)`` and ``(x.e)/(x.x)``. Here x and e are candidate
and residual after the model is projected out (own derivation, docs/theory). A candidate must pass two tests: against
the noise, and against the scatter between segments. Errors of single positions are then not mistaken for a term.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from piga.calibration.fit import repetitions
from piga.calibration.intervals import parameter_rows
from piga.calibration.joint import JointFit, merge_runs
from piga.calibration.model.design import STIFFNESS_COLUMNS, Design, ServoState, phaseless_columns
from piga.calibration.model.reduction import Reduction, solve_upper
from piga.calibration.sources import across_squared
from piga.calibration.summary import RunSummary
from piga.calibration.weights import RATE, Extra, Positions, reduce_positions
from piga.errors import CalibrationError, IdentifiabilityError
from piga.records.calibration.coefficient import Coefficient
from piga.records.calibration.diagnostics import MissingTerm
from piga.records.run import Run
from piga.records.terms import GYRO, SERVO_TERMS, harmonic, si_factor, unit_of
from piga.results import Array
from piga.terms import ERROR_TERMS, LOGGED_TERMS

Names = tuple[str, ...]
Squares = tuple[float | None, float | None]


_FALSE_ALARMS = 0.002
"""Probability that a record of a right model gets any suggestion, Bonferroni over the candidates."""
_THERMAL_ALARMS = 0.005
"""The same for a bias that follows a recorded temperature: one candidate, expected in advance."""
_CONFOUNDED = 1e-3
"""Smallest independent part of a candidate, relative to its size, for the candidate to be determined."""
_NOTABLE = 0.01
"""Chi-square reduction (relative) above which a term is always reported."""
_LIKE_A_CUBE = 0.5
"""Share of the best candidate's decrease above which the servo's stiffness is suggested instead of a cube
of a_x."""
_ALIKE = 0.9
"""Share of the best candidate's decrease above which another candidate is called similar."""
_SUGGESTIONS = 3
"""Most terms suggested."""
_PIECES = 24
"""Parts of a record of few segments, for the scatter between parts."""
_SPARE = 3
"""Segments beyond the number of parameters above which the scatter between segments is used."""
_CONSTANT = 1e-3
"""Largest relative change of a squared force that counts as constant."""
_FORCE_SAMPLES = 4096
"""Samples used for this."""


CUBIC = ("servo", "k3", "k2o")
"""Terms that take up an odd signature of a_x, most plausible first."""
_PAIRS = (("tan_beta", ("p", "q")), ("s1", ("s1", "c1")), ("s2", ("s2", "c2")))
"""Candidates that turn with the output: their term and columns."""


def _candidate_terms(fit: JointFit, squares: Squares) -> list[tuple[str, ...]]:
    """Columns of every candidate that is missing in the model and that the runs can determine.

    A gyro accelerometer has no known cause of ``k1a``: ask for it by name. Candidates that turn with the output are skipped
    unless the zero of its angle is known in all segments.
    """
    terms, direct = fit.wish.terms, fit.summaries[0].unit != GYRO
    left_out = set(terms) | ({"k1"} if "scale_factor" in terms else set())
    left_out |= _servo_out_of_reach(fit, squares) | (set() if direct else {"k1a"})
    candidates: list[tuple[str, ...]] = [
        (name,) for name in ERROR_TERMS if name not in left_out and _is_shown(fit, name)
    ]
    if direct:
        return candidates
    one_phase = len(fit.live) == 1 and fit.summaries[0].phases == "shared"
    if one_phase or "tan_beta" in terms:
        candidates += [
            columns
            for name, columns in _PAIRS
            if name not in terms and all(_is_shown(fit, column) for column in columns)
        ]
    return candidates


def _is_shown(fit: JointFit, name: str) -> bool:
    """True unless a run lacks the column or its logged input, or the input is the same everywhere."""
    columns = phaseless_columns((name,)) or (name,)
    return all(
        name not in LOGGED_TERMS or live.run.shows(name)
        if live
        else set(columns) <= set(summary.positions[0].part.names)
        for live, summary in zip(fit.live, fit.summaries, strict=True)
    )


def _servo_out_of_reach(fit: JointFit, squares: Squares) -> set[str]:
    """Terms that the runs cannot separate from the servo terms of the model, and servo terms that they cannot determine."""
    terms, (total, across) = fit.wish.terms, squares
    scaled = "scale_factor" in terms or "k1" in terms
    known = (name for summary in fit.summaries for name, _ in summary.known_servo)
    names = {*terms, *known} & set(SERVO_TERMS) if "tan_beta" in terms else set(SERVO_TERMS)
    if scaled and total is not None:
        names |= {"k3"} if "servo" in terms else set()
        names |= {"servo"} if "k3" in terms else set()
    if scaled and across is not None:
        names |= {"servo"}
    return names


def constant_squares(run: Run) -> Squares:
    """``a_x^2 + a_t^2`` and ``(u_t/K)^2`` [m^2/s^4] of a record; None for one that changes."""
    at = np.unique(np.linspace(0, run.size - 1, _FORCE_SAMPLES).astype(np.int64))
    squares: list[float | None] = []
    for square in ((run.f[at] ** 2).sum(axis=1), across_squared(run, at)):
        low, middle, high = np.quantile(square, (0.005, 0.5, 0.995))
        squares.append(float(middle) if high - low <= _CONSTANT * middle else None)
    return squares[0], squares[1]


def _stored_squares(summary: RunSummary) -> Squares:
    """The same from the columns ``a_x``, ``a_x (u_t/K)^2`` and ``a_x^3`` of a summary; None without them."""
    wanted = ("scale_factor", STIFFNESS_COLUMNS[0], "k3")
    if not set(wanted) <= set(summary.positions[0].part.names):
        return None, None
    along, across, cube = np.vstack(
        [position.part.select(wanted).factor[:, :3] for position in summary.positions]
    ).T
    squares: list[float | None] = []
    for column in (across + cube, across):
        square = float(along @ column / max(float(along @ along), 1e-300))
        missed = float(np.linalg.norm(column - square * along))
        squares.append(square if missed <= _CONSTANT * float(np.linalg.norm(column)) else None)
    return squares[0], squares[1]


def _common(values: Sequence[float | None]) -> float | None:
    """The value that all runs have; None if they differ."""
    held = [value for value in values if value is not None]
    alike = len(held) == len(values) and max(held) - min(held) <= _CONSTANT * max(held)
    return sum(held) / len(held) if alike else None


@dataclass(frozen=True)
class CandidateTest:
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

    fit: JointFit

    @cached_property
    def squares(self) -> Squares:
        """``a_x^2 + a_t^2`` and ``(u_t/K)^2`` [m^2/s^4] of all runs; None for one that changes."""
        fit = self.fit
        pairs = [
            constant_squares(live.run) if live else _stored_squares(summary)
            for live, summary in zip(fit.live, fit.summaries, strict=True)
        ]
        return _common([total for total, _ in pairs]), _common([across for _, across in pairs])

    @cached_property
    def terms(self) -> list[Names]:
        """Columns of every candidate for a suggestion."""
        return _candidate_terms(self.fit, self.squares)

    @cached_property
    def order(self) -> list[str]:
        """Names of the columns: candidates for a suggestion, and signatures of the servo."""
        fit, names = self.fit, [name for names in self.terms for name in names]
        held = {*fit.wish.terms, *(name for summary in fit.summaries for name, _ in summary.known_servo)}
        more = ("k3", "servo_damping") if "p" in fit.local else ("k3",)
        return names + [name for name in more if name not in {*names, *held} and _is_shown(fit, name)]

    @cached_property
    def common(self) -> list[int]:
        """Parameters of the pieces: all, but for the phases that belong to one segment each."""
        fit, size = self.fit, self.fit.layout.size
        phases = [g for g in range(fit.estimate.phases.size) if len(fit.summaries[fit.run_of(g)].labels) == 1]
        return [*range(size), *(size + g for g in phases)]

    @cached_property
    def summaries(self) -> tuple[RunSummary, ...]:
        """The runs with the columns of the candidates."""
        return tuple(_wide(self.fit, index, self.order) for index in range(len(self.fit.live)))

    @cached_property
    def pieces(self) -> tuple[list[Array], int]:
        """Factors ``[parameters | candidates | residual]`` of the parts of the records, and the number of rows."""
        fit, estimate, layout = self.fit, self.fit.estimate, self.fit.layout
        state, summaries = fit.servo, self.summaries
        if state is None and layout.coupled:
            state = ServoState(tuple(estimate.phases.tolist()), stiffness=0.0, damping=0.0, inverse=0.0)
        parts = replace(fit, summaries=summaries).repetitions(state, (RATE, *self.order))
        at, pieces = self.common, []
        for part in parts:
            local = layout.coupled and layout.size + part.group not in at
            rows = parameter_rows(layout, estimate, part, at, local=local)
            names = (*map(str, at), RATE, *self.order)
            piece = Reduction(names, rows).without((RATE,), part.variance).factor
            phase = float(estimate.phases[part.group]) if estimate.phases.size else 0.0
            piece[:, len(at) : -1] = piece[:, len(at) : -1] @ _turn(phase, self.order)
            pieces.append(piece)
        return pieces, sum(summary.count for summary in summaries)

    def refit(self, names: Names) -> JointFit | None:
        """The fit with more terms; None if the records cannot separate them."""
        wish = replace(self.fit.wish, terms=(*self.fit.wish.terms, *names))
        try:
            return merge_runs(wish, self.summaries, [None] * len(self.fit.live))
        except (CalibrationError, IdentifiabilityError):
            return None

    def after(self, change: Array) -> dict[str, float]:
        """Coefficients (file units) by key after a change of the ``common`` parameters, and of any others."""
        fit = self.fit
        whole = np.zeros(fit.layout.size + fit.estimate.phases.size)
        whole[self.common] = change[: len(self.common)]
        moved = fit.moved(whole).tolist()
        return {c.key: c.value + shift for c, shift in zip(fit.coefficients, moved, strict=True)}


def _wide(fit: JointFit, index: int, extra: Sequence[str]) -> RunSummary:
    """The summary of a run with the columns of the candidates, of parts of the segments if there are few."""
    live, summary = fit.live[index], fit.summaries[index]
    if live is None:
        return summary
    run, segments = live.run, sum(len({p.name for p in one.positions}) for one in fit.summaries)
    design = fit.design_of(index, live)[0].with_servo(None)
    positions = Positions.of(run)
    if not positions.continuous and segments < len(fit.layout.columns) + len(extra[:2]) + _SPARE:
        positions = positions.cut(math.ceil(_PIECES / segments))
    more = _columns_beside(design, extra)
    reduced = reduce_positions(design, live.fit.mode, live.fit.noise, positions, more)
    variances = live.fit.noise.rate_variances(len(run.labels)) if not positions.continuous else np.zeros(1)
    parts = repetitions(design, replace(live.fit.noise, stated=(), counted=()), reduced, positions)
    held = zip(parts, variances[positions.segments].tolist(), strict=True)
    return replace(summary, positions=tuple(replace(part, variance=own) for part, own in held))


def suggest_terms(candidates: Candidates, coefficients: tuple[Coefficient, ...]) -> tuple[MissingTerm, ...]:
    """The few missing terms whose signature is in the residuals, best first; none is added to the model.

    Parameters
    ----------
    candidates:
        Those of the finished fit.
    coefficients:
        The result, with combined standard uncertainties.
    """
    fit, left = candidates.fit, candidates.terms
    if any(live and live.request.phase_source != "output" for live in fit.live) or not left:
        return ()
    order = candidates.order
    pieces, rows = candidates.pieces
    suggestions: list[MissingTerm] = []
    scale_factor = fit.summaries[0].inner_scale_factor
    limit = _FALSE_ALARMS / len(left)
    square = candidates.squares[0]
    for _ in range(_SUGGESTIONS):
        tests = [
            t
            for names in left
            if (t := tested(pieces, order, names, rows))
            and t.probability < (_THERMAL_ALARMS if names == ("k0_T",) else limit)
        ]
        shifts = [_largest_shift(candidates, coefficients, t) for t in tests]
        worth = [
            (test, shift)
            for test, shift in zip(tests, shifts, strict=True)
            if shift[0] > 1.0 or test.fall > _NOTABLE
        ]
        if not worth:
            break
        best, shift = max(worth, key=lambda item: item[0].fall)
        if best.names == ("k0_t",):
            warm = [item for item in worth if item[0].names == ("k0_T",) and item[0].fall > _ALIKE * best.fall]
            best, shift = (warm or [(best, shift)])[0]
        best, shift = _servo_first(best, shift, worth, square)
        alike = [", ".join(terms_of(t.names)) for t in tests if t is not best and t.fall > _ALIKE * best.fall]
        entry = _suggestion(best, shift, alike, scale_factor)
        if square is not None and best.names[0] in ("servo", "k3"):
            under = _both_meanings(best, candidates.after(best.change), square, scale_factor)
            entry = replace(entry, scale_factor_under=under)
        suggestions.append(entry)
        pieces = [with_term(piece, order, best.names) for piece in pieces]
        order = [name for name in order if name not in best.names]
        taken = CUBIC[:2] if square is not None and best.names[0] in CUBIC[:2] else best.names
        left = [names for names in left if names != best.names and names[0] not in taken]
    return tuple(suggestions)


def _servo_first(
    best: CandidateTest,
    shift: tuple[float, str],
    worth: list[tuple[CandidateTest, tuple[float, str]]],
    square: float | None,
) -> tuple[CandidateTest, tuple[float, str]]:
    """The servo's stiffness in place of a cube of a_x with a similar fit, if the record cannot separate them."""
    if square is None or best.names[0] not in CUBIC:
        return best, shift
    servo = [(t, s) for t, s in worth if t.names == ("servo",) and t.fall > _LIKE_A_CUBE * best.fall]
    return servo[0] if servo else (best, shift)


def _both_meanings(
    test: CandidateTest, after: dict[str, float], square: float, scale_factor: float
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


def _columns_beside(design: Design, extra: Sequence[str]) -> Extra:
    """The columns ``extra`` beside those of a design; those of the servo without a phase."""
    terms = tuple(dict.fromkeys("tan_beta" if name in ("p", "q") else name for name in extra))
    request = replace(design.request, terms=terms)
    names = Design(design.run, request, design.scale_factor).names
    new = [name for name in names if name not in design.names]
    order = [names.index(name) for name in new]
    others = design.means.beside(request, None)
    return Extra(tuple(new), lambda _: next(others).columns[order])


def _turn(phase: float, extra: Sequence[str]) -> Array:
    """Matrix that turns columns of harmonics of the angle as read to those of the angle with the phase of the fit."""
    matrix = np.eye(len(extra))
    for name in extra:
        wave = harmonic(name)
        if wave and wave[0] == "s":
            s, c = extra.index(name), extra.index(f"c{wave[1]}")
            cosine, sine = math.cos(wave[1] * phase), math.sin(wave[1] * phase)
            matrix[np.ix_((s, c), (s, c))] = [[cosine, -sine], [sine, cosine]]
    return matrix


def tested(pieces: list[Array], order: list[str], names: Names, rows: int) -> CandidateTest | None:
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
    if np.linalg.svd(own, compute_uv=False)[-1] < _CONFOUNDED or np.abs(np.diag(R)[:m]).min() == 0.0:
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
    return CandidateTest(names, columns, std, spread, count, fall / (fall + rest), chance, change)


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


def _largest_shift(
    candidates: Candidates, coefficients: tuple[Coefficient, ...], test: CandidateTest
) -> tuple[float, str]:
    """Largest change of a reported coefficient in its standard uncertainties, and its name.

    The phase is included if the candidate affects it by nature.
    """
    after = candidates.after(test.change)
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


def _suggestion(
    test: CandidateTest, shift: tuple[float, str], alike: list[str], scale_factor: float
) -> MissingTerm:
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
