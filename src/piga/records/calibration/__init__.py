"""The calibration record as plain data: coefficients, budget, residuals, diagnostics, verdict, and its JSON document."""

from piga.records.calibration.calibration import Calibration, CalibrationPlots, Given, Provenance, RunRecord
from piga.records.calibration.coefficient import (
    Amount,
    BudgetEntry,
    BudgetTable,
    Coefficient,
    SIValue,
    StandSource,
)
from piga.records.calibration.diagnostics import (
    Creep,
    Diagnostics,
    Event,
    MissingTerm,
    MonteCarlo,
    MonteCarloCheck,
    Outlier,
    Quality,
    Residuals,
    SegmentLeverage,
    SegmentScatter,
    SegmentSummary,
    counted,
)

__all__ = [
    "Amount",
    "BudgetEntry",
    "BudgetTable",
    "Calibration",
    "CalibrationPlots",
    "Coefficient",
    "Creep",
    "Diagnostics",
    "Event",
    "Given",
    "MissingTerm",
    "MonteCarlo",
    "MonteCarloCheck",
    "Outlier",
    "Provenance",
    "Quality",
    "Residuals",
    "RunRecord",
    "SIValue",
    "SegmentLeverage",
    "SegmentScatter",
    "SegmentSummary",
    "StandSource",
    "counted",
]
