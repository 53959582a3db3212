"""``piga compensate``: specific force and velocity increments from runs and calibrations."""

from __future__ import annotations

import glob
import io
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer

from piga.cli.common import (
    ForceOption,
    argument,
    check_pipes,
    counted,
    deliver,
    deliver_file,
    files_named_in,
    flag,
    note,
    option,
    progress,
)
from piga.errors import ArgumentError

if TYPE_CHECKING:
    from piga.compensation import Compensated, CompensatedSet, Phase
    from piga.compensation.result import Inputs
    from piga.records import Calibration, Run
    from piga.reports.render.page import Page


def compensate(
    run: Annotated[
        list[Path],
        argument(
            "RUN.toml",
            "A run file, a triad file, three run files (x, y, z), or - for a live stream.",
            show_default=False,
        ),
    ],
    calibration: Annotated[list[Path] | None, option("CALIBRATION.json", "Calibration; one per run.")] = None,
    out: Annotated[Path, option("FILE", "Result, .parquet or .csv; - for a live stream.")] = Path("-"),
    method: Annotated[
        Literal["exact", "published"] | None,
        typer.Option(help="Default: what the phase of the calibration needs."),
    ] = None,
    phase: Annotated[str | None, option("ANGLE", "Phase of the output zero, e.g. '0.48 rad'.")] = None,
    identify_phase: Annotated[str | None, option("TIME", "Phase from this time at rest, e.g. '60 s'.")] = None,
    rate: Annotated[str | None, option("RATE", "Output rate, e.g. '10 Hz'. No velocity is lost.")] = None,
    uncertainty: Annotated[bool, typer.Option(help="Write the column u_ax.")] = True,
    max_age: Annotated[float | None, option("DAYS", "Flag all rows if the calibration is older.")] = None,
    other_serial: Annotated[bool, flag("--other-serial", "Accept another serial number.")] = False,
    as_run: Annotated[str | None, option("NAME", "Take a joint calibration as this run sees it.")] = None,
    force: ForceOption = False,
    kind: Annotated[Literal["angle", "rate"], typer.Option(help="Live stream: kind of the output.")] = "angle",
    arrow: Annotated[bool, flag("--arrow", "Live stream: Arrow record batches instead of lines.")] = False,
    report: Annotated[Path | None, option("FILE.html", "Also write a page with figures.")] = None,
    json: Annotated[bool, flag("--json", "Print a summary as JSON.")] = False,
) -> None:
    """Compensate runs or live data: specific force and velocity.

    One run gives the columns t, ax, dv, u_ax, flags. Several instruments are solved together.
    """
    from piga.compensation.files import is_triad_file, summary_of
    from piga.compensation.model import Phase
    from piga.compensation.result import format_of, write_rows
    from piga.records.calibration.document import read_with_digest
    from piga.units import to_si

    read = [read_with_digest(path) for path in calibration or []]
    calibrations = [one if as_run is None else one.for_run(as_run) for one, _ in read]
    sources = [(path.name, digest) for path, (_, digest) in zip(calibration or [], read, strict=True)]
    given = None if phase is None else Phase(to_si(phase, "rad", what="--phase"))
    rest = None if identify_phase is None else to_si(identify_phase, "s", what="--identify-phase")
    period = None if rate is None else 1.0 / to_si(rate, "Hz", what="--rate")
    live, several = str(run[0]) == "-", len(run) > 1 or is_triad_file(run[0])
    if live or several:
        _refuse(live, identify_phase=rest, phase=given, rate=period, report=report, as_run=as_run)
    if live:
        _live(_one(calibrations), kind, method, given, uncertainty, max_age, arrow)
        return
    if str(out) == "-":
        raise ArgumentError("--out is missing", remedy="name a .parquet or .csv file")
    if report is not None and report.suffix != ".html":
        raise ArgumentError(f"--report {report}: the name must end in .html", remedy="e.g. report.html")
    arguments: dict[str, Any] = {"uncertainty": uncertainty, "max_age_days": max_age, "force": other_serial}
    shown = {
        "rate": "as recorded" if period is None else f"written at {1.0 / period:.6g} Hz, shown as recorded",
        "calibration flagged when older than": "never" if max_age is None else f"{max_age:g} days",
        "another serial number allowed": "yes" if other_serial else "no",
    }
    inputs = [path for one in run for path in files_named_in(one)] + (calibration or [])
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")  # PyArrow's own keeps 30 MB of unused memory
    command = f"compensate-{out.stem[:40]}"
    names = [glob.escape(path.name) for path in (out, report) if path is not None and path.parent == out.parent]
    with ExitStack() as stack:
        to = stack.enter_context(deliver(out.parent, command, names, inputs, force=force, as_json=json))
        page_to = to
        if report is not None and report.parent != out.parent:
            other = deliver_file(report, command, inputs, force=force, as_json=json, option="--report")
            page_to = stack.enter_context(other)
        format_of(out)
        if several:
            solved = _together(run, sources, calibrations, method, arguments, report is not None)
        else:
            solved = _single(run[0], sources, _one(calibrations), method, given, rest, arguments)
        with progress("writing", solved.result.size) as advance:
            written = write_rows(
                solved.result, to / out.name, period=period, inputs=solved.inputs, progress=advance
            )
        if report is not None:
            from piga.reports.render.page import write_page

            with progress("writing the report"):
                write_page(solved.page(shown), page_to / report.name)
        summary = summary_of(solved.result, solved.records, written, solved.inputs)
        document = {"file": str((to.folder or out.parent) / out.name)} | summary
        document["calibrations"] = [
            {"serial": used.serial, "verdict": used.verdict.grade}
            | {"doubts": [doubt.words for doubt in used.verdict.doubts]}
            for used in solved.calibrations
        ]
        to.tell(lambda: document, lambda: counted(summary["rows"], "row"))
    for line in [] if json else _notes(document):
        note(line)


def _notes(document: dict[str, Any]) -> Iterator[str]:
    """What a user must know of a compensation: flags, repairs, notes, and doubts about the calibrations."""
    yield from (f"{name}: {counted(count, 'row')}" for name, count in document["flags"].items())
    yield from (f"{count} x {name}" for name, count in document["repairs"].items())
    yield from document["notes"]
    for used in document["calibrations"]:
        yield from (f"piga: calibration of {used['serial']}: {doubt}" for doubt in used["doubts"])


_ONE_RECORD = {
    "identify_phase": ("live", "several", "give the phase, or use piga.compensation.PhaseFinder"),
    "phase": ("", "several", "give each [[triad.instrument]] its phase"),
    "as_run": ("", "several", "compensate each instrument by itself"),
    "rate": ("live", "", "resample with piga.compensation.Resampler"),
    "report": ("live", "", "record the stream, then compensate the record"),
}
"""Options that are not allowed for a live stream or several instruments, and the alternative."""


def _refuse(live: bool, **options: object) -> None:
    """Refuse an option that would have no effect."""
    kind, where = ("live", "a live stream") if live else ("several", "several instruments")
    for name, value in options.items():
        *refused, remedy = _ONE_RECORD[name]
        if value and kind in refused:
            raise ArgumentError(f"--{name.replace('_', '-')} is not for {where}", remedy=remedy)


def _one(calibrations: list[Calibration]) -> Calibration:
    if len(calibrations) != 1:
        raise ArgumentError(
            f"--calibration is given {len(calibrations)} times", remedy="one is needed for one run"
        )
    return calibrations[0]


class _Solved(NamedTuple):
    """A compensation: result, records, files and calibrations used, and its page, made of the options in words."""

    result: Compensated | CompensatedSet
    records: Sequence[Run]
    inputs: Inputs
    calibrations: list[Calibration]
    page: Callable[[dict[str, str]], Page]


def _single(
    run: Path,
    sources: list[tuple[str, str]],
    calibration: Calibration,
    method: str | None,
    phase: Phase | None,
    rest: float | None,
    arguments: dict[str, Any],
) -> _Solved:
    """Compensate one recorded run of any length. ``sources`` are the calibration file and its SHA-256 as read."""
    from piga.compensation import identify_phase
    from piga.compensation.compensator import compensate
    from piga.compensation.model import check_method
    from piga.stand import read_run

    with progress("reading"):
        record = read_run(run)
    inputs = [*record.input_sha256.items(), *sources]
    if rest is not None:
        phase = identify_phase(record, calibration, rest)
        note(f"phase {phase.value:.6g} rad, standard uncertainty {phase.std:.2g} rad")
    with progress("compensating", record.size) as advance:
        result = compensate(record, calibration, method=method, phase=phase, progress=advance, **arguments)

    def page(shown: dict[str, str]) -> Page:
        from piga.reports.compensation import compensation_page, of_record

        words = {"method": check_method(method, calibration)}
        if not calibration.direct:
            given = f"{phase.value:.6g} rad, standard uncertainty {phase.std:.2g} rad" if phase else ""
            words["phase used"] = given or "of the calibration"
        data = inputs[1 if len(inputs) > 2 else 0][0]
        return compensation_page(of_record(record, calibration, result), (data,), inputs, words | shown)

    return _Solved(result, [record], inputs, [calibration], page)


def _together(
    runs: list[Path],
    sources: list[tuple[str, str]],
    calibrations: list[Calibration],
    method: str | None,
    arguments: dict[str, Any],
    details: bool,
) -> _Solved:
    """Solve several instruments together, with the calibrations given or those that the triad file names."""
    from piga.compensation.files import compensate_set, orthogonal_triad, read_member, read_triad

    if method == "published":
        raise ArgumentError(
            "--method published is not for several instruments", remedy="leave it out: a set is solved exactly"
        )
    if len(runs) == 1:
        paths, mounted, inputs = read_triad(runs[0])
    elif len(runs) == len(calibrations) == 3:
        paths, mounted, inputs = runs, orthogonal_triad(calibrations), sources
    else:
        raise ArgumentError(
            f"{len(runs)} runs and {len(calibrations)} calibrations: piga cannot know how the instruments are mounted",
            remedy="three runs and three calibrations in the order x, y, z, or a triad file with axes",
        )
    each = list(zip(paths, mounted, strict=True))
    with progress("reading"):
        records = [read_member(path, item, arguments["force"]) for path, item in each]
    inputs = [*inputs, *(file for record in records for file in record.input_sha256.items())]
    with progress("compensating", records[0].size) as advance:
        result = compensate_set(records, mounted, details=details, progress=advance, **arguments)

    def page(shown: dict[str, str]) -> Page:
        from piga.reports.compensation import compensation_page, of_set

        serials = [(path.stem, item.calibration.serial) for path, item in each]
        names = tuple(f"{name} ({serial})" if serial else name for name, serial in serials)
        outline, files = of_set(records, mounted, result), list(dict.fromkeys(inputs))
        return compensation_page(outline, names, files, {"method": "exact"} | shown)

    return _Solved(result, records, inputs, [item.calibration for item in mounted], page)


def _live(
    calibration: Calibration,
    kind: str,
    method: str | None,
    phase: Phase | None,
    uncertainty: bool,
    max_age: float | None,
    arrow: bool,
) -> None:
    from piga.compensation import Compensator
    from piga.compensation.live import compensate_arrow, compensate_lines

    check_pipes()
    stream = Compensator(
        calibration, kind=kind, method=method, phase=phase, uncertainty=uncertainty, max_age_days=max_age
    )
    if arrow:
        compensate_arrow(sys.stdin.buffer, sys.stdout.buffer, stream)
    else:
        if isinstance(sys.stdin, io.TextIOWrapper):
            sys.stdin.reconfigure(encoding="utf-8-sig", errors="replace")
        compensate_lines(sys.stdin, sys.stdout, stream)
