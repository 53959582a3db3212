"""``piga calibrate``, ``piga compensate``, and ``piga demo``: the main job on the shipped record."""

from __future__ import annotations

import glob
import io
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer

from piga.cli.common import (
    ForceOption,
    JsonOption,
    MethodOption,
    PhasesOption,
    TermsOption,
    argument,
    counted,
    deliver,
    deliver_file,
    files_named_in,
    flag,
    note,
    option,
    progress,
)
from piga.data import EXAMPLE, copy_example
from piga.errors import ArgumentError, PigaError
from piga.output import CALIBRATION_RESULTS

if TYPE_CHECKING:
    from piga.calibration.summary import RunSummary
    from piga.compensation import Compensated, CompensatedSet, Compensator, Phase
    from piga.compensation.result import Inputs
    from piga.records import Calibration, Run
    from piga.reports.render.page import Page

RunFilesArgument = Annotated[
    list[Path],
    argument("RUN.toml", "Run file. Several files, or summaries of runs (.json), are calibrated together."),
]


def calibrate(
    runs: RunFilesArgument,
    out: Annotated[Path | None, option("DIR", "Folder for the results [default: RUN-calibration].")] = None,
    terms: TermsOption = None,
    method: MethodOption = None,
    phases: PhasesOption = None,
    per_run: Annotated[
        str | None, option("A,B,...", "Terms of each run alone [default: k0]; '' for none.")
    ] = None,
    summary: Annotated[bool, flag("--summary", "Also write summaries, to calibrate without the data.")] = False,
    report: Annotated[bool, typer.Option(help="Write report.html.")] = True,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate the coefficients of an instrument from its runs.

    Writes calibration.json, residuals.parquet and report.html. Several runs of one instrument are calibrated together.
    A set with reference = "gravity-norm" gives set-calibration.json and report.html.
    """
    inputs = [path for run in runs for path in files_named_in(run)]
    default = f"{runs[0].stem}-calibration" if len(runs) == 1 else "joint-calibration"
    directory = out or runs[0].parent / default
    from piga.gravity_norm.estimate import is_set_file

    if any(is_set_file(run) for run in runs):
        plain = not any((terms, method, phases, per_run, summary))
        _calibrate_set(runs, directory, inputs, plain=plain, force=force, as_json=as_json)
        return
    from piga.calibration.summary import RunSummary
    from piga.records.calibration.document import to_document

    with deliver(directory, "calibrate", CALIBRATION_RESULTS, inputs, force=force, as_json=as_json) as to:
        items = _read_items(runs)
        with progress("calibrating") as advance:
            from piga.calibration.calibrate import calibrate as estimate

            calibration = estimate(
                items, _names(terms), method, phases=phases, per_run=_names(per_run), progress=advance
            )
        with progress("writing the report" if report else "writing"):
            write_results(calibration, to.stage, report=report)
            for item in items if summary else []:
                if not isinstance(item, RunSummary):
                    made = RunSummary.of(item)
                    made.to_json(to / f"summary-{made.name}.json")
        to.tell(lambda: to_document(calibration), calibration.summary)


def _names(text: str | None) -> list[str] | None:
    return None if text is None else [name.strip() for name in text.split(",") if name.strip()]


def _calibrate_set(
    runs: list[Path], directory: Path, inputs: list[Path], *, plain: bool, force: bool, as_json: bool
) -> None:
    from piga.gravity_norm import calibrate_set_file
    from piga.reports.gravity_norm import brief, page, set_document

    if len(runs) > 1 or not plain:
        raise ArgumentError(
            f"{runs[0]}: a set with reference = 'gravity-norm' is calibrated alone and has no terms or methods to choose",
            remedy="name this file alone, without these options",
        )
    names = ("set-calibration.json", "report.html")
    with deliver(directory, "calibrate", names, inputs, force=force, as_json=as_json) as to:
        with progress("calibrating"):
            calibration = calibrate_set_file(runs[0])
        to.show(set_document(calibration), page(calibration), brief(calibration), *names)


def _read_items(paths: list[Path]) -> list[Run | RunSummary]:
    from piga.calibration.summary import RunSummary
    from piga.stand import read_run

    with progress("reading"):
        return [RunSummary.from_json(path) if path.suffix == ".json" else read_run(path) for path in paths]


def write_results(calibration: Calibration, directory: Path, *, report: bool = True) -> None:
    """Write the results. A calibration of summaries alone has no residuals to write."""
    from piga.formats.columns import write_residuals

    calibration.to_json(directory / "calibration.json")
    if calibration.residuals is not None:
        write_residuals(calibration, directory / "residuals.parquet")
    if report:
        calibration.report(directory / "report.html")


def demo(
    out: Annotated[Path, option("DIR", "Folder for the results.")] = Path("piga-demo"),
    force: ForceOption = False,
) -> None:
    """Calibrate and compensate the shipped record, with a report."""
    note("demo of the shipped record; the first time takes up to a minute")
    from piga.compensation import compensate as compensate_run
    from piga.stand import read_run

    names = (*CALIBRATION_RESULTS, "compensated.parquet", f"{EXAMPLE}.csv", f"{EXAMPLE}.toml")
    with deliver(out, "demo", names, (), force=force, as_json=False) as to:
        run = copy_example(to.stage)
        with progress("reading"):
            record = replace(read_run(run), source=f"{to.folder}/{run.name}")
        with progress("calibrating") as show:
            from piga.calibration.calibrate import calibrate as estimate

            calibration = estimate([record], progress=show)
        with progress("writing the report"):
            write_results(calibration, to.stage)
        with progress("compensating"):
            compensate_run(record, calibration).to_parquet(to / "compensated.parquet")
        here = f"{sys.executable} -m piga"  # in an environment that is not activated
        program = "piga" if shutil.which("piga") else here
        again = f"To go on: change {to.folder}/{run.name} and run: {program} calibrate {to.folder}/{run.name}"
        to.tell(dict, lambda: f"{calibration.summary()}\n\n{again}")


# -- compensation --------------------------------------------------------------------------------------


def compensate(
    run: Annotated[list[Path], argument("RUN.toml", "Run file, triad file, three run files, or - (live).")],
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
    max_age: Annotated[
        float | None, option("DAYS", "Flag all rows if the calibration is older.", min=0)
    ] = None,
    other_serial: Annotated[bool, flag("--other-serial", "Accept another serial number.")] = False,
    as_run: Annotated[str | None, option("NAME", "Take a joint calibration as this run sees it.")] = None,
    force: ForceOption = False,
    kind: Annotated[Literal["angle", "rate"], typer.Option(help="Live stream: kind of the output.")] = "angle",
    arrow: Annotated[bool, flag("--arrow", "Live stream: Arrow record batches instead of lines.")] = False,
    report: Annotated[Path | None, option("FILE.html", "Also write a page with figures.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Compensate runs or live data: specific force and velocity.

    One run gives the columns t, ax, dv, u_ax, flags. Several instruments are solved together.
    """
    from piga.compensation import Compensator
    from piga.compensation.model import Phase
    from piga.compensation.result import format_of, summary_of, write_rows
    from piga.compensation.sets import is_triad_file
    from piga.records.calibration.document import read_with_digest
    from piga.units import to_si

    read = [read_with_digest(path) for path in calibration or []]
    calibrations = [one if as_run is None else one.for_run(as_run) for one, _ in read]
    sources = [(path.name, digest) for path, (_, digest) in zip(calibration or [], read, strict=True)]
    given = None if phase is None else Phase(to_si(phase, "rad", what="--phase"))
    rest, hertz = _positive("--identify-phase", identify_phase, "s"), _positive("--rate", rate, "Hz")
    live, several = str(run[0]) == "-", len(run) > 1 or is_triad_file(run[0])
    options = {"identify_phase": rest, "phase": given, "rate": hertz, "report": report, "as_run": as_run}
    _refuse("a live stream" if live else "several instruments" if several else "", options)
    if live:
        _live(
            Compensator(
                _one(calibrations),
                kind=kind,
                method=method,
                phase=given,
                uncertainty=uncertainty,
                max_age_days=max_age,
            ),
            arrow,
        )
        return
    if str(out) == "-":
        raise ArgumentError("--out is missing", remedy="name a .parquet or .csv file")
    if report is not None and report.suffix != ".html":
        raise ArgumentError(f"--report {report}: the name must end in .html", remedy="e.g. report.html")
    arguments: dict[str, Any] = {"uncertainty": uncertainty, "max_age_days": max_age, "force": other_serial}
    shown = {
        "rate": "as recorded" if hertz is None else f"written at {hertz:.6g} Hz, shown as recorded",
        "calibration flagged when older than": "never" if max_age is None else f"{max_age:g} days",
        "another serial number allowed": "yes" if other_serial else "no",
    }
    inputs = [path for one in run for path in files_named_in(one)] + (calibration or [])
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")  # PyArrow's own keeps 30 MB of unused memory
    command, made = f"compensate-{out.stem[:40]}", [out, *([report] if report else [])]
    names = [glob.escape(path.name) for path in made if path.parent == out.parent]
    with ExitStack() as stack:
        to = stack.enter_context(deliver(out.parent, command, names, inputs, force=force, as_json=as_json))
        page_to = to
        if report is not None and report.parent != out.parent:
            other = deliver_file(report, command, inputs, force=force, as_json=as_json)
            page_to = stack.enter_context(other)
        format_of(out)
        if several:
            solved = _together(run, sources, calibrations, method, arguments, report is not None)
        else:
            solved = _single(run[0], sources, _one(calibrations), method, given, rest, arguments)
        with progress("writing", solved.result.size) as advance:
            period = None if hertz is None else 1.0 / hertz
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
    for line in [] if as_json else _notes(document):
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


_PHASE = "give the phase, or use piga.compensation.PhaseFinder"
_NO_EFFECT = {
    "a live stream": {
        "identify_phase": _PHASE,
        "rate": "resample with piga.compensation.Resampler",
        "report": "record the stream, then compensate the record",
    },
    "several instruments": {
        "identify_phase": _PHASE,
        "phase": "give each [[triad.instrument]] its phase",
        "as_run": "compensate each instrument by itself",
    },
}
"""Options that would have no effect, and the alternative."""


def _refuse(where: str, options: Mapping[str, object]) -> None:
    for name, remedy in _NO_EFFECT.get(where, {}).items():
        if options[name]:
            raise ArgumentError(f"--{name.replace('_', '-')} is not for {where}", remedy=remedy)


def _one(calibrations: list[Calibration]) -> Calibration:
    if len(calibrations) != 1:
        given = f"is given {len(calibrations)} times" if calibrations else "is missing"
        raise ArgumentError(
            f"--calibration {given}",
            remedy="name the one calibration of the run: --calibration CALIBRATION.json",
        )
    return calibrations[0]


class _Solved(NamedTuple):
    """A compensation: result, records, files and calibrations used, and its page, made of the options in words."""

    result: Compensated | CompensatedSet
    records: Sequence[Run]
    inputs: Inputs
    calibrations: list[Calibration]
    page: Callable[[dict[str, str]], Page]


def _is_another_record(record: Run, calibration: Calibration) -> bool:
    """True if no data file of the record was calibrated."""
    data = {digest for file, digest in record.input_sha256.items() if not file.endswith(".toml")}
    return not data & {*calibration.provenance.input_sha256.values()}


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
    from piga.compensation.compensator import compensate as compensate_run
    from piga.compensation.model import check_method
    from piga.stand import read_run

    with progress("reading"):
        record = read_run(run)
    inputs = [*record.input_sha256.items(), *sources]
    if rest is not None:
        phase = identify_phase(record, calibration, rest)
        note(f"phase {phase.value:.6g} rad, standard uncertainty {phase.std:.2g} rad")
    elif phase is None and "tan_beta" in calibration.terms and _is_another_record(record, calibration):
        note(
            "the phase of the calibration is used: right if the output still counts from the same zero; "
            "after a new power-up use --identify-phase '60 s'"
        )
    with progress("compensating", record.size) as advance:
        result = compensate_run(record, calibration, method=method, phase=phase, progress=advance, **arguments)

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
    from piga.compensation.sets import compensate_set, orthogonal_triad, read_member, read_triad

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
    with progress("reading"):
        records = [read_member(path) for path in paths]
    inputs = [*inputs, *(file for record in records for file in record.input_sha256.items())]
    with progress("compensating", records[0].size) as advance:
        result = compensate_set(records, mounted, details=details, progress=advance, **arguments)

    def page(shown: dict[str, str]) -> Page:
        from piga.reports.compensation import compensation_page, of_set

        serials = [(path.stem, item.calibration.serial) for path, item in zip(paths, mounted, strict=True)]
        names = tuple(f"{name} ({serial})" if serial else name for name, serial in serials)
        outline, files = of_set(records, mounted, result), list(dict.fromkeys(inputs))
        return compensation_page(outline, names, files, {"method": "exact"} | shown)

    return _Solved(result, records, inputs, [item.calibration for item in mounted], page)


def _live(stream: Compensator, arrow: bool) -> None:
    """Compensate standard input until it ends."""
    from piga.compensation.live import compensate_arrow, compensate_lines

    closed = "input" if sys.stdin is None else "output" if getattr(sys.stdout, "name", "") == os.devnull else ""
    if closed:
        raise PigaError(f"standard {closed} is closed", remedy="connect it: ... | piga compensate - ... > FILE")
    if arrow:
        compensate_arrow(sys.stdin.buffer, sys.stdout.buffer, stream)
    else:
        if isinstance(sys.stdin, io.TextIOWrapper):
            sys.stdin.reconfigure(encoding="utf-8-sig", errors="replace")
        compensate_lines(sys.stdin, sys.stdout, stream)
