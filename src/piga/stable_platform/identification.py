"""Identification of misalignments, phases and harmonics from readouts; batch, recursive, with covariance.

Sources: ``gimbals`` (angles of a static base), ``pick-off`` (redundancy axis), ``force`` (disturbance in
the specific force, any base). Only readouts are seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from piga._kernels.platform_recursion import sequential_factor
from piga.errors import ArgumentError
from piga.stable_platform.estimate import Group, Solution, noise_levels, solve
from piga.stable_platform.geodesy import geodetic_to_earth, specific_force_at_rest
from piga.stable_platform.models import Knowledge
from piga.stable_platform.observation import (
    Tip,
    Unknowns,
    coarse_unknowns,
    exact_platform,
    gimbal_rows,
    misalignment_regressors,
    names,
)
from piga.stable_platform.scenario import Gyro, Place
from piga.stable_platform.simulate import Readouts

Array = NDArray[np.float64]

STATIC_SOURCES = ("gimbals", "pick-off")
MOVING_SOURCES = ("force", "pick-off")


@dataclass(frozen=True)
class Parameter:
    """One identified quantity: value, standard uncertainty [``unit``]."""

    name: str
    value: float
    std: float
    unit: str


@dataclass(frozen=True)
class Identification:
    """Result: the gyros as identified, redundancy angle, covariance of the unknowns, noise, doubts.

    ``names, values, covariance`` are the Cartesian unknowns (misalignments, eta0, eta_rate);
    ``parameters`` the same as amplitudes and phases with first-order uncertainty. ``history`` of the
    recursive form: ``rows`` (k,) [s] and ``values``, ``stds`` (k, p).
    """

    sources: tuple[str, ...]
    polar: Gyro
    equatorial: Gyro
    eta0: float
    eta_rate: float
    names: tuple[str, ...]
    values: Array
    covariance: Array
    noise: dict[str, float]
    rms: dict[str, float]
    degrees_of_freedom: float
    condition: float
    parameters: tuple[Parameter, ...]
    notes: tuple[str, ...] = ()
    history: dict[str, Array] = field(default_factory=dict)

    @property
    def knowledge(self) -> Knowledge:
        """What the compensation models take."""
        return Knowledge(self.polar, self.equatorial, self.eta0, self.eta_rate)

    def __getitem__(self, name: str) -> Parameter:
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise KeyError(f"no parameter '{name}'; there are: {', '.join(p.name for p in self.parameters)}")


def identify(readouts: Readouts, place: Place, *, sources: Sequence[str] = STATIC_SOURCES, orders: int = 3,
             iterations: int = 4) -> Identification:  # fmt: skip
    """Batch identification by weighted Gauss-Newton least squares on the exact geometry.

    Parameters
    ----------
    readouts:
        The calibration stretch; for ``gimbals`` the base must be at rest.
    place:
        Where the base is (its gravity starts the triad attitude) [rad], [m].
    sources:
        Any of ``gimbals``, ``pick-off``, ``force``.
    orders:
        Harmonics of the misalignment over the case turn to identify.
    iterations:
        Gauss-Newton steps; four reach rounding.

    Raises
    ------
    IdentifiabilityError
        If the sources cannot separate the unknowns; the message says which.
    ArgumentError
        If a source is not known, or the record is shorter than two case turns.
    """
    sources = _checked(readouts, sources)
    x, groups, solution = _gauss_newton(readouts, place, sources, orders, iterations)
    return _result(x, groups, solution, sources, orders)


def _gauss_newton(readouts: Readouts, place: Place, sources: tuple[str, ...], orders: int,
                  iterations: int) -> tuple[Unknowns, list[Group], Solution]:  # fmt: skip
    """Converged unknowns, their rows with the noise levels found, and the last solution."""
    x = _start(readouts, place, orders)
    levels: list[float] | None = None
    for _ in range(iterations):
        groups = _groups(readouts, x, sources, levels)
        solution = solve(groups, _named(sources, orders))
        levels = noise_levels(_after(groups, solution.step), len(solution.step))
        x = x.moved(_whole(solution.step, sources, orders))
    groups = _groups(readouts, x, sources, levels)
    solution = solve(groups, _named(sources, orders))
    return x.moved(_whole(solution.step, sources, orders)), _after(groups, solution.step), solution


def identify_recursively(
    readouts: Readouts,
    place: Place,
    *,
    sources: Sequence[str] = STATIC_SOURCES,
    orders: int = 3,
    points: int = 200,
) -> Identification:
    """The same estimate sample by sample, with its history.

    The rows are linearised once about a batch solution over the first quarter of the record (at least four case
    turns) and taken in one by one by square-root (Givens) updates; the end agrees with the batch
    estimate to the second order of what the start was wrong by. ``points`` are kept as history.
    """
    sources = _checked(readouts, sources)
    span = float(readouts.times[-1] - readouts.times[0])
    early = max(4.0 * _case_period(readouts), 0.25 * span)
    x, early_groups, start = _gauss_newton(readouts.first(early), place, sources, orders, 4)
    levels = [g.sigma for g in early_groups]
    groups = _groups(readouts, x, sources, levels)
    count = len(groups[0].residual) // (3 if groups[0].name != "pick-off" else 1)
    rows = np.concatenate([_in_time(g, count) for g in groups], axis=1)
    size = rows.shape[2]
    # A wide prior (1 rad per scaled unknown) keeps the first factors regular without weighing on the result.
    scale = np.sqrt(np.sum(rows[:, :, :-1] ** 2, axis=(0, 1)))
    rows[:, :, :-1] /= scale
    kept = np.unique(np.linspace(count // points + size, count - 1, points).astype(np.int64))
    factors = np.empty((len(kept), size, size))
    sequential_factor(np.ascontiguousarray(rows), 1e-9, kept, factors)
    values, stds = np.empty((len(kept), size - 1)), np.empty((len(kept), size - 1))
    for k, factor in enumerate(factors):
        inverse = np.linalg.inv(factor[:-1, :-1]) / scale[:, None]
        values[k], stds[k] = inverse @ factor[:-1, -1], np.sqrt(np.sum(inverse**2, axis=1))
    step, covariance = values[-1], inverse @ inverse.T
    end = x.moved(_whole(step, sources, orders))
    solution = Solution(step, covariance, start.condition)
    result = _result(end, _groups(readouts, end, sources, levels), solution, sources, orders)
    tips = len(result.names)
    origin = np.concatenate([x.polar.vector, x.equatorial.vector, [x.eta0, x.eta_rate]])[:tips]
    times = readouts.times[np.minimum(kept + 1, len(readouts.times) - 1)]
    history = {"time": times, "values": origin + values[:, :tips], "stds": stds[:, :tips]}
    return replace(result, history=history)


def _checked(readouts: Readouts, sources: Sequence[str]) -> tuple[str, ...]:
    unknown = [s for s in sources if s not in {"gimbals", "pick-off", "force"}]
    if unknown or not sources:
        raise ArgumentError(f"identification: sources {list(sources)!r} must be among gimbals, pick-off, force")
    period = _case_period(readouts)
    span = float(readouts.times[-1] - readouts.times[0])
    if not span >= 2.0 * period:
        raise ArgumentError(
            f"identification needs two turns of the cases ({2.0 * period:g} s), the record has {span:g} s",
            remedy="lengthen [identification] duration, or [compensation] misalignment = 'true'",
        )
    return tuple(sources)


def _case_period(readouts: Readouts) -> float:
    rate = np.abs(np.diff(readouts.encoder1[:3])).max() / readouts.step
    return 2.0 * np.pi / rate if rate > 0.0 else np.inf


def _start(readouts: Readouts, place: Place, orders: int) -> Unknowns:
    force = specific_force_at_rest(geodetic_to_earth(place.latitude, place.longitude, place.height))
    return coarse_unknowns(readouts, force, orders)


def _named(sources: tuple[str, ...], orders: int) -> tuple[str, ...]:
    """Names of the unknowns that the sources together can see."""
    tips, everything = 4 + 4 * orders, names(orders)
    gyros, eta, slow = everything[:tips], everything[tips : tips + 2], everything[tips + 2 :]
    return (*gyros, *(eta if "pick-off" in sources else ()), *(slow if "gimbals" in sources else ()))


def _size(sources: tuple[str, ...], orders: int) -> int:
    tips = 4 + 4 * orders
    return tips + (10 if "gimbals" in sources else 2 if "pick-off" in sources else 0)


def _whole(step: Array, sources: tuple[str, ...], orders: int) -> Array:
    if "gimbals" in sources and "pick-off" not in sources:
        return np.insert(step, 4 + 4 * orders, [0.0, 0.0])
    return step


def _groups(
    readouts: Readouts, x: Unknowns, sources: tuple[str, ...], levels: list[float] | None
) -> list[Group]:
    """Rows of every source, cut to the unknowns that the sources together can see."""
    size = _size(sources, len(x.polar.cosines))
    groups = []
    if "gimbals" in sources:
        residual, regressors, _, _ = gimbal_rows(x, readouts)
        groups.append(Group("gimbals", residual.ravel(), regressors.reshape(-1, regressors.shape[2])))
    if "force" in sources:
        groups.append(disturbance_rows(readouts, x, size))
    if "pick-off" in sources:
        _, ring = exact_platform(x, readouts.times, readouts.encoder1, readouts.encoder2)
        _, pick = misalignment_regressors(x, readouts.times, readouts.encoder1, readouts.encoder2)
        padded = np.zeros((len(ring), size))
        padded[:, : pick.shape[1]] = pick
        groups.append(Group("pick-off", readouts.pickoff - ring, padded))
    if "pick-off" not in sources and "gimbals" in sources:
        tips = 4 + 4 * len(x.polar.cosines)
        groups = [replace(g, regressors=np.delete(g.regressors, [tips, tips + 1], axis=1)) for g in groups]
    return groups if levels is None else [replace(g, sigma=s) for g, s in zip(groups, levels, strict=True)]


def disturbance_rows(readouts: Readouts, x: Unknowns, size: int) -> Group:
    """Rows of the specific-force disturbance, on a base that may move [Hu2010].

    The mean over one case turn of the force, turned back to the triad with what is known so far, stands
    for the undisturbed force; force and regressors alike are smoothed
    over a fifth of a turn (two Hann windows) and freed of that mean, so that motion faster than the cases turn
    and the slow turn of gravity drop out. ``rows`` counts the independent samples left.
    """
    from scipy.signal import oaconvolve

    t = 0.5 * (readouts.times[1:] + readouts.times[:-1])
    encoders = [0.5 * (angle[1:] + angle[:-1]) for angle in (readouts.encoder1, readouts.encoder2)]
    force = readouts.increments / readouts.step
    turn = round(_case_period(readouts) / readouts.step) // 2 * 2 + 1
    box = np.ones(turn)
    if readouts.step * turn > _case_period(readouts):
        box[0] = box[-1] = 0.5
    box /= box.sum()
    hann = np.hanning(max(turn // 10, 3) + 2)[1:-1]
    smooth = np.convolve(hann, hann) / hann.sum() ** 2
    highpass = -box
    middle = turn // 2
    highpass[middle] += 1.0
    band = np.convolve(highpass, smooth)
    attitude, _ = exact_platform(x, t, *encoders)
    undone = np.einsum("nji,nj->ni", attitude, force)
    mean = np.stack([np.convolve(column, box, mode="valid") for column in undone.T], axis=1)
    mean = np.pad(mean, ((middle, middle), (0, 0)), mode="edge")
    predicted = np.einsum("nij,nj->ni", attitude, mean)
    e, _ = misalignment_regressors(x, t, *encoders)
    columns = np.cross(mean[:, :, None], e, axis=1)[:, :, :size]
    stacked = np.concatenate([(force - predicted)[:, :, None], columns], axis=2)
    kept = oaconvolve(stacked[middle : len(t) - middle], band[:, None, None], mode="valid", axes=0)
    gain = float(np.sum(band**2))
    rows = np.ascontiguousarray(kept[:, :, 1:].reshape(-1, kept.shape[2] - 1))
    if rows.shape[1] < size:
        rows = np.pad(rows, ((0, 0), (0, size - rows.shape[1])))
    return Group("force", kept[:, :, 0].ravel(), rows, rows=rows.shape[0] * gain)


def _after(groups: Sequence[Group], step: Array) -> list[Group]:
    return [replace(g, residual=g.residual - g.regressors @ step) for g in groups]


def _in_time(group: Group, count: int) -> Array:
    """Weighted rows of a group as (time, rows per instant, p + 1); groups of one more instant lose the last."""
    table = np.column_stack([group.regressors, group.residual]) / group.sigma
    per = 1 if group.name == "pick-off" else 3
    return table[: count * per].reshape(count, per, -1)


def _result(x: Unknowns, groups: Sequence[Group], solution: Solution, sources: tuple[str, ...],
            orders: int) -> Identification:  # fmt: skip
    tips = 4 + 4 * orders
    known = tips + (2 if "pick-off" in sources else 0)
    vector = np.concatenate([x.polar.vector, x.equatorial.vector, [x.eta0, x.eta_rate]])[:known]
    covariance = solution.covariance
    block = covariance[:known, :known]
    freedom = sum(g.count() for g in groups) - len(covariance)
    return Identification(
        sources=sources,
        polar=x.polar.gyro(),
        equatorial=x.equatorial.gyro(),
        eta0=x.eta0,
        eta_rate=x.eta_rate,
        names=names(orders)[:known],
        values=vector,
        covariance=block,
        noise={g.name: g.sigma for g in groups},
        rms={g.name: float(np.sqrt(np.mean(g.residual**2))) for g in groups},
        degrees_of_freedom=freedom,
        condition=solution.condition,
        parameters=_parameters(vector, block, orders, known > tips),
        notes=_notes(vector, block, orders),
    )


def _parameters(vector: Array, covariance: Array, orders: int, with_eta: bool) -> tuple[Parameter, ...]:
    """Amplitudes and phases with first-order uncertainty (central differences of the exact conversion)."""
    labels = _labels(orders)

    def converted(v: Array) -> Array:
        half = 2 + 2 * orders
        out = []
        for part in (v[:half], v[half : 2 * half]):
            gyro = Tip.from_vector(part).gyro()
            out += [gyro.misalignment, gyro.phase]
            out += [number for h in gyro.harmonics for number in (h.amplitude, h.phase)]
        return np.array(out)

    tips = 4 + 4 * orders
    values, jacobian = converted(vector), np.empty((tips, tips))
    for k in range(tips):
        step = np.zeros(len(vector))
        step[k] = max(1e-4 * np.sqrt(covariance[k, k]), 1e-13)
        difference = converted(vector + step) - converted(vector - step)
        jacobian[:, k] = np.where(labels_are_angles(labels), _wrapped(difference), difference) / (2.0 * step[k])
    stds = np.sqrt(np.einsum("ij,jk,ik->i", jacobian, covariance[:tips, :tips], jacobian))
    found = [Parameter(n, float(v), float(s), "rad") for n, v, s in zip(labels, values, stds, strict=True)]
    if with_eta:
        std = np.sqrt(np.diag(covariance))
        found.append(Parameter("redundancy.initial", float(vector[tips]), float(std[tips]), "rad"))
        found.append(Parameter("redundancy.rate", float(vector[tips + 1]), float(std[tips + 1]), "rad/s"))
    return tuple(found)


def _labels(orders: int) -> list[str]:
    labels = []
    for gyro in ("polar", "equatorial"):
        labels += [f"{gyro}.misalignment", f"{gyro}.phase"]
        labels += [
            f"{gyro}.harmonic{k}.{what}" for k in range(1, orders + 1) for what in ("amplitude", "phase")
        ]
    return labels


def labels_are_angles(labels: Sequence[str]) -> NDArray[np.bool_]:
    """Which of the parameter names are phases (to be compared modulo a turn)."""
    return np.array([name.endswith("phase") for name in labels])


def _wrapped(angle: Array) -> Array:
    return np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi


def _notes(vector: Array, covariance: Array, orders: int) -> tuple[str, ...]:
    notes = []
    half, std = 2 + 2 * orders, np.sqrt(np.diag(covariance))
    for start, gyro in ((0, "polar"), (half, "equatorial")):
        if np.hypot(vector[start], vector[start + 1]) < 3.0 * std[start : start + 2].max():
            notes.append(
                f"{gyro}: the misalignment is below three times its uncertainty; its phase means nothing"
            )
        for k in range(1, orders + 1):
            at = start + 2 * k
            if np.hypot(vector[at], vector[at + 1]) < 3.0 * std[at : at + 2].max():
                notes.append(f"{gyro}: harmonic {k} is below three times its uncertainty")
    return tuple(notes)
