"""What an identification gives: gyros, uncertainties, amplitudes and phases, and doubts in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from piga.platform.identification.estimate import Reduced, Solution
from piga.platform.identification.observation import Tip, Unknowns, names
from piga.platform.identification.sources import Record
from piga.platform.model.models import Knowledge
from piga.platform.model.scenario import Gyro

Array = NDArray[np.float64]

UNKNOWN_PHASE = float(np.pi / np.sqrt(3.0))
"""Standard uncertainty [rad] of a phase of which nothing is known: that of any angle of a turn."""


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


def result(record: Record, x: Unknowns, parts: Sequence[Reduced], solution: Solution) -> Identification:
    """The result at the unknowns ``x``, from the last rows and the last solution about them."""
    orders, tips = record.orders, 4 + 4 * record.orders
    known = tips + (2 if "pick-off" in record.sources else 0)
    vector = np.concatenate([x.polar.vector, x.equatorial.vector, [x.eta0, x.eta_rate]])[:known]
    covariance = solution.covariance[:known, :known]
    return Identification(
        sources=record.sources,
        polar=x.polar.gyro(),
        equatorial=x.equatorial.gyro(),
        eta0=x.eta0,
        eta_rate=x.eta_rate,
        names=names(orders)[:known],
        values=vector,
        covariance=covariance,
        noise={part.name: level for part, level in zip(parts, solution.levels, strict=True)},
        rms={part.name: float(np.sqrt(part.squares(solution.step) / part.rows)) for part in parts},
        degrees_of_freedom=sum(part.rows for part in parts) - len(solution.covariance),
        condition=solution.condition,
        parameters=_parameters(vector, covariance, orders, known > tips),
        notes=_notes(vector, covariance, orders),
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
    stds = np.where(labels_are_angles(labels), np.minimum(stds, UNKNOWN_PHASE), stds)
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
        at = [start + 2 * k for k in range(1, orders + 1)]
        small = [
            k for k, i in enumerate(at, start=1) if np.hypot(*vector[i : i + 2]) < 3.0 * std[i : i + 2].max()
        ]
        if small:
            which = ", ".join(str(k) for k in small)
            notes.append(
                f"{gyro}: harmonics below three times their uncertainty, whose phases mean nothing: {which}"
            )
    return tuple(notes)
