"""Calibrations kept as evidence: calibrate and store, recompute what is stored."""

from piga.evidence.compare import Comparison, compare_calibrations
from piga.evidence.keep import keep_results, keep_run
from piga.evidence.reproduce import Reproduced, reproduce

__all__ = ["Comparison", "Reproduced", "compare_calibrations", "keep_results", "keep_run", "reproduce"]
