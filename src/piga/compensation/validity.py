"""Where a calibration holds: range of specific force, temperature, age."""

from __future__ import annotations

import datetime as dt
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga._kernels.compensation import layout as at
from piga.records.calibration import Calibration

Array = NDArray[np.float64]

MARGIN = 0.05
"""Part of the calibrated span by which a value may lie outside before it is flagged."""


@dataclass(frozen=True)
class Limits:
    """Range in which the calibration holds; infinite where it is not known.

    Attributes
    ----------
    a_x:
        Lowest and highest specific force along the input axis [m/s^2].
    a_t:
        Largest transverse specific force [m/s^2].
    temperature:
        Lowest and highest temperature [K].
    """

    a_x: tuple[float, float] = (-math.inf, math.inf)
    a_t: float = math.inf
    temperature: tuple[float, float] = (-math.inf, math.inf)

    @staticmethod
    def of(calibration: Calibration) -> Limits:
        """Limits from a calibration record: its ``diagnostics.range``, else the means of its segments.

        The record's range has the keys ``a_x`` [low, high], ``a_t`` [low, high] in m/s^2 and
        ``temperature`` [low, high] in K, each optional. Spans are widened by ``MARGIN``.
        """
        known = calibration.diagnostics.range
        means = [segment.mean_a_x for segment in calibration.segments]
        span = known.get("a_x") or ((min(means), max(means)) if len(means) > 2 else None)
        transverse, warm = known.get("a_t"), known.get("temperature")
        return Limits(
            a_x=_widened(span) if span else (-math.inf, math.inf),
            a_t=float(transverse[1]) * (1.0 + MARGIN) if transverse else math.inf,
            temperature=_widened(warm, 2.0) if warm else (-math.inf, math.inf),
        )

    def as_array(self, temperature_reference: float) -> Array:
        """The limits as the kernels take them."""
        low, high = self.temperature
        return np.array([*self.a_x, self.a_t, low - temperature_reference, high - temperature_reference])


def _widened(span: Any, least: float = 0.0) -> tuple[float, float]:
    low, high = float(span[0]), float(span[1])
    margin = max(MARGIN * (high - low), least, MARGIN * max(abs(low), abs(high)) if least == 0.0 else 0.0)
    return low - margin, high + margin


def age_in_days(calibration: Calibration, now: dt.datetime | None = None) -> float | None:
    """Days since the calibration was made; None when its date cannot be read."""
    try:
        made = dt.datetime.fromisoformat(calibration.provenance.created)
    except ValueError:
        return None
    if made.tzinfo is None:
        made = made.replace(tzinfo=dt.UTC)
    return ((now or dt.datetime.now(dt.UTC)) - made).total_seconds() / 86400.0


def age_flag(calibration: Calibration, max_age_days: float | None) -> int:
    """The ``age`` flag when the calibration is older than ``max_age_days`` (None: any age will do)."""
    if max_age_days is None:
        return 0
    age = age_in_days(calibration)
    return at.AGE if age is None or age > max_age_days else 0
