"""From internal parameters to named coefficients with units, and their covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piga.calibration.design import Design
from piga.calibration.solution import Solution
from piga.records.calibration import Coefficient
from piga.records.terms import harmonic, si_factor, unit_of

Array = NDArray[np.float64]


def name_coefficients(
    design: Design, solution: Solution, covariance: Array, per_segment: bool
) -> tuple[tuple[Coefficient, ...], Array]:
    """Coefficients in file units and their covariance in the same units and order.

    Internal amplitudes are multiples of K (``K tan_beta``, ``K k0``, ...); division by K, estimated or
    nominal, and the change of units are carried through the covariance to first order (JCGM 100, 5.1).
    """
    names = _names(design)
    amplitudes, phases = solution.amplitudes, solution.phases
    total = np.concatenate([amplitudes, phases])
    at_scale = names.index("scale_factor") if "scale_factor" in names else None
    scale_factor = design.run.scale_factor if at_scale is None else float(amplitudes[at_scale])
    values, jacobian = total.copy(), np.eye(total.size)
    for i, name in enumerate(names):
        if name == "scale_factor":
            continue
        values[i] /= scale_factor
        jacobian[i, i] = 1.0 / scale_factor
        if at_scale is not None:
            jacobian[i, at_scale] = -values[i] / scale_factor
    _make_tangent_positive(design, values, jacobian, len(names))
    keys: list[tuple[str, str | None]] = [(name, None) for name in names]
    labels = design.run.labels[: phases.size] if per_segment else [None] * phases.size
    keys += [("phi", label) for label in labels]
    units = np.array([1.0 / si_factor(name) for name, _ in keys])
    values, jacobian = values * units, jacobian * units[:, None]
    result = jacobian @ covariance @ jacobian.T
    std = np.sqrt(np.maximum(np.diag(result), 0.0))
    coefficients = tuple(
        Coefficient(name, float(value), float(s), unit_of(name), segment)
        for (name, segment), value, s in zip(keys, values, std, strict=True)
    )
    return _in_asked_order(design, coefficients, result)


def _names(design: Design) -> list[str]:
    """Names of the amplitudes, in internal order."""
    coupling = ["tan_beta"] if "p" in design.local_names else []
    return coupling + [n for n in design.local_names if harmonic(n)] + list(design.shared_names)


def _make_tangent_positive(design: Design, values: Array, jacobian: Array, count: int) -> None:
    """Report tan_beta >= 0: its sign goes into the phase; phases into (-pi, pi]."""
    if "p" not in design.local_names:
        return
    if values[0] < 0.0:
        values[0], jacobian[0] = -values[0], -jacobian[0]
        values[count:] += np.pi
        at = 1
        for order in design.request.harmonics:
            if order % 2:
                values[at : at + 2], jacobian[at : at + 2] = -values[at : at + 2], -jacobian[at : at + 2]
            at += 2
    values[count:] = np.pi - np.mod(np.pi - values[count:], 2.0 * np.pi)


def _in_asked_order(
    design: Design, coefficients: tuple[Coefficient, ...], covariance: Array
) -> tuple[tuple[Coefficient, ...], Array]:
    """Coefficients in the order of the request, phi behind tan_beta."""
    rank = {name: i for i, name in enumerate(design.request.terms)}
    rank["phi"] = rank.get("tan_beta", 0)
    order = sorted(range(len(coefficients)), key=lambda i: (rank[coefficients[i].name], i))
    return tuple(coefficients[i] for i in order), covariance[np.ix_(order, order)]
