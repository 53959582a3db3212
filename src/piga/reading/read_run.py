"""Read a run: run file and data file to a :class:`~piga.records.run.Run`, everything found counted."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from piga.errors import RunFileError
from piga.output import settle
from piga.reading.assembly import Assembly, StandReference
from piga.reading.raw_columns import read_columns
from piga.records.run import Run
from piga.records.run_file import read_run_file
from piga.records.toml_file import toml_bytes


def read_record(
    path: str | Path, stand_reference: StandReference, *, need_reference: bool = True, held: int | None = None
) -> Run:
    """Read a recorded test; :func:`piga.read_run` is this with the stands of piga.

    Parameters
    ----------
    path:
        Run file (TOML); its data file is looked for beside it.
    stand_reference:
        Gives the reference when ``[data]`` has none and a ``[stand]`` table describes it.
    need_reference:
        False: a record without any reference is read too (its ``f`` is nan); a set of instruments needs none.
    held:
        Most rows whose arrays lie in memory; None: 4 194 304. Nothing that is read or refused depends on it.

    Raises
    ------
    RunFileError
        If the run file is not valid.
    DataError
        If the data file does not hold what the run file says; with file, row, column and remedy.

    Notes
    -----
    The arrays of a record of more than ``held`` rows lie in files without a name beside it, mapped into memory: what
    stays resident is bounded, whatever the length of the record.
    """
    path = Path(path)
    settle(path.parent)
    content = toml_bytes(path)
    run_file = read_run_file(path, content)
    if need_reference and run_file.data.reference is None and run_file.stand is None:
        raise RunFileError(
            f"{path}: [data] reference is missing: the specific force that the instrument felt",
            remedy="add reference = { columns = ['fx', 'fy', 'fz'], unit = 'g' }, or a [stand] table",
        )
    raw = read_columns(path.parent, run_file.data, held)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        run = Assembly(run_file, raw, stand_reference).run(path)
    run.input_sha256.update({path.name: hashlib.sha256(content).hexdigest()} | raw.inputs)
    return run
