"""What a record can determine, in words: rank, condition, confounded terms, useless estimates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from piga.calibration.model.reduction import Reduction
from piga.calibration.model.solution import Layout, at_phase
from piga.errors import IdentifiabilityError
from piga.records.calibration.coefficient import Coefficient, short_way
from piga.records.calibration.diagnostics import SCATTER, SegmentScatter
from piga.records.run import Run
from piga.records.terms import harmonic, unit_of
from piga.results import Array
from piga.terms import PRODUCTS
from piga.units import G0

RANK = 1e-9
"""Smallest singular value of the column-scaled factor, relative to the largest, that counts as information."""
NAMED_WEIGHT = 0.3
"""Weight in a null direction, relative to the largest, above which a term is named."""
_USELESS = 0.05
"""Uncertainty, as a fraction of the record's largest specific force, above which an estimate is no result."""
_ALIKE = 0.95
"""Correlation above which coefficients are reported as hard to tell apart."""


_POSITIONS = 4
"""Fewest positions."""
_SAME_SIZE = 0.05
"""Largest relative difference of the specific forces of a head."""
_MOVE = 1e-3
"""Least turn between positions that counts as a move [rad]."""


_LEVEL = frozenset({"scale_factor", "k0"})

_PAIRS: tuple[tuple[frozenset[str], str], ...] = (
    (_LEVEL, "a_x never changes: add positions or levels with another a_x"),
    (frozenset({"k0", "k1"}), "a_x never changes: add positions or levels with another a_x"),
    (frozenset({"k0", "k2"}), "a_x^2 never changes: add levels with another |a_x|, or leave k2 out"),
    (frozenset({"k2", "k2o"}), "a_x keeps its sign: add levels with a_x of the other sign, or leave k2o out"),
    (
        frozenset({"scale_factor", "k1a"}),
        "a_x keeps its sign: add levels with a_x of the other sign, or leave k1a out",
    ),
    (frozenset({"k0", "k1a"}), "|a_x| never changes: add levels with another |a_x|, or leave k1a out"),
    (frozenset({"k2", "k1a"}), "|a_x| takes too few values: add levels, or leave k1a out"),
    (frozenset({"scale_factor", "k3"}), "|a_x| takes too few values: add levels, or leave k3 out"),
)
"""Explanation for a record that cannot tell exactly these two terms apart."""

_REMEDIES: tuple[tuple[frozenset[str], str], ...] = (
    (
        frozenset({"k0", "k2", "k_YY"}),
        "a one-plane tumble has a_x^2 + a_Y^2 = g^2: leave k_YY out",
    ),
    (
        frozenset({"tan_beta"}),
        "the gimbal does not turn enough, or there is no transverse force: add revolutions",
    ),
)
"""Remedy if a record cannot tell these terms apart from others."""

_OF_A_X = tuple(name for name, factors in PRODUCTS.items() if {*factors} <= {"x", "|x|"})
"""Terms that depend on a_x alone. The record needs at least as many different a_x as such terms."""

_HELPING_RUNS: tuple[tuple[frozenset[str], str], ...] = (
    (frozenset({"k0", "k2", "k_YY"}), "a run on a centrifuge or a vibration table (a_x changes, a_Y does not)"),
    (frozenset({"k0", "k2", "k_ZZ"}), "a run on a centrifuge or a vibration table (a_x changes, a_Z does not)"),
    (frozenset({"scale_factor", "k0"}), "a run on a dividing head (a_x of both signs)"),
    (frozenset({"k0", "k1"}), "a run on a dividing head (a_x of both signs)"),
    (frozenset({"k2", "k2o"}), "a run on a dividing head (a_x of both signs)"),
    (frozenset({"k0", "k2"}), "a run on a centrifuge (|a_x| of many sizes)"),
    (frozenset({"scale_factor", "k3"}), "a run on a centrifuge (|a_x| of many sizes)"),
    (frozenset({"k1", "k3"}), "a run on a centrifuge (|a_x| of many sizes)"),
    (frozenset({"m_Y"}), "a run on a dividing head that turns in the plane X0 Y0"),
    (frozenset({"m_Z"}), "a run on a dividing head that turns in the plane X0 Z0"),
    (frozenset({"tan_beta"}), "a run on a dividing head (transverse force while the gimbal turns)"),
    (frozenset({"k_YY"}), "a run on a dividing head that turns in the plane X0 Y0"),
    (frozenset({"k_ZZ"}), "a run on a dividing head that turns in the plane X0 Z0"),
)
"""Runs that tell terms apart, most specific first."""


@dataclass(frozen=True)
class Examination:
    """Condition of the column-scaled factor, terms in directions without information, and all requested terms."""

    condition: float
    null_terms: tuple[str, ...]
    asked: tuple[str, ...] = ()


def term_of(column: str) -> str:
    """The term of a linear column; ``p`` and ``q`` belong to the coupling."""
    return "tan_beta" if column in ("p", "q") else column


def examine_parts(layout: Layout, parts: list[Reduction], phases: Sequence[float] = ()) -> Examination:
    """Rank and condition of the request for all phase groups together.

    Names the terms of all directions without information. With several groups, the coupling
    columns of all groups count as one direction each, and those of a servo term at the ``phases`` as one.
    """
    if layout.servo_columns:
        names = (*layout.columns[: layout.turning], *layout.servo)
        parts = [
            at_phase(part, (*names, *part.names[layout.local :]), phase)
            for part, phase in zip(parts, phases or (0.0,) * len(parts), strict=True)
        ]
        layout = layout.with_servo_among_keys()
    names = layout.columns
    factor = (_aligned(layout, parts) if len(parts) > 1 else parts[0]).factor[:-1, :-1]
    norms = np.linalg.norm(factor, axis=0)
    zero = [
        term_of(name)
        for name, norm in zip(names, norms, strict=True)
        if norm <= 1e-14 * max(norms.max(), 1e-300)
    ]
    asked = tuple(dict.fromkeys(map(term_of, names)))
    if zero:
        return Examination(float("inf"), tuple(dict.fromkeys(zero)), asked)
    _, singular, right = np.linalg.svd(factor / norms)
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0.0 else float("inf")
    if singular[-1] > RANK * singular[0]:
        return Examination(condition, (), asked)
    weights = np.linalg.norm(right[singular <= RANK * singular[0]], axis=0)
    named = [
        term_of(name)
        for name, weight in zip(names, weights, strict=True)
        if weight > NAMED_WEIGHT * weights.max()
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
    return Reduction.of_rows(layout.columns, rows, 0)


def refuse_if_confounded(examination: Examination, runs: int = 1) -> None:
    """Raise if the record, or the ``runs`` together, cannot determine the requested terms.

    Raises
    ------
    IdentifiabilityError
        Names the terms and a test or run that would separate them.
    """
    if examination.null_terms:
        terms, asked = (
            {name.split("[", maxsplit=1)[0] for name in names}
            for names in (examination.null_terms, examination.asked)
        )
        listed = ", ".join(sorted(examination.null_terms))
        verb = "cannot determine" if len(examination.null_terms) == 1 else "cannot separate"
        subject = "this record" if runs == 1 else f"these {runs} runs together"
        remedy = _remedy(terms, asked, runs)
        if any("[" in name and not name.startswith("phi") for name in examination.null_terms):
            remedy += "; or let the runs share a term: leave it out of per_run ([] for none)"
        raise IdentifiabilityError(f"{subject} {verb} {listed}", remedy=remedy, terms=examination.null_terms)


def _remedy(terms: set[str], asked: set[str], runs: int = 1) -> str:
    """Remedy for ``terms`` that cannot be separated; ``asked`` are all requested terms."""
    helping = next((text for members, text in _HELPING_RUNS if members <= terms), None)
    if runs > 1:
        return f"add {helping}" if helping else "leave one of these terms out, or add a run of another kind"
    powers = [name for name in _OF_A_X if name in asked]
    fitting = [text for members, text in _PAIRS if members == terms and (members != _LEVEL or len(powers) == 2)]
    if not fitting and len(powers) > 2 and terms <= set(powers):
        other = "" if "k0" in powers else " other than zero"
        words = (
            f"a_x takes too few values: {', '.join(powers)} together need at least {len(powers)} different ones{other}; "
            "add positions or levels with another a_x, or leave terms out"
        )
        fitting = [words]
        helping = "a run that has other values of a_x, on a dividing head or a centrifuge"
    fitting += [text for members, text in _REMEDIES if members <= terms]
    if not fitting:
        fitting = ["leave one of these terms out, or record other positions, levels or temperatures"]
    return fitting[0] + (f"; or calibrate it together with {helping}" if helping else "")


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
            remedy=_useless_remedy({c.name for c, _ in bad}, {c.name for c in coefficients}),
        )


def _useless_remedy(terms: set[str], asked: set[str]) -> str:
    """Remedy for terms that the record can hardly separate."""
    text = _remedy(terms, asked - {"phi"})
    return text.replace("never changes", "hardly changes").replace(
        "too few values", "too few or too close values"
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


def scatter_in_words(scatter: SegmentScatter, *, direct: bool = False) -> tuple[str, ...]:
    """Doubt about mean rates that scatter more than the noise explains. ``direct``: the instrument has no gimbal."""
    notes = []
    force, own = scatter.segment_scatter_g or 0.0, "instrument" if direct else "servo"
    ratio, without_it = scatter.segment_scatter_ratio or 0.0, scatter.segment_scatter_ratio_without_it or 0.0
    if ratio > SCATTER:
        notes.append(
            f"the mean rates of the segments scatter {ratio:.1f} times more than the noise explains "
            f"({force * 1e6:.2g} ug rms): the stand or the {own} has an effect that the model lacks; the "
            "standard uncertainties include the scatter, but not what is the same at every visit of a position"
        )
    elif without_it > SCATTER:
        notes.append(
            f"the mean rates of the segments scatter {without_it:.1f} times more than the noise of the "
            f"{'output' if direct else 'angle'} explains ({force * 1e6:.2g} ug rms): the standard uncertainties include this "
            f"scatter, but an effect of the stand or of the {own} that is the same at every visit of a "
            "position does not average out"
        )
    return tuple(notes)


def alike_in_words(coefficients: tuple[Coefficient, ...], covariance: Array) -> list[str]:
    """Groups of coefficients that are hard to separate, one sentence each."""
    plain = [i for i, c in enumerate(coefficients) if c.name != "phi"]
    std = np.sqrt(np.diag(covariance))
    correlation = np.abs(covariance / np.outer(std, std))
    notes, left = [], list(plain)
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


def _loose(coefficients: tuple[Coefficient, ...]) -> list[str]:
    """Segments with an undetermined phase."""
    return [c.segment for c in coefficients if c.segment is not None and not c.determined]


def one_way_in_words(run: Run, terms: tuple[str, ...]) -> tuple[str, ...]:
    """A remark of the plan if a head turned one way only: hysteresis then looks like ``m_Y`` or ``m_Z``.

    The direction comes from the mean specific forces of the segments in order, in the plane that they lie in.
    """
    held = [name for name in ("m_Y", "m_Z") if name in terms]
    if not held or len(run.labels) < _POSITIONS:
        return ()
    count = np.bincount(run.segment_index, minlength=len(run.labels))
    if np.count_nonzero(count) < _POSITIONS:
        return ()
    sums = np.stack([np.bincount(run.segment_index, run.f[:, axis], len(run.labels)) for axis in range(3)])
    mean = (sums[:, count > 0] / count[count > 0]).T
    size = np.linalg.norm(mean, axis=1)
    if np.ptp(size) > _SAME_SIZE * size.max():
        return ()
    plane = np.linalg.svd(mean - mean.mean(axis=0))[2][:2]
    steps = short_way(np.diff(np.arctan2(*(mean @ plane.T).T)))
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
    loose = _loose(coefficients)
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
