"""``piga compensate``: specific force and velocity increments from runs and calibrations."""

from __future__ import annotations

import io
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from piga.cli.common import (
    ForceOption,
    check_pipes,
    files_named_in,
    note,
    print_json,
    progress,
    say,
    write_by_rename,
)
from piga.errors import ArgumentError
from piga.output import check_outputs

if TYPE_CHECKING:
    from piga.compensation import Compensated, Mounted, Phase
    from piga.records import Calibration, Run


def compensate(
    run: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN.toml",
            help="A run file, a triad file, three run files (x, y, z), or - for a live stream.",
            show_default=False,
        ),
    ],
    calibration: Annotated[
        list[Path] | None,
        typer.Option(metavar="CALIBRATION.json", help="Calibration record; one per run.", show_default=False),
    ] = None,
    out: Annotated[Path, typer.Option(help="Result, .parquet or .csv; - for a live stream.")] = Path("-"),
    method: Annotated[
        Literal["exact", "published"] | None,
        typer.Option(help="Default: what the phase of the calibration needs."),
    ] = None,
    phase: Annotated[
        str | None, typer.Option(metavar="ANGLE", help="Phase of the output zero, e.g. '0.48 rad'.")
    ] = None,
    identify_phase: Annotated[
        str | None,
        typer.Option(metavar="TIME", help="Estimate the phase from the first seconds, at rest, e.g. '60 s'."),
    ] = None,
    rate: Annotated[
        str | None, typer.Option(metavar="RATE", help="Output rate, e.g. '10 Hz'. No velocity is lost.")
    ] = None,
    uncertainty: Annotated[bool, typer.Option(help="Write the column u_ax.")] = True,
    max_age: Annotated[
        float | None, typer.Option(metavar="DAYS", help="Flag all rows if the calibration is older than this.")
    ] = None,
    other_serial: Annotated[
        bool, typer.Option("--other-serial", help="Accept a calibration of another serial number.")
    ] = False,
    force: ForceOption = False,
    kind: Annotated[Literal["angle", "rate"], typer.Option(help="Live stream: kind of the output.")] = "angle",
    arrow: Annotated[
        bool, typer.Option("--arrow", help="Live stream: Arrow record batches instead of lines.")
    ] = False,
    resume: Annotated[
        bool,
        typer.Option("--resume", hidden=True),
    ] = False,
    report: Annotated[
        Path | None,
        typer.Option(metavar="FILE.html", help="Also write a page with figures.", show_default=False),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print a summary as JSON.")] = False,
) -> None:
    """Compensate runs or live data: specific force and velocity.

    One run gives the columns t, ax, dv, u_ax, flags. Several instruments are solved together.
    """
    from piga.compensation.model import Phase
    from piga.records.calibration.document import read_with_digest
    from piga.units import to_si

    if resume:
        raise ArgumentError("--resume is gone", remedy="run the same command again without it")
    read = [read_with_digest(path) for path in calibration or []]
    calibrations = [one for one, _ in read]
    sources = [(path.name, digest) for path, (_, digest) in zip(calibration or [], read, strict=True)]
    given = None if phase is None else Phase(to_si(phase, "rad", what="--phase"))
    rest = None if identify_phase is None else to_si(identify_phase, "s", what="--identify-phase")
    period = None if rate is None else 1.0 / to_si(rate, "Hz", what="--rate")
    live, several = str(run[0]) == "-", len(run) > 1 or _is_triad(run[0])
    if live or several:
        _refuse(live, identify_phase=rest, phase=given, rate=period, report=report)
    if live:
        _live(_one(calibrations), kind, method, given, arrow, uncertainty, max_age)
        return
    if str(out) == "-":
        raise ArgumentError("--out is missing", remedy="name a .parquet or .csv file")
    page = _page(report)
    inputs = [path for one in run for path in files_named_in(one)] + (calibration or [])
    check_outputs([out, *([] if page is None else [page])], inputs, force=force)
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")  # PyArrow's own keeps 30 MB of unused memory
    options = _Options(method, given, uncertainty, max_age, other_serial, period)
    if several:
        summary, calibrations = _together(run, sources, calibrations, out, options, page)
    else:
        summary = _single(run[0], _one(calibrations), sources, (out, page), options, rest)
    if json:
        print_json({"file": str(out)} | summary | {"calibrations": _verdicts(calibrations)})
        return
    say(f"wrote {out}: {summary['rows']} rows")
    if page is not None:
        say(f"wrote {page}")
    for name, count in summary.get("flags", {}).items():
        note(f"{name}: {count} {'row' if count == 1 else 'rows'}")
    for name, count in summary.get("repairs", {}).items():
        note(f"{count} x {name}")
    for one in calibrations:
        for doubt in one.verdict.doubts:
            note(f"piga: calibration of {one.serial}: {doubt.words}")


def _verdicts(calibrations: list[Calibration]) -> list[dict[str, Any]]:
    """What the calibrations used do not hold for, as JSON values."""
    return [
        {
            "serial": one.serial,
            "verdict": one.verdict.level,
            "does_not_hold": [d.words for d in one.verdict.doubts],
        }
        for one in calibrations
    ]


ONE_RECORD = {
    "identify_phase": ("live", "several", "give the phase, or use piga.compensation.PhaseFinder"),
    "phase": ("", "several", "give each [[triad.instrument]] its phase"),
    "rate": ("live", "", "resample with piga.compensation.Resampler"),
    "report": ("live", "", "record the stream, then compensate the record"),
}
"""Options that are not allowed for a live stream or several instruments, and the alternative."""


def _refuse(live: bool, **options: object) -> None:
    """Refuse an option that would have no effect."""
    kind = "live" if live else "several"
    for name, value in options.items():
        *refused, remedy = ONE_RECORD[name]
        if value and kind in refused:
            where = "a live stream" if live else "several instruments"
            raise ArgumentError(f"--{name.replace('_', '-')} is not for {where}", remedy=remedy)


def _page(report: Path | None) -> Path | None:
    """Path of the report page; None without a page."""
    if report is None:
        return None
    if report.suffix != ".html":
        raise ArgumentError(f"--report {report}: the name must end in .html", remedy="e.g. report.html")
    return report


def _is_triad(path: Path) -> bool:
    from piga.compensation.sets.set_files import is_triad_file

    return is_triad_file(path)


def _one(calibrations: list[Calibration]) -> Calibration:
    if len(calibrations) != 1:
        raise ArgumentError(
            f"--calibration is given {len(calibrations)} times", remedy="one is needed for one run"
        )
    return calibrations[0]


@dataclass(frozen=True)
class _Options:
    """Options of a compensation. ``period`` [s] is the interval of another output rate."""

    method: str | None
    phase: Phase | None
    uncertainty: bool
    max_age: float | None
    force: bool
    period: float | None

    def arguments(self) -> dict[str, Any]:
        """Keyword arguments for the functions of :mod:`piga.compensation`."""
        return {
            "method": self.method,
            "phase": self.phase,
            "uncertainty": self.uncertainty,
            "max_age_days": self.max_age,
            "force": self.force,
        }

    def in_words(self, calibration: Calibration) -> dict[str, str]:
        """Options as label-value pairs for the report."""
        from piga.compensation.model import check_method

        phase = "of the calibration"
        if self.phase is not None:
            phase = f"{self.phase.value:.6g} rad, standard uncertainty {self.phase.std:.2g} rad"
        return {"method": check_method(self.method, calibration), "phase used": phase} | self.common()

    def common(self) -> dict[str, str]:
        """Label-value pairs that the reports of one instrument and of a set share."""
        return {
            "rate": "as recorded"
            if self.period is None
            else f"written at {1.0 / self.period:.6g} Hz, shown as recorded",
            "calibration flagged when older than": "never"
            if self.max_age is None
            else f"{self.max_age:g} days",
            "another serial number allowed": "yes" if self.force else "no",
        }


def _single(
    run: Path,
    calibration: Calibration,
    sources: list[tuple[str, str]],
    target: tuple[Path, Path | None],
    options: _Options,
    rest: float | None,
) -> dict[str, Any]:
    """Compensate one recorded run of any length.

    ``sources`` are the calibration file and its SHA-256 as read. ``target``: result and report.
    ``rest`` [s] is the initial time at rest, which gives
    the phase.
    """
    from piga.compensation import Resampler, identify_phase
    from piga.compensation.compensator import compensate
    from piga.compensation.files.file_to_file import (
        HELD_ROWS,
        FileSummary,
        compensate_to_file,
        found_while_reading,
    )
    from piga.compensation.result import format_of, inputs_listed
    from piga.stand import read_run

    out, page = target
    kind = format_of(out)
    with progress("reading"):
        record = read_run(run)
    inputs = [*record.input_sha256.items(), *sources]
    options = _with_phase(options, None if rest is None else identify_phase(record, calibration, rest))
    resampler = None if options.period is None else Resampler(options.period)
    report, watch = None, None
    if page is not None:
        report = _Report(page, record.kind, calibration, inputs)
        watch = report.outline.piece
        if record.size <= HELD_ROWS:
            report.take(record, compensate(record, calibration, **options.arguments()))
            watch = None
    summary = FileSummary()

    def write(path: Path) -> None:
        nonlocal summary
        with progress("compensating", record.size) as advance:
            summary = compensate_to_file(
                record, calibration, path, kind, resampler=resampler, progress=advance, watch=watch,
                inputs=inputs, **options.arguments(),
            )  # fmt: skip

    write_by_rename(out, write)
    repairs = found_while_reading(record)
    if report is not None:
        report.write(options.in_words(calibration), repairs)
    return {
        "rows": summary.rows,
        "velocity_m_s": summary.velocity,
        "flags": summary.flags,
        "repairs": repairs,
        "inputs": inputs_listed(inputs),
    }


def _with_phase(options: _Options, phase: Phase | None) -> _Options:
    """The options with the estimated phase, if one was estimated."""
    if phase is None:
        return options
    note(f"phase {phase.value:.6g} rad, standard uncertainty {phase.std:.2g} rad")
    return replace(options, phase=phase)


def _together(
    runs: list[Path], sources: list[tuple[str, str]], calibrations: list[Calibration], out: Path, options: _Options,
    page: Path | None,
) -> tuple[dict[str, Any], list[Calibration]]:  # fmt: skip
    """Summary and the calibrations used: those given, or those that the triad file names."""
    from piga.compensation.result import format_of
    from piga.compensation.sets.set_files import compensate_set_files, orthogonal_triad, read_triad

    if options.method == "published":
        raise ArgumentError(
            "--method published is not for several instruments",
            remedy="leave it out; piga.studies.published_set compares the published solution of a set",
        )
    kind = format_of(out)
    if len(runs) == 1:
        paths, mounted, inputs = read_triad(runs[0])
    elif len(runs) == len(calibrations) == 3:
        paths, mounted, inputs = runs, orthogonal_triad(calibrations), sources
    else:
        raise ArgumentError(
            f"{len(runs)} runs and {len(calibrations)} calibrations: piga cannot know how the instruments are mounted",
            remedy="three runs and three calibrations in the order x, y, z, or a triad file with axes",
        )
    report = None
    if page is not None:
        report = _SetReport(page, paths, mounted)
    summary: dict[str, Any] = {}

    def write(path: Path) -> None:
        with progress("compensating") as advance:
            summary.update(
                compensate_set_files(
                    paths, mounted, path, kind, uncertainty=options.uncertainty, max_age_days=options.max_age,
                    force=options.force, period=options.period, progress=advance,
                    watch=None if report is None else report.outline.piece, inputs=inputs,
                )
            )  # fmt: skip

    write_by_rename(out, write)
    if report is not None:
        report.write({"method": "exact"} | options.common(), summary["inputs"])
    return summary, [one.calibration for one in mounted]


class _Report:
    """Collects the report of one compensation. ``files``: name and SHA-256 of each file read."""

    def __init__(self, page: Path, kind: str, calibration: Calibration, files: list[tuple[str, str]]) -> None:
        self._page, self._calibration, self._files = page, calibration, files
        from piga.reports.compensation.outline import outline_of

        self._whole: tuple[Run, Compensated] | None = None
        self.outline = outline_of(kind, calibration)

    def take(self, record: Run, result: Compensated) -> None:
        """Add a whole record."""
        self._whole = record, result
        self.outline.record(record, result)

    def write(self, options: dict[str, str], repairs: dict[str, int]) -> None:
        """Write the report by rename."""
        from piga.reports.compensation.page import CompensationFacts, write_compensation_report

        facts = CompensationFacts(self._calibration, self._files, options, repairs)
        write_by_rename(
            self._page,
            lambda path: write_compensation_report(self.outline, facts, path, self._whole),
            "--report",
        )


class _SetReport:
    """Collects the report of a set. ``runs`` are its run files."""

    def __init__(self, page: Path, runs: list[Path], mounted: list[Mounted]) -> None:
        from piga.records import read_run_file
        from piga.reports.compensation.outline import SetOutline

        self._page = page
        kinds = [read_run_file(run).data for run in runs]
        serials = [item.calibration.serial for item in mounted]
        self._names = tuple(
            f"{run.stem} ({serial})" if serial else run.stem for run, serial in zip(runs, serials, strict=True)
        )
        self.outline = SetOutline("rate" if kinds[0].output.kind == "rate" else "angle", mounted)

    def write(self, options: dict[str, str], inputs: list[dict[str, str]]) -> None:
        """Write the report by rename. ``inputs`` are those of the summary."""
        from piga.reports.compensation.page import SetFacts, write_set_report

        files = dict.fromkeys((one["file"], one["sha256"]) for one in inputs)
        facts = SetFacts(self._names, tuple(files), options)
        write_by_rename(self._page, lambda path: write_set_report(self.outline, facts, path), "--report")


def _live(
    calibration: Calibration,
    kind: str,
    method: str | None,
    phase: Phase | None,
    arrow: bool,
    uncertainty: bool,
    max_age: float | None,
) -> None:
    from piga.compensation import Compensator
    from piga.compensation.files.live import compensate_arrow, compensate_lines

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
