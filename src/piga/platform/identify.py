"""Identification of misalignments, phases and harmonics from readouts, and alignment, with covariance.

Sources: ``gimbals`` (angles of a static base), ``pick-off`` (redundancy axis), ``force`` (disturbance in
the specific force, any base). Only readouts are used.

Alignment on a static base: gravity describes a cone about the Earth's axis, because the platform keeps its attitude in
inertial space. The gimbal angles follow the base, because the Earth turns it. Together they give the triad's attitude and drift
and the base's attitude. Each observation alone lacks one angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import msgspec
import numpy as np

from piga.errors import IdentifiabilityError
from piga.frames import matrix_to_rotation_vector
from piga.platform.geometry import local_axes, wrapped
from piga.platform.navigator import Knowledge, Start, site_start
from piga.platform.observation import STATIC_SOURCES, ObservedRecord, Reduced, Unknowns, gyro_of, names, tip_of
from piga.platform.scenario import Place
from piga.platform.simulate import Readouts
from piga.progress import Progress, report
from piga.results import Array, Result
from piga.threads import one_thread

_SMALLEST_SIGMA = 1e-12
"""Smallest noise level of a group. It avoids division by zero for a record without noise."""
_NOISE_STEPS = 20
"""Most steps to the noise levels of the groups."""
_STEPS, _ALIGNING_STEPS = 10, 3
"""Most steps of an identification; steps of an alignment."""
_SETTLED = 0.01
"""The iteration ends if the step is below this share of the standard uncertainties."""
UNKNOWN_PHASE = float(np.pi / np.sqrt(3.0))
"""Standard uncertainty [rad] of an unknown phase (uniform over a turn)."""


class LeastSquares(NamedTuple):
    """A least-squares step (p,), its covariance (p, p), the condition of the scaled problem, noise level of each group."""

    step: Array
    covariance: Array
    condition: float
    noise: dict[str, float]
    degrees_of_freedom: float


def solve(parts: Sequence[Reduced], names: Sequence[str]) -> LeastSquares:
    """Weighted least squares with noise levels (standard deviations) of the groups, estimated from the residuals of the same rows.

    Each group loses the degrees of freedom that its rows gave to the estimate: the sum of their leverages,
    ``trace(J C J') / sigma^2``.

    Raises
    ------
    IdentifiabilityError
        If a combination of unknowns cannot be determined from the rows. The message names it.
    """
    p = len(names)
    levels = [float(np.linalg.norm(part.factor[:, -1]) / np.sqrt(part.rows)) for part in parts]
    for _ in range(_NOISE_STEPS):
        used = tuple(max(level, _SMALLEST_SIGMA) for level in levels)
        stacked = np.concatenate([part.factor / level for part, level in zip(parts, used, strict=True)])
        factor: Array = np.linalg.qr(stacked, mode="r")  # type: ignore[assignment]
        norms = np.linalg.norm(factor[:p, :p], axis=0)
        norms[norms == 0.0] = 1.0
        left, values, right = np.linalg.svd(factor[:p, :p] / norms)
        if values[-1] < 1e-11 * values[0]:
            share = np.abs(right[-1])
            alike = ", ".join(names[k] for k in sorted(np.argsort(-share)[:4]) if share[k] > 0.25 * share.max())
            raise IdentifiabilityError(
                f"the record cannot tell apart: {alike}",
                remedy="use another source of observation, a longer record or unequal case speeds",
            )
        inverse = (right.T / values) @ left.T / norms[:, None]
        step, covariance, levels = inverse @ factor[:p, p], inverse @ inverse.T, []
        for part, level in zip(parts, used, strict=True):
            rows = part.factor[:, :-1] / level
            freedom = max(part.rows - float(np.sum((rows @ covariance) * rows)), 1.0)
            levels.append(float(np.linalg.norm(part.factor @ [*step, -1.0]) / np.sqrt(freedom)))
        if np.allclose(levels, used, rtol=1e-4, atol=_SMALLEST_SIGMA):
            break
    noise = {part.name: level for part, level in zip(parts, used, strict=True)}
    return LeastSquares(
        step, covariance, float(values[0] / values[-1]), noise, sum(part.rows for part in parts) - p
    )


def gauss_newton(
    record: ObservedRecord, x: Unknowns, steps: int, progress: Progress | None, settled: float = _SETTLED
) -> tuple[Unknowns, LeastSquares]:
    """Converged unknowns, and the last step with its covariance."""
    for k in range(steps):
        report(progress, k, steps, f"step {k + 1} of at most {steps}")
        solution = solve(record.groups(x), record.names)
        x = record.moved(x, solution.step)
        if np.all(np.abs(solution.step) < settled * np.sqrt(np.diag(solution.covariance))):
            break
    return x, solution


@dataclass(frozen=True)
class Parameter:
    """One identified quantity: value, standard uncertainty [``unit``]."""

    name: str
    value: float
    std: float
    unit: str


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Result):
    """Result: the knowledge that the compensation models use, covariance of the unknowns, noise, doubts.

    ``names, values, covariance`` are the Cartesian unknowns (misalignments, eta0, eta_rate);
    ``parameters`` the same as amplitudes and phases with first-order uncertainty.
    """

    sources: tuple[str, ...]
    knowledge: Knowledge
    names: tuple[str, ...]
    values: Array
    covariance: Array
    noise: dict[str, float]
    degrees_of_freedom: float
    condition: float
    parameters: tuple[Parameter, ...]
    notes: tuple[str, ...] = ()

    def in_brief(self) -> list[tuple[str, str]]:
        """The parameters with their standard uncertainties, and the doubts."""
        rows = [(p.name, f"{p.value:.6g} +- {p.std:.2g} {p.unit}") for p in self.parameters]
        return [("sources", ", ".join(self.sources)), *rows, *(("note", note) for note in self.notes)]

    def document(self) -> dict[str, Any]:
        """JSON document of ``piga platform identify``."""
        names = ("sources", "parameters", "noise", "degrees_of_freedom", "condition", "notes")
        matrix, values = self.covariance.tolist(), self.values.tolist()
        covariance = {"names": self.names, "values": values, "matrix": matrix}
        document = {name: getattr(self, name) for name in names} | {"covariance": covariance}
        return dict(msgspec.to_builtins(document))

    def __getitem__(self, name: str) -> Parameter:
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise KeyError(f"no parameter '{name}'; there are: {', '.join(p.name for p in self.parameters)}")


@one_thread()
def identify(readouts: Readouts, place: Place, *, sources: Sequence[str] = STATIC_SOURCES, orders: int = 3,
             progress: Progress | None = None) -> Identification:  # fmt: skip
    """Batch identification by weighted Gauss-Newton least squares on the exact geometry.

    ``readouts`` are the calibration stretch; for ``gimbals`` the base must be at rest. ``place`` of the base: its gravity
    gives the first triad attitude. ``sources``: any of ``gimbals``, ``pick-off``, ``force``. ``orders``: harmonics of the
    misalignment over the case turn to identify. ``progress`` is called as ``progress(done, total, what)`` before each step; it
    returns False to stop (:mod:`piga.progress`).

    Raises
    ------
    IdentifiabilityError
        If the sources cannot separate the unknowns. The message names them.
    ArgumentError
        If a source is not known, the record is shorter than two case turns, or (for ``force``) has fewer than
        20 samples a turn.
    """
    record = ObservedRecord.checked(readouts, place, sources, orders)
    x, solution = gauss_newton(record, record.coarse(), _STEPS, progress)
    count = 4 + 4 * orders + (2 if "pick-off" in sources else 0)
    values = np.concatenate([x.polar, x.equatorial, [x.eta0, x.eta_rate]])[:count]
    covariance = solution.covariance[:count, :count]
    return Identification(
        sources=record.sources,
        knowledge=Knowledge(gyro_of(x.polar), gyro_of(x.equatorial), x.eta0, x.eta_rate),
        names=record.names[:count],
        values=values,
        covariance=covariance,
        noise=solution.noise,
        degrees_of_freedom=solution.degrees_of_freedom,
        condition=solution.condition,
        parameters=_parameters(values, covariance, orders),
        notes=_notes(values, covariance),
    )


def _amplitudes(tips: Array) -> dict[str, float]:
    """Amplitude and phase of the fundamental and of each harmonic, of both gyros, from their unknowns."""
    values: dict[str, float] = {}
    for name, vector in zip(("polar", "equatorial"), np.split(tips, 2), strict=True):
        gyro = gyro_of(vector)
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
    for gyro, below in zip(("polar", "equatorial"), small.tolist(), strict=True):
        if any(below):
            which = ", ".join(f"harmonic {k}" if k else "misalignment" for k, one in enumerate(below) if one)
            notes.append(f"{gyro}: below three times the uncertainty, so the phase means nothing: {which}")
    return tuple(notes)


# -- alignment on a static base ----------------------------------------------------------------------------------

ALIGNED = names(0)[-9:]
"""Order of the covariance: triad attitude [rad], triad drift [rad/s], base attitude about Earth axes [rad]."""


@dataclass(frozen=True, eq=False, repr=False)
class Alignment(Result):
    """Triad ``C_G^i`` (3, 3) at time zero, drift (3,) [rad/s] along triad axes, base ``C_b^n`` (3, 3).

    ``covariance`` (9, 9) in the order of :data:`ALIGNED`; ``noise`` per source.
    The alignment cannot observe accelerometer biases.
    """

    place: Place
    triad: Array
    drift: Array
    base: Array
    covariance: Array
    noise: dict[str, float]
    condition: float

    @property
    def std(self) -> Array:
        """Standard uncertainties (9,) in the order of :data:`ALIGNED`."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def triad_vector(self) -> Array:
        """Rotation vector (3,) [rad] from inertial axes to the triad."""
        return matrix_to_rotation_vector(self.triad)

    @property
    def base_angles(self) -> Array:
        """Roll, pitch, heading (3,) [rad] of the base."""
        c = self.base
        pitch = np.arcsin(np.clip(-c[2, 0], -1.0, 1.0))
        return np.array([np.arctan2(c[2, 1], c[2, 2]), pitch, np.arctan2(c[1, 0], c[0, 0])])

    @property
    def base_stds(self) -> Array:
        """Standard uncertainties of roll, pitch, heading (3,) [rad]."""
        _, pitch, heading = self.base_angles
        c, s, flat, steep = np.cos(heading), np.sin(heading), np.cos(pitch), np.tan(pitch)
        by_level = np.array([[c / flat, s / flat, 0.0], [-s, c, 0.0], [c * steep, s * steep, 1.0]])
        jacobian = by_level @ local_axes(self.place.latitude, self.place.longitude).T
        return np.sqrt(np.diag(jacobian @ self.covariance[6:9, 6:9] @ jacobian.T))

    def start(self, *, with_drift: bool) -> Start:
        """Start of the navigation at the known place, with or without compensation of the estimated drift."""
        return site_start(self.place, self.triad, self.drift if with_drift else np.zeros(3))

    def document(self) -> dict[str, Any]:
        """JSON document of ``piga platform align``."""
        return {
            "triad_to_inertial": self.triad.tolist(),
            "triad_rotation_vector_rad": self.triad_vector.tolist(),
            "drift_rad_s": self.drift.tolist(),
            "base_roll_pitch_heading_rad": self.base_angles.tolist(),
            "covariance": {"names": list(ALIGNED), "matrix": self.covariance.tolist()},
            "noise": self.noise,
            "condition": self.condition,
        }


def align(
    readouts: Readouts, place: Place, knowledge: Knowledge, *, orders: int = 3,
    progress: Progress | None = None,
) -> Alignment:  # fmt: skip
    """Align on a record of a base at rest at a known place. The misalignments must be known.

    The method is Gauss-Newton on the exact geometry. The noise levels come from the residuals. ``progress`` is called as
    ``progress(done, total, what)`` before each step.

    Raises
    ------
    IdentifiabilityError
        If the record is too short to determine the attitude.
    """
    record = ObservedRecord(readouts, place, ("gimbals", "rest"), orders)
    known = replace(
        record.coarse(),
        polar=tip_of(knowledge.polar, orders),
        equatorial=tip_of(knowledge.equatorial, orders),
        eta0=knowledge.eta0,
        eta_rate=knowledge.eta_rate,
    )
    x, solution = gauss_newton(record, known, _ALIGNING_STEPS, progress, settled=0.0)
    base, told = local_axes(place.latitude, place.longitude).T @ x.base, (solution.noise, solution.condition)
    return Alignment(place, x.triad.T.copy(), x.drift, base, solution.covariance, *told)
