"""Run summaries on disk (schema ``piga.run-summary/1``): exact, readable, checked when read."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from piga.calibration.intervals.added_noise import AddedNoise
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.servo_columns import PHASELESS
from piga.calibration.noise.levels import Noise
from piga.errors import CalibrationError
from piga.output import settle
from piga.records.calibration import Event, Outlier, Quality, SegmentSummary
from piga.records.json_file import JsonError, decode_json, schema_of
from piga.records.limits import read_whole
from piga.records.run_file import Draw
from piga.records.terms import check_name

if TYPE_CHECKING:
    from piga.calibration.joint.summary import RunSummary, SourceSummary

SCHEMA = "piga.run-summary/1"
MAX_BYTES = 256 << 20
_PLAIN = (
    "name", "serial", "scale_factor", "kind", "terms", "per_run", "phase", "temperature_reference", "time_reference",
    "inner_scale_factor", "turning", "labels", "stand", "reference_id", "undetermined", "figures", "ranges",
    "input_sha256", "source", "software", "created", "known_servo",
)  # fmt: skip


class _Reduction(msgspec.Struct, frozen=True):
    names: tuple[str, ...]
    weight: list[list[float]]
    unit: list[list[list[float]]]
    count: int


class _Added(msgspec.Struct, frozen=True):
    name: str
    variance: float
    deviation: float
    together: bool
    scores: tuple[list[list[float]], ...]


class _Source(msgspec.Struct, frozen=True):
    name: str
    value: float
    unit: str
    parts: tuple[_Reduction, ...]
    distribution: str = "normal"
    degrees_of_freedom: float | None = None
    known_servo: tuple[tuple[str, float], ...] = ()
    draw: Draw = "reference"
    segments: tuple[tuple[int, _Reduction], ...] = ()
    in_fit: bool = False


class _Summary(msgspec.Struct, frozen=True):
    schema: str
    name: str
    serial: str
    scale_factor: float
    kind: str
    terms: tuple[str, ...]
    per_run: tuple[str, ...]
    phase: str
    temperature_reference: float
    time_reference: float
    inner_scale_factor: float
    turning: bool
    labels: tuple[str | None, ...]
    stand: str | None
    reference_id: str | None
    undetermined: tuple[str, ...]
    figures: dict[str, float]
    ranges: dict[str, list[float]]
    input_sha256: dict[str, str]
    source: str
    software: str
    created: str
    noise: tuple[float, ...]
    parts: tuple[_Reduction, ...]
    sources: tuple[_Source, ...]
    quality: Quality
    segments: tuple[SegmentSummary, ...]
    outliers: tuple[Outlier, ...] = ()
    degrees_of_freedom: float | None = None
    added: tuple[_Added, ...] = ()
    known_servo: tuple[tuple[str, float], ...] = ()


def write_summary(summary: RunSummary, path: Path) -> None:
    """Write a summary as JSON, every float with all its digits."""
    document: dict[str, Any] = {"schema": SCHEMA} | {name: getattr(summary, name) for name in _PLAIN}
    document |= {
        "noise": [summary.noise.white, summary.noise.walk, summary.noise.drift, summary.noise.scatter],
        "parts": [_plain(part) for part in summary.parts],
        "sources": [
            {
                "name": s.name,
                "value": s.value,
                "unit": s.unit,
                "parts": [_plain(part) for part in s.parts],
                "distribution": s.distribution,
                "degrees_of_freedom": _finite(s.degrees_of_freedom),
                "known_servo": s.known_servo,
                "draw": s.draw,
                "segments": [(group, _plain(part)) for group, part in s.segments],
                "in_fit": s.in_fit,
            }
            for s in summary.sources
        ],
        "degrees_of_freedom": _finite(summary.degrees_of_freedom),
        "added": [
            {
                "name": a.name,
                "variance": a.variance,
                "deviation": a.deviation,
                "together": a.together,
                "scores": [part.tolist() for part in a.scores],
            }
            for a in summary.added
        ],
        "quality": msgspec.to_builtins(summary.quality),
        "segments": [msgspec.to_builtins(segment) for segment in summary.segments],
        "outliers": [msgspec.to_builtins(outlier) for outlier in summary.outliers],
    }
    path.write_text(json.dumps(document, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")


def _finite(degrees: float) -> float | None:
    """Degrees of freedom; None where the levels are known."""
    return degrees if math.isfinite(degrees) else None


def _degrees(written: float | None) -> float:
    return math.inf if written is None else written


def _plain(part: Reduction) -> dict[str, Any]:
    return {
        "names": part.names,
        "weight": part.weight.tolist(),
        "unit": part.unit.tolist(),
        "count": part.count,
    }


def read_summary(path: Path) -> RunSummary:
    """Read a summary and check that its parts fit together.

    Raises
    ------
    CalibrationError
        If the file is missing, damaged, or of another schema.
    """
    from piga.calibration.joint.summary import RunSummary

    settle(path.parent)
    found = _decode(path)
    fields = {name: getattr(found, name) for name in _PLAIN}
    return RunSummary(
        **fields,
        noise=_noise(found.noise),
        parts=_reductions(path, found.parts, len(found.labels)),
        sources=tuple(_source(path, s, len(found.labels)) for s in found.sources),
        degrees_of_freedom=_degrees(found.degrees_of_freedom),
        added=tuple(_added(path, noise, found) for noise in found.added),
        quality=Quality(
            found.quality.rows,
            found.quality.used,
            found.quality.masked,
            tuple(Event(e.kind, e.count, e.first_row, e.detail) for e in found.quality.events),
        ),
        segments=found.segments,
        outliers=found.outliers,
    )


def _noise(written: tuple[float, ...]) -> Noise:
    """Levels as written; summaries of older versions lack the last ones."""
    white, walk, drift, scatter = (*written, 0.0, 0.0)[:4]
    return Noise(white, walk, drift, scatter)


def _source(path: Path, s: _Source, groups: int) -> SourceSummary:
    """A source; one that is drawn for each segment has the changed group of each in place of all groups."""
    from piga.calibration.joint.summary import SourceSummary

    parts = _reductions(path, s.parts, 0 if s.draw == "segment" else groups)
    segments = _reductions(path, tuple(part for _, part in s.segments), len(s.segments))
    own = [group for group, _ in s.segments]
    if bool(own) != (s.draw == "segment") or any(not 0 <= group < groups for group in own):
        raise CalibrationError(f"{path}: its sources are damaged", remedy="summarise the run again")
    return SourceSummary(
        s.name, s.value, s.unit, parts, s.distribution, _degrees(s.degrees_of_freedom), s.known_servo, s.draw,
        tuple(zip(own, segments, strict=True)), s.in_fit,
    )  # fmt: skip


def _decode(path: Path) -> _Summary:
    raw = read_whole(path, MAX_BYTES, "a run summary", CalibrationError)
    try:
        kind = schema_of(raw)
        if kind != SCHEMA:
            raise CalibrationError(
                f"{path}: no run summary of schema '{SCHEMA}' (it says: {kind})",
                remedy="name a run file (.toml), or a summary that --summary wrote",
            )
        return decode_json(raw, _Summary)
    except JsonError as error:
        raise CalibrationError(
            f"{path}: not a valid run summary: {error}", remedy="summarise the run again"
        ) from None


def _added(path: Path, noise: _Added, found: _Summary) -> AddedNoise:
    try:
        scores = tuple(np.array(part, dtype=float) for part in noise.scores)
    except ValueError:
        scores = ()
    fits = len(scores) == len(found.parts) and all(
        part.ndim == 2 and len(part) == len(own.names) and part.shape[1] == scores[0].shape[1]
        for part, own in zip(scores, found.parts, strict=True)
    )
    if not fits or not all(np.isfinite(part).all() for part in scores):
        raise CalibrationError(f"{path}: its added noise is damaged", remedy="summarise the run again")
    return AddedNoise(noise.name, noise.variance, noise.deviation, noise.together, scores)


def _reductions(path: Path, parts: tuple[_Reduction, ...], groups: int) -> tuple[Reduction, ...]:
    result = []
    for part in parts:
        size = len(part.names) + 1
        try:
            weight, unit = np.array(part.weight, dtype=float), np.array(part.unit, dtype=float)
        except ValueError:
            weight, unit = np.zeros(0), np.zeros(0)
        fits = weight.shape == (2, size) and unit.shape == (2, size, size)
        known = all(name in ("p", "q", *PHASELESS) or check_name(name) for name in part.names)
        whole = fits and np.isfinite(weight).all() and np.isfinite(unit).all() and (weight[0] >= 0.0).all()
        if not (whole and known) or len(parts) != groups or part.count < 0:
            raise CalibrationError(f"{path}: its summaries are damaged", remedy="summarise the run again")
        result.append(Reduction(part.names, weight, unit, part.count))
    return tuple(result)
