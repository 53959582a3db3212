"""Calibrate and store: inputs, result and report become one record, or nothing does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from piga.errors import DataError
from piga.evidence.inputs import input_files
from piga.records import Calibration
from piga.records.store import Draft, DraftFile, Record, Store
from piga.records.store.blobs import digest_of
from piga.records.store.software import software_identity

if TYPE_CHECKING:
    from piga.records.store.store import Position

_ID, _NUMBER, _STORE, _AFTER = (f"\u27e6record {name}\u27e7" for name in ("id", "number", "store", "after"))


def keep_run(
    store: Store,
    run: Path,
    operator: str,
    reason: str,
    *,
    terms: list[str] | None = None,
    method: str | None = None,
    phase: str | None = None,
    phase_source: str | None = None,
    measured: str | None = None,
    supersedes: str | None = None,
    report: bool = True,
) -> tuple[Record, Calibration]:
    """Calibrate a run and store it with its inputs and a report that carries the record's name and the head.

    Parameters
    ----------
    store:
        Where it is kept.
    run:
        Run file.
    operator, reason:
        Who keeps it and why.
    terms, method, phase, phase_source:
        As for :func:`piga.calibrate`.
    measured:
        Time of the test, in ISO form; without a zone it is UTC.
    supersedes:
        Name of the record that this one amends.
    report:
        Make the report too (it needs the extra ``report``).

    Raises
    ------
    PigaError
        If it cannot be calibrated or stored; nothing is stored then.
    """
    from piga.calibration import calibrate
    from piga.stand import read_run

    inputs = input_files(run)
    calibration = calibrate(read_run(run), terms, method, phase=phase, phase_source=phase_source)
    _check_inputs(calibration, inputs)
    draft = Draft(
        calibration.serial,
        operator,
        reason,
        inputs,
        _request(calibration),
        software_identity(),
        measured,
        supersedes,
    )
    page = _report(calibration, draft) if report else None
    return store.append(lambda place: _filled(draft, calibration, page, place)), calibration


def keep_results(
    store: Store,
    run: Path,
    results: Path,
    operator: str,
    reason: str,
    *,
    measured: str | None = None,
    supersedes: str | None = None,
) -> tuple[Record, Calibration]:
    """Store what ``piga calibrate`` left in a directory, with the run it came from, every file as it is.

    Raises
    ------
    PigaError
        If the results are not those of this run, or cannot be stored; nothing is stored then.
    """
    inputs = input_files(run)
    calibration = Calibration.from_json(results / "calibration.json")
    _check_inputs(calibration, inputs)
    files = [*inputs, DraftFile("calibration", "results/calibration.json", results / "calibration.json")]
    if (results / "report.html").is_file():
        files.append(DraftFile("report", "results/report.html", results / "report.html"))
    software = {"piga": calibration.provenance.software.removeprefix("piga ")}
    draft = Draft(
        calibration.serial,
        operator,
        reason,
        tuple(files),
        _request(calibration),
        software,
        measured,
        supersedes,
    )
    return store.append(lambda _place: draft), calibration


def _request(calibration: Calibration) -> dict[str, Any]:
    """What was asked for, so that it can be asked again."""
    return {
        "terms": list(calibration.terms),
        "method": calibration.method,
        "phase": calibration.phase,
        "phase_source": calibration.phase_source,
    }


def _check_inputs(calibration: Calibration, inputs: tuple[DraftFile, ...]) -> None:
    """The result must come from these very files."""
    known = calibration.provenance.input_sha256
    for file in inputs:
        name = Path(file.name).name
        if file.role in ("run", "data") and known.get(name) != digest_of(file.parts())[0]:
            raise DataError(
                f"{file.name}: is not the file that the calibration was computed from (its SHA-256 differs)",
                remedy="calibrate again, with the files as they are now",
            )


def _report(calibration: Calibration, draft: Draft) -> str | None:
    """The report with blanks for what is known only when the record gets its place."""
    from importlib.util import find_spec

    if find_spec("matplotlib") is None:
        return None
    from piga.reports.calibration import calibration_page
    from piga.reports.calibration_tables import facts_table
    from piga.reports.page import Section, Text, page_html

    lead = (
        "This report is part of a record that is never changed. The head below vouches for every record before it: "
        "piga records verify --head compares it with the store."
    )
    rows = [
        ("Record", _ID),
        ("Number in the store", _NUMBER),
        ("Store", _STORE),
        ("Head before this record", _AFTER),
    ]
    rows += [("Operator", draft.operator), ("Reason", draft.reason)]
    rows += [("Measured", draft.measured)] if draft.measured else []
    rows += [("Supersedes", draft.supersedes)] if draft.supersedes else []
    page = calibration_page(calibration)
    section = Section("Record", "record", (Text(lead, lead=True), facts_table(rows, code=True)))
    footer = f"Record {_ID}, number {_NUMBER}, after head {_AFTER}. {page.footer}"
    return page_html(replace(page, sections=(*page.sections, section), footer=footer))


def _filled(draft: Draft, calibration: Calibration, page: str | None, place: Position) -> Draft:
    """The draft with its results, the report's blanks filled in."""
    from piga.records.calibration_json import calibration_to_bytes

    files = [
        *draft.files,
        DraftFile("calibration", "results/calibration.json", calibration_to_bytes(calibration)),
    ]
    if page is not None:
        for blank, value in (
            (_ID, place.id),
            (_NUMBER, str(place.number)),
            (_STORE, place.store),
            (_AFTER, place.after),
        ):
            page = page.replace(blank, value)
        files.append(DraftFile("report", "results/report.html", page.encode()))
    return replace(draft, files=tuple(files))
