"""What a record can determine, in words: rank, condition, confounded terms, useless estimates.

Servo terms turn with the output angle. Five columns without a phase span them; their coefficients follow from the terms and the
phase (:class:`piga.calibration.model.solution.Layout`; docs/understanding/servo).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from piga.calibration.model.reduction import Reduction, triangle
from piga.calibration.model.solution import (
    PHASELESS,
    STIFFNESS_COLUMNS,
    Estimate,
    Layout,
    at_phase,
    solve_parts,
)
from piga.errors import IdentifiabilityError
from piga.records.calibration.coefficient import Coefficient, short_way
from piga.records.calibration.diagnostics import SCATTER, Diagnostics
from piga.records.run import Run
from piga.records.terms import harmonic, unit_of
from piga.results import Array
from piga.terms import PRODUCTS
from piga.units import G0

_RANK = 1e-9
"""Smallest singular value of the column-scaled factor, relative to the largest, that counts as information."""
_NAMED_WEIGHT = 0.3
"""Weight in a null direction, relative to the largest, above which a term is named."""
_SEPARATE = 1e-3
"""Smallest independent part of a servo term's column, relative to its size, for the term to be determined."""
_NAMED_SHARE = 0.05
"""Least share of that column for which another term is named."""
_USELESS = 0.05
"""Uncertainty, as a fraction of the record's largest specific force, above which an estimate is no result."""
_ALIKE = 0.95
"""Correlation above which coefficients are reported as hard to tell apart."""
_POSITIONS = 4
"""Fewest positions of a head whose direction is told."""
_SAME_SIZE = 0.05
"""Largest relative difference of the specific forces of a head."""
_MOVE = 1e-3
"""Least turn between positions that counts as a move [rad]."""

_OF_A_X = tuple(name for name, factors in PRODUCTS.items() if {*factors} <= {"x", "|x|"})
"""Terms that depend on a_x alone. The record needs at least as many different a_x as such terms."""

_BOTH_SIGNS = "a run on a dividing head (a_x of both signs)"
_ANY_SIZE = "a run on a centrifuge (|a_x| of many sizes)"
_LEVEL = "a_x never changes: add positions or levels with another a_x"
_ONE_SIGN = "a_x keeps its sign: add levels with a_x of the other sign, or leave {} out"
_FEW = "|a_x| takes too few values: add levels, or leave {} out"
_OTHERS = "leave one of these terms out, or record other positions, levels or temperatures"
_IN_PLANE = "a run on a dividing head that turns in the plane X0 "
_FORCED = "a run on a centrifuge or a vibration table (a_x changes, a_{} does not)"
_TUMBLE = "a one-plane tumble has a_x^2 + a_{}^2 = g^2: leave k_{}{} out"

_REMEDIES: tuple[tuple[tuple[str, ...], str, str], ...] = (
    (("k0", "k2", "k_YY"), _TUMBLE.format(*"YYY"), _FORCED.format("Y")),
    (("k0", "k2", "k_ZZ"), _TUMBLE.format(*"ZZZ"), _FORCED.format("Z")),
    (("scale_factor", "k0"), _LEVEL, _BOTH_SIGNS),
    (("k0", "k1"), _LEVEL, _BOTH_SIGNS),
    (("k2", "k2o"), _ONE_SIGN.format("k2o"), _BOTH_SIGNS),
    (("scale_factor", "k1a"), _ONE_SIGN.format("k1a"), _BOTH_SIGNS),
    (("k0", "k2"), "a_x^2 never changes: add levels with another |a_x|, or leave k2 out", _ANY_SIZE),
    (("k0", "k1a"), "|a_x| never changes: add levels with another |a_x|, or leave k1a out", _ANY_SIZE),
    (("k2", "k1a"), _FEW.format("k1a"), _ANY_SIZE),
    (("scale_factor", "k3"), _FEW.format("k3"), _ANY_SIZE),
    (("k1", "k3"), _FEW.format("k3"), _ANY_SIZE),
    (("m_Y",), _OTHERS, _IN_PLANE + "Y0"),
    (("m_Z",), _OTHERS, _IN_PLANE + "Z0"),
    (
        ("tan_beta",),
        "the gimbal does not turn enough, or there is no transverse force: add revolutions",
        "a run on a dividing head (transverse force while the gimbal turns)",
    ),
    (("k_YY",), _OTHERS, _IN_PLANE + "Y0"),
    (("k_ZZ",), _OTHERS, _IN_PLANE + "Z0"),
)
"""Terms, remedy of a record that cannot tell them apart, and a run that helps, most specific first."""


@dataclass(frozen=True)
class Examination:
    """Condition of the column-scaled factor, terms in directions without information, and all requested terms."""

    condition: float
    null_terms: tuple[str, ...]
    asked: tuple[str, ...] = ()


def examine_parts(layout: Layout, parts: list[Reduction], phases: Sequence[float] = ()) -> Examination:
    """Rank and condition of the request for all phase groups together.

    Names the terms of all directions without information. With several groups, the coupling
    columns of all groups count as one direction each, and those of a servo term at the ``phases`` as one.
    """
    if layout.servo_columns:
        turning = (*layout.columns[: layout.turning], *layout.servo)
        parts = [
            at_phase(part, (*turning, *part.names[layout.local :]), phase)
            for part, phase in zip(parts, phases or (0.0,) * len(parts), strict=True)
        ]
        count = len(layout.servo)  # combined at a phase, the servo terms are shared columns
        tails = tuple(np.append(np.arange(count), count + tail) for tail in layout.tails)
        keys = (*((name, None) for name in layout.servo), *layout.keys)
        layout = replace(layout, keys=keys, tails=tails, servo=(), given=())
    names = ["tan_beta" if name in ("p", "q") else name for name in layout.columns]
    factor = (_aligned(layout, parts) if len(parts) > 1 else parts[0]).factor[:-1, :-1]
    norms = np.linalg.norm(factor, axis=0)
    zero = [name for name, norm in zip(names, norms, strict=True) if norm <= 1e-14 * max(norms.max(), 1e-300)]
    asked = tuple(dict.fromkeys(names))
    if zero:
        return Examination(float("inf"), tuple(dict.fromkeys(zero)), asked)
    _, singular, right = np.linalg.svd(factor / norms)
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0.0 else float("inf")
    if singular[-1] > _RANK * singular[0]:
        return Examination(condition, (), asked)
    weights = np.linalg.norm(right[singular <= _RANK * singular[0]], axis=0)
    named = [
        name for name, weight in zip(names, weights, strict=True) if weight > _NAMED_WEIGHT * weights.max()
    ]
    return Examination(condition, tuple(dict.fromkeys(named)), asked)


def _aligned(layout: Layout, parts: list[Reduction]) -> Reduction:
    """Summary of all groups; the local columns of each group are turned to its best phase."""
    factors = [np.array(part.factor) for part in parts]
    for turned in factors:
        if layout.coupled and turned[0, 0] and turned[1, 1]:
            q = turned[1, -1] / turned[1, 1]
            p = (turned[0, -1] - turned[0, 1] * q) / turned[0, 0]
            phase = np.arctan2(q, p)
            cosine, sine = np.cos(phase), np.sin(phase)
            turned[:, :2] = turned[:, :2] @ np.array([[cosine, -sine], [sine, cosine]])
    rows = layout.stacked(factors).reshape(-1, len(layout.columns) + 1)
    return Reduction(layout.columns, triangle(rows))


def refuse_if_confounded(examination: Examination, runs: int = 1) -> None:
    """Raise if the record, or the ``runs`` together, cannot determine the requested terms.

    Raises
    ------
    IdentifiabilityError
        Names the terms and a test or run that would separate them.
    """
    null = examination.null_terms
    if null:
        terms, asked = ({name.split("[")[0] for name in names} for names in (null, examination.asked))
        remedy = _remedy(terms, asked, runs)
        if any("[" in name and not name.startswith("phi") for name in null):
            remedy += "; or let the runs share a term: leave it out of per_run ([] for none)"
        raise _not_separated(tuple(sorted(null)), runs, remedy, null)


def _not_separated(
    listed: tuple[str, ...], runs: int, remedy: str, terms: tuple[str, ...]
) -> IdentifiabilityError:
    """The error of a record, or of ``runs`` together, that cannot determine terms."""
    subject = "this record" if runs == 1 else f"these {runs} runs together"
    verb = "cannot determine" if len(listed) == 1 else "cannot separate"
    return IdentifiabilityError(f"{subject} {verb} {', '.join(listed)}", remedy=remedy, terms=terms)


def _remedy(terms: set[str], asked: set[str], runs: int = 1) -> str:
    """Remedy for ``terms`` that cannot be separated; ``asked`` are all requested terms."""
    known = [(words, helping) for members, words, helping in _REMEDIES if terms.issuperset(members)]
    words, helping = known[0] if known else (_OTHERS, "")
    if runs > 1:
        return f"add {helping}" if helping else "leave one of these terms out, or add a run of another kind"
    powers = [name for name in _OF_A_X if name in asked]
    if len(powers) > 2 and terms <= set(powers):
        other = "" if "k0" in powers else " other than zero"
        words = (
            f"a_x takes too few values: {', '.join(powers)} together need at least {len(powers)} different ones{other}; "
            "add positions or levels with another a_x, or leave terms out"
        )
        helping = "a run that has other values of a_x, on a dividing head or a centrifuge"
    return words + (f"; or calibrate it together with {helping}" if helping else "")


def refuse_if_servo_alike(layout: Layout, parts: list[Reduction], *, per_segment: bool, runs: int) -> None:
    """Raise if the parts cannot separate a servo term from the other terms.

    The mean of ``servo`` is tested without its second harmonic. The harmonic exists, but an error of the read-out at
    twice the turn would look like it. ``per_segment`` and ``runs`` are for the message.

    Raises
    ------
    IdentifiabilityError
        Names the terms and the test that separates them.
    """
    plain = replace(layout, servo=(), given=())
    names = [tuple(name for name in part.names if name not in PHASELESS) for part in parts]
    rest = [part.select(own) for part, own in zip(parts, names, strict=True)]
    refuse_if_confounded(examine_parts(plain, rest), runs)
    estimate = solve_parts(plain, rest)
    for term in layout.servo:
        factors = [
            part.select((*own, STIFFNESS_COLUMNS[0])).factor
            if term == "servo"
            else at_phase(part, (*own, term), phase).factor
            for part, own, phase in zip(parts, names, estimate.phases.tolist(), strict=True)
        ]
        alike = _made_of(plain, estimate, factors)
        if alike:
            terms = (*alike, term)
            raise _not_separated(terms, runs, _servo_remedy(set(terms), per_segment), terms)


def _made_of(layout: Layout, estimate: Estimate, factors: list[Array]) -> tuple[str, ...]:
    """Terms whose columns, with free phases, combine to the last column of ``[model | column | y]``; empty if a part remains."""
    rows = np.vstack([f[:, :-2] @ j for f, j in zip(factors, estimate.jacobians, strict=True)])
    column = np.concatenate([factor[:, -2] for factor in factors])
    scale, size = np.linalg.norm(rows, axis=0), float(np.linalg.norm(column))
    scale[scale == 0.0] = 1.0
    share = np.linalg.lstsq(rows / scale, column, rcond=1e-9)[0]
    if np.linalg.norm(column - rows / scale @ share) > _SEPARATE * size:
        return ()
    names = [name for name, _ in layout.amplitude_keys] + ["tan_beta"] * estimate.phases.size
    named = (n for n, part in zip(names, share, strict=True) if abs(part) > _NAMED_SHARE * size)
    return tuple(dict.fromkeys(named)) or ("tan_beta",)


def _servo_remedy(terms: set[str], per_segment: bool) -> str:
    """The test that separates these terms, or what to leave out."""
    if "servo_damping" in terms:
        if per_segment:
            return (
                "with one phase per segment, phi takes up the whole effect of the damping: use phases = "
                "'shared', or leave servo_damping out"
            )
        return "|a_x| has one size only: add positions or levels with another |a_x|, or leave servo_damping out"
    if "k3" in terms:
        return (
            "a_x^2 + a_t^2 never changes, so a_x a_t^2 cannot be separated from a_x less a_x^3: leave "
            "'k3' out (or 'servo'; K differs by k3 g^2); or calibrate it together with a run on a "
            "centrifuge or a vibration table (a_x changes, a_t does not)"
        )
    if terms & {"scale_factor", "k1"}:
        return (
            "a_t never changes, so a_x a_t^2 cannot be separated from a_x: calibrate it together with a "
            "run on a dividing head, give [instrument] servo, or leave servo out"
        )
    return "add positions or levels with another a_x and another transverse force, or leave servo out"


def refuse_useless(
    coefficients: tuple[Coefficient, ...], largest: float, duration: float, spread: float
) -> None:
    """Raise if an uncertainty is so large that the estimate is useless.

    Parameters
    ----------
    coefficients:
        Estimates with their standard uncertainties.
    largest:
        Largest specific force of the record [m/s^2].
    duration, spread:
        Duration [s] and range of temperature [K], for the drift terms.
    """
    bad = []
    for coefficient in coefficients:
        share = coefficient.std * _full_scale(coefficient, largest / G0, duration, spread)
        if coefficient.name != "phi" and not share < _USELESS:
            bad.append((coefficient, share))
    if bad:
        listed = "; ".join(
            f"{c.key} = {c.value:.3g} with standard uncertainty {c.std:.2g}{'' if c.unit == '1' else ' ' + c.unit}"
            for c, _ in bad
        )
        raise IdentifiabilityError(
            f"this record does not determine {', '.join(c.key for c, _ in bad)}: {listed}",
            remedy=_remedy({c.name for c, _ in bad}, {c.name for c in coefficients} - {"phi"})
            .replace("never changes", "hardly changes")
            .replace("too few values", "too few or too close values"),
        )


def _full_scale(coefficient: Coefficient, largest: float, duration: float, spread: float) -> float:
    """Force error by an error of one file unit, as a share of ``largest`` [g]."""
    name = coefficient.name
    if name == "scale_factor":
        return 1.0 / abs(coefficient.value)
    if name in ("k0", "k0_t", "k0_T") or harmonic(name):
        extent = {"k0_t": 0.5 * duration, "k0_T": 0.5 * spread}.get(name, 1.0)
        return extent / largest
    if name == "k1_T":
        return 0.5 * spread
    return largest ** {"g/g^2": 1, "g/g^3": 2}.get(unit_of(name), 0)


def scatter_in_words(scatter: Diagnostics, *, direct: bool = False) -> tuple[str, ...]:
    """Doubt about mean rates that scatter more than the noise explains. ``direct``: the instrument has no gimbal."""
    if scatter.worst_scatter <= SCATTER:
        return ()
    force, own = 1e6 * (scatter.segment_scatter_g or 0.0), "instrument" if direct else "servo"
    words = (
        f"the mean rates of the segments scatter {scatter.worst_scatter:.1f} times more than the noise of the "
        f"{'output' if direct else 'angle'} explains ({force:.2g} ug rms): the standard uncertainties include this "
        f"scatter, but an effect of the stand or of the {own} that is the same at every visit of a "
        "position does not average out"
    )
    return (words,)


def alike_in_words(coefficients: tuple[Coefficient, ...], covariance: Array) -> list[str]:
    """Groups of coefficients that are hard to separate, one sentence each."""
    plain = [i for i, c in enumerate(coefficients) if c.name != "phi"]
    std = np.sqrt(np.diag(covariance))
    correlation = np.abs(covariance / np.outer(std, std))
    notes, left = [], plain.copy()
    while left:
        group = [left.pop(0)]
        for i in group:
            group += [j for j in left if correlation[i, j] > _ALIKE]
            left = [j for j in left if j not in group]
        if len(group) > 1:
            keys = [coefficients[i].key for i in sorted(group)]
            worst = max(correlation[i, j] for i in group for j in group if i != j)
            notes.append(
                f"{', '.join(keys[:-1])} and {keys[-1]} are hard to tell apart in this record (largest correlation "
                f"{worst:.3f} in size): use them together"
            )
    return notes


def one_way_in_words(run: Run, terms: tuple[str, ...]) -> tuple[str, ...]:
    """A remark of the plan if a head turned one way only: hysteresis then looks like ``m_Y`` or ``m_Z``."""
    held = [name for name in ("m_Y", "m_Z") if name in terms]
    first = run.segment_edges()[:-1]
    middle = (first + run.segment_edges()[1:]) // 2
    f, size = run.f[middle], np.linalg.norm(run.f[middle], axis=1)
    if not held or first.size < _POSITIONS or np.ptp(size) > _SAME_SIZE * size.max():
        return ()
    plane = np.linalg.svd(f - f.mean(axis=0))[2][:2]
    steps = short_way(np.diff(np.arctan2(*(f @ plane.T).T)))
    moves = steps[np.abs(steps) > _MOVE]
    if moves.size < _POSITIONS - 1 or abs(np.sign(moves).sum()) < moves.size:
        return ()
    words = (
        f"the stand turned one way only: a lag of the head or of the instrument after each move looks like {held[0]} "
        f"(1 arcsec of lag is 1 arcsec of {held[0]}): visit the positions there and back"
    )
    return (words,)


def remarks_in_words(coefficients: tuple[Coefficient, ...], covariance: Array) -> tuple[str, ...]:
    """Remarks that are not doubts, one sentence each: the uncertainties contain what they say."""
    sentences = alike_in_words(coefficients, covariance)
    if any(c.name == "tan_beta" and c.value < 4.0 * c.std for c in coefficients):
        sentences.append(
            "tan_beta is not well above its uncertainty: phi is hardly determined; the limits of "
            "tan_beta respect that a size cannot be negative: the lower one is 0 if an instrument "
            "without coupling would give this estimate as often"
        )
    loose = [c.segment for c in coefficients if c.segment is not None and not c.determined]
    if loose:
        sentences.append(
            f"phi is not determined in segment {', '.join(map(str, loose))}: no transverse force there, or the gimbal hardly turns"
        )
    small = [
        c.key
        for c in coefficients
        if c.name not in ("phi", "scale_factor", "tan_beta") and abs(c.value) < 2.0 * c.std
    ]
    if small:
        verb, whose = ("is", "its") if len(small) == 1 else ("are", "their")
        sentences.append(
            f"{', '.join(small)} {verb} smaller than twice {whose} standard uncertainty: the record does not need "
            f"{'it' if len(small) == 1 else 'them'}"
        )
    return tuple(sentences)
