"""Summary of a run in fixed size: its reduction, which can be merged with other runs without the raw data.

On disk a summary has the schema ``piga.run-summary/2``: exact, readable, checked when read.
"""

from __future__ import annotations

import datetime as dt
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from piga._version import __version__
from piga.calibration.fit import Fit, fit_run
from piga.calibration.merged import RunTriangles, SourceSummary, repetitions, source_column
from piga.calibration.model.design import PHASELESS, Design, given_servo
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.request import Request, make_request
from piga.calibration.residuals import find_residuals, root_mean_square, segment_table
from piga.calibration.sources import Source, listed, sources
from piga.calibration.uncertainty import stated_scatter, units_of
from piga.calibration.weights import RATE, Extra, Noise, reduce_positions, residual_increments
from piga.errors import ArgumentError, CalibrationError, IdentifiabilityError
from piga.output import check_results
from piga.progress import SILENT, Steps
from piga.records.arrays import largest_size
from piga.records.calibration.calibration import Provenance
from piga.records.calibration.coefficient import Level, Number, StandSource
from piga.records.calibration.diagnostics import Outlier, Quality, Residuals, SegmentSummary
from piga.records.run import Run
from piga.records.terms import SERVO_TERMS, check_name, harmonic, turns
from piga.results import Array, Result
from piga.terms import LOGGED_TERMS, TERMS
from piga.text_files import JsonError, converted, json_object, read_whole
from piga.threads import one_thread

STATIC_TERMS = tuple(name for name in TERMS if name not in ("phi", "k1", *LOGGED_TERMS))
"""Columns of a stored summary besides the requested harmonics; with temperature or vibration also their columns."""
SCHEMA = "piga.run-summary/2"
MOST_SUMMARY_BYTES = 256 << 20
_LAST_TO_GO = ("k0", "tan_beta", "scale_factor")
"""Terms that the fit for the noise levels leaves out last."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class RunSummary(RunTriangles, Result):
    """Data of one run for a joint calibration.

    Attributes
    ----------
    serial, kind:
        Serial number of the instrument; kind of the output.
    terms, per_run, phases:
        As requested in its run file.
    turning:
        True if the regressors depend on K (a base rotation is recorded).
    stand, reference_id:
        Kind of the stand and name of the reference. Runs that agree in both share the errors of the reference.
    undetermined:
        Terms that this run alone cannot determine.
    stand_sources:
        Sources that exist on its stand, and whether they are stated.
    quality, segments, figures:
        As in a calibration of this run alone.
    """

    serial: str
    kind: str
    terms: tuple[str, ...]
    per_run: tuple[str, ...] | None
    phases: str
    temperature_reference: Level
    time_reference: Number
    turning: bool
    stand: str | None
    reference_id: str | None
    undetermined: tuple[str, ...]
    quality: Quality
    segments: tuple[SegmentSummary, ...]
    figures: dict[str, Level]
    input_sha256: dict[str, str] = field(default_factory=dict)
    source: str = ""
    software: str = ""
    created: str = ""
    outliers: tuple[Outlier, ...] = ()
    stand_sources: tuple[StandSource, ...] = ()

    @classmethod
    @one_thread()
    def of(
        cls, run: Run, terms: str | list[str] | tuple[str, ...] | None = None, *, name: str = ""
    ) -> RunSummary:
        """Reduce a run to a summary that contains the columns of all terms.

        Parameters
        ----------
        run:
            The record.
        terms:
            Terms of the fit for the noise levels; default: those of the run file.
        name:
            Name of the run; default: the stem of its run file.

        Raises
        ------
        CalibrationError, ArgumentError
            If the request does not fit the record.
        """
        live = prepare(run, make_request(run, terms, "information"), name or run_name(run, 0))
        fit, columns = live.fit, _all_columns(run, live.request)
        design = Design(live.run, replace(live.request, terms=columns, per_run=()), fit.design.scale_factor)
        return with_sources(summarise(live, columns), design, fit.design, fit.values, fit.mode)

    def to_json(self, path: str | Path) -> None:
        """Write the summary (schema ``piga.run-summary/2``): exact.

        Infinite degrees of freedom of a source are null.
        """
        document = {"schema": SCHEMA} | msgspec.to_builtins(self, enc_hook=_plain)
        document["phase"] = document.pop("phases")
        for part in document["sources"]:
            if math.isinf(part["degrees_of_freedom"]):
                part["degrees_of_freedom"] = None
        Path(path).write_text(
            json.dumps(document, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8"
        )

    @staticmethod
    def from_json(path: str | Path) -> RunSummary:
        """Read a summary.

        Raises
        ------
        CalibrationError
            If the file is missing, damaged, or no summary of a known schema; also if its parts do not fit together.
        """
        path = Path(path)
        check_results(path.parent)
        raw = read_whole(path, MOST_SUMMARY_BYTES, "a run summary", CalibrationError)
        try:
            document = json_object(raw)
            kind = document.get("schema")
            if kind != SCHEMA:
                raise CalibrationError(
                    f"{path}: no run summary of schema '{SCHEMA}' (it says: {kind})",
                    remedy="name a run file (.toml), or a summary that --summary wrote",
                )
            _restore(document)
            summary = converted(document, RunSummary, _array)
        except (JsonError, msgspec.ValidationError) as error:
            raise CalibrationError(
                f"{path}: not a valid run summary: {error}", remedy="summarise the run again"
            ) from None
        damaged = next(_damages(summary), None)
        if damaged is not None:
            raise CalibrationError(f"{path}: its {damaged} damaged", remedy="summarise the run again")
        return summary

    def without_scatter(self) -> RunSummary:
        """The summary with the weights of white noise, random walk and stated scatter only."""
        return self.weighted(replace(self.noise, scatter=0.0))


@dataclass(frozen=True)
class LiveRun:
    """A run with raw data: its name, request, and the fit of its noise levels."""

    name: str
    request: Request
    fit: Fit
    undetermined: tuple[str, ...]

    @property
    def run(self) -> Run:
        """The record as used."""
        return self.fit.design.run

    def without_scatter(self) -> LiveRun:
        """The run with the weights of white noise, random walk and stated scatter only."""
        return replace(self, fit=replace(self.fit, noise=replace(self.fit.noise, scatter=0.0)))


def run_name(run: Run, index: int) -> str:
    """Stem of the run file; if it is only 'run', the name of its folder; or else a number."""
    if not run.source:
        return f"run {index + 1}"
    path = Path(run.source)
    return (path.resolve().parent.name if path.stem == "run" else path.stem) or path.stem


def prepare(run: Run, request: Request, name: str) -> LiveRun:
    """Find the weights of a run by its own fit. Terms that the run alone cannot determine are left out of the fit."""
    undetermined: list[str] = []
    terms, stated = request.terms, stated_scatter(run)
    while True:
        try:
            fit = fit_run(run, replace(request, terms=terms), stated)
        except IdentifiabilityError as error:
            dropped = _given_up(terms, error.terms)
            undetermined += [*dict.fromkeys((*error.terms, *dropped))]
            terms = tuple(term for term in terms if term not in dropped) or ("k0",)
            continue
        return LiveRun(name, request, fit, tuple(dict.fromkeys(undetermined)))


def _given_up(terms: tuple[str, ...], confounded: tuple[str, ...]) -> tuple[str, ...]:
    """Terms to leave out of a fit that cannot separate these terms: one of them, with its partner."""
    if not confounded or len(terms) == 1:
        raise ArgumentError("the run determines no coefficient", remedy="check its reference and its output")
    order = {term: _LAST_TO_GO.index(term) + 1 if term in _LAST_TO_GO else 0 for term in confounded}
    chosen = min(reversed(confounded), key=order.__getitem__)
    wave = harmonic(chosen)
    if wave:
        return tuple(f"{kind}{wave[1]}" for kind in ("s", "c"))
    if chosen == "tan_beta":
        return (chosen, *(term for term in terms if harmonic(term) or term in SERVO_TERMS))
    return (chosen,)


def _all_columns(run: Run, request: Request) -> tuple[str, ...]:
    """Terms with columns in a stored summary."""
    logged = (name for name, column in LOGGED_TERMS.items() if getattr(run, column) is not None)
    static = (name for name in STATIC_TERMS if not (run.direct and turns(name)))
    return (*static, *logged, *(term for term in request.terms if harmonic(term)))


def bare_summary(
    name: str,
    request: Request,
    design: Design,
    noise: Noise,
    rows: Sequence[Reduction],
    undetermined: tuple[str, ...] = (),
) -> RunSummary:
    """Triangles of the positions of a run, with what is needed to solve them: no sources, no residuals."""
    run = design.run
    return RunSummary(
        **vars(RunTriangles.of_rows(name, design, noise, rows)),
        serial=run.serial,
        kind=run.kind,
        terms=request.terms,
        per_run=request.per_run,
        phases=request.phases,
        temperature_reference=request.temperature_reference,
        time_reference=design.time_reference,
        turning=run.base_rate is not None,
        stand=None if run.stand is None else str(run.stand.get("kind")),
        reference_id=run.uncertainty.reference_id,
        undetermined=undetermined,
        quality=run.quality,
        segments=(),
        figures={},
        input_sha256=dict(run.input_sha256),
        source=run.source,
    )


def own_summary(live: LiveRun) -> RunSummary:
    """The triangles of the run's own fit."""
    fit = live.fit
    rows = [position.part for position in fit.triangles.positions]
    summary = bare_summary(live.name, live.request, fit.design.with_servo(None), fit.noise, rows)
    return replace(summary, outliers=fit.outliers)


def summarise(live: LiveRun, columns: tuple[str, ...], scale_factor: float | None = None) -> RunSummary:
    """Reduce a prepared run to the given columns; ``scale_factor`` replaces the K inside the regressors."""
    run, fit = live.run, live.fit
    wish = replace(live.request, terms=columns, per_run=())
    design = Design(run, wish, scale_factor or fit.design.scale_factor)
    rows = reduce_positions(design, fit.mode, fit.noise)
    summary = bare_summary(live.name, live.request, design, fit.noise, rows, live.undetermined)
    return replace(summary, **_described(fit))


def with_sources(
    summary: RunSummary,
    design: Design,
    fitted: Design,
    values: Array,
    mode: str,
    *,
    units: bool = False,
    steps: Steps = SILENT,
) -> RunSummary:
    """The summary of a record with a column for each source of Type B.

    Of a long record the means of neighbouring samples are moved.

    Parameters
    ----------
    summary, design, mode:
        The summary, its columns (those of the servo without a phase), and the mode of the weights.
    fitted, values:
        A model of the record, and its column coefficients (segments, m).
    units:
        With one unit of each source that nobody stated.
    steps:
        Hears of each source.
    """
    run, given = design.means.run, list(sources(design.means.run))
    unstated = units_of(run) if units else []
    plain = Design(run, fitted.request, fitted.scale_factor, fitted.servo)
    known, changes = residual_increments(plain, values)[0], []
    for source in (*given, *unstated):
        steps.part(f"adding up the budget: {source.name}")
        change = residual_increments(plain.of(source.moved), values)[0]
        change -= known
        changes.append(change)
    names = tuple(source_column(number) for number in range(len(changes)))
    extra = Extra(names, lambda block: np.array([change[block.start : block.stop] for change in changes]))
    parts = reduce_positions(design, mode, summary.noise, extra=extra if changes else None)
    moved_by = [_source_summary(source, design.run, summary.noise) for source in given]
    moved_by += [replace(_source_summary(one, design.run, summary.noise), stated=False) for one in unstated]
    positions = repetitions(design, summary.noise, parts)
    return replace(summary, positions=positions, sources=tuple(moved_by), stand_sources=listed(design.run))


def _source_summary(source: Source, run: Run, noise: Noise) -> SourceSummary:
    servo = given_servo(replace(run, servo=source.fields["servo"])) if "servo" in source.fields else {}
    return SourceSummary(
        source.name,
        source.value,
        source.unit,
        source.distribution,
        source.degrees_of_freedom,
        tuple(servo.items()),
        source.draw,
        in_fit=source.draw == "segment" and bool(noise.stated),
    )


def _described(fit: Fit) -> dict[str, Any]:
    """Segments and figures of a run from its own fit."""
    residuals = find_residuals(fit.design, fit.values, fit.noise, fit.mode)
    return {
        "segments": segment_table(fit.design, residuals),
        "figures": residual_figures(residuals),
        "outliers": fit.outliers,
        "software": f"piga {__version__}",
        "created": now(),
    }


def residual_figures(residuals: Residuals) -> dict[str, Any]:
    """Root mean square and largest residual before and after (the units of the residuals)."""
    return {
        "residual_rms": root_mean_square(residuals.after),
        "residual_rms_before": root_mean_square(residuals.before),
        "residual_max_before": largest_size(residuals.before),
        "residual_max_after": largest_size(residuals.after),
    }


def provenance(inputs: dict[str, str], options: dict[str, Any]) -> Provenance:
    """Where a result comes from: hashes of its inputs, this version, the time (UTC), and options."""
    return Provenance(inputs, f"piga {__version__}", now(), options)


def now() -> str:
    """Creation time for results (UTC)."""
    return dt.datetime.now(dt.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _plain(value: Any) -> Any:
    """An array or a NumPy number as plain values."""
    return value.tolist()


def _array(_kind: type, value: Any) -> Array:
    """An array from nested lists of numbers; an empty one from anything else."""
    try:
        numbers = np.array(value)
    except ValueError:
        return np.zeros(0)
    return numbers.astype(np.float64) if numbers.dtype.kind in "fi" else np.zeros(0)


def _restore(document: dict[str, Any]) -> None:
    """Infinite degrees of freedom, and the name of a key. In place."""
    sources = document.get("sources")
    if "phase" in document:
        document["phases"] = document.pop("phase")
    for part in sources if isinstance(sources, list) else ():
        if isinstance(part, dict) and part.get("degrees_of_freedom", 0.0) is None:
            del part["degrees_of_freedom"]


def _damages(summary: RunSummary) -> Iterator[str]:
    """Contradictions between parts of a summary."""
    groups = len(summary.labels)
    parts = tuple(position.part for position in summary.positions)
    held = {position.group for position in summary.positions}
    if not _whole(parts) or held != set(range(groups)):
        yield "summaries are"
    columns = {name for part in parts for name in part.names}
    if not {source_column(number) for number in range(len(summary.sources))} <= columns:
        yield "sources are"


def _whole(parts: tuple[Reduction, ...]) -> bool:
    """True if all reductions have known columns, and finite factors of the right size."""
    for part in parts:
        size = len(part.names) + 1
        fits = part.factor.shape == (size, size) and part.count >= 0
        known = all(
            name in ("p", "q", RATE, *PHASELESS) or name.startswith("source ") or check_name(name)
            for name in part.names
        )
        finite = np.isfinite(part.factor).all() and not np.tril(part.factor, -1).any()
        if not (fits and known and finite):
            return False
    return True
