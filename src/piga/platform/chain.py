"""The whole chain: simulate, identify, align, navigate with every model, compare lines per day with the closed-form theory.

And the error budget by source.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga import earth
from piga.frames import rotation_vector_to_matrix
from piga.platform.geometry import gravity, local_axes, misalignment
from piga.platform.identify import Alignment, Identification, align, identify
from piga.platform.navigator import (
    Errors,
    Knowledge,
    Navigation,
    Start,
    compensator,
    errors,
    navigate,
    true_knowledge,
    true_start,
)
from piga.platform.observation import MOVING_SOURCES, STATIC_SOURCES
from piga.platform.scenario import Gyro, Model, PlatformScenario
from piga.platform.simulate import PlatformRun, number_table, simulate
from piga.progress import Progress, Steps
from piga.results import Array, Plotted, Result, finite
from piga.units import ARCMIN, ARCSEC, DAY, G0
from piga.upper import doors

if TYPE_CHECKING:
    import pyarrow as pa

    from piga.reports.render.figure import Figure

_COLUMNS = {"east_velocity": 1, "north_velocity": 0, "heading": 5, "roll": 3, "pitch": 4}
"""Columns of the channels in a table of velocity (north, east, down) and attitude (roll, pitch, heading)."""
CHANNELS = tuple(_COLUMNS)
_SCHULER = float(np.sqrt(earth.GM / earth.SEMI_MAJOR_AXIS**3))
_ALIKE = 1e-9
"""Largest relative difference of two rates that count as equal."""
_NEIGHBOURS = 4.0 * 3600.0
"""Shortest stretch [s] whose fit contains the neighbours of a line at ``+- Earth rate``. In shorter ones they are one line."""


def channels(errors: Errors) -> dict[str, Array]:
    """The error channels whose lines are followed: velocities [m/s], attitude [rad]."""
    table = np.concatenate([errors.velocity, errors.attitude], axis=1)
    return {name: table[:, column] for name, column in _COLUMNS.items()}


def fitted_lines(times: Array, values: Array, rates: tuple[float, ...], latitude: float) -> Array:
    """Amplitudes (r, k) at the angular ``rates`` (r,) [rad/s] in the columns of ``values`` (n, k), at mid-stretch.

    All lines are fitted together with the other known components: the growth of each line over the stretch, the
    neighbours of the first line (the polar gyro's) at ``rate +- Earth rate`` (on stretches of four hours and more),
    twice each rate, sum and difference of two rates, the Schuler oscillation with its Foucault split, and a cubic. A
    Hann window weights the samples, so the rest of the Schuler oscillation does not leak into the lines. The amplitude is
    NaN for a rate of zero, and for two rates that the stretch cannot separate (:func:`separable`).
    """
    n = len(times)
    step = float(times[-1] - times[0]) / (n - 1)
    amplitude = np.full((len(rates), values.shape[1]), np.nan)
    turning = [k for k, rate in enumerate(rates) if rate > 0.0]
    if not turning or not separable(rates, n * step):
        return amplitude
    scaled, gram, norms = _line_design(n, step, tuple(rates[k] for k in turning), rates[0], latitude)
    solution = np.linalg.lstsq(gram, scaled.T @ (values - values.mean(axis=0)), rcond=1e-12)[0]
    solution = solution[: 2 * len(turning)] / norms[: 2 * len(turning), None]
    amplitude[turning] = np.hypot(solution[::2], solution[1::2])
    return amplitude


def separable(rates: tuple[float, ...], stretch: float) -> bool:
    """True if a stretch [s] can separate the lines at the case ``rates`` [rad/s].

    The two lines must have at least one beat in the stretch. On stretches of four hours and more, they must also have
    half a beat with the neighbours of the first line at ``+- Earth rate``.
    """
    if len(rates) < 2 or min(rates) <= 0.0:
        return True
    apart = abs(rates[1] - rates[0])
    beats = [apart * stretch] + (
        [2.0 * abs(apart - earth.EARTH_RATE) * stretch] if stretch >= _NEIGHBOURS else []
    )
    return min(beats) >= 2.0 * np.pi


@lru_cache(maxsize=4)
def _line_design(
    n: int, step: float, rates: tuple[float, ...], polar: float, latitude: float
) -> tuple[Array, Array, Array]:
    """Weighted regressors, their Gram matrix and their norms for ``n`` samples about mid-stretch.

    Beside two rates, a wave within half a beat of one of them (twice one rate may be the other) is not taken again.
    """
    t = (np.arange(n) - 0.5 * (n - 1)) * step
    x = t / max(t[-1], 1.0)
    foucault = earth.EARTH_RATE * np.sin(latitude)
    others, neighbours = [2.0 * rate for rate in rates] + [_SCHULER], []
    if n * step >= _NEIGHBOURS:
        neighbours = [polar - earth.EARTH_RATE, polar + earth.EARTH_RATE] if polar > 0.0 else []
        others += [_SCHULER - foucault, _SCHULER + foucault]
    if len(rates) == 2:
        others += [rates[0] + rates[1], abs(rates[0] - rates[1])]
        beat = 2.0 * np.pi / (n * step)
        others = [w for w in others if min(abs(w - rate) for rate in rates) > 0.49 * beat]
    waves = [f(w * t) for w in (*rates, *neighbours, *others) for f in (np.cos, np.sin)]
    growth = [x * wave for wave in waves[: 2 * len(rates)]]
    design = np.stack([*waves, *growth, np.ones_like(x), x, x * x, x**3], axis=1)
    weights = np.sin(np.pi / n * (np.arange(n) + 0.5)) ** 2
    norms = np.sqrt(weights @ (design * design))
    design /= norms
    weighted = weights[:, None] * design
    return weighted, design.T @ weighted, norms


@dataclass(frozen=True, eq=False, repr=False)
class Lines(Result):
    """Amplitudes at the case-rotation periods per day: ``amplitude[channel]`` (days,), SI; position error [m].

    ``amplitude`` is that at the polar case's rate; ``equatorial`` that at the equatorial case's where it turns at another
    speed, else empty. NaN: no such line, or not told apart from the other. ``position`` is the largest horizontal
    position error of each day.
    """

    day: NDArray[np.int64]
    amplitude: Mapping[str, Array]
    position: Array
    equatorial: Mapping[str, Array] = field(default_factory=dict)

    @property
    def by_case(self) -> dict[str, Mapping[str, Array]]:
        """The amplitudes that there are, by the name of their case's line in documents."""
        named = {"line": self.amplitude, "equatorial_line": self.equatorial}
        return {name: amplitude for name, amplitude in named.items() if amplitude}


def day_slices(times: Array) -> list[slice]:
    """Rows of each day of the run (1-based days). A rest of less than four hours belongs to the day before."""
    days = max(1, int(np.ceil((times[-1] - _NEIGHBOURS) / DAY + 1e-9)))
    edges = np.searchsorted(times, np.arange(days + 1) * DAY + 1e-6)
    edges[0], edges[-1] = 0, len(times)
    return [slice(a, b) for a, b in pairwise(edges.tolist()) if b - a > 24]


def case_rates(scenario: PlatformScenario) -> tuple[float, ...]:
    """Angular rates [rad/s] at which lines are followed: one where both cases turn alike, else polar and equatorial.

    If both cases rest, a period of eight minutes is used, for comparison with rotating cases.
    """
    polar, equatorial = scenario.polar_rotation, scenario.equatorial_rotation
    if abs(polar - equatorial) <= _ALIKE * polar:
        return (polar or 2.0 * np.pi / 480.0,)
    return polar, equatorial


def has_theory(scenario: PlatformScenario) -> bool:
    """True if :func:`theory_lines` holds: four hours on a base that stays at its place; a case turns without reversals."""
    turning = max(scenario.polar_rotation, scenario.equatorial_rotation) > 0.0
    return turning and not theory_note(scenario).endswith("no theory is shown")


def theory_note(scenario: PlatformScenario) -> str:
    """The reason why the lines are shown without theory, or without that of roll and pitch; else empty."""
    if scenario.reversal:
        return "the cases reverse: the closed form of the lines does not hold, and no theory is shown"
    if scenario.motion.kind == "track":
        return "the base changes its place: the closed form of the lines does not hold, and no theory is shown"
    if scenario.duration < _NEIGHBOURS:
        return "in less than 4 h a line contains its neighbours at +- Earth rate: no theory is shown"
    turns = "the base turns: its roll and pitch have no line at the case rate, and no theory of them is shown"
    return turns if scenario.motion.kind == "turn" else ""


def lines_note(scenario: PlatformScenario) -> str:
    """The reason why a day gives no amplitudes although both cases turn; empty if it gives them."""
    rates, stretch = case_rates(scenario), min(scenario.duration, DAY)
    if separable(rates, stretch):
        return ""
    periods = " and ".join(f"{2.0 * np.pi / rate:.6g} s" for rate in rates)
    return (
        f"the lines of the two cases ({periods}) cannot be told apart within {stretch / 3600.0:g} h: no amplitudes; "
        "give both cases one period, or periods further apart"
    )


def daily_lines(errors: Errors, rates: tuple[float, ...], latitude: float) -> Lines:
    """Line amplitudes of every channel, day by day, at the case ``rates`` [rad/s] (one, or polar and equatorial)."""
    table, parts = np.stack(list(channels(errors).values()), axis=1), day_slices(errors.times)
    days = [fitted_lines(errors.times[part], table[part], rates, latitude) for part in parts]
    amplitude = np.array(days).reshape(len(parts), len(rates), len(CHANNELS)).transpose(1, 2, 0)
    horizontal = errors.horizontal
    position = np.array([horizontal[part].max() for part in parts])
    return _lines([dict(zip(CHANNELS, one, strict=True)) for one in amplitude], position)


def _lines(by_case: list[dict[str, Array]], position: Array) -> Lines:
    return Lines(np.arange(1, len(position) + 1), by_case[0], position, by_case[1] if len(by_case) > 1 else {})


def theory_lines(
    scenario: PlatformScenario, model: Model, knowledge: Knowledge, days: list[slice], times: Array
) -> Lines:
    """Closed-form line amplitudes of a base that stays at its place, day by day (redundancy angle at mid-day) [He2014].

    The turn about the polar axis that the model leaves, ``d_r(c)``, has amplitude D at one cycle per
    case turn, and ``S = w_c^2 / (w_c^2 - w_s^2)`` with the Schuler rate w_s. Then east velocity
    ``g D S cos(L) / w_c``, north velocity by the Coriolis coupling ``2 Omega sin(L) S / w_c`` of it, heading
    ``D S sin(L)``, roll ``D S cos(L) cos(heading)``, pitch ``D S cos(L) sin(heading)``. The literature
    gives heading and roll without S; the longitude error, which turns the local axes about the same
    pole, adds it (docs/theory/platform.md section 8). Cases at unequal speeds: ``m1`` stands at the polar case's
    rate, ``m2`` at the equatorial one's. Position is not predicted (NaN), nor are roll and pitch of a base that turns.
    """
    rates = case_rates(scenario)
    middles = [0.5 * float(times[d.start] + times[d.stop - 1]) for d in days]
    left = np.array([_left_about_pole(scenario, model, knowledge, middle, rates) for middle in middles])
    lines = [_channels_of_turn(scenario, left[:, k], rate) for k, rate in enumerate(rates)]
    return _lines(lines, np.full(len(days), np.nan))


def _channels_of_turn(scenario: PlatformScenario, turn: Array, rate: float) -> dict[str, Array]:
    """Amplitudes of every channel from that of the turn about the polar axis [rad] at ``rate`` [rad/s]; NaN at rest."""
    if rate == 0.0:
        return {name: np.full(len(turn), np.nan) for name in CHANNELS}
    latitude, heading = scenario.place.latitude, scenario.motion.heading
    turn, sine = turn * rate**2 / (rate**2 - _SCHULER**2), abs(np.sin(latitude))
    east = gravity(latitude, scenario.place.height) * turn * np.cos(latitude) / rate
    level = turn * np.cos(latitude) * (np.nan if scenario.motion.kind == "turn" else 1.0)
    return {
        "east_velocity": east,
        "north_velocity": east * 2.0 * earth.EARTH_RATE * sine * rate / (rate**2 - _SCHULER**2),
        "heading": turn * sine,
        "roll": level * abs(np.cos(heading)),
        "pitch": level * abs(np.sin(heading)),
    }


def _left_about_pole(
    scenario: PlatformScenario, model: Model, knowledge: Knowledge, time: float, rates: tuple[float, ...]
) -> list[float]:
    """Amplitudes [rad] at the case ``rates`` [rad/s] of the z angle that the model leaves at ``time``: order one of each case."""
    truth = true_knowledge(scenario)
    eta, pole = truth.eta0 + truth.eta_rate * time, rotation_vector_to_matrix(np.array(scenario.triad))[2]
    left = _about_pole(truth.polar, truth.equatorial, eta, pole)
    if model != "none":
        polar, equatorial = knowledge.polar, knowledge.equatorial
        if model != "C":
            polar, equatorial = (Gyro(g.misalignment, g.phase) for g in (polar, equatorial))
        left = left - _about_pole(polar, equatorial, knowledge.eta0 if model == "A" else eta, pole)
    lines = np.fft.fft(left)[:, 1] / 128.0
    return np.abs(lines if len(rates) == 2 else [lines.sum()]).tolist()


def _about_pole(polar: Gyro, equatorial: Gyro, eta: float, pole: Array) -> Array:
    """What each gyro gives to the angle [rad] about the Earth's axis, ``pole`` in triad axes, over a turn of its case: (2, 256)."""
    angle = (2.0 * np.pi / 256) * np.arange(256, dtype=np.float64)
    c1, c2 = angle + polar.phase, angle + equatorial.phase
    first = (pole[0] - pole[2] * np.tan(eta)) * np.cos(c1) + pole[1] * np.sin(c1)
    second = pole[2] * np.sin(c2) / np.cos(eta)
    return np.stack([misalignment(polar, c1) * first, misalignment(equatorial, c2) * second])


# -- the chain ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Preparation:
    """Knowledge before navigation: misalignments, start, and the results that gave them (None: from truth)."""

    knowledge: Knowledge
    start: Start
    identification: Identification | None
    alignment: Alignment | None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ModelRun:
    """One compensation model over the run: navigation, errors, lines per day, and theory."""

    navigation: Navigation
    errors: Errors
    lines: Lines
    theory: Lines | None


def navigation_table(run: ModelRun) -> pa.Table:
    """Output of the navigator, and its errors."""
    t, e = run.navigation.table, run.errors
    return number_table(
        ("t", "s", run.navigation.times),
        ("latitude longitude", "rad", t[:, :2]),
        ("height", "m", t[:, 2]),
        ("v_north v_east v_down", "m/s", t[:, 3:6]),
        ("roll pitch heading", "rad", t[:, 6:]),
        ("error_north error_east error_up", "m", np.stack([e.north, e.east, e.up], axis=1)),
        ("error_v_north error_v_east error_v_down", "m/s", e.velocity),
        ("error_roll error_pitch error_heading", "rad", e.attitude),
    )


@dataclass(frozen=True, eq=False, repr=False)
class ModelComparisonRun(Result, Plotted):
    """All models over one run. The plot shows the lines of each model, day by day."""

    run: PlatformRun
    preparation: Preparation
    models: Mapping[Model, ModelRun]

    def figure(self) -> Figure:
        """Lines at the case-rotation period against the day."""
        return doors().platform_figures().lines_figure(self)

    def in_brief(self) -> list[tuple[str, str]]:
        """Duration, and what each model leaves."""
        rows = [("duration", f"{self.run.scenario.duration / 3600.0:.6g} h, step {self.run.scenario.step:g} s")]
        for model, ran in self.models.items():
            left = f"position within {float(ran.errors.horizontal.max()):.4g} m"
            rows.append(("no model" if model == "none" else f"model {model}", left))
        return [*rows, *(("note", note) for note in self.preparation.notes)]

    def document(self) -> dict[str, Any]:
        """The JSON document of ``piga platform compare``."""
        theory = {m: _lines_document(r.theory) for m, r in self.models.items() if r.theory is not None}
        return {
            "models": {m: _lines_document(r.lines) for m, r in self.models.items()},
            "theory": theory,
            "notes": list(self.preparation.notes),
        }


def sources_of(run: PlatformRun) -> tuple[str, ...]:
    """Sources of identification that the base of a run allows."""
    return STATIC_SOURCES if run.truth.motion.at_rest else MOVING_SOURCES


def prepare(run: PlatformRun, progress: Progress | None = None) -> Preparation:
    """Identify and align as the scenario asks, from readouts of its calibration stretch only."""
    s, c = run.scenario, run.scenario.compensation
    stretch, place = run.readouts.first(s.calibration_time), s.place
    identification, aligned, notes = None, None, [lines_note(s), theory_note(s)]
    if c.misalignment == "identified" and s.polar_rotation > 0.0:
        identification = identify(stretch, place, sources=sources_of(run), orders=c.orders, progress=progress)
        notes = [*identification.notes, *notes]
    elif c.misalignment == "identified":
        notes.insert(0, "the cases are at rest: nothing can be identified; the true misalignments are used")
    knowledge = true_knowledge(s) if identification is None else identification.knowledge
    attitude = c.attitude or ("aligned" if run.truth.motion.at_rest else "true")
    if "aligned" in (attitude, c.drift):
        aligned = align(stretch, place, knowledge, orders=c.orders, progress=progress)
    start = aligned.start(with_drift=False) if aligned and attitude == "aligned" else true_start(run.truth)
    start = replace(start, drift=_drift(s, aligned))
    return Preparation(knowledge, start, identification, aligned, tuple(note for note in notes if note))


def _drift(s: PlatformScenario, aligned: Alignment | None) -> Array:
    if s.compensation.drift == "aligned" and aligned is not None:
        return aligned.drift
    if s.compensation.drift == "true":
        w1x, w1y = s.polar.drift
        w2z = s.equatorial.drift[1]
        return np.array([w1x, w1y, w2z / np.cos(s.redundancy) - w1x * np.tan(s.redundancy)])
    return np.zeros(3)


def run_model(run: PlatformRun, preparation: Preparation, model: Model, *, every: int = 1) -> ModelRun:
    """Navigate the run with one model; lines per day, and theory where the base stays at its place."""
    s = run.scenario
    made = compensator(model, preparation.knowledge, run.readouts, redundancy=s.compensation.redundancy)
    navigation = navigate(run.readouts, made, preparation.start, damping_time=s.damping_time, every=every)
    error = errors(navigation, run.truth, run.readouts)
    lines = daily_lines(error, case_rates(s), s.place.latitude)
    days = day_slices(error.times)
    theory = theory_lines(s, model, preparation.knowledge, days, error.times) if has_theory(s) else None
    return ModelRun(navigation, error, lines, theory)


def compare(scenario: PlatformScenario, *, progress: Progress | None = None) -> ModelComparisonRun:
    """Simulate the scenario and navigate it with every model it names.

    ``progress`` is called as ``progress(done, total, what)`` before each step; it returns False to stop
    (:mod:`piga.progress`).

    Raises
    ------
    PigaError
        If the scenario cannot be simulated, or its misalignments cannot be identified.
    """
    named = scenario.compensation.models
    steps = Steps(progress, 2 + len(named))
    steps("simulating")
    run = simulate(scenario)
    steps("identifying and aligning")
    preparation, models, every = prepare(run), {}, max(1, round(1.0 / scenario.step))  # a row a second
    for m in named:
        steps(f"navigating, model {m}")
        models[m] = run_model(run, preparation, m, every=every)
    steps.finish()
    return ModelComparisonRun(run, preparation, models)


def last_east_lines(lines: Lines) -> list[float]:
    """East velocity lines [m/s] of the last day: at the polar case's rate and, at another speed, the equatorial one's."""
    return [float(amplitude["east_velocity"][-1]) for amplitude in lines.by_case.values()]


def _lines_document(lines: Lines) -> dict[str, Any]:
    """Amplitudes by channel and day, in m/s or arcmin; a missing line is null."""
    document: dict[str, Any] = {"day": lines.day.tolist()}
    for label, amplitude in lines.by_case.items():
        for name, values in amplitude.items():
            size, unit = (1.0, "m_s") if name.endswith("velocity") else (ARCMIN, "arcmin")
            document[f"{name}_{label}_{unit}"] = [finite(value) for value in (values / size).tolist()]
    return document | {"position_error_m": [finite(value) for value in lines.position.tolist()]}


# -- error budget --------------------------------------------------------------------------------------------


Source = Mapping[str, ArrayLike]
"""One error put in, any of: ``attitude`` [rad] and ``drift`` [rad/s], by ``attitude + drift t`` of which the navigator's triad is
turned too far; accelerometer ``bias`` [m/s^2], reference ``height`` [m], ``position`` [m] and ``velocity`` [m/s] north, east, down
at the start."""


@dataclass(frozen=True)
class BudgetRow:
    """One source: largest horizontal errors over the run."""

    source: str
    position_linear_m: float
    velocity_linear_m_s: float


def standard_sources(alignment: Alignment | None = None) -> dict[str, Source]:
    """The usual sources, at the size of a good platform. With ``alignment``: the attitude errors have its uncertainties."""
    tilts = np.diag([ARCSEC] * 3 if alignment is None else alignment.std[:3])
    drifts, biases = np.eye(3) * np.radians(1e-5) / 3600.0, np.eye(3) * 1e-6 * G0
    return {
        **{f"triad attitude {axis}": {"attitude": one} for axis, one in zip("xyz", tilts, strict=True)},
        **{f"drift {axis}, 1e-5 deg/h": {"drift": one} for axis, one in zip("xyz", drifts, strict=True)},
        **{f"accelerometer bias {axis}, 1 ug": {"bias": one} for axis, one in zip("xyz", biases, strict=True)},
        "reference height, 10 m": {"height": 10.0},
        "start position north, 10 m": {"position": (10.0, 0.0, 0.0)},
        "start velocity east, 1 mm/s": {"velocity": (0.0, 1e-3, 0.0)},
    }


def error_budget(scenario: PlatformScenario, sources: Mapping[str, Source]) -> tuple[BudgetRow, ...]:
    """Each source alone, then all together, over the length of the scenario, on a base at rest.

    A source is put into a navigation of perfect gyros and sensors. Its error is the difference to that without it. These errors
    are small and add.
    """
    step = max(1, round(_BUDGET_STEP / scenario.step)) * scenario.step
    run = simulate(
        PlatformScenario(scenario.place, scenario.duration, step, damping_time=scenario.damping_time)
    )
    unmoved = _horizontal(run, {})
    tables = {name: _horizontal(run, source) - unmoved for name, source in sources.items()}
    tables["all together"] = np.sum(list(tables.values()), axis=0)
    largest = {name: np.hypot(*table).max(axis=1).tolist() for name, table in tables.items()}
    return tuple(BudgetRow(name, *pair) for name, pair in largest.items())


_BUDGET_STEP = 2.0
"""Step of the navigations for the error budget [s], or the scenario's step if that is longer."""


def _horizontal(run: PlatformRun, source: Source) -> Array:
    """Errors (2, 2, n) north and east, of position [m] and velocity [m/s], of a navigation with this error."""
    none: dict[str, ArrayLike] = dict.fromkeys(
        ("attitude", "drift", "bias", "height", "position", "velocity"), 0.0
    )
    by = {name: np.zeros(3) + np.asarray(value) for name, value in (none | dict(source)).items()}
    readouts, place, start = run.readouts, run.scenario.place, true_start(run.truth)
    axes = local_axes(place.latitude, place.longitude)
    off = axes @ by["position"]
    velocity = start.velocity + axes @ by["velocity"] + np.cross([0.0, 0.0, earth.EARTH_RATE], off)
    triad = rotation_vector_to_matrix(by["attitude"]) @ start.triad
    increments, altitude = (
        readouts.increments + readouts.step * by["bias"],
        readouts.altitude + by["height"][:1],
    )
    moved = replace(readouts, increments=increments, altitude=altitude)
    made, every = compensator("none", true_knowledge(run.scenario), moved), max(1, round(10.0 / readouts.step))
    begun = Start(start.position + off, velocity, triad, by["drift"])
    e = errors(
        navigate(moved, made, begun, damping_time=run.scenario.damping_time, every=every), run.truth, readouts
    )
    return np.array([[e.north, e.velocity[:, 0]], [e.east, e.velocity[:, 1]]])
