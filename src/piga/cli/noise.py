"""``piga noise``: deviations and levels of the noise of a static log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from piga.cli.common import ForceOption, JsonOption, deliver, files_named_in, progress, write_json


def noise(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Run file, or a log written by any program.")],
    column: Annotated[
        str | None, typer.Option("--column", metavar="NAME", help="Column of the output, for a log.")
    ] = None,
    kind: Annotated[
        Literal["rate", "angle"],
        typer.Option("--kind", help="rate: a voltage, a rate. angle: what is summed up, as counts, a phase."),
    ] = "rate",
    unit: Annotated[
        str | None, typer.Option("--unit", metavar="UNIT", help="Unit of the column [default: as in the log].")
    ] = None,
    sample_rate: Annotated[
        str | None,
        typer.Option("--sample-rate", metavar="RATE", help="If no column holds the time, e.g. '20 Hz'."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Write noise.json and noise.html.")
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show the noise of a static log.

    Allan, modified and Hadamard deviation, and the levels of quantisation, random walk, bias instability, rate random walk
    and drift, each with its interval.
    """
    from piga.noise import read_static_log
    from piga.reports.noise import brief, noise_document, page
    from piga.reports.render.page import page_text, write_page

    with progress("reading"):
        result = read_static_log(log, column=column, kind=kind, unit=unit, sample_rate=sample_rate)
    names = ("noise.json", "noise.html")
    inputs = files_named_in(log) if log.suffix == ".toml" else [log]
    with deliver(out, "noise", names, inputs, force=force, as_json=as_json) as to:
        if out is not None:
            write_json(to / names[0], noise_document(result))
            write_page(page(result), to / names[1])
        to.tell(lambda: noise_document(result), lambda: page_text(brief(result)))
