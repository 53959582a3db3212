"""Calibrate and store. Inputs, result and report become one record; on an error nothing is stored."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from piga.errors import CalibrationError, RunFileError
from piga.ledger.reproduce import software_identity
from piga.ledger.store import Draft, DraftFile, Record
from piga.ledger.store.store import Store
from piga.output import check_results
from piga.reading.columns import stand_files
from piga.records import Calibration
from piga.records.calibration.document import MOST_BYTES, calibration_from_bytes, calibration_to_bytes
from piga.records.run_file import read_run_file
from piga.records.text_files import read_whole

if TYPE_CHECKING:
    from piga.ledger.store.documents import Position


def input_files(run: Path, digests: dict[str, str]) -> tuple[DraftFile, ...]:
    """Run file, data file, its ``.sha256`` if there is one, and the files of a ``[stand]`` table.

    Names keep their places relative to each other: a data file in ``../data`` moves the run file one folder down. ``digests``
    are those of the inputs as they were read for the calibration; the store refuses others.
    """
    run_file = read_run_file(run)
    named = [("data", run_file.data.file), *(("stand", name) for name in stand_files(run_file.stand))]
    if Path(f"{run_file.data.file}.sha256").name in digests:
        named.append(("sidecar", f"{run_file.data.file}.sha256"))
    for _, name in named:
        if PurePosixPath(name).is_absolute() or Path(name).is_absolute():
            raise RunFileError(
                f"{run}: '{name}' is an absolute path: the record could not be read elsewhere",
                remedy="name the file relative to the run file",
            )
    depth = max(_upwards(name) for _, name in named)
    below = "/".join(["run"] * depth)
    files = [DraftFile("run", _joined(below, run.name), run, digests.get(run.name, ""))]
    for role, name in dict.fromkeys(named):
        key = name if role == "stand" else Path(name).name
        files.append(DraftFile(role, _joined(below, name), run.parent / name, digests.get(key, "")))
    return tuple(files)


def _upwards(name: str) -> int:
    return os.path.normpath(name).replace(os.sep, "/").split("/").count("..")


def _joined(below: str, name: str) -> str:
    return os.path.normpath(f"{below}/{name}" if below else name).replace(os.sep, "/")


_RESULT, _PAGE = "results/calibration.json", "results/report.html"
"""Names of the results in a record."""
_MAX_PAGE = 1 << 28
"""Largest page that is kept [bytes]. The page of a calibration has a few MB."""


@dataclass(frozen=True)
class Prepared:
    """A calibration ready to be stored: the record without its place in the chain; ``report``: make its page with that place."""

    draft: Draft
    calibration: Calibration
    report: bool = False

    def keep(self, store: Store) -> Record:
        """Store the record. When this returns, it is on disk.

        Raises
        ------
        PigaError
            If it cannot be stored; nothing is stored then.
        """
        return store.append(self._at)

    def _at(self, place: Position) -> Draft:
        if not self.report:
            return self.draft
        page = _report(self.calibration, self.draft, place)
        report = DraftFile("report", _PAGE, page.encode())
        return replace(self.draft, files=(*self.draft.files, report))


def prepare_run(
    run: Path,
    operator: str,
    reason: str,
    *,
    terms: list[str] | None = None,
    method: str | None = None,
    phases: str | None = None,
    phase_source: str | None = None,
    measured: str | None = None,
    supersedes: str | None = None,
    report: bool = True,
) -> Prepared:
    """Calibrate a run and prepare its record: inputs, result, and a report that shows the record's name and the head.

    Parameters
    ----------
    run:
        Run file.
    operator, reason:
        Who stores the record, and why.
    terms, method, phases, phase_source:
        As for :func:`piga.calibrate`.
    measured:
        Time of the test, in ISO form; UTC if no zone is given.
    supersedes:
        Name of the record that this one amends.
    report:
        Create the report, too.

    Raises
    ------
    PigaError
        If the run cannot be calibrated.
    """
    from piga.calibration.calibrate import calibrate
    from piga.stand import read_run

    calibration = calibrate(read_run(run), terms, method, phases=phases, phase_source=phase_source)
    result = DraftFile("calibration", _RESULT, calibration_to_bytes(calibration))
    draft = _draft(run, calibration, [result], operator, reason, measured, supersedes)
    return Prepared(replace(draft, software=software_identity()), calibration, report)


def prepare_results(
    run: Path,
    results: Path,
    operator: str,
    reason: str,
    *,
    measured: str | None = None,
    supersedes: str | None = None,
) -> Prepared:
    """Prepare a record from the folder of ``piga calibrate`` and its run. Every file is stored unchanged.

    The other parameters are those of :func:`prepare_run`.

    Raises
    ------
    PigaError
        If the results are not those of this run.
    """
    path, page = results / "calibration.json", results / "report.html"
    raw = read_whole(path, MOST_BYTES, "a calibration.json", CalibrationError)
    calibration = calibration_from_bytes(raw, path)
    files = [DraftFile("calibration", _RESULT, raw)]
    if page.is_file():
        html = read_whole(page, _MAX_PAGE, "a report.html", CalibrationError)
        files.append(DraftFile("report", _PAGE, html))
    check_results(results)
    return Prepared(_draft(run, calibration, files, operator, reason, measured, supersedes), calibration)


def _draft(
    run: Path,
    calibration: Calibration,
    results: list[DraftFile],
    operator: str,
    reason: str,
    measured: str | None,
    supersedes: str | None,
) -> Draft:
    """The record of a calibration: inputs, results, and its options, so that it can be repeated."""
    inputs = input_files(run, calibration.provenance.input_sha256)
    options = {
        "terms": list(calibration.terms),
        "method": calibration.method,
        "phase": calibration.phases,
        "phase_source": calibration.phase_source,
    }
    software = {"piga": calibration.provenance.software.removeprefix("piga ")}
    files = (*inputs, *results)
    return Draft(calibration.serial, operator, reason, files, options, software, measured, supersedes)


def _report(calibration: Calibration, draft: Draft, place: Position) -> str:
    """The report of a record, with its place in the chain."""
    from piga.reports.calibration.page import page as calibration_page
    from piga.reports.calibration.tables import facts_table
    from piga.reports.render.page import Section, page_html

    lead = (
        "This report is part of a record that is never changed. The head below vouches for every record before it: "
        "piga records verify --head compares it with the store."
    )
    rows = [
        ("Record", place.id),
        ("Number in the store", str(place.number)),
        ("Store", place.store),
        ("Head before this record", place.after),
        ("Operator", draft.operator),
        ("Reason", draft.reason),
    ]
    rows += [("Measured", draft.measured)] if draft.measured else []
    rows += [("Supersedes", draft.supersedes)] if draft.supersedes else []
    page = calibration_page(calibration)
    section = Section("Record", "record", (lead, facts_table(rows, code=True)))
    footer = f"Record {place.id}, number {place.number}, after head {place.after}. {page.footer}"
    return page_html(replace(page, sections=(*page.sections, section), footer=footer))
