"""``calibration.json``: the calibration record on disk (schema ``piga.calibration/1``). And records of given coefficients."""

from __future__ import annotations

import datetime as dt
import hashlib
import json
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from piga._version import __version__
from piga.errors import ArgumentError, CalibrationError, PigaError, UnitError, Where
from piga.output import check_results
from piga.records.calibration import (
    Amount,
    BudgetEntry,
    BudgetTable,
    Calibration,
    Coefficient,
    Diagnostics,
    Given,
    Level,
    Outlier,
    Provenance,
    Quality,
    RunRecord,
    SegmentSummary,
    StandSource,
)
from piga.records.limits import check_label, read_whole
from piga.records.run_file import PHASE_SOURCES, Method, Phases, PhaseSource, check_direct_unit
from piga.records.terms import GYRO, check_name, integral_unit, scale_factor_in, si_factor, turns, unit_of
from piga.records.text_files import JsonError, json_object
from piga.results import Array
from piga.units import conversion_factor, from_si, numbers_are_si, parse_unit, to_si

SCHEMA = "piga.calibration/1"


MOST_BYTES = 256 << 20
"""Largest file [bytes]."""
ROUNDING = 1e-9
"""Largest rounding error of a correlation (own choice). The smallest eigenvalue may be this, times the matrix size, below zero."""
SAME = 1e-6
"""Largest relative difference between a standard uncertainty and the square root of its variance (own choice)."""
_MOST_OUTLIERS = 10_000
"""Most outliers that are listed one by one. The events of the quality section count all of them."""


class _Level(msgspec.Struct, frozen=True):
    value: Level
    unit: str


class _Instrument(msgspec.Struct, frozen=True):
    serial: str
    scale_factor_nominal: _Level
    scale_factor_tolerance: Level = 0.01


class _Model(msgspec.Struct, frozen=True):
    terms: tuple[str, ...]
    method: Method | Literal["published"]
    phase: Phases = "shared"
    phase_source: PhaseSource = "output"
    temperature_reference: _Level = _Level(293.15, "K")
    time_reference: Amount = Amount(0.0, "s")


class _Covariance(msgspec.Struct, frozen=True):
    names: tuple[str, ...]
    matrix: tuple[tuple[Annotated[float, msgspec.Meta(ge=-1e200, le=1e200)], ...], ...]


class _Noise(msgspec.Struct, frozen=True, omit_defaults=True):
    angle_rms: _Level
    angle_random_walk: _Level
    segment_scatter: _Level | None = None


class _Residual(msgspec.Struct, frozen=True):
    rms: _Level
    rms_before: _Level
    max_before: _Level
    max_after: _Level


class _Identifiability(msgspec.Struct, frozen=True):
    condition: Annotated[float, msgspec.Meta(ge=1.0)] | None
    notes: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


class _Document(msgspec.Struct, frozen=True, kw_only=True):
    """A whole document. Keys that are not named here, such as those of earlier or later versions, are ignored."""

    schema: str
    instrument: _Instrument
    model: _Model
    coefficients: tuple[Coefficient, ...]
    uncertainty_budget: tuple[BudgetEntry, ...] = ()
    covariance: _Covariance
    noise: _Noise
    residual: _Residual
    quality: Quality
    identifiability: _Identifiability
    provenance: Provenance
    surplus_observations: Level = math.inf
    diagnostics: Diagnostics = Diagnostics()
    segments: tuple[SegmentSummary, ...] = ()
    runs: tuple[RunRecord, ...] = ()
    outliers: tuple[Outlier, ...] = ()
    sources_of_the_stand: tuple[StandSource, ...] = ()
    gravity: str = ""


def to_document(calibration: Calibration) -> dict[str, Any]:
    """The record as plain JSON values (file units).

    The verdict is for people who read the file. piga does not read it back: it computes the verdict again from the record.
    """
    c, verdict = calibration, calibration.verdict
    residual, count, per_g = c.residual_unit, integral_unit(c.unit), si_factor("scale_factor")
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "instrument": _Instrument(
            c.serial, _Level(c.scale_factor_nominal / per_g, f"{c.unit}/g"), c.scale_factor_tolerance
        ),
        "model": _Model(
            c.terms,
            cast("Method", c.method),
            cast("Phases", c.phases),
            cast("PhaseSource", c.phase_source),
            _Level(c.temperature_reference, "K"),
            Amount(c.time_reference, "s"),
        ),
        "coefficients": [_stated(k) for k in c.coefficients],
        "covariance": {"names": [k.key for k in c.coefficients], "matrix": c.covariance.tolist()},
        "noise": _Noise(
            _Level(c.angle_rms, count),
            _Level(c.angle_random_walk, f"{count}/sqrt(s)"),
            _Level(c.segment_scatter, c.unit),
        ),
        "residual": _Residual(
            _Level(c.residual_rms, residual),
            _Level(c.residual_rms_before, residual),
            _Level(c.residual_max_before, residual),
            _Level(c.residual_max_after, residual),
        ),
        "surplus_observations": c.surplus_observations,
        "quality": c.quality,
        "identifiability": _Identifiability(
            c.condition if math.isfinite(c.condition) else None, c.notes, c.remarks
        ),
        "verdict": verdict.document(),
        "diagnostics": c.diagnostics.document(),
        "segments": c.segments,
        "uncertainty_budget": [row.document() for row in c.budget],
        "sources_of_the_stand": c.sources,
        "gravity": c.gravity,
        "provenance": c.provenance,
    }
    if c.runs:
        document["runs"] = [_renamed(msgspec.to_builtins(run), "phases", "phase") for run in c.runs]
    if c.outliers:
        document["outliers"] = c.outliers[:_MOST_OUTLIERS]
    plain = cast("dict[str, Any]", msgspec.to_builtins(document, enc_hook=float))
    if c.direct:  # nothing turns
        for table, keys in (
            (plain["model"], ("phase", "phase_source")),
            *((s, ("turns",)) for s in plain["segments"]),
        ):
            for key in keys:
                table.pop(key, None)
    return plain


def _stated(c: Coefficient) -> dict[str, Any]:
    """A coefficient. ``expanded`` is the half-width for 95 %; infinite degrees of freedom are null."""
    stated: dict[str, Any] = {"name": c.name, "value": c.value, "std": c.std, "unit": c.unit}
    stated |= {"segment": c.segment} if c.name == "phi" else {}
    stated |= {} if c.run is None else {"run": c.run}
    nu, covered = c.degrees_of_freedom, c.coverage
    stated["degrees_of_freedom"] = nu if math.isfinite(nu) else None
    if covered.monte_carlo:
        return stated | {"expanded": covered.half_width, "interval": [covered.low, covered.high]}
    return stated | {"coverage_factor": covered.factor, "expanded": covered.half_width}


def calibration_to_bytes(calibration: Calibration) -> bytes:
    """The bytes of ``calibration.json``: UTF-8, indented, every float with all its digits."""
    text = json.dumps(to_document(calibration), indent=1, ensure_ascii=False, allow_nan=False)
    return f"{text}\n".encode()


def read_calibration(path: Path) -> Calibration:
    """Read a record.

    Raises
    ------
    CalibrationError
        If the file is missing, is not a calibration record, is of a newer schema, or contradicts itself.
        Compensation, certificates and the store all read through this check.
    """
    return read_with_digest(path)[0]


def read_with_digest(path: Path) -> tuple[Calibration, str]:
    """Read a record and the SHA-256 of its bytes.

    Raises
    ------
    CalibrationError
        As :func:`read_calibration`.
    """
    check_results(path.parent)
    raw = read_whole(path, MOST_BYTES, "a calibration.json", CalibrationError)
    return calibration_from_bytes(raw, path), hashlib.sha256(raw).hexdigest()


def calibration_from_bytes(raw: bytes, path: Path) -> Calibration:
    """Read a record from the bytes of its file; ``path`` names it in messages.

    Raises
    ------
    CalibrationError
        As :func:`read_calibration`.
    """
    document = _decoded(raw, path)
    matrix = _check(path, document)
    model, noise, residual, found = document.model, document.noise, document.residual, document.identifiability
    unit = _output_unit(document, path)
    count = integral_unit(unit)
    return Calibration(
        serial=document.instrument.serial,
        scale_factor_nominal=_nominal(document, unit, path),
        terms=model.terms,
        phases=model.phase,
        phase_source=model.phase_source,
        method=model.method,
        coefficients=document.coefficients,
        covariance=matrix,
        surplus_observations=document.surplus_observations,
        angle_rms=_in_si(noise.angle_rms, count, path),
        angle_random_walk=_in_si(noise.angle_random_walk, f"{count}/sqrt(s)", path),
        segment_scatter=0.0 if noise.segment_scatter is None else noise.segment_scatter.value,
        residual_rms=residual.rms.value,
        residual_rms_before=residual.rms_before.value,
        residual_max_before=residual.max_before.value,
        residual_max_after=residual.max_after.value,
        quality=document.quality,
        condition=math.inf if found.condition is None else found.condition,
        notes=found.notes,
        remarks=found.remarks,
        budget=BudgetTable(document.uncertainty_budget),
        diagnostics=document.diagnostics,
        segments=document.segments,
        provenance=document.provenance,
        temperature_reference=_in_si(model.temperature_reference, "K", path),
        time_reference=_in_si(model.time_reference, "s", path),
        runs=document.runs,
        outliers=document.outliers,
        sources=document.sources_of_the_stand,
        scale_factor_tolerance=document.instrument.scale_factor_tolerance,
        gravity=document.gravity,
        unit=unit,
    )


def _nominal(document: _Document, unit: str, path: Path) -> float:
    """Nominal K [unit of the output rate per m/s^2]."""
    nominal = document.instrument.scale_factor_nominal
    per_g = si_factor("scale_factor")
    return nominal.value * per_g if nominal.unit == f"{unit}/g" else _in_si(nominal, f"{unit}/(m/s^2)", path)


def _output_unit(document: _Document, path: Path) -> str:
    """Unit of the output rate: that of the nominal K without ``/g``. An angle is that of a gyro accelerometer."""
    unit = document.instrument.scale_factor_nominal.unit.rpartition("/")[0]
    try:
        return GYRO if not unit or parse_unit(unit).dimension == parse_unit(GYRO).dimension else unit
    except UnitError as error:
        raise _not_valid(path, error.message) from None


def _renamed(entry: dict[str, Any], old: str, new: str) -> dict[str, Any]:
    return {new if key == old else key: value for key, value in entry.items()}


def _with_names_of_today(document: dict[str, Any]) -> None:
    """Bring what a file says otherwise than :class:`Calibration` to its form."""
    if document.get("surplus_observations") is None and "degrees_of_freedom" in document:  # the first version
        document["surplus_observations"] = document["degrees_of_freedom"]
    origin = document.get("provenance")
    if isinstance(origin, dict) and isinstance(origin.get("input_sha256"), str):  # the first version: one input
        origin["input_sha256"] = {"input": origin["input_sha256"]}
    for run in _tables(document, "runs"):
        if "phase" in run:
            run["phases"] = run.pop("phase")
    for coefficient in _tables(document, "coefficients"):
        if coefficient.get("degrees_of_freedom") is None:  # infinite
            coefficient.pop("degrees_of_freedom", None)


def _tables(document: dict[str, Any], key: str) -> list[dict[str, Any]]:
    entries = document.get(key)
    return [entry for entry in entries if isinstance(entry, dict)] if isinstance(entries, list) else []


def _decoded(raw: bytes, path: Path) -> _Document:
    """A record of the known schema. It may hold no key twice."""
    try:
        document = json_object(raw)
        schema = document.get("schema")
        if schema == SCHEMA:
            _with_names_of_today(document)
            return msgspec.convert(document, _Document)
    except (JsonError, msgspec.ValidationError) as error:
        raise _not_valid(path, str(error).replace("phases", "phase")) from None
    if isinstance(schema, str) and schema.startswith("piga.calibration/"):
        raise CalibrationError(
            f"{path}: schema '{schema}' is not known to this version",
            remedy="update piga, or calibrate again",
            where=Where(path),
        )
    raise CalibrationError(
        f"{path}: is not a calibration record (it lacks the schema '{SCHEMA}')",
        remedy="name a calibration.json",
        where=Where(path),
    )


def _not_valid(path: Path, why: str) -> CalibrationError:
    return CalibrationError(
        f"{path}: not a valid calibration record: {why}", remedy="calibrate again", where=Where(path)
    )


def _in_si(quantity: Amount | _Level, like: str, path: Path) -> float:
    try:
        return quantity.value * conversion_factor(quantity.unit, like)
    except UnitError as error:
        raise CalibrationError(
            f"{path}: {error.message}", remedy="calibrate again", where=Where(path)
        ) from None


def _check(path: Path, document: _Document) -> Array:
    """Check that the parts agree with each other, and return the covariance."""
    try:
        if document.instrument.serial:
            check_label(document.instrument.serial, "the serial")
        unit = _output_unit(document, path)
        wrong = (
            *(fault for c in document.coefficients for fault in _faults(c, unit)),
            *_contradictions(document),
        )
        if not wrong:
            return _covariance(document)
    except PigaError as error:
        raise CalibrationError(f"{path}: {error.message}", remedy=error.remedy) from None
    raise CalibrationError(f"{path}: {wrong[0]}", remedy="get the file from its author, or calibrate again")


def _faults(c: Coefficient, output: str) -> Iterator[str]:
    """Faults of one coefficient by itself. ``output`` is the unit of the output rate."""
    if not check_name(c.name):
        yield f"unknown coefficient '{c.name[:60]}': a later version may know it"
    elif c.unit != unit_of(c.name, output):
        yield f"coefficient '{c.name}' in '{c.unit[:60]}', '{unit_of(c.name, output)}' is needed"
    elif output != GYRO and turns(c.name):
        yield f"'{c.name}' belongs to a gyro accelerometer, and the output is in '{output}'"
    elif c.name == "scale_factor" and not c.value > 0.0:
        yield f"scale_factor is {c.value:g}, it must be positive"
    elif c.name == "tan_beta" and c.value < 0.0:
        yield f"tan_beta is {c.value:g}, it must not be negative: its sign is in phi"
    if c.interval is not None and not c.interval[0] <= c.interval[1]:
        yield f"the ends of the interval of '{c.key}' are interchanged"
    if c.segment is not None and c.name != "phi":
        yield f"'{c.key}': only a phase can belong to a segment"
    if c.run is not None and c.name in ("scale_factor", "tan_beta"):
        yield f"'{c.key}': the coefficient belongs to the instrument, not to a run"


def _contradictions(document: _Document) -> Iterator[str]:
    """Contradictions between the parts of a record."""
    if not document.instrument.scale_factor_nominal.value > 0.0:
        yield "scale_factor_nominal is not positive"
    model, quality, coefficients = document.model, document.quality, document.coefficients
    runs = {run.name for run in document.runs}
    keys = [c.key for c in coefficients]
    names = {c.name for c in coefficients}
    twice = next((key for key, count in Counter(keys).items() if count > 1), None)
    if twice is not None:
        yield f"the coefficient '{twice}' occurs twice"
    if len(set(model.terms)) < len(model.terms):
        yield f"a term is named twice: {', '.join(model.terms)[:80]}"
    for term in model.terms:
        if term not in names:
            yield f"there is no coefficient of the term '{term[:60]}'"
    for c in coefficients:
        if c.name not in (*model.terms, "phi"):
            yield f"the coefficient '{c.name[:60]}' is not among the terms"
        if c.run is not None and c.run not in runs:
            yield f"'{c.key}': there is no run '{c.run}'"
        if model.phase == "shared" and c.segment is not None:
            yield f"the phase is 'shared', but '{c.key}' is of one segment"
    if max(quality.used, quality.masked) > quality.rows:
        yield "more rows are used or masked than the record has"
    try:
        dt.datetime.fromisoformat(document.provenance.created)
    except ValueError:
        yield f"provenance.created: '{document.provenance.created[:40]}' is not a time"


def _covariance(document: _Document) -> Array:
    """The covariance matrix, after its checks.

    It must be square, symmetric and positive semi-definite (to ``ROUNDING`` of the correlations), and in the
    order of the coefficients. Its diagonal must be the squares of their standard uncertainties. The published
    recursion of piga 0.1 left its covariance asymmetric by rounding: there the asymmetry is compared with the largest
    element.
    """
    again, coefficients = "calibrate again", document.coefficients
    if document.covariance.names != tuple(c.key for c in coefficients):
        raise CalibrationError("covariance names differ from the coefficients", remedy=again)
    size = len(coefficients)
    if [len(row) for row in document.covariance.matrix] != [size] * size:
        raise CalibrationError("the covariance is not a full square matrix", remedy=again)
    matrix = np.array(document.covariance.matrix, dtype=float).reshape(size, size)
    for c, variance in zip(coefficients, np.diag(matrix), strict=True):
        if variance < 0.0:
            raise CalibrationError(f"the variance of '{c.key}' is negative", remedy=again)
        if abs(math.sqrt(variance) - c.std) > SAME * max(c.std, math.sqrt(variance)):
            raise CalibrationError(
                f"the standard uncertainty of '{c.key}' is {c.std:.6g}, but the covariance gives "
                f"{math.sqrt(variance):.6g}",
                remedy=again,
            )
    scale = np.sqrt(np.diag(matrix))
    scale[scale == 0.0] = 1.0
    correlation = matrix / scale / scale[:, None]
    held = matrix if document.model.method == "published" else correlation
    if np.abs(held - held.T).max() > ROUNDING * np.abs(held).max():
        raise CalibrationError("the covariance is not symmetric", remedy=again)
    try:
        np.linalg.cholesky(0.5 * (correlation + correlation.T) + size * ROUNDING * np.eye(size))
    except np.linalg.LinAlgError:
        raise CalibrationError("the covariance is not positive semi-definite", remedy=again) from None
    return matrix


# -- given coefficients ---------------------------------------------------------------------------------

_GIVEN = "Calibration.from_coefficients"
_GIVEN_KEY = re.compile(r"([^\[\]]+)(?:\[(.+)\])?")


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
        check_direct_unit(unit, f"{_GIVEN} unit")
    named = [_coefficient(key, given, unit) for key, given in coefficients.items()]
    if not named:
        raise ArgumentError(
            f"{_GIVEN}: no coefficient is given", remedy='e.g. {"scale_factor": "0.8884 rad/s/g"}'
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
        scale_factor_nominal=_given_nominal(given, scale_factor_nominal, unit),
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
        return calibration_from_bytes(calibration_to_bytes(made), Path(_GIVEN))
    except (CalibrationError, ValueError) as error:
        raise ArgumentError(str(error).partition("\n")[0], remedy="correct the coefficients") from None


def _coefficient(key: str, given: Given, output: str) -> Coefficient:
    parts = _GIVEN_KEY.fullmatch(key)
    name, segment = parts.groups() if parts else (key, None)
    if not check_name(name):
        raise ArgumentError(
            f"{_GIVEN}: unknown coefficient '{key}'", remedy="e.g. scale_factor, tan_beta, phi, k0"
        )
    if segment is not None and name != "phi":
        raise ArgumentError(
            f"{_GIVEN}: '{key}': only a phase can belong to a segment", remedy=f"name it '{name}'"
        )
    if isinstance(given, Coefficient):
        if given.key != key:
            raise ArgumentError(
                f"{_GIVEN}: '{key}' is the coefficient '{given.key}'", remedy="use its own name"
            )
        return given
    value, std = given if isinstance(given, tuple) else (given, 0.0)
    unit = unit_of(name, output)
    u = _number(std, unit, f"{_GIVEN} u({key})")
    if u < 0.0:
        raise ArgumentError(
            f"{_GIVEN} u({key}): a standard uncertainty is not negative", remedy="give it without sign"
        )
    return Coefficient(name, _number(value, unit, f"{_GIVEN} {key}"), u, unit, segment)


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
            f"{_GIVEN} covariance: shape {matrix.shape}, but there are {size} coefficients: {(size, size)} is needed",
            remedy="one row and one column for each coefficient, in their order",
        )
    variance = np.diag(matrix)
    if not np.isfinite(matrix).all() or (variance < 0.0).any():
        raise ArgumentError(f"{_GIVEN} covariance: a variance is negative or not finite", remedy="correct it")
    wrong = (std > 0.0) & ~np.isclose(np.sqrt(variance), std, rtol=1e-6)
    if wrong.any():
        key = named[int(np.argmax(wrong))].key
        raise ArgumentError(
            f"{_GIVEN} covariance: it contradicts the standard uncertainty of '{key}'",
            remedy="give one of the two",
        )
    return matrix


def _given_nominal(named: list[Coefficient], given: float | str | None, unit: str) -> float:
    estimated = next((c.value_si for c in named if c.name == "scale_factor"), None)
    with numbers_are_si(True):
        nominal = estimated if given is None else scale_factor_in(given, unit, f"{_GIVEN} scale_factor_nominal")
    if nominal is not None:
        if not nominal > 0.0:
            raise ArgumentError(f"{_GIVEN}: the scale factor must be positive", remedy="reverse the input axis")
        return nominal
    raise ArgumentError(
        f"{_GIVEN}: there is no scale factor", remedy="add 'scale_factor' or scale_factor_nominal"
    )


def _chosen(phase_source: str) -> str:
    if phase_source not in PHASE_SOURCES:
        raise ArgumentError(
            f"{_GIVEN} phase_source: '{phase_source}'", remedy=f"one of {', '.join(PHASE_SOURCES)}"
        )
    return phase_source
