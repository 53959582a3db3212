"""One place that says how kernels are compiled.

Kernels take floats and float64 arrays, raise nothing a user should read, and run unchanged with
``NUMBA_DISABLE_JIT=1``. ``nogil`` lets plain threads run them on all cores; ``cache`` keeps the
compiled code between processes. Contraction of multiply-add is allowed, reordering is not, so that
results do not depend on how a record is split.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile a hot loop (cached on disk, releases the GIL)."""
    return cast("F", numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})(function))


def inline(function: F) -> F:
    """Compile a small scalar function that is inlined into the kernels that call it."""
    return cast("F", numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})(function))


def exact(function: F) -> F:
    """Compile arithmetic whose rounding errors are part of the method: nothing is contracted."""
    return cast("F", numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=False)(function))
