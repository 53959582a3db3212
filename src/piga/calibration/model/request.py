"""The request of a calibration, checked against the record, and the phase angle of the coupling.

The run file and the arguments of a call together make the request. ``phase_source`` gives the source of the angle:
as read, integrated from a log of rates, or predicted from the input.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from piga.errors import ArgumentError, CalibrationError
from piga.records.arrays import changes, integrated_rate, middles, norms, stored
from piga.records.run import Run
from piga.records.run_file import METHODS, PHASE_SOURCES, PHASES
from piga.records.terms import SERVO_TERMS, check_terms, harmonic, integral_unit, level_in, term_names
from piga.results import Array
from piga.terms import LOGGED_TERMS
from piga.units import to_si

_STUDIES = {
    "published": "piga.studies.published_recursion(run), which repeats the literature",
    "revolutions": "piga.calibrate(piga.studies.whole_turns(run), ['scale_factor', 'k0']): turns show no tan_beta",
}
"""Former methods, and what does the same."""


@dataclass(frozen=True)
class Request:
    """Terms to estimate, phase handling, method, and noise levels when given (SI)."""

    terms: tuple[str, ...]
    phases: str
    phase_source: str
    method: str
    angle_rms: float | None
    angle_random_walk: float | None
    temperature_reference: float
    per_run: tuple[str, ...] | None = None


def harmonics_of(terms: tuple[str, ...]) -> tuple[int, ...]:
    """Orders of the harmonics of the output angle among terms."""
    return tuple(sorted({wave[1] for name in terms if (wave := harmonic(name))}))


def shared_of(terms: tuple[str, ...]) -> tuple[str, ...]:
    """Those terms whose regressor does not depend on the phase."""
    return tuple(name for name in terms if name != "tan_beta" and harmonic(name) is None)


def make_request(
    run: Run,
    terms: str | list[str] | tuple[str, ...] | None = None,
    method: str | None = None,
    phases: str | None = None,
    phase_source: str | None = None,
    per_run: str | list[str] | tuple[str, ...] | None = None,
) -> Request:
    """Replace settings of the run file by call arguments and check the request against the record.

    Raises
    ------
    ArgumentError
        For an unknown option or term.
    CalibrationError
        If the record lacks data for a term, or lost the phase that ``shared`` needs.
    """
    model, estimation, count = run.model, run.estimation, integral_unit(run.unit)
    walk, asked = estimation.angle_random_walk, method or estimation.method
    request = Request(
        terms=term_names(terms) if terms is not None else model.terms,
        phases=phases or model.phases,
        phase_source=phase_source or model.phase_source,
        method="information" if asked == "recursive" else asked,
        angle_rms=None if estimation.angle_rms is None else level_in(estimation.angle_rms, count),
        angle_random_walk=None if walk is None else level_in(walk, f"{count}/sqrt(s)"),
        temperature_reference=to_si(model.temperature_reference, "K"),
        per_run=estimation.per_run if per_run is None else tuple(per_run),
    )
    if request.method in _STUDIES:
        raise ArgumentError(
            f"method '{request.method}' is not among those of calibrate",
            remedy=f"use {_STUDIES[request.method]}, or method 'information'",
        )
    for name, value, allowed in (
        ("phases", request.phases, PHASES),
        ("phase_source", request.phase_source, PHASE_SOURCES),
        ("method", request.method, METHODS),
    ):
        if value not in allowed:
            raise ArgumentError(f"{name}: '{value}' is not known", remedy=f"one of: {', '.join(allowed)}")
    check_terms(request.terms, output=run.unit)
    check_per_run(request.per_run or (), request.terms)
    _check_record(run, request)
    return request


def check_per_run(per_run: tuple[str, ...], terms: tuple[str, ...]) -> None:
    """Check the terms that may differ between runs: their regressor must not turn with the phase, and not K.

    Raises
    ------
    ArgumentError
        Naming the term.
    """
    for name in per_run:
        if name not in terms:
            raise ArgumentError(
                f"per_run: '{name}' is not among the terms", remedy=f"one of: {', '.join(terms)}"
            )
        if name == "scale_factor":
            raise ArgumentError(
                "per_run: 'scale_factor' belongs to the instrument; all other coefficients are multiples of it",
                remedy="estimate 'k1' instead, and name that in per_run",
            )
        if name == "tan_beta" or harmonic(name) or name in SERVO_TERMS:
            raise ArgumentError(
                f"per_run: '{name}' depends on the output angle and belongs to the instrument",
                remedy="leave it out of per_run: every run has its own phase already",
            )


def _check_record(run: Run, request: Request) -> None:
    for name in request.terms:
        column = LOGGED_TERMS.get(name)
        if column is not None and getattr(run, column) is None:
            unit = "degC" if column == "temperature" else "g"
            raise CalibrationError(
                f"term '{name}' needs the {column}, but the record has none",
                remedy=f"add [data] {column} = {{ column = '...', unit = '{unit}' }}, or leave the term out",
            )
    if run.direct:
        for key, asked, only in (
            ("phases", request.phases, "shared"),
            ("phase_source", request.phase_source, "output"),
        ):
            if asked != only:
                raise CalibrationError(
                    f"{key} '{asked}' belongs to the gimbal of a gyro accelerometer, and the instrument is direct",
                    remedy="leave it out",
                )
    check_servo(request)
    at = lost_phase(run, request.terms, request.phases)
    if at is not None:
        why = "the counter may have rolled over unseen before it"
        if run.kind == "rate":
            why = "a log of rates does not tell how far the output turned in the move before it"
        raise CalibrationError(
            "phase 'shared' is not possible: the zero of the output angle is lost at segment "
            f"'{run.labels[at]}': {why}",
            remedy="set phases = 'per-segment' (run file [model], or --phases per-segment), or correct [instrument] "
            "counts_per_revolution or scale_factor if they are wrong",
        )
    if request.phase_source == "input" and request.phases != "shared":
        raise CalibrationError(
            "phase_source 'input' predicts the phase through the whole record and needs phases = 'shared'",
            remedy="use phase_source = 'output'",
        )


def with_phase(terms: Sequence[str]) -> bool:
    """True if a term depends on the output angle."""
    return "tan_beta" in terms or any(map(harmonic, terms))


def lost_phase(run: Run, terms: tuple[str, ...], phases: str) -> int | None:
    """First segment for which one phase of the whole record is asked and lost; None if there is none."""
    if phases != "shared" or not with_phase(terms):
        return None
    first = run.segment_edges()[1:-1]
    moved = (run.t[first] - run.t[first - 1] > 1.5 * run.median_step) & (run.kind == "rate")
    groups = [*np.diff(run.phase_group).astype(bool) | moved]
    return groups.index(True) + 1 if True in groups else None


def check_servo(request: Request) -> None:
    """Check the servo terms: they need the phase of the coupling.

    Raises
    ------
    CalibrationError
        If a servo term is requested without tan_beta.
    """
    asked = [name for name in SERVO_TERMS if name in request.terms]
    if not asked:
        return
    if "tan_beta" not in request.terms:
        raise CalibrationError(
            f"term '{asked[0]}' depends on the output angle and needs the phase of 'tan_beta'",
            remedy="add 'tan_beta' to the terms",
        )


_PLAUSIBLE = 0.3
"""Largest difference of a sound rate from ``K a_x - Omega_x``, as a share of ``K |a|``."""
_GROSS = 10.0
"""Multiple of the median difference above which a rate is a spike."""


def phase_angle(run: Run, request: Request, scale_factor: float) -> Array:
    """The phase angle of the coupling: as read, integrated from a rate, or predicted from the input."""
    if run.direct:  # it has no phase, and no column turns with one
        return run.output
    predicted = request.phase_source == "input"
    if not predicted and run.kind != "rate":
        return run.output
    if not predicted:
        return integrated_rate(run.t, _steady_rates(run), run.begins)
    h = changes(run.t)
    h[run.begins] = 0.0
    increments = scale_factor * h * middles(run.f[:, 0])
    return stored(np.cumsum(increments, out=increments))


def _steady_rates(run: Run) -> Array:
    """Rates of a log; rates that no motion explains are replaced by ``K a_x - Omega_x``. The log itself without such rates.

    A spike in the rate would shift the integrated phase of all later samples.
    """
    expected = run.scale_factor * run.f[:, 0]  # K nominal
    plausible = _PLAUSIBLE * abs(run.scale_factor) * norms(run.f)
    if run.base_rate is not None:
        expected -= run.base_rate[:, 0]
        plausible += norms(run.base_rate)
    surplus = np.abs(run.output - expected)
    if not (surplus > plausible).any():
        return run.output
    spikes = surplus > np.maximum(plausible, _GROSS * float(np.median(surplus)))
    return stored(np.where(spikes, expected, run.output))
