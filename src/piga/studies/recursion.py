"""[Wei2024]: the time-varying run, the skew that avoids locking, calibration, compensation, five coefficients; and the errata."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np

from piga.calibration.calibrate import calibrate
from piga.instrument import ErrorModel, Instrument, closed_form, dead_zone, mean_rate, propagate
from piga.records import Calibration, Run
from piga.reports.render.figure import Figure, Plot, Role, axis
from piga.results import Array
from piga.studies.case import (
    INSTRUMENT,
    RAMP_TOP,
    RATIO,
    SCALE,
    TRANSVERSE,
    Chapter,
    Value,
    chapter_of,
    closed_form_phase,
    compensated_error,
    growing_estimates,
    model_phase,
    model_residual,
    own_calibration,
    published_calibration,
    published_recursion,
    raw_error,
    raw_state,
    record,
    velocity,
)
from piga.studies.constant import EXAMPLES, published_closed_form
from piga.studies.platform import CASE_RATE, CHANNELS, GRAVITY_OF_TABLE, compared, formula, last_lines
from piga.units import ARCMIN, ARCSEC, G0

_PUBLISHED_TAN_BETA, _PUBLISHED_PHASE = 4.848e-3, 0.802
_LATE = 20.0
_EVERY = 20
"""Every 20th sample of the run is drawn: at least seventeen per revolution."""


def run() -> Chapter:
    """a_Y = 5 a_x with a_x up to about 2 g: indicated against true acceleration."""
    log = record("ramp")
    error = raw_error(log)
    late = log.f[:, 0] > 0.5 * RAMP_TOP * G0
    values = {
        "error": float(np.abs(error).max()),
        "growth": float(np.abs(error[late] / (log.f[late, 0] / G0)).max()),
    }
    return chapter_of("time-varying", values, (_run_figure(error),))


def _run_figure(error: Array) -> Figure:
    log = record("ramp")
    drawn = slice(None, None, _EVERY)
    a_x, error = log.f[drawn, 0] / G0, error[drawn]
    indicated = a_x + error
    plot = Plot("time-varying-run", "Indicated against true acceleration, a_Y = 5 a_x", columns=2, height=2.6)
    close = a_x > RAMP_TOP - 0.25
    for part, ends, title in (
        (slice(None), np.array([0.0, RAMP_TOP]), "Indicated against true"),
        (close, a_x[close][[0, -1]], "The last quarter of a g"),
    ):
        plot.panel("true acceleration a_x [g]", "indicated acceleration [g]", title)
        plot.dashed(ends, ends, "ideal").line(a_x[part], indicated[part], "indicated", "before")
    plot.panel("true acceleration a_x [g]", "error [g]", "Error against the input")
    plot.band(a_x, -RATIO * a_x, RATIO * a_x, "envelope 5 a_x tan(beta)")
    plot.line(a_x, error, "error of the indication", "after")
    plot.panel("revolutions of the gimbal", "error [g]", "One period a revolution")
    plot.line(model_phase(log)[drawn] / (2.0 * np.pi), error, "error of the indication", "after")
    return plot.caption(
        "The error reaches 0.05 g at 2 g and repeats with each revolution: on the whole range the indication looks right."
    )


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
    return chapter_of("mounting", values, ())


def _revolving_skew(load: float) -> float:
    """Least skew [arcsec] at which the exact motion makes one revolution within 50 000 s."""
    from scipy.optimize import brentq

    def missing(skew: float) -> float:
        force = load * math.sin(skew * ARCSEC), load * math.cos(skew * ARCSEC), 0.0
        return float(closed_form(INSTRUMENT, 5e4, *force)[0]) - INSTRUMENT.alpha0 - 2.0 * math.pi

    return float(brentq(missing, 500.0, 2000.0, xtol=1e-4))


def recursion() -> Chapter:
    """[tan_beta, phi] from x0 = [4.5e-3, 0.4], P0 = 1e10 I, and wrong convergence with a constant input."""
    tan_beta, phi = raw_state(published_calibration("ramp"))
    wrong_tan_beta, wrong_phi = raw_state(published_calibration("constant"))
    ours, constant_ours = own_calibration("ramp"), own_calibration("constant")
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
    return chapter_of("recursion", values, (_history_figure(),))


def _history_figure() -> Figure:
    """Whole run on the left, from 20 s on the right; tan(beta) above, phi below."""
    t = record("ramp").t
    estimates: tuple[tuple[dict[str, Array], str, Role], ...] = (
        (published_calibration("ramp").history or {}, "published recursion", "before"),
        (growing_estimates(record("ramp"), ("tan_beta",)), "linear estimator, no first guess", "after"),
    )
    plot = Plot("recursion-history", "Recursive calibration: history of the estimates", columns=2, height=2.3)
    for name, scale, y, true, printed in (
        ("tan_beta", 1e3, "tan(beta) [1e-3]", INSTRUMENT.tan_beta, _PUBLISHED_TAN_BETA),
        ("phi", 1.0, "phi [rad]", INSTRUMENT.alpha0, _PUBLISHED_PHASE),
    ):
        for begin in (0.0, _LATE):
            above = "Whole run" if begin == 0.0 else f"From {_LATE:g} s on"
            plot.panel("time [s]", y, above if name == "tan_beta" else "")
            plot.level([begin, t[-1]], scale * true, "true")
            plot.level([begin, t[-1]], scale * printed, "published result", "warning")
            for history, label, role in estimates:
                when = t[history["sample"].astype(int) - 1]
                shown = when >= begin
                plot.line(when[shown], scale * history[name][shown], label, role)
    return plot.caption(
        "The published recursion settles within 20 s; its phase then drifts with the run, through the printed 0.802 rad, and "
        "would go on below the truth in a longer one. The linear estimator is at "
        "the truth as soon as there are more samples than unknowns (noiseless data)."
    )


def compensation() -> Chapter:
    """The published compensation (under 0.002 g) against the exact one (rounding)."""
    log = record("ramp")
    published, ours = published_calibration("ramp"), own_calibration("ramp")
    before, model = raw_error(log), model_residual(log, published)
    formula = compensated_error(log, _with_phase(published, _PUBLISHED_PHASE), "published")
    exact = compensated_error(log, ours, "exact")
    largest = [float(np.abs(error).max()) for error in (before, model, formula, exact)]
    values = {
        "before": largest[0],
        "model-limit": largest[1],
        "model": largest[1],
        "formula": largest[2],
        "exact": largest[3],
    }
    return chapter_of("compensation", values, (_compensation_figure(before, model, formula, exact),))


def _with_phase(calibration: Calibration, phi: float) -> Calibration:
    """The calibration with another phase [rad], as the phase of the output."""
    changed = tuple(replace(c, value=phi) if c.name == "phi" else c for c in calibration.coefficients)
    return replace(calibration, coefficients=changed, phase_source="output")


def _compensation_figure(before: Array, model: Array, formula: Array, exact: Array) -> Figure:
    t = record("ramp").t[::20]
    rows: tuple[tuple[Array, float, str, Role, str], ...] = (
        (before, 1.0, "g", "before", "Before"),
        (model, 1e3, "mg", "warning", "Published, phase from the input"),
        (formula, 1e3, "mg", "z", "Published, phase from the output"),
        (exact, 1e15, "1e-15 g", "after", "Exact"),
    )
    plot = Plot("compensation-errors", "What compensation leaves of the error", columns=2, height=2.3)
    for y, scale, unit, role, title in rows:
        plot.panel("time [s]", f"error [{unit}]", title).line(t, scale * y[::20], role=role)
    return plot.caption(
        "Four scales: g, mg twice, and 1e-15 g. Above right the phase is the integral of K a_x, below left that of the output "
        "plus the printed 0.802 rad. The published compensation takes the error from 0.05 g to "
        f"1 or 2 mg at {RAMP_TOP:g} g; the exact one to rounding."
    )


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
    K = _INSTRUMENT.scale_factor
    a_x, a_Y = f[:, 0] / G0, f[:, 1] / G0
    phase = model_phase(_real_record()) + TRUTH["phi"]
    error = TRUTH["tan_beta"] * a_Y * np.sin(phase) + TRUTH["k0"] + TRUTH["k1"] * a_x + TRUTH["k2"] * a_x**2
    return Run.from_arrays(
        t, K * G0 * (a_x + error), f, scale_factor=SCALE, kind="rate", serial="five", units="SI"
    )


@cache
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


@cache
def own_five() -> Calibration:
    """Calibration of the real record by piga."""
    return calibrate(_real_record(), terms=TERMS)


@cache
def published_five(*, real: bool) -> Calibration:
    """The published recursion from its first guess, on the real record or on a record of the published model."""
    run = _real_record() if real else _model_record()
    return published_recursion(run, TERMS)


def five() -> Chapter:
    """Error curve, fit overlay and recovered values, for the published method and piga's."""
    values: dict[str, float | Value] = {}
    for name in TRUTH:
        ours = own_five()[name]
        values[name] = Value(ours.value, tolerance=3.0 * ours.std, words={"std": ours.std})
        values[f"{name}-published"] = published_five(real=False)[name].value
        values[f"{name}-real"] = published_five(real=True)[name].value
    old, new = _noisy_successes()
    values |= {"successes-published": float(old), "successes": float(new)}
    return chapter_of("five-coefficients", values, (_five_record(), _five_fit(), _five_history()))


def _indicated_error(run: Run) -> tuple[Array, Array, Array]:
    """Time [s], indicated minus true a_x [g] over ten samples, and mean output angle [rad]."""
    t, psi, v = run.t[::10], run.output[::10], velocity(run)[::10]
    error = (np.diff(psi) / run.scale_factor - np.diff(v)) / np.diff(t) / G0
    return 0.5 * (t[1:] + t[:-1]), error, 0.5 * (psi[1:] + psi[:-1])


def _model_error(calibration: Calibration, force: Array, psi: Array) -> Array:
    """Error [g] from the coefficients of a calibration, at force (n, 3) [m/s^2] and phase ``psi`` [rad]."""
    a_x, a_Y = force[:, 0] / G0, force[:, 1] / G0
    value = {name: calibration[name].value for name in TRUTH}
    coupling = value["tan_beta"] * a_Y * np.sin(psi + value["phi"])
    return np.asarray(coupling + value["k0"] + value["k1"] * a_x + value["k2"] * a_x**2)


def _five_record() -> Figure:
    run = _real_record()
    t, error, _ = _indicated_error(run)
    plot = Plot("five-record", "The 257 s record: input and error", height=2.1)
    plot.panel("time [s]", "specific force [g]")
    plot.line(run.t, run.f[:, 0] / G0, "a_x", "x").line(run.t, run.f[:, 1] / G0, "a_Y", "z")
    plot.panel("time [s]", "error of the indication [mg]").line(t, 1e3 * error, "error", "before")
    return plot.caption(
        "Rising to 120 s, steady to 200 s, fast changes to 257 s. The error is bias, slope and bend of a_x with the "
        "cross-coupling of up to 3 mg on top."
    )


def _five_fit() -> Figure:
    run = _real_record()
    t, error, psi = _indicated_error(run)
    force = five_force(t)
    fit = _model_error(own_five(), force, psi)
    old = _model_error(published_five(real=True), force, np.interp(t, run.t, model_phase(run)))
    plot = Plot("five-fit", "Fit of the five coefficients", columns=2, height=2.4)
    for begin, end in ((100.0, 130.0), (215.0, 245.0)):
        part = (t > begin) & (t < end)
        plot.panel("time [s]", "error of the indication [mg]")
        plot.points(t[part], 1e3 * error[part], "record", "muted")
        plot.line(t[part], 1e3 * old[part], "published method", "before")
        plot.line(t[part], 1e3 * fit[part], "linear estimator", "after")
    plot.panel("time [s]", "residual [mg]", "Left by the published method")
    plot.line(t, 1e3 * (error - old), role="before")
    plot.panel("time [s]", "residual [mg]", "Left by the linear estimator")
    plot.line(t, 1e3 * (error - fit), role="after")
    return plot.caption(
        "Above: thirty seconds of the rise and of the fast changes. Below: what each method leaves (means over 0.2 s). Good is "
        "noise without a trace of the gimbal's turns."
    )


_SHOWN = (
    ("tan_beta", 1e3, axis("tan(beta) [1e-3]", limits=(0.0, 0.7))),
    ("phi", 180.0 / math.pi, axis("phi [deg]", limits=(0.0, 40.0))),
    ("k0", 1e3, axis("k0 [mg]", limits=(-4.0, 4.0))),
    ("k1", 1e3, axis("k1 [1e-3]", limits=(-10.0, 10.0))),
    ("k2", 1e3, axis("k2 [mg/g^2]", limits=(-2.0, 4.0))),
)


def _five_history() -> Figure:
    t = _real_record().t
    plot = Plot("five-history", "The five coefficients as the record comes in", columns=2, height=2.0)

    own, published = growing_estimates(_real_record(), TERMS), published_five(real=True).history or {}

    def late(history: dict[str, Array], name: str) -> tuple[Array, Array]:
        """Times from 20 s on, and the history there."""
        when = t[np.minimum(history["sample"].astype(int), t.size) - 1]
        return when[when > 20.0], history[name][when > 20.0]

    for name, scale, y in _SHOWN:
        when, value = late(own, name)
        half = 2.0 * scale * late(own, f"u({name})")[1]
        plot.panel("time [s]", y)
        plot.band(when, scale * value - half, scale * value + half, "95 % interval", "after")
        plot.level([20.0, t[-1]], scale * TRUTH[name], "published value")
        before, old = late(published, name)
        plot.line(before, scale * old, "published method", "before")
        plot.line(when, scale * value, "linear estimator", "after")
    return plot.caption(
        "From 20 s on. The linear estimator runs into the published values inside its stated interval; the published method, "
        "whose phase is predicted from the input, does not on the exact motion."
    )


# -- errors in the publications --------------------------------------------------------------------------

_T = np.linspace(0.0, 60.0, 1201)


def errata() -> Chapter:
    """All errata with their numbers."""
    values = {**_forms(), **_phase(), **_platform()}
    computed = {key: value.computed if isinstance(value, Value) else value for key, value in values.items()}
    signs = [computed[f"sign-{number}"] for number in (2, 3, 4)]
    return chapter_of(
        "errata",
        values,
        (),
        least_sign=min(signs),
        most_sign=max(signs),
        square=computed["square"],
        shift=abs(computed["phase-shift"]),
        residual=1e3 * computed["phase-residual"],
        degrees=computed["degrees"],
        effect=computed["degrees-effect"],
        gravity=computed["gravity"],
        heading=computed["heading-published"],
        roll=computed["roll-published"],
        ours=computed["heading-ours"],
    )


def _forms() -> dict[str, float | Value]:
    """The lost sign of the printed forms, for the a_x of the examples turned negative; the lost square of the critical one."""
    values: dict[str, float | Value] = {}
    for example in EXAMPLES[1:]:
        a_x, a_Y, a_Z = example.force
        force = -a_x, a_Y, a_Z
        exact = closed_form(INSTRUMENT, _T, *force)[1]
        for suffix, printed in (("", True), ("-corrected", False)):
            _, rate = published_closed_form(example.number, INSTRUMENT, _T, *force, as_published=printed)
            values[f"sign-{example.number}{suffix}"] = float(np.abs(rate - exact).max())
    force = EXAMPLES[1].force
    start, top = math.tan(0.5 * INSTRUMENT.alpha0), 2.0 * INSTRUMENT.scale_factor * force[0]
    m = 0.5 * top * _T + (start - 1.0) / (start + 1.0)
    exact = closed_form(INSTRUMENT, _T, *force)[1]
    values["square"] = float(top / (1.0 + m[0]))
    values["square-corrected"] = float(np.abs(top / (1.0 + m * m) - exact).max())
    return values


def _phase() -> dict[str, float | Value]:
    """The phase of the published model, which walks away from the true one by K V r^2/2, and the phase printed in degrees."""
    log, calibration, (constant, lead) = record("ramp"), published_calibration("ramp"), closed_form_phase()
    predicted = model_phase(log)
    walk = predicted + constant - lead - propagate(INSTRUMENT, log.t, log.f, between="linear")
    shift = raw_state(calibration)[1] - (constant - lead)
    misread = compensated_error(log, _with_phase(calibration, math.radians(_PUBLISHED_PHASE)), "published")
    bound = TRANSVERSE * RAMP_TOP * INSTRUMENT.tan_beta * float(np.abs(walk + shift).max())
    left = float(np.abs(model_residual(log, calibration)).max())
    return {
        "phase-walk": float(np.polyfit(0.5 * RATIO**2 * predicted, walk, 1)[0]),
        "phase-shift": shift,
        "phase-residual": Value(left, words={"bound": bound}),
        "degrees": math.degrees(constant - lead),
        "degrees-effect": float(np.abs(misread).max()),
    }


def _platform() -> dict[str, float | Value]:
    """G of the table, and the simulated lines of heading and roll over the formula."""
    values: dict[str, float | Value] = {
        "gravity": 100.0 * (0.222 / (GRAVITY_OF_TABLE * ARCMIN / CASE_RATE) - 1.0)
    }
    lines = last_lines(compared(wobble=False), "A")
    for c in CHANNELS[1:]:
        theory = formula(c.channel)
        values[f"{c.channel}-published"] = 100.0 * (c.simulated * c.scale / theory - 1.0)
        values[f"{c.channel}-ours"] = 100.0 * (lines[c.channel] / theory - 1.0)
    return values
