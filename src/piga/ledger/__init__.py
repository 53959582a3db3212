"""Calibrations kept as evidence: calibrate and store a run, recompute a stored record."""

from piga.ledger.keep import Prepared, prepare_results, prepare_run
from piga.ledger.reproduce import Comparison, Reproduced, compare_calibrations, reproduce

__all__ = [
    "Comparison",
    "Prepared",
    "Reproduced",
    "compare_calibrations",
    "prepare_results",
    "prepare_run",
    "reproduce",
]
