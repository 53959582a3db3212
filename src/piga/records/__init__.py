"""Plain data: run files, runs, calibrations, terms and the units used in files."""

from piga.records.calibration.calibration import Calibration, Provenance
from piga.records.calibration.coefficient import Coefficient
from piga.records.calibration.diagnostics import Event, Quality, Residuals, SegmentSummary
from piga.records.run import Run
from piga.records.run_file import RunFile, read_run_file
from piga.text_files import read_toml

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
