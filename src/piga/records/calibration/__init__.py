"""The calibration record as plain data: coefficients, budget, residuals, diagnostics, verdict, and its JSON document."""
