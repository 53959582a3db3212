"""What the comparison of models looks at: lines per day, spectra, and the closed-form theory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from piga import earth
from piga.stable_platform.geodesy import gravity
from piga.stable_platform.geometry import misalignment
from piga.stable_platform.models import Compensator, Knowledge
from piga.stable_platform.navigation import Errors
from piga.stable_platform.scenario import Gyro, Scenario

Array = NDArray[np.float64]

DAY = 86400.0
CHANNELS = ("east_velocity", "north_velocity", "heading", "roll", "pitch")
_SCHULER = float(np.sqrt(earth.GM / earth.SEMI_MAJOR_AXIS**3))


def channels(errors: Errors) -> dict[str, Array]:
    """The error channels whose lines are followed: velocities [m/s], attitude [rad]."""
    return {
        "east_velocity": errors.velocity[:, 1],
        "north_velocity": errors.velocity[:, 0],
        "heading": errors.attitude[:, 2],
        "roll": errors.attitude[:, 0],
        "pitch": errors.attitude[:, 1],
    }


def line_amplitudes(times: Array, values: Array, rate: float, latitude: float) -> Array:
    """Amplitude at angular rate ``rate`` [rad/s] in each column of ``values`` (n, k) over ``times`` (n,) [s].

    Fitted together with what else is known to be there: the growth of the line over the stretch, its
    neighbours at ``rate +- Earth rate`` (on stretches of half a day and more), twice the rate, the
    Schuler oscillation with its Foucault split, and a cubic. The amplitude is that at mid-stretch.
    """
    n = len(times)
    scaled, gram, norms = _line_design(n, float(times[-1] - times[0]) / (n - 1), rate, latitude)
    solution = np.linalg.lstsq(gram, scaled.T @ (values - values.mean(axis=0)), rcond=1e-12)[0]
    return np.hypot(solution[0] / norms[0], solution[1] / norms[1])


@lru_cache(maxsize=4)
def _line_design(n: int, step: float, rate: float, latitude: float) -> tuple[Array, Array, Array]:
    """Scaled regressors, their Gram matrix and their norms for ``n`` samples about mid-stretch."""
    t = (np.arange(n) - 0.5 * (n - 1)) * step
    x = t / max(t[-1], 1.0)
    foucault = earth.EARTH_RATE * np.sin(latitude)
    rates = [rate, 2.0 * rate, _SCHULER]
    if n * step > 0.5 * DAY:
        rates += [rate - earth.EARTH_RATE, rate + earth.EARTH_RATE, _SCHULER - foucault, _SCHULER + foucault]
    waves = [f(w * t) for w in rates for f in (np.cos, np.sin)]
    design = np.stack([*waves, x * waves[0], x * waves[1], np.ones_like(x), x, x * x, x**3], axis=1)
    norms = np.linalg.norm(design, axis=0)
    design /= norms
    return design, design.T @ design, norms


@dataclass(frozen=True)
class Lines:
    """Amplitudes at the case-rotation period per day: ``amplitude[channel]`` (days,), SI; position error [m].

    ``position`` is the largest horizontal position error of each day.
    """

    day: NDArray[np.int64]
    amplitude: Mapping[str, Array]
    position: Array


def day_slices(times: Array) -> list[slice]:
    """Rows of each day of the run (1-based days; the last may be shorter)."""
    days = int(np.ceil((times[-1] - 1e-6) / DAY))
    edges = np.searchsorted(times, np.arange(days + 1) * DAY + 1e-6)
    edges[0] = 0
    return [slice(a, b) for a, b in pairwise(edges.tolist()) if b - a > 24]


def daily_lines(errors: Errors, rate: float, latitude: float) -> Lines:
    """Line amplitudes of every channel, day by day."""
    named = channels(errors)
    table = np.stack([named[name] for name in CHANNELS], axis=1)
    parts = day_slices(errors.times)
    alike = {part.stop - part.start for part in parts}
    rows = []
    for length in alike:
        group = [part for part in parts if part.stop - part.start == length]
        values = np.concatenate([table[part] for part in group], axis=1)
        fitted = line_amplitudes(errors.times[group[0]], values, rate, latitude).reshape(
            len(group), len(CHANNELS)
        )
        rows += list(zip((parts.index(part) for part in group), fitted, strict=True))
    amplitude = np.array([fitted for _, fitted in sorted(rows, key=lambda row: row[0])])
    horizontal = errors.horizontal
    position = np.array([horizontal[part].max() for part in parts])
    return Lines(
        np.arange(1, len(parts) + 1), {name: amplitude[:, k] for k, name in enumerate(CHANNELS)}, position
    )


def theory_lines(
    scenario: Scenario, compensator: Compensator, known: Knowledge, days: list[slice], times: Array
) -> Lines:
    """Closed-form line amplitudes of a static base, day by day (redundancy angle at mid-day) [He2014].

    The turn about the polar axis that the model leaves, ``d_r(c)``, has amplitude D at one cycle per
    case turn, and ``S = w_c^2 / (w_c^2 - w_s^2)`` with the Schuler rate w_s. Then east velocity
    ``g D S cos(L) / w_c``, north velocity by the Coriolis coupling ``2 Omega sin(L) S / w_c`` of it, heading
    ``D S sin(L)``, roll ``D S cos(L) cos(heading)``, pitch ``D S cos(L) sin(heading)``. The literature
    gives heading and roll without S; the longitude error, which turns the local axes about the same
    pole, adds it (docs/platform.md section 8). Position is not predicted (NaN).
    """
    latitude, rate = scenario.place.latitude, scenario.polar_rotation.rate
    left = np.array(
        [
            _left_about_pole(scenario, compensator, known, 0.5 * float(times[d.start] + times[d.stop - 1]))
            for d in days
        ]
    )
    force = gravity(latitude, scenario.place.height)
    left = left * rate**2 / (rate**2 - _SCHULER**2)
    east = force * left * np.cos(latitude) / rate
    level = left * np.cos(latitude)
    amplitude = {
        "east_velocity": east,
        "north_velocity": east * 2.0 * earth.EARTH_RATE * np.sin(latitude) * rate / (rate**2 - _SCHULER**2),
        "heading": left * np.sin(latitude),
        "roll": level * abs(np.cos(scenario.motion.heading)),
        "pitch": level * abs(np.sin(scenario.motion.heading)),
    }
    return Lines(np.arange(1, len(days) + 1), amplitude, np.full(len(days), np.nan))


def _left_about_pole(scenario: Scenario, compensator: Compensator, known: Knowledge, time: float) -> float:
    """Amplitude [rad] at one cycle per case turn of the z angle that the model leaves at ``time``."""
    drift = scenario.equatorial.drift[0] - scenario.polar.drift[1]
    eta = scenario.redundancy + drift * time
    angle = (2.0 * np.pi / 256) * np.arange(256, dtype=np.float64)
    equal = scenario.polar_rotation == scenario.equatorial_rotation
    second = scenario.equatorial if equal else Gyro()
    left = _about_pole(scenario.polar, second, angle, eta)
    if compensator.model != "none":
        polar, equatorial = known.polar, known.equatorial if equal else Gyro()
        if compensator.model != "C":
            polar, equatorial = (Gyro(g.misalignment, g.phase) for g in (polar, equatorial))
        held = known.eta0 if compensator.model == "A" else eta
        left = left - _about_pole(polar, equatorial, angle, held)
    return float(2.0 * np.abs(np.mean(left * np.exp(-1j * angle))))


def _about_pole(polar: Gyro, equatorial: Gyro, encoder: Array, eta: float) -> Array:
    c1, c2 = encoder + polar.phase, encoder + equatorial.phase
    return misalignment(equatorial, c2) * np.sin(c2) / np.cos(eta) - misalignment(polar, c1) * np.cos(
        c1
    ) * np.tan(eta)


def spectrum(times: Array, values: Array) -> tuple[Array, Array]:
    """Amplitude spectrum (Hann window, mean removed): frequency [Hz], amplitude of a sine there."""
    n = len(times)
    window = np.hanning(n)
    amplitude = 2.0 * np.abs(np.fft.rfft((values - values.mean()) * window)) / window.sum()
    return np.fft.rfftfreq(n, times[1] - times[0]), amplitude
