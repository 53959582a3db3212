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
from scipy.special import fdtrc

from piga.calibration.fit import Fit, repetitions, without_scatter
from piga.calibration.joint import JointFit, merge_runs
from piga.calibration.model.design import Design, Names
from piga.calibration.model.solution import name_coefficients, solve
from piga.calibration.remarks.missing_terms import (
    CUBIC,
    Candidates,
    constant_squares,
    tested,
    with_term,
)
from piga.calibration.servo import at_phases, reduce_settled
from piga.calibration.sources import across_squared
from piga.calibration.summary import LiveRun, RunSummary
from piga.calibration.uncertainty import budget_row, unstated_servo
from piga.calibration.weights import Positions, of_segments, reduce_positions, with_scatter
from piga.errors import CalibrationError, IdentifiabilityError
from piga.records.arrays import spans
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


def left_out_terms(fit: JointFit, candidates: Candidates) -> tuple[LeftOut, ...]:
    """Servo signatures in the records; empty if none is clear, if terms absorb them, or if the stand separates them.

    ``candidates`` are those of the fit without scatter.
    """
    only, coefficients = candidates.fit.only, fit.coefficients
    if only is None:
        return _left_out_of_runs(fit)
    plain, design = only.fit, only.fit.design
    held = (*design.request.terms, *design.turning_servo)
    if design.request.phase_source != "output" or design.run.direct:
        return ()
    square = constant_squares(design.run)[0]
    cube = square is not None and "scale_factor" in held and not set(CUBIC) & set(held)
    named = "servo" in held or ("k3" in held and square is not None) or "scale_factor" not in held
    unnamed = () if named else _unnamed(fit, candidates, square)
    if "tan_beta" not in held:
        return unnamed
    settled = square is None or design.turning_servo or "servo" in design.run.uncertainty.waived
    asked = () if square is None or settled else _asked_cube(coefficients, square)
    damping = "servo_damping" not in held and not design.has_phases
    if not cube and not damping:
        return asked
    order, (pieces, rows) = candidates.order, candidates.pieces
    before = {c.key: c.value for c in candidates.fit.coefficients}
    doubts: list[LeftOut] = []
    if square is not None and cube:
        test = tested(pieces, order, ("k3",), rows)
        if test is not None and test.probability <= _CLEAR:
            after = candidates.after(test.change)
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
            after = candidates.after(test.change)
            turned = {name: whole[name] for name in TURNED}
            unit = design.scale_factor * si_factor("servo_damping")
            size = (float(test.columns[0]) / unit, float(test.std[0]) / unit)
            is_clear = test.probability <= _CLEAR
            doubts.append(_damped(coefficients, before, after | turned, size, clear=is_clear))
    covered = any(doubt.source == CUBIC_SOURCE for doubt in doubts)
    return (*doubts, *asked, *(() if covered else unnamed))


def _unnamed(fit: JointFit, candidates: Candidates, square: float | None) -> tuple[LeftOut, ...]:
    """The servo that a record does not exclude: by the column of ``servo``, without ``tan_beta`` by the cube in 1 g.

    Without both it is listed with its effect, and has no size.
    """
    unit, coefficients = si_factor("servo"), fit.coefficients
    if fit.only is None:
        return ()
    design, run = fit.only.fit.design, fit.only.run
    if "servo" in run.uncertainty.waived:
        return ()
    weighted, total = 0.0, 1e-300
    for part in spans(run.size):
        along = run.f[part, 0] ** 2
        weighted, total = weighted + float(along @ across_squared(run, part)), total + float(along.sum())
    share = _SOFTEST * unit * weighted / total
    if share < _NEGLIGIBLE:
        return ()
    pieces, rows = candidates.pieces
    names = ("servo",) if "servo" in candidates.order else ("k3",)
    if names == ("k3",) and square is None:
        listed = unstated_servo(fit.record(0, fit.only), [c.key for c in coefficients])
        return (LeftOut(_UNNAMED_SOURCE, np.zeros(len(coefficients)), "", listed),)
    test = tested(pieces, candidates.order, names, rows)
    if test is None:
        moved = [c.value * share if c.name == "scale_factor" else 0.0 for c in coefficients]
        return (_unnamed_servo(np.array(moved), _SOFTEST, math.inf),)
    before, after = {c.key: c.value for c in candidates.fit.coefficients}, candidates.after(test.change)
    size, std, spread = (
        float(values[0]) / design.scale_factor / unit for values in (test.columns, test.std, test.spread)
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
        design, rows = reduce_settled(raw, plain.mode, plain.noise)
    except IdentifiabilityError:
        return None
    parts = with_scatter(at_phases(design, rows), plain.noise)
    solution = solve(design, of_segments(parts, Positions.of(raw.run)))
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


def _damped(
    coefficients: tuple[Coefficient, ...],
    before: dict[str, float],
    after: dict[str, float],
    size: tuple[float, float],
    *,
    clear: bool,
) -> LeftOut:
    """A wave of ``servo_damping`` that is missing in the model: ``size`` and its standard uncertainty [g/g^3].

    It is examined if it is clear, or if a clear cube shows that the servo yields. A damping is then expected. ``before``
    and ``after`` are the coefficients without and with it. The changes of phi and tan_beta are counted from the reported
    values, which may have other weights. One standard uncertainty of the damping is added to its size.
    """
    damping, std = size
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
    return LeftOut(DAMPING_SOURCE, change * (1.0 + std / abs(damping)), words if clear else "")


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
class _WideRuns:
    """The runs with the columns of ``EXTRA``, weighted without scatter."""

    fit: JointFit
    summaries: tuple[RunSummary, ...]

    @classmethod
    def of(cls, fit: JointFit) -> _WideRuns:
        """The runs of a fit. Those without raw data have the columns of their summaries."""
        runs = enumerate(zip(fit.summaries, fit.live, strict=True))
        return cls(fit, tuple(_with_columns(fit, index, summary, live) for index, (summary, live) in runs))

    def refit(self, terms: Names) -> JointFit | None:
        """The runs with these terms; None if they cannot separate the terms."""
        wish = replace(self.fit.wish, terms=terms)
        try:
            return merge_runs(wish, list(self.summaries), [None] * len(self.summaries))
        except IdentifiabilityError:
            return None

    def clear(self, base: JointFit, names: Names, limit: float = _CLEAR) -> JointFit | None:
        """The runs with additional terms; None if they cannot separate them, or if the effect may be chance."""
        after = self.refit((*base.wish.terms, *names))
        return None if after is None or _chance(after, names) > limit else after


def _left_out_of_runs(fit: JointFit) -> tuple[LeftOut, ...]:
    """Servo signatures in several runs; empty if none is clear or terms take them up."""
    terms = fit.wish.terms
    held = {*terms, *(name for summary in fit.summaries for name, _ in summary.known_servo)}
    cube = "scale_factor" in terms and "scale_factor" not in fit.wish.per_run and "servo" not in held
    if "tan_beta" not in terms or not (cube or "servo_damping" not in held):
        return ()
    try:
        rows = _WideRuns.of(fit)
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
        by_k3, by_servo = rows.clear(base, ("k3",)), rows.refit((*terms, "servo"))
        if by_k3 and by_servo:
            after = _values(by_k3)
            under = {"servo": _values(by_servo)["scale_factor"], "k3": after["scale_factor"]}
            doubts.append(_cubic_doubt(fit.coefficients, _values(base), after, under, after["k3"]))
            base = by_k3
    limit = 1.0 if any(doubt.source == CUBIC_SOURCE for doubt in doubts) else _CLEAR
    wave = rows.clear(base, ("servo_damping",), limit) if "servo_damping" not in held else None
    if wave:
        damping = next(c for c in wave.coefficients if c.name == "servo_damping")
        is_clear = _chance(wave, ("servo_damping",)) <= _CLEAR
        doubts.append(
            _damped(
                fit.coefficients, _values(base), _values(wave), (damping.value, damping.std), clear=is_clear
            )
        )
    covered = any(doubt.source == CUBIC_SOURCE for doubt in doubts)
    return (*doubts, *(() if covered else unnamed))


def _unnamed_of_runs(rows: _WideRuns, base: JointFit) -> tuple[LeftOut, ...]:
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


def _chance(fit: JointFit, names: Names) -> float:
    """Probability of terms as large as these by chance, by the scatter of the positions (F test)."""
    at = [index for index, c in enumerate(fit.coefficients) if c.name in names]
    size = np.array([fit.coefficients[index].value for index in at])
    square = size @ np.linalg.solve(fit.covariance[np.ix_(at, at)], size)
    return float(fdtrc(len(at), fit.degrees[at].min(), square / len(at)))


def _values(fit: JointFit) -> dict[str, float]:
    """Coefficients (file units) by key."""
    return {c.key: c.value for c in fit.coefficients}


def _with_columns(fit: JointFit, index: int, summary: RunSummary, live: LiveRun | None) -> RunSummary:
    """The summary of a run with the columns of ``EXTRA``."""
    if live is None:
        return replace(summary, sources=())
    terms = fit.wish.terms_of(index)
    wish = replace(live.request, terms=(*terms, *(name for name in EXTRA if name not in terms)), per_run=())
    plain = without_scatter(live.fit)
    design = Design(live.run, wish, summary.inner_scale_factor)
    parts = reduce_positions(design, plain.mode, plain.noise)
    return replace(summary, positions=repetitions(design, plain.noise, parts), sources=())


def _asked(rows: _WideRuns, base: JointFit) -> tuple[LeftOut, ...]:
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


def _lacking(rows: _WideRuns, base: JointFit) -> tuple[LeftOut, ...]:
    """Missing terms that the runs can separate: those of the servo, or ``k3``."""
    servo = tuple(name for name in SERVO_TERMS if name not in base.wish.terms)
    tried = {names: rows.clear(base, names) for names in (servo, ("servo",), ("k3",))}
    clear = {names: wider for names, wider in tried.items() if wider}
    if not clear:
        return ()
    names, best = min(clear.items(), key=lambda item: item[1].estimate.cost)
    coefficients, after = rows.fit.coefficients, _values(best)
    change = _difference(coefficients, {c.key: c.value for c in coefficients}, after)
    words = _lacking_words(names, best.coefficients, coefficients, after)
    return (LeftOut(_LACKING[names[0]], change, words),)


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
