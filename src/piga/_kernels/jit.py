"""One place that says how kernels are compiled.

Kernels take floats and float64 arrays, raise nothing a user should read, and run unchanged with
``NUMBA_DISABLE_JIT=1``. ``nogil`` lets plain threads run them on all cores; ``cache`` keeps the
compiled code between processes. Contraction of multiply-add is allowed, reordering is not, so that
results do not depend on how a record is split.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numba
from numba import types

F = TypeVar("F", bound=Callable[..., Any])


def _compiled(function: F, fastmath: bool | set[str]) -> F:
    made = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=fastmath)(function)
    return cast("F", made)


def kernel(function: F) -> F:
    """Compile a hot loop (cached on disk, releases the GIL)."""
    return _compiled(function, {"contract"})


def inline(function: F) -> F:
    """Compile a small scalar function that is inlined into the kernels that call it."""
    return _compiled(function, {"contract"})


def exact(function: F) -> F:
    """Compile arithmetic whose rounding errors are part of the method: nothing is contracted."""
    return _compiled(function, False)


def reducing_kernel(function: F) -> F:
    """Compile a loop that sums many numbers: sums may be reordered, so that they use vector registers.

    Used only where the last bits of a sum do not matter for how results compare between chunkings.
    """
    return _compiled(function, {"contract", "reassoc", "nsz"})


def _no_prefetch(_array: Any, _index: int) -> None:
    """Ask the memory for the element at a flat ``index``, which may lie beyond the end; never waits."""


if TYPE_CHECKING or numba.config.DISABLE_JIT:
    prefetch = _no_prefetch
else:
    from llvmlite import ir
    from numba.extending import intrinsic

    @intrinsic
    def prefetch(_context, array, _index):
        """Ask the memory for the element at a flat ``index``, which may lie beyond the end; never waits."""

        def generate(context, builder, signature, arguments):
            data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
            byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
            address = builder.bitcast(builder.gep(data, [arguments[1]]), byte)
            kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
            function = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
            builder.call(function, [address, number(0), number(3), number(1)])
            return context.get_dummy_value()

        return types.void(array, types.intp), generate
