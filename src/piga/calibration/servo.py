"""Refusal of servo terms that a record cannot determine.

Five columns without a phase span the regressors of ``servo`` and ``servo_damping``, which turn with the output angle. Their
coefficients follow from the terms and the phase (:class:`piga.calibration.model.solution.Layout`;
docs/understanding/servo).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from piga.calibration.model.identifiability import examine_parts, refuse_if_confounded
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.solution import (
    PHASELESS,
    STIFFNESS_COLUMNS,
    Estimate,
    Layout,
    at_phase,
    solve_parts,
)
from piga.errors import IdentifiabilityError
from piga.results import Array

_SEPARATE = 1e-3
"""Smallest independent part of a term's column, relative to its size, for the term to be determined."""
_NAMED_SHARE = 0.05
"""Least share of that column for which another term is named."""


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
            subject = "this record" if runs == 1 else f"these {runs} runs together"
            raise IdentifiabilityError(
                f"{subject} cannot separate {', '.join(terms)}",
                remedy=_remedy(set(terms), per_segment),
                terms=terms,
            )


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
