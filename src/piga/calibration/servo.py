"""The servo in the calibration: its columns at a phase, and refusal of terms that a record cannot determine.

The regressors of ``servo`` and ``servo_damping`` turn with the output angle. Five columns without a phase span them. At
a phase ``phi`` they combine to one column per term. The model is then not linear in the phase. A Gauss-Newton
step about the phase changes only the two columns of the coupling, because ``p = K tan_beta cos(phi)`` and ``q = K
tan_beta sin(phi)`` determine the phase. The phase does not depend on their common size, so the observation does not change
(docs/understanding/servo). When a step returns the same phase, the linear fit is the fit of the model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from piga.calibration.model.design import PHASELESS, STIFFNESS_COLUMNS, Names, ServoState
from piga.calibration.model.identifiability import examine_parts, refuse_if_confounded
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.solution import Estimate, Layout, solve_parts
from piga.errors import IdentifiabilityError
from piga.records.calibration.coefficient import short_way
from piga.records.terms import SERVO_TERMS
from piga.results import Array

_ITERATIONS = 40
"""Most steps about the phase; four are usual."""
_SETTLED = 1e-10
"""Change of the phase [rad] that ends the iteration."""
_NEAR = 1e-4
"""Share of a standard uncertainty within which the iteration may end."""
_SCAN = 24
"""Trial phases before the first step, if one phase serves the whole record: six in a wave of the cost."""
_SEEN = 4.0
"""Least ratio of tan_beta to its uncertainty for a phase that depends on the coupling; below it the phase is fixed."""
_SEPARATE = 1e-3
"""Smallest independent part of a term's column, relative to its size, for the term to be determined."""
_NAMED_SHARE = 0.05
"""Least share of that column for which another term is named."""


def at_state(
    part: Reduction,
    wanted: Names,
    state: ServoState,
    group: int,
    known: dict[str, float] | None = None,
    moved: Mapping[str, dict[str, float]] | None = None,
) -> Reduction:
    """The summary of a phase group, with the columns without a phase combined to the terms of the servo.

    Parameters
    ----------
    part:
        Summary. Its servo columns are among ``PHASELESS``.
    wanted:
        Columns of the result.
    state, group:
        State and phase group that give the phase.
    known:
        K times the given coefficients (SI); they are subtracted from the observation.
    moved:
        Changes of these by the sources of Type B, by the column of each source; it is made anew from them.
    """
    return part.mixed(wanted, mixture(part.names, wanted, state, state.phases[group], known, moved))


def mixture(
    names: Names,
    wanted: Names,
    state: ServoState,
    phase: float,
    known: dict[str, float] | None = None,
    moved: Mapping[str, dict[str, float]] | None = None,
) -> Array:
    """Matrix (m + 1, wanted + 1) from columns without a phase, and the observation behind them, to wanted columns."""
    there = [name for name in PHASELESS if name in names]
    at = [names.index(name) for name in there]
    of = [PHASELESS.index(name) for name in there]
    terms, turn = state.term_rows(phase), state.phase_row(phase)[of]
    matrix = np.zeros((len(names) + 1, len(wanted) + 1))
    matrix[-1, -1] = 1.0
    subtracted = {name: (column, moved[name]) for column, name in enumerate(wanted) if moved and name in moved}
    for column, name in enumerate(wanted):
        if name in subtracted:
            continue
        if name in terms:
            matrix[at, column] = terms[name][of]
            continue
        matrix[names.index(name), column] = 1.0
        if name == "p":
            matrix[at, column] -= np.sin(phase) * turn
        elif name == "q":
            matrix[at, column] += np.cos(phase) * turn
    for column, sizes in (*subtracted.values(), (-1, known or {})):
        for name, value in sizes.items():
            matrix[at, column] -= value * terms[name][of]
    return matrix


def find_state(
    layout: Layout, parts: list[Reduction], wanted: Sequence[Names], known: dict[str, float]
) -> ServoState:
    """The state that reproduces itself: the estimate at its phase gives the same phase.

    Parameters
    ----------
    layout, wanted:
        Layout of the model with its servo terms, and the columns of each phase group.
    parts:
        Summary of each phase group, with columns without a phase.
    known:
        K times the given coefficients (SI).
    """
    state = ServoState((0.0,) * len(parts), known.get("servo", 0.0), known.get("servo_damping", 0.0), 0.0)
    state = replace(state, phases=_first_phases(layout, parts, wanted, state, known))
    for _ in range(_ITERATIONS):
        chosen = [
            at_state(part, names, state, g, known)
            for g, (part, names) in enumerate(zip(parts, wanted, strict=True))
        ]
        estimate, rows, before = solve_parts(layout, chosen), sum(part.count for part in parts), state
        state = _moved_state(layout, estimate, known, rows)
        if _settled(layout, estimate, rows, before, state):
            break
    return state


def _settled(layout: Layout, estimate: Estimate, rows: int, before: ServoState, state: ServoState) -> bool:
    """True if a step moved no phase and no servo term by more than rounding, or than a small share of its uncertainty."""
    std = np.sqrt(np.diag(estimate.covariance) * estimate.cost / rows)
    change = np.abs(short_way(np.array(state.phases) - np.array(before.phases)))
    if (state.inverse == 0.0) != (before.inverse == 0.0) or np.any(
        change >= np.maximum(_SETTLED, _NEAR * std[layout.size :])
    ):
        return False
    keys = layout.amplitude_keys
    pairs = ((before.stiffness, state.stiffness), (before.damping, state.damping))
    return all(
        abs(new - old) <= max(1e-9 * abs(new), _NEAR * std[keys.index((name, None))])
        for name, (old, new) in zip(SERVO_TERMS, pairs, strict=True)
        if (name, None) in keys
    )


def _moved_state(layout: Layout, estimate: Estimate, known: dict[str, float], rows: int) -> ServoState:
    keys = layout.amplitude_keys
    sizes = {
        name: float(estimate.amplitudes[keys.index((name, None))])
        if (name, None) in keys
        else known.get(name, 0.0)
        for name in SERVO_TERMS
    }
    coupling = float(estimate.amplitudes[0])
    freedom = max(rows - estimate.covariance.shape[0], 1)
    deviation = np.sqrt(max(estimate.covariance[0, 0] * estimate.cost / freedom, 0.0))
    inverse = 1.0 / coupling if abs(coupling) > _SEEN * deviation else 0.0
    phases = tuple(float(phase) for phase in estimate.phases)
    return ServoState(phases, sizes["servo"], sizes["servo_damping"], inverse)


def _first_phases(
    layout: Layout, parts: list[Reduction], wanted: Sequence[Names], state: ServoState, known: dict[str, float]
) -> tuple[float, ...]:
    """First phases: from the coupling alone, or the best of a scan with all terms if one phase serves the record."""
    if len(parts) == 1:
        return (_scanned(parts[0], wanted[0], known),)
    plain = [tuple(name for name in names if name not in SERVO_TERMS) for names in wanted]
    chosen = [at_state(part, names, state, g) for g, (part, names) in enumerate(zip(parts, plain, strict=True))]
    return tuple(float(phase) for phase in solve_parts(_without_servo(layout), chosen).phases)


def _scanned(part: Reduction, wanted: Names, known: dict[str, float]) -> float:
    """Phase of least sum of squares; the coupling is bound to it."""
    best, chosen = np.inf, 0.0
    for phase in 2.0 * np.pi * np.arange(_SCAN) / _SCAN - np.pi:
        state = ServoState((float(phase),), 0.0, 0.0, 0.0)
        factor = at_state(part, wanted, state, 0, known).factor
        bound = np.column_stack([factor[:, :2] @ [np.cos(phase), np.sin(phase)], factor[:, 2:]])
        scale = np.linalg.norm(bound[:, :-1], axis=0)
        scale[scale == 0.0] = 1.0
        solution = np.linalg.lstsq(bound[:, :-1] / scale, bound[:, -1], rcond=1e-12)[0]
        cost = float(np.sum((bound[:, -1] - bound[:, :-1] / scale @ solution) ** 2))
        if cost < best and solution[0] >= 0.0:
            best, chosen = cost, float(phase)
    return chosen


def _without_servo(layout: Layout) -> Layout:
    """The layout without the terms of the servo."""
    kept = [i for i, (name, _) in enumerate(layout.keys) if name not in SERVO_TERMS]
    number = {old: new for new, old in enumerate(kept)}
    tails = tuple(
        np.array([number[int(i)] for i in tail if int(i) in number], dtype=np.int64) for tail in layout.tails
    )
    return replace(layout, keys=tuple(layout.keys[i] for i in kept), tails=tails)


def state_of(
    layout: Layout,
    parts: list[Reduction],
    wanted: Sequence[Names],
    known: dict[str, float],
    *,
    per_segment: bool = False,
    runs: int = 1,
) -> ServoState:
    """State that combines the servo columns. Without a coupling there is no phase, and only the mean of a known stiffness remains.

    Parameters as for :func:`find_state`; ``per_segment`` and ``runs`` are for the message of a refusal.

    Raises
    ------
    IdentifiabilityError
        If the parts cannot separate a servo term from the other terms.
    """
    if not layout.coupled:
        return ServoState((0.0,) * len(parts), known.get("servo", 0.0), 0.0, 0.0, turning=False)
    _refuse_if_servo_alike(layout, parts, wanted, per_segment, runs)
    return find_state(layout, parts, wanted, known)


def _refuse_if_servo_alike(
    layout: Layout, parts: list[Reduction], wanted: Sequence[Names], per_segment: bool, runs: int
) -> None:
    """Raise if the parts cannot separate a servo term from the other terms.

    The mean of ``servo`` is tested without its second harmonic. The harmonic exists, but an error of the read-out at
    twice the turn would look like it.

    Raises
    ------
    IdentifiabilityError
        Names the terms and the test that separates them.
    """
    plain = _without_servo(layout)
    state = ServoState((0.0,) * len(parts), 0.0, 0.0, 0.0)
    names = [tuple(name for name in columns if name not in SERVO_TERMS) for columns in wanted]
    rest = [at_state(part, own, state, g) for g, (part, own) in enumerate(zip(parts, names, strict=True))]
    refuse_if_confounded(examine_parts(plain, rest), runs)
    estimate = solve_parts(plain, rest)
    state = replace(state, phases=tuple(estimate.phases.tolist()))
    for term in SERVO_TERMS:
        if (term, None) not in layout.keys:
            continue
        factors = [
            part.select((*own, STIFFNESS_COLUMNS[0])).factor
            if term == "servo"
            else at_state(part, (*own, term), state, g).factor
            for g, (part, own) in enumerate(zip(parts, names, strict=True))
        ]
        alike = _made_of(plain, estimate, factors)
        if alike:
            terms = (*alike, term)
            subject = "this record" if runs == 1 else f"these {runs} runs together"
            raise IdentifiabilityError(
                f"{subject} cannot separate {', '.join(terms)}",
                remedy=_remedy(set(terms), per_segment),
                terms=terms,
            )


def _made_of(layout: Layout, estimate: Estimate, factors: list[Array]) -> Names:
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


def _remedy(terms: set[str], per_segment: bool) -> str:
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
