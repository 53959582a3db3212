"""A realistic made-up calibration: 24 positions of 60 s at 20 Hz, ripple before, noise after."""

from __future__ import annotations

import math

import numpy as np

from piga.records.calibration.calibration import Calibration, Provenance
from piga.records.calibration.coefficient import Amount, BudgetEntry, Coefficient
from piga.records.calibration.diagnostics import Diagnostics, Event, Quality, Residuals, SegmentSummary
from piga.units import ARCSEC, G0

K = 0.888506608 / G0
TAN_BETA = 3.587621e-4
PHI = 0.48
SEGMENTS = 24


def ripple_integral(psi, t, order, phase):
    """Integral of cos(order psi + phase) dt, exact for psi linear between samples."""
    wave = np.exp(1j * (order * psi + phase))
    dt, turn = np.diff(t), order * np.diff(psi)
    still = np.abs(turn) < 1e-9
    step = np.where(still, dt * wave[:-1], np.diff(wave) * dt / np.where(still, 1.0, 1j * turn))
    return np.concatenate(([0.0], np.cumsum(step.real)))


def residuals(rows=1200, seed=1, white=2.2 * ARCSEC, walk=1.2 * ARCSEC, order_2=0.0, uneven=False):
    """Residuals of a tumble; ``order_2`` [m/s^2] is a planted second harmonic left in both."""
    rng = np.random.default_rng(seed)
    parts = []
    for segment in range(SEGMENTS):
        x = math.radians(15.0 * segment)
        step = 0.05 * (1.0 + (0.6 * (rng.random(rows) - 0.5) if uneven else 0.0)) * np.ones(rows)
        t = np.cumsum(step)
        psi = rng.uniform(0, 6) + K * G0 * math.cos(x) * (t - t[0])
        wander = np.cumsum(walk * np.sqrt(step) * rng.standard_normal(rows))
        noise = white * rng.standard_normal(rows) + wander
        planted = K * order_2 * ripple_integral(psi, t, 2, 0.3)
        coupled = -K * TAN_BETA * G0 * math.sin(x) * ripple_integral(psi, t, 1, PHI - math.pi / 2)
        offset = K * 1.6e-3 * G0 * (t - t[0]) + 1.2e-4 * K * G0 * math.cos(x) * (t - t[0])
        after = noise - np.polyval(np.polyfit(t, noise, 1), t) + planted
        before = noise + planted + coupled + offset
        parts.append(
            (t + 70.0 * segment, psi, np.full(rows, G0 * math.cos(x)), before, after, np.full(rows, segment))
        )
    t, psi, a_x, before, after, segment = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Residuals(
        row=np.arange(1, t.size + 1),
        t=t,
        psi=psi,
        a_x=a_x,
        before=before,
        after=after,
        innovation=rng.standard_normal(t.size),
        segment=segment.astype(np.int32),
    )


def segment_rows(result):
    rows = []
    for segment in range(SEGMENTS):
        part = result.segment == segment
        psi, after, before = result.psi[part], result.after[part], result.before[part]
        rows.append(
            SegmentSummary(
                label=str(segment),
                rows=int(part.sum()),
                duration=float(np.ptp(result.t[part])),
                mean_a_x=float(result.a_x[part].mean()),
                turns=float((psi[-1] - psi[0]) / (2 * math.pi)),
                rms=float(np.std(after)),
                rms_before=float(np.sqrt(np.mean(before**2))),
                max_after=float(np.max(np.abs(after))),
            )
        )
    return tuple(rows)


def calibration(*, serial="G-0417", phases="shared", with_residuals=True, budget=True, **options):
    result = residuals(**options)
    coefficients = [
        Coefficient("scale_factor", 0.88850921, 1.4e-6, "rad/s/g"),
        Coefficient("tan_beta", 3.58742e-4, 2.3e-7, "1"),
        Coefficient("k0", 1.60021e-3, 1.1e-6, "g"),
        Coefficient("k2", 3.1e-7, 1.9e-6, "g/g^2"),
        Coefficient("m_Y", 2.3987e-4, 1.3e-6, "rad"),
    ]
    if phases == "shared":
        coefficients.insert(2, Coefficient("phi", 0.48013, 6.4e-4, "rad"))
    else:
        coefficients += [Coefficient("phi", 0.1 * s, 3e-3, "rad", str(s)) for s in range(SEGMENTS)]
    size = len(coefficients)
    mixing = np.eye(size) + 0.35 * np.tri(size, k=-1) * np.sin(np.arange(size * size).reshape(size, size))
    shape = mixing @ mixing.T
    std = np.array([c.std for c in coefficients]) / np.sqrt(np.diag(shape))
    rows = (
        BudgetEntry(source="Fit to the record", type="A", contributions={c.key: c.std for c in coefficients}),
        BudgetEntry(
            source="Reference scale",
            type="B",
            standard_uncertainty=Amount(10.0, "ppm"),
            contributions={"scale_factor": 8.9e-6, "k0": 1.6e-8},
        ),
        BudgetEntry(
            source="Reference misalignment",
            type="B",
            standard_uncertainty=Amount(2.0, "arcsec"),
            contributions={"m_Y": 9.7e-6, "tan_beta": 1.1e-8},
        ),
    )
    return Calibration(
        serial=serial,
        scale_factor_nominal=0.8884 / G0,
        terms=("scale_factor", "tan_beta", "k0", "k2", "m_Y"),
        phases=phases,
        phase_source="output",
        method="information",
        coefficients=tuple(coefficients),
        covariance=shape * np.outer(std, std),
        surplus_observations=float(result.t.size - size - SEGMENTS),
        angle_rms=2.2 * ARCSEC,
        angle_random_walk=1.2 * ARCSEC,
        residual_rms=float(np.std(result.after)),
        residual_rms_before=float(np.sqrt(np.mean(result.before**2))),
        residual_max_before=float(np.max(np.abs(result.before))),
        residual_max_after=float(np.max(np.abs(result.after))),
        quality=Quality(
            rows=result.t.size + 12,
            used=result.t.size,
            masked=12,
            events=(
                Event("repeated time", 9, 4711, "rows with the time of the row before were left out"),
                Event("outlier", 3, 20311, "left out: more than 6 standard deviations from the fit"),
            ),
        ),
        condition=38.4,
        notes=("k2 is below its own uncertainty: a one-plane tumble tells k2 only together with k_YY.",),
        budget=rows if budget else (),
        diagnostics=Diagnostics(lag1_correlation=0.0021, skewness=0.41),
        segments=segment_rows(result),
        provenance=Provenance(
            input_sha256={"run.toml": "9f86d081884c7d65" * 4, "run.csv": "2c26b46b68ffc68f" * 4},
            software="piga 0.1.0",
            created="2026-01-01T00:00:00Z",
            options={"phases": phases, "robust": True},
        ),
        residuals=result if with_residuals else None,
    )
