"""Effect of servo terms that the model does not contain, as sources of Type B.

If ``a_x^2 + a_t^2 = N`` is constant, ``a_x a_t^2 = N a_x - a_x^3``. A servo of finite stiffness and a third-order
coefficient then fit the record alike. The scale factor of one model is ``1 + k3 N`` times that of the other. Data of
such a stand cannot separate them. A suggestion therefore gives the scale factor of both models. If the signature is clear and
neither term is requested, or only ``k3``, the difference is a source of Type B. The damping of the float under the
servo turns the phase. If its wave is clear and ``servo_damping`` is not requested, the change by this term is a source
too (docs/understanding/servo).

A servo that is not named and not clear is a source of Type B, too: the record excludes it only above some size. What it may
move K below this limit is in the budget.

Several runs may separate what one stand cannot. Then the better term is suggested like any other
(:mod:`piga.calibration.remarks.missing_terms`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from piga.calibration.joint import JointFit
from piga.calibration.model.design import STIFFNESS_COLUMNS
from piga.calibration.remarks.missing_terms import CUBIC, Candidates, tested, with_term
from piga.calibration.sources import across_squared
from piga.records.arrays import spans
from piga.records.calibration.coefficient import Coefficient, StandSource, changes, coverage_factor
from piga.records.terms import GYRO, SERVO_TERMS, si_factor, unit_of
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
LACKING_SOURCE = "servo terms that the model lacks"
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

    def largest_shift(self, coefficients: tuple[Coefficient, ...]) -> float:
        """Largest change of a coefficient in its standard uncertainties."""
        sizes = zip(np.abs(self.change).tolist(), coefficients, strict=True)
        return max((size / c.std for size, c in sizes if c.std > 0.0), default=0.0)


def left_out_terms(fit: JointFit, candidates: Candidates) -> tuple[LeftOut, ...]:
    """Servo signatures in the records; empty if none is clear, if terms absorb them, or if the stands separate them.

    ``candidates`` are those of the fit without scatter.
    """
    coefficients, square = fit.coefficients, candidates.squares[0]
    held = {*fit.wish.terms, *(name for summary in fit.summaries for name, _ in summary.known_servo)}
    if fit.summaries[0].unit != GYRO or any(
        live and live.request.phase_source != "output" for live in fit.live
    ):
        return ()
    scaled = "scale_factor" in held and "scale_factor" not in fit.wish.per_run
    cube = square is not None and scaled and not set(CUBIC) & held
    named = "servo" in held or ("k3" in held and square is not None) or not scaled
    unnamed = () if named else _unnamed(fit, candidates)
    if "tan_beta" not in held:
        return unnamed
    settled = square is None or set(SERVO_TERMS) & held or _is_waived(fit)
    together = _together(fit, candidates) if scaled and not set(SERVO_TERMS) & held else ()
    if together:
        return together
    asked = () if square is None or settled else _asked_cube(coefficients, square)
    damping = "servo_damping" not in held and all(len(summary.labels) == 1 for summary in fit.summaries)
    if not cube and not damping:
        return asked
    order, (pieces, rows) = candidates.order, candidates.pieces
    scale_factor = fit.summaries[0].inner_scale_factor
    before = {c.key: c.value for c in candidates.fit.coefficients}
    doubts: list[LeftOut] = []
    if square is not None and cube:
        test = tested(pieces, order, ("k3",), rows)
        if test is not None and test.probability <= _CLEAR:
            after = candidates.after(test.change)
            k3 = float(test.columns[0]) / scale_factor
            cube_with = {"servo": after["scale_factor"] * (1.0 + k3 * square), "k3": after["scale_factor"]}
            doubts.append(_cubic_doubt(coefficients, before, after, cube_with, k3 / si_factor("k3")))
            pieces = [with_term(piece, order, ("k3",)) for piece in pieces]
            order = [name for name in order if name != "k3"]
    test = tested(pieces, order, ("servo_damping",), rows) if damping else None
    if test is not None and (doubts or asked or test.probability <= _CLEAR):
        unit = scale_factor * si_factor("servo_damping")
        size = (float(test.columns[0]) / unit, float(test.std[0]) / unit)
        is_clear = test.probability <= _CLEAR
        after = candidates.after(test.change)
        # the wave turns with the phase that it moves: a linear step is not enough
        whole = candidates.refit(("k3", "servo_damping") if doubts else ("servo_damping",))
        if whole is not None:
            after |= {c.key: c.value for c in whole.coefficients if c.name in TURNED}
            doubts.append(_damped(coefficients, before, after, size, clear=is_clear))
    covered = any(doubt.source == CUBIC_SOURCE for doubt in doubts)
    return (*doubts, *asked, *(() if covered else unnamed))


def _together(fit: JointFit, candidates: Candidates) -> tuple[LeftOut, ...]:
    """Both terms of the servo, if several runs show both: each alone may fit badly, because the damping turns the phases."""
    if fit.only or candidates.squares[0] is not None or not set(SERVO_TERMS) <= set(candidates.order):
        return ()
    wider = candidates.refit(SERVO_TERMS)
    if wider is None:
        return ()
    factors = coverage_factor(wider.degrees, 1.0 - _CLEAR).tolist()
    pairs = [pair for pair in zip(wider.coefficients, factors, strict=True) if pair[0].name in SERVO_TERMS]
    if any(abs(c.value) < factor * c.std for c, factor in pairs):
        return ()
    after = {c.key: c.value for c in wider.coefficients}
    sizes = ", ".join(f"{c.key} = {c.value:.3g} +/- {c.std:.1g} {c.unit}" for c, _ in pairs)
    moved = ", ".join(
        f"{c.key} {after[c.key]:.8g} instead of {c.value:.8g} {c.unit}".removesuffix(" 1")
        for c in fit.coefficients
        if c.name in ("scale_factor", "tan_beta")
    )
    words = (
        f"the runs together show {sizes}, which the model lacks; with it they give {moved}. The uncertainties cover "
        "this shift. Add 'servo' and 'servo_damping' to [model] terms if it makes sense"
    )
    change = _difference(fit.coefficients, {c.key: c.value for c in fit.coefficients}, after)
    return (LeftOut(LACKING_SOURCE, change, words),)


def _is_waived(fit: JointFit) -> bool:
    """True if the run file of a run waives the servo."""
    sources = (source for summary in fit.summaries for source in summary.stand_sources)
    return any(source.name == "servo" and source.status == "waived" for source in sources)


def _unnamed(fit: JointFit, candidates: Candidates) -> tuple[LeftOut, ...]:
    """The servo that the records do not exclude: by the column of ``servo``, without ``tan_beta`` by the cube in 1 g.

    Without both, that of one run is listed with its effect, and has no size.
    """
    unit, coefficients, square = si_factor("servo"), fit.coefficients, candidates.squares[0]
    share = _softest_share(fit)
    if _is_waived(fit) or share < _NEGLIGIBLE:
        return ()
    name = "servo" if "servo" in candidates.order else "k3"
    if name not in candidates.order or (name == "k3" and square is None):
        if fit.only is None:
            return ()
        listed = StandSource("servo", "unstated", "ug/g^3")
        return (LeftOut(_UNNAMED_SOURCE, np.zeros(len(coefficients)), "", listed),)
    pieces, rows = candidates.pieces
    test = tested(pieces, candidates.order, (name,), rows)
    if test is None:
        moved = [c.value * share if c.name == "scale_factor" else 0.0 for c in coefficients]
        return (_unnamed_servo(np.array(moved), _SOFTEST, math.inf),)
    before, after = {c.key: c.value for c in candidates.fit.coefficients}, candidates.after(test.change)
    size, std, spread = (
        float(values[0]) / fit.summaries[0].inner_scale_factor / unit
        for values in (test.columns, test.std, test.spread)
    )
    if name == "k3" and square is not None:
        after["scale_factor"] *= 1.0 + size * unit * square
    std = max(std, spread * coverage_factor(test.freedom) / coverage_factor(math.inf))
    after |= {c.key: before[c.key] for c in coefficients if c.name in TURNED}
    return (_unnamed_servo(_difference(coefficients, before, after), size, std),)


def _softest_share(fit: JointFit) -> float:
    """Relative change of K by the softest servo, from the records, or without any from the summaries; 0 without their columns."""
    weighted, total = 0.0, 1e-300
    for run in (live.run for live in fit.live if live):
        for part in spans(run.size):
            along = run.f[part, 0] ** 2
            weighted, total = weighted + float(along @ across_squared(run, part)), total + float(along.sum())
    names = ("scale_factor", STIFFNESS_COLUMNS[0])
    for position in () if any(fit.live) else (p for summary in fit.summaries for p in summary.positions):
        if set(names) <= set(position.part.names):
            force, bent = position.part.select(names).factor[:, :2].T
            weighted, total = weighted + float(force @ bent), total + float(force @ force)
    return _SOFTEST * si_factor("servo") * weighted / total


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
