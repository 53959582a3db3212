"""Figures and tables of docs/theory/twin.md, figure of the triad.

Run ``python -m builders.build_twin_figures [STUDY ...]`` from the root.

The tables go into ``docs/measured``; then run ``python benchmarks/measured.py``.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from benchmarks.harness import put_table
from benchmarks.measured import ROOT, rounded
from scipy.integrate import solve_ivp
from tests.compensation.twin_triad import run as run_triad
from tests.compensation.twin_triad import spectrum
from tests.stand.simulated import predicted_angle_error

from piga._kernels.motion import servo
from piga.calibration.calibrate import calibrate
from piga.calibration.orders import order_spectrum
from piga.earth import Site
from piga.instrument import ErrorModel, Instrument, propagate
from piga.instrument.twin.electronics import Electronics
from piga.instrument.twin.linear import (
    analyse_loop,
    predicted_k2,
    predicted_rectification,
    predicted_second_harmonic,
)
from piga.instrument.twin.parameters import PRESETS
from piga.instrument.twin.run import run_twin
from piga.reports.calibration.figures import spectrum_figure
from piga.reports.calibration.tables import scale_factor
from piga.reports.render.axes import write_figure
from piga.reports.render.figure import Plot, axis
from piga.reports.stand import bode_figure, pole_figure, servo_figure, step_figure
from piga.stand import DividingHead, Specimen, read_run, read_scenario, run_scenario, simulate_test
from piga.stand.write_run import coefficients, run_file_text, write_data
from piga.units import ARCSEC, G0

OUT = ROOT / "docs" / "figures"
EXAMPLE = PRESETS["example"]


def constant(f, duration, step=2e-3):
    t = np.arange(round(duration / step) + 1) * step
    return t, np.tile(np.asarray(f, float), (t.size, 1))


def mean_rate(p, a_x, a_t, turns=3):
    """Mean rate over whole revolutions, and the motion."""
    t, f = constant((a_x, a_t, 0.0), (turns + 0.2) * 2 * math.pi / (p.K * abs(a_x)))
    motion = run_twin(p, t, f)
    return 2 * math.pi * turns / np.interp(motion.alpha[0] + 2 * math.pi * turns, motion.alpha, t), motion


def second_harmonic(motion, w):
    one = motion.alpha < motion.alpha[0] + 2 * math.pi
    phase, ripple = motion.alpha[one], motion.rate[one] - w
    basis = np.column_stack([np.ones(phase.size), *(f(n * phase) for n in (1, 2) for f in (np.cos, np.sin))])
    fit = np.linalg.lstsq(basis, ripple, rcond=None)[0]
    return math.hypot(fit[3], fit[4])


def save(drawn, caption=""):
    figure = drawn.caption(caption) if isinstance(drawn, Plot) else drawn
    write_figure(figure, OUT / f"{figure.key}.svg")


def record(study, corner, rows, conditions):
    """Write a table of the page."""
    command = f"python -m builders.build_twin_figures {study}"
    put_table(f"twin-{study}", corner, rows, record=True, command=command, conditions=conditions)


def significant(value, digits, unit="1"):
    """A cell with so many digits."""
    return {"value": rounded(value, digits), "unit": unit}


def fixed(value, decimals, unit="1"):
    """A cell with so many decimals."""
    return {"value": round(float(value), decimals) + 0.0, "unit": unit, "decimals": decimals}


def stiffening():
    t, f = constant((2 * G0, G0, 0.0), 10.0, 5e-3)
    quasi = propagate(Instrument(EXAMPLE.K, 1e-3, 0.2), t, f, between="linear")
    factors = np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0])
    errors, rows = [], {}
    for factor in factors:
        p = replace(EXAMPLE, pick_off_null=1e-3, alpha0=0.2, rate_gain=0.1).stiffened(factor)
        errors.append(float(np.max(np.abs(run_twin(p, t, f).alpha - quasi))))
        rows[f"{factor:g}"] = {
            "largest difference": significant(errors[-1], 4, "rad"),
            "times s": significant(errors[-1] * factor, 4, "rad"),
        }
    order = -np.polyfit(np.log(factors[1:]), np.log(errors[1:]), 1)[0]
    record("stiffening", "s", rows, f"preset `example`, 2 g along, 1 g across, 10 s; fitted order {order:.3f}")
    line = errors[-1] * factors[-1] / factors
    plot = Plot(
        "twin-stiffening", "Towards the quasi-steady model",
        "log all servo gains, multiplied by", "log largest difference in 10 s [rad]",
    )  # fmt: skip
    plot.points(factors, errors, "twin less quasi-steady")
    save(plot.dashed(factors, line, "first order", "muted"))


def rectification():
    gains = np.geomspace(600.0, 6000.0, 9)
    a_x, a_t = 2 * G0, G0
    w = EXAMPLE.K * a_x
    rows, table = [], {}
    for k_i in gains:
        p = replace(EXAMPLE, integral_gain=k_i, proportional_gain=60.0, rate_gain=0.1)
        mean, motion = mean_rate(p, a_x, a_t)
        textbook = p.K * a_t**2 * p.pendulosity * w / (2 * k_i)
        harmonic = second_harmonic(motion, w)
        rows.append((w - mean, textbook, -predicted_rectification(p, a_t, w), harmonic))
        full = predicted_second_harmonic(p, a_t, w)
        table[f"{k_i:.0f}"] = {
            "fall of the mean rate": significant(w - mean, 5, "rad/s"),
            "by K a_t² ml w/(2 k_i)": significant(textbook, 5, "rad/s"),
            "difference": fixed(100 * ((w - mean) / textbook - 1), 2, "%"),
            "second harmonic": significant(harmonic, 5, "rad/s"),
            "less the same formula": fixed(100 * (harmonic / textbook - 1), 2, "%"),
            "less abs(G)": fixed(100 * (harmonic / full - 1), 2, "%"),
        }
    record(
        "rectification",
        "k_i",
        {name: cells for k, (name, cells) in enumerate(table.items()) if k % 2 == 0},
        "preset `example` with k_p = 60 and k_d = 0.1; 2 g along, 1 g across, three whole revolutions",
    )
    shift, textbook, full, harmonic = (1e6 * np.array(column) for column in zip(*rows, strict=True))
    gain = 1e-3 * gains
    plot = Plot("twin-rectification", "Finite servo stiffness", columns=2)
    for name, title, values in (
        ("fall of the mean rate", "Rectification", shift), ("amplitude at order 2", "Second harmonic", harmonic)
    ):  # fmt: skip
        plot.panel("integral gain [kNm/(rad s)]", f"log {name} [urad/s]", title)
        plot.points(gain, values, "twin").line(gain, textbook, "K a_t² ml w/(2 k_i)", "model")
        if title == "Rectification":
            plot.dashed(gain, full, "with full compliance")
    save(plot)


def coulomb():
    friction = np.array([0.0, 1e-3, 2e-3, 4e-3, 8e-3])
    shifts, rates, rows = [], [], {}
    base = None
    for value in friction:
        p = replace(EXAMPLE, integral_gain=0.0, coulomb_friction=value)
        mean, motion = mean_rate(p, 2 * G0, 0.3 * G0, 2)
        base = base or (motion.beta.mean(), mean)
        shifts.append((motion.beta.mean() - base[0]) / ARCSEC)
        rates.append(1e6 * (mean / base[1] - 1))
        rows[f"{1e3 * value:g} mNm"] = {
            "shift of beta": fixed(shifts[-1], 3, "arcsec"),
            "-M_c/k_p": fixed(-value / p.proportional_gain / ARCSEC, 3, "arcsec"),
            "change of the mean rate": fixed(rates[-1], 3, "ppm"),
        }
    rows.pop("0 mNm")
    record("coulomb", "M_c", rows, "preset `example` without integral action; 2 g along, 0.3 g across")
    plot = Plot("twin-coulomb", "Coulomb friction on the outer axis", columns=2)
    plot.panel("Coulomb friction [mNm]", "shift of beta [arcsec]", "Tilt").points(
        1e3 * friction, shifts, "twin"
    )
    plot.line(1e3 * friction, -friction / EXAMPLE.proportional_gain / ARCSEC, "-M_c/k_p", "model")
    y = axis("change of the mean rate [ppm]", limits=(-1.0, 1.0))
    save(plot.panel("Coulomb friction [mNm]", y, "Mean rate").marked(1e3 * friction, rates, "twin"))


def k2():
    products = np.array([-4e-6, -2e-6, 0.0, 2e-6, 4e-6])
    result, predicted, rows = [], [], {}
    for product in products:
        p = replace(EXAMPLE, product_of_inertia=product)
        even = 0.0
        for sign in (1.0, -1.0):
            t, f = constant((sign * 2 * G0, 0.0, 0.0), 2.0)
            motion = run_twin(p, t, f)
            even += 0.5 * ((motion.alpha[-1] - motion.alpha[0]) / t[-1] / p.K - sign * 2 * G0)
        result.append(even / (2 * G0) ** 2 * G0 * 1e6)
        predicted.append(predicted_k2(p) * G0 * 1e6)
        rows[f"{product:g} kg m²"] = {
            name: fixed(value, 5, "µg/g²") | {"digits": 7}
            for name, value in (("twin", result[-1]), ("D K² g/(ml)", predicted[-1]))
        }
    rows.pop("0 kg m²")
    record("k2", "D", rows, "preset `example`; even part of the rate at plus and minus 2 g")
    plot = Plot("twin-k2", "The origin of k2", "product of inertia D [mg m^2]", "k2 [ug/g^2]")
    save(plot.points(1e6 * products, result, "twin").line(1e6 * products, predicted, "D K² g/ml", "model"))


def start_up():
    p = replace(EXAMPLE, alpha0=0.7)
    t, f = constant((G0, 0.5 * G0, 0.0), 0.2, 2e-4)
    runs = {name: run_twin(p, t, f, start=name) for name in ("transient", "slow-manifold")}
    plot = Plot("twin-start", "Two ways to start", columns=2).panel("time [ms]", "tilt [arcsec]", "Tilt")
    roles = {"transient": "before", "slow-manifold": "after"}
    for name, motion in runs.items():
        plot.line(1e3 * t, motion.beta / ARCSEC, name, roles[name])
    plot.panel(axis("time [ms]", limits=(0.0, 40.0)), "rate/(K a_x)", "Output rate")
    for name, motion in runs.items():
        plot.line(1e3 * t[:201], motion.rate[:201] / (p.K * G0), name, roles[name])
    save(plot)


def accuracy():
    """Against SciPy with the same right-hand side, 10 s from rest, for several tolerances."""
    p = replace(PRESETS["example-floated"], pick_off_null=3e-3, product_of_inertia=2e-5, hunting=1e-3)
    t, f = constant((G0, 0.3 * G0, 0.2 * G0), 10.0, 1e-3)
    omega = np.tile([1e-3, 0.05, -0.03], (t.size, 1))
    out, constants = np.zeros(5), p.constants()

    def rhs(s, x):
        servo.derivative(constants, s, x, servo.Inputs(*f[0], *omega[0], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), out)
        return out.copy()

    start, rows = [p.alpha0, p.pick_off_null, 0.0, 0.0, 0.0], {}
    for method in ("DOP853", "Radau"):
        truth = solve_ivp(rhs, (0, 10.0), start, method=method, rtol=1e-12, atol=1e-14, t_eval=t[::50]).y[0]
        for tolerance in (1e-8, 1e-12):
            motion = run_twin(p, t, f, omega, start="transient", accuracy=tolerance)
            error = np.max(np.abs(motion.alpha[::50] - truth))
            rows[f"{method}, {tolerance:.0e}".replace("e-0", "e-")] = {
                "largest difference in alpha": significant(error, 2, "rad"),
                "own estimate, summed": significant(motion.local_error, 2, "rad"),
                "steps": int(motion.steps),
            }
    record(
        "accuracy",
        "SciPy method, local error allowed [rad]",
        rows,
        "10 s from rest with start-up transient, hunting wheel and turning base; preset `example-floated`",
    )


def loop():
    for figure in (bode_figure(EXAMPLE), step_figure(EXAMPLE), pole_figure(EXAMPLE)):
        save(replace(figure, key=f"twin-{figure.key}"))
    rows = {}
    for name, p in PRESETS.items():
        a = analyse_loop(p)
        cells = {
            "H/sqrt(J_x B)": (p.nutation / 2 / math.pi, 1, "Hz"),
            "nutation in the loop": (a.nutation / 2 / math.pi, 1, "Hz"),
            "damping": (a.nutation_damping, 2, "1"),
            "crossover": (a.crossover / 2 / math.pi, 1, "Hz"),
            "phase margin": (math.degrees(a.phase_margin), 1, "deg"),
            "gain margin": (20 * math.log10(a.gain_margin), 1, "dB"),
            "bandwidth": (a.bandwidth / 2 / math.pi, 0, "Hz"),
        }
        rows[name] = {
            column: fixed(value, digits, unit)
            for column, (value, digits, unit) in cells.items()
            if math.isfinite(value)
        }
    record("loop", "preset", rows, "an empty gain margin: no gain makes the loop unstable")


def recorded(scenario, test, folder):
    write_data(test, folder / "run.parquet")
    (folder / "run.toml").write_text(run_file_text(scenario, test, "run.parquet"), encoding="utf-8")
    return read_run(folder / "run.toml")


def round_trip():
    """Calibrate a twin run of the dividing head: without the servo's terms, with the predicted error off, with the terms."""
    examples = Path(__file__).parents[1] / "examples"
    scenario = read_scenario(examples / "twin.toml")
    test = run_scenario(scenario)
    truth = {v.name: v.value for v in coefficients(test)}
    with tempfile.TemporaryDirectory() as folder:
        run = recorded(scenario, test, Path(folder))
    plain = [name for name in run.model.terms if not name.startswith("servo")]
    raw = calibrate(run, plain)
    corrected = calibrate(replace(run, output=run.output - predicted_angle_error(test)), plain)
    full = calibrate(run)
    columns = ("without the terms", raw), ("predicted error taken off", corrected), ("with the terms", full)
    rows = {}
    for c in full.coefficients:
        own = {"truth": truth[c.name]}
        own |= {
            column: fit[c.name].value for column, fit in columns if c.name in {b.name for b in fit.coefficients}
        }
        rows[f"{c.name} [{c.unit}]"] = {
            column: {"value": rounded(value, 7), "digits": 7} for column, value in own.items()
        } | {
            "u": rounded(c.std, 2),
            "error/u": {"value": round((c.value - truth[c.name]) / c.std, 1) + 0.0, "decimals": 1},
        }
    rows["residual, rms [rad]"] = {column: rounded(fit.residual_rms, 3) for column, fit in columns}
    record(
        "round-trip", "coefficient", rows, "`examples/twin.toml`; u is the standard uncertainty with the terms"
    )


def missing_harmonic():
    """Spectrum of the residuals of a soft servo, calibrated without harmonics."""
    scenario = read_scenario(Path(__file__).parents[1] / "examples" / "twin.toml")
    stand = DividingHead(Site(math.radians(40.0)), (math.pi / 4, 7 * math.pi / 4), dwell=120.0, move=5.0)
    soft = Specimen(
        Instrument("0.8884 rad/s/g", "74 arcsec", 0.8), ErrorModel(), twin=replace(EXAMPLE, integral_gain=0.0)
    )
    test = simulate_test(stand, soft, Electronics(sample_rate=20.0), model="twin")
    with tempfile.TemporaryDirectory() as folder:
        cal = calibrate(recorded(scenario, test, Path(folder)), ["tan_beta", "k0"])
    figure = spectrum_figure(order_spectrum(cal.residuals, scale_factor(cal)))
    save(replace(figure, key="twin-order-two", title="A soft servo shows at order 2"))


def lock():
    test = run_scenario(read_scenario(Path(__file__).parents[1] / "examples" / "twin-spin-up.toml"))
    save(replace(servo_figure(test, test.motion), key="twin-lock"))
    changes = test.motion.lock_changes()
    print(f"first lost {changes[0]}, last recovered {changes[-1]}, {len(changes)} changes")


def triad():
    """Error along an input axis by revolution order: raw, compensated, and the noise that was put in."""
    orders, outcome = np.arange(0.3, 5.01, 0.02), run_triad(120.0)

    title = "A triad of servo twins, before and after compensation."
    plot = Plot(
        "compensation-triad-orders", title, "revolution order [cycles/rev]", "log error along the input axis [µg]", height=3.0
    )  # fmt: skip
    for name, error in (("before", outcome.before), ("after", outcome.after), ("noise put in", outcome.noise)):
        size = spectrum(outcome.psi, error, orders) / (1e-6 * G0)
        plot.line(orders, size, name, "reference", dashed=name == "noise put in")
    save(plot, "Three twins on a cone, 120 s of slow swing. Order 1 is cross-coupling.")


STUDIES = (
    loop, stiffening, rectification, coulomb, k2, start_up, accuracy, round_trip, missing_harmonic, lock, triad,
)  # fmt: skip


def main():
    OUT.mkdir(parents=True, exist_ok=True)
    studies = {study.__name__.replace("_", "-"): study for study in STUDIES}
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("studies", nargs="*", choices=[*studies, []], help="all when none is named")
    for name in parser.parse_args().studies or studies:
        print(f"\n{name}")
        studies[name]()


if __name__ == "__main__":
    main()
