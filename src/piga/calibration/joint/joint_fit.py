"""Several runs of one instrument, calibrated together from their summaries.

Coefficients belong to the instrument, except phases (each power-up has its own zero of the output angle) and
the terms named in ``per_run``. Every run is weighted by its own noise levels. Summaries add. A run whose raw data
no longer exist therefore takes part like any other.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from piga.calibration.budget.uncertainty import SharedSource
from piga.calibration.fit.servo import at_state, mixture, state_of
from piga.calibration.intervals.added_noise import AddedNoise
from piga.calibration.joint.summary import LiveRun, RunSummary, prepare, run_name, summarise
from piga.calibration.model.design import ServoState, phaseless_columns
from piga.calibration.model.identifiability import Examination, examine_parts, refuse_if_confounded
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.request import check_per_run, make_request
from piga.calibration.model.solution import Estimate, Layout, Owner, name_parameters, solve_parts
from piga.calibration.noise.settings import NOISE
from piga.errors import ArgumentError, CalibrationError
from piga.progress import Steps
from piga.records.calibration import Coefficient
from piga.records.calibration.coefficient import changes
from piga.records.run import Run
from piga.records.terms import SERVO_TERMS, check_terms, harmonic
from piga.results import Array


@dataclass(frozen=True)
class JointSettings:
    """Limits and steps of a joint fit (own choices).

    Attributes
    ----------
    inner_change:
        Relative change of K above which the regressors of runs with base rotation are computed again.
    same_servo:
        Largest relative difference of a servo coefficient between runs that is accepted; different rates cause
        it.
    noise_step:
        Finite-difference step of a run's noise for d(variance)/d(noise), relative.
    """

    inner_change: float = 1e-6
    same_servo: float = 0.02
    noise_step: float = 0.01


JOINT = JointSettings()


SERVO_SOURCE = "servo "
"""Prefix of the names of sources that belong to the instrument."""
COMMON_TO_ALL_STANDS = ("gravity",)
"""Sources that belong to the site, not to the stand."""


@dataclass(frozen=True)
class Wish:
    """Request for all runs together: union of their terms, and the terms that may differ between runs."""

    terms: tuple[str, ...]
    per_run: tuple[str, ...]
    own: tuple[tuple[str, ...], ...]

    def terms_of(self, index: int) -> tuple[str, ...]:
        """Terms of one run: the common terms, and those ``per_run`` terms that the run asks for."""
        return tuple(t for t in self.terms if t not in self.per_run or t in self.own[index])


@dataclass(frozen=True)
class JointFit:
    """Result of merging: summaries, positions of their phase groups, estimate and named coefficients."""

    wish: Wish
    summaries: tuple[RunSummary, ...]
    live: tuple[LiveRun | None, ...]
    layout: Layout
    estimate: Estimate
    coefficients: tuple[Coefficient, ...]
    covariance: Array
    examination: Examination
    servo: ServoState | None = None

    def first_group(self, index: int) -> int:
        """Number of the first phase group of a run."""
        return sum(len(summary.parts) for summary in self.summaries[:index])

    def servo_of(self, index: int, segments: int) -> ServoState | None:
        """State that combines the servo columns in the segments of a run; None without servo terms."""
        if self.servo is None:
            return None
        first, count = self.first_group(index), len(self.summaries[index].parts)
        own = self.servo.phases[first : first + count]
        return replace(self.servo, phases=own if count == segments else own * segments)

    def column_values(self, index: int) -> Array:
        """Coefficients of the columns of a run in each of its phase groups."""
        first, count = self.first_group(index), len(self.summaries[index].parts)
        phases = self.estimate.phases if self.layout.coupled else np.zeros(first + count)
        return np.array(
            [self.layout.linear(self.estimate.amplitudes, phases[g], g) for g in range(first, first + count)]
        )


def fit_jointly(
    items: Sequence[Run | RunSummary],
    terms: Sequence[str] | None,
    phases: str | None,
    per_run: Sequence[str] | None,
    steps: Steps,
) -> JointFit:
    """Reduce the runs that have raw data, merge all summaries and solve. ``steps`` hears of each run.

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
    summaries = evident_together(summaries)
    steps("solving all runs together")
    merged = merge_runs(wish, summaries, live)
    scale_factor = _scale_factor(merged)
    stale = [
        i
        for i, summary in enumerate(summaries)
        if summary.turning and abs(scale_factor / summary.inner_scale_factor - 1.0) > JOINT.inner_change
    ]
    for i in stale:
        prepared_again = live[i]
        if prepared_again is not None:
            again = summarise(prepared_again, wish.terms_of(i), scale_factor)
            kept = {(noise.name, noise.otherwise) for noise in summaries[i].added}
            summaries[i] = replace(again, added=tuple(n for n in again.added if (n.name, n.otherwise) in kept))
    return merge_runs(wish, summaries, live) if stale else merged


def evident_together(summaries: list[RunSummary]) -> list[RunSummary]:
    """The runs with their coloured noise if they show it together, else with a random walk in its place.

    Of n runs, one shows coloured noise by chance n times as often as a single run does. The runs are of one instrument.
    So their gains together must exceed the limit of a run by ``2 log n``.
    """
    gains = [max((noise.gain for noise in summary.added), default=0.0) for summary in summaries]
    coloured = sum(gains) >= NOISE.colour_in_covariance + 2.0 * math.log(len(summaries))

    def taken(noise: AddedNoise) -> bool:
        return not noise.otherwise if coloured else noise.gain == 0.0

    return [replace(summary, added=tuple(filter(taken, summary.added))) for summary in summaries]


def _wish(
    items: Sequence[Run | RunSummary], terms: Sequence[str] | None, per_run: Sequence[str] | None
) -> Wish:
    own = [item.terms if isinstance(item, RunSummary) else item.model.terms for item in items]
    if terms is not None:
        own = [tuple(terms)] * len(items)
    union = tuple(dict.fromkeys(name for names in own for name in names))
    check_terms(union, where="terms of all runs together")
    asked = [item.per_run if isinstance(item, RunSummary) else item.estimation.per_run for item in items]
    free = tuple(per_run) if per_run is not None else tuple(dict.fromkeys(n for names in asked for n in names))
    check_per_run(free, union)
    return Wish(union, free, tuple(own))


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
    if len(references) > 1 and {"k0_T", "k1_T"} & set(wish.terms):
        raise CalibrationError(
            "the runs have different reference temperatures",
            remedy="write the same [model] temperature_reference in all run files",
        )


def layout_and_columns(wish: Wish, summaries: Sequence[RunSummary]) -> tuple[Layout, list[tuple[str, ...]]]:
    """The common layout, and the shared columns of every run."""
    shared = [
        tuple(t for t in wish.terms_of(i) if t != "tan_beta" and harmonic(t) is None)
        for i in range(len(summaries))
    ]
    keys: list[tuple[str, str | None]] = []
    for term in wish.terms:
        if term == "tan_beta" or harmonic(term):
            continue
        if term in wish.per_run:
            keys += [(term, s.name) for s, own in zip(summaries, shared, strict=True) if term in own]
        else:
            keys.append((term, None))
    tails = []
    for summary, own in zip(summaries, shared, strict=True):
        at = [keys.index((t, summary.name if t in wish.per_run else None)) for t in own]
        tails += [np.array(at, dtype=np.int64)] * len(summary.parts)
    orders = tuple(sorted({wave[1] for t in wish.terms if (wave := harmonic(t))}))
    return Layout("tan_beta" in wish.terms, orders, tuple(keys), tuple(tails)), shared


def _parts(
    layout: Layout,
    shared: list[tuple[str, ...]],
    summaries: Sequence[RunSummary],
    state: ServoState | None,
    source: SharedSource | None = None,
    segment: int | None = None,
) -> list[Reduction]:
    """Summaries of all phase groups. Those that a source moves are in their moved form; with a state, combined at it.

    ``segment``: the only moved segment; default: all segments are moved.
    """
    local = layout.columns[: layout.local]
    parts: list[Reduction] = []
    for index, summary in enumerate(summaries):
        chosen, known = summary.parts, known_servo_of(summary, shared[index])
        if source is not None and index in source.moved:
            moved = summary.sources[source.moved[index]]
            chosen = moved.parts
            if segment is not None:
                group, part = moved.segments[segment]
                chosen = (*summary.parts[:group], part, *summary.parts[group + 1 :])
            known = known_servo_of(
                replace(summary, known_servo=moved.known_servo or summary.known_servo), shared[index]
            )
        held = summary.choose(chosen, local, without_phase(shared[index], known))
        wanted = summary.columns(local, shared[index])
        if state is not None:
            held = [at_state(part, wanted, state, len(parts) + group, known) for group, part in enumerate(held)]
        parts += held
    return parts


def known_servo_of(summary: RunSummary, shared: tuple[str, ...]) -> dict[str, float]:
    """K times the servo coefficients that a run gives and that are not estimated."""
    return {name: summary.inner_scale_factor * size for name, size in summary.known_servo if name not in shared}


def without_phase(shared: tuple[str, ...], known: Iterable[str]) -> tuple[str, ...]:
    """Shared columns as they are stored in summaries."""
    return tuple(name for name in shared if name not in SERVO_TERMS) + phaseless_columns((*shared, *known))


def _servo_state(
    layout: Layout, shared: list[tuple[str, ...]], summaries: Sequence[RunSummary]
) -> ServoState | None:
    """State that combines the servo columns in all phase groups; None without servo terms.

    Raises
    ------
    CalibrationError
        If the runs give different parameters of the servo.
    """
    known = [known_servo_of(summary, own) for summary, own in zip(summaries, shared, strict=True)]
    if not any(known) and not any(name in SERVO_TERMS for names in shared for name in names):
        return None
    for index, given in enumerate(known):
        alike = given.keys() == known[0].keys() and all(
            abs(size - known[0][name]) <= JOINT.same_servo * abs(size) for name, size in given.items()
        )
        if not alike:
            raise CalibrationError(
                f"run '{summaries[0].name}' and run '{summaries[index].name}' give different parameters of the servo",
                remedy="write the same [instrument] servo in all run files of an instrument, or in none",
            )
    local = layout.columns[: layout.local]
    wanted = [
        summary.columns(local, own)
        for summary, own in zip(summaries, shared, strict=True)
        for _ in summary.parts
    ]
    parts = _parts(layout, shared, summaries, None)
    return state_of(layout, parts, wanted, known[0], runs=len(summaries))


def merge_runs(wish: Wish, summaries: list[RunSummary], live: list[LiveRun | None]) -> JointFit:
    """Merge summaries that hold the requested columns, and solve.

    Raises
    ------
    CalibrationError
        If a summary lacks a column, or the runs give different parameters of the servo.
    IdentifiabilityError
        If the runs together cannot separate what is asked.
    """
    layout, shared = layout_and_columns(wish, summaries)
    state = _servo_state(layout, shared, summaries)
    parts = _parts(layout, shared, summaries, state)
    examination = examine_parts(layout, parts)
    refuse_if_confounded(examination, len(summaries))
    estimate = _estimate(layout, shared, summaries, parts, state)
    coefficients, covariance = _named(wish, summaries, layout, estimate)
    return JointFit(
        wish=wish,
        summaries=tuple(summaries),
        live=tuple(live),
        layout=layout,
        estimate=estimate,
        coefficients=coefficients,
        covariance=covariance,
        examination=examination,
        servo=state,
    )


def _estimate(
    layout: Layout,
    shared: list[tuple[str, ...]],
    summaries: Sequence[RunSummary],
    parts: list[Reduction],
    state: ServoState | None,
) -> Estimate:
    """Estimate. Its covariance includes the noise that is not in the weights of the runs."""
    plain = solve_parts(layout, parts)
    added = np.zeros_like(plain.covariance)
    for noise, per_unit in _added(layout, shared, summaries, plain, state):
        added += noise.variance * per_unit
    return replace(plain, covariance=plain.covariance + added)


def _added(
    layout: Layout,
    shared: list[tuple[str, ...]],
    summaries: Sequence[RunSummary],
    plain: Estimate,
    state: ServoState | None,
) -> Iterator[tuple[AddedNoise, Array]]:
    """Noise that is not in the weights of the runs, and the covariance per unit of each."""
    local = layout.columns[: layout.local]
    first = 0
    for index, summary in enumerate(summaries):
        groups = range(first, first + len(summary.parts))
        first = groups.stop
        if not summary.added:
            continue
        known = known_servo_of(summary, shared[index])
        held = summary.columns(local, without_phase(shared[index], known))
        wanted = summary.columns(local, shared[index])
        jacobians = [layout.jacobian(plain.amplitudes, plain.phases, group) for group in groups]
        for noise in summary.added:
            own = noise.select(summary.parts[0].names, held)
            if state is not None:
                own = own.mixed([mixture(held, wanted, state, state.phases[g])[:-1, :-1] for g in groups])
            meat = own.per_unit(jacobians)
            yield noise, plain.covariance @ meat @ plain.covariance


def _named(
    wish: Wish, summaries: Sequence[RunSummary], layout: Layout, estimate: Estimate
) -> tuple[tuple[Coefficient, ...], Array]:
    owners: list[Owner] = []
    if layout.coupled:
        owners = [(label, summary.name) for summary in summaries for label in summary.labels]
    nominal = summaries[0].scale_factor
    return name_parameters(layout, estimate, estimate.covariance, nominal, wish.terms, owners)


def _scale_factor(fit: JointFit) -> float:
    keys = fit.layout.amplitude_keys
    if ("scale_factor", None) not in keys:
        return fit.summaries[0].scale_factor
    return float(fit.estimate.amplitudes[keys.index(("scale_factor", None))])


def joint_sources(summaries: Sequence[RunSummary]) -> Iterator[SharedSource]:
    """Sources of all runs. A source that runs share moves all of them at once.

    Runs share a source if it has the same name and value, on the same kind of stand, with the same
    ``reference_id`` (or none in both). ``gravity`` is shared on any stand. A servo parameter belongs to the
    instrument and is shared in any case. A source with a new value in each run or each segment is not shared.
    """
    shared_by_key: dict[tuple[str, str | None, str | None, float, int], SharedSource] = {}
    for index, summary in enumerate(summaries):
        for number, source in enumerate(summary.sources):
            of_servo = source.name.startswith(SERVO_SOURCE)
            of_site = source.name in COMMON_TO_ALL_STANDS or of_servo
            own = -1 if source.draw == "reference" else index
            device = None if of_servo else summary.reference_id
            key = (source.name, None if of_site else summary.stand, device, source.value, own)
            shape = (source.distribution, source.degrees_of_freedom, len(source.segments), source.in_fit)
            first = shared_by_key.get(key, SharedSource(source.name, source.value, source.unit, {}, *shape))
            shared_by_key[key] = replace(first, moved=first.moved | {index: number})
    for shared in shared_by_key.values():
        names = ", ".join(summaries[index].name for index in shared.moved)
        yield replace(shared, name=f"{shared.name} ({names})")


def joint_contributions(fit: JointFit, steps: Steps) -> Iterator[tuple[SharedSource, Array]]:
    """Changes of the coefficients (draws, n; file units) by one standard uncertainty of each source.

    ``steps`` hears of each source.
    """
    layout, shared = layout_and_columns(fit.wish, fit.summaries)
    base = np.array([c.value for c in fit.coefficients])

    def change(source: SharedSource, segment: int | None) -> Array:
        estimate = solve_parts(layout, _parts(layout, shared, fit.summaries, fit.servo, source, segment))
        named, _ = _named(fit.wish, fit.summaries, layout, estimate)
        return changes(named, base, np.array([c.value for c in named]))

    for number, source in enumerate(joint_sources(fit.summaries)):
        steps.parts(number, f"adding up the budget: {source.name}")
        draws = range(source.segments) if source.segments else (None,)
        yield source, np.array([change(source, segment) for segment in draws])


def joint_degrees(fit: JointFit) -> Array:
    """Degrees of freedom of the Type A variance of every coefficient (JCGM 100, eq. G.2b).

    The variance is a sum of shares of the runs. Each share is as well known as the noise levels of its run. It is
    the derivative of the variance by the scale of that noise. Noise that is not in the weights is a share of its own.
    """
    layout, shared = layout_and_columns(fit.wish, fit.summaries)
    now = np.diag(fit.covariance)
    known = np.zeros(now.size)
    for index, summary in enumerate(fit.summaries):
        parts = _parts(layout, shared, fit.summaries, fit.servo)
        first = fit.first_group(index)
        for group in range(first, first + len(summary.parts)):
            parts[group] = parts[group].scaled(1.0 / (1.0 + JOINT.noise_step))
        summaries = list(fit.summaries)
        summaries[index] = replace(
            summary, added=tuple(noise.scaled(1.0 / (1.0 + JOINT.noise_step)) for noise in summary.added)
        )
        estimate = _estimate(layout, shared, summaries, parts, fit.servo)
        _, covariance = _named(fit.wish, fit.summaries, layout, estimate)
        known += ((np.diag(covariance) - now) / JOINT.noise_step) ** 2 / summary.degrees_of_freedom
    plain = solve_parts(layout, _parts(layout, shared, fit.summaries, fit.servo))
    before = np.zeros(now.size)
    for noise, per_unit in _added(layout, shared, fit.summaries, plain, fit.servo):
        _, covariance = _named(fit.wish, fit.summaries, layout, replace(plain, covariance=per_unit))
        share = np.diag(covariance)
        known += 0.5 * (noise.deviation * share) ** 2 + noise.shared * share * before
        before = share
    return now**2 / np.maximum(known, 1e-300)


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
