"""Identification of misalignments, phases and harmonics from readouts: batch, with covariance.

Sources: ``gimbals`` (angles of a static base), ``pick-off`` (redundancy axis), ``force`` (disturbance in
the specific force, any base). Only readouts are seen.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from piga.platform.identification.estimate import Reduced, Solution, solve_with_noise
from piga.platform.identification.identified import Identification, result
from piga.platform.identification.observation import Unknowns, coarse_unknowns
from piga.platform.identification.sources import STATIC_SOURCES, Record
from piga.platform.model.geodesy import geodetic_to_earth, specific_force_at_rest
from piga.platform.model.scenario import Place
from piga.platform.model.simulate import Readouts

_SETTLED = 0.01
"""A step below this share of the standard uncertainties ends the iteration."""


def identify(readouts: Readouts, place: Place, *, sources: Sequence[str] = STATIC_SOURCES, orders: int = 3,
             iterations: int = 6) -> Identification:  # fmt: skip
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
        At most so many steps; fewer when they have settled.

    Raises
    ------
    IdentifiabilityError
        If the sources cannot separate the unknowns; the message says which.
    ArgumentError
        If a source is not known, the record is shorter than two case turns, or (for ``force``) has fewer than
        20 samples a turn.
    """
    record = Record.checked(readouts, sources, orders)
    return result(record, *gauss_newton(record, place, iterations))


def gauss_newton(record: Record, place: Place, iterations: int = 6) -> tuple[Unknowns, list[Reduced], Solution]:
    """Converged unknowns, the rows about the last ones but one, and the last step with its covariance."""
    force = specific_force_at_rest(geodetic_to_earth(place.latitude, place.longitude, place.height))
    x = coarse_unknowns(record.readouts, force, record.orders)
    for _ in range(max(iterations, 1)):
        parts = [group.reduced() for group in record.groups(x)]
        solution = solve_with_noise(parts, record.names)
        x = record.moved(x, solution.step)
        if np.all(np.abs(solution.step) < _SETTLED * np.sqrt(np.diag(solution.covariance))):
            break
    return x, parts, solution
