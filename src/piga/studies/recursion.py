"""[Wei2024]: the time-varying run, the skew that avoids locking, the published recursion, compensation, five coefficients."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Final, Literal

import numpy as np

from piga._kernels.jit import kernel
from piga.calibration.calibrate import calibrate
from piga.compensation import compensate
from piga.errors import CalibrationError
from piga.instrument import ErrorModel, Instrument, closed_form, dead_zone, mean_rate, propagate
from piga.records import Calibration, Run
from piga.reports.render.figure import Plot, Role
from piga.results import Array
from piga.studies.case import INSTRUMENT, RATIO, SCALE, TRANSVERSE, Chapter, Value, chapter_of
from piga.units import ARCSEC, G0

RAMP_TOP: Final = 2.06
"""a_x at the end of the time-varying run [g]: a_Y reaches about 10 g, the error about 0.05 g."""
PUBLISHED_PHASE: Final = 0.802
"""phi of the time-varying run as printed [rad]."""
_START, _VARIANCE = (4.5e-3, 0.4), 1e10
"""First states (tan_beta, phi [rad]) of the published run, and the diagonal of their covariance."""

ForceHistory = Literal["ramp", "constant"]


@cache
def record(profile: ForceHistory) -> Run:
    """The time-varying run as a record of output rates over 100 s at 100 Hz, a_Y = 5 a_x [Wei2024].

    ``ramp``: a_x from 0 to 2.06 g. The publication does not print its profile; a straight line replaces
    it. ``constant``: a_x = 2.06 g throughout.
    """
    t = np.arange(10_001) / 100.0
    a_x = RAMP_TOP * G0 * (t / 100.0 if profile == "ramp" else np.ones_like(t))
    f = np.outer(a_x, [1.0, TRANSVERSE, 0.0])
    _, output = propagate(INSTRUMENT, t, f, with_rate=True, between="linear")
    return Run.from_arrays(t, output, f, scale_factor=SCALE, kind="rate", serial="published", units="SI")


@cache
def published_calibration(profile: ForceHistory) -> Calibration:
    """[tan_beta, phi] of a record by the published recursion, x0 = [4.5e-3, 0.4], P0 = 1e10 I."""
    return published_recursion(record(profile))


def raw_state(profile: ForceHistory) -> list[float]:
    """[tan_beta, phi] as the recursion returns them. tan_beta may be negative and phi beyond half a turn."""
    return _recursed(record(profile), 2, _START, _VARIANCE)[0].tolist()


def raw_error(run: Run) -> Array:
    """Indicated minus true specific force of a rate record [g]."""
    return np.asarray((run.output / run.scale_factor - run.f[:, 0]) / G0)


def model_phase(run: Run) -> Array:
    """Phase of the published model minus phi: the integral of K a_x [rad]."""
    steps = 0.5 * (run.f[1:, 0] + run.f[:-1, 0]) * np.diff(run.t)
    return np.asarray(run.scale_factor * np.concatenate(([0.0], np.cumsum(steps))))


def model_error(value: Mapping[str, float], force: Array, phase: Array) -> Array:
    """Error [g] by the published model, at force (n, 3) [m/s^2] with a_Z = 0 and phase [rad] without phi.

    A coefficient of ``k0``, ``k1`` and ``k2`` that is not given is zero.
    """
    a_x, a_Y = force[:, 0] / G0, force[:, 1] / G0
    k0, k1, k2 = (value.get(name, 0.0) for name in ("k0", "k1", "k2"))
    return np.asarray(value["tan_beta"] * a_Y * np.sin(phase + value["phi"]) + k0 + k1 * a_x + k2 * a_x**2)


def model_residual(run: Run, calibration: Calibration) -> Array:
    """Error that remains after the published model, at its own phase [g] (a_Z = 0)."""
    values = {c.name: c.value for c in calibration.coefficients}
    return np.asarray(raw_error(run) - model_error(values, run.f, model_phase(run)))


def compensated_error(run: Run, calibration: Calibration, method: str) -> Array:
    """Compensated minus true specific force of a rate record [g]."""
    return np.asarray((compensate(run, calibration, method=method, uncertainty=False).ax - run.f[:, 0]) / G0)


def with_phase(calibration: Calibration, phi: float) -> Calibration:
    """The calibration with another phase [rad], as the phase of the output."""
    changed = tuple(replace(c, value=phi) if c.name == "phi" else c for c in calibration.coefficients)
    return replace(calibration, coefficients=changed, phase_source="output")


def closed_form_phase() -> tuple[float, float]:
    """``C`` and ``phi = asin(r)`` of the time-varying run [rad] [Wei2024, eq. 5-11, 19-21]."""
    root = math.sqrt((1.0 - RATIO) * (1.0 + RATIO))
    start = math.tan(0.5 * INSTRUMENT.alpha0)
    return 2.0 / root * math.atan((start + RATIO) / root), math.asin(RATIO)


# -- the published recursion -----------------------------------------------------------------------------


def published_recursion(
    run: Run,
    terms: tuple[str, ...] = ("tan_beta",),
    *,
    start: tuple[float, ...] = _START,
    variance: float = _VARIANCE,
) -> Calibration:
    """Calibrate a record by the published recursion [Wei2024, eq. 12-18, 22-24].

    It predicts the phase from the input instead of reading it, takes ``a_t`` along the direction of the largest transverse
    force, and needs a first guess. It can converge to a wrong solution. This implementation does not hide that.

    The indicated acceleration is the increment (or rate) of the output plus the base rotation about X0, divided by
    the nominal K. The phase is ``s = int K a_x`` from the start.

    Parameters
    ----------
    run:
        The record.
    terms:
        ``("tan_beta",)`` or ``("tan_beta", "k0", "k1", "k2")``.
    start, variance:
        First states (tan_beta, phi [rad], then k0, k1, k2 in g units; those that are not given are 0), and the diagonal of their
        first covariance. Those of the published run are the default.

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
    state, std = _recursed(run, len(names), start, variance)
    if state[0] < 0.0:
        state[0], state[1] = -state[0], state[1] + np.pi
    state[1] = math.remainder(state[1], 2.0 * math.pi)
    given = {name: (float(v), float(u)) for name, v, u in zip(names, state, std, strict=True)}
    result = Calibration.from_coefficients(given, serial=run.serial, scale_factor_nominal=run.scale_factor)
    return replace(result, terms=tuple(terms), method="published")


def _recursed(run: Run, count: int, start: tuple[float, ...], variance: float) -> tuple[Array, Array]:
    """The first ``count`` of the states tan_beta, phi, k0, k1, k2 after the last sample, and their standard deviations."""
    indicated, force, s = _series(run)
    at = int(np.argmax(force[1] ** 2 + force[2] ** 2))
    direction = float(np.arctan2(force[2, at], force[1, at]))
    a_t = (force[1] * np.cos(direction) + force[2] * np.sin(direction)) / G0
    state, covariance = np.zeros(count), np.eye(count) * variance
    state[: len(start)] = start
    state[1] -= direction
    total = _recursion(indicated / G0, force[0] / G0, a_t, s, state, covariance)
    state[1] += direction
    return state, np.sqrt(np.maximum(np.diag(covariance), 0.0) * total / (s.size - count))


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


@kernel
def _recursion(indicated: Array, a_x: Array, a_t: Array, s: Array, x: Array, P: Array) -> float:
    """Run the recursion over all samples; ``x`` and ``P`` are updated in place.

    ``y = indicated - a_x``, ``row = [a_t sin(s + x2), a_t x1 cos(s + x2), 1, a_x, a_x^2]`` cut to the
    states, ``gain = P row / (1 + row P row)``, as published [Wei2024, eq. 12-18 and 22-24]. Returns the sum of squared
    innovations.
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
    return total


# -- chapters -----------------------------------------------------------------------------------------

_EVERY = 20
"""Every 20th sample of the run is drawn: at least seventeen per revolution."""


def run() -> Chapter:
    """a_Y = 5 a_x with a_x up to about 2 g: indicated against true acceleration."""
    log = record("ramp")
    error, late = raw_error(log), log.f[:, 0] > 0.5 * RAMP_TOP * G0
    growth = float(np.abs(error[late] / (log.f[late, 0] / G0)).max())
    values = {"error": float(np.abs(error).max()), "growth": growth}
    a_x, error = log.f[::_EVERY, 0] / G0, error[::_EVERY]
    plot = Plot("time-varying-run", "Error of the indication", "true acceleration a_x [g]", "error [g]")
    plot.band(a_x, -RATIO * a_x, RATIO * a_x, "envelope 5 a_x tan(beta)").line(a_x, error, "error", "after")
    figure = plot.caption("The error reaches 0.05 g at 2 g and repeats with each revolution.")
    return chapter_of("time-varying", values, (figure,))


def mounting() -> Chapter:
    """Skew that keeps a_x^2 > a_t^2 tan^2(beta)."""
    load, skew = TRANSVERSE * G0, 10.0 * INSTRUMENT.beta
    a_x = load * math.sin(skew)
    rate = float(mean_rate(INSTRUMENT, a_x, load * math.cos(skew), 0.0))
    values = {
        "least-skew": math.atan(float(dead_zone(INSTRUMENT, load, 0.0)[1]) / load) / ARCSEC,
        "moves": _revolving_skew(load),
        "shortfall": 1.0 - rate / (INSTRUMENT.scale_factor * a_x),
    }
    return chapter_of("mounting", values)


def _revolving_skew(load: float) -> float:
    """Least skew [arcsec] at which the exact motion makes one revolution within 50 000 s."""
    from scipy.optimize import brentq

    def missing(skew: float) -> float:
        force = load * math.sin(skew * ARCSEC), load * math.cos(skew * ARCSEC), 0.0
        return float(closed_form(INSTRUMENT, 5e4, *force)[0]) - INSTRUMENT.alpha0 - 2.0 * math.pi

    return float(brentq(missing, 500.0, 2000.0, xtol=1e-4))


def recursion() -> Chapter:
    """[tan_beta, phi] from x0 = [4.5e-3, 0.4], P0 = 1e10 I, and wrong convergence with a constant input."""
    tan_beta, phi = raw_state("ramp")
    wrong_tan_beta, wrong_phi = raw_state("constant")
    ours, constant_ours = (calibrate(record(one), terms=["tan_beta"]) for one in ("ramp", "constant"))
    constant, lead = closed_form_phase()
    values = {
        "tan_beta": tan_beta,
        "phi": phi,
        "phase-constant": constant - lead,
        "own-tan_beta": ours["tan_beta"].value,
        "own-truth": ours["tan_beta"].value - INSTRUMENT.tan_beta,
        "own-phi": ours["phi"].value - INSTRUMENT.alpha0,
        "constant-tan_beta": wrong_tan_beta,
        "constant-phi": wrong_phi,
        "constant-own": constant_ours["tan_beta"].value - INSTRUMENT.tan_beta,
    }
    return chapter_of("recursion", values)


def compensation() -> Chapter:
    """The published compensation (under 0.002 g) against the exact one (rounding)."""
    log = record("ramp")
    published, ours = published_calibration("ramp"), calibrate(log, terms=["tan_beta"])
    before, model = raw_error(log), model_residual(log, published)
    formula = compensated_error(log, with_phase(published, PUBLISHED_PHASE), "published")
    exact = compensated_error(log, ours, "exact")
    largest = [float(np.abs(error).max()) for error in (before, model, model, formula, exact)]
    values = dict(zip(("before", "model-limit", "model", "formula", "exact"), largest, strict=True))
    rows: tuple[tuple[Array, float, str, Role, str], ...] = (
        (before, 1.0, "g", "before", "Before"),
        (model, 1e3, "mg", "warning", "Published, phase from the input"),
        (formula, 1e3, "mg", "z", "Published, phase from the output"),
        (exact, 1e15, "1e-15 g", "after", "Exact"),
    )
    plot = Plot("compensation-errors", "What compensation leaves of the error", columns=2, height=2.3)
    for y, scale, unit, role, title in rows:
        plot.panel("time [s]", f"error [{unit}]", title).line(log.t[::_EVERY], scale * y[::_EVERY], role=role)
    figure = plot.caption(
        "Four scales: g, mg twice, and 1e-15 g. Above right the phase is the integral of K a_x, below left that of the output "
        "plus the printed 0.802 rad. The published compensation takes the error from 0.05 g to "
        f"1 or 2 mg at {RAMP_TOP:g} g; the exact one to rounding."
    )
    return chapter_of("compensation", values, (figure,))


# -- five coefficients on a record of 257 s with three phases, eq. 22-24 ---------------------------------------

TERMS = ("tan_beta", "k0", "k1", "k2")
TRUTH = {"tan_beta": 3.6e-4, "phi": math.radians(27.5), "k0": 1.60e-3, "k1": -2.37e-3, "k2": 1.98e-3}
_DIGIT = {"tan_beta": 0.1e-4, "phi": math.radians(0.1), "k0": 1e-5, "k1": 1e-5, "k2": 1e-5}
_INSTRUMENT = Instrument(SCALE, math.atan(TRUTH["tan_beta"]), TRUTH["phi"])
_STEP, _END, _FINE = 0.02, 257.0, 16
_COUNT_NOISE, _WALK = 2e-5, 2e-6
_TRIALS = 20
_SEED = 2024


def five_force(t: Array) -> Array:
    """Specific force (n, 3) [m/s^2]: rising to 120 s, steady to 200 s, fast changes to 257 s; a_Y up to 8 g."""
    rise = np.clip(t / 120.0, 0.0, 1.0)
    fast = np.clip(t - 200.0, 0.0, None)
    a_x = 2.0 * rise + 0.9 * np.sin(2.0 * np.pi * fast / 9.0)
    a_Y = 8.0 * rise * (1.0 - 0.45 * np.sin(2.0 * np.pi * fast / 14.0) ** 2)
    return np.asarray(G0 * np.stack([a_x, a_Y, np.zeros_like(t)], axis=1))


@cache
def _real_record() -> Run:
    """Output angle of the exact motion of an instrument with these errors, with noise."""
    fine = np.linspace(0.0, _END, round(_END / _STEP) * _FINE + 1)
    t = fine[::_FINE]
    model = ErrorModel(k0=TRUTH["k0"] * G0, k1=TRUTH["k1"], k2=TRUTH["k2"] / G0)
    alpha = propagate(_INSTRUMENT, fine, five_force(fine), error_model=model, between="linear")[::_FINE]
    stream = np.random.default_rng(_SEED)
    walk = _WALK * math.sqrt(_STEP) * np.cumsum(stream.standard_normal(t.size))
    psi = alpha - alpha[0] + walk + _COUNT_NOISE * stream.standard_normal(t.size)
    return Run.from_arrays(t, psi, five_force(t), scale_factor=SCALE, serial="five", units="SI")


@cache
def _model_record() -> Run:
    """Output rate [rad/s] of the published model, without noise. Its phase is the integral of K a_x."""
    t = _real_record().t
    f = five_force(t)
    rate = _INSTRUMENT.scale_factor * G0 * (f[:, 0] / G0 + model_error(TRUTH, f, model_phase(_real_record())))
    return Run.from_arrays(t, rate, f, scale_factor=SCALE, kind="rate", serial="five", units="SI")


def _noisy_successes() -> tuple[int, int]:
    """Number of ``_TRIALS`` noisy records in which the published method, and piga's, recovers the truth.

    The records come from the published model, with the random walk of the real record as noise. The published method
    succeeds if all five coefficients are within half of their printed digits. piga's method takes the phase from the
    input and succeeds if all five are within four standard uncertainties.
    """
    clean, successes = _model_record(), [0, 0]
    for seed in range(_TRIALS):
        noise = _WALK / math.sqrt(_STEP) * np.random.default_rng(seed).standard_normal(clean.size)
        noisy = replace(clean, output=clean.output + noise)
        old = published_recursion(noisy, TERMS)
        new = calibrate(noisy, terms=TERMS, method="rate", phase_source="input")
        successes[0] += all(abs(old[name].value - true) <= 0.5 * _DIGIT[name] for name, true in TRUTH.items())
        successes[1] += all(abs(new[name].value - true) <= 4.0 * new[name].std for name, true in TRUTH.items())
    return successes[0], successes[1]


def five() -> Chapter:
    """Recovered values, for the published method and piga's."""
    own = calibrate(_real_record(), terms=TERMS)
    real, modelled = (published_recursion(run, TERMS) for run in (_real_record(), _model_record()))
    values: dict[str, float | Value] = {}
    for name in TRUTH:
        values[name] = Value(own[name].value, tolerance=3.0 * own[name].std, words={"std": own[name].std})
        values[f"{name}-published"] = modelled[name].value
        values[f"{name}-real"] = real[name].value
    old, new = _noisy_successes()
    values |= {"successes-published": float(old), "successes": float(new)}
    return chapter_of("five-coefficients", values)
