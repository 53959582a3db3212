"""``piga ui``: the workbench in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from piga.cli.common import argument, option, say

if TYPE_CHECKING:
    from piga.workbench.security import Door

_Gone = typer.Option(hidden=True, metavar="...")


def ui(
    folder: Annotated[
        Path, argument("FOLDER", "Folder of records [default: this one].", show_default=False)
    ] = Path(),
    port: Annotated[
        int, option("--port", "N", "Port on this machine [default: a free one].", show_default=False)
    ] = 0,
    browser: Annotated[bool, typer.Option(help="Open the browser.")] = True,
    host: Annotated[str | None, _Gone] = None,
    tls: Annotated[tuple[str, str] | None, _Gone] = None,
    password_file: Annotated[str | None, _Gone] = None,
    live: Annotated[str | None, _Gone] = None,
    phase: Annotated[str | None, _Gone] = None,
) -> None:
    """Open the workbench in the browser.

    It answers on this machine only, to the browser that opens the printed address. Ctrl-C ends it.
    """
    from piga.errors import ArgumentError
    from piga.workbench.app import open_browser, serve

    if host is not None or tls is not None or password_file is not None:
        raise ArgumentError(
            "piga ui answers on this machine only: --host, --tls and --password-file are gone",
            remedy="from another computer: ssh -L 8443:127.0.0.1:8443 BENCH with --port 8443, or a reverse proxy",
        )
    if live is not None or phase is not None:
        raise ArgumentError(
            "piga ui shows no stream any more: --live and --phase are gone",
            remedy="compensate the stream with: logger | piga compensate - --calibration CALIBRATION.json",
        )

    def ready(door: Door, place: Path) -> None:
        say(f"piga ui: {door.address}")
        if browser:
            open_browser(door, place)

    serve(folder, port, ready=ready)
