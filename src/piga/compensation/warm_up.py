"""Compile the kernels in processes of their own: the compiler takes 200 MB that the work on a file does not need.

The compiler keeps what it has worked on. Every kernel that is done stands on disk, so a process that has grown too large
ends, and the next one goes on from there.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numba.core.event import Listener, install_listener

from piga._kernels.compensate_record import compensate_angles, compensate_rates
from piga.compensation.model import Model
from piga.compensation.step import NO_RATES, NONE, Chunk, empty_step, init_state, run_kernel, work_array

KERNELS = {"angle": compensate_angles, "rate": compensate_rates}
MOST_BYTES = 230_000_000
"""Memory of a compiling process above which the next kernel is left to another one."""
MORE = 75
"""Exit status of a process that leaves kernels to the next one."""
MOST_PROCESSES = 40


def compile_apart(kind: str) -> None:
    """Let another process compile the kernel of an ``angle`` or ``rate`` record, unless its compiled form is on disk."""
    if _is_compiled(kind):
        return
    for _ in range(MOST_PROCESSES):
        done = subprocess.run([sys.executable, "-m", __name__, kind], check=False, stdout=subprocess.DEVNULL)  # noqa: S603
        if done.returncode != MORE:
            return


def _is_compiled(kind: str) -> bool:
    kernel = KERNELS[kind]
    if not hasattr(kernel, "stats"):
        return True  # interpreted
    source = Path(kernel.__code__.co_filename)
    pattern = f"{source.stem}.{kernel.__name__}-*.nbi"
    folder = Path(kernel.stats.cache_path)
    return any(found.stat().st_mtime >= source.stat().st_mtime for found in folder.glob(pattern))


class _Leave(Listener):
    """Ends the process before a kernel is compiled when it has grown too large, and one at least is on disk."""

    def __init__(self) -> None:
        self._depth = self._before = 0

    def on_start(self, _event: Any) -> None:
        """A kernel is about to be compiled; those that call it are under way."""
        if self._before > self._depth and _memory() > MOST_BYTES:
            os._exit(MORE)
        self._depth += 1
        self._before = self._depth

    def on_end(self, _event: Any) -> None:
        """It is compiled, and is put on the disk after this."""
        self._depth -= 1


def _memory() -> int:
    """Most memory that this process has held [bytes]; 0 where the system does not tell."""
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


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
    with install_listener("numba:compile", _Leave()):
        compile_here(sys.argv[1])
