"""One place that says how kernels are compiled.

Kernels take floats and float64 arrays, raise nothing a user should read, and run unchanged with
``NUMBA_DISABLE_JIT=1``. ``nogil`` lets plain threads run them on all cores; ``cache`` keeps the
compiled code between processes. Contraction of multiply-add is allowed, reordering is not, so that
results do not depend on how a record is split.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numba
from numba import types
from numba.core.caching import FunctionCache, IndexDataCacheFile

F = TypeVar("F", bound=Callable[..., Any])


class _SoundCacheFile(IndexDataCacheFile):
    """Files of compiled kernels that hold what was written, or are compiled again.

    A power cut leaves files that are empty, short or full of zeros. Numba reads them as they are: the command ends
    in its exceptions. Here every data file begins with the SHA-256 of the rest, and a damaged one is removed.
    """

    def _load_index(self) -> dict[Any, str]:
        try:
            return super()._load_index()  # type: ignore[no-untyped-call]
        except OSError:
            raise
        except Exception:  # whatever unpickling damaged bytes provokes
            self._remove(self._index_path)
            return {}

    def _load_data(self, name: str) -> Any:
        path = self._data_path(name)  # type: ignore[no-untyped-call]
        raw = Path(path).read_bytes()
        if hashlib.sha256(raw[32:]).digest() != raw[:32]:
            self._remove(path)
            raise FileNotFoundError(path)
        return pickle.loads(raw[32:])  # noqa: S301 - compiled code of this package, as Numba keeps it

    def _save_data(self, name: str, data: Any) -> None:
        packed = self._dump(data)  # type: ignore[no-untyped-call]
        with self._open_for_write(self._data_path(name)) as stream:  # type: ignore[no-untyped-call]
            stream.write(hashlib.sha256(packed).digest() + packed)

    @staticmethod
    def _remove(path: str) -> None:
        with suppress(OSError):
            Path(path).unlink()


def _compiled(function: F, fastmath: bool | set[str]) -> F:
    made = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=fastmath)(function)
    cache = getattr(made, "_cache", None)
    if isinstance(cache, FunctionCache):
        cache._cache_file.__class__ = _SoundCacheFile
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
