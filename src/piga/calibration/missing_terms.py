"""Terms that are missing in the model: an added-variable test of every candidate, and servo terms in the budget.

All candidates are reduced together with the model in one square-root reduction. The factor then gives the decrease of
the sum of squares by a candidate and its estimate: ``(x.e)^2/(x.x)`` and ``(x.e)/(x.x)``. Here x and e are candidate
and residual after the model is projected out (own derivation, docs/theory). A candidate must pass two tests: against
the noise, and against the scatter between segments. Errors of single positions are then not mistaken for a term.

A servo that the model lacks and that the records show is covered by the change of the coefficients in a fit with its terms. If
``a_x^2 + a_t^2 = N`` is constant, ``a_x a_t^2 = N a_x - a_x^3``: a servo of finite stiffness and a third-order coefficient then fit
the records alike, and the scale factors of both models differ by ``k3 N``; both are covered (docs/understanding/servo). A servo
that is not named and not clear is in the budget up to the size that the records do not exclude.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from piga.calibration.intervals import parameter_rows
from piga.calibration.joint import JointFit, merge_runs
from piga.calibration.model.design import Design, Names
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.solution import phaseless_columns
from piga.calibration.summary import CONSTANT, RunSummary, repetitions
from piga.calibration.weights import RATE, Extra, Positions, reduce_positions
from piga.errors import CalibrationError, IdentifiabilityError
from piga.records.calibration.coefficient import Coefficient, StandSource, changes, coverage_factor, rounded
from piga.records.calibration.diagnostics import MissingTerm
from piga.records.terms import GYRO, SERVO_TERMS, harmonic, si_factor, unit_of
from piga.results import Array
from piga.terms import ERROR_TERMS, LOGGED_TERMS

Squares = list[float | None]

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
_EQUAL = 1e-6
"""Relative difference of two decreases that rounding makes: the first of the terms in the table then counts."""
_SUGGESTIONS = 3
"""Most terms suggested."""
_PIECES = 24
"""Parts of a record of few segments, for the scatter between parts."""
_SPARE = 3
"""Segments beyond the number of parameters above which the scatter between segments is used."""
_FEWEST = 4
"""Fewest degrees of freedom of this scatter."""
_CLEAR = 0.01
"""Probability that a record without a servo gets one into its budget, Bonferroni over the tests."""
_NEGLIGIBLE = 1e-9
"""Relative change of K by the softest servo below which none is listed."""
_SOFTEST = 1e-4
"""Softest servo that is assumed [g/g^3]: its rotor axis tilts by 1e-4 rad at 45 degrees in 1 g (2 s a_x a_t)."""
_ONE_SIDED = 1.645
"""Standard uncertainties up to a one-sided 95 % limit."""

LACKING_SOURCE = "servo terms that the model lacks"
_UNNAMED_SOURCE = "servo that is not named"
"""Names in the budget. They begin as :data:`piga.records.calibration.coefficient.OF_THE_MODEL` requires."""
_TURNED = ("phi", "tan_beta")
"""Coefficients that take up most of a missing ``servo_damping``."""

CUBIC = ("servo", "k3", "k2o")
"""Terms that take up an odd signature of a_x, most plausible first."""
_PAIRS = (("tan_beta", ("p", "q")), ("s1", ("s1", "c1")), ("s2", ("s2", "c2")))
"""Candidates that turn with the output: their term and columns."""


def _candidate_terms(fit: JointFit, squares: Squares) -> list[Names]:
    """Columns of every candidate that is missing in the model and that the runs can determine.

    A gyro accelerometer has no known cause of ``k1a``: ask for it by name. Candidates that turn with the output are skipped
    unless the zero of its angle is known in all segments. Left out is what the runs cannot separate from the servo terms of
    the model, and servo terms that they cannot determine.
    """
    (total, across), terms, direct = squares, fit.terms, fit.summaries[0].unit != GYRO
    scaled = "scale_factor" in terms or "k1" in terms
    skipped = {*terms} | ({"k1"} if scaled else set()) | (set() if direct else {"k1a"})
    skipped |= held_terms(fit) & {*SERVO_TERMS} if "tan_beta" in terms else {*SERVO_TERMS}
    if scaled and (across is not None or (total is not None and "k3" in terms)):
        skipped.add("servo")
    if scaled and total is not None and "servo" in terms:
        skipped.add("k3")
    candidates: list[Names] = [(name,) for name in ERROR_TERMS if name not in skipped and _is_shown(fit, name)]
    one_phase = len(fit.live) == 1 and fit.summaries[0].phases == "shared"
    if not direct and (one_phase or "tan_beta" in terms):
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
        name not in LOGGED_TERMS or live.design.run.shows(name)
        if live
        else {*columns} <= {*summary.positions[0].part.names}
        for live, summary in zip(fit.live, fit.summaries, strict=True)
    )


@dataclass(frozen=True)
class CandidateTest:
    """A candidate (one column, or a pair that turns with the output) against the model.

    ``size`` are its coefficients with ``std`` by the noise, and ``spread`` by the scatter between the parts of the record (with
    Student's factor for few parts). ``fall`` is the relative decrease of the sum of squares. ``probability`` is that of such a
    decrease by chance (the larger of both tests). ``change`` is the change of the parameters when the candidate is added.
    """

    names: Names
    size: Array
    std: Array
    spread: Array
    fall: float
    probability: float
    change: Array


@dataclass(frozen=True)
class Candidates:
    """A fit without slow noise, and the columns of all terms that may be missing in it.

    Slow noise would absorb the signature of a missing term. ``squares`` are ``a_x^2 + a_t^2`` and ``(u_t/K)^2`` [m^2/s^4] of all
    runs, None for one that changes. ``terms`` are the columns of every candidate for a suggestion, ``order`` all columns (also the
    signatures of the servo). ``common`` are the parameters of the pieces: all, but for the phases that belong to one of several
    segments. ``pieces`` are the factors ``[parameters | columns | residual]`` of the parts of the records in ``summaries``.
    """

    fit: JointFit
    squares: Squares
    terms: list[Names]
    order: list[str]
    common: list[int]
    summaries: tuple[RunSummary, ...]
    pieces: Array

    @classmethod
    def of(cls, fit: JointFit) -> Candidates:
        """The candidates of a fit without slow noise; none where the phase comes from the input."""
        estimate, layout = fit.estimate, fit.layout
        squares: list[float | None] = []
        for of_runs in zip(*(summary.squares for summary in fit.summaries), strict=True):
            known = [square for square in of_runs if square is not None]
            alike = len(known) == len(of_runs) and max(known) - min(known) <= CONSTANT * max(known)
            squares.append(sum(known) / len(known) if alike else None)
        terms = [] if fit.by_input else _candidate_terms(fit, squares)
        names = [name for names in terms for name in names]
        more = () if fit.by_input else ("k3", "servo_damping") if layout.coupled else ("k3",)
        order = names + [n for n in more if n not in {*names} | held_terms(fit) and _is_shown(fit, n)]
        alone = [layout.coupled and len(one.labels) == 1 for one in fit.summaries for _ in one.labels]
        common = [*range(layout.size), *(layout.size + group for group in np.flatnonzero(alone).tolist())]
        summaries = tuple(_wide(fit, index, order) if order else one for index, one in enumerate(fit.summaries))
        pieces = []
        for part in replace(fit, summaries=summaries).repetitions(estimate, (RATE, *order)) if order else ():
            local = layout.coupled and not alone[part.group]
            rows = parameter_rows(layout, estimate, part, common, local=local)
            columns = (*map(str, common), RATE, *order)
            piece = Reduction(columns, rows).without((RATE,), part.variance).factor
            phase = float(estimate.phases[part.group]) if estimate.phases.size else 0.0
            piece[:, len(common) : -1] = piece[:, len(common) : -1] @ _turn(phase, order)
            pieces.append(piece)
        return cls(fit, squares, terms, order, common, summaries, np.array(pieces))

    def test(self, names: Names, beside: Names = ()) -> CandidateTest | None:
        """Test of the columns of a candidate, with the model and the columns ``beside`` fitted; sizes in SI."""
        m, rows = len(self.common), sum(summary.count for summary in self.summaries)
        base, at = ([m + self.order.index(name) for name in own] for own in (beside, names))
        unit = self.fit.summaries[0].inner_scale_factor
        return tested(self.pieces, [*range(m), *base], at, names, rows, unit)

    def refit(self, names: Names) -> dict[str, Coefficient] | None:
        """Coefficients by key of the fit with more terms; None if the records cannot separate them."""
        try:
            fit = merge_runs(self.summaries, (*self.fit.terms, *names), self.fit.per_run)
        except (CalibrationError, IdentifiabilityError, np.linalg.LinAlgError):
            return None
        pairs = zip(fit.coefficients, fit.degrees.tolist(), strict=True)
        return {c.key: replace(c, degrees_of_freedom=own) for c, own in pairs}

    def moved(self, test: CandidateTest) -> Array:
        """Change of the coefficients (n,; file units) when a candidate is added."""
        fit = self.fit
        whole = np.zeros(fit.layout.size + fit.estimate.phases.size)
        whole[self.common] = test.change[: len(self.common)]
        return fit.moved(whole)


def held_terms(fit: JointFit) -> set[str]:
    """Terms of the model, and those of the servo that the runs give."""
    return {*fit.terms, *(name for summary in fit.summaries for name, _ in summary.known_servo)}


def _wide(fit: JointFit, index: int, extra: Sequence[str]) -> RunSummary:
    """The summary of a run with the columns of the candidates, of parts of the segments if there are few."""
    live, summary = fit.live[index], fit.summaries[index]
    if live is None:
        return summary
    run, segments = live.design.run, sum(len({p.name for p in one.positions}) for one in fit.summaries)
    design = fit.design_of(index, live)[0]
    positions = Positions.of(run)
    if not positions.continuous and segments < len(fit.layout.columns) + len(extra[:2]) + _SPARE:
        positions = positions.cut(math.ceil(_PIECES / segments))
    terms = tuple(dict.fromkeys("tan_beta" if name in ("p", "q") else name for name in extra))
    wider = Design(run, replace(design.request, terms=terms), design.scale_factor)
    new = [name for name in wider.names if name not in design.names]
    at, others = [wider.names.index(name) for name in new], design.means.beside(wider.request)
    more = Extra(tuple(new), lambda _: next(others).columns[at])
    reduced = reduce_positions(design, summary.noise, positions, more)
    variances = summary.noise.rate_variances(len(run.labels)) if not positions.continuous else np.zeros(1)
    parts = repetitions(design, replace(summary.noise, stated=(), counted=()), reduced, positions)
    held = zip(parts, variances[positions.segments].tolist(), strict=True)
    return replace(summary, positions=tuple(replace(part, variance=own) for part, own in held))


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


def tested(
    pieces: Array, base: Sequence[int], at: Sequence[int], names: Names, rows: int, unit: float
) -> CandidateTest | None:
    """Test of the columns ``at`` of the pieces beside those of ``base``; None if they have no independent part.

    ``unit`` is the value of a column coefficient for a coefficient of one.
    """
    from scipy.special import fdtrc

    m, q = len(base), len(at)
    parts = pieces[:, :, [*base, *at, -1]]
    scale = np.linalg.norm(parts[:, :, :-1], axis=(0, 1))
    if not scale.all():
        return None
    parts = parts / np.append(scale, 1.0)
    R: Array = np.asarray(np.linalg.qr(parts.reshape(-1, m + q + 1), mode="r"))
    own, z, rest = R[m : m + q, m : m + q], R[m : m + q, -1], float(R[m + q, -1] ** 2)
    if np.linalg.svd(own, compute_uv=False)[-1] < _CONFOUNDED or np.abs(np.diag(R)[:m]).min() == 0.0:
        return None
    fall, freedom, few = float(z @ z), rows - m - q, max(len(parts) - m - q, _FEWEST)
    if freedom < 1 or fall + rest == 0.0:
        return None
    variance, inverse = rest / freedom, np.linalg.solve(own, np.eye(q))
    size, model = inverse @ z, np.linalg.solve(R[:m, :m], R[:m, m : m + q])
    fitted = np.append(np.linalg.solve(R[:m, :m], R[:m, -1]) - model @ size, size)
    beside = parts[:, :, m : m + q] - parts[:, :, :m] @ model
    score = np.einsum("jkq,jk->jq", beside, parts[:, :, -1] - parts[:, :, :-1] @ fitted)
    scatter, weight = score.T @ score * len(parts) / few, own.T @ z
    ratio = float(weight @ np.linalg.pinv(scatter) @ weight) / q
    by_noise = float(fdtrc(q, freedom, fall / q / max(variance, 1e-300)))
    covariance = inverse @ inverse.T
    spread = np.sqrt(np.maximum(np.diag(covariance @ scatter @ covariance), 0.0))
    spread *= coverage_factor(few) / coverage_factor(math.inf)
    each = scale[m:] * unit
    return CandidateTest(
        names,
        size / each,
        np.sqrt(variance * np.diag(covariance)) / each,
        spread / each,
        fall / (fall + rest),
        max(by_noise, float(fdtrc(q, few, ratio))),
        -(model @ size) / scale[:m],
    )


def suggest_terms(candidates: Candidates, coefficients: tuple[Coefficient, ...]) -> tuple[MissingTerm, ...]:
    """The few missing terms whose signature is in the residuals, best first; none is added to the model.

    ``coefficients`` are the result, with combined standard uncertainties.
    """
    left, suggestions = candidates.terms, list[MissingTerm]()
    beside: Names = ()
    limit, own = _FALSE_ALARMS / max(len(left), 1), values_of(coefficients)
    square = candidates.squares[0] if left else None
    for _ in range(_SUGGESTIONS):
        found = [test for names in left if (test := candidates.test(names, beside))]
        tests = [t for t in found if t.probability < (_THERMAL_ALARMS if t.names == ("k0_T",) else limit)]
        values = values_of(candidates.fit.coefficients)
        moved = [changes(coefficients, own, values + candidates.moved(t)) for t in tests]
        shifts = {t.names: largest_shift(coefficients, m, t.names) for t, m in zip(tests, moved, strict=True)}
        worth = [t for t in tests if shifts[t.names][0] > 1.0 or t.fall > _NOTABLE]
        if not worth:
            break
        most = max(test.fall for test in worth)
        best = next(test for test in worth if test.fall >= (1.0 - _EQUAL) * most)
        likelier, share = ("k0_T", _ALIKE) if best.names == ("k0_t",) else ("", 1.0)
        if square is not None and best.names[0] in CUBIC:
            likelier, share = "servo", _LIKE_A_CUBE
        best = next((t for t in worth if t.names == (likelier,) and t.fall > share * best.fall), best)
        alike = [t for t in tests if t is not best and t.fall > _ALIKE * best.fall]
        names = tuple(", ".join(_terms_of(t.names)) for t in alike)
        suggestions.append(_suggestion(best, *shifts[best.names], names))
        beside = (*beside, *best.names)
        taken = CUBIC[:2] if square is not None and best.names[0] in CUBIC[:2] else best.names
        left = [names for names in left if names != best.names and names[0] not in taken]
    return tuple(suggestions)


def _terms_of(names: Names) -> Names:
    """Terms of the columns of a candidate."""
    return ("tan_beta",) if names == ("p", "q") else names


def largest_shift(
    coefficients: Iterable[Coefficient], change: Array, names: Names = ("servo_damping",)
) -> tuple[float, str]:
    """Largest change of a coefficient in its standard uncertainties, and its name.

    The phase is included only for ``servo_damping``, which turns it.
    """
    skipped = () if names == ("servo_damping",) else ("phi",)
    sizes = zip(coefficients, np.abs(change).tolist(), strict=True)
    shifts = [(size / c.std, c.name) for c, size in sizes if c.name not in skipped and c.std > 0.0]
    return max(shifts, default=(0.0, ""))


def values_of(coefficients: Iterable[Coefficient]) -> Array:
    """Values of coefficients (n,)."""
    return np.array([c.value for c in coefficients])


def _suggestion(test: CandidateTest, shift: float, coefficient: str, alike: Names) -> MissingTerm:
    terms, size, std = _terms_of(test.names), test.size, test.std
    if test.names == ("p", "q"):
        size, std = np.array([math.hypot(*size)]), std[:1]
    units = np.array([si_factor(name) for name in terms])
    return MissingTerm(
        terms=terms,
        estimate=tuple((size / units).tolist()),
        standard_uncertainty=tuple((std / units).tolist()),
        unit=tuple(unit_of(name) for name in terms),
        chi2_fall=test.fall,
        probability=test.probability,
        largest_shift=shift,
        coefficient=coefficient,
        alike=alike,
    )


def suggestions_in_words(suggestions: tuple[MissingTerm, ...]) -> tuple[str, ...]:
    """One sentence for each suggestion."""
    notes = []
    for entry in suggestions:
        each = zip(entry.terms, entry.estimate, entry.standard_uncertainty, entry.unit, strict=True)
        sizes = ", ".join(f"{n} = {v:.3g} +/- {u:.1g} {unit}".removesuffix(" 1") for n, v, u, unit in each)
        meaning = f"; {', '.join(entry.alike)} would explain nearly as much" if entry.alike else ""
        notes.append(
            f"the residuals have the signature of a missing term: {sizes} would lower their sum of squares by "
            f"{_two_digits(100.0 * entry.chi2_fall)} % and move {entry.coefficient} by {_two_digits(entry.largest_shift)} "
            f"standard uncertainties{meaning}; not applied: add it to [model] terms if it makes sense"
        )
    return tuple(notes)


def _two_digits(value: float) -> str:
    """Two digits without a power of ten: 0.93, 12, 340."""
    return f"{value:.2g}" if abs(value) < 99.5 else f"{float(f'{value:.2g}'):.0f}"


@dataclass(frozen=True)
class LeftOut:
    """A signature of the servo that no term of the model absorbs.

    ``change`` is the half-width of its effect on each coefficient of the result (file units). ``words`` are its note;
    empty if it is not clear. ``listed`` is its place among the sources of the stand.
    """

    source: str
    change: Array
    words: str
    listed: StandSource | None = None


def left_out_terms(fit: JointFit, candidates: Candidates) -> tuple[LeftOut, ...]:
    """Servo signatures in the records; empty if none is clear, if terms absorb them, or if the stands separate them.

    ``candidates`` are those of the fit without scatter. Phases of the segments take up a damping; on one stand that is no head
    they let it pass for a stiffness.
    """
    held, square = held_terms(fit), candidates.squares[0]
    if fit.summaries[0].unit != GYRO or fit.by_input or "scale_factor" not in held:
        return ()
    one_phase = all(len(summary.labels) == 1 for summary in fit.summaries)
    hidden = fit.only is not None and square is None and not one_phase
    lacking = _lacking(fit, candidates, one_phase) if "tan_beta" in held and not hidden else ()
    waived = any(s.name == "servo" and s.status == "waived" for one in fit.summaries for s in one.stand_sources)
    if waived or "servo" in held or (lacking and "servo" in candidates.order):
        return lacking
    if square and "k3" in held:
        return (*lacking, _asked_cube(fit.coefficients, square))
    return (*lacking, *_unnamed(fit, candidates, hidden))


def _lacking(fit: JointFit, candidates: Candidates, one_phase: bool) -> tuple[LeftOut, ...]:
    """The terms of the servo, if a fit with them shows one, or ``k3`` may be one: it has a damping, too, that turns the phases.

    The half-width is the change in that fit, and by what its standard uncertainty is larger.
    """
    names = tuple(n for n in SERVO_TERMS if n in candidates.order and (one_phase or n == "servo"))
    wider = next((found for own in (names, names[:1]) if own and (found := candidates.refit(own))), {})
    sizes = [wider[name] for name in names if name in wider]
    own, square = fit.coefficients, candidates.squares[0]
    shown = [c for c in sizes if _is_clear(c, len(sizes))]
    if not sizes or not (shown or (square is not None and any(_is_clear(c) for c in own if c.name == "k3"))):
        return ()
    change = changes(own, values_of(own), values_of([wider[c.key] for c in own]))
    change += np.copysign([math.sqrt(max(wider[c.key].std ** 2 - c.std**2, 0.0)) for c in own], change)
    moved = ", ".join(
        f"{c.key} {rounded(wider[c.key])} instead of {rounded(c)} {c.unit}".removesuffix(" 1")
        for c in own
        if c.name in ("scale_factor", "tan_beta", "phi") and c.segment is None
    )
    if square is not None and "servo" in wider:
        by_k3 = wider["scale_factor"].value * (1.0 - wider["servo"].value * si_factor("servo") * square)
        at = [c.key for c in own].index("scale_factor")
        change[at] = max(change[at], by_k3 - own[at].value, key=abs)
        moved += (
            f" (with k3 in place of servo: {by_k3:.8g}; a run on a centrifuge, calibrated together, decides)"
        )
    seen = ", ".join(f"{c.key} = {c.value:.3g} +/- {c.std:.1g} {c.unit}" for c in shown)
    words = (
        f"the residuals show {seen}, which the model lacks; with it: {moved}. The uncertainties "
        f"cover this shift. Add {' and '.join(map(repr, SERVO_TERMS if one_phase else names))} to [model] terms"
    )
    return (LeftOut(LACKING_SOURCE, change, words if shown else ""),)


def _is_clear(c: Coefficient, tests: int = 1) -> bool:
    """True if it is not zero by chance, one of so many ``tests``."""
    factor = coverage_factor(max(c.degrees_of_freedom, _FEWEST), 1.0 - _CLEAR / tests)
    return abs(c.value) > factor * c.std


def _unnamed(fit: JointFit, candidates: Candidates, hidden: bool) -> tuple[LeftOut, ...]:
    """The servo that the records do not exclude: by the column of ``servo``, without ``tan_beta`` by the cube in 1 g.

    Without both, that of one run is listed with its effect, and has no size. The half-width is that of the 95 % limit, one-sided
    because a stiffness is not negative, but at most that of the softest servo.
    """
    coefficients, square, unit = fit.coefficients, candidates.squares[0], si_factor("servo")
    rows = [summary.count for summary in fit.summaries]
    bent, total = np.average([summary.bending for summary in fit.summaries], axis=0, weights=rows)
    share = _SOFTEST * unit * float(bent / max(total, 1e-300))  # relative change of K by the softest servo
    if share < _NEGLIGIBLE:
        return ()
    names = ("servo",) if square is None else ("servo", "k3")
    name = next((name for name in names if name in candidates.order), None)
    if name is None or hidden:
        listed = StandSource("servo", "unstated", "ug/g^3")
        return (LeftOut(_UNNAMED_SOURCE, np.zeros(len(coefficients)), "", listed),) if fit.only else ()
    test, of_scale = candidates.test((name,)), np.array([c.name == "scale_factor" for c in coefficients])
    if test is None:
        return (_bounded(np.where(of_scale, share * values_of(coefficients), 0.0), _SOFTEST, math.inf),)
    moved = candidates.moved(test)
    if name == "k3" and square is not None:
        before = values_of(candidates.fit.coefficients)
        moved = np.where(of_scale, (before + moved) * (1.0 + float(test.size[0]) * square) - before, moved)
    moved[[c.name in _TURNED for c in coefficients]] = 0.0
    std = max(float(test.std[0]), float(test.spread[0])) / unit
    return (_bounded(moved, float(test.size[0]) / unit, std),)


def _bounded(shift: Array, size: float, std: float, why: str = "") -> LeftOut:
    """A servo that is not named: ``size`` with ``std`` [g/g^3] by the records; ``shift`` is what ``size`` changes.

    ``why``: words in place of those on the limit.
    """
    limit = max(size, 0.0) + _ONE_SIDED * std
    words = (
        f"not named: the record excludes more than {1e6 * limit:.2g} ug/g^3"
        if limit < _SOFTEST
        else f"not named, and the record hardly tells it from K: up to {1e6 * _SOFTEST:.0f} ug/g^3 are assumed"
    )
    listed = StandSource("servo", "bounded" if limit < _SOFTEST else "assumed", reason=why or words)
    return LeftOut(_UNNAMED_SOURCE, shift * (min(limit, _SOFTEST) / size), "", listed)


def _asked_cube(coefficients: tuple[Coefficient, ...], square: float) -> LeftOut:
    """The other meaning of a requested ``k3``, if ``a_x^2 + a_t^2`` is constant: ``square`` [m^2/s^4]."""
    named = {c.name: c for c in coefficients}
    scale, k3 = named["scale_factor"], named["k3"]
    shift = scale.value * k3.value * si_factor("k3") * square
    moved = np.array([shift if c is scale else 0.0 for c in coefficients])
    bounded = _bounded(
        moved, k3.value, k3.std, "not named, and not told from k3 here: what k3 shows is covered"
    )
    covered = (
        f"k3 may be the effect of the servo: scale_factor is {scale.value + shift:.8g} with servo and {scale.value:.8g} with k3 "
        f"{scale.unit}, and its uncertainty covers both; a run on a centrifuge, calibrated together, decides"
    )
    return replace(bounded, words=covered if _is_clear(k3) else "")
