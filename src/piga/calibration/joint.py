"""The fit of one run or of several runs of one instrument, from their summaries: their reduction, request and sources.

Summaries can be added. Therefore the raw data of a run are not needed: its summary is enough.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from piga._version import __version__
from piga.calibration.fit import Fit, fit_run
from piga.calibration.intervals import Interval, find_interval
from piga.calibration.model.design import Design
from piga.calibration.model.identifiability import Examination, refuse_useless
from piga.calibration.model.request import Request, check_per_run, make_request
from piga.calibration.model.solution import Estimate, asked_order
from piga.calibration.sources import SERVO_SOURCE, SourceSummary, listed, sources, stated_scatter, units_of
from piga.calibration.summary import MergedRuns, RunSummary, repetitions, source_column
from piga.calibration.weights import (
    RATE,
    Extra,
    find_residuals,
    reduce_positions,
    residual_figures,
    residual_increments,
    segment_table,
)
from piga.errors import ArgumentError, CalibrationError, IdentifiabilityError
from piga.progress import SILENT, Steps
from piga.records.calibration.coefficient import Coefficient, StandSource, changes
from piga.records.run import Run
from piga.records.terms import SERVO_TERMS, check_terms, harmonic, turns
from piga.results import Array
from piga.terms import LOGGED_TERMS, TERMS, THERMAL_TERMS

STATIC_TERMS = tuple(name for name in TERMS if name not in ("phi", "k1", *LOGGED_TERMS))
"""Columns of a stored summary besides the requested harmonics; with temperature or vibration also their columns."""
BIAS = "k0"
"""Term that each run has of its own unless asked otherwise."""
_LAST_TO_GO = (BIAS, "tan_beta", "scale_factor")
"""Terms that the fit for the noise levels leaves out last."""
_INNER_CHANGE = 1e-6
"""Relative change of K above which the regressors of runs with base rotation are computed again."""
_COMMON_TO_ALL_STANDS = ("gravity",)
"""Sources that belong to the site, not to the stand."""
_WARMED = {"k0_T": "k0", "k1_T": "scale_factor"}
"""Terms of temperature, and the column that each becomes by one kelvin more."""
_WORST = ("waived", "stated", "bounded", "assumed", "unstated")
"""Statuses of a source, the worst last."""


@dataclass(frozen=True)
class JointFit(MergedRuns):
    """The solution of merged runs: those with raw data, estimate with its interval, named coefficients."""

    live: tuple[Fit | None, ...]
    estimate: Estimate
    interval: Interval
    coefficients: tuple[Coefficient, ...]
    covariance: Array
    examination: Examination

    @property
    def degrees(self) -> Array:
        """Degrees of freedom of Type A in the order of the coefficients."""
        phases = len(self.coefficients) - self.layout.size
        return self.interval.degrees[asked_order(self.layout, self.terms, phases)]

    @property
    def only(self) -> Fit | None:
        """The fit of the run, if there is one only, with raw data."""
        return self.live[0] if len(self.live) == 1 else None

    @property
    def by_input(self) -> bool:
        """True if the phase of a run is predicted from the input."""
        return any(live and live.design.request.phase_source != "output" for live in self.live)

    def design_of(self, index: int, live: Fit) -> tuple[Design, Array]:
        """Columns of a run with raw data, and their coefficients in each of its segments."""
        own, summary = live.design, self.summaries[index]
        if own.request.terms != summary.terms or own.scale_factor != summary.inner_scale_factor:
            own = Design(
                live.design.run, replace(live.design.request, terms=summary.terms), summary.inner_scale_factor
            )
        return own, self.values_in_segments(own, self.estimate, index)

    def moved(self, change: Array) -> Array:
        """Change of the coefficients (n,; file units) by a change of the internal parameters."""
        if not change.any():
            return np.zeros(len(self.coefficients))
        at, estimate, layout = self.estimate.amplitudes.size, self.estimate, self.layout
        amplitudes, phases = estimate.amplitudes + change[:at], estimate.phases + change[at:]
        if phases.size == 1:  # exact, by the column coefficients
            linear = layout.linear(estimate.amplitudes, float(estimate.phases[0]), 0)
            linear = linear + estimate.jacobians[0] @ change
            phases = np.arctan2(linear[1:2], linear[:1])
            amplitudes = layout.from_linear(linear, float(phases[0]))
        named, _ = self.named(replace(estimate, amplitudes=amplitudes, phases=phases), estimate.covariance)
        return changes(
            self.coefficients, *(np.array([c.value for c in one]) for one in (self.coefficients, named))
        )

    def without_scatter(self) -> JointFit:
        """The fit with the weights of white noise, random walk and stated scatter only; tests of the model use it."""
        if not any(summary.noise.scatter for summary in self.summaries):
            return self
        quiet = tuple(one.weighted(replace(one.noise, scatter=0.0)) for one in self.summaries)
        fit = replace(self, summaries=quiet)
        examination, estimate = fit.solved()
        named, covariance = fit.named(estimate, estimate.covariance)
        solved = replace(fit, estimate=estimate, examination=examination)
        return replace(solved, coefficients=named, covariance=covariance)


def merge_runs(
    summaries: Sequence[RunSummary],
    terms: tuple[str, ...],
    per_run: tuple[str, ...] = (),
    live: Sequence[Fit | None] = (),
) -> JointFit:
    """Merge summaries that contain the requested columns, and solve.

    ``live`` are the fits of those with raw data.
    """
    runs = MergedRuns.of(summaries, terms, per_run)
    examination, estimate = runs.solved()
    stated = any(summary.noise.stated for summary in summaries)
    interval = find_interval(runs.layout, estimate, runs.repetitions(estimate), stated=stated)
    coefficients, covariance = runs.named(estimate, interval.covariance)
    return JointFit(
        **vars(runs),
        live=tuple(live) or (None,) * len(summaries),
        estimate=estimate,
        interval=interval,
        coefficients=coefficients,
        covariance=covariance,
        examination=examination,
    )


def fit_alone(run: Run, request: Request, steps: Steps) -> JointFit:
    """Fit one run from the triangles of its own fit."""
    fit = fit_run(run, request, stated_scatter(run))
    summary = replace(fit.runs.summaries[0], outliers=fit.outliers)
    steps("finding the intervals")
    return _useful(merge_runs([summary], request.terms, live=[fit]))


def fit_jointly(
    items: Sequence[Run | RunSummary],
    terms: Sequence[str] | None,
    phases: str | None,
    per_run: Sequence[str] | None,
    steps: Steps,
) -> JointFit:
    """Reduce the runs that have raw data, merge all summaries and solve. Each run is reported to ``steps``."""
    names = _names(items)
    _check_one_instrument(items, names)
    asked = [item.terms if isinstance(item, RunSummary) else item.model.terms for item in items]
    if terms is not None:
        asked = [tuple(terms)] * len(items)
    union = tuple(dict.fromkeys(name for own in asked for name in own))
    check_terms(union, where="terms of all runs together", output=items[0].unit)
    free = _own_terms(items, asked) if per_run is None else tuple(per_run)
    check_per_run(free, union)
    live: list[Fit | None] = []
    summaries: list[RunSummary] = []
    for index, (item, name) in enumerate(zip(items, names, strict=True)):
        wanted = tuple(term for term in union if term not in free or term in asked[index])
        if isinstance(item, RunSummary):
            live.append(None)
            summaries.append(replace(item, name=name, terms=wanted))
            continue
        steps.within(index / len(items), f"fitting the model to {name}")
        request = make_request(item, wanted, "information", phases, per_run=())
        fit, undetermined = fit_determined(item, request)
        live.append(fit)
        summaries.append(_summarised(fit, request, wanted, name, undetermined))
    if len({one.temperature_reference for one in summaries}) > 1 and set(THERMAL_TERMS) & set(union):
        raise CalibrationError(
            "the runs have different reference temperatures",
            remedy="write the same [model] temperature_reference in all run files",
        )
    steps("solving all runs together")
    merged = merge_runs(summaries, union, free, live)
    scale_factor, stale = merged.scale_factor_of(merged.estimate), False
    for index, (fit_of_run, summary) in enumerate(zip(live, summaries, strict=True)):
        changed = abs(scale_factor / summary.inner_scale_factor - 1.0) > _INNER_CHANGE
        if fit_of_run and summary.turning and changed:
            request = replace(fit_of_run.design.request, terms=summary.terms)
            again = _summarised(
                fit_of_run, request, summary.terms, summary.name, summary.undetermined, scale_factor
            )
            summaries[index], stale = again, True
    return _useful(merge_runs(summaries, union, free, live) if stale else merged)


def _useful(fit: JointFit) -> JointFit:
    """The fit, if it determines its coefficients well enough to be a result."""
    ranges = fit.ranges
    largest = max(*(abs(v) for v in ranges["a_x"]), ranges["a_t"][1])
    duration = max(max(p.end for p in s.positions) - min(p.begin for p in s.positions) for s in fit.summaries)
    spread = float(np.ptp(ranges["temperature"])) if "temperature" in ranges else 0.0
    refuse_useless(fit.coefficients, largest, duration, spread)
    return fit


def _own_terms(items: Sequence[Run | RunSummary], asked: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    """Terms with a value in each run: those that the run files name. Where none names any, the bias.

    A bias changes from one power-up to the next. Shared, its change would widen the intervals of all other terms. A run of
    one position cannot tell its bias alone; then all runs share it.
    """
    files = [item.per_run if isinstance(item, RunSummary) else item.estimation.per_run for item in items]
    given = [names for names in files if names is not None]
    if given or len(items) == 1:
        return tuple(dict.fromkeys(name for names in given for name in names))
    counts = [len(item.segments if isinstance(item, RunSummary) else item.labels) for item in items]
    with_bias = [count for count, names in zip(counts, asked, strict=True) if BIAS in names]
    return (BIAS,) if with_bias and min(with_bias) > 1 else ()


def run_name(run: Run, index: int) -> str:
    """Stem of the run file; if it is only 'run', the name of its folder; or else a number."""
    if not run.source:
        return f"run {index + 1}"
    path = Path(run.source)
    return (path.resolve().parent.name if path.stem == "run" else path.stem) or path.stem


def _names(items: Sequence[Run | RunSummary]) -> list[str]:
    """A unique name for every run; equal names get a number."""
    names: list[str] = []
    for index, item in enumerate(items):
        plain = item.name if isinstance(item, RunSummary) else run_name(item, index)
        name, number = plain, 2
        while name in names:
            name, number = f"{plain} ({number})", number + 1
        names.append(name)
    return names


def _check_one_instrument(items: Sequence[Run | RunSummary], names: Sequence[str]) -> None:
    first = items[0]
    seen: dict[tuple[str, ...], str] = {}
    for item, name in zip(items, names, strict=True):
        if item.serial != first.serial:
            raise CalibrationError(
                f"run '{names[0]}' is of instrument '{first.serial}', run '{name}' of '{item.serial}'",
                remedy="a joint calibration is for one instrument; correct [instrument] serial if they are the same",
            )
        if item.unit != first.unit:
            raise CalibrationError(
                f"the output of run '{names[0]}' is in {first.unit}, that of run '{name}' in {item.unit}",
                remedy="a joint calibration is for one kind of output; calibrate the runs one by one",
            )
        if abs(item.scale_factor / first.scale_factor - 1.0) > 1e-9:
            raise CalibrationError(
                f"run '{names[0]}' and run '{name}' have different nominal scale factors",
                remedy="write the same [instrument] scale_factor in all run files of an instrument",
            )
        digests = tuple(sorted(d for f, d in item.input_sha256.items() if not f.endswith(".toml")))
        if digests and digests in seen:
            raise CalibrationError(
                f"run '{name}' has the same data as run '{seen[digests]}'",
                remedy="name each run once",
            )
        seen[digests] = name


def fit_determined(run: Run, request: Request) -> tuple[Fit, tuple[str, ...]]:
    """The fit of a run with the terms that it can determine alone, for its weights; and the other terms."""
    undetermined: list[str] = []
    terms, stated = request.terms, stated_scatter(run)
    while True:
        try:
            return fit_run(run, replace(request, terms=terms), stated), tuple(dict.fromkeys(undetermined))
        except IdentifiabilityError as error:
            dropped = _given_up(terms, error.terms)
            undetermined += [*error.terms, *dropped]
            terms = tuple(term for term in terms if term not in dropped) or (BIAS,)


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


def _summarised(
    fit: Fit,
    request: Request,
    columns: tuple[str, ...],
    name: str,
    undetermined: tuple[str, ...],
    scale_factor: float | None = None,
) -> RunSummary:
    """The run of a fit, reduced to the given columns; ``scale_factor`` replaces the K inside the regressors."""
    wide = replace(request, terms=columns, per_run=())
    design = Design(fit.design.run, wide, scale_factor or fit.design.scale_factor)
    rows = reduce_positions(design, fit.noise)
    return replace(
        RunSummary.of_rows(design, fit.noise, rows),
        name=name,
        terms=request.terms,
        per_run=request.per_run,
        undetermined=undetermined,
        outliers=fit.outliers,
        software=f"piga {__version__}",
        created=now(),
    )


def now() -> str:
    """Creation time for results (UTC)."""
    return dt.datetime.now(dt.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def summary_of_all_terms(run: Run, request: Request, name: str) -> RunSummary:
    """The summary of a run with the columns of all terms, and with its sources."""
    fit, undetermined = fit_determined(run, request)
    logged = (term for term, column in LOGGED_TERMS.items() if getattr(run, column) is not None)
    static = (term for term in STATIC_TERMS if not (run.direct and turns(term)))
    columns = (*static, *logged, *(term for term in request.terms if harmonic(term)))
    summary = _summarised(fit, request, columns, name or run_name(run, 0), undetermined)
    residuals = find_residuals(fit.design, fit.values, fit.noise)
    figures = residual_figures(residuals)
    summary = replace(summary, segments=segment_table(fit.design, residuals), figures=figures)
    design = Design(fit.design.run, replace(request, terms=columns, per_run=()), fit.design.scale_factor)
    return with_sources(summary, design, fit.design, fit.values)


def with_sources(
    summary: RunSummary,
    design: Design,
    fitted: Design,
    values: Array,
    *,
    units: bool = False,
    steps: Steps = SILENT,
) -> RunSummary:
    """The summary of a record with a column for each source of Type B; ``units``: also for one unit of those not stated.

    ``design`` has the columns of the summary, those of the servo without a phase. ``fitted`` is a model of the record, and
    ``values`` (segments, m) are its column coefficients. Of a long record the means of neighbouring samples are moved.
    """
    run = design.means.run
    stated, weighed = list(sources(run)), bool(summary.noise.stated)
    moving = [*stated, *(units_of(run) if units else ())]
    plain = Design(run, fitted.request, fitted.scale_factor)
    known, changes = residual_increments(plain, values)[0], []
    for source in moving:
        steps.part(f"adding up the budget: {source.summary.name}")
        change = residual_increments(plain.of(source.moved), values)[0]
        change -= known
        changes.append(change)
    names = tuple(source_column(number) for number in range(len(changes)))
    extra = Extra(names, lambda block: np.array([change[block.start : block.stop] for change in changes]))
    parts = reduce_positions(design, summary.noise, extra=extra if changes else None)
    held = (
        replace(one.summary, stated=number < len(stated), in_fit=one.summary.draw == "segment" and weighed)
        for number, one in enumerate(moving)
    )
    return replace(
        summary,
        positions=repetitions(design, summary.noise, parts),
        sources=tuple(held),
        stand_sources=listed(design.run),
    )


def with_all_sources(fit: JointFit, steps: Steps = SILENT) -> JointFit:
    """The fit with the sources of Type B of its runs with raw data; the others have those that are stated."""
    summaries = list(fit.summaries)
    for index, live in enumerate(fit.live):
        if live:
            design, values = fit.design_of(index, live)
            summaries[index] = with_sources(summaries[index], design, design, values, units=True, steps=steps)
    return replace(fit, summaries=tuple(summaries))


def joint_sources(
    summaries: Sequence[RunSummary], *, stated: bool = True
) -> Iterator[tuple[SourceSummary, dict[int, int]]]:
    """Sources of all runs, each with its number in every run that it moves. A source that runs share moves all of them at once.

    Runs share a source if it has the same name and value, on the same kind of stand, with the same
    ``reference_id`` (or none in both). ``gravity`` is shared on any stand. A servo parameter belongs to the
    instrument and is shared in any case. A source with a new value in each run or each segment is not shared.
    """
    moved: dict[tuple[str, str | None, str | None, float, int], dict[int, int]] = {}
    for index, summary in enumerate(summaries):
        for number, source in enumerate(summary.sources):
            if source.stated != stated:
                continue
            of_servo = source.name.startswith(SERVO_SOURCE)
            of_site = source.name in _COMMON_TO_ALL_STANDS or of_servo
            own = -1 if source.draw == "reference" else index
            device = None if of_servo else summary.reference_id
            key = (source.name, None if of_site else summary.stand, device, source.value, own)
            moved.setdefault(key, {})[index] = number
    for numbers in moved.values():
        (first, number), *_ = numbers.items()
        source, names = summaries[first].sources[number], ", ".join(summaries[index].name for index in numbers)
        yield (replace(source, name=f"{source.name} ({names})") if names else source), numbers


def effects(fit: JointFit, *, stated: bool) -> Iterator[tuple[SourceSummary, Array]]:
    """Changes of the coefficients (draws, n; file units) by each source, linear in the observations (JCGM 100, 5.1).

    By one standard uncertainty of those that are stated, or by one unit of the others. A stated source with a new value in each
    segment moves one segment at a time.
    """
    inverse, scores = fit.estimate.inverse, [_scores(fit, index) for index in range(len(fit.summaries))]
    for source, numbers in joint_sources(fit.summaries, stated=stated):
        own = [scores[index][:, :, number] for index, number in numbers.items()]
        (first, *_) = numbers
        each = stated and source.draw == "segment" and not fit.summaries[first].positions[0].block
        draws = own[0] if each else [np.sum([one.sum(axis=0) for one in own], axis=0)]
        moved = np.array([fit.moved(inverse @ draw) for draw in draws])
        if moved.any() or not source.name.startswith(SERVO_SOURCE):
            yield source, moved


def _scores(fit: JointFit, index: int) -> Array:
    """Products of the columns of the parameters and of each source of a run: (positions, parameters, sources)."""
    summary, wanted = fit.summaries[index], fit.wanted(index)
    names = tuple(source_column(number) for number in range(len(summary.sources)))
    # the fit that made a stored summary may lack the terms of temperature: its source moves those of this fit
    stored = not fit.live[index] and set(_WARMED) & set(wanted)
    warm = [number for number, source in enumerate(summary.sources) if stored and source.name == "temperature"]
    beside = tuple(dict.fromkeys(_WARMED.values())) if warm else ()
    values, m, result = fit.values_of(fit.estimate, index), len(wanted), []
    for position in fit.positions(index, fit.estimate, (RATE, *names, *beside)):
        rows = position.part.without((RATE,), position.variance).factor
        columns, others = rows[:, m : m + len(names)], rows[:, m + len(names) : -1]
        own = dict(zip(wanted, values[position.group - fit.first_group(index)], strict=True))
        for number in warm:
            products = [own.get(term, 0.0) * others[:, beside.index(base)] for term, base in _WARMED.items()]
            columns[:, number] = -summary.sources[number].value * np.sum(products, axis=0)
        result.append(fit.estimate.jacobians[position.group].T @ rows[:, :m].T @ columns)
    return np.array(result)


def sources_of_stand(fit: JointFit, more: Sequence[StandSource] = ()) -> tuple[StandSource, ...]:
    """The sources of the stands of all runs by name, and ``more``, with what one unit of those not stated does.

    A source has the worst status that a run gives it. The summary of a run without its raw data has no effects.
    """
    merged: dict[str, StandSource] = {}
    for source in (one for summary in fit.summaries for one in summary.stand_sources):
        first = merged.get(source.name, source)
        merged[source.name] = max(first, source, key=lambda one: _WORST.index(one.status))
    keys = [c.key for c in fit.coefficients]
    effects_of = {
        source.name: {key: float(part) for key, part in zip(keys, change[0], strict=True) if part}
        for source, change in effects(fit, stated=False)
    }
    return tuple(
        replace(source, effects={n: own for n, own in effects_of.items() if n.startswith(source.name)})
        if source.status == "unstated"
        else source
        for source in (*merged.values(), *more)
    )


def check_items(items: object) -> list[Run | RunSummary]:
    """The runs given to a calibration, as a list; refused if there are none, or an item is neither a run nor a summary."""
    given = list(items) if isinstance(items, (list, tuple)) else [items]
    runs = [item for item in given if isinstance(item, (Run, RunSummary))]
    if not runs or len(runs) < len(given):
        raise ArgumentError(
            "calibrate: a run, or a list of runs and run summaries, is needed",
            remedy="pass a Run, or a list of Run and RunSummary",
        )
    return runs
