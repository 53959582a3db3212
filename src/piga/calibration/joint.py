"""The fit of one run or of several runs of one instrument, from their summaries.

Coefficients belong to the instrument, except phases (each power-up has its own zero of the output angle) and
the terms named in ``per_run``. Every run is weighted by its own noise levels. Summaries can be added. Therefore the raw
data of a run are not needed: its summary is enough.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from piga.calibration.fit import fit_run
from piga.calibration.intervals import Interval
from piga.calibration.merged import MergedRuns, SourceSummary, Wish, source_column
from piga.calibration.model.design import Design, ServoState
from piga.calibration.model.identifiability import Examination, refuse_useless
from piga.calibration.model.request import Request, check_per_run, make_request
from piga.calibration.model.solution import Estimate, asked_order
from piga.calibration.sources import merged_sources, with_effects
from piga.calibration.summary import (
    LiveRun,
    RunSummary,
    own_summary,
    prepare,
    run_name,
    summarise,
    with_sources,
)
from piga.calibration.uncertainty import stated_scatter
from piga.calibration.weights import RATE
from piga.errors import ArgumentError, CalibrationError
from piga.progress import SILENT, Steps
from piga.records.calibration.coefficient import Coefficient, StandSource, changes
from piga.records.run import Run
from piga.records.terms import check_terms
from piga.results import Array
from piga.terms import THERMAL_TERMS

_INNER_CHANGE = 1e-6
"""Relative change of K above which the regressors of runs with base rotation are computed again."""


BIAS = "k0"
"""Term that each run has of its own unless asked otherwise."""
_SERVO_SOURCE = "servo "
"""Prefix of the names of sources that belong to the instrument."""
_COMMON_TO_ALL_STANDS = ("gravity",)
"""Sources that belong to the site, not to the stand."""
_WARMED = {"k0_T": "k0", "k1_T": "scale_factor"}
"""Terms of temperature, and the column that each becomes by one kelvin more."""


@dataclass(frozen=True)
class JointFit(MergedRuns):
    """The solution of merged runs: those with raw data, estimate with its interval, named coefficients, servo state."""

    summaries: tuple[RunSummary, ...]
    live: tuple[LiveRun | None, ...]
    estimate: Estimate
    interval: Interval
    coefficients: tuple[Coefficient, ...]
    covariance: Array
    examination: Examination
    servo: ServoState | None

    @property
    def degrees(self) -> Array:
        """Degrees of freedom of Type A in the order of the coefficients."""
        phases = len(self.coefficients) - self.layout.size
        return self.interval.degrees[asked_order(self.layout, self.wish.terms, phases)]

    @property
    def only(self) -> LiveRun | None:
        """The run, if there is one only, with raw data."""
        return self.live[0] if len(self.live) == 1 else None

    def design_of(self, index: int, live: LiveRun) -> tuple[Design, Array]:
        """Columns of a run with raw data, and their coefficients in each of its segments."""
        own, terms = live.fit.design, self.wish.terms_of(index)
        scale_factor = self.summaries[index].inner_scale_factor
        if own.request.terms != terms or own.scale_factor != scale_factor:
            own = Design(live.run, replace(live.request, terms=terms), scale_factor)
        return self.design_at(own, self.estimate, self.servo, index)

    def moved(self, change: Array) -> Array:
        """Change of the coefficients (n,; file units) by a change of the internal parameters."""
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
        summaries = tuple(summary.without_scatter() for summary in self.summaries)
        live = tuple(one and one.without_scatter() for one in self.live)
        quiet = replace(self, summaries=summaries, live=live)
        state, examination, estimate = quiet.solved()
        coefficients, covariance = quiet.named(estimate, estimate.covariance)
        return replace(
            quiet,
            estimate=estimate,
            coefficients=coefficients,
            covariance=covariance,
            examination=examination,
            servo=state,
        )


def fit_alone(run: Run, request: Request, steps: Steps) -> JointFit:
    """Fit one run from the triangles of its own fit.

    Raises
    ------
    IdentifiabilityError, DataError
        If the record does not determine what is asked.
    """
    live = LiveRun("", request, fit_run(run, request, stated_scatter(run)), ())
    steps("finding the intervals")
    return _useful(merge_runs(Wish.of_one(request.terms), [own_summary(live)], [live]))


def fit_jointly(
    items: Sequence[Run | RunSummary],
    terms: Sequence[str] | None,
    phases: str | None,
    per_run: Sequence[str] | None,
    steps: Steps,
) -> JointFit:
    """Reduce the runs that have raw data, merge all summaries and solve. Each run is reported to ``steps``.

    Raises
    ------
    CalibrationError
        If the runs are not of one instrument, or a run is given twice.
    IdentifiabilityError
        If the runs together cannot separate what is asked.
    """
    _check_one_instrument(items)
    wish = _wish(items, terms, per_run)
    names = _names(items)
    live: list[LiveRun | None] = []
    summaries: list[RunSummary] = []
    for index, (item, name) in enumerate(zip(items, names, strict=True)):
        if isinstance(item, RunSummary):
            live.append(None)
            summaries.append(replace(item, name=name))
            continue
        steps.within(index / len(items), f"fitting the model to {name}")
        own = wish.terms_of(index)
        request = make_request(item, own, "information", phases, per_run=())
        prepared = prepare(item, request, name)
        live.append(prepared)
        summaries.append(summarise(prepared, own))
    _check_temperature(wish, summaries)
    steps("solving all runs together")
    merged = merge_runs(wish, summaries, live)
    scale_factor = _scale_factor(merged)
    stale = [
        i
        for i, summary in enumerate(summaries)
        if summary.turning and abs(scale_factor / summary.inner_scale_factor - 1.0) > _INNER_CHANGE
    ]
    for i in stale:
        prepared_again = live[i]
        if prepared_again is not None:
            summaries[i] = summarise(prepared_again, wish.terms_of(i), scale_factor)
    return _useful(merge_runs(wish, summaries, live) if stale else merged)


def _useful(fit: JointFit) -> JointFit:
    """The fit, if it determines its coefficients well enough to be a result."""
    ranges = fit.ranges
    largest = max(*(abs(v) for v in ranges["a_x"]), ranges["a_t"][1])
    duration = max(max(p.end for p in s.positions) - min(p.begin for p in s.positions) for s in fit.summaries)
    spread = float(np.ptp(ranges["temperature"])) if "temperature" in ranges else 0.0
    refuse_useless(fit.coefficients, largest, duration, spread)
    return fit


def _wish(
    items: Sequence[Run | RunSummary], terms: Sequence[str] | None, per_run: Sequence[str] | None
) -> Wish:
    own = [item.terms if isinstance(item, RunSummary) else item.model.terms for item in items]
    if terms is not None:
        own = [tuple(terms)] * len(items)
    union = tuple(dict.fromkeys(name for names in own for name in names))
    check_terms(union, where="terms of all runs together", output=items[0].unit)
    free = _own_terms(items, own) if per_run is None else tuple(per_run)
    check_per_run(free, union)
    return Wish(union, free, tuple(own))


def _own_terms(items: Sequence[Run | RunSummary], own: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    """Terms with a value in each run: those that the run files name. Where none names any, the bias.

    A bias changes from one power-up to the next. Shared, its change would widen the intervals of all other terms. A run of
    one position cannot tell its bias alone; then all runs share it.
    """
    given = [item.per_run if isinstance(item, RunSummary) else item.estimation.per_run for item in items]
    asked = [names for names in given if names is not None]
    if asked:
        return tuple(dict.fromkeys(name for names in asked for name in names))
    if len(items) == 1:
        return ()
    counts = [len(item.segments if isinstance(item, RunSummary) else item.labels) for item in items]
    with_bias = [count for count, names in zip(counts, own, strict=True) if BIAS in names]
    return (BIAS,) if with_bias and min(with_bias) > 1 else ()


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


def _check_one_instrument(items: Sequence[Run | RunSummary]) -> None:
    first, names = items[0], _names(items)
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


def _check_temperature(wish: Wish, summaries: list[RunSummary]) -> None:
    references = {summary.temperature_reference for summary in summaries}
    if len(references) > 1 and set(THERMAL_TERMS) & set(wish.terms):
        raise CalibrationError(
            "the runs have different reference temperatures",
            remedy="write the same [model] temperature_reference in all run files",
        )


def merge_runs(wish: Wish, summaries: Sequence[RunSummary], live: Sequence[LiveRun | None]) -> JointFit:
    """Merge summaries that contain the requested columns, and solve; raises as :meth:`MergedRuns.solved` does."""
    runs = MergedRuns.of(wish, summaries)
    state, examination, estimate = runs.solved()
    interval = runs.interval_of(estimate, state)
    coefficients, covariance = runs.named(estimate, interval.covariance)
    return JointFit(
        wish=wish,
        summaries=tuple(summaries),
        layout=runs.layout,
        shared=runs.shared,
        live=tuple(live),
        estimate=estimate,
        interval=interval,
        coefficients=coefficients,
        covariance=covariance,
        examination=examination,
        servo=state,
    )


def _scale_factor(fit: JointFit) -> float:
    keys = fit.layout.amplitude_keys
    if ("scale_factor", None) not in keys:
        return fit.summaries[0].scale_factor
    return float(fit.estimate.amplitudes[keys.index(("scale_factor", None))])


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
            of_servo = source.name.startswith(_SERVO_SOURCE)
            of_site = source.name in _COMMON_TO_ALL_STANDS or of_servo
            own = -1 if source.draw == "reference" else index
            device = None if of_servo else summary.reference_id
            key = (source.name, None if of_site else summary.stand, device, source.value, own)
            moved.setdefault(key, {})[index] = number
    for numbers in moved.values():
        (first, number), *_ = numbers.items()
        source, names = summaries[first].sources[number], ", ".join(summaries[index].name for index in numbers)
        yield (replace(source, name=f"{source.name} ({names})") if names else source), numbers


def with_all_sources(fit: JointFit, steps: Steps = SILENT) -> JointFit:
    """The fit with the sources of Type B of its runs with raw data; the others have those that are stated."""
    summaries = list(fit.summaries)
    for index, live in enumerate(fit.live):
        if live:
            design, values = fit.design_of(index, live)
            plain, mode = design.with_servo(None), live.fit.mode
            summaries[index] = with_sources(
                summaries[index], plain, design, values, mode, units=True, steps=steps
            )
    return replace(fit, summaries=tuple(summaries))


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
        if moved.any() or not source.name.startswith(_SERVO_SOURCE):
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
    for position in fit.positions(index, fit.servo, (RATE, *names, *beside)):
        rows = position.part.without((RATE,), position.variance).factor
        columns, others = rows[:, m : m + len(names)], rows[:, m + len(names) : -1]
        own = dict(zip(wanted, values[position.group - fit.first_group(index)], strict=True))
        for number in warm:
            products = [own.get(term, 0.0) * others[:, beside.index(base)] for term, base in _WARMED.items()]
            columns[:, number] = -summary.sources[number].value * np.sum(products, axis=0)
        result.append(fit.estimate.jacobians[position.group].T @ rows[:, :m].T @ columns)
    return np.array(result)


def given_servo_of(fit: JointFit) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """Given coefficients of the servo, and by source of Type B the same, moved by it."""
    given = dict(fit.summaries[0].known_servo)
    moved = {source.name: dict(source.known_servo) for source, _ in joint_sources(fit.summaries)}
    return given, {name: servo for name, servo in moved.items() if servo}


def sources_of_stand(fit: JointFit, more: Sequence[StandSource] = ()) -> tuple[StandSource, ...]:
    """The sources of the stands of all runs, and ``more``, and the change of each coefficient by one unit of those not stated.

    The summary of a run without its raw data has no effects.
    """
    listed = (*merged_sources(summary.stand_sources for summary in fit.summaries), *more)
    moved = {source.name: change[0] for source, change in effects(fit, stated=False)}
    return with_effects(listed, moved, [c.key for c in fit.coefficients])


def check_items(items: object) -> list[Run | RunSummary]:
    """Check the runs given to a joint calibration.

    Raises
    ------
    ArgumentError
        If there are none, or an item is neither a run nor a summary.
    """
    given = list(items) if isinstance(items, (list, tuple)) else [items]
    runs = [item for item in given if isinstance(item, (Run, RunSummary))]
    if not runs or len(runs) < len(given):
        raise ArgumentError(
            "calibrate: a run, or a list of runs and run summaries, is needed",
            remedy="pass a Run, or a list of Run and RunSummary",
        )
    return runs
