"""Made-up histories of an instrument: light calibrations with a value per coefficient."""

from __future__ import annotations

import datetime as dt

import numpy as np

from piga.records.calibration.calibration import Calibration, Provenance
from piga.records.calibration.coefficient import BudgetEntry, Coefficient
from piga.records.calibration.diagnostics import Diagnostics, Quality
from piga.records.terms import unit_of

START = dt.datetime(2020, 3, 2, 9, 0, tzinfo=dt.UTC)


def record(values, stds, common=None, *, serial="G-0417"):
    """A calibration with these values and standard uncertainties; ``common``: {source: {key: contribution}}."""
    coefficients = tuple(
        Coefficient(name, float(values[name]), float(stds[name]), unit_of(name)) for name in values
    )
    names = [c.name for c in coefficients]
    budget = [_row("fit residuals", "A", {})]
    budget += [_row(source, "B", parts) for source, parts in (common or {}).items()]
    return Calibration(
        serial=serial,
        scale_factor_nominal=0.0906,
        terms=tuple(name for name in names if name != "phi"),
        phases="shared",
        phase_source="output",
        method="information",
        coefficients=coefficients,
        covariance=np.diag([c.std**2 for c in coefficients]),
        surplus_observations=100.0,
        angle_rms=1e-6,
        angle_random_walk=1e-6,
        residual_rms=1e-6,
        residual_rms_before=1e-3,
        residual_max_before=1e-2,
        residual_max_after=1e-5,
        quality=Quality(110, 110, 0),
        condition=10.0,
        notes=(),
        budget=tuple(budget),
        diagnostics=Diagnostics(),
        segments=(),
        provenance=Provenance({"run.csv": "0" * 64}, "piga 0.1.0", "2026-01-01T00:00:00Z"),
    )


def _row(source, kind, parts):
    return BudgetEntry(source=source, type=kind, contributions=parts)


def history(years, values, std, *, key="k0", common=None):
    """History of one coefficient: (n,) years and values, one standard uncertainty or (n,) of them."""
    stds = np.broadcast_to(std, len(values))
    return [
        (f"r{i}", START + dt.timedelta(days=365.25 * float(t)), record({key: y}, {key: s}, common))
        for i, (t, y, s) in enumerate(zip(years, values, stds, strict=True))
    ]
