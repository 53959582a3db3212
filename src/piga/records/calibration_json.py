"""``calibration.json``: the calibration record on disk (schema ``piga.calibration/1``)."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from piga.errors import CalibrationError, UnitError
from piga.records.calibration import (
    Calibration,
    Coefficient,
    Outlier,
    Provenance,
    Quality,
    RunRecord,
    SegmentSummary,
)
from piga.records.limits import read_whole
from piga.units import conversion_factor, from_si

Array = NDArray[np.float64]

SCHEMA = "piga.calibration/1"
MAX_BYTES = 256 << 20
MOST_OUTLIERS = 10_000
"""Outliers listed one by one; the events of the quality section count all of them."""


class _Quantity(msgspec.Struct, frozen=True):
    value: float
    unit: str


class _Instrument(msgspec.Struct, frozen=True):
    serial: str
    scale_factor_nominal: _Quantity


class _Model(msgspec.Struct, frozen=True):
    terms: tuple[str, ...]
    phase: str
    phase_source: str
    method: str
    temperature_reference: _Quantity = _Quantity(293.15, "K")
    time_reference: _Quantity = _Quantity(0.0, "s")


class _Coefficient(msgspec.Struct, frozen=True):
    name: str
    value: float
    std: float
    unit: str
    segment: str | None = None
    run: str | None = None
    degrees_of_freedom: float | None = None
    interval: tuple[float, float] | None = None


class _Covariance(msgspec.Struct, frozen=True):
    names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]


class _Noise(msgspec.Struct, frozen=True):
    angle_rms: _Quantity
    angle_random_walk: _Quantity
    bias_drift: _Quantity | None = None
    segment_scatter: _Quantity | None = None


class _Residual(msgspec.Struct, frozen=True):
    rms: _Quantity
    rms_before: _Quantity
    max_before: _Quantity
    max_after: _Quantity


class _Identifiability(msgspec.Struct, frozen=True):
    condition: float | None
    notes: tuple[str, ...] = ()


class _Provenance(msgspec.Struct, frozen=True):
    input_sha256: str | dict[str, str]
    software: str
    created: str
    options: dict[str, Any] = {}


class _Document(msgspec.Struct, frozen=True):
    schema: str
    instrument: _Instrument
    model: _Model
    coefficients: tuple[_Coefficient, ...]
    covariance: _Covariance
    noise: _Noise
    residual: _Residual
    quality: Quality
    identifiability: _Identifiability
    provenance: _Provenance
    uncertainty_budget: tuple[dict[str, Any], ...] = ()
    degrees_of_freedom: float = math.inf
    diagnostics: dict[str, Any] = {}
    segments: tuple[SegmentSummary, ...] = ()
    runs: tuple[RunRecord, ...] = ()
    outliers: tuple[Outlier, ...] = ()


def to_document(calibration: Calibration) -> dict[str, Any]:
    """The record as plain JSON values (file units; see ``interface.md``)."""
    c = calibration
    document: dict[str, Any] = {
        "schema": SCHEMA,
        **_subject(c),
        **_estimates(c),
        "residual": _residual(c),
        "degrees_of_freedom": c.degrees_of_freedom,
        "quality": msgspec.to_builtins(c.quality),
        "identifiability": {
            "condition": c.condition if math.isfinite(c.condition) else None,
            "notes": list(c.notes),
        },
        "diagnostics": c.diagnostics,
        "segments": [msgspec.to_builtins(s) for s in c.segments],
        "uncertainty_budget": list(c.budget),
        "provenance": msgspec.to_builtins(c.provenance),
    }
    if c.runs:
        document["runs"] = [msgspec.to_builtins(run) for run in c.runs]
    if c.outliers:
        document["outliers"] = [msgspec.to_builtins(outlier) for outlier in c.outliers[:MOST_OUTLIERS]]
    return document


def _subject(c: Calibration) -> dict[str, Any]:
    """What was calibrated, and by which model."""
    return {
        "instrument": {
            "serial": c.serial,
            "scale_factor_nominal": {"value": from_si(c.scale_factor_nominal, "rad/s/g"), "unit": "rad/s/g"},
        },
        "model": {
            "terms": list(c.terms),
            "phase": c.phase,
            "phase_source": c.phase_source,
            "method": c.method,
            "temperature_reference": {"value": c.temperature_reference, "unit": "K"},
            "time_reference": {"value": c.time_reference, "unit": "s"},
        },
    }


def _estimates(c: Calibration) -> dict[str, Any]:
    """Coefficients, their covariance and the noise levels."""
    return {
        "coefficients": [
            {"name": k.name, "value": k.value, "std": k.std, "unit": k.unit}
            | ({"segment": k.segment} if k.name == "phi" else {})
            | ({} if k.run is None else {"run": k.run})
            | _expanded(k)
            for k in c.coefficients
        ],
        "covariance": {"names": [k.key for k in c.coefficients], "matrix": c.covariance.tolist()},
        "noise": {
            "angle_rms": {"value": c.angle_rms, "unit": "rad"},
            "angle_random_walk": {"value": c.angle_random_walk, "unit": "rad/sqrt(s)"},
            "bias_drift": {"value": c.bias_drift, "unit": "rad/s/sqrt(s)"},
            "segment_scatter": {"value": c.segment_scatter, "unit": "rad/s"},
        },
    }


def _residual(c: Calibration) -> dict[str, Any]:
    """Residual figures, of angles or of rates."""
    unit = "rad/s" if c.diagnostics.get("residual_kind") == "rate" else "rad"
    figures = {
        "rms": c.residual_rms,
        "rms_before": c.residual_rms_before,
        "max_before": c.residual_max_before,
        "max_after": c.residual_max_after,
    }
    return {name: {"value": value, "unit": unit} for name, value in figures.items()}


def _expanded(coefficient: Coefficient) -> dict[str, Any]:
    """Degrees of freedom (null: infinite), coverage factor, expanded uncertainty and interval for 95 %."""
    nu = coefficient.degrees_of_freedom
    return {
        "degrees_of_freedom": nu if math.isfinite(nu) else None,
        "coverage_factor": coefficient.coverage_factor,
        "expanded": coefficient.expanded,
    } | ({} if coefficient.interval is None else {"interval": list(coefficient.interval)})


def write_calibration(calibration: Calibration, path: Path) -> None:
    """Write the record as JSON (UTF-8, indented, every float with all its digits)."""
    path.write_bytes(calibration_to_bytes(calibration))


def calibration_to_bytes(calibration: Calibration) -> bytes:
    """The bytes of ``calibration.json``."""
    text = json.dumps(to_document(calibration), indent=1, ensure_ascii=False, allow_nan=False)
    return f"{text}\n".encode()


def read_calibration(path: Path) -> Calibration:
    """Read a record.

    Raises
    ------
    CalibrationError
        If the file is missing, is no calibration record, or is of a newer schema.
    """
    return calibration_from_bytes(read_whole(path, MAX_BYTES, "a calibration.json", CalibrationError), path)


def calibration_from_bytes(raw: bytes, path: Path) -> Calibration:
    """Read a record from the bytes of its file; ``path`` names it in messages.

    Raises
    ------
    CalibrationError
        As :func:`read_calibration`.
    """
    document = _decode(raw, path)
    matrix = _matrix(path, document)
    condition = document.identifiability.condition
    return Calibration(
        serial=document.instrument.serial,
        scale_factor_nominal=_in_si(document.instrument.scale_factor_nominal, "rad/s/(m/s^2)", path),
        terms=document.model.terms,
        phase=document.model.phase,
        phase_source=document.model.phase_source,
        method=document.model.method,
        coefficients=tuple(_coefficient(c) for c in document.coefficients),
        covariance=matrix,
        degrees_of_freedom=document.degrees_of_freedom,
        angle_rms=_in_si(document.noise.angle_rms, "rad", path),
        angle_random_walk=_in_si(document.noise.angle_random_walk, "rad/sqrt(s)", path),
        bias_drift=_level(document.noise.bias_drift),
        segment_scatter=_level(document.noise.segment_scatter),
        residual_rms=document.residual.rms.value,
        residual_rms_before=document.residual.rms_before.value,
        residual_max_before=document.residual.max_before.value,
        residual_max_after=document.residual.max_after.value,
        quality=document.quality,
        condition=math.inf if condition is None else condition,
        notes=document.identifiability.notes,
        budget=document.uncertainty_budget,
        diagnostics=document.diagnostics,
        segments=document.segments,
        provenance=_provenance(document.provenance),
        temperature_reference=_in_si(document.model.temperature_reference, "K", path),
        time_reference=_in_si(document.model.time_reference, "s", path),
        runs=document.runs,
        outliers=document.outliers,
    )


def _provenance(found: _Provenance) -> Provenance:
    """Where the numbers come from; the first version named one input, by its hash alone."""
    hashes = found.input_sha256
    named = {"input": hashes} if isinstance(hashes, str) else hashes
    return Provenance(named, found.software, found.created, found.options)


def _coefficient(found: _Coefficient) -> Coefficient:
    nu = math.inf if found.degrees_of_freedom is None else found.degrees_of_freedom
    return Coefficient(
        found.name, found.value, found.std, found.unit, found.segment, found.run, nu, found.interval
    )


def _decode(raw: bytes, path: Path) -> _Document:
    try:
        kind = msgspec.json.decode(raw, type=dict[str, Any]).get("schema")
        if isinstance(kind, str) and kind.startswith("piga.calibration/") and kind != SCHEMA:
            raise CalibrationError(
                f"{path}: schema '{kind}' is not known to this version",
                remedy="update piga, or calibrate again",
            )
        if kind != SCHEMA:
            raise CalibrationError(
                f"{path}: no calibration record (no schema '{SCHEMA}')", remedy="name a calibration.json"
            )
        return msgspec.json.decode(raw, type=_Document)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise CalibrationError(
            f"{path}: not a valid calibration record: {error}", remedy="calibrate again"
        ) from None


def _level(found: _Quantity | None) -> float:
    """A noise level that older files do not have."""
    return 0.0 if found is None else found.value


def _in_si(quantity: _Quantity, like: str, path: Path) -> float:
    try:
        return quantity.value * conversion_factor(quantity.unit, like)
    except UnitError as error:
        raise CalibrationError(f"{path}: {error.message}", remedy="calibrate again") from None


def _matrix(path: Path, document: _Document) -> Array:
    """The covariance, once the parts fit: names and units known, square, symmetric, in the order of the names."""
    from piga.records.terms import check_name, unit_of

    try:
        matrix = np.array(document.covariance.matrix, dtype=float)
    except ValueError:
        matrix = np.empty(0)

    keys = tuple(
        Coefficient(c.name, c.value, c.std, c.unit, c.segment, c.run).key for c in document.coefficients
    )
    for coefficient in document.coefficients:
        if not check_name(coefficient.name):
            raise CalibrationError(f"{path}: unknown coefficient '{coefficient.name}'", remedy="update piga")
        if coefficient.unit != unit_of(coefficient.name):
            raise CalibrationError(
                f"{path}: coefficient '{coefficient.name}' in '{coefficient.unit}', '{unit_of(coefficient.name)}' is needed",
                remedy="convert it",
            )
        if not (math.isfinite(coefficient.value) and coefficient.std >= 0.0):
            raise CalibrationError(
                f"{path}: coefficient '{coefficient.name}' is no valid number", remedy="calibrate again"
            )
    if document.covariance.names != keys:
        raise CalibrationError(
            f"{path}: covariance names differ from the coefficients", remedy="calibrate again"
        )
    if matrix.shape != (len(keys), len(keys)) or not np.isfinite(matrix).all():
        raise CalibrationError(f"{path}: the covariance is not a full square matrix", remedy="calibrate again")
    spread = np.abs(matrix - matrix.T).max() if matrix.size else 0.0
    if spread > 1e-9 * np.abs(matrix).max():
        raise CalibrationError(f"{path}: the covariance is not symmetric", remedy="calibrate again")
    return matrix
