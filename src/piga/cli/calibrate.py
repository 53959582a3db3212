"""``piga calibrate``, ``piga compensate``, and ``piga demo``: the main job on the shipped record."""

from __future__ import annotations

import io
import os
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import typer

import piga
from piga.cli.common import (
    Ending,
    argument,
    counted,
    deliver,
    deliver_file,
    flag,
    note,
    option,
    progress,
)
from piga.data import EXAMPLE, copy_example
from piga.errors import ArgumentError, PigaError
from piga.output import CALIBRATION_RESULTS


def calibrate(
    runs: Annotated[
        list[Path],
        argument("RUN.toml", "Run file. Several files, or summaries of runs (.json), are calibrated together."),
    ],
    out: Annotated[Path | None, option("DIR", "Folder for the results [default: RUN-calibration].")] = None,
    terms: Annotated[str | None, option("A,B,...", "Terms to estimate, instead of the run file's.")] = None,
    method: Annotated[str | None, option("NAME", "Estimator: information | rate.")] = None,
    phases: Annotated[
        str | None, option("NAME", "Phases of the output zero: shared | per-segment.", "--phases", "--phase")
    ] = None,
    per_run: Annotated[
        str | None, option("A,B,...", "Terms of each run alone [default: k0]; '' for none.")
    ] = None,
    summary: Annotated[bool, flag("--summary", "Also write summaries, to calibrate without the data.")] = False,
    report: Annotated[bool, typer.Option(help="Write report.html.")] = True,
) -> None:
    """Estimate the coefficients of an instrument from its runs.

    Writes calibration.json, residuals.parquet and report.html. Several runs of one instrument are calibrated together.
    A set with reference = "gravity-norm" gives set-calibration.json and report.html.
    """
    from piga.gravity_norm import is_set_file
    from piga.records.calibration.document import to_document

    directory = out or runs[0].parent / f"{runs[0].stem if len(runs) == 1 else 'joint'}-calibration"
    if any(is_set_file(run) for run in runs):
        _calibrate_set(runs, directory, plain=not any((terms, method, phases, per_run, summary)))
        return
    if per_run is not None and len(runs) == 1:
        raise ArgumentError(
            "--per-run is not for one run", remedy="leave it out, or name all runs of the instrument"
        )
    with deliver(directory, "calibrate", CALIBRATION_RESULTS, runs) as to:
        with progress("reading"):
            items = [
                piga.RunSummary.from_json(run) if run.suffix == ".json" else piga.read_run(run) for run in runs
            ]
        with progress("calibrating") as advance:
            calibration = piga.calibrate(
                items, _names(terms), method, phases=phases, per_run=_names(per_run), progress=advance
            )
        with progress("writing the report" if report else "writing"):
            write_results(calibration, to.stage, report=report)
            for item in items if summary else []:
                if isinstance(item, piga.Run):
                    made = piga.RunSummary.of(item)
                    made.to_json(to / f"summary-{made.name}.json")
        to.tell(lambda: to_document(calibration), calibration.summary)


def _names(text: str | None) -> list[str] | None:
    return None if text is None else [name.strip() for name in text.split(",") if name.strip()]


def _calibrate_set(runs: list[Path], directory: Path, *, plain: bool) -> None:
    from piga.gravity_norm import calibrate_set_file
    from piga.reports.gravity_norm import brief, page, set_document

    if len(runs) > 1 or not plain:
        raise ArgumentError(
            f"{runs[0]}: a set with reference = 'gravity-norm' is calibrated alone and has no terms or methods to choose",
            remedy="name this file alone, without these options",
        )
    names = ("set-calibration.json", "report.html")
    with deliver(directory, "calibrate", names, runs) as to:
        with progress("calibrating"):
            calibration = calibrate_set_file(runs[0])
        to.show(set_document(calibration), page(calibration), brief(calibration), *names)


def write_results(calibration: piga.Calibration, directory: Path, *, report: bool = True) -> None:
    """Write the results. A calibration of summaries alone has no residuals to write."""
    from piga.formats.columns import write_residuals

    calibration.to_json(directory / "calibration.json")
    if calibration.residuals is not None:
        write_residuals(calibration, directory / "residuals.parquet")
    if report:
        calibration.report(directory / "report.html")


def demo(
    out: Annotated[Path, option("DIR", "Folder for the results.")] = Path("piga-demo"),
) -> None:
    """Calibrate and compensate the shipped record, with a report."""
    note("demo of the shipped record; the first time takes up to a minute")
    names = (*CALIBRATION_RESULTS, "compensated.parquet", f"{EXAMPLE}.csv", f"{EXAMPLE}.toml")
    with deliver(out, "demo", names, ()) as to:
        run = copy_example(to.stage)
        with progress("reading"):
            record = replace(piga.read_run(run), source=f"{to.folder}/{run.name}")
        with progress("calibrating") as show:
            calibration = piga.calibrate([record], progress=show)
        with progress("writing the report"):
            write_results(calibration, to.stage)
        with progress("compensating"):
            piga.compensate(record, calibration).to_parquet(to / "compensated.parquet")
        here = f"{sys.executable} -m piga"  # in an environment that is not activated
        program = "piga" if shutil.which("piga") else here
        again = f"To go on: change {to.folder}/{run.name} and run: {program} calibrate {to.folder}/{run.name}"
        to.tell(dict, lambda: f"{calibration.summary()}\n\n{again}")


# -- compensation --------------------------------------------------------------------------------------


def compensate(
    run: Annotated[list[Path], argument("RUN.toml", "Run file, triad file, or - (live).")],
    calibration: Annotated[list[Path] | None, option("CALIBRATION.json", "Calibration of the run.")] = None,
    out: Annotated[Path, option("FILE", "Result, .parquet or .csv; - for a live stream.")] = Path("-"),
    method: Annotated[
        Literal["exact", "published"] | None,
        typer.Option(help="Default: what the phase of the calibration needs."),
    ] = None,
    phase: Annotated[str | None, option("ANGLE", "Phase of the output zero, e.g. '0.48 rad'.")] = None,
    identify_phase: Annotated[str | None, option("TIME", "Phase from this time at rest, e.g. '60 s'.")] = None,
    rate: Annotated[str | None, option("RATE", "Output rate, e.g. '10 Hz'. No velocity is lost.")] = None,
    uncertainty: Annotated[bool, typer.Option(help="Write the column u_ax.")] = True,
    max_age: Annotated[
        float | None, option("DAYS", "Flag all rows if the calibration is older.", min=0)
    ] = None,
    other_serial: Annotated[bool, flag("--other-serial", "Accept another serial number.")] = False,
    as_run: Annotated[str | None, option("NAME", "Take a joint calibration as this run sees it.")] = None,
    kind: Annotated[
        Literal["angle", "rate"] | None, typer.Option(help="Live stream: kind of the output [default: angle].")
    ] = None,
    report: Annotated[Path | None, option("FILE.html", "Also write a page with figures.")] = None,
) -> None:
    """Compensate a run or live data: specific force and velocity.

    One run gives the columns t, ax, dv, u_ax, flags. Several instruments are solved together.
    """
    from piga.compensation.result import format_of, summary_of, write_rows
    from piga.compensation.sets import is_triad_file
    from piga.units import to_si

    if len(run) > 1:
        raise ArgumentError(
            f"{len(run)} run files: piga cannot know how the instruments are mounted",
            remedy="name one triad file, which holds runs, calibrations and axes",
        )
    rest, hertz = _positive("--identify-phase", identify_phase, "s"), _positive("--rate", rate, "Hz")
    options: dict[str, Any] = {"uncertainty": uncertainty, "max_age_days": max_age, "method": method}
    options["phase"] = None if phase is None else piga.Phase(to_si(phase, "rad", what="--phase"))
    live, several = str(run[0]) == "-", is_triad_file(run[0])
    where = "a live stream" if live else "several instruments" if several else "a run file"
    given: dict[str, Any] = {"identify_phase": rest, "phase": phase, "rate": hertz, "report": report}
    given |= {"as_run": as_run, "method published": method == "published", "kind": kind}
    for name, remedy in _NO_EFFECT[where].items():
        if given[name]:
            raise ArgumentError(f"--{name.replace('_', '-')} is not for {where}", remedy=remedy)
    if live:
        _live(piga.Compensator(_calibration(calibration, as_run)[0], kind=kind or "angle", **options))
        return
    if str(out) == "-":
        raise ArgumentError("--out is missing", remedy="name a .parquet or .csv file")
    if report is not None and report.suffix != ".html":
        raise ArgumentError(f"--report {report}: the name must end in .html", remedy="e.g. report.html")
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")  # PyArrow's own keeps 30 MB of unused memory
    inputs = [*run, *(calibration or [])]
    page = nullcontext() if report is None else deliver_file(report, "compensate-page", inputs)
    with page as page_to, deliver_file(out, "compensate", inputs) as to:
        format_of(out)
        options["force"] = other_serial
        if several:
            solved = _together(run[0], report is not None, options)
        else:
            solved = _single(run[0], *_calibration(calibration, as_run), rest, options)
        with progress("writing", solved.result.size) as advance:
            period = None if hertz is None else 1.0 / hertz
            written = write_rows(
                solved.result, to / out.name, period=period, inputs=solved.inputs, progress=advance
            )
        if page_to is not None and report is not None:
            solved.words["rate"] = f"written at {hertz:.6g} Hz, shown as recorded" if hertz else "as recorded"
            from piga.reports.compensation import CompensationOutline, compensation_page

            with progress("writing the report"):
                outline = CompensationOutline(*solved[:4])
                files = list(dict.fromkeys(solved.inputs))
                shown = compensation_page(outline, solved.names, files, solved.words)
                piga.reports.write_page(shown, page_to / report.name)
        summary = summary_of(solved.result, solved.records, written, solved.inputs)
        document = {"file": str((to.folder or out.parent) / out.name)} | summary
        document["calibrations"] = [
            {"serial": used.serial, "verdict": used.verdict.grade}
            | {"doubts": [doubt.words for doubt in used.verdict.doubts]}
            for used in solved.calibrations
        ]
        to.tell(lambda: document, lambda: counted(summary["rows"], "row"))
    for line in [] if Ending.as_json else _notes(document):
        note(line)


def _positive(name: str, text: str | None, unit: str) -> float | None:
    """The SI value of an option that is larger than 0; None if it is not given."""
    from piga.units import to_si

    value = None if text is None else to_si(text, unit, what=name)
    if value is not None and value <= 0.0:
        raise ArgumentError(f"{name} {text}: must be positive", remedy="leave it out, or give more than 0")
    return value


def _notes(document: dict[str, Any]) -> Iterator[str]:
    """What a user must know of a compensation: flags, repairs, notes, and doubts about the calibrations."""
    yield from (f"{name}: {counted(count, 'row')}" for name, count in document["flags"].items())
    yield from (f"{count} x {name}" for name, count in document["repairs"].items())
    yield from document["notes"]
    for used in document["calibrations"]:
        yield from (f"piga: calibration of {used['serial']}: {doubt}" for doubt in used["doubts"])


_STREAM = {"kind": "leave it out: it says what a live stream holds (piga compensate -)"}
_NO_EFFECT = {
    "a run file": _STREAM,
    "a live stream": {
        "identify_phase": "give the phase, or use piga.compensation.PhaseFinder",
        "rate": "resample with piga.compensation.Resampler",
        "report": "record the stream, then compensate the record",
    },
    "several instruments": {
        **_STREAM,
        "identify_phase": "give each [[triad.instrument]] its phase",
        "phase": "give each [[triad.instrument]] its phase",
        "as_run": "compensate each instrument by itself",
        "method published": "leave it out: a set is solved exactly",
    },
}
"""Options that would have no effect, and the alternative."""


def _calibration(paths: list[Path] | None, as_run: str | None) -> tuple[piga.Calibration, tuple[str, str]]:
    """The calibration of the command, and its file with the SHA-256 as read."""
    from piga.records.calibration.document import read_with_digest

    if paths is None or len(paths) != 1:
        given = f"is given {len(paths)} times" if paths else "is missing"
        remedy = "name the one calibration of the run: --calibration CALIBRATION.json"
        raise ArgumentError(f"--calibration {given}", remedy=remedy)
    calibration, digest = read_with_digest(paths[0])
    return calibration if as_run is None else calibration.for_run(as_run), (paths[0].name, digest)


class _Solved(NamedTuple):
    """A compensation, what was read for it, and how a set is mounted. The page shows ``names`` and ``words``."""

    result: piga.Compensated | piga.CompensatedSet
    records: Sequence[piga.Run]
    calibrations: list[piga.Calibration]
    mounted: list[piga.Mounted]
    inputs: list[tuple[str, str]]
    names: list[str]
    words: dict[str, str]


def _single(
    run: Path,
    calibration: piga.Calibration,
    source: tuple[str, str],
    rest: float | None,
    options: dict[str, Any],
) -> _Solved:
    """Compensate one recorded run of any length."""
    with progress("reading"):
        record = piga.read_run(run)
    phase, used = options["phase"], "of the calibration"
    if rest is not None:
        phase = options["phase"] = piga.identify_phase(record, calibration, rest)
    elif phase is None and "tan_beta" in calibration.terms:
        data = {digest for file, digest in record.input_sha256.items() if not file.endswith(".toml")}
        if not data & {*calibration.provenance.input_sha256.values()}:
            note(
                "the phase of the calibration is used: right if the output still counts from the same zero; "
                "after a new power-up use --identify-phase '60 s'"
            )
    if phase is not None:
        used = f"{phase.value:.6g} rad, standard uncertainty {phase.std:.2g} rad"
    if rest is not None:
        note(f"phase {used}")
    with progress("compensating", record.size) as advance:
        result = piga.compensate(record, calibration, progress=advance, **options)
    words = {"method": result.method} | ({} if calibration.direct else {"phase used": used})
    names = [file for file in record.input_sha256 if not file.endswith(".toml")]
    inputs = [*record.input_sha256.items(), source]
    return _Solved(result, [record], [calibration], [], inputs, names[:1] or [run.name], words)


def _together(path: Path, details: bool, options: dict[str, Any]) -> _Solved:
    from piga.compensation.sets import read_member, read_triad

    paths, mounted, inputs = read_triad(path)
    with progress("reading"):
        records = [read_member(one) for one in paths]
    inputs += [file for record in records for file in record.input_sha256.items()]
    with progress("compensating", records[0].size) as advance:
        given = {name: options[name] for name in ("uncertainty", "max_age_days", "force")}
        result = piga.compensate_set(records, mounted, details=details, progress=advance, **given)
    used = [item.calibration for item in mounted]
    names = [
        f"{one.stem} ({item.serial})" if item.serial else one.stem
        for one, item in zip(paths, used, strict=True)
    ]
    return _Solved(result, records, used, mounted, inputs, names, {"method": "exact"})


def _live(stream: piga.Compensator) -> None:
    from piga.compensation.compensator import compensate_lines

    closed = "input" if sys.stdin is None else "output" if getattr(sys.stdout, "name", "") == os.devnull else ""
    if closed:
        raise PigaError(f"standard {closed} is closed", remedy="connect it: ... | piga compensate - ... > FILE")
    if isinstance(sys.stdin, io.TextIOWrapper):
        sys.stdin.reconfigure(encoding="utf-8-sig", errors="replace")
    compensate_lines(sys.stdin, sys.stdout, stream)
