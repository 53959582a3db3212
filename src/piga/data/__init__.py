"""Data files of the package, and the shipped record."""

from __future__ import annotations

import gzip
from importlib.resources import files
from pathlib import Path

EXAMPLE = "tumble-a"
"""Name of the shipped record."""


def copy_example(folder: Path) -> Path:
    """Copy the shipped record and its run file into ``folder``. Returns the run file."""
    source = files("piga.data")
    (folder / f"{EXAMPLE}.csv").write_bytes(gzip.decompress(source.joinpath(f"{EXAMPLE}.csv.gz").read_bytes()))
    run = folder / f"{EXAMPLE}.toml"
    run.write_bytes(source.joinpath(f"{EXAMPLE}.toml").read_bytes())
    return run
