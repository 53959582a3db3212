"""The tide of the solid Earth in local gravity, from PySolid (extra ``tide``)."""

from __future__ import annotations

import contextlib
import datetime as dt
import io
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.earth import SEMI_MAJOR_AXIS, Site
from piga.errors import ArgumentError

Array = NDArray[np.float64]

GRAVIMETRIC_FACTOR, LOVE_H2 = 1.1562, 0.6078
"""Degree-2 numbers of the IERS Conventions' elastic Earth: ``delta = 1 + h - 3 k/2`` and ``h``."""
_STEP = 60.0


@dataclass(frozen=True)
class EarthTide:
    """Tidal gravity of a test that begins at ``start`` (UTC); ``in_reference``: the lab's reference has it."""

    site: Site
    start: dt.datetime
    in_reference: bool = False

    def gravity(self, t: Array) -> Array:
        """Change of gravity [m/s^2] at times ``t`` [s] of the test, (n,).

        PySolid gives the radial displacement ``u = h W/g`` of the degree-2 (and small degree-3) potential W;
        gravity changes by ``-delta (2 W/a) = -(2 delta g/(h a)) u``. Good to some percent of a tide of
        1e-6 m/s^2.

        Raises
        ------
        ArgumentError
            If PySolid is not installed.
        """
        times, up = self._displacement(float(t.min()), float(t.max()))
        factor = -2.0 * GRAVIMETRIC_FACTOR * self.site.local_gravity / (LOVE_H2 * SEMI_MAJOR_AXIS)
        return factor * np.interp(t, times, up)

    def _displacement(self, first: float, last: float) -> tuple[Array, Array]:
        """Times [s] on a one-minute grid around the test, and the radial displacement there [m]."""
        try:
            from pysolid import calc_solid_earth_tides_point
        except ImportError:
            raise ArgumentError(
                "earth_tide needs PySolid", remedy="pip install 'piga[tide]', or leave earth_tide out"
            ) from None
        steps = math.ceil((last - first) / _STEP) + 2
        begin = self.start.astimezone(dt.UTC).replace(tzinfo=None) + dt.timedelta(seconds=first - _STEP)
        end = begin + dt.timedelta(seconds=_STEP * steps)
        latitude, longitude = math.degrees(self.site.latitude), math.degrees(self.site.longitude)
        with contextlib.redirect_stdout(io.StringIO()):  # it prints whatever its options say
            stamps, *_, up = calc_solid_earth_tides_point(latitude, longitude, begin, end, step_sec=_STEP)
        times = np.array([(stamp - begin).total_seconds() for stamp in stamps]) + first - _STEP
        return times, np.asarray(up, dtype=float)
