"""Effect of servo terms that the model does not contain, as sources of Type B.

A servo that the records show is covered by the change of the coefficients in a fit with its terms. If ``a_x^2 + a_t^2 = N`` is
constant, ``a_x a_t^2 = N a_x - a_x^3``: a servo of finite stiffness and a third-order coefficient then fit the records alike, and
the scale factors of both models differ by ``k3 N``; both are covered (docs/understanding/servo). A servo that is not named and not
clear is in the budget up to the size that the records do not exclude.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from piga.calibration.joint import JointFit
from piga.calibration.model.design import STIFFNESS_COLUMNS
from piga.calibration.remarks.missing_terms import FEWEST, Candidates, held_terms, values_of
from piga.calibration.sources import across_squared
from piga.records.arrays import spans
from piga.records.calibration.coefficient import Coefficient, StandSource, changes, coverage_factor, rounded
from piga.records.terms import GYRO, SERVO_TERMS, si_factor
from piga.results import Array

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

    def largest_shift(self, coefficients: tuple[Coefficient, ...]) -> float:
        """Largest change of a coefficient in its standard uncertainties."""
        sizes = zip(np.abs(self.change).tolist(), coefficients, strict=True)
        return max((size / c.std for size, c in sizes if c.std > 0.0), default=0.0)


def left_out_terms(fit: JointFit, candidates: Candidates) -> tuple[LeftOut, ...]:
    """Servo signatures in the records; empty if none is clear, if terms absorb them, or if the stands separate them.

    ``candidates`` are those of the fit without scatter.
    """
    held, square, coefficients = held_terms(fit), candidates.squares[0], fit.coefficients
    by_input = any(live and live.request.phase_source != "output" for live in fit.live)
    if fit.summaries[0].unit != GYRO or by_input:
        return ()
    waived = any(s.name == "servo" and s.status == "waived" for one in fit.summaries for s in one.stand_sources)
    scaled = "scale_factor" in held and "scale_factor" not in fit.wish.per_run
    lacking = (
        _lacking(fit, candidates) if scaled and "tan_beta" in held and not _is_hidden(fit, candidates) else ()
    )
    if waived or not scaled or "servo" in held or (lacking and "servo" in candidates.order):
        return lacking
    return (
        *lacking,
        *(_asked_cube(coefficients, square) if square and "k3" in held else _unnamed(fit, candidates)),
    )


def _is_hidden(fit: JointFit, candidates: Candidates) -> bool:
    """True if phases of the segments of one run, on a stand that is no head, let its damping pass for its stiffness."""
    return fit.only is not None and candidates.squares[0] is None and _has_own_phases(fit)


def _lacking(fit: JointFit, candidates: Candidates) -> tuple[LeftOut, ...]:
    """The terms of the servo, if a fit with them shows one, or ``k3`` may be one: it has a damping, too, that turns the phases.

    The half-width is the change in that fit, and by what its standard uncertainty is larger.
    """
    one_phase = not _has_own_phases(fit)
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
    if square is not None and "servo" in (c.name for c in sizes):
        by_k3 = wider["scale_factor"].value * (1.0 - wider["servo"].value * si_factor("servo") * square)
        at = [c.key for c in own].index("scale_factor")
        change[at] = max(change[at], by_k3 - own[at].value, key=abs)
        moved += (
            f" (with k3 in place of servo: {by_k3:.8g}; a run on a centrifuge, calibrated together, decides)"
        )
    words = (
        f"the residuals show {', '.join(map(_in_words, shown))}, which the model lacks; with it: {moved}. The uncertainties "
        f"cover this shift. Add {' and '.join(map(repr, SERVO_TERMS if one_phase else names))} to [model] terms"
    )
    return (LeftOut(LACKING_SOURCE, change, words if shown else ""),)


def _has_own_phases(fit: JointFit) -> bool:
    """True if the segments of a run have phases of their own, which take up a damping."""
    return any(len(summary.labels) > 1 for summary in fit.summaries)


def _is_clear(c: Coefficient, tests: int = 1) -> bool:
    """True if it is not zero by chance, one of so many ``tests``."""
    factor = coverage_factor(max(c.degrees_of_freedom, FEWEST), 1.0 - _CLEAR / tests)
    return abs(c.value) > factor * c.std


def _in_words(c: Coefficient) -> str:
    return f"{c.key} = {c.value:.3g} +/- {c.std:.1g} {c.unit}"


def _unnamed(fit: JointFit, candidates: Candidates) -> tuple[LeftOut, ...]:
    """The servo that the records do not exclude: by the column of ``servo``, without ``tan_beta`` by the cube in 1 g.

    Without both, that of one run is listed with its effect, and has no size. The half-width is that of the 95 % limit, one-sided
    because a stiffness is not negative, but at most that of the softest servo.
    """
    coefficients, square, unit = fit.coefficients, candidates.squares[0], si_factor("servo")
    share, nothing = _softest_share(fit), np.zeros(len(coefficients))
    if share < _NEGLIGIBLE:
        return ()
    names = ("servo",) if square is None else ("servo", "k3")
    name = next((name for name in names if name in candidates.order), None)
    if name is None or _is_hidden(fit, candidates):
        listed = StandSource("servo", "unstated", "ug/g^3")
        return (LeftOut(_UNNAMED_SOURCE, nothing, "", listed),) if fit.only else ()
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


def _softest_share(fit: JointFit) -> float:
    """Relative change of K by the softest servo, from the records, or without any from the summaries; 0 without their columns."""
    weighted, total = 0.0, 1e-300
    for run in (live.run for live in fit.live if live):
        for part in spans(run.size):
            along = run.f[part, 0] ** 2
            weighted, total = weighted + float(along @ across_squared(run, part)), total + float(along.sum())
    names = ("scale_factor", STIFFNESS_COLUMNS[0])
    for position in () if any(fit.live) else (p for summary in fit.summaries for p in summary.positions):
        if {*names} <= {*position.part.names}:
            force, bent = position.part.select(names).factor[:, :2].T
            weighted, total = weighted + float(force @ bent), total + float(force @ force)
    return _SOFTEST * si_factor("servo") * weighted / total


def _asked_cube(coefficients: tuple[Coefficient, ...], square: float) -> tuple[LeftOut, ...]:
    """The other meaning of a requested ``k3``, if ``a_x^2 + a_t^2`` is constant: ``square`` [m^2/s^4]."""
    named = {c.name: c for c in coefficients}
    scale, k3 = named.get("scale_factor"), named.get("k3")
    if scale is None or k3 is None:
        return ()
    shift = scale.value * k3.value * si_factor("k3") * square
    moved = np.array([shift if c is scale else 0.0 for c in coefficients])
    bounded = _bounded(
        moved, k3.value, k3.std, "not named, and not told from k3 here: what k3 shows is covered"
    )
    covered = (
        f"k3 may be the effect of the servo: scale_factor is {scale.value + shift:.8g} with servo and {scale.value:.8g} with k3 "
        f"{scale.unit}, and its uncertainty covers both; a run on a centrifuge, calibrated together, decides"
    )
    return (replace(bounded, words=covered if _is_clear(k3) else ""),)
