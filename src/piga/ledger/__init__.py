"""Calibrations kept as evidence: calibrate and store a run, recompute a stored record."""

from piga.ledger.evidence import Comparison, Reproduced, compare_calibrations, prepare_run, reproduce

__all__ = ["Comparison", "Reproduced", "compare_calibrations", "prepare_run", "reproduce"]
