"""Plain data: run files, runs, calibrations, terms and the units used in files."""

from piga.records.calibration import (
    Calibration,
    Coefficient,
    Event,
    Provenance,
    Quality,
    Residuals,
    SegmentSummary,
)
from piga.records.run import Run
from piga.records.run_file import RunFile, read_run_file
from piga.records.text_files import read_toml

__all__ = [
    "Calibration",
    "Coefficient",
    "Event",
    "Provenance",
    "Quality",
    "Residuals",
    "Run",
    "RunFile",
    "SegmentSummary",
    "read_run_file",
    "read_toml",
]
