"""The page of ``piga compensate --report``: filled while the record is compensated, written at the end."""

from __future__ import annotations

from pathlib import Path

from piga.cli.common import write_by_rename
from piga.compensation import Compensated, Mounted
from piga.records import Calibration, Run, read_run_file
from piga.records.spool import give_back
from piga.reports.compensation.outline import SetOutline
from piga.reports.compensation.page import (
    CompensationFacts,
    SetFacts,
    outline_of,
    write_compensation_report,
    write_set_report,
)


class Report:
    """Watches one compensation; ``files`` are the run file, its data and the calibration record."""

    def __init__(self, page: Path, kind: str, calibration: Calibration, files: tuple[Path, ...]) -> None:
        self._page, self._calibration, self._files = page, calibration, files
        self._whole: tuple[Run, Compensated] | None = None
        self.found = outline_of(kind, calibration)

    def take(self, record: Run, result: Compensated) -> None:
        """Take a whole record."""
        give_back()
        self._whole = record, result
        self.found.record(record, result)

    def write(self, options: dict[str, str], repairs: dict[str, int]) -> None:
        """Write the page by rename."""
        give_back()
        facts = CompensationFacts(self._calibration, self._files, options, repairs)
        write_by_rename(
            self._page, lambda path: write_compensation_report(self.found, facts, path, self._whole), "--report"
        )


class SetReport:
    """Watches the compensation of a set; ``runs`` are its run files, ``files`` all that is named on the page."""

    def __init__(self, page: Path, runs: list[Path], mounted: list[Mounted], files: list[Path]) -> None:
        self._page, self._files = page, files
        kinds = [read_run_file(run).data for run in runs]
        self._files = [*files, *(run.parent / data.file for run, data in zip(runs, kinds, strict=True))]
        serials = [item.calibration.serial for item in mounted]
        self._names = tuple(
            f"{run.stem} ({serial})" if serial else run.stem for run, serial in zip(runs, serials, strict=True)
        )
        self.found = SetOutline("rate" if kinds[0].output.kind == "rate" else "angle", mounted)

    def write(self, options: dict[str, str]) -> None:
        """Write the page by rename."""
        give_back()
        facts = SetFacts(self._names, tuple(dict.fromkeys(self._files)), options)
        write_by_rename(self._page, lambda path: write_set_report(self.found, facts, path), "--report")
