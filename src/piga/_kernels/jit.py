"""Decorators that compile the kernels.

Kernels take floats and float64 arrays. They raise no messages for users. They run unchanged with
``NUMBA_DISABLE_JIT=1``. With ``nogil`` plain threads run them on all cores. ``cache`` keeps the
compiled code between processes. Contraction of multiply-add is allowed. Reordering is not, so the
results do not depend on how a record is split.
"""

from __future__ import annotations

import hashlib
import pickle
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TypeVar, cast

import numba
import numpy as np
from numba import types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.compiler_lock import global_compiler_lock
from numba.core.runtime.nrt import rtsys
from numpy.typing import NDArray

try:
    import fcntl
except ImportError:  # Windows: every process compiles for itself
    fcntl = None  # type: ignore[assignment]

Array = NDArray[np.float64]
F = TypeVar("F", bound=Callable[..., Any])

LOCK = "compiling.lock"
"""Lock file in the folder of compiled kernels; the compiling process holds it."""
PATIENCE = 60.0
"""Longest wait for another process [s]; a stopped process delays others no longer than this."""
LOADING = 0.5
"""A kernel that takes longer is compiled and not loaded [s]."""
RECENT = 2.0
"""Time after a compilation within which the next one is expected [s]."""


class _SoundCacheFile(IndexDataCacheFile):
    """Files of compiled kernels. A file that does not contain the bytes that were written is compiled again.

    A power cut leaves files that are empty, short or full of zeros. Numba does not check them, so the command would end
    with an exception of Numba. Here every file begins with the SHA-256 of the rest, and a damaged one is removed. Files that
    cannot be read or written (a full disk, another user's) cost only the time to compile.
    """

    def save(self, key: Any, data: Any) -> None:
        """Store a compiled kernel if there is space."""
        _Turn.saved = time.monotonic()
        with suppress(OSError):
            super().save(key, data)  # type: ignore[no-untyped-call]

    def _load_index(self) -> dict[Any, str]:
        try:
            version, packed = pickle.loads(self._read(self._index_path))  # noqa: S301 - as in _load_data
        except OSError:
            return {}
        if version != self._version:
            return {}
        try:
            stamp, overloads = pickle.loads(packed)  # noqa: S301 - as in _load_data
        except (AttributeError, ImportError):  # of an older version, with a class that has another name now
            return {}
        return overloads if stamp == self._source_stamp else {}

    def _save_index(self, overloads: dict[Any, str]) -> None:
        packed = self._dump((self._source_stamp, overloads))  # type: ignore[no-untyped-call]
        self._write(self._index_path, pickle.dumps((self._version, packed)))

    def _load_data(self, name: str) -> Any:
        path = self._data_path(name)  # type: ignore[no-untyped-call]
        try:
            return pickle.loads(self._read(path))  # noqa: S301 - compiled code of this package, as Numba keeps it
        except (AttributeError, ImportError):  # of an older version, that called a module of another name
            self._remove(path)
            raise FileNotFoundError(path) from None

    def _save_data(self, name: str, data: Any) -> None:
        packed = self._dump(data)  # type: ignore[no-untyped-call]
        self._write(self._data_path(name), packed)  # type: ignore[no-untyped-call]

    def _read(self, path: str) -> bytes:
        """Content after the SHA-256. If it does not match, the file is removed and FileNotFoundError is raised."""
        raw = Path(path).read_bytes()
        if hashlib.sha256(raw[32:]).digest() != raw[:32]:
            self._remove(path)
            raise FileNotFoundError(path)
        return raw[32:]

    def _write(self, path: str, packed: bytes) -> None:
        with self._open_for_write(path) as stream:
            stream.write(hashlib.sha256(packed).digest() + packed)

    @staticmethod
    def _remove(path: str) -> None:
        with suppress(OSError):
            Path(path).unlink()


class _LoadedCache(FunctionCache):
    """Cache of a kernel. It loads compiled code without the parts of Numba that only compiling needs."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled code for a signature, or None. Of Numba, compiled code needs only the memory manager."""
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]


def _hold(folder: Path) -> IO[bytes] | None:
    """Hold the lock of a folder until the returned file is closed; None if the lock is not available.

    One of several processes compiles, and the others load the stored result. The system releases the lock when a process
    ends, for any reason.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        held = (folder / LOCK).open("ab")
    except OSError:
        return None
    last = time.monotonic() + PATIENCE
    while fcntl is not None and time.monotonic() < last:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(0.02)
        except OSError:  # a file system without locks
            break
        else:
            break
    return held


class _Turn:
    """Compiles a kernel, and all that it calls, while no other process does."""

    depth = 0
    since = 0.0
    saved = -1e9

    def __init__(self, compile_: Callable[[Any], Any], folder: Path) -> None:
        self._compile, self._folder = compile_, folder

    def __call__(self, signature: Any) -> Any:
        with global_compiler_lock:
            if _Turn.depth:
                return self._compile(signature)
            _Turn.depth += 1
            _Turn.since = time.monotonic()
            held = _hold(self._folder)
            try:
                return self._compile(signature)
            finally:
                _Turn.depth -= 1
                if held is not None:
                    held.close()


def compiling() -> bool:
    """True while kernels are compiled, not only loaded: the first command after an installation does so."""
    now = time.monotonic()
    return (_Turn.depth > 0 and now - _Turn.since > LOADING) or now - _Turn.saved < RECENT


def _compiled(function: F, fastmath: bool | set[str]) -> F:
    options: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
    try:
        made = numba.njit(fastmath=fastmath, **options)(function)
    except RuntimeError:  # no folder that may be written to: compiled in every process
        made = numba.njit(fastmath=fastmath, **(options | {"cache": False}))(function)
    cache = getattr(made, "_cache", None)
    if isinstance(cache, FunctionCache):
        cache.__class__ = _LoadedCache
        cache._cache_file.__class__ = _SoundCacheFile
        made.compile = _Turn(made.compile, Path(cache.cache_path))
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
