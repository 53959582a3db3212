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
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})(function))


def reducing_kernel(function: F) -> F:
    """Compile a loop that sums many numbers: sums may be reordered, so that they use vector registers.

    Used only where the last bits of a sum do not matter for how results compare between chunkings.
    """
    flags = {"contract", "reassoc", "nsz"}
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=flags)(function))


def exact_kernel(function: F) -> F:
    """Compile arithmetic that relies on every rounding (error-free transformations): no contraction."""
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy")(function))
