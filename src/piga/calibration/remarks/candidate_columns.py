"""Columns of terms that are not in the model, good enough to test for them: trapezoid over the samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piga.calibration.fit.one_run import Fit
from piga.calibration.model.design import Block, Design
from piga.records.run import Run
from piga.records.spool import extent, gathered
from piga.records.terms import SERVO_TERMS, harmonic

Array = NDArray[np.float64]

SINGLE = (
    "k0", "k1", "k2", "k3", "k2o", "m_Y", "m_Z", "k_XY", "k_XZ", "k_YY", "k_ZZ", "k_YZ", "k0_t", "k0_T", "k1_T",
    *SERVO_TERMS,
)  # fmt: skip
CUBIC = ("servo", "k3", "k2o")
"""Terms that take an odd signature of a_x; the one to think of first comes first."""
CONSTANT = 1e-3
"""Relative change of a squared force that counts as none."""
LOOKED = 4096
"""Samples that are looked at for that."""
PAIRS = (("tan_beta", ("p", "q")), ("s1", ("s1", "c1")), ("s2", ("s2", "c2")))
"""Candidates that turn with the output: term that stands for them, and their columns."""


def candidate_terms(design: Design) -> list[tuple[str, ...]]:
    """Columns of every candidate that the model lacks and the record can hold.

    What turns with the output is left out where the zero of its angle is not known in all segments.
    """
    terms, run = design.request.terms, design.run
    low, high = (0.0, 0.0) if run.temperature is None else extent(run.temperature)
    left_out = set(terms) | ({"k1"} if "scale_factor" in terms else set())
    left_out |= {"k0_T", "k1_T"} if low == high else set()
    left_out |= servo_out_of_reach(design)
    found: list[tuple[str, ...]] = [(name,) for name in SINGLE if name not in left_out]
    if design.request.phase == "shared" or "tan_beta" in terms:
        found += [columns for name, columns in PAIRS if name not in terms]
    return found


def servo_out_of_reach(design: Design) -> set[str]:
    """Terms that a record cannot tell from others because of the servo, or the servo because of them."""
    total, across = constant_squares(design.run)
    terms = design.request.terms
    scaled = "scale_factor" in terms or "k1" in terms
    found = set(design.turning_servo) if "tan_beta" in terms else set(SERVO_TERMS)
    if scaled and total is not None:
        found |= {"k3"} if "servo" in terms else set()
        found |= {"servo"} if "k3" in terms else set()
    if scaled and across is not None:
        found |= {"servo"}
    return found


def constant_squares(run: Run) -> tuple[float | None, float | None]:
    """``a_x^2 + a_t^2`` and ``a_t^2`` [m^2/s^4] of a record; None for one that changes."""
    f = gathered(run.f, np.unique(np.linspace(0, run.size - 1, LOOKED).astype(np.int64)))
    across = f[:, 1] ** 2 + f[:, 2] ** 2
    found: list[float | None] = []
    for square in (across + f[:, 0] ** 2, across):
        low, middle, high = np.quantile(square, (0.005, 0.5, 0.995))
        found.append(float(middle) if high - low <= CONSTANT * middle else None)
    return found[0], found[1]


def candidate_sums(
    fit: Fit, block: Block, names: list[str], starts: NDArray[np.int64], step: int
) -> list[Array]:
    """Integrals of the candidates over joined intervals of a block (sums of their values, for a log of rates).

    Parameters
    ----------
    fit, block, names:
        The fit, a block of its design and the columns wanted.
    starts:
        Rows of the block at which the joined intervals begin, the first 0.
    step:
        Samples between those that are looked at, where the record is smooth; a log of rates is looked at in full.
    """
    design, run = fit.design, fit.design.run
    size, first = block.h.size, block.start if design.point else block.start - 1
    at = np.arange(size)
    if not design.point:
        looked = np.zeros(size + 1, dtype=bool)
        looked[::step] = looked[starts] = looked[size] = True
        at = np.flatnonzero(looked)
    rows = first + at
    phase = fit.solution.phases
    group = block.segment if phase.size > 1 else 0
    alpha = design.phase_angle[rows] + (phase[group] if phase.size else 0.0)
    a = np.ascontiguousarray(run.f[rows].T)
    t = run.t[rows] - design.time_reference
    warm = t if run.temperature is None else run.temperature[rows] - design.request.temperature_reference
    turning = a if run.base_rate is None else a - run.base_rate[rows].T / design.scale_factor
    values = (term_values(name, a, t, warm, turning, alpha) for name in names)
    if design.point:
        return [np.add.reduceat(value, starts) for value in values]
    half = 0.5 * np.where(run.begins[first + 1 + at[:-1]], 0.0, np.diff(t))
    edges = np.searchsorted(at, starts)
    return [np.add.reduceat(half * (value[1:] + value[:-1]), edges) for value in values]


def term_values(name: str, a: Array, t: Array, warm: Array, turning: Array, alpha: Array) -> Array:
    """What the column of a term holds at the samples, its integrand.

    Parameters
    ----------
    name:
        Term, or ``p``, ``q`` of the coupling.
    a:
        (3, n) specific force [m/s^2].
    t, warm:
        (n,) time [s] and temperature [K] from their references.
    turning:
        (3, n) specific force less base rate over K [m/s^2].
    alpha:
        (n,) angle that the column turns with [rad].
    """
    order = harmonic(name)
    if order:
        return np.sin(order[1] * alpha) if order[0] == "s" else np.cos(order[1] * alpha)
    x, y, z = a
    if name in ("p", "q", *SERVO_TERMS):
        sine, cosine = np.sin(alpha), np.cos(alpha)
        if name in ("p", "servo"):
            across = turning[1] * sine - turning[2] * cosine
            return across if name == "p" else -2.0 * turning[0] * across**2
        along = turning[1] * cosine + turning[2] * sine
        return along if name == "q" else -(turning[0] ** 2) * along
    if name in ("k0_t", "k0_T", "k1_T"):
        return {"k0_t": t, "k0_T": warm, "k1_T": x * warm}[name]
    factors = {
        "k0": (), "k1": (x,), "k2": (x, x), "k3": (x, x, x), "k2o": (x, np.abs(x)), "m_Y": (y,), "m_Z": (z,),
        "k_XY": (x, y), "k_XZ": (x, z), "k_YY": (y, y), "k_ZZ": (z, z), "k_YZ": (y, z),
    }[name]  # fmt: skip
    result = np.ones_like(x)
    for factor in factors:
        result = result * factor
    return result
