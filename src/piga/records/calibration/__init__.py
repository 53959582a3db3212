"""The calibration record as plain data: coefficients, budget, residuals, diagnostics, verdict, and its JSON document."""

from piga.records.calibration.budget import Amount, BudgetEntry, BudgetTable, Level, Number, TypeB
from piga.records.calibration.calibration import (
    Calibration,
    CalibrationFigures,
    CalibrationPlots,
    Given,
    Provenance,
    RunRecord,
)
from piga.records.calibration.coefficient import LOOSE_PHASE, Coefficient, SIValue
from piga.records.calibration.diagnostics import (
    ColouredNoise,
    Count,
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
)

__all__ = [
    "LOOSE_PHASE",
    "Amount",
    "BudgetEntry",
    "BudgetTable",
    "Calibration",
    "CalibrationFigures",
    "CalibrationPlots",
    "Coefficient",
    "ColouredNoise",
    "Count",
    "Diagnostics",
    "Event",
    "Given",
    "Level",
    "MissingTerm",
    "MonteCarlo",
    "MonteCarloCheck",
    "Number",
    "Outlier",
    "Provenance",
    "Quality",
    "Residuals",
    "RunRecord",
    "SIValue",
    "SegmentLeverage",
    "SegmentScatter",
    "SegmentSummary",
    "TypeB",
]
