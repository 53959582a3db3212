"""From internal parameters to named coefficients with units, and their covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piga.calibration.model.design import Design
from piga.calibration.model.solution import Estimate, Layout, layout_of
from piga.records.calibration import Coefficient
from piga.records.terms import si_factor, unit_of

Array = NDArray[np.float64]
Owner = tuple[str | None, str | None]
"""Segment and run that a phase belongs to; None where it serves all of them."""


def name_coefficients(
    design: Design, solution: Estimate, covariance: Array, per_segment: bool
) -> tuple[tuple[Coefficient, ...], Array]:
    """Coefficients of one run in file units and their covariance in the same units and order."""
    count = solution.phases.size
    owners: list[Owner] = [(label if per_segment else None, None) for label in design.run.labels[:count]]
    layout = layout_of(design, max(count, 1))
    return name_parameters(layout, solution, covariance, design.run.scale_factor, design.request.terms, owners)


def name_parameters(
    layout: Layout,
    estimate: Estimate,
    covariance: Array,
    scale_factor: float,
    terms: tuple[str, ...],
    owners: list[Owner],
) -> tuple[tuple[Coefficient, ...], Array]:
    """Coefficients in file units and their covariance in the same units and order.

    Internal amplitudes are multiples of K (``K tan_beta``, ``K k0``, ...); division by K, estimated or
    nominal (``scale_factor``), and the change of units are carried through the covariance to first order
    (JCGM 100, 5.1). ``terms`` give the order, ``owners`` say whose the phases are.
    """
    keys = layout.amplitude_keys
    total = np.concatenate([estimate.amplitudes, estimate.phases])
    at_scale = keys.index(("scale_factor", None)) if ("scale_factor", None) in keys else None
    if at_scale is not None:
        scale_factor = float(total[at_scale])
    values, jacobian = total.copy(), np.eye(total.size)
    for i in range(len(keys)):
        if i == at_scale:
            continue
        values[i] /= scale_factor
        jacobian[i, i] = 1.0 / scale_factor
        if at_scale is not None:
            jacobian[i, at_scale] = -values[i] / scale_factor
    _make_tangent_positive(layout, values, jacobian)
    named: list[tuple[str, str | None, str | None]] = [(name, None, run) for name, run in keys]
    named += [("phi", segment, run) for segment, run in owners]
    units = np.array([1.0 / si_factor(name) for name, _, _ in named])
    values, jacobian = values * units, jacobian * units[:, None]
    result = jacobian @ covariance @ jacobian.T
    std = np.sqrt(np.maximum(np.diag(result), 0.0))
    coefficients = tuple(
        Coefficient(name, float(value), float(s), unit_of(name), segment, run)
        for (name, segment, run), value, s in zip(named, values, std, strict=True)
    )
    return _in_asked_order(terms, coefficients, result)


def _make_tangent_positive(layout: Layout, values: Array, jacobian: Array) -> None:
    """Report tan_beta >= 0: its sign goes into the phase; phases into (-pi, pi]."""
    if not layout.coupled:
        return
    if values[0] < 0.0:
        values[0], jacobian[0] = -values[0], -jacobian[0]
        values[layout.size :] += np.pi
        at = 1
        for order in layout.orders:
            if order % 2:
                values[at : at + 2], jacobian[at : at + 2] = -values[at : at + 2], -jacobian[at : at + 2]
            at += 2
        for index, (name, _) in enumerate(layout.keys, start=layout.head):
            if name == "servo_damping":
                values[index], jacobian[index] = -values[index], -jacobian[index]
    values[layout.size :] = np.pi - np.mod(np.pi - values[layout.size :], 2.0 * np.pi)


def _in_asked_order(
    terms: tuple[str, ...], coefficients: tuple[Coefficient, ...], covariance: Array
) -> tuple[tuple[Coefficient, ...], Array]:
    """Coefficients in the order of the request, phi behind tan_beta."""
    rank = {name: i for i, name in enumerate(terms)}
    rank["phi"] = rank.get("tan_beta", 0)
    order = sorted(range(len(coefficients)), key=lambda i: (rank[coefficients[i].name], i))
    return tuple(coefficients[i] for i in order), covariance[np.ix_(order, order)]
