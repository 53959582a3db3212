"""Mounting: skew the instrument so that it revolves whatever the load [Wei2024]."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from piga.instrument import Instrument, closed_form, dead_zone, mean_rate
from piga.reports.render.figure import Axis, Figure, Panel, Role, Series
from piga.studies.case import Case, Chapter
from piga.studies.publication import INSTRUMENT, SCALE, TRANSVERSE
from piga.units import ARCSEC, G0

Array = NDArray[np.float64]

_SKEWS = np.geomspace(1.0, 36000.0, 400) * ARCSEC


def chapter() -> Chapter:
    """Which skew keeps a_x^2 > a_t^2 tan^2(beta)."""
    load = TRANSVERSE * G0
    border = math.atan(float(dead_zone(INSTRUMENT, load, 0.0)[1]) / load) / ARCSEC
    source = "[Wei2024] mounting recommendation"
    cases = (
        Case(
            "mounting.least-skew",
            source,
            "least skew against the load at which the gimbal revolves, a_x^2 = a_t^2 tan^2(beta)",
            "arcsec",
            1000.0,
            border,
            1e-9,
            "the condition gives beta itself, whatever the load: rounding",
        ),
        Case(
            "mounting.moves",
            source,
            "skew at which the motion passes one revolution in the long run, found by bisection",
            "arcsec",
            1000.0,
            _revolving_skew(load),
            0.1,
            "within 50 000 s a revolution shows down to 1e-4 of the border: 0.1 arcsec",
        ),
        Case(
            "mounting.shortfall",
            source,
            "mean rate missing at a skew of ten times beta, share of K a_x",
            "1",
            None,
            _shortfall(10.0 * INSTRUMENT.beta, load),
            None,
            "not published: running is not enough, the mean rate is still short by r^2/2 until it is compensated",
        ),
    )
    text = (
        "The whole load a lies across the input axis but for a skew: a_x = a sin(skew), a_t = a cos(skew). The recommendation is "
        "to skew the instrument so far that a_x^2 > a_t^2 tan^2(beta); with the load in one plane this is skew > beta."
    )
    return Chapter("mounting", "Mounting", source, text, cases, (_figure(load),))


def _shortfall(skew: float, load: float) -> float:
    a_x = load * math.sin(skew)
    return 1.0 - float(mean_rate(INSTRUMENT, a_x, load * math.cos(skew), 0.0)) / (INSTRUMENT.scale_factor * a_x)


def _revolving_skew(load: float) -> float:
    """Least skew [arcsec] at which the motion itself turns by a revolution within 50 000 s."""
    low, high = 500.0, 2000.0
    while high - low > 1e-3:
        skew = 0.5 * (low + high)
        angle = skew * ARCSEC
        turned = (
            closed_form(INSTRUMENT, 5e4, load * math.sin(angle), load * math.cos(angle), 0.0)[0]
            - INSTRUMENT.alpha0
        )
        low, high = (low, skew) if turned > 2.0 * math.pi else (skew, high)
    return 0.5 * (low + high)


def _figure(load: float) -> Figure:
    rates, missing = [], []
    roles: tuple[Role, ...] = ("x", "y", "z")
    for seconds, role in zip((100.0, 1000.0, 5000.0), roles, strict=True):
        inst = Instrument(SCALE, seconds * ARCSEC)
        a_x, a_t = load * np.sin(_SKEWS), load * np.cos(_SKEWS)
        share = mean_rate(inst, a_x, a_t, 0.0) / (inst.scale_factor * a_x)
        name = f"beta = {seconds:g} arcsec"
        rates.append(Series(_SKEWS / ARCSEC, share, name, role=role))
        running = share > 0.0
        missing.append(
            Series(_SKEWS[running] / ARCSEC, np.maximum(1.0 - share[running], 1e-9), name, role=role)
        )
    x = Axis("skew of the input axis", "arcsec", log=True)
    left = Panel(x, Axis("mean rate over K a_x", "1"), tuple(rates), "Locked below beta")
    right = Panel(
        x, Axis("missing share of the mean rate", "1", log=True), tuple(missing), "What skew alone leaves"
    )
    return Figure(
        "mounting-skew",
        "How far to skew the instrument",
        (left, right),
        "Left: below a skew of beta the gimbal locks and nothing is measured; above, the mean rate rises to K a_x. Right: the "
        "missing share falls as (beta/skew)^2/2, so that skew alone does not replace compensation.",
        columns=2,
        height=3.0,
    )
