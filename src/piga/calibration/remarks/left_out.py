"""Effect of servo terms that the model does not contain, as sources of Type B.

If ``a_x^2 + a_t^2 = N`` is constant, ``a_x a_t^2 = N a_x - a_x^3``. A servo
of finite stiffness and a third-order coefficient then fit the record alike, and the scale factor of one model is ``1 + k3 N``
times that of the other. If this signature is clear and neither term is requested, or only ``k3``, the difference is a source. The
damping of the float under the servo turns the phase; if its wave is clear, the change by it is a source too
(docs/understanding/servo). A servo that is not named and not clear is in the budget up to the size that the record does not
exclude. Several runs may separate what one stand cannot. Then the better term is suggested like any other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from piga.calibration.joint import JointFit
from piga.calibration.model.design import STIFFNESS_COLUMNS
from piga.calibration.remarks.missing_terms import (
    CUBIC,
    Candidates,
    CandidateTest,
    either_in_words,
    held_terms,
    size_in_words,
    values_of,
)
from piga.calibration.sources import across_squared
from piga.records.arrays import spans
from piga.records.calibration.coefficient import Coefficient, StandSource, changes, coverage_factor
from piga.records.terms import GYRO, SERVO_TERMS, si_factor
from piga.results import Array

_CLEAR = 0.01
"""Probability of a signature of the servo by chance, below which it enters the budget."""
_SEEN = 2.0
"""Ratio of a requested k3 to its standard uncertainty above which its other meaning is reported."""
_NEGLIGIBLE = 1e-9
"""Relative change of K by the softest servo below which none is listed."""
_SOFTEST = 1e-4
"""Softest servo that is assumed [g/g^3]: its rotor axis tilts by 1e-4 rad at 45 degrees in 1 g (2 s a_x a_t)."""
_ONE_SIDED = 1.645
"""Standard uncertainties up to a one-sided 95 % limit."""

CUBIC_SOURCE = "meaning of the cubic signature: servo or k3"
DAMPING_SOURCE = "servo damping that the model lacks"
LACKING_SOURCE = "servo terms that the model lacks"
_UNNAMED_SOURCE = "servo that is not named"
"""Names in the budget. They begin as :data:`piga.records.calibration.coefficient.OF_THE_MODEL` requires."""
_TURNED = ("phi", "tan_beta")
"""Coefficients that take up most of a missing ``servo_damping``."""


@dataclass(frozen=True)
class LeftOut:
    """A signature of the servo that no term of the model absorbs.

    ``change`` is the half-width of its effect on each coefficient of the result (file units). ``words`` are its note;
    empty if the signature is not clear by itself. ``listed`` is its place among the sources of the stand.
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
    named = "servo" in held or ("k3" in held and square is not None) or not scaled
    unnamed = () if named or waived else _unnamed(fit, candidates)
    if "tan_beta" not in held:
        return unnamed
    without_servo = not {*SERVO_TERMS} & held
    together = _together(fit, candidates) if scaled and without_servo else ()
    if together:
        return together
    asked = _asked_cube(coefficients, square) if square is not None and without_servo and not waived else ()
    cube = square is not None and scaled and not {*CUBIC} & held
    damping = "servo_damping" not in held and all(len(summary.labels) == 1 for summary in fit.summaries)
    cubic = candidates.test(("k3",)) if cube else None
    doubts: list[LeftOut] = []
    if cubic is not None and cubic.probability <= _CLEAR:
        moved, size = candidates.moved(cubic), float(cubic.size[0]) / si_factor("k3")
        under, names = candidates.under(cubic, moved), [c.name for c in coefficients]
        change = np.where(np.array(names) == "phi", 0.0, moved)
        at = names.index("scale_factor")
        change[at] = max((value - coefficients[at].value for value in under.values()), key=abs)
        words = f"the residuals contain a cube of a_x ({size:.3g} g/g^3): {either_in_words(under, held=True)}"
        doubts.append(LeftOut(CUBIC_SOURCE, change, words))
    clear = ("k3",) if doubts else ()
    wave = candidates.test(("servo_damping",), clear) if damping else None
    if wave is not None and (doubts or asked or wave.probability <= _CLEAR):
        # the wave turns with the phase that it moves: a linear step is not enough
        whole = candidates.refit((*clear, "servo_damping"))
        if whole is not None:
            doubts.append(_damped(coefficients, candidates.moved(wave), whole, wave))
    covered = any(doubt.source == CUBIC_SOURCE for doubt in doubts)
    return (*doubts, *asked, *(() if covered else unnamed))


def _together(fit: JointFit, candidates: Candidates) -> tuple[LeftOut, ...]:
    """Both terms of the servo, if several runs show both: each alone may fit badly, because the damping turns the phases."""
    if fit.only or candidates.squares[0] is not None or not {*SERVO_TERMS} <= {*candidates.order}:
        return ()
    wider = candidates.refit(SERVO_TERMS)
    pair = [wider[name] for name in SERVO_TERMS] if wider else []
    if wider is None or any(
        abs(c.value) < coverage_factor(c.degrees_of_freedom, 1.0 - _CLEAR) * c.std for c in pair
    ):
        return ()
    sizes = ", ".join(size_in_words(c.key, c.value, c.std, c.unit) for c in pair)
    moved = ", ".join(
        f"{c.key} {wider[c.key].value:.8g} instead of {c.value:.8g} {c.unit}".removesuffix(" 1")
        for c in fit.coefficients
        if c.name in ("scale_factor", "tan_beta")
    )
    words = (
        f"the runs together show {sizes}, which the model lacks; with it they give {moved}. The uncertainties cover "
        "this shift. Add 'servo' and 'servo_damping' to [model] terms if it makes sense"
    )
    return (LeftOut(LACKING_SOURCE, _to(fit.coefficients, wider), words),)


def _to(coefficients: tuple[Coefficient, ...], wider: dict[str, Coefficient]) -> Array:
    """Change of the coefficients to those of a fit with more terms."""
    return changes(coefficients, values_of(coefficients), values_of([wider[c.key] for c in coefficients]))


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
    if name is None:
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


def _bounded(shift: Array, size: float, std: float) -> LeftOut:
    """A servo that is not named: ``size`` with ``std`` [g/g^3] by the records; ``shift`` is what ``size`` changes."""
    limit = max(size, 0.0) + _ONE_SIDED * std
    words = (
        f"not named: the record excludes more than {1e6 * limit:.2g} ug/g^3"
        if limit < _SOFTEST
        else f"not named, and the record hardly tells it from K: up to {1e6 * _SOFTEST:.0f} ug/g^3 are assumed"
    )
    listed = StandSource("servo", "bounded" if limit < _SOFTEST else "assumed", reason=words)
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
    if abs(k3.value) <= _SEEN * k3.std:
        return (_bounded(moved, k3.value, k3.std),)
    both = {"servo": scale.value + shift, "k3": scale.value}
    return (
        LeftOut(CUBIC_SOURCE, moved, f"k3 may be the effect of the servo: {either_in_words(both, held=True)}"),
    )


def _damped(
    coefficients: tuple[Coefficient, ...], moved: Array, whole: dict[str, Coefficient], wave: CandidateTest
) -> LeftOut:
    """A wave of ``servo_damping`` that is missing in the model.

    It is examined if it is clear, or if a clear cube shows that the servo yields. A damping is then expected. The changes of phi
    and tan_beta are those of the ``whole`` fit, counted from the reported values, which may have other weights. One standard
    uncertainty of the damping is added to its size.
    """
    damping, std = (float(own[0]) / si_factor("servo_damping") for own in (wave.size, wave.std))
    change = np.where([c.name in _TURNED for c in coefficients], _to(coefficients, whole), moved)
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
    clear = wave.probability <= _CLEAR
    return LeftOut(DAMPING_SOURCE, change * (1.0 + std / abs(damping)), words if clear else "")
