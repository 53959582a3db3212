"""Imperfections of a stand, by their names in the uncertainty budget.

The reference in a lab's log is that of the stand without imperfections. The instrument feels the stand with
them. All are scalars or vectors in SI, zero by default.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from piga.errors import ArgumentError
from piga.frames import rotation_vector_to_matrix
from piga.results import Array
from piga.units import to_si

Harmonic = tuple[int, float, float]

GENERAL = ("reference_scale", "reference_bias", "reference_misalignment", "timing", "temperature")
"""Imperfections that every stand has. They act on its reference, its clock and its thermometer."""


def _entry(unit: str, meaning: str, size: int = 1) -> Any:
    """A field of :class:`Imperfections`: a number, or a vector of ``size`` numbers."""
    default = 0.0 if size == 1 else (0.0,) * size
    return field(default=default, metadata={"unit": unit, "size": size, "meaning": meaning})


@dataclass(frozen=True)
class Imperfections:
    """Imperfections of a stand: true value minus assumed value.

    Fields are SI. Their ``metadata`` holds the unit for reports, the size and the meaning.
    """

    reference_scale: float = _entry("ppm", "relative error of the specific-force reference")
    reference_bias: tuple[float, ...] = _entry(
        "ug", "offset of the specific-force reference, base axes", size=3
    )
    reference_misalignment: tuple[float, ...] = _entry(
        "arcsec", "small turn of the instrument on the stand about X0, Y0, Z0", size=3
    )
    gravity: float = _entry("ug", "local gravity")
    timing: float = _entry("ppm", "relative error of the clock's rate")
    temperature: float = _entry("K", "offset of the thermometer")
    levelling: tuple[float, ...] = _entry("arcsec", "tilt of the stand about its two levelling axes", size=2)
    angle_error: float = _entry("arcsec", "index error of the dividing head")
    angle_harmonics: tuple[tuple[int, float, float], ...] = _entry(
        "arcsec", "dividing errors: order, amplitude, phase", size=0
    )
    settling: float = _entry("arcsec", "angle still to go when a position is reached")
    arm_radius: float = _entry("um", "effective radius of the centrifuge or lever arm on the table")
    arm_stretch: float = _entry("s^2/rad^2", "relative growth of the radius per squared rate")
    rate_error: float = _entry("ppm", "relative error of the centrifuge or table rate")
    rate_ripple: float = _entry("ppm", "relative ripple of the rate once a revolution")
    transverse_motion: float = _entry("ppm", "transverse over axial motion of the vibration table")
    rocking: float = _entry(
        "arcsec", "rotation of the vibration table at peak drive, about the horizontal axis across it"
    )

    def stand_specific(self) -> tuple[str, ...]:
        """Names of the imperfections that are not zero and belong to particular stands."""
        return tuple(
            e.name for e in fields(self) if e.name not in GENERAL and np.any(np.asarray(getattr(self, e.name)))
        )

    def require(self, accepted: Iterable[str], stand: str) -> None:
        """Refuse imperfections that ``stand`` does not have.

        Raises
        ------
        ArgumentError
            If there is one. The message names it, and those that the stand has.
        """
        names = set(accepted)
        for name in self.stand_specific():
            if name not in names:
                raise ArgumentError(
                    f"imperfection '{name}' does not exist on a {stand}",
                    remedy=f"it has: {', '.join((*GENERAL, *sorted(names)))}",
                )

    def felt(self, force: Array, rate: Array) -> tuple[Array, Array]:
        """Force and rate that the instrument feels if the stand makes ``force`` and ``rate``, (n, 3) each."""
        turn = rotation_vector_to_matrix(np.array(self.reference_misalignment))
        true = (1.0 + self.reference_scale) * force + np.array(self.reference_bias)
        return true @ turn, rate @ turn


NONE = Imperfections()
"""A perfect stand, as the lab's reference describes it."""


def _one(name: str, value: Any, unit: str, size: int, what: str, rng: np.random.Generator | None) -> Any:
    if name == "angle_harmonics":
        return tuple(_harmonic(item, what, rng) for item in _listed(value, what))
    if size == 1:
        number = to_si(value, unit, what=what)
        return number if rng is None else number * float(rng.standard_normal())
    if rng is not None and not isinstance(value, (list, tuple)):
        value = [value] * size
    items = _listed(value, what)
    if len(items) != size:
        raise ArgumentError(
            f"{what}: {len(items)} values given, {size} needed", remedy=f"give a list of {size}"
        )
    numbers = np.array([to_si(item, unit, what=what) for item in items])
    return tuple(float(v) for v in (numbers if rng is None else numbers * rng.standard_normal(size)))


def _listed(value: Any, what: str) -> list[Any]:
    if not isinstance(value, (list, tuple)):
        raise ArgumentError(
            f"{what}: a list is needed, got {value!r}", remedy="write e.g. ['1 arcsec', '0 arcsec']"
        )
    return list(value)


def _harmonic(item: Any, what: str, rng: np.random.Generator | None) -> Harmonic:
    parts = _listed(item, what)
    if len(parts) != 3 or isinstance(parts[0], bool) or not isinstance(parts[0], int):
        raise ArgumentError(
            f"{what}: {item!r} is not a harmonic: order, amplitude and phase are needed",
            remedy="write e.g. [2, '1 arcsec', '0 deg']",
        )
    amplitude = to_si(parts[1], "rad", what=what)
    phase = to_si(parts[2], "rad", what=what)
    return int(parts[0]), amplitude if rng is None else amplitude * float(rng.standard_normal()), phase


def imperfections(
    values: Mapping[str, Any], *, rng: np.random.Generator | None = None, where: str = "[imperfections]"
) -> Imperfections:
    """Imperfections from text or numbers as written in a scenario.

    With ``rng`` the values are standard uncertainties, and the imperfections are drawn from normal distributions.
    A single value for a vector then holds for each component.

    Raises
    ------
    ArgumentError, UnitError
        If a value is not valid. The message names the key.
    """
    metadata = {entry.name: entry.metadata for entry in fields(Imperfections)}
    for name in values:
        if name not in metadata:
            raise ArgumentError(f"{where}: unknown key '{name}'", remedy=f"known keys: {', '.join(metadata)}")
    chosen = {
        name: _one(name, values[name], str(meta["unit"]), int(meta["size"]), f"{where} {name}", rng)
        for name, meta in metadata.items()
        if name in values
    }
    return Imperfections(**chosen)
