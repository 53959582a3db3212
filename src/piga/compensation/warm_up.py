"""Compile the kernels in processes of their own: the compiler takes 200 MB that the work on a file does not need.

The compiler keeps what it has worked on. Every kernel that is done stands on disk, so a process that has grown too large
ends, and the next one goes on from there.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numba.core.event import Listener, install_listener

from piga._kernels.compensation import layout as at
from piga._kernels.compensation.record import compensate_angles, compensate_rates
from piga._kernels.compensation.set import SET_STATE, SET_WORK
from piga._kernels.compensation.set_record import compensate_set
from piga.compensation.model import Model
from piga.compensation.sets.set_compensator import stacked
from piga.compensation.step import NO_RATES, NONE, Chunk, empty_step, init_state, run_kernel, work_array

KERNELS = {"angle": compensate_angles, "rate": compensate_rates, "set": compensate_set}
MOST_BYTES = 230_000_000
"""Memory of a compiling process above which the next kernel is left to another one."""
MORE = 75
"""Exit status of a process that leaves kernels to the next one."""
MOST_PROCESSES = 12


def compile_apart(kind: str) -> None:
    """Let others compile the kernel of an ``angle`` or ``rate`` record or of a ``set``, unless it stands on disk."""
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
        self._saved = False

    def on_start(self, _event: Any) -> None:
        """A kernel is about to be compiled."""
        if self._saved and _memory() > MOST_BYTES:
            os._exit(MORE)

    def on_end(self, event: Any) -> None:
        """It is compiled; one of ours is put on the disk after this, parts of Numba itself are not."""
        self._saved |= event.data["dispatcher"].py_func.__module__.startswith("piga.")


def _memory() -> int:
    """Most memory that this process has held [bytes]; 0 where the system does not tell."""
    status = Path("/proc/self/status")
    if status.exists():  # the resource usage begins with what the process that started this one held
        lines = (line.split() for line in status.read_text(encoding="ascii", errors="replace").splitlines())
        return next((1024 * int(words[1]) for words in lines if words[:1] == ["VmHWM:"]), 0)
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def compile_here(kind: str) -> None:
    """Compile the kernel: run it on a few samples."""
    rows, marks = np.zeros(4), np.ones(4, dtype=np.bool_)
    model = Model(
        parameters=np.ones(at.PARAMETERS), has_terms=False, orders=NONE, sines=NONE, cosines=NONE,
        codes=np.zeros(0, dtype=np.int64), factor=np.zeros((0, 0)), limits=np.zeros(5), formula=0, base_flag=0,
        needs_temperature=False,
    )  # fmt: skip
    if kind != "set":
        chunk = Chunk(rows, rows, rows, rows, marks, NO_RATES, NONE, NONE)
        run_kernel(model, init_state(), chunk, kind, 1.0, work_array(), empty_step(4, True, True))
        return
    axes, flags = np.array([np.roll(np.eye(3), -i, axis=0) for i in range(3)]), np.zeros(4, dtype=np.int32)
    parameters, has_terms, orders, sines, cosines, codes, factors, limits = stacked([model] * 3)
    compensate_set(
        rows, np.zeros((3, 4)), np.zeros((3, 0)), marks, np.zeros((3, 0, 3)), np.zeros((3, 0)), parameters, axes,
        has_terms, orders, sines, cosines, codes, factors, limits, 0, math.inf, np.zeros((3, at.STATE)),
        np.zeros(SET_STATE), np.ones((3, at.STRIDE)), np.zeros(at.BLOCK), np.zeros((3, at.WORK)), np.zeros(SET_WORK),
        np.zeros((4, 3)), np.zeros((4, 3)), np.zeros((4, 3)), np.zeros(4), flags, np.zeros((3, 0)),
        np.zeros((3, 0), dtype=np.int32),
    )  # fmt: skip


if __name__ == "__main__":
    with install_listener("numba:compile", _Leave()):
        compile_here(sys.argv[1])
