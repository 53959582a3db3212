"""``piga records trend``: drift of an instrument's coefficients over the years."""

from __future__ import annotations

import datetime as dt
import gc
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from piga.cli.common import ForceOption, JsonOption, argument, day_in, deliver, option, progress
from piga.errors import PigaError
from piga.output import is_hidden

if TYPE_CHECKING:
    from piga.trend.history import Common, HistoryEntry

_MOST_RECORDS = 10_000
RARELY = (100_000, 50, 100)
"""Thresholds that make garbage collection rare: thousands of records are many small objects, and none is garbage."""


def trend(
    sources: Annotated[
        list[Path] | None, argument("CALIBRATION.json|DIR", "Calibrations, or folders that hold them.")
    ] = None,
    store: Annotated[
        str | None, option("--store", "FILE|URL", "Store to take the records from.", envvar="PIGA_STORE")
    ] = None,
    serial: Annotated[
        str | None, option("--serial", "SERIAL", "Serial number of the instrument; needed with a store.")
    ] = None,
    at: Annotated[
        str | None, option("--at", "YYYY-MM-DD", "Date of the forecast [default: a year ahead].")
    ] = None,
    common: Annotated[
        list[str] | None,
        option(
            "--common",
            "PART | SOURCE=PART",
            "Share (0 to 1) of Type B that all records have in common, for all sources or one [default: 1].",
        ),
    ] = None,
    out: Annotated[Path | None, option("--out", "DIR", "Write trend.json and trend.html.")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show how coefficients drift over the years.

    For each coefficient: stability over time, drift per year, control limits, forecast, alarms.
    """
    from piga.reports.trend import brief, page, trend_document
    from piga.trend.history import find_trend

    gc.set_threshold(*RARELY)
    with progress("reading"):
        drifts = find_trend(history(sources or [], store, serial), common=_common(common or []))
    date = day_in(at, "--at") if at else drifts.times[-1] + dt.timedelta(days=365)
    names = ("trend.json", "trend.html")
    with deliver(out, "trend", names, _files(sources or []), force=force, as_json=as_json) as to:
        document = trend_document(drifts, at=date)
        to.show(document, page(drifts, date), brief(drifts, date), *names)


def history(sources: list[Path], store: str | None, serial: str | None) -> Iterator[HistoryEntry]:
    """Records from files, or of an instrument in a store."""
    if sources:
        entries = (_entry(path) for path in _files(sources))
        yield from (entry for entry in entries if serial is None or entry[2].serial == serial)
        return
    if store is None:
        raise PigaError("no records are named", remedy="give calibration.json files, directories, or --store")
    if serial is None:
        raise PigaError("--store needs the instrument", remedy="add --serial")
    from piga.ledger.store import open_store

    with open_store(store) as opened:
        calibrations = opened.history(serial)
        if not calibrations:
            kept = sorted({record.document.serial for record in opened.each()})
            raise PigaError(
                f"{store}: holds no record of '{serial}'",
                remedy=f"--serial is one of: {', '.join(kept[:9])}"
                if kept
                else "add records: piga records add",
            )
        yield from calibrations


def _files(sources: list[Path]) -> list[Path]:
    paths: list[Path] = []
    for source in sources:
        inside = [source]
        if source.is_dir():
            try:
                named = sorted(source.rglob("calibration*.json"))
            except OSError as error:
                raise PigaError(
                    f"{source}: cannot be searched ({error.strerror or error})", remedy="name a smaller folder"
                ) from None
            inside = [path for path in named if not any(is_hidden(part) for part in path.parents)]
        if not inside:
            raise PigaError(f"{source}: holds no calibration.json", remedy="name another directory")
        paths += inside
    if len(paths) > _MOST_RECORDS:
        raise PigaError(f"{len(paths)} files, more than {_MOST_RECORDS}", remedy="name fewer directories")
    return list(dict.fromkeys(paths))


def _entry(path: Path) -> HistoryEntry:
    """A file as a record. Its path is the id; the time is that of the evaluation."""
    from piga.records.calibration import Calibration

    calibration = Calibration.from_json(path)
    created = calibration.provenance.created
    try:
        time = dt.datetime.fromisoformat(created)
    except ValueError:
        raise PigaError(
            f"{path}: provenance.created '{created[:40]}' is not a time", remedy="calibrate again"
        ) from None
    return str(path), time if time.tzinfo else time.replace(tzinfo=dt.UTC), calibration


def _common(given: list[str]) -> Common:
    parts: dict[str, float] = {}
    for text in given:
        name, _, number = text.rpartition("=")
        try:
            parts[name] = float(number)
        except ValueError:
            raise PigaError(
                f"--common {text}: '{number}' is not a number", remedy="e.g. 0.5, or timing=0"
            ) from None
    if "" in parts and len(parts) > 1:
        raise PigaError(
            "--common: give either one part for all sources, or parts by source", remedy="drop the plain number"
        )
    return parts.get("", parts)
