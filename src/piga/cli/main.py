"""Entry point of the command ``piga``. Exit codes: 0 done, 2 wrong use or bad input, 1 internal error, 130 stopped with Ctrl-C."""

from __future__ import annotations

import gc
import os
import sys
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from piga._version import __version__
from piga.cli import records
from piga.cli.calibrate import calibrate, compensate, demo
from piga.cli.check import check, convert, examples, init, noise, terms
from piga.cli.common import BOTH, DOING, FORCE, JSON, App, argument, note, option, prepare_output, say
from piga.cli.simulate import campaign, plan, platform, reproduce, simulate
from piga.errors import EXTRAS, ArgumentError, CalibrationWarning, PigaError, PigaWarning, missing_package

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
"""One BLAS thread, because the matrices are small. More threads would wait for each other, for seconds on a busy machine."""

RARELY = 100_000
"""New objects between two searches for garbage: most objects of a command are made at its start and stay."""
STOPPED = 130
"""Exit code of a command that was stopped with Ctrl-C, as shells have it."""
app = App(
    "piga",
    "Calibrate and compensate precession-type accelerometers, and analyse the platform that carries them.",
    pretty_exceptions_enable=False,
    add_completion=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(value: bool) -> None:
    if value:
        typer.echo(f"piga {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version."
    ),
) -> None:
    pass


def ui(
    folder: Annotated[
        Path, argument("FOLDER", "Folder of records [default: this one].", show_default=False)
    ] = Path(),
    port: Annotated[int, option("N", "Port on this machine [default: a free one].", show_default=False)] = 0,
    browser: Annotated[bool, typer.Option(help="Open the browser.")] = True,
) -> None:
    """Open the workbench in the browser.

    It answers on this machine only, to the browser that opens the printed address. Ctrl-C ends it.
    """
    from piga.workbench.app import Door, open_browser, serve

    def ready(door: Door, place: Path) -> None:
        say(f"piga ui: {door.address}")
        if browser:
            open_browser(door, place)

    serve(folder, port, ready=ready)


COMMANDS: dict[Callable[..., None], tuple[str, ...]] = {
    demo: FORCE,
    examples: FORCE,
    init: BOTH,
    check: BOTH,
    convert: FORCE,
    calibrate: BOTH,
    compensate: BOTH,
    noise: BOTH,
    simulate: BOTH,
    plan: BOTH,
    reproduce: BOTH,
    ui: (),
    terms: JSON,
}
"""Commands in the order of the help, with the options of their endings."""
for command, ends in COMMANDS.items():
    app.command(ends=ends)(command)
for group in (platform, campaign, records.app, records.certificates):
    app.add_typer(group)


def main() -> None:
    """Run the command line and turn errors into exit codes.

    Doubts about a calibration are printed with its result. Other warnings of piga are lines on stderr.
    """
    gc.set_threshold(RARELY)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        show = warnings.showwarning

        def one_line(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if issubclass(category, PigaWarning):
                note(f"piga: {message}")
            else:
                show(message, category, *where, **more)

        warnings.showwarning = one_line
        guarded(_run)


_LOOPBACK = "from another computer: ssh -L 8443:127.0.0.1:8443 BENCH with --port 8443, or a reverse proxy"
_STREAM = "compensate the stream with: logger | piga compensate - --calibration CALIBRATION.json"
_KEEP = "calibrate with it, then keep the folder: piga records add RUN.toml --results DIR"
_GONE = {
    "completion": "let the shell complete commands with: piga --install-completion",
    "methods": "piga check --explain estimation.method",
    "calibrate --compare": "write the sets into the run file: [model] compare",
    "calibrate --phase-source": "write it into the run file: [model] phase_source",
    **{f"records add {name}": _KEEP for name in ("--terms", "--method", "--phases", "--phase-source")},
    "records backup": "an export of all records is one: piga records export FILE --store STORE",
    "certificate issue --issued": "write the date into the file of --data: [certificate] issued; without it: today",
    "compensate --arrow": "send lines, or push columns into piga.Compensator in Python",
    "compensate --resume": "run the same command again without it",
    "platform navigate": "piga platform compare SCENARIO.toml --out DIR writes navigation-MODEL.parquet too",
    "platform simulate --every": "take every N-th row of the Parquet file",
    **dict.fromkeys(("init --yes", "init -y"), "leave it out: init does not ask"),
    **dict.fromkeys(("ui --host", "ui --tls", "ui --password-file"), _LOOPBACK),
    **dict.fromkeys(("ui --live", "ui --phase"), _STREAM),
}
"""Commands and options that piga had, and what takes their place."""


def _run() -> None:
    """Run the command of the arguments; one that is gone is refused, with what takes its place."""
    words = [word.partition("=")[0] for word in sys.argv[1:]]
    for gone, remedy in _GONE.items():
        named = gone.split()
        option = named.pop() if "-" in named[-1][:1] else ""
        if words[: len(named)] == named and option in ("", *words[len(named) :]):
            raise ArgumentError(f"piga {gone} is gone", remedy=remedy)
    app(standalone_mode=True, prog_name="piga")


def stopped_words(stop: KeyboardInterrupt) -> str:
    """What was stopped and what is on disk, from the notes of a stop."""
    notes = list(dict.fromkeys(getattr(stop, "__notes__", [])))
    doing = next((text for text in notes if text.startswith(DOING)), "")
    disk = [text for text in notes if not text.startswith(DOING)] or ["nothing was written"]
    return "\n".join([f"piga: stopped{' ' if doing else ''}{doing}", *(f"  on disk: {text}" for text in disk)])


def guarded(action: Callable[[], object]) -> None:
    """Do the work of a command; errors end the process with an exit code."""
    prepare_output()
    try:
        action()
    except PigaError as error:
        note(f"piga: {error}")
        sys.exit(2)
    except BrokenPipeError:
        sys.exit(0)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise
        note(f"piga: {missing_package(package)}")
        sys.exit(2)
    except OSError as error:
        name = f"{error.filename}: " if error.filename else ""
        remedy = "check name, rights and room on the disk (TMPDIR: that of temporary files), then run again"
        note(f"piga: {name}{error.strerror or error}\n  remedy: {remedy}")
        sys.exit(2)
    except KeyboardInterrupt as stop:
        note(stopped_words(stop))
        sys.exit(STOPPED)
    except SystemExit as end:
        cause = getattr(end.__context__, "__cause__", None)
        if end.code == STOPPED and isinstance(cause, KeyboardInterrupt):  # typer made an exit of it
            note(stopped_words(cause))
        raise
    except MemoryError:
        note("piga: stopped: the memory is full\n  remedy: end other programs, or cut the record into parts")
        sys.exit(1)
    except Exception:  # any unexpected error ends here
        traceback.print_exc()
        note("piga: internal error; please report it with the lines above")
        sys.exit(1)
