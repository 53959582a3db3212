"""Calibrations and records made from a known instrument by the exact motion."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

import piga
from piga.instrument.parameters import ErrorModel
from piga.records import Calibration, Provenance, Quality, Run
from piga.records.calibration.coefficient import Coefficient
from piga.records.calibration.diagnostics import Diagnostics
from piga.records.terms import si_factor, unit_of
from piga.units import G0

Array = NDArray[np.float64]
K_G = 0.8884
TAN_BETA = float(np.tan(np.radians(1000.0 / 3600.0)))


def calibration_of(
    values: dict[str, float],
    std: dict[str, float] | None = None,
    *,
    angle_rms: float = 0.0,
    angle_random_walk: float = 0.0,
    serial: str = "",
    phase_source: str = "output",
    created: str = "2026-01-01T00:00:00Z",
) -> Calibration:
    """A calibration with these coefficients (file units; ``phi[label]`` for a segment) and uncertainties."""
    std = std or {}
    coefficients = tuple(_coefficient(key, value, std.get(key, 0.0)) for key, value in values.items())
    return Calibration(
        serial=serial,
        scale_factor_nominal=K_G / G0,
        terms=tuple(key for key in values if not key.startswith("phi")),
        phases="per-segment" if any(c.segment for c in coefficients) else "shared",
        phase_source=phase_source,
        method="information",
        coefficients=coefficients,
        covariance=np.diag([c.std**2 for c in coefficients]),
        surplus_observations=1e3,
        angle_rms=angle_rms,
        angle_random_walk=angle_random_walk,
        residual_rms=0.0,
        residual_rms_before=0.0,
        residual_max_before=0.0,
        residual_max_after=0.0,
        quality=Quality(1, 1, 0),
        condition=1.0,
        notes=(),
        budget=(),
        diagnostics=Diagnostics(),
        segments=(),
        provenance=Provenance({}, "piga test", created),
    )


def _coefficient(key: str, value: float, std: float) -> Coefficient:
    name, _, rest = key.partition("[")
    return Coefficient(name, value, std, unit_of(name), rest.rstrip("]") or None)


def run_of(
    t: Array,
    f: Array,
    *,
    phi: float = 0.0,
    kind: str = "angle",
    base_rate: Array | None = None,
    errors: dict[str, float] | None = None,
    temperature: Array | None = None,
    serial: str = "",
) -> Run:
    """Record of the exact motion for force samples ``f`` [m/s^2]; ``errors`` in file units.

    The published instrument with the phase as start angle: psi then starts at 0.
    """
    model = None
    if errors:
        model = ErrorModel(**{name: value * si_factor(name) for name, value in errors.items()})
    alpha, rate = piga.propagate(
        piga.Instrument(K_G / G0, float(np.arctan(TAN_BETA)), phi),
        t,
        f,
        base_rate,
        True,
        error_model=model,
        temperature=temperature,
        between="linear",
    )
    output = rate if kind == "rate" else alpha - phi
    return Run.from_arrays(
        t,
        output,
        f,
        scale_factor=K_G / G0,
        kind=kind,
        base_rate=base_rate,
        temperature=temperature,
        serial=serial,
        units="SI",
    )


def constant_force(t: Array, a_x: float, a_Y: float, a_Z: float = 0.0) -> Array:
    """Constant specific force, arguments in g, samples in m/s^2."""
    return np.tile(np.array([a_x, a_Y, a_Z]) * G0, (t.size, 1))


def mean_force(f: Array) -> Array:
    """Mean of a_x over each interval [m/s^2] for input that is linear between samples."""
    return 0.5 * (f[1:, 0] + f[:-1, 0])


def in_pieces(stream: piga.Compensator, columns: Mapping[str, NDArray], edges: Iterable[int]) -> list[Any]:
    """The compensated pieces of a stream whose columns come cut at these rows."""
    return [stream.push({name: c[a:b] for name, c in columns.items()}) for a, b in pairwise(edges)]


def assert_same_bits(
    parts: Sequence[Any], whole: Any, names: Iterable[str] = ("ax", "dv", "u_ax", "flags")
) -> None:
    """The pieces, one after another, are the whole result."""
    for name in names:
        joined = np.concatenate([getattr(part, name) for part in parts])
        assert joined.tobytes() == getattr(whole, name).tobytes(), name
