"""``calibration.json``: the calibration record on disk (schema ``piga.calibration/1``)."""

from __future__ import annotations

import datetime as dt
import hashlib
import json
import math
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import MISSING, asdict, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import msgspec
import numpy as np

from piga.errors import CalibrationError, PigaError, UnitError, Where
from piga.output import check_results
from piga.records.calibration.calibration import At, Calibration
from piga.records.calibration.coefficient import BudgetEntry, Coefficient
from piga.records.run_file import Method, Phases, PhaseSource
from piga.records.terms import GYRO, check_name, integral_unit, si_factor, turns, unit_of
from piga.results import finite
from piga.text_files import JsonError, check_label, converted, json_object, read_whole
from piga.units import conversion_factor, parse_unit

SCHEMA = "piga.calibration/1"
MOST_BYTES = 256 << 20
"""Largest file [bytes]."""
ROUNDING = 1e-9
"""Largest rounding error of a correlation (own choice). The smallest eigenvalue may be this, times the matrix size, below zero."""
_SAME = 1e-6
"""Largest relative difference between a standard uncertainty and the square root of its variance (own choice)."""
_MOST_OUTLIERS = 10_000
"""Most outliers that are listed one by one. The events of the quality section count all of them."""


class _Covariance(msgspec.Struct, frozen=True):
    names: tuple[str, ...]
    matrix: tuple[tuple[Annotated[float, msgspec.Meta(ge=-1e200, le=1e200)], ...], ...]


def _document_type() -> tuple[dict[str, At], Any]:
    """The place of each field of a calibration in the file, in order; and the type of the file."""
    kinds = get_type_hints(Calibration, include_extras=True)
    notes = {name: getattr(kind, "__metadata__", ()) for name, kind in kinds.items()}
    kinds |= {
        "covariance": _Covariance,
        "budget": tuple[BudgetEntry, ...],
        "condition": kinds["condition"] | None,
    }
    kinds |= {
        "phases": Phases,
        "phase_source": PhaseSource,
        "method": Method | Literal["published", "recursive", "revolutions"],
    }
    places, sections = {}, defaultdict[str, list[Any]](list)
    for field in fields(Calibration):
        section, key, unit = next((note for note in notes[field.name] if isinstance(note, At)), At())
        if section is None:
            continue
        places[field.name] = At(section, key or field.name, unit)
        kind = kinds[field.name]
        kind = msgspec.defstruct("Stated", [("value", kind), ("unit", str)]) if unit else kind
        required = field.default is MISSING and field.default_factory is MISSING
        entry = (kind,) if required else (kind | msgspec.UnsetType, msgspec.UNSET)
        sections[section].append((key or field.name, *entry))
    top = sections.pop("")
    top += [(name, msgspec.defstruct(name, entries, kw_only=True)) for name, entries in sections.items()]
    return places, msgspec.defstruct("_Document", top, kw_only=True)


_PLACES, _DOCUMENT = _document_type()


def _units(unit: str, residual: str = "") -> dict[str, str]:
    """Unit of each quantity in the file, by field, for an output rate in ``unit`` and residuals in ``residual``."""
    names = {"output": unit, "count": integral_unit(unit), "residual": residual}
    return {field: place.unit.format(**names) for field, place in _PLACES.items() if place.unit}


def to_document(calibration: Calibration) -> dict[str, Any]:
    """The record as plain JSON values (file units).

    The verdict is for people who read the file. piga does not read it back: it computes the verdict again from the record.
    """
    c, units = calibration, _units(calibration.unit, calibration.residual_unit)
    values = {field: getattr(c, field) for field in _PLACES}
    values["scale_factor_nominal"] /= si_factor("scale_factor")
    values |= {
        "condition": finite(c.condition),
        "coefficients": [_stated(k) for k in c.coefficients],
        "covariance": {"names": list(c), "matrix": c.covariance.tolist()},
        "diagnostics": {k: v for k, v in asdict(c.diagnostics).items() if v not in (None, {}, ())},
        "budget": c.budget.entries,
        "outliers": c.outliers[:_MOST_OUTLIERS],
    }
    left_out = {name for name in ("runs", "outliers") if not values[name]}
    left_out |= {"phases", "phase_source"} if c.direct else set()  # nothing turns
    document: dict[str, Any] = {"schema": SCHEMA}
    for field, (section, key, _) in _PLACES.items():
        if field not in left_out:
            place = document.setdefault(section, {}) if section else document
            place[key] = {"value": values[field], "unit": units[field]} if field in units else values[field]
        if field == "remarks":
            document["verdict"] = c.verdict.document()
    plain: dict[str, Any] = msgspec.to_builtins(document, enc_hook=float)
    for segment in plain["segments"] if c.direct else ():
        segment.pop("turns", None)
    for run in plain.get("runs", ()):
        for key in list(run):  # in order
            run["phase" if key == "phases" else key] = run.pop(key)
    return plain


def _stated(c: Coefficient) -> dict[str, Any]:
    """A coefficient. ``expanded`` is the half-width for 95 %; infinite degrees of freedom are null."""
    stated: dict[str, Any] = {"name": c.name, "value": c.value, "std": c.std, "unit": c.unit}
    stated |= {"segment": c.segment} if c.name == "phi" or c.segment is not None else {}
    stated |= {} if c.run is None else {"run": c.run}
    stated["degrees_of_freedom"] = finite(c.degrees_of_freedom)
    if c.interval is not None:
        return stated | {"expanded": c.expanded, "interval": list(c.interval)}
    return stated | {"coverage_factor": c.coverage_factor, "expanded": c.expanded}


def calibration_to_bytes(calibration: Calibration) -> bytes:
    """The bytes of ``calibration.json``: UTF-8, indented, every float with all its digits."""
    text = json.dumps(to_document(calibration), indent=1, ensure_ascii=False, allow_nan=False)
    return f"{text}\n".encode()


def read_with_digest(path: Path) -> tuple[Calibration, str]:
    """Read a record, and the SHA-256 of its bytes. Compensation, certificates and the store all read through this check."""
    check_results(path.parent)
    raw = read_whole(path, MOST_BYTES, "a calibration.json", CalibrationError)
    return calibration_from_bytes(raw, path), hashlib.sha256(raw).hexdigest()


def calibration_from_bytes(raw: bytes, path: Path) -> Calibration:
    """Read a record from the bytes of its file; ``path`` names it in messages."""
    try:
        plain = json_object(raw)
        schema = str(plain.get("schema"))
        if schema == SCHEMA:
            _upgrade(plain)
            return _calibration(converted(plain, _DOCUMENT))
        message = f"is not a calibration record (it lacks the schema '{SCHEMA}')"
        remedy = "name a calibration.json"
        if schema.startswith("piga.calibration/"):
            message, remedy = (
                f"schema '{schema}' is not known to this version",
                "update piga, or calibrate again",
            )
        elif schema.startswith("piga.set-calibration/"):
            message = "is the set-calibration.json of a set of accelerometers, not the calibration of one"
            remedy = "its report.html has the results; for this command calibrate each instrument by itself"
    except (JsonError, msgspec.ValidationError, UnitError) as error:
        why = error.message if isinstance(error, UnitError) else str(error)
        message, remedy = f"not a valid calibration record: {why}", "calibrate again"
    except PigaError as error:
        message, remedy = error.message, error.remedy
    raise CalibrationError(f"{path}: {message}", remedy=remedy, where=Where(path))


def _upgrade(document: dict[str, Any]) -> None:
    """Bring what a file says otherwise than :class:`Calibration`, today or in an earlier version, to its form."""

    def tables(key: str) -> list[dict[str, Any]]:
        entries = document.get(key)
        return [entry for entry in entries if isinstance(entry, dict)] if isinstance(entries, list) else []

    if document.get("surplus_observations") is None and "degrees_of_freedom" in document:  # 0.1
        document["surplus_observations"] = document["degrees_of_freedom"]
    origin = document.get("provenance")
    if isinstance(origin, dict) and isinstance(origin.get("input_sha256"), str):  # 0.1: one input
        origin["input_sha256"] = {"input": origin["input_sha256"]}
    for run in tables("runs"):
        if "phase" in run:
            run["phases"] = run.pop("phase")
    for coefficient in tables("coefficients"):
        if coefficient.get("degrees_of_freedom") is None:  # infinite
            coefficient.pop("degrees_of_freedom", None)


def _calibration(document: Any) -> Calibration:
    """The record of a document, after its checks. An output whose unit is an angle is that of a gyro accelerometer."""
    output = document.instrument.scale_factor_nominal.unit.rpartition("/")[0]
    is_angle = not output or parse_unit(output).dimension == parse_unit(GYRO).dimension
    unit = GYRO if is_angle else output
    likes, stated = _units(unit), {}
    for field, (section, key, _) in _PLACES.items():
        value = getattr(getattr(document, section) if section else document, key)
        if value is not msgspec.UNSET:
            stated[field] = value
    values = {field: value.value if field in likes else value for field, value in stated.items()}
    values["condition"] = math.inf if values["condition"] is None else values["condition"]
    values["scale_factor_nominal"] *= si_factor("scale_factor")
    calibration = Calibration(**values | {"covariance": np.empty((0, 0))}, unit=unit)
    wrong = next(_faults(calibration, document.covariance), None)
    if wrong is not None:
        raise CalibrationError(wrong, remedy="get the file from its author, or calibrate again")
    scaled = {
        field: values[field] * conversion_factor(stated[field].unit, like)
        for field, like in likes.items()
        if like and field in values and stated[field].unit != like
    }
    return replace(calibration, covariance=np.array(document.covariance.matrix, dtype=float), **scaled)


def _faults(c: Calibration, covariance: _Covariance) -> Iterator[str]:
    if c.serial:
        check_label(c.serial, "the serial")
    for k in c.coefficients:
        yield from _faults_of(k, c)
    if not c.scale_factor_nominal > 0.0:
        yield "scale_factor_nominal is not positive"
    yield from (f"the coefficient '{key}' occurs twice" for key, n in Counter(list(c)).items() if n > 1)
    estimated = {k.name for k in c.coefficients} - {"phi"}
    if not c.terms or sorted(c.terms) != sorted(estimated):
        yield f"the terms ({', '.join(c.terms)[:80]}) are not those of the coefficients"
    for row in c.budget:
        for key in row.contributions:
            if not check_name(key.partition("[")[0]):
                yield f"uncertainty_budget: '{row.source[:60]}' acts on '{key[:60]}', which is not a coefficient"
    try:
        dt.datetime.fromisoformat(c.provenance.created)
    except ValueError:
        yield f"provenance.created: '{c.provenance.created[:40]}' is not a time"
    yield from _faults_of_covariance(covariance, c)


def _faults_of(k: Coefficient, c: Calibration) -> Iterator[str]:
    if not check_name(k.name):
        yield f"unknown coefficient '{k.name[:60]}': a later version may know it"
    elif k.unit != unit_of(k.name, c.unit):
        yield f"coefficient '{k.name}' in '{k.unit[:60]}', '{unit_of(k.name, c.unit)}' is needed"
    elif c.direct and turns(k.name):
        yield f"'{k.name}' belongs to a gyro accelerometer, and the output is in '{c.unit}'"
    elif k.name == "scale_factor" and not k.value > 0.0:
        yield f"scale_factor is {k.value:g}, it must be positive"
    elif k.name == "tan_beta" and k.value < 0.0:
        yield f"tan_beta is {k.value:g}, it must not be negative: its sign is in phi"
    if k.interval is not None and not k.interval[0] <= k.interval[1]:
        yield f"the ends of the interval of '{k.key}' are interchanged"
    if not math.isfinite(k.expanded):
        yield f"degrees_of_freedom of '{k.key}' are {k.degrees_of_freedom:g}: too few for an interval"
    if k.segment is not None and (k.name != "phi" or c.phases == "shared"):
        yield f"'{k.key}': only a phase can belong to a segment, and not if the phase is 'shared'"
    if k.run is not None and (k.name in ("scale_factor", "tan_beta") or k.run not in [r.name for r in c.runs]):
        yield f"'{k.key}': there is no run '{k.run}', or the coefficient belongs to the instrument"


def _faults_of_covariance(stated: _Covariance, c: Calibration) -> Iterator[str]:
    """Faults of the covariance. It must be symmetric and positive semi-definite (to ``ROUNDING`` of the correlations).

    The published recursion of piga 0.1 left its covariance asymmetric by rounding: there the asymmetry is compared with the
    largest element.
    """
    size = len(c)
    if stated.names != tuple(c) or [len(row) for row in stated.matrix] != [size] * size:
        yield "the covariance is not a square matrix of the coefficients in their order"
    matrix = np.array(stated.matrix, dtype=float).reshape(size, size)
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    for k, std in zip(c.coefficients, scale.tolist(), strict=True):
        if abs(std - k.std) > _SAME * max(k.std, std):
            yield f"the standard uncertainty of '{k.key}' is {k.std:.6g}, but the covariance gives {std:.6g}"
    scale[scale == 0.0] = 1.0
    correlation = matrix / scale / scale[:, None]
    compared = matrix if c.method == "published" else correlation
    if np.abs(compared - compared.T).max() > ROUNDING * np.abs(compared).max():
        yield "the covariance is not symmetric"
    try:
        np.linalg.cholesky(0.5 * (correlation + correlation.T) + size * ROUNDING * np.eye(size))
    except np.linalg.LinAlgError:
        yield "the covariance is not positive semi-definite"
