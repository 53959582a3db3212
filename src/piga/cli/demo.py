"""``piga demo``: the main job on the shipped record."""

from __future__ import annotations

import gzip
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from piga.cli.calibrate import RESULTS, run_calibration, write_results
from piga.cli.common import say
from piga.cli.options import ForceOption
from piga.output import results

EXAMPLE = "tumble-a"


def demo(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where the results go.")] = Path(
        "piga-demo"
    ),
    force: ForceOption = False,
) -> None:
    """Calibrate and compensate the shipped record, with a report."""
    from piga.compensation import compensate
    from piga.reports.calibration.page import calibration_text
    from piga.stand import read_run

    names = (*RESULTS, "compensated.parquet", f"{EXAMPLE}.csv", f"{EXAMPLE}.toml")
    with results(out, "demo", names, (), force=force) as folder:
        run = copy_example(folder)
        calibration = run_calibration(run, None, None, None, None)
        written = [*write_results(calibration, folder), folder / "compensated.parquet"]
        compensate(read_run(run), calibration).to_parquet(written[-1])
    say(calibration_text(calibration))
    say("")
    run = out / run.name
    say(f"The record and its run file are in {out}; change {run.name} and run: piga calibrate {run}")
    for path in written:
        say(f"wrote {out / path.name}")


def copy_example(folder: Path) -> Path:
    """Copy the shipped record and its run file into ``folder``; returns the run file."""
    source = files("piga.data")
    (folder / f"{EXAMPLE}.csv").write_bytes(gzip.decompress(source.joinpath(f"{EXAMPLE}.csv.gz").read_bytes()))
    run = folder / f"{EXAMPLE}.toml"
    run.write_bytes(source.joinpath(f"{EXAMPLE}.toml").read_bytes())
    return run
