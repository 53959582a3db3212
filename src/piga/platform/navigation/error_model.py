r"""Linear error dynamics of inertial-axes navigation, held against full perturbed runs.

.. math::

   \delta\dot r = \delta v - k_1 n\,(n\cdot\delta r - \delta h), \qquad
   \delta\dot v = G(r)\,\delta r + \delta f_i - k_2 n\,(n\cdot\delta r - \delta h), \qquad
   \delta f_i = \phi_i(t) \times f_i + C_P^i\, b

``delta r, delta v`` (3,) position [m] and velocity [m/s] error in inertial axes; ``G`` (3, 3) gradient
of J2 gravitation [1/s^2]; ``phi`` (3,) attitude error [rad] (what must be added to the navigator's idea of
the triad), ``b`` (3,) accelerometer bias [m/s^2] in platform axes, ``n`` the vertical, ``k1, k2`` the
altitude gains, ``delta h`` the error of the reference height. Small misalignments between P and G are
left out of ``C_P^i``. Form after [Britting1971]; written out in docs/platform.md section 9.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga import earth
from piga._kernels.platform.errors import propagate_errors
from piga.platform.model.geodesy import KERNEL_EARTH, geodetic_to_earth, local_axes, specific_force_at_rest
from piga.platform.model.scenario import Place
from piga.platform.navigation.navigator import damping_gains

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Perturbation:
    """One error put in.

    ``attitude`` [rad] and ``drift`` [rad/s] of the triad, accelerometer ``bias`` [m/s^2], reference
    ``height`` [m], and ``position`` [m], ``velocity`` [m/s] north, east, down at the start.
    """

    attitude: tuple[float, float, float] = (0.0, 0.0, 0.0)
    drift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    height: float = 0.0
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def plus(self, other: Perturbation) -> Perturbation:
        """Both at once."""

        def added(a: tuple[float, float, float], b: tuple[float, float, float]) -> tuple[float, float, float]:
            return (a[0] + b[0], a[1] + b[1], a[2] + b[2])

        return Perturbation(
            added(self.attitude, other.attitude),
            added(self.drift, other.drift),
            added(self.bias, other.bias),
            self.height + other.height,
            added(self.position, other.position),
            added(self.velocity, other.velocity),
        )


def linear_errors(place: Place, perturbation: Perturbation, duration: float, *, step: float = 10.0,
                  damping_time: float = 100.0) -> Array:  # fmt: skip
    """Errors of a navigator at rest at ``place``: time [s], position n, e, d [m], velocity n, e, d [m/s].

    Shape (m, 7), every ``step`` seconds. The perturbation is that of the navigator: its triad is turned
    by ``attitude + drift t`` too far, its accelerometers read ``bias`` too much.
    """
    count = round(duration / step)
    position = geodetic_to_earth(place.latitude, place.longitude, place.height)
    axes = local_axes(place.latitude, place.longitude)
    spin = np.array([0.0, 0.0, earth.EARTH_RATE])
    start = np.zeros(6)
    start[:3] = axes @ np.array(perturbation.position)
    start[3:] = axes @ np.array(perturbation.velocity) + np.cross(spin, start[:3])
    out = np.empty((count + 1, 6))
    propagate_errors(
        start, position, specific_force_at_rest(position), axes, np.array(perturbation.attitude),
        np.array(perturbation.drift), np.array(perturbation.bias), perturbation.height,
        damping_gains(damping_time), KERNEL_EARTH[0], KERNEL_EARTH[1], earth.EARTH_RATE, step, out,
    )  # fmt: skip
    return np.column_stack([np.arange(count + 1) * step, out])
