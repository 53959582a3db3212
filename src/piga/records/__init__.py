"""Plain data in and out: run files, runs, calibration records."""

from piga.reading.read_run import read_record
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
from piga.records.toml_file import read_toml

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
    "read_record",
    "read_run_file",
    "read_toml",
]
