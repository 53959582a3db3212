"""Coefficients as numbers of an uncertainty library, with their covariance."""

from __future__ import annotations

import math
from importlib.util import find_spec
from typing import Any

import numpy as np

from piga.errors import ArgumentError, missing_package
from piga.records.calibration import Calibration
from piga.records.terms import si_factor

LIBRARIES = ("uncertainties", "GTC")


def correlated(calibration: Calibration, library: str | None, *, si: bool) -> dict[str, Any]:
    """The coefficients by key: :meth:`piga.Calibration.correlated`."""
    if library is not None and library not in LIBRARIES:
        raise ArgumentError(f"correlated: library '{library}'", remedy=f"one of {', '.join(LIBRARIES)}")
    chosen = library or next((name for name in LIBRARIES if find_spec(name) is not None), LIBRARIES[0])
    if find_spec(chosen) is None:
        raise missing_package(chosen)
    scale = np.array([si_factor(c.name) if si else 1.0 for c in calibration.coefficients])
    values = scale * np.array([c.value for c in calibration.coefficients])
    covariance = np.outer(scale, scale) * calibration.covariance
    made = (
        _uncertainties(calibration, values, covariance)
        if chosen == "uncertainties"
        else _gtc(calibration, values, covariance)
    )
    return dict(zip(calibration, made, strict=True))


def _uncertainties(calibration: Calibration, values: np.ndarray, covariance: np.ndarray) -> list[Any]:
    from uncertainties import correlated_values_norm

    std = np.sqrt(np.diag(covariance))
    pairs = list(zip(values.tolist(), std.tolist(), strict=True))
    return list(correlated_values_norm(pairs, correlation(covariance), tags=list(calibration)))


def _gtc(calibration: Calibration, values: np.ndarray, covariance: np.ndarray) -> list[Any]:
    """Numbers of GTC, one ensemble. It has one number of degrees of freedom: the fewest of all coefficients."""
    import GTC

    std, matrix = np.sqrt(np.diag(covariance)), correlation(covariance)
    uncertain = [i for i, u in enumerate(std) if u > 0.0]
    keys = list(calibration)
    fewest = min((calibration.coefficients[i].degrees_of_freedom for i in uncertain), default=math.inf)
    made: list[Any] = [GTC.constant(value, label=key) for value, key in zip(values.tolist(), keys, strict=True)]
    numbers = GTC.multiple_ureal(values[uncertain], std[uncertain], fewest, [keys[i] for i in uncertain])
    for i, number in zip(uncertain, numbers, strict=True):
        for j in (other for other in uncertain if other < i):
            GTC.set_correlation(float(matrix[i, j]), number, made[j])
        made[i] = number
    return made


def correlation(covariance: np.ndarray) -> np.ndarray:
    """Correlation matrix; a coefficient without uncertainty correlates with none."""
    std = np.sqrt(np.diag(covariance))
    size = np.where(std > 0.0, std, 1.0)
    matrix: np.ndarray = covariance / np.outer(size, size)
    np.fill_diagonal(matrix, 1.0)
    return matrix
