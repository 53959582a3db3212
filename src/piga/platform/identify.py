"""Identification of misalignments, phases and harmonics from readouts, with covariance.

Sources: ``gimbals`` (angles of a static base), ``pick-off`` (redundancy axis), ``force`` (disturbance in
the specific force, any base). Only readouts are used. :func:`observability` states, before any estimate, which
unknowns each source can determine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from piga import earth
from piga.errors import IdentifiabilityError
from piga.platform.geometry import wrapped
from piga.platform.navigator import Knowledge
from piga.platform.observation import STATIC_SOURCES, ObservedRecord, Reduced, Tip, Unknowns
from piga.platform.scenario import Gyro, Place
from piga.platform.simulate import Readouts
from piga.progress import Progress, report
from piga.results import Array, Plotted, Result, finite
from piga.threads import one_thread
from piga.units import ARCSEC
from piga.upper import doors

if TYPE_CHECKING:
    from piga.reports.render.figure import Figure

_SMALLEST_SIGMA = 1e-12
"""Smallest noise level of a group. It avoids division by zero for a record without noise."""
_SETTLED = 0.01
"""The iteration ends if the step is below this share of the standard uncertainties."""
UNKNOWN_PHASE = float(np.pi / np.sqrt(3.0))
"""Standard uncertainty [rad] of an unknown phase (uniform over a turn)."""


@dataclass(frozen=True, eq=False, repr=False)
class LeastSquares(Result):
    """A least-squares step (p,), its covariance (p, p), the condition of the scaled problem, noise levels."""

    step: Array
    covariance: Array
    condition: float
    levels: tuple[float, ...]

    def by_source(self, parts: Sequence[Reduced]) -> tuple[dict[str, float], dict[str, float]]:
        """Noise level of each group, and the root mean square of its residuals after the step."""
        noise = {part.name: level for part, level in zip(parts, self.levels, strict=True)}
        return noise, {part.name: float(np.sqrt(part.squares(self.step) / part.rows)) for part in parts}


def solve(parts: Sequence[Reduced], levels: Sequence[float], names: Sequence[str]) -> LeastSquares:
    """Weighted least squares with the noise ``levels`` (standard deviations) of the groups.

    Raises
    ------
    IdentifiabilityError
        If a combination of unknowns cannot be determined from the rows. The message names it.
    """
    p = len(names)
    stacked = np.concatenate([part.factor / level for part, level in zip(parts, levels, strict=True)])
    factor: Array = np.linalg.qr(stacked, mode="r")  # type: ignore[assignment]
    norms = np.linalg.norm(factor[:p, :p], axis=0)
    norms[norms == 0.0] = 1.0
    left, values, right = np.linalg.svd(factor[:p, :p] / norms)
    if values[-1] < 1e-11 * values[0]:
        raise IdentifiabilityError(
            f"the record cannot tell apart: {in_words(right[-1], names)}",
            remedy="use another source of observation, a longer record or unequal case speeds",
        )
    inverse = (right.T / values) @ left.T / norms[:, None]
    condition = float(values[0] / values[-1])
    return LeastSquares(inverse @ factor[:p, p], inverse @ inverse.T, condition, tuple(levels))


def solve_with_noise(parts: Sequence[Reduced], names: Sequence[str]) -> LeastSquares:
    """Weighted least squares with noise levels estimated from the residuals of the same rows.

    Each group loses the degrees of freedom that its rows gave to the estimate: the sum of their leverages,
    ``trace(J C J') / sigma^2``.
    """
    levels = [max(float(np.linalg.norm(p.factor[:, -1]) / np.sqrt(p.rows)), _SMALLEST_SIGMA) for p in parts]
    solution, settled = solve(parts, levels, names), False
    for _ in range(20):
        levels = []
        for part, level in zip(parts, solution.levels, strict=True):
            rows = part.factor[:, :-1] / level
            freedom = max(part.rows - float(np.sum((rows @ solution.covariance) * rows)), 1.0)
            levels.append(max(float(np.sqrt(part.squares(solution.step) / freedom)), _SMALLEST_SIGMA))
        settled = np.allclose(levels, solution.levels, rtol=1e-4, atol=0.0)
        solution = solve(parts, levels, names)
        if settled:
            break
    return solution


def in_words(direction: Array, names: Sequence[str]) -> str:
    """The unknowns with the largest share in a singular direction, e.g. ``polar.u + equatorial.v``."""
    order = np.argsort(-np.abs(direction))
    chosen = [k for k in order if abs(direction[k]) > 0.25 * abs(direction[order[0]])][:4]
    return ", ".join(names[k] for k in sorted(chosen))


def gauss_newton(
    record: ObservedRecord, x: Unknowns, steps: int, progress: Progress | None, settled: float = _SETTLED
) -> tuple[Unknowns, list[Reduced], LeastSquares]:
    """Converged unknowns, the rows about the last ones but one, and the last step with its covariance."""
    for k in range(max(steps, 1)):
        report(progress, k, steps, f"step {k + 1} of at most {steps}")
        parts = record.groups(x)
        solution = solve_with_noise(parts, record.names)
        x = record.moved(x, solution.step)
        if np.all(np.abs(solution.step) < settled * np.sqrt(np.diag(solution.covariance))):
            break
    return x, parts, solution


@dataclass(frozen=True)
class Parameter:
    """One identified quantity: value, standard uncertainty [``unit``]."""

    name: str
    value: float
    std: float
    unit: str


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Result):
    """Result: the gyros as identified, redundancy angle, covariance of the unknowns, noise, doubts.

    ``names, values, covariance`` are the Cartesian unknowns (misalignments, eta0, eta_rate);
    ``parameters`` the same as amplitudes and phases with first-order uncertainty.
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

    def in_brief(self) -> list[tuple[str, str]]:
        """The parameters with their standard uncertainties, and the doubts."""
        rows = [(p.name, f"{p.value:.6g} +- {p.std:.2g} {p.unit}") for p in self.parameters]
        return [("sources", ", ".join(self.sources)), *rows, *(("note", note) for note in self.notes)]

    @property
    def knowledge(self) -> Knowledge:
        """The knowledge that the compensation models use."""
        return Knowledge(self.polar, self.equatorial, self.eta0, self.eta_rate)

    def __getitem__(self, name: str) -> Parameter:
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise KeyError(f"no parameter '{name}'; there are: {', '.join(p.name for p in self.parameters)}")


@one_thread()
def identify(readouts: Readouts, place: Place, *, sources: Sequence[str] = STATIC_SOURCES, orders: int = 3,
             iterations: int = 6, progress: Progress | None = None) -> Identification:  # fmt: skip
    """Batch identification by weighted Gauss-Newton least squares on the exact geometry.

    ``readouts`` are the calibration stretch; for ``gimbals`` the base must be at rest. ``place`` of the base: its gravity
    gives the first triad attitude. ``sources``: any of ``gimbals``, ``pick-off``, ``force``. ``orders``: harmonics of the
    misalignment over the case turn to identify. ``iterations``: largest number of steps; the iteration ends earlier if it
    has converged. ``progress`` is called as ``progress(done, total, what)`` before each step; it returns False to stop
    (:mod:`piga.progress`).

    Raises
    ------
    IdentifiabilityError
        If the sources cannot separate the unknowns. The message names them.
    ArgumentError
        If a source is not known, the record is shorter than two case turns, or (for ``force``) has fewer than
        20 samples a turn.
    """
    record = ObservedRecord.checked(readouts, place, sources, orders)
    x, parts, solution = gauss_newton(record, record.coarse(), iterations, progress)
    count = 4 + 4 * orders + (2 if "pick-off" in sources else 0)
    values = np.concatenate([x.polar.vector, x.equatorial.vector, [x.eta0, x.eta_rate]])[:count]
    covariance = solution.covariance[:count, :count]
    noise, rms = solution.by_source(parts)
    return Identification(
        sources=record.sources,
        polar=x.polar.gyro(),
        equatorial=x.equatorial.gyro(),
        eta0=x.eta0,
        eta_rate=x.eta_rate,
        names=record.names[:count],
        values=values,
        covariance=covariance,
        noise=noise,
        rms=rms,
        degrees_of_freedom=sum(part.rows for part in parts) - len(solution.covariance),
        condition=solution.condition,
        parameters=_parameters(values, covariance, orders),
        notes=_notes(values, covariance),
    )


def _amplitudes(tips: Array) -> dict[str, float]:
    """Amplitude and phase of the fundamental and of each harmonic, of both gyros, from their unknowns."""
    values: dict[str, float] = {}
    for name, vector in zip(("polar", "equatorial"), np.split(tips, 2), strict=True):
        gyro = Tip(vector).gyro()
        values |= {f"{name}.misalignment": gyro.misalignment, f"{name}.phase": gyro.phase}
        for k, amplitude, phase in gyro.harmonics:
            values |= {f"{name}.harmonic{k}.amplitude": amplitude, f"{name}.harmonic{k}.phase": phase}
    return values


def _parameters(values: Array, covariance: Array, orders: int) -> tuple[Parameter, ...]:
    """Amplitudes and phases with first-order uncertainty (central differences of the exact conversion)."""
    count, std = 4 + 4 * orders, np.sqrt(np.diag(covariance))
    tips, rest = values[:count], zip(values[count:].tolist(), std[count:].tolist(), strict=True)
    found = _amplitudes(tips)
    phases, jacobian = np.array([name.endswith("phase") for name in found]), np.empty((count, count))
    for k, size in enumerate(np.maximum(1e-4 * std[:count], 1e-13)):
        step = size * (np.arange(count) == k)
        ahead, behind = (np.array(list(_amplitudes(at).values())) for at in (tips + step, tips - step))
        jacobian[:, k] = np.where(phases, wrapped(ahead - behind), ahead - behind) / (2.0 * size)
    stds = np.sqrt(np.einsum("ij,jk,ik->i", jacobian, covariance[:count, :count], jacobian))
    stds = np.where(phases, np.minimum(stds, UNKNOWN_PHASE), stds)
    rows = [Parameter(*row, "rad") for row in zip(found, found.values(), stds.tolist(), strict=True)]
    redundancy = zip((("redundancy.initial", "rad"), ("redundancy.rate", "rad/s")), rest, strict=False)
    return (*rows, *(Parameter(name, value, u, unit) for (name, unit), (value, u) in redundancy))


def _notes(values: Array, covariance: Array) -> tuple[str, ...]:
    """Misalignments and harmonics that are below three times their uncertainty."""
    notes = []
    pairs, stds = (v[: len(v) // 4 * 4].reshape(2, -1, 2) for v in (values, np.sqrt(np.diag(covariance))))
    small = np.hypot(pairs[..., 0], pairs[..., 1]) < 3.0 * stds.max(axis=2)
    for gyro, (fundamental, *harmonics) in zip(("polar", "equatorial"), small.tolist(), strict=True):
        which = ", ".join(str(k) for k, below in enumerate(harmonics, start=1) if below)
        if fundamental:
            notes.append(
                f"{gyro}: the misalignment is below three times its uncertainty; its phase means nothing"
            )
        if which:
            notes.append(
                f"{gyro}: harmonics below three times their uncertainty, whose phases mean nothing: {which}"
            )
    return tuple(notes)


@dataclass(frozen=True, eq=False, repr=False)
class GrowingIdentification(Result, Plotted):
    """Identifications of growing parts of one record. The last part is the whole record.

    ``times`` (k,) [s] are the ends of the parts. The plot shows the misalignments against time.
    """

    times: Array
    parts: tuple[Identification, ...]

    @property
    def values(self) -> Array:
        """Unknowns (k, p) in the order of ``names`` of an identification."""
        return np.array([part.values for part in self.parts])

    @property
    def stds(self) -> Array:
        """Standard uncertainties (k, p) of the unknowns."""
        return np.array([np.sqrt(np.diag(part.covariance)) for part in self.parts])

    def figure(self) -> Figure:
        """Estimates against the length of the record."""
        return doors().platform_figures().convergence_figure(self)

    def in_brief(self) -> list[tuple[str, str]]:
        """The result of the whole record."""
        return self.parts[-1].in_brief()


def identify_growing(
    readouts: Readouts,
    place: Place,
    *,
    sources: Sequence[str] = STATIC_SOURCES,
    orders: int = 3,
    count: int = 12,
    progress: Progress | None = None,
) -> GrowingIdentification:
    """Identify from ``count`` growing parts of a record. The shortest part has four turns of the slower case.

    The other arguments and the errors are those of :func:`identify`.
    """
    record = ObservedRecord.checked(readouts, place, sources, orders)
    start, end = float(readouts.times[0]), float(readouts.times[-1])
    shortest = min(4.0 * record.periods[1], end - start)
    times, parts = start + np.linspace(shortest, end - start, count), []
    for k, time in enumerate(times):
        report(progress, k, count, f"part {k + 1} of {count}")
        parts.append(identify(readouts.first(float(time) - start), place, sources=sources, orders=orders))
    return GrowingIdentification(times, tuple(parts))


UNKNOWNS = ("polar.u", "polar.v", "equatorial.u", "equatorial.v")
_OBSERVED = {
    "gimbals, z only": "z",
    "redundancy-axis pick-off only": "Y",
    "gimbals, x and y": "xy",
    "gimbals, z, with pick-off": "zY",
    "gimbals, all": "xyz",
    "gimbals with pick-off": "xyzY",
    "specific force": "123",
    "specific force with pick-off": "123Y",
}
"""Small angles, pick-off and axes of the specific force that each source observes."""
_SEPARABLE = 100.0
"""Condition number above which unknowns count as not separable: their uncertainty has grown a hundredfold."""


@dataclass(frozen=True, eq=False, repr=False)
class Observability(Result):
    """One source: condition number, standard uncertainty (4,) [rad] of :data:`UNKNOWNS`, and a sentence.

    ``std`` is for white noise of one arc-second on every reading (infinite: not observable). For the specific
    force this is one arc-second of its direction, 48 um/s^2.
    """

    source: str
    condition: float
    std: Array
    separable: bool
    sentence: str


@one_thread()
def observability(readouts: Readouts, identification: Identification) -> tuple[Observability, ...]:
    """Observability of the two misalignments from each source alone and together.

    ``identification`` gives the redundancy angle. If both cases turn at one speed, the z angle alone contains
    ``m2 sin(c2) - m1 tan(eta) cos(c1)`` as one line, and the pick-off alone ``m2 cos(c2) - m1 sin(c1)``. Each then
    leaves two of the four unknowns undetermined.
    """
    every = max(1, len(readouts.times) // 4000)
    t, *encoders = (v[::every] for v in (readouts.times, readouts.encoder1, readouts.encoder2))
    i, turns = identification, (np.eye(3), np.zeros(3), np.eye(3))
    x = Unknowns(Tip.of(i.polar, 0), Tip.of(i.equatorial, 0), i.eta0, i.eta_rate, *turns)
    e, pick = x.regressors(t, *encoders)
    # the direction of gravity in the triad: a cone about the Earth's axis
    angle = earth.EARTH_RATE * readouts.times
    cone = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=1)
    gravity = cone @ np.linalg.lstsq(0.5 * (cone[1:] + cone[:-1]), readouts.increments, rcond=None)[0]
    gravity /= np.linalg.norm(gravity, axis=1, keepdims=True)
    felt = np.cross(gravity[::every, :, None], e, axis=1)
    table = [*(e[:, k] for k in range(3)), pick, *(felt[:, k] for k in range(3))]
    rows = dict(zip("xyzY123", (one[:, :4] for one in table), strict=True))
    equal = np.allclose(np.diff(encoders[0][:64]), np.diff(encoders[1][:64]))
    basis, _ = np.linalg.qr(np.stack([np.ones_like(t), t / t[-1]], axis=1))
    verdicts = []
    for source, keys in _OBSERVED.items():
        clean = np.concatenate([rows[k] - basis @ (basis.T @ rows[k]) for k in keys])
        _, values, right = np.linalg.svd(clean, full_matrices=False)
        condition = float(values[0] / values[-1]) if values[-1] > 0.0 else np.inf
        scatter = right.T / np.where(values > 0.0, values, np.nan) * (np.sqrt(every) * ARCSEC)
        std = np.nan_to_num(np.sqrt(np.sum(scatter**2, axis=1)), nan=np.inf)
        separable, hidden = condition < _SEPARABLE, right[values < values[0] / _SEPARABLE]
        sentence = "tells both misalignments and both phases" if separable else _mixed(hidden, clean, equal)
        verdicts.append(Observability(source, condition, std, separable, sentence))
    return tuple(verdicts)


def _mixed(hidden: Array, clean: Array, equal: bool) -> str:
    """The unknowns that a source leaves undetermined, and what to do; ``equal``: both cases turn at one speed."""
    unseen = [n for n, column in zip(UNKNOWNS, clean.T, strict=True) if not column.any()]
    if unseen:
        return f"does not see {', '.join(unseen)} at all; add the z axis or the pick-off"
    mixed = "; ".join(in_words(direction, UNKNOWNS) for direction in hidden)
    why = ": both cases turn at one speed, so that the two lines coincide" if equal else ""
    cure = ", or turn the cases at unequal speeds" if equal else ""
    return f"cannot tell apart {mixed}{why}; add the other gimbal axes or the pick-off{cure}"


def identification_document(identification: Identification, sources: Sequence[Observability]) -> dict[str, Any]:
    """JSON document of ``piga platform identify``."""
    names = ("sources", "parameters", "noise", "degrees_of_freedom", "condition", "notes")
    document = {name: getattr(identification, name) for name in names}
    document["covariance"] = {
        "names": identification.names,
        "values": identification.values.tolist(),
        "matrix": identification.covariance.tolist(),
    }
    document["observability"] = [
        {
            "source": o.source,
            "condition": finite(o.condition),
            "std_rad": {n: (v if v < 1.0 else None) for n, v in zip(UNKNOWNS, o.std.tolist(), strict=True)},
            "separable": o.separable,
            "verdict": o.sentence,
        }
        for o in sources
    ]
    return dict(msgspec.to_builtins(document))
