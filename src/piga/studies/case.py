"""Parts of a reproduction: judged numbers (cases), chapters, and the published instrument and runs that they share."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any, Final, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from piga.calibration.calibrate import calibrate
from piga.compensation import compensate
from piga.instrument import Instrument, propagate
from piga.records import Calibration, Run
from piga.records.run_file import TomlTable
from piga.reports.render.figure import Figure
from piga.results import finite
from piga.studies.published import published_recursion
from piga.units import G0

Verdict = Literal["pass", "fail", "info"]


@dataclass(frozen=True)
class Case:
    """One published number and piga's number.

    Attributes
    ----------
    id:
        Name of the chapter, a dot, name of the case.
    source:
        Key of the publication with its equation or example, e.g. ``[Wei2024] eq. 12-18``.
    quantity, unit:
        The compared quantity, and the unit of all four numbers.
    published:
        The published number; None if none is printed.
    computed:
        piga's number, from a run of the library.
    tolerance:
        Largest difference that counts as agreement; None if the numbers are not comparable (verdict ``info``).
    note:
        Reason for the tolerance; for ``info`` the reason why there is no verdict.
    limit:
        True: the publication prints an upper limit. Any size from zero up to it agrees.
    """

    id: str
    source: str
    quantity: str
    unit: str
    published: float | None
    computed: float
    tolerance: float | None
    note: str
    limit: bool = False

    @property
    def difference(self) -> float | None:
        """Computed minus published number; None if nothing is published."""
        return None if self.published is None else self.computed - self.published

    @property
    def verdict(self) -> Verdict:
        """``pass`` within the tolerance, ``fail`` outside it, ``info`` without a tolerance."""
        if self.published is None or self.tolerance is None:
            return "info"
        if self.limit:
            return "pass" if abs(self.computed) <= self.published else "fail"
        return "pass" if abs(self.computed - self.published) <= self.tolerance else "fail"

    def document(self) -> dict[str, Any]:
        """The case in the JSON of ``piga reproduce``. A non-finite number becomes null."""
        keys = [
            "id",
            "source",
            "quantity",
            "unit",
            "published",
            "computed",
            "difference",
            "tolerance",
            "verdict",
            "note",
        ]
        return {key: finite(value) if isinstance(value := getattr(self, key), float) else value for key in keys}


@dataclass(frozen=True)
class Chapter:
    """Cases and figures of one part of a publication. ``text`` describes the method and the result."""

    id: str
    title: str
    source: str
    text: str
    cases: tuple[Case, ...]
    figures: tuple[Figure, ...]


class PublishedCase(TomlTable, frozen=True):
    """A case as ``published.toml`` has it: all of :class:`Case` but the computed number."""

    source: str
    quantity: str
    unit: str
    note: str
    published: float | None = None
    tolerance: float | None = None
    limit: bool = False


class PublishedChapter(TomlTable, frozen=True):
    """A chapter as ``published.toml`` has it; its cases by name, in order."""

    title: str
    source: str
    text: str
    cases: dict[str, PublishedCase]


@cache
def published_chapters() -> dict[str, PublishedChapter]:
    """Every chapter of ``published.toml``, in the order of the publications."""
    text = files("piga.data").joinpath("published.toml").read_bytes()
    return msgspec.toml.decode(text, type=dict[str, PublishedChapter])


@dataclass(frozen=True)
class Value:
    """A computed number with parts of its case that come from the run, too. ``words`` fill quantity and note."""

    computed: float
    published: float | None = None
    tolerance: float | None = None
    words: Mapping[str, float] = field(default_factory=dict)


def chapter_of(
    name: str, values: Mapping[str, float | Value], figures: Sequence[Figure], **words: float
) -> Chapter:
    """The chapter ``name`` with the computed ``values`` of its cases. ``words`` fill its text.

    Raises
    ------
    ValueError
        If ``values`` are not those of the published cases.
    """
    printed = published_chapters()[name]
    if set(values) != set(printed.cases):
        raise ValueError(f"{name}: the cases differ: {sorted(set(values) ^ set(printed.cases))}")
    cases = []
    for key, case in printed.cases.items():
        given = values[key]
        value = given if isinstance(given, Value) else Value(given)
        cases.append(
            Case(
                id=f"{name}.{key}",
                source=case.source,
                quantity=case.quantity.format(**value.words),
                unit=case.unit,
                published=case.published if value.published is None else value.published,
                computed=value.computed,
                tolerance=case.tolerance if value.tolerance is None else value.tolerance,
                note=case.note.format(**value.words),
                limit=case.limit,
            )
        )
    text = printed.text.format(**words)
    return Chapter(name, printed.title, printed.source, text, tuple(cases), tuple(figures))


Array = NDArray[np.float64]

SCALE: Final = "0.8884 rad/s/g"
INSTRUMENT: Final = Instrument(SCALE, "1000 arcsec", 0.25 * math.pi)
"""K, beta and alpha0 of all published runs except the five-coefficient one [Wei2020], [Wei2024]."""
TRANSVERSE: Final = 5.0
"""a_Y of the examples [g]. In the time-varying run a_Y = 5 a_x."""
RATIO: Final = TRANSVERSE * INSTRUMENT.tan_beta
"""r of the time-varying run, and a_x of the critical example [g]."""
RAMP_TOP: Final = 2.06
"""a_x at the end of the time-varying run [g]: a_Y reaches about 10 g, the error about 0.05 g."""


def example_force(a_x: float) -> tuple[float, float, float]:
    """Specific force of an example [m/s^2]: ``a_x`` [g] and the transverse force of all of them."""
    return a_x * G0, TRANSVERSE * G0, 0.0


ForceHistory = Literal["ramp", "constant"]


@cache
def record(profile: ForceHistory) -> Run:
    """The time-varying run as a record of output rates over 100 s at 100 Hz, a_Y = 5 a_x [Wei2024].

    ``ramp``: a_x from 0 to 2.06 g. The publication does not print its profile; a straight line replaces
    it. ``constant``: a_x = 2.06 g throughout.
    """
    duration = rate = 100.0
    t = np.arange(round(duration * rate) + 1) / rate
    a_x = RAMP_TOP * G0 * (t / duration if profile == "ramp" else np.ones_like(t))
    f = np.outer(a_x, [1.0, TRANSVERSE, 0.0])
    _, output = propagate(INSTRUMENT, t, f, with_rate=True, between="linear")
    return Run.from_arrays(t, output, f, scale_factor=SCALE, kind="rate", serial="published")


@cache
def published_calibration(profile: ForceHistory) -> Calibration:
    """[tan_beta, phi] of a record by the published recursion, x0 = [4.5e-3, 0.4], P0 = 1e10 I."""
    return published_recursion(record(profile))


@cache
def own_calibration(profile: ForceHistory) -> Calibration:
    """The calibration by piga's linear estimator, with its history. It needs no first guess."""
    return calibrate(record(profile), terms=["tan_beta"], method="recursive")


def raw_state(calibration: Calibration) -> tuple[float, float]:
    """[tan_beta, phi] as the recursion returns them. tan_beta may be negative and phi beyond half a turn."""
    history = calibration.history or {}
    return float(history["tan_beta"][-1]), float(history["phi"][-1])


def raw_error(run: Run) -> Array:
    """Indicated minus true specific force of a rate record [g]."""
    return np.asarray((run.output / run.scale_factor - run.f[:, 0]) / G0)


def velocity(run: Run) -> Array:
    """Integral of a_x [m/s]."""
    steps = 0.5 * (run.f[1:, 0] + run.f[:-1, 0]) * np.diff(run.t)
    return np.concatenate(([0.0], np.cumsum(steps)))


def model_phase(run: Run) -> Array:
    """Phase of the published model minus phi: the integral of K a_x [rad]."""
    return np.asarray(run.scale_factor * velocity(run))


def model_residual(run: Run, calibration: Calibration) -> Array:
    """Error that remains after the published model, at its own phase [g] (a_Z = 0)."""
    phase = model_phase(run) + calibration["phi"].value
    return np.asarray(raw_error(run) - run.f[:, 1] / G0 * calibration["tan_beta"].value * np.sin(phase))


def compensated_error(run: Run, calibration: Calibration, method: str) -> Array:
    """Compensated minus true specific force of a rate record [g]."""
    return np.asarray((compensate(run, calibration, method=method, uncertainty=False).ax - run.f[:, 0]) / G0)


def closed_form_phase() -> tuple[float, float]:
    """``C`` and ``phi = asin(r)`` of the time-varying run [rad] [Wei2024, eq. 5-11, 19-21]."""
    root = math.sqrt((1.0 - RATIO) * (1.0 + RATIO))
    start = math.tan(0.5 * INSTRUMENT.alpha0)
    return 2.0 / root * math.atan((start + RATIO) / root), math.asin(RATIO)
