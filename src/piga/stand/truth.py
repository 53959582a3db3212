"""The truth beside a simulated test, under the names and units of a calibration."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from piga.instrument.twin.parameters import TwinParameters
from piga.instrument.twin.predictions import (
    predicted_k2,
    predicted_rate_error,
    predicted_rectification,
    predicted_second_harmonic,
    servo_terms,
)
from piga.records.terms import si_factor, unit_of
from piga.stand.imperfections import Imperfections
from piga.stand.simulate import SimulatedTest
from piga.units import G0, parse_unit

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TrueValue:
    """One true value: ``value`` in ``unit``; ``segment`` when it holds for one segment only."""

    name: str
    value: float
    unit: str
    segment: str | None = None
    note: str = ""


def coefficients(test: SimulatedTest) -> tuple[TrueValue, ...]:
    """True coefficients: scale factor, tan beta, phases, and every term that is not zero.

    With the twin, bias and k2 that its torques and inertias make are added to those of the error model, and the terms
    ``servo`` and ``servo_damping`` are what its servo is predicted to make at a small rate.
    Harmonics are turned to the zero of the output angle.
    """
    own = test.specimen.instrument
    values = {"scale_factor": own.scale_factor, "tan_beta": abs(own.tan_beta)}
    model = test.specimen.error_model
    values |= {f.name: getattr(model, f.name) for f in fields(model) if f.name not in ("T_ref", "s1", "c1")}
    values |= {"servo": test.specimen.servo, "servo_damping": test.specimen.servo_damping}
    if test.model == "twin":
        for name, extra in _of_twin(test.specimen.design).items():
            values[name] += extra
    kept = [
        TrueValue(name, value / si_factor(name), unit_of(name))
        for name, value in values.items()
        if value != 0.0 or name in ("scale_factor", "tan_beta", "k0")
    ]
    return (*kept, *_harmonics(test), *_phases(test))


def _of_twin(p: TwinParameters) -> dict[str, float]:
    """Bias [m/s^2] from torques about the inner axis, k2 [1/(m/s^2)] from the float's inertia, the servo's terms."""
    bias = (p.restoring * (p.pick_off_null - p.restoring_zero) - p.inner_torque) / p.pendulosity
    values = {"k0": bias, "k2": predicted_k2(p)}
    if p.integral_gain > 0.0:
        terms = servo_terms(p)
        values |= {"servo": terms.servo, "servo_damping": terms.servo_damping}
    return values


def _harmonics(test: SimulatedTest) -> tuple[TrueValue, ...]:
    orders = dict(test.specimen.harmonics)
    model = test.specimen.error_model
    if model.s1 or model.c1:
        sine, cosine = orders.get(1, (0.0, 0.0))
        orders[1] = (sine + model.s1, cosine + model.c1)
    values = []
    for order, (sine, cosine) in sorted(orders.items()):
        c, s = math.cos(order * test.phases[0]), math.sin(order * test.phases[0])
        values.append(TrueValue(f"s{order}", (sine * c - cosine * s) / G0, "g"))
        values.append(TrueValue(f"c{order}", (sine * s + cosine * c) / G0, "g"))
    return tuple(values)


def _phases(test: SimulatedTest) -> tuple[TrueValue, ...]:
    """``phi``: one when all segments share it, else one per segment."""
    turn = math.pi if test.specimen.instrument.beta < 0.0 else 0.0
    phases = [math.remainder(phase + turn, 2.0 * math.pi) for phase in test.phases]
    if shares_phase(test):
        return (TrueValue("phi", phases[0], "rad"),)
    return tuple(TrueValue("phi", p, "rad", name) for p, name in zip(phases, test.log.labels, strict=True))


def shares_phase(test: SimulatedTest) -> bool:
    """Whether the counter keeps its zero through the whole test."""
    e = test.electronics
    if e.counter_bits is None or float(1 << e.counter_bits) % e.counts_per_revolution == 0.0:
        return True
    return not bool((np.diff(test.log.t) > 1.5 * e.interval).any())


def imperfection_values(errors: Imperfections) -> tuple[TrueValue, ...]:
    """Imperfections that are not zero, in the units of the uncertainty budget; vectors by component."""
    rows = []
    for entry in fields(errors):
        value, unit = getattr(errors, entry.name), str(entry.metadata["unit"])
        factor = parse_unit(unit).factor
        if entry.name == "angle_harmonics":
            rows += [
                TrueValue(f"{entry.name}[{n}]", a / factor, unit, note=f"phase {p:g} rad") for n, a, p in value
            ]
        elif isinstance(value, tuple):
            names = ("X0", "Y0", "Z0") if len(value) == 3 else ("1", "2")
            rows += [
                TrueValue(f"{entry.name} {n}", v / factor, unit) for n, v in zip(names, value, strict=True) if v
            ]
        elif value:
            rows.append(TrueValue(entry.name, value / factor, unit))
    return tuple(rows)


def predicted_angle_error(test: SimulatedTest) -> Array:
    """Output angle of the twin less that of the quasi-steady model [rad], predicted at the rows of the log.

    Integral of :func:`piga.instrument.twin.predictions.predicted_rate_error` along the test; zero for the
    quasi-steady model. What a calibration of the log finds wrong is this, seen through its regressors.
    """
    if test.model != "twin":
        return np.zeros(test.log.t.size)
    profile = test.profile
    error = predicted_rate_error(test.specimen.design, profile.t, test.alpha, profile.force, profile.base_rate)
    steps = 0.5 * (error[1:] + error[:-1]) * np.diff(profile.t)
    return np.interp(test.log.t, profile.t, np.concatenate([[0.0], np.cumsum(steps)]))


def predictions(test: SimulatedTest) -> tuple[TrueValue, ...]:
    """What the twin does that the quasi-steady model cannot, at 1 g along and 1 g across the input axis."""
    if test.model != "twin":
        return ()
    p = test.specimen.design
    rate = p.K * G0
    shift = predicted_rectification(p, G0, rate)
    ripple = predicted_second_harmonic(p, G0, rate)
    return (
        TrueValue("rectification", shift / rate, "1", note="relative shift of the mean rate, 1 g and 1 g"),
        TrueValue("second_harmonic", ripple / (p.K * G0), "g", note="at twice the gimbal angle, 1 g and 1 g"),
    )
