"""``piga demo``: the main job on the shipped record."""

from __future__ import annotations

import gzip
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from piga.cli.calibrate import run_calibration, write_results
from piga.cli.common import output_directory, say, write_by_rename

EXAMPLE = "tumble-a"


def demo(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where the results go.")] = Path(
        "piga-demo"
    ),
) -> None:
    """Calibrate and compensate the shipped record, with a report."""
    from piga.compensation import compensate
    from piga.reports.calibration import calibration_text
    from piga.stand import read_run

    run = copy_example(output_directory(out))
    calibration = run_calibration(run, None, None, None, None)
    written = write_results(calibration, out)
    written.append(
        write_by_rename(out / "compensated.parquet", compensate(read_run(run), calibration).to_parquet)
    )
    say(calibration_text(calibration))
    say("")
    say(f"The record and its run file are in {out}; change {run.name} and run: piga calibrate {run}")
    for path in written:
        say(f"wrote {path}")


def copy_example(folder: Path) -> Path:
    """Copy the shipped record and its run file into ``folder``; returns the run file."""
    source = files("piga.data")
    data = gzip.decompress(source.joinpath(f"{EXAMPLE}.csv.gz").read_bytes())
    text = source.joinpath(f"{EXAMPLE}.toml").read_bytes()
    write_by_rename(folder / f"{EXAMPLE}.csv", lambda path: path.write_bytes(data))
    return write_by_rename(folder / f"{EXAMPLE}.toml", lambda path: path.write_bytes(text))
