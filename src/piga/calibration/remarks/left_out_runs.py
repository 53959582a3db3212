"""What the servo leaves in several runs together where its terms are not asked for (see ``left_out``).

The sources of Type B are those of one record. Runs together may tell what one stand cannot: where they tell ``servo`` from
``k3``, the one that fits better is the one to add, and what it would change is in the budget.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from piga.calibration.fit.one_run import phase_groups
from piga.calibration.fit.servo import at_state
from piga.calibration.joint.joint_fit import (
    JointFit,
    known_servo_of,
    layout_and_columns,
    merge_runs,
    without_phase,
)
from piga.calibration.joint.summary import LiveRun, RunSummary, group_rows, reduce_rows
from piga.calibration.model.design import Design
from piga.calibration.model.reduction import Reduction
from piga.calibration.remarks.all_remarks import without_slow
from piga.calibration.remarks.candidate_columns import CUBIC
from piga.calibration.remarks.left_out import (
    CLEAR,
    CUBIC_SOURCE,
    SEEN,
    LeftOut,
    asked_words,
    cubic_doubt,
    damped,
    difference,
)
from piga.calibration.remarks.missing_terms import Tested, tested
from piga.errors import CalibrationError, IdentifiabilityError
from piga.records.calibration import Coefficient
from piga.records.terms import SERVO_TERMS

Array = NDArray[np.float64]
Names = tuple[str, ...]

EXTRA = ("k3", *SERVO_TERMS)
"""Terms that are tried."""
LACKING = {"servo": "servo terms that the model lacks", "k3": "k3 that the model lacks"}
"""Names in the budget where the runs tell servo from k3."""


@dataclass(frozen=True)
class Rows:
    """The runs with the columns of ``EXTRA``, weighted without a slow noise.

    ``pieces`` are, for each run, phase group within the run and reduction of each segment; of a run that takes part by
    its summary, of each phase group.
    """

    fit: JointFit
    summaries: tuple[RunSummary, ...]
    pieces: tuple[tuple[tuple[int, Reduction], ...], ...]

    def refit(self, terms: Names) -> JointFit | None:
        """The runs with these terms; None where they cannot tell the terms apart."""
        wish = replace(self.fit.wish, terms=terms)
        try:
            return merge_runs(wish, list(self.summaries), [None] * len(self.summaries))
        except IdentifiabilityError:
            return None


@dataclass(frozen=True)
class Wider:
    """The runs with more terms: ``test`` is that of the terms added, ``before`` and ``after`` the fits."""

    before: JointFit
    after: JointFit
    test: Tested

    @property
    def fall(self) -> float:
        """Relative fall of the sum of squares."""
        return 1.0 - self.after.estimate.cost / self.before.estimate.cost


def left_out_of_runs(fit: JointFit) -> tuple[LeftOut, ...]:
    """What the servo leaves in runs together; none where nothing is clear or terms take it."""
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
    if cube and not set(CUBIC) & held and rows.refit((*terms, "servo", "k3")):
        return _lacking(rows, base)
    doubts: list[LeftOut] = []
    if cube and "k3" in terms and "k3" not in fit.wish.per_run:
        doubts += _asked(rows, base)
    if cube and not set(CUBIC) & held:
        by_k3, by_servo = _clear(rows, base, ("k3",)), rows.refit((*terms, "servo"))
        if by_k3 and by_servo:
            doubts.append(_both_meanings(fit.coefficients, base, by_k3.after, by_servo))
            base = by_k3.after
    limit = 1.0 if any(doubt.source == CUBIC_SOURCE for doubt in doubts) else CLEAR
    wave = _clear(rows, base, ("servo_damping",), limit) if "servo_damping" not in held else None
    if wave:
        scale_factor = fit.summaries[0].scale_factor
        doubts.append(damped(fit.coefficients, _values(base), _values(wave.after), wave.test, scale_factor))
    return tuple(doubts)


def _clear(rows: Rows, base: JointFit, names: Names, limit: float = CLEAR) -> Wider | None:
    """The runs with these terms as well; None where they cannot tell them apart, or as much comes more often by chance."""
    after = rows.refit((*base.wish.terms, *names))
    if after is None:
        return None
    count = sum(summary.count for summary in rows.summaries)
    test = tested(_pieces(rows, after, names), list(names), names, count)
    return Wider(base, after, test) if test is not None and test.probability <= limit else None


def _values(fit: JointFit) -> dict[str, float]:
    """Coefficients (file units) by key."""
    return {c.key: c.value for c in fit.coefficients}


def _rows(fit: JointFit) -> Rows:
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
    return Rows(fit, tuple(summaries), tuple(pieces))


def _with_columns(
    fit: JointFit, index: int, summary: RunSummary, live: LiveRun
) -> tuple[RunSummary, tuple[tuple[int, Reduction], ...]]:
    """A run at hand with the columns of ``EXTRA``: its summary, and its segments with their phase groups."""
    terms = fit.wish.terms_of(index)
    wish = replace(live.request, terms=(*terms, *(name for name in EXTRA if name not in terms)), per_run=())
    groups, per_segment = phase_groups(live.run, wish)
    plain = without_slow(live.fit, phase_groups(live.run, live.fit.design.request)[0])
    segments = reduce_rows(Design(live.run, wish, summary.inner_scale_factor), plain)
    parts = group_rows(segments, plain, groups)
    alone = [group_rows([segment], plain, (0,))[0] for segment in segments]
    wider = replace(summary, parts=parts, sources=(), added=())
    return wider, tuple(zip(groups if per_segment else (0,) * len(alone), alone, strict=True))


def _pieces(rows: Rows, fit: JointFit, names: Names) -> list[Array]:
    """Factors ``[parameters | names | residual without them]`` of the segments of all runs, linear about a fit with them."""
    layout, shared = layout_and_columns(fit.wish, rows.summaries)
    local = layout.columns[: layout.local]
    amplitudes, phases = fit.estimate.amplitudes, fit.estimate.phases
    keys = layout.amplitude_keys
    at = [keys.index((name, None)) for name in names]
    others = [i for i in range(layout.size + phases.size) if i not in at]
    found = []
    for index, (summary, pieces) in enumerate(zip(rows.summaries, rows.pieces, strict=True)):
        known = known_servo_of(summary, shared[index])
        wanted = summary.columns(local, shared[index])
        held = without_phase(shared[index], known)
        chosen = summary.choose(tuple(piece for _, piece in pieces), local, held)
        for (own, _), piece in zip(pieces, chosen, strict=True):
            group = fit.first_group(index) + own
            part = piece if fit.servo is None else at_state(piece, wanted, fit.servo, group, known)
            columns, observed = part.factor[:, :-1], part.factor[:, -1]
            turned = columns @ layout.jacobian(amplitudes, phases, group)
            left = observed - columns @ layout.linear(amplitudes, float(phases[group]), group)
            found.append(
                np.column_stack([turned[:, others], turned[:, at], left + turned[:, at] @ amplitudes[at]])
            )
    return found


def _both_meanings(
    coefficients: tuple[Coefficient, ...], base: JointFit, by_k3: JointFit, by_servo: JointFit
) -> LeftOut:
    """A cube of a_x that runs on stands of one ``a_x^2 + a_t^2`` cannot name."""
    before, after = _values(base), _values(by_k3)
    change = np.array([0.0 if c.name == "phi" else after[c.key] - before[c.key] for c in coefficients])
    under = {"servo": _values(by_servo)["scale_factor"], "k3": after["scale_factor"]}
    return cubic_doubt(coefficients, change, under, after["k3"])


def _asked(rows: Rows, base: JointFit) -> tuple[LeftOut, ...]:
    """The other meaning of a ``k3`` that is asked for, where the runs cannot tell it from the servo."""
    terms, coefficients = base.wish.terms, rows.fit.coefficients
    named = {c.key: c for c in coefficients}
    k3, scale = named["k3"], named["scale_factor"]
    swapped = rows.refit(tuple("servo" if name == "k3" else name for name in terms))
    if abs(k3.value) <= SEEN * k3.std or swapped is None or rows.refit((*terms, "servo")):
        return ()
    shift = _values(swapped)["scale_factor"] - _values(base)["scale_factor"]
    change = np.array([shift if c is scale else 0.0 for c in coefficients])
    return (LeftOut(CUBIC_SOURCE, change, asked_words(scale, shift)),)


def _lacking(rows: Rows, base: JointFit) -> tuple[LeftOut, ...]:
    """The terms that runs which tell them apart ask for: those of the servo, or ``k3``."""
    servo = tuple(name for name in SERVO_TERMS if name not in base.wish.terms)
    tried = [_clear(rows, base, names) for names in dict.fromkeys((servo, ("servo",), ("k3",)))]
    clear = [wider for wider in tried if wider]
    if not clear:
        return ()
    best = max(clear, key=lambda wider: wider.fall)
    coefficients, after = rows.fit.coefficients, _values(best.after)
    change = difference(coefficients, {c.key: c.value for c in coefficients}, after)
    words = _lacking_words(best.test.names, best.after.coefficients, coefficients, after)
    return (LeftOut(LACKING[best.test.names[0]], change, words),)


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
        f"the runs together have the signature of {sizes}, which the model lacks; with it they give {moved}. The "
        f"uncertainties hold this shift. Add {quoted} to [model] terms if it makes sense"
    )
