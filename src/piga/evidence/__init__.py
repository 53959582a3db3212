"""Calibrations kept as evidence: calibrate and store, recompute what is stored."""

from piga.evidence.compare import Comparison, compare_calibrations
from piga.evidence.keep import Prepared, prepare_results, prepare_run
from piga.evidence.reproduce import Reproduced, reproduce

__all__ = [
    "Comparison",
    "Prepared",
    "Reproduced",
    "compare_calibrations",
    "prepare_results",
    "prepare_run",
    "reproduce",
]
