"""Parts of a reproduction: judged numbers (cases), chapters, and what they share: the published instrument, runs and recursion."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from typing import Any, Final, Literal

import msgspec
import numpy as np

from piga._kernels.jit import kernel
from piga.calibration.calibrate import calibrate
from piga.calibration.fit import fit_run
from piga.calibration.model.request import make_request
from piga.compensation import compensate
from piga.errors import CalibrationError
from piga.instrument import Instrument, propagate
from piga.records import Calibration, Run
from piga.records.run_file import TomlTable
from piga.reports.render.figure import Figure
from piga.results import Array, finite
from piga.units import G0

Verdict = Literal["pass", "fail", "info"]


class Case(TomlTable, frozen=True):
    """A published number, as ``published.toml`` has it, beside that of piga.

    Attributes
    ----------
    source:
        Key of the publication with its equation or example, e.g. ``[Wei2024] eq. 12-18``.
    quantity, unit:
        The compared quantity, and the unit of all numbers.
    note:
        Reason for the tolerance; for ``info`` the reason why there is no verdict.
    published:
        The published number; None if none is printed.
    tolerance:
        Largest difference that counts as agreement; None if the numbers are not comparable (verdict ``info``).
    limit:
        True: the publication prints an upper limit. Any size from zero up to it agrees.
    id, computed:
        Name of the chapter, a dot, the name of the case; and the number of piga. Both come from the run.
    """

    source: str
    quantity: str
    unit: str
    note: str
    published: float | None = None
    tolerance: float | None = None
    limit: bool = False
    id: str = ""
    computed: float = math.nan

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
        keys = "id source quantity unit published computed difference tolerance verdict note"
        return {key: finite(getattr(self, key)) for key in keys.split()}


@dataclass(frozen=True)
class Chapter:
    """Cases and figures of one part of a publication. ``text`` describes the method and the result."""

    id: str
    title: str
    source: str
    text: str
    cases: tuple[Case, ...]
    figures: tuple[Figure, ...]


class PublishedChapter(TomlTable, frozen=True):
    """A chapter as ``published.toml`` has it; its cases by name, in order."""

    title: str
    source: str
    text: str
    cases: dict[str, Case]


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
    """The chapter ``name`` with the computed ``values`` of its cases. ``words`` fill its text."""
    printed = published_chapters()[name]
    if set(values) != set(printed.cases):
        raise ValueError(f"{name}: the cases differ: {sorted(set(values) ^ set(printed.cases))}")
    cases = []
    for key, case in printed.cases.items():
        given = values[key]
        value = given if isinstance(given, Value) else Value(given)
        of_run = {
            "published": case.published if value.published is None else value.published,
            "tolerance": case.tolerance if value.tolerance is None else value.tolerance,
            "quantity": case.quantity.format(**value.words),
            "note": case.note.format(**value.words),
        }
        cases.append(msgspec.structs.replace(case, id=f"{name}.{key}", computed=value.computed, **of_run))
    return Chapter(
        name, printed.title, printed.source, printed.text.format(**words), tuple(cases), tuple(figures)
    )


SCALE: Final = "0.8884 rad/s/g"
INSTRUMENT: Final = Instrument(SCALE, "1000 arcsec", 0.25 * math.pi)
"""K, beta and alpha0 of all published runs except the five-coefficient one [Wei2020], [Wei2024]."""
TRANSVERSE: Final = 5.0
"""a_Y of the examples [g]. In the time-varying run a_Y = 5 a_x."""
RATIO: Final = TRANSVERSE * INSTRUMENT.tan_beta
"""r of the time-varying run, and a_x of the critical example [g]."""
RAMP_TOP: Final = 2.06
"""a_x at the end of the time-varying run [g]: a_Y reaches about 10 g, the error about 0.05 g."""


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
    return Run.from_arrays(t, output, f, scale_factor=SCALE, kind="rate", serial="published", units="SI")


@cache
def published_calibration(profile: ForceHistory) -> Calibration:
    """[tan_beta, phi] of a record by the published recursion, x0 = [4.5e-3, 0.4], P0 = 1e10 I."""
    return published_recursion(record(profile))


@cache
def own_calibration(profile: ForceHistory) -> Calibration:
    """The calibration by piga's linear estimator. It needs no first guess."""
    return calibrate(record(profile), terms=["tan_beta"])


def growing_estimates(run: Run, terms: tuple[str, ...]) -> dict[str, Array]:
    """Estimates, and their standard uncertainties of the weights, of the first samples of a record (file units)."""
    marks, rows = np.linspace(1, run.size, GROWING).astype(np.int64)[1:], []
    for mark in marks.tolist():
        part = run.between(float(run.t[0]), float(run.t[mark - 1]))
        fit = fit_run(part, make_request(part, terms))
        named, _ = fit.runs.named(fit.estimate, fit.estimate.covariance)
        rows.append([size for c in named for size in (c.value, c.std)])
    keys = [key for c in named for key in (c.name, f"u({c.name})")]
    return {"sample": marks.astype(float), **dict(zip(keys, np.array(rows).T, strict=True))}


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


# -- the published recursion -----------------------------------------------------------------------------

START = (4.5e-3, 0.4)
"""First guess of the published run: tan_beta, phi [rad]."""
_VARIANCE = 1e10
"""Diagonal of the first covariance of the published run."""
POINTS = 400
"""Points of the history."""
GROWING = 50
"""Points of that of piga's own estimates."""


def published_recursion(
    run: Run,
    terms: tuple[str, ...] = ("tan_beta",),
    *,
    start: tuple[float, ...] = START,
    variance: float = _VARIANCE,
) -> Calibration:
    """Calibrate a record by the published recursion [Wei2024, eq. 12-18, 22-24], with its history.

    It uses rates. It predicts the phase from the input instead of reading it, takes ``a_t`` along the direction of the first
    transverse force, and needs a first guess. It can converge to a wrong solution. This implementation does not hide that.

    The indicated acceleration is the increment (or rate) of the output plus the base rotation about X0, divided by
    the nominal K. The phase is ``s = int K a_x`` from the start. The recursion estimates ``phi`` less the constant direction of
    the transverse force, which is added afterwards. ``history`` has the states as the recursion returns them: tan_beta may be
    negative and phi beyond half a turn.

    Parameters
    ----------
    run:
        The record.
    terms:
        ``("tan_beta",)`` or ``("tan_beta", "k0", "k1", "k2")``.
    start, variance:
        First states (tan_beta, phi [rad], then k0, k1, k2 in g units; those that are not given are 0), and the diagonal of their
        first covariance.

    Raises
    ------
    CalibrationError
        For other terms, or too many values of ``start``.
    """
    names = ("tan_beta", "phi", *terms[1:])
    if tuple(terms) not in (("tan_beta",), ("tan_beta", "k0", "k1", "k2")) or len(start) > len(names):
        raise CalibrationError(
            "the published recursion estimates (tan_beta) or (tan_beta, k0, k1, k2), and starts from as many values and phi",
            remedy="give these terms, or use piga.calibrate",
        )
    indicated, force, s = _series(run)
    direction = _direction(force)
    a_t = (force[1] * np.cos(direction) + force[2] * np.sin(direction)) / G0
    state = np.zeros(len(names))
    state[: len(start)] = start
    state[1] -= direction
    covariance = np.eye(state.size) * variance
    marks = np.unique(np.linspace(1, s.size, min(POINTS, s.size)).astype(np.int64))
    history = np.empty((s.size, state.size))
    total = _recursion(indicated / G0, force[0] / G0, a_t, s, state, covariance, history)
    state[1] += direction
    history = history[marks - 1]
    history[:, 1] += direction
    values = {"sample": marks.astype(float), **dict(zip(names, history.T, strict=True))}
    if state[0] < 0.0:
        state[0], state[1] = -state[0], state[1] + np.pi
    state[1] = math.remainder(state[1], 2.0 * math.pi)
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0) * total / (s.size - state.size))
    given = {name: (float(v), float(u)) for name, v, u in zip(names, state, std, strict=True)}
    result = Calibration.from_coefficients(given, serial=run.serial, scale_factor_nominal=run.scale_factor)
    return replace(result, terms=tuple(terms), method="published", history=values)


def _series(run: Run) -> tuple[Array, Array, Array]:
    """Indicated acceleration [m/s^2], force (3, n) and predicted phase, per sample or mid-interval."""
    omega = np.zeros(run.size) if run.base_rate is None else run.base_rate[:, 0]
    h = np.diff(run.t)
    h[run.begins[1:]] = 0.0
    step = run.scale_factor * h * 0.5 * (run.f[1:, 0] + run.f[:-1, 0])
    s = np.concatenate(([0.0], np.cumsum(step)))
    if run.kind == "rate":
        return (run.output + omega) / run.scale_factor, run.f.T, s
    formed = h > 0.0
    rate = np.diff(run.output)[formed] / h[formed] + 0.5 * (omega[1:] + omega[:-1])[formed]
    force = 0.5 * (run.f[1:] + run.f[:-1])[formed].T
    return rate / run.scale_factor, force, 0.5 * (s[1:] + s[:-1])[formed]


def _direction(force: Array) -> float:
    """Direction of the transverse force at its largest size [rad]."""
    at = int(np.argmax(force[1] ** 2 + force[2] ** 2))
    return float(np.arctan2(force[2, at], force[1, at]))


@kernel
def _recursion(
    indicated: Array,
    a_x: Array,
    a_t: Array,
    s: Array,
    x: Array,
    P: Array,
    history: Array,
) -> float:
    """Run the recursion over all samples; ``x`` and ``P`` are updated in place.

    ``y = indicated - a_x``, ``row = [a_t sin(s + x2), a_t x1 cos(s + x2), 1, a_x, a_x^2]`` cut to the
    states, ``gain = P row / (1 + row P row)``, as published [Wei2024, eq. 12-18 and 22-24]. The states after each sample
    go into ``history``. Returns the sum of squared innovations.
    """
    m = x.size
    row = np.empty(m)
    Pr = np.empty(m)
    total = 0.0
    for i in range(indicated.size):
        sine, cosine = math.sin(s[i] + x[1]), math.cos(s[i] + x[1])
        row[0] = a_t[i] * sine
        row[1] = a_t[i] * x[0] * cosine
        residual = indicated[i] - a_x[i] - a_t[i] * x[0] * sine
        if m > 2:
            row[2] = 1.0
            row[3] = a_x[i]
            row[4] = a_x[i] * a_x[i]
            residual -= x[2] + x[3] * a_x[i] + x[4] * a_x[i] * a_x[i]
        denominator = 1.0
        for j in range(m):
            Pr[j] = 0.0
            for k in range(m):
                Pr[j] += P[j, k] * row[k]
            denominator += row[j] * Pr[j]
        for j in range(m):
            gain = Pr[j] / denominator
            x[j] += gain * residual
            for k in range(m):
                P[j, k] -= gain * Pr[k]
        total += residual * residual
        history[i] = x
    return total
