"""Effect of servo terms that the model does not contain, as sources of Type B.

If ``a_x^2 + a_t^2 = N`` is constant, ``a_x a_t^2 = N a_x - a_x^3``. A servo of finite stiffness and a third-order
coefficient then fit the record alike. The scale factor of one model is ``1 + k3 N`` times that of the other. Data of
such a stand cannot separate them. A suggestion therefore gives the scale factor of both models. If the signature is clear and
neither term is requested, or only ``k3``, the difference is a source of Type B. The damping of the float under the
servo turns the phase. If its wave is clear and ``servo_damping`` is not requested, the change by this term is a source
too (docs/understanding/servo).

A servo that is not named and not clear is a source of Type B, too: the record excludes it only above some size. What it may
move K below this limit is in the budget.

Several runs may separate what one stand cannot. If they separate ``servo`` from ``k3``, the better term is suggested, and its
effect is in the budget.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from piga.calibration.fit import Fit, repetitions, without_scatter
from piga.calibration.joint import JointFit, merge_runs
from piga.calibration.model.design import Design, Names
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.solution import name_coefficients, solve
from piga.calibration.remarks.missing_terms import (
    CUBIC,
    Candidates,
    CandidateTest,
    after_change,
    constant_squares,
    tested,
    with_term,
)
from piga.calibration.servo import at_state, reduce_settled
from piga.calibration.sources import across_squared
from piga.calibration.summary import LiveRun, RunSummary
from piga.calibration.uncertainty import budget_row, unstated_servo
from piga.calibration.weights import Positions, of_segments, reduce_positions, with_scatter
from piga.errors import CalibrationError, IdentifiabilityError
from piga.records.calibration import BudgetEntry, Coefficient, StandSource
from piga.records.calibration.coefficient import changes, coverage_factor
from piga.records.terms import SERVO_TERMS, si_factor, unit_of
from piga.results import Array

_CLEAR = 0.01
"""Probability of such a signature by chance, below which it enters the budget."""
_SEEN = 2.0
"""Ratio of a requested k3 to its standard uncertainty above which its other meaning is reported."""
_NEGLIGIBLE = 1e-9
"""Relative change of K by the softest servo below which none is listed."""
_SOFTEST = 1e-4
"""Softest servo that is assumed [g/g^3]: its rotor axis tilts by 1e-4 rad at 45 degrees in 1 g (2 s a_x a_t)."""


CUBIC_SOURCE = "meaning of the cubic signature: servo or k3"
DAMPING_SOURCE = "servo damping that the model lacks"
_UNNAMED_SOURCE = "servo that is not named"
"""Names in the budget. They begin as :data:`piga.records.calibration.coefficient.OF_THE_MODEL` requires."""
_ONE_SIDED = 1.645
"""Standard uncertainties up to a one-sided 95 % limit."""
TURNED = ("phi", "tan_beta")
"""Coefficients that take up most of a missing ``servo_damping``."""


@dataclass(frozen=True)
class LeftOut:
    """A clear signature of the servo that no term of the model absorbs.

    ``change`` is the half-width of its effect on each coefficient of the result (file units). ``words`` are its note;
    empty if the signature is not clear by itself. ``listed`` is its place among the sources of the stand.
    """

    source: str
    change: Array
    words: str
    listed: StandSource | None = None

    @property
    def covariance(self) -> Array:
        """Its contribution to the covariance of the coefficients."""
        return np.outer(self.change, self.change) / 3.0

    def largest_shift(self, coefficients: tuple[Coefficient, ...]) -> float:
        """Largest change of a coefficient in its standard uncertainties."""
        sizes = zip(np.abs(self.change).tolist(), coefficients, strict=True)
        return max((size / c.std for size, c in sizes if c.std > 0.0), default=0.0)

    def row(self, coefficients: tuple[Coefficient, ...]) -> BudgetEntry:
        """Its row of the budget: a uniform distribution between the half-widths."""
        return budget_row(self.source, "B", "rectangular", None, "", coefficients, self.change / math.sqrt(3.0))


def left_out_terms(candidates: Candidates, coefficients: tuple[Coefficient, ...]) -> tuple[LeftOut, ...]:
    """Servo signatures in a record; empty if none is clear, if terms absorb them, or if the stand separates them.

    Parameters
    ----------
    candidates:
        Those of the fit without slow noise.
    coefficients:
        Those of the result.
    """
    plain = candidates.fit
    design = plain.design
    held = (*design.request.terms, *design.turning_servo)
    if design.request.phase_source != "output" or design.run.direct:
        return ()
    square = constant_squares(design.run)[0]
    cube = square is not None and "scale_factor" in held and not set(CUBIC) & set(held)
    named = "servo" in held or ("k3" in held and square is not None) or "scale_factor" not in held
    unnamed = () if named else _unnamed(candidates, coefficients, square)
    if "tan_beta" not in held:
        return unnamed
    settled = square is None or design.turning_servo or "servo" in design.run.uncertainty.waived
    asked = () if square is None or settled else _asked_cube(coefficients, square)
    damping = "servo_damping" not in held and not design.has_phases
    if not cube and not damping:
        return asked
    order, (pieces, rows) = candidates.order, candidates.pieces
    before = after_change(plain, np.zeros(1))
    doubts: list[LeftOut] = []
    if square is not None and cube:
        test = tested(pieces, order, ("k3",), rows)
        if test is not None and test.probability <= _CLEAR:
            after = after_change(plain, test.change)
            k3 = float(test.columns[0]) / design.scale_factor
            cube_with = {"servo": after["scale_factor"] * (1.0 + k3 * square), "k3": after["scale_factor"]}
            doubts.append(_cubic_doubt(coefficients, before, after, cube_with, k3 / si_factor("k3")))
            pieces = [with_term(piece, order, ("k3",)) for piece in pieces]
            order = [name for name in order if name != "k3"]
    test = tested(pieces, order, ("servo_damping",), rows) if damping else None
    if test is not None and (doubts or asked or test.probability <= _CLEAR):
        beside = ("k3", "servo_damping") if doubts else ("servo_damping",)
        whole = _with_terms(plain, beside)
        if whole is not None:
            after = after_change(plain, test.change)
            turned = {name: whole[name] for name in TURNED}
            doubts.append(damped(coefficients, before, after | turned, test, design.scale_factor))
    covered = any(doubt.source == CUBIC_SOURCE for doubt in doubts)
    return (*doubts, *asked, *(() if covered else unnamed))


def _unnamed(
    candidates: Candidates, coefficients: tuple[Coefficient, ...], square: float | None
) -> tuple[LeftOut, ...]:
    """The servo that a record does not exclude: by the column of ``servo``, without ``tan_beta`` by the cube in 1 g.

    Without both it is listed with its effect, and has no size.
    """
    plain, unit = candidates.fit, si_factor("servo")
    run = plain.design.run
    if "servo" in run.uncertainty.waived:
        return ()
    along, across = run.f[:, 0] ** 2, across_squared(run, slice(None))
    part = _SOFTEST * unit * float(along @ across / max(float(along.sum()), 1e-300))
    if part < _NEGLIGIBLE:
        return ()
    pieces, rows = candidates.pieces
    names = ("servo",) if "servo" in candidates.order else ("k3",)
    if names == ("k3",) and square is None:
        return (LeftOut(_UNNAMED_SOURCE, np.zeros(len(coefficients)), "", unstated_servo(plain)),)
    test = tested(pieces, candidates.order, names, rows)
    if test is None:
        moved = [c.value * part if c.name == "scale_factor" else 0.0 for c in coefficients]
        return (_unnamed_servo(np.array(moved), _SOFTEST, math.inf),)
    before, after = (after_change(plain, change) for change in (np.zeros(1), test.change))
    size, std, spread = (
        float(values[0]) / plain.design.scale_factor / unit for values in (test.columns, test.std, test.spread)
    )
    if names == ("k3",) and square is not None:
        after["scale_factor"] *= 1.0 + size * unit * square
    std = max(std, spread * coverage_factor(test.freedom) / coverage_factor(math.inf))
    shift = _difference(coefficients, before, after | {name: before[name] for name in TURNED if name in before})
    return (_unnamed_servo(shift, size, std),)


def _unnamed_servo(shift: Array, size: float, std: float) -> LeftOut:
    """The servo that is not named. A record, or several, give it as ``size``, with ``std`` [g/g^3].

    ``shift`` is the change of the coefficients by ``size``. The half-width is that of the 95 % limit, one-sided because a
    stiffness is not negative, but at most that of the softest servo.
    """
    softest = _SOFTEST
    limit = max(size, 0.0) + _ONE_SIDED * std
    told = limit < softest
    words = (
        f"not named: the record excludes more than {1e6 * limit:.2g} ug/g^3"
        if told
        else f"not named, and the record hardly tells it from K: up to {1e6 * softest:.0f} ug/g^3 are assumed"
    )
    listed = StandSource("servo", "bounded" if told else "assumed", reason=words)
    return LeftOut(_UNNAMED_SOURCE, shift * (min(limit, softest) / size), "", listed)


def _with_terms(plain: Fit, extra: tuple[str, ...]) -> dict[str, float] | None:
    """Coefficients (file units) by key of the fit with more terms; None if the record cannot separate them.

    The change by a term depends on the weights of every row. The coarse rows for testing candidates are not enough.
    """
    request = replace(plain.design.request, terms=(*plain.design.request.terms, *extra))
    raw = Design(plain.design.run, request, plain.design.scale_factor)
    try:
        design, parts = reduce_settled(raw, plain.mode, plain.noise)
    except IdentifiabilityError:
        return None
    solution = solve(design, of_segments(with_scatter(parts, plain.noise), Positions.of(raw.run)))
    named, _ = name_coefficients(design, solution, solution.covariance)
    return {c.key: c.value for c in named}


def _cubic_doubt(
    coefficients: tuple[Coefficient, ...],
    before: dict[str, float],
    after: dict[str, float],
    under: dict[str, float],
    size: float,
) -> LeftOut:
    """A clear cube of ``size`` (file unit) that no term absorbs, on a stand that cannot separate servo from k3.

    ``before`` and ``after`` are the coefficients without and with a cube; ``under`` is K with each term (file unit).
    """
    at = next(i for i, c in enumerate(coefficients) if c.name == "scale_factor")
    change = np.array([0.0 if c.name == "phi" else after[c.key] - before[c.key] for c in coefficients])
    change[at] = max((value - coefficients[at].value for value in under.values()), key=abs)
    named = ", ".join(f"{value:.8g} with {name}" for name, value in under.items())
    words = (
        f"the residuals contain a cube of a_x ({size:.3g} g/g^3): a_x^2 + a_t^2 never changes here, "
        f"so no record of this stand can separate servo from k3. scale_factor would be {named} "
        f"{unit_of('scale_factor')}; its uncertainty covers both. Every servo has a finite stiffness: "
        "add 'servo' (and 'servo_damping') to [model] terms; a run on a centrifuge or [instrument] "
        "servo decides"
    )
    return LeftOut(CUBIC_SOURCE, change, words)


def _asked_cube(coefficients: tuple[Coefficient, ...], square: float) -> tuple[LeftOut, ...]:
    """The other meaning of a requested ``k3``, if ``a_x^2 + a_t^2`` is constant: ``square`` [m^2/s^4]."""
    named = {c.name: c for c in coefficients}
    scale, k3 = named.get("scale_factor"), named.get("k3")
    if scale is None or k3 is None:
        return ()
    shift = scale.value * k3.value * si_factor("k3") * square
    if abs(k3.value) > _SEEN * k3.std:
        return (_other_meaning(coefficients, scale, shift),)
    moved = np.array([shift if c is scale else 0.0 for c in coefficients])
    return (_unnamed_servo(moved, k3.value, k3.std),)


def _other_meaning(coefficients: tuple[Coefficient, ...], scale: Coefficient, shift: float) -> LeftOut:
    """A requested ``k3`` that may be the servo; with ``servo`` in its place the scale factor changes by ``shift``."""
    words = (
        "k3 may be the effect of the servo: a_x^2 + a_t^2 never changes here, and with 'servo' "
        f"instead of 'k3' the fit is the same; scale_factor is then {scale.value + shift:.8g} instead "
        f"of {scale.value:.8g} {scale.unit}, {1e6 * shift / scale.value:+.3g} ppm. The uncertainty of "
        "scale_factor covers both. A run on a centrifuge, calibrated together with this one, or "
        "[instrument] servo decides"
    )
    return LeftOut(CUBIC_SOURCE, np.array([shift if c is scale else 0.0 for c in coefficients]), words)


def damped(
    coefficients: tuple[Coefficient, ...],
    before: dict[str, float],
    after: dict[str, float],
    test: CandidateTest,
    scale_factor: float,
) -> LeftOut:
    """A wave of ``servo_damping`` that is missing in the model.

    It is examined if it is clear, or if a clear cube shows that the servo yields. A damping is then expected. ``before``
    and ``after`` are the coefficients without and with it. The changes of phi and tan_beta are counted from the reported
    values, which may have other weights. One standard uncertainty of the damping is added to its size.
    """
    size, std = abs(float(test.columns[0])), float(test.std[0])
    damping = float(test.columns[0]) / scale_factor / si_factor("servo_damping")
    reported = {c.key: c.value for c in coefficients if c.name in TURNED}
    change = _difference(coefficients, before | reported, after)
    turned = ", ".join(
        f"{c.key} by {1e3 * step:.3g} mrad"
        for c, step in zip(coefficients, change, strict=True)
        if c.name == "phi"
    )
    words = (
        "the residuals contain a wave of the gimbal angle that grows with the square of a_x "
        f"(servo_damping = {damping:.3g} g/g^3): its effect turns {turned}, and the uncertainties "
        "cover this. Add 'servo_damping' to [model] terms to take it out"
    )
    return LeftOut(DAMPING_SOURCE, change * (1.0 + std / size), words if test.probability <= _CLEAR else "")


def _difference(
    coefficients: tuple[Coefficient, ...], before: dict[str, float], after: dict[str, float]
) -> Array:
    """Change of each coefficient between two results."""
    values = (np.array([result[c.key] for c in coefficients]) for result in (before, after))
    return changes(coefficients, *values)


EXTRA = ("k3", *SERVO_TERMS)
"""Terms that are tried."""
_LACKING = {"servo": "servo terms that the model lacks", "k3": "k3 that the model lacks"}
"""Names in the budget where the runs tell servo from k3."""


@dataclass(frozen=True)
class _LeftOutRows:
    """The runs with the columns of ``EXTRA``, weighted without slow noise.

    ``pieces`` hold, for each run, the phase group within the run and the reduction of each segment. A run with only a
    summary has one entry per phase group.
    """

    fit: JointFit
    summaries: tuple[RunSummary, ...]
    pieces: tuple[tuple[tuple[int, Reduction], ...], ...]

    def refit(self, terms: Names) -> JointFit | None:
        """The runs with these terms; None if they cannot separate the terms."""
        wish = replace(self.fit.wish, terms=terms)
        try:
            return merge_runs(wish, list(self.summaries), [None] * len(self.summaries))
        except IdentifiabilityError:
            return None


@dataclass(frozen=True)
class _Wider:
    """The runs with more terms: ``test`` is that of the terms added, ``before`` and ``after`` the fits."""

    before: JointFit
    after: JointFit
    test: CandidateTest

    @property
    def fall(self) -> float:
        """Relative fall of the sum of squares."""
        return 1.0 - self.after.estimate.cost / self.before.estimate.cost


def left_out_of_runs(fit: JointFit) -> tuple[LeftOut, ...]:
    """Servo signatures in several runs; empty if none is clear or terms take them up."""
    terms = fit.wish.terms
    held = {*terms, *(name for summary in fit.summaries for name, _ in summary.known_servo)}
    cube = "scale_factor" in terms and "scale_factor" not in fit.wish.per_run and "servo" not in held
    if "tan_beta" not in terms or not (cube or "servo_damping" not in held):
        return ()
    try:
        rows = _rows(fit)
        base = rows.refit(terms)
    except CalibrationError:
        return ()
    if base is None:
        return ()
    unnamed = _unnamed_of_runs(rows, base) if cube else ()
    if cube and not set(CUBIC) & held and rows.refit((*terms, "servo", "k3")):
        return _lacking(rows, base) or unnamed
    doubts: list[LeftOut] = []
    if cube and "k3" in terms and "k3" not in fit.wish.per_run:
        doubts += _asked(rows, base)
    if cube and not set(CUBIC) & held:
        by_k3, by_servo = _clear(rows, base, ("k3",)), rows.refit((*terms, "servo"))
        if by_k3 and by_servo:
            after = _values(by_k3.after)
            under = {"servo": _values(by_servo)["scale_factor"], "k3": after["scale_factor"]}
            doubts.append(_cubic_doubt(fit.coefficients, _values(base), after, under, after["k3"]))
            base = by_k3.after
    limit = 1.0 if any(doubt.source == CUBIC_SOURCE for doubt in doubts) else _CLEAR
    wave = _clear(rows, base, ("servo_damping",), limit) if "servo_damping" not in held else None
    if wave:
        scale_factor = fit.summaries[0].scale_factor
        doubts.append(damped(fit.coefficients, _values(base), _values(wave.after), wave.test, scale_factor))
    covered = any(doubt.source == CUBIC_SOURCE for doubt in doubts)
    return (*doubts, *(() if covered else unnamed))


def _unnamed_of_runs(rows: _LeftOutRows, base: JointFit) -> tuple[LeftOut, ...]:
    """The servo that the runs do not exclude; empty if one of them waives it, or if they cannot tell it."""
    sources = (source for summary in rows.fit.summaries for source in summary.stand_sources)
    wider = rows.refit((*base.wish.terms, "servo"))
    if wider is None or any(source.name == "servo" and source.status == "waived" for source in sources):
        return ()
    servo = next(c for c in wider.coefficients if c.name == "servo")
    before, after = _values(base), _values(wider)
    after |= {key: before[key] for key in before if key.startswith(TURNED)}
    shift = _difference(rows.fit.coefficients, before, after)
    std = servo.std * servo.coverage_factor / coverage_factor(math.inf)
    return (_unnamed_servo(shift, servo.value, std),)


def _clear(rows: _LeftOutRows, base: JointFit, names: Names, limit: float = _CLEAR) -> _Wider | None:
    """The runs with additional terms; None if they cannot separate them, or if the effect may be chance."""
    after = rows.refit((*base.wish.terms, *names))
    if after is None:
        return None
    count = sum(summary.count for summary in rows.summaries)
    test = tested(_pieces(rows, after, names), list(names), names, count)
    if test is None or test.probability > limit or _chance_by_scatter(after, names) > limit:
        return None
    return _Wider(base, after, test)


def _chance_by_scatter(fit: JointFit, names: Names) -> float:
    """Probability of terms as large as these by chance, by the scatter of the positions."""
    at = [index for index, c in enumerate(fit.coefficients) if c.name in names]
    scores = np.array([fit.coefficients[index].value / fit.coefficients[index].std for index in at])
    covariance = fit.covariance[np.ix_(at, at)]
    size = np.sqrt(np.diag(covariance))
    distance = scores @ np.linalg.solve(covariance / np.outer(size, size), scores)
    return float(chdtrc(len(at), distance))


def _values(fit: JointFit) -> dict[str, float]:
    """Coefficients (file units) by key."""
    return {c.key: c.value for c in fit.coefficients}


def _rows(fit: JointFit) -> _LeftOutRows:
    """The runs with the columns of all terms that are tried."""
    summaries, pieces = [], []
    for index, (summary, live) in enumerate(zip(fit.summaries, fit.live, strict=True)):
        if live is None:
            summaries.append(replace(summary, sources=()))
            pieces.append(tuple(enumerate(summary.parts)))
            continue
        wider, own = _with_columns(fit, index, summary, live)
        summaries.append(wider)
        pieces.append(own)
    return _LeftOutRows(fit, tuple(summaries), tuple(pieces))


def _with_columns(
    fit: JointFit, index: int, summary: RunSummary, live: LiveRun
) -> tuple[RunSummary, tuple[tuple[int, Reduction], ...]]:
    """A run at hand with the columns of ``EXTRA``: its summary, and its segments with their phase groups."""
    terms = fit.wish.terms_of(index)
    wish = replace(live.request, terms=(*terms, *(name for name in EXTRA if name not in terms)), per_run=())
    plain = without_scatter(live.fit)
    design = Design(live.run, wish, summary.inner_scale_factor)
    segments = plain.reduce(design)
    positions = repetitions(design, plain.noise, reduce_positions(design, plain.mode, plain.noise))
    wider = replace(summary, positions=positions, sources=())
    return wider, tuple(zip(design.groups, segments, strict=True))


def _pieces(rows: _LeftOutRows, fit: JointFit, names: Names) -> list[Array]:
    """Factors ``[parameters | names | residual without them]`` of all segments, linear about a fit with them."""
    layout = fit.layout
    amplitudes, phases = fit.estimate.amplitudes, fit.estimate.phases
    keys = layout.amplitude_keys
    at = [keys.index((name, None)) for name in names]
    others = [i for i in range(layout.size + phases.size) if i not in at]
    factors = []
    for index, (summary, pieces) in enumerate(zip(rows.summaries, rows.pieces, strict=True)):
        known, wanted = fit.known_servo(index), fit.wanted(index)
        chosen = summary.choose(tuple(piece for _, piece in pieces), fit.local, fit.stored(index))
        for (own, _), piece in zip(pieces, chosen, strict=True):
            group = fit.first_group(index) + own
            part = piece if fit.servo is None else at_state(piece, wanted, fit.servo, group, known)
            columns, observed = part.factor[:, :-1], part.factor[:, -1]
            turned = columns @ layout.jacobian(amplitudes, phases, group)
            left = observed - columns @ layout.linear(amplitudes, float(phases[group]), group)
            factors.append(
                np.column_stack([turned[:, others], turned[:, at], left + turned[:, at] @ amplitudes[at]])
            )
    return factors


def _asked(rows: _LeftOutRows, base: JointFit) -> tuple[LeftOut, ...]:
    """The other meaning of a requested ``k3``, if the runs cannot separate it from the servo."""
    terms, coefficients = base.wish.terms, rows.fit.coefficients
    named = {c.key: c for c in coefficients}
    k3, scale = named["k3"], named["scale_factor"]
    swapped = rows.refit(tuple("servo" if name == "k3" else name for name in terms))
    if swapped is None or rows.refit((*terms, "servo")):
        return ()
    shift = _values(swapped)["scale_factor"] - _values(base)["scale_factor"]
    if abs(k3.value) > _SEEN * k3.std:
        return (_other_meaning(coefficients, scale, shift),)
    moved = np.array([shift if c is scale else 0.0 for c in coefficients])
    return (_unnamed_servo(moved, k3.value, k3.std),)


def _lacking(rows: _LeftOutRows, base: JointFit) -> tuple[LeftOut, ...]:
    """Missing terms that the runs can separate: those of the servo, or ``k3``."""
    servo = tuple(name for name in SERVO_TERMS if name not in base.wish.terms)
    tried = [_clear(rows, base, names) for names in dict.fromkeys((servo, ("servo",), ("k3",)))]
    clear = [wider for wider in tried if wider]
    if not clear:
        return ()
    best = max(clear, key=lambda wider: wider.fall)
    coefficients, after = rows.fit.coefficients, _values(best.after)
    change = _difference(coefficients, {c.key: c.value for c in coefficients}, after)
    words = _lacking_words(best.test.names, best.after.coefficients, coefficients, after)
    return (LeftOut(_LACKING[best.test.names[0]], change, words),)


def _lacking_words(
    names: Names, wider: tuple[Coefficient, ...], coefficients: tuple[Coefficient, ...], after: dict[str, float]
) -> str:
    sizes = ", ".join(f"{c.key} = {c.value:.3g} +/- {c.std:.1g} {c.unit}" for c in wider if c.name in names)
    moved = ", ".join(
        f"{c.key} {after[c.key]:.8g} instead of {c.value:.8g} {c.unit}".removesuffix(" 1")
        for c in coefficients
        if c.name in ("scale_factor", "tan_beta")
    )
    quoted = " and ".join(f"'{name}'" for name in names)
    return (
        f"the runs together show {sizes}, which the model lacks; with it they give {moved}. The "
        f"uncertainties cover this shift. Add {quoted} to [model] terms if it makes sense"
    )
