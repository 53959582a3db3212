"""Alignment on a static base: attitude and drift of the triad against inertial axes, with covariance.

Gravity describes a cone about the Earth's axis, because the platform keeps its attitude in inertial space. The gimbal angles
follow the base, because the Earth turns it. Together they give the triad's attitude and drift and the base's attitude. Each
observation alone lacks one angle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from piga.frames import matrix_to_rotation_vector, rotation_vector_to_matrix
from piga.platform.geometry import local_axes, wrapped
from piga.platform.identify import gauss_newton
from piga.platform.navigator import Knowledge, Start, site_start
from piga.platform.observation import ObservedRecord, Tip, names
from piga.platform.scenario import Place
from piga.platform.simulate import Readouts
from piga.progress import Progress
from piga.results import Array, Result

UNKNOWNS = names(0)[-9:]
"""Order of the covariance: triad attitude [rad], triad drift [rad/s], base attitude about Earth axes [rad]."""


@dataclass(frozen=True, eq=False, repr=False)
class Alignment(Result):
    """Triad ``C_G^i`` (3, 3) at time zero, drift (3,) [rad/s] along triad axes, base ``C_b^n`` (3, 3).

    ``covariance`` (9, 9) in the order of :data:`UNKNOWNS`; ``noise`` per source; ``rms`` after the fit.
    The alignment cannot observe accelerometer biases.
    """

    place: Place
    triad: Array
    drift: Array
    base: Array
    covariance: Array
    noise: dict[str, float]
    rms: dict[str, float]
    condition: float

    @property
    def std(self) -> Array:
        """Standard uncertainties (9,) in the order of :data:`UNKNOWNS`."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def triad_vector(self) -> Array:
        """Rotation vector (3,) [rad] from inertial axes to the triad."""
        return matrix_to_rotation_vector(self.triad)

    @property
    def base_angles(self) -> Array:
        """Roll, pitch, heading (3,) [rad] of the base."""
        return _angles(self.base)

    @property
    def base_stds(self) -> Array:
        """Standard uncertainties of roll, pitch, heading (3,) [rad]."""
        to_level = local_axes(self.place.latitude, self.place.longitude).T
        jacobian = np.empty((3, 3))
        for k, turn in enumerate(1e-6 * to_level.T):
            ahead, behind = (rotation_vector_to_matrix(sign * turn) @ self.base for sign in (1.0, -1.0))
            difference = _angles(ahead) - _angles(behind)
            jacobian[:, k] = wrapped(difference) / 2e-6
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
            "covariance": {"names": list(UNKNOWNS), "matrix": self.covariance.tolist()},
            "noise": self.noise,
            "condition": self.condition,
        }


def _angles(base: Array) -> Array:
    """Roll, pitch, heading (3,) [rad] of ``C_b^n``."""
    pitch = np.arcsin(np.clip(-base[2, 0], -1.0, 1.0))
    return np.array([np.arctan2(base[2, 1], base[2, 2]), pitch, np.arctan2(base[1, 0], base[0, 0])])


def align(
    readouts: Readouts, place: Place, knowledge: Knowledge, *, orders: int = 3, iterations: int = 5,
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
        polar=Tip.of(knowledge.polar, orders),
        equatorial=Tip.of(knowledge.equatorial, orders),
        eta0=knowledge.eta0,
        eta_rate=knowledge.eta_rate,
    )
    x, parts, solution = gauss_newton(record, known, iterations, progress, settled=0.0)
    base, noise = local_axes(place.latitude, place.longitude).T @ x.base, solution.by_source(parts)
    return Alignment(place, x.triad.T.copy(), x.drift, base, solution.covariance, *noise, solution.condition)
