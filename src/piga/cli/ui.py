"""``piga ui``: the workbench in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from piga.cli.common import say

if TYPE_CHECKING:
    from piga.workbench.live import Live
    from piga.workbench.security import Door


def ui(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Folder of records [default: this one].")
    ] = Path(),
    port: Annotated[int, typer.Option(metavar="N", help="Port on this machine [default: a free one].")] = 0,
    host: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Let other computers in: the name of this machine that their browsers use. "
            "Needs --tls and --password-file.",
        ),
    ] = None,
    tls: Annotated[
        tuple[Path, Path] | None,
        typer.Option(metavar="CERT KEY", help="TLS certificate of that name and its private key (PEM)."),
    ] = None,
    password_file: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="File with the password (12 characters or more) that only you can read."
        ),
    ] = None,
    live: Annotated[
        Path | None,
        typer.Option(
            metavar="CALIBRATION.json",
            help="Compensate the lines of standard input on the page Live, with this.",
        ),
    ] = None,
    phase: Annotated[str | None, typer.Option(help="Live: phase of the output zero, e.g. '0.48 rad'.")] = None,
    browser: Annotated[bool, typer.Option(help="Open the browser.")] = True,
) -> None:
    """Open the workbench in the browser.

    It answers on this machine only, to the browser that opens the printed address. With --host it answers other
    computers, too, and asks for the password. Ctrl-C ends it.
    """
    from piga.workbench.app import open_browser, serve
    from piga.workbench.remote import entrance

    way = entrance(host, tls, password_file)

    def ready(door: Door) -> None:
        say(f"piga ui: {door.address}")
        if browser:
            open_browser(door.address)

    serve(folder, port, ready=ready, live=None if live is None else _live(live, phase), entrance=way)


def _live(calibration: Path, phase: str | None) -> Live:
    """The stream on standard input."""
    import sys

    from piga.cli.common import check_pipes
    from piga.units import to_si
    from piga.workbench.live import Live

    check_pipes()
    stream = Live(calibration, None if phase is None else to_si(phase, "rad"))
    stream.start(sys.stdin)
    return stream
