"""Figures and tables of docs/twin.md: run ``python builders/build_twin_figures.py`` from the repository root."""

from __future__ import annotations

import math
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from piga._kernels.motion import servo
from piga.calibration.calibrate import calibrate
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
from piga.reports.calibration.figures import order_spectrum, scale_factor, spectrum_figure
from piga.reports.render.figure import Axis, Figure, Panel, Series
from piga.reports.render.static import write_figure
from piga.reports.stand import loop_figures, servo_figure
from piga.stand import DividingHead, Specimen, read_run, read_scenario, run_scenario, simulate_test
from piga.stand.write_run import coefficients, predicted_angle_error, run_file_text, write_data
from piga.units import ARCSEC, G0

OUT = Path(__file__).parents[1] / "docs" / "figures"
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


def save(figure):
    write_figure(figure, OUT / f"{figure.key}.svg")


def row(*cells):
    print("| " + " | ".join(str(cell) for cell in cells) + " |")


def stiffening():
    t, f = constant((2 * G0, G0, 0.0), 10.0, 5e-3)
    quasi = propagate(Instrument(EXAMPLE.K, 1e-3, 0.2), t, f)
    factors = np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0])
    errors = []
    for factor in factors:
        p = replace(EXAMPLE, pick_off_null=1e-3, alpha0=0.2, rate_gain=0.1).stiffened(factor)
        errors.append(float(np.max(np.abs(run_twin(p, t, f).alpha - quasi))))
        row(f"{factor:g}", f"{errors[-1]:.3e}", f"{errors[-1] * factor:.3e}")
    order = -np.polyfit(np.log(factors[1:]), np.log(errors[1:]), 1)[0]
    print(f"order {order:.4f}")
    line = errors[-1] * factors[-1] / factors
    panel = Panel(
        Axis("all servo gains, multiplied by", "1", log=True),
        Axis("largest difference in 10 s", "rad", log=True),
        (
            Series(factors, errors, name="twin less quasi-steady", mark="points"),
            Series(factors, line, name="first order", role="muted", dashed=True),
        ),
    )
    save(Figure("twin-stiffening", "Towards the quasi-steady model", (panel,)))


def rectification():
    gains = np.geomspace(600.0, 6000.0, 9)
    a_x, a_t = 2 * G0, G0
    w = EXAMPLE.K * a_x
    rows = []
    for k_i in gains:
        p = replace(EXAMPLE, integral_gain=k_i, proportional_gain=60.0, rate_gain=0.1)
        mean, motion = mean_rate(p, a_x, a_t)
        textbook = p.K * a_t**2 * p.pendulosity * w / (2 * k_i)
        harmonic = second_harmonic(motion, w)
        rows.append((w - mean, textbook, -predicted_rectification(p, a_t, w), harmonic))
        row(
            f"{k_i:.0f}", f"{w - mean:.4e}", f"{textbook:.4e}", f"{100 * ((w - mean) / textbook - 1):+.2f} %",
            f"{harmonic:.4e}", f"{100 * (harmonic / textbook - 1):+.2f} %",
            f"{100 * (harmonic / predicted_second_harmonic(p, a_t, w) - 1):+.2f} %",
        )  # fmt: skip
    shift, textbook, full, harmonic = (1e6 * np.array(column) for column in zip(*rows, strict=True))
    panels = tuple(
        Panel(
            Axis("integral gain", "kNm/(rad s)"),
            Axis(name, "urad/s", log=True),
            (
                Series(1e-3 * gains, measured, name="twin", mark="points"),
                Series(1e-3 * gains, textbook, name="K a_t² ml w/(2 k_i)", role="model"),
                *extra,
            ),
            title,
        )
        for name, title, measured, extra in (
            (
                "fall of the mean rate",
                "Rectification",
                shift,
                (Series(1e-3 * gains, full, name="with full compliance", role="reference", dashed=True),),
            ),
            ("amplitude at order 2", "Second harmonic", harmonic, ()),
        )
    )
    save(Figure("twin-rectification", "Finite servo stiffness", panels, columns=2))


def coulomb():
    friction = np.array([0.0, 1e-3, 2e-3, 4e-3, 8e-3])
    shifts, rates = [], []
    base = None
    for value in friction:
        p = replace(EXAMPLE, integral_gain=0.0, coulomb_friction=value)
        mean, motion = mean_rate(p, 2 * G0, 0.3 * G0, 2)
        base = base or (motion.beta.mean(), mean)
        shifts.append((motion.beta.mean() - base[0]) / ARCSEC)
        rates.append(1e6 * (mean / base[1] - 1))
        row(
            f"{1e3 * value:g}",
            f"{shifts[-1]:.3f}",
            f"{-value / p.proportional_gain / ARCSEC:.3f}",
            f"{rates[-1]:+.4f}",
        )
    predicted = -friction / EXAMPLE.proportional_gain / ARCSEC
    panels = (
        Panel(
            Axis("Coulomb friction", "mNm"),
            Axis("shift of beta", "arcsec"),
            (
                Series(1e3 * friction, shifts, name="twin", mark="points"),
                Series(1e3 * friction, predicted, name="-M_c/k_p", role="model"),
            ),
            "Tilt",
        ),
        Panel(
            Axis("Coulomb friction", "mNm"),
            Axis("change of the mean rate", "ppm", limits=(-1.0, 1.0)),
            (Series(1e3 * friction, rates, name="twin", mark="line+points"),),
            "Mean rate",
        ),
    )  # fmt: skip
    save(Figure("twin-coulomb", "Coulomb friction on the outer axis", panels, columns=2))


def k2():
    products = np.array([-4e-6, -2e-6, 0.0, 2e-6, 4e-6])
    found, predicted = [], []
    for product in products:
        p = replace(EXAMPLE, product_of_inertia=product)
        even = 0.0
        for sign in (1.0, -1.0):
            t, f = constant((sign * 2 * G0, 0.0, 0.0), 2.0)
            motion = run_twin(p, t, f)
            even += 0.5 * ((motion.alpha[-1] - motion.alpha[0]) / t[-1] / p.K - sign * 2 * G0)
        found.append(even / (2 * G0) ** 2 * G0 * 1e6)
        predicted.append(predicted_k2(p) * G0 * 1e6)
        row(f"{product:g}", f"{found[-1]:.5f}", f"{predicted[-1]:.5f}")
    panel = Panel(
        Axis("product of inertia D", "mg m^2"),
        Axis("k2", "ug/g^2"),
        (
            Series(1e6 * products, found, name="twin", mark="points"),
            Series(1e6 * products, predicted, name="D K² g/ml", role="model"),
        ),
    )  # fmt: skip
    save(Figure("twin-k2", "The origin of k2", (panel,)))


def start_up():
    p = replace(EXAMPLE, alpha0=0.7)
    t, f = constant((G0, 0.5 * G0, 0.0), 0.2, 2e-4)
    runs = {name: run_twin(p, t, f, start=name) for name in ("transient", "slow-manifold")}
    series = tuple(
        Series(1e3 * t, motion.beta / ARCSEC, name=name, role="before" if name == "transient" else "after")
        for name, motion in runs.items()
    )
    panels = (
        Panel(Axis("time", "ms"), Axis("tilt", "arcsec"), series, "Tilt"),
        Panel(
            Axis("time", "ms", limits=(0.0, 40.0)),
            Axis("rate/(K a_x)", "1"),
            tuple(
                Series(1e3 * t[:201], m.rate[:201] / (p.K * G0), name=n, role=s.role)
                for (n, m), s in zip(runs.items(), series, strict=True)
            ),
            "Output rate",
        ),
    )  # fmt: skip
    save(Figure("twin-start", "Two ways to start", panels, columns=2))


def accuracy():
    """Against SciPy with the same right-hand side, 10 s from rest, for several tolerances."""
    p = replace(PRESETS["example-floated"], pick_off_null=3e-3, product_of_inertia=2e-5, hunting=1e-3)
    t, f = constant((G0, 0.3 * G0, 0.2 * G0), 10.0, 1e-3)
    omega = np.tile([1e-3, 0.05, -0.03], (t.size, 1))
    out, constants = np.zeros(5), p.constants()

    def rhs(s, x):
        servo.derivative(constants, s, x, servo.Inputs(*f[0], *omega[0], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), out)
        return out.copy()

    start = [p.alpha0, p.pick_off_null, 0.0, 0.0, 0.0]
    for method in ("DOP853", "Radau"):
        truth = solve_ivp(rhs, (0, 10.0), start, method=method, rtol=1e-12, atol=1e-14, t_eval=t[::50]).y[0]
        for tolerance in (1e-8, 1e-10, 1e-12):
            motion = run_twin(p, t, f, omega, start="transient", accuracy=tolerance)
            error = np.max(np.abs(motion.alpha[::50] - truth))
            row(method, f"{tolerance:g}", f"{error:.1e}", f"{motion.local_error:.1e}", motion.steps)


def speed():
    t, f = constant((G0, 0.3 * G0, 0.0), 600.0, 1e-3)
    noise = np.zeros_like(f)
    noise[:, 2] = 1e-7 * np.random.default_rng(1).standard_normal(t.size)
    run_twin(EXAMPLE, t[:10], f[:10])
    inst = Instrument(EXAMPLE.K, 1e-3)
    propagate(inst, t[:10], f[:10])
    started = time.perf_counter()
    propagate(inst, t, f)
    row("quasi-steady", f"{time.perf_counter() - started:.2f}")
    for name, p in PRESETS.items():
        for label, held in (("quiet", None), ("pick-off noise", noise)):
            started = time.perf_counter()
            run_twin(p, t, f, noise=held)
            row(f"twin, {name}, {label}", f"{time.perf_counter() - started:.2f}")


def loop():
    for figure in loop_figures(EXAMPLE):
        save(replace(figure, key=f"twin-{figure.key}"))
    for name, p in PRESETS.items():
        a = analyse_loop(p)
        row(
            name, f"{p.nutation / 2 / math.pi:.1f}", f"{a.nutation / 2 / math.pi:.1f}", f"{a.nutation_damping:.2f}",
            f"{a.crossover / 2 / math.pi:.1f}", f"{math.degrees(a.phase_margin):.1f}",
            f"{20 * math.log10(a.gain_margin):.1f}" if math.isfinite(a.gain_margin) else "unlimited",
            f"{a.bandwidth / 2 / math.pi:.0f}",
        )  # fmt: skip


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
    names = {c.name for c in raw.coefficients}
    for c in full.coefficients:
        others = [f"{k[c.name].value:.7g}" if c.name in names else "" for k in (raw, corrected)]
        row(
            c.name, f"{truth[c.name]:.7g}", *others, f"{c.value:.7g}", f"{c.std:.1g}",
            f"{(c.value - truth[c.name]) / c.std:+.1f}", c.unit,
        )  # fmt: skip
    print("residual rms [rad]", *(f"{k.residual_rms:.3e}" for k in (raw, corrected, full)))


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
    save(replace(servo_figure(test), key="twin-lock"))
    changes = test.motion.lock_changes()
    print(f"first lost {changes[0]}, last recovered {changes[-1]}, {len(changes)} changes")


def main():
    OUT.mkdir(parents=True, exist_ok=True)
    studies = (
        loop,
        stiffening,
        rectification,
        coulomb,
        k2,
        start_up,
        accuracy,
        speed,
        round_trip,
        missing_harmonic,
        lock,
    )
    for study in studies:
        print(f"\n{study.__name__}")
        study()


if __name__ == "__main__":
    main()
