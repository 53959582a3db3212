"""A calibration made of given coefficients, without a run."""

from __future__ import annotations

import datetime as dt
import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from piga._version import __version__
from piga.errors import ArgumentError, CalibrationError
from piga.records.calibration import (
    BudgetTable,
    Calibration,
    Coefficient,
    Diagnostics,
    Given,
    Provenance,
    Quality,
)
from piga.records.calibration.document import calibration_from_bytes, calibration_to_bytes
from piga.records.run_file import PHASE_SOURCES, check_direct_unit
from piga.records.terms import GYRO, check_name, scale_factor_in, unit_of
from piga.units import from_si, numbers_are_si, to_si

WHERE = "Calibration.from_coefficients"
_KEY = re.compile(r"([^\[\]]+)(?:\[(.+)\])?")


def calibration_of(
    coefficients: Mapping[str, Given],
    covariance: ArrayLike | None,
    serial: str,
    scale_factor_nominal: float | str | None,
    phase_source: str,
    unit: str = GYRO,
) -> Calibration:
    """The calibration with these coefficients: :meth:`piga.Calibration.from_coefficients`.

    It passes the checks of a calibration that is read from a file.
    """
    if unit != GYRO:
        check_direct_unit(unit, f"{WHERE} unit")
    named = [_coefficient(key, given, unit) for key, given in coefficients.items()]
    if not named:
        raise ArgumentError(
            f"{WHERE}: no coefficient is given", remedy='e.g. {"scale_factor": "0.8884 rad/s/g"}'
        )
    matrix = _matrix(named, covariance)
    std = np.sqrt(np.diag(matrix))
    given = [
        Coefficient(c.name, c.value, float(u), c.unit, c.segment, None, c.degrees_of_freedom)
        for c, u in zip(named, std, strict=True)
    ]
    per_segment = any(c.segment is not None for c in given)
    made = Calibration(
        serial=serial,
        scale_factor_nominal=_nominal(given, scale_factor_nominal, unit),
        terms=tuple(c.name for c in given if c.name != "phi"),
        phases="per-segment" if per_segment else "shared",
        phase_source=_chosen(phase_source),
        method="information",
        coefficients=tuple(given),
        covariance=matrix,
        surplus_observations=0.0,
        angle_rms=0.0,
        angle_random_walk=0.0,
        residual_rms=0.0,
        residual_rms_before=0.0,
        residual_max_before=0.0,
        residual_max_after=0.0,
        quality=Quality(0, 0, 0),
        condition=math.inf,
        notes=("the coefficients were given, not estimated from a record: no test was made",),
        budget=BudgetTable(),
        diagnostics=Diagnostics(),
        segments=(),
        provenance=Provenance({}, f"piga {__version__}", dt.datetime.now(dt.UTC).isoformat(timespec="seconds")),
        unit=unit,
    )
    try:
        return calibration_from_bytes(calibration_to_bytes(made), Path(WHERE))
    except (CalibrationError, ValueError) as error:
        raise ArgumentError(str(error).partition("\n")[0], remedy="correct the coefficients") from None


def _coefficient(key: str, given: Given, output: str) -> Coefficient:
    parts = _KEY.fullmatch(key)
    name, segment = parts.groups() if parts else (key, None)
    if not check_name(name):
        raise ArgumentError(
            f"{WHERE}: unknown coefficient '{key}'", remedy="e.g. scale_factor, tan_beta, phi, k0"
        )
    if segment is not None and name != "phi":
        raise ArgumentError(
            f"{WHERE}: '{key}': only a phase can belong to a segment", remedy=f"name it '{name}'"
        )
    if isinstance(given, Coefficient):
        if given.key != key:
            raise ArgumentError(f"{WHERE}: '{key}' is the coefficient '{given.key}'", remedy="use its own name")
        return given
    value, std = given if isinstance(given, tuple) else (given, 0.0)
    unit = unit_of(name, output)
    u = _number(std, unit, f"{WHERE} u({key})")
    if u < 0.0:
        raise ArgumentError(
            f"{WHERE} u({key}): a standard uncertainty is not negative", remedy="give it without sign"
        )
    return Coefficient(name, _number(value, unit, f"{WHERE} {key}"), u, unit, segment)


def _number(given: float | str, unit: str, what: str) -> float:
    """A number in the unit of the file; a text carries its own unit."""
    return (
        from_si(to_si(given, unit, what=what), unit) if isinstance(given, str) else to_si(given, "1", what=what)
    )


def _matrix(named: list[Coefficient], covariance: ArrayLike | None) -> np.ndarray:
    std = np.array([c.std for c in named])
    if covariance is None:
        return np.diag(std**2)
    matrix = np.asarray(covariance, dtype=float)
    size = len(named)
    if matrix.shape != (size, size):
        raise ArgumentError(
            f"{WHERE} covariance: shape {matrix.shape}, but there are {size} coefficients: {(size, size)} is needed",
            remedy="one row and one column for each coefficient, in their order",
        )
    variance = np.diag(matrix)
    if not np.isfinite(matrix).all() or (variance < 0.0).any():
        raise ArgumentError(f"{WHERE} covariance: a variance is negative or not finite", remedy="correct it")
    wrong = (std > 0.0) & ~np.isclose(np.sqrt(variance), std, rtol=1e-6)
    if wrong.any():
        key = named[int(np.argmax(wrong))].key
        raise ArgumentError(
            f"{WHERE} covariance: it contradicts the standard uncertainty of '{key}'",
            remedy="give one of the two",
        )
    return matrix


def _nominal(named: list[Coefficient], given: float | str | None, unit: str) -> float:
    estimated = next((c.value_si for c in named if c.name == "scale_factor"), None)
    with numbers_are_si(True):
        nominal = estimated if given is None else scale_factor_in(given, unit, f"{WHERE} scale_factor_nominal")
    if nominal is not None:
        if not nominal > 0.0:
            raise ArgumentError(f"{WHERE}: the scale factor must be positive", remedy="reverse the input axis")
        return nominal
    raise ArgumentError(
        f"{WHERE}: there is no scale factor", remedy="add 'scale_factor' or scale_factor_nominal"
    )


def _chosen(phase_source: str) -> str:
    if phase_source not in PHASE_SOURCES:
        raise ArgumentError(
            f"{WHERE} phase_source: '{phase_source}'", remedy=f"one of {', '.join(PHASE_SOURCES)}"
        )
    return phase_source
