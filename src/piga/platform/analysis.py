"""Analysis for the comparison of models: lines per day, and the closed-form theory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from piga import earth
from piga.platform.geometry import gravity, misalignment
from piga.platform.navigator import Errors, Knowledge, true_knowledge
from piga.platform.scenario import Gyro, Model, PlatformScenario
from piga.results import Array, Result
from piga.units import DAY

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


def line_amplitudes(times: Array, values: Array, rate: float, latitude: float) -> Array:
    """Amplitude at angular rate ``rate`` [rad/s] in each column of ``values`` (n, k) over ``times`` (n,) [s].

    As :func:`fitted_lines` of one rate.
    """
    return fitted_lines(times, values, (rate,), latitude)[0]


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
        [2.0 * abs(apart - earth.EARTH_RATE) * stretch] if stretch > _NEIGHBOURS else []
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
    others = [2.0 * rate for rate in rates] + [_SCHULER]
    if len(rates) == 2:
        others += [rates[0] + rates[1], abs(rates[0] - rates[1])]
    if n * step > _NEIGHBOURS:
        others += [polar - earth.EARTH_RATE, polar + earth.EARTH_RATE] if polar > 0.0 else []
        others += [_SCHULER - foucault, _SCHULER + foucault]
    beat = 2.0 * np.pi / (n * step)
    if len(rates) == 2:
        others = [w for w in others if min(abs(w - rate) for rate in rates) > 0.49 * beat]
    waves = [f(w * t) for w in (*rates, *others) for f in (np.cos, np.sin)]
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
    """Rows of each day of the run (1-based days; the last may be shorter)."""
    days = int(np.ceil((times[-1] - 1e-6) / DAY))
    edges = np.searchsorted(times, np.arange(days + 1) * DAY + 1e-6)
    edges[0] = 0
    return [slice(a, b) for a, b in pairwise(edges.tolist()) if b - a > 24]


def case_rates(scenario: PlatformScenario) -> tuple[float, ...]:
    """Angular rates [rad/s] at which lines are followed: one where both cases turn alike, else polar and equatorial.

    If both cases rest, a period of eight minutes is used, for comparison with rotating cases.
    """
    polar, equatorial = scenario.polar_rotation.rate, scenario.equatorial_rotation.rate
    if abs(polar - equatorial) <= _ALIKE * polar:
        return (polar or 2.0 * np.pi / 480.0,)
    return polar, equatorial


def has_theory(scenario: PlatformScenario) -> bool:
    """True if :func:`theory_lines` holds: the base stays at its place, and a case turns without reversals."""
    turning = max(scenario.polar_rotation.rate, scenario.equatorial_rotation.rate) > 0.0
    return scenario.motion.kind != "track" and turning and scenario.polar_rotation.turns == 0


def theory_note(scenario: PlatformScenario) -> str:
    """The reason why the lines are shown without theory, or without that of roll and pitch; else empty."""
    if scenario.polar_rotation.turns != 0:
        return "the cases reverse: the closed form of the lines does not hold, and no theory is shown"
    if scenario.motion.kind == "track":
        return "the base changes its place: the closed form of the lines does not hold, and no theory is shown"
    turns = "the base turns: its roll and pitch have no line at the case rate, and no theory of them is shown"
    return turns if scenario.motion.kind == "turn" else ""


def lines_note(scenario: PlatformScenario) -> str:
    """The reason why a day gives no amplitudes although both cases turn; empty if it gives them."""
    rates, stretch = case_rates(scenario), min(scenario.duration, DAY)
    if separable(rates, stretch):
        return ""
    periods = " and ".join(f"{2.0 * np.pi / rate:.6g} s" for rate in rates)
    apart = 2.0 * np.pi / stretch + (2.0 * earth.EARTH_RATE if stretch > _NEIGHBOURS else 0.0)
    wanted = 2.0 * np.pi / max(rates[0] - apart, 0.5 * rates[0])
    return (
        f"the lines of the two cases ({periods}) cannot be told apart within {stretch / 3600.0:g} h: no amplitudes; "
        f"give both cases one period, or the equatorial one {wanted:.4g} s or more"
    )


def daily_lines(errors: Errors, rates: float | tuple[float, ...], latitude: float) -> Lines:
    """Line amplitudes of every channel, day by day, at the case ``rates`` [rad/s] (one, or polar and equatorial)."""
    rates = rates if isinstance(rates, tuple) else (rates,)
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
    turn = turn * rate**2 / (rate**2 - _SCHULER**2)
    east = gravity(latitude, scenario.place.height) * turn * np.cos(latitude) / rate
    level = turn * np.cos(latitude) * (np.nan if scenario.motion.kind == "turn" else 1.0)
    return {
        "east_velocity": east,
        "north_velocity": east * 2.0 * earth.EARTH_RATE * np.sin(latitude) * rate / (rate**2 - _SCHULER**2),
        "heading": turn * np.sin(latitude),
        "roll": level * abs(np.cos(heading)),
        "pitch": level * abs(np.sin(heading)),
    }


def _left_about_pole(
    scenario: PlatformScenario, model: Model, knowledge: Knowledge, time: float, rates: tuple[float, ...]
) -> list[float]:
    """Amplitudes [rad] at the case ``rates`` [rad/s] of the z angle that the model leaves at ``time``: order one of each case."""
    truth = true_knowledge(scenario)
    eta = truth.eta0 + truth.eta_rate * time
    left = _about_pole(truth.polar, truth.equatorial, eta)
    if model != "none":
        polar, equatorial = knowledge.polar, knowledge.equatorial
        if model != "C":
            polar, equatorial = (Gyro(g.misalignment, g.phase) for g in (polar, equatorial))
        left = left - _about_pole(polar, equatorial, knowledge.eta0 if model == "A" else eta)
    lines = np.fft.fft(left)[:, 1] / 128.0
    return np.abs(lines if len(rates) == 2 else [lines.sum()]).tolist()


def _about_pole(polar: Gyro, equatorial: Gyro, eta: float) -> Array:
    """What each gyro gives to the z angle [rad] over a turn of its case: (2, 256)."""
    angle = (2.0 * np.pi / 256) * np.arange(256, dtype=np.float64)
    c1, c2 = angle + polar.phase, angle + equatorial.phase
    first = -misalignment(polar, c1) * np.cos(c1) * np.tan(eta)
    return np.stack([first, misalignment(equatorial, c2) * np.sin(c2) / np.cos(eta)])
