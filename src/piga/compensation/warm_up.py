"""Compile the kernels in a process of their own: the compiler takes 200 MB that the work on a file does not need."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np

from piga._kernels.compensate_record import compensate_angles, compensate_rates
from piga.compensation.model import Model
from piga.compensation.step import NO_RATES, NONE, Chunk, empty_step, init_state, run_kernel, work_array

KERNELS = {"angle": compensate_angles, "rate": compensate_rates}


def compile_apart(kind: str) -> None:
    """Let another process compile the kernel of an ``angle`` or ``rate`` record, unless its compiled form is on disk."""
    if _is_compiled(kind):
        return
    subprocess.run([sys.executable, "-m", __name__, kind], check=False, stdout=subprocess.DEVNULL)  # noqa: S603


def _is_compiled(kind: str) -> bool:
    kernel = KERNELS[kind]
    if not hasattr(kernel, "stats"):
        return True  # interpreted
    source = Path(kernel.__code__.co_filename)
    pattern = f"{source.stem}.{kernel.__name__}-*.nbi"
    folder = Path(kernel.stats.cache_path)
    return any(found.stat().st_mtime >= source.stat().st_mtime for found in folder.glob(pattern))


def compile_here(kind: str) -> None:
    """Compile the kernel: run it on a few samples."""
    rows = np.zeros(4)
    no_codes = np.zeros(0, dtype=np.int64)
    model = Model(
        parameters=np.ones(64), has_terms=False, orders=NONE, sines=NONE, cosines=NONE, codes=no_codes,
        factor=np.zeros((0, 0)), limits=np.zeros(5), formula=0, base_flag=0, needs_temperature=False,
    )  # fmt: skip
    chunk = Chunk(rows, rows, rows, rows, np.ones(4, dtype=np.bool_), NO_RATES, NONE, NONE)
    run_kernel(model, init_state(), chunk, kind, 1.0, work_array(), empty_step(4, True, True))


if __name__ == "__main__":
    compile_here(sys.argv[1])
