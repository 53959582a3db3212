"""The page of ``piga compensate --report``: filled while the record is compensated, written at the end."""

from __future__ import annotations

from pathlib import Path

from piga.cli.common import write_by_rename
from piga.compensation import Compensated
from piga.records import Calibration, Run
from piga.reports.compensation import CompensationFacts, outline_of, write_compensation_report


class Report:
    """Watches one compensation; ``files`` are the run file, its data and the calibration record."""

    def __init__(self, page: Path, kind: str, calibration: Calibration, files: tuple[Path, ...]) -> None:
        self._page, self._calibration, self._files = page, calibration, files
        self._whole: tuple[Run, Compensated] | None = None
        self.found = outline_of(kind, calibration)

    def take(self, record: Run, result: Compensated) -> None:
        """Take a whole record."""
        self._whole = record, result
        self.found.record(record, result)

    def write(self, options: dict[str, str], repairs: dict[str, int]) -> None:
        """Write the page by rename."""
        facts = CompensationFacts(self._calibration, self._files, options, repairs)
        write_by_rename(
            self._page, lambda path: write_compensation_report(self.found, facts, path, self._whole)
        )
