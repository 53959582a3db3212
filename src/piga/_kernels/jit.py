"""Decorators that compile the kernels.

Kernels take floats and float64 arrays. They raise no messages for users. They run unchanged with
``NUMBA_DISABLE_JIT=1``. With ``nogil`` plain threads run them on all cores. Contraction of multiply-add is allowed.
Reordering is not, so the results do not depend on how a record is split.

Numba keeps the compiled code between processes: in ``NUMBA_CACHE_DIR`` if the user sets it, else in a folder of the
user's own (:func:`cache_folder`). Kernels are kept by their sources, not by the place of the package: a second
installation compiles nothing again. Compiled code is executed as it is read. So a folder that another user owns is refused,
and the kernels are compiled in each process.
"""

from __future__ import annotations

import os
import stat
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core import event
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.runtime.nrt import rtsys
from numpy.typing import NDArray

from piga._version import __version__
from piga.progress import WHEN_COMPILED

Array = NDArray[np.float64]
F = TypeVar("F", bound=Callable[..., Any])

config: Any = numba.config


def _user_cache() -> Path:
    """The folder for caches of the current user, by the custom of the system. RuntimeError if there is no home."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def sources_digest(folder: Path) -> str:
    """Digest of the kernels' sources in ``folder``, and of the version of Numba.

    Numba compares a cached kernel with its own file only, not with the files of the kernels that it calls.
    """
    digest = zlib.crc32(numba.__version__.encode())
    for path in sorted(folder.rglob("*.py")):
        digest = zlib.crc32(path.read_bytes(), zlib.crc32(path.name.encode(), digest))
    return f"{digest:08x}"


SOURCES = sources_digest(Path(__file__).parent)


def cache_folder(parent: Path) -> Path | None:
    """The folder of compiled kernels of these sources in ``parent``, made for this user alone (mode 0700).

    None if it cannot be made, is not a folder, or belongs to another user.
    """
    folder = parent / f"piga-kernels-{__version__}-{SOURCES}"
    try:
        parent.mkdir(parents=True, exist_ok=True)
        if not folder.exists():
            folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
        if hasattr(os, "getuid"):
            if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid():
                return None
            if stat.S_IMODE(status.st_mode) & 0o077:
                folder.chmod(0o700)
    except OSError:
        return None
    return folder


def _folder_to_use() -> str:
    """Folder for the compiled kernels; empty if there is none."""
    if config.CACHE_DIR:
        return str(config.CACHE_DIR)
    try:
        return str(cache_folder(_user_cache()) or "")
    except RuntimeError:
        return ""


FOLDER = _folder_to_use()


class _LoadedCache(FunctionCache):
    """Numba's cache. It loads compiled code without the tables that only the compiler needs (a fifth of a command's start)."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled code for a signature, or None. Of Numba, compiled code needs only the memory manager."""
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]


class _Compilations(event.Listener):
    """Tells those who wait that a kernel is compiled."""

    def on_start(self, _event: Any) -> None:
        """A kernel is compiled from now on."""
        while WHEN_COMPILED:
            WHEN_COMPILED.pop()()

    def on_end(self, _event: Any) -> None:
        """A kernel is compiled."""


event.register("numba:compile", _Compilations())  # type: ignore[no-untyped-call]


def _compiled(function: F, fastmath: bool | set[str], **more: Any) -> F:
    options: dict[str, Any] = {"cache": bool(FOLDER), "nogil": True, "error_model": "numpy"}
    options |= {"no_cfunc_wrapper": True} | more
    before = config.CACHE_DIR
    config.CACHE_DIR = FOLDER  # for our kernels only: code of the user keeps its place
    try:
        made = numba.njit(fastmath=fastmath, **options)(function)
    finally:
        config.CACHE_DIR = before
    cache = getattr(made, "_cache", None)
    if isinstance(cache, FunctionCache):
        cache.__class__ = _LoadedCache
        if function.__module__.startswith("piga._kernels."):
            place = str(Path(FOLDER, function.__module__))
            cache._impl.locator.get_cache_path = lambda: place
            cache._cache_path = place
            cache._cache_file = IndexDataCacheFile(place, cache._impl.filename_base, SOURCES)  # type: ignore[no-untyped-call]
    return cast("F", made)


def kernel(function: F) -> F:
    """Compile a hot loop (cached on disk, releases the GIL)."""
    return _compiled(function, {"contract"})


def inline(function: F) -> F:
    """Compile a function that is inlined into the kernels that call it. It makes no array, so no references are counted."""
    return _compiled(function, {"contract"}, forceinline=True, _nrt=False)


def lean(function: F) -> F:
    """Compile a function that makes no array, and returns none to a :func:`kernel`: no references are counted.

    That took two thirds of the time of a compensation.
    """
    return _compiled(function, {"contract"}, _nrt=False)


def exact(function: F) -> F:
    """Like :func:`lean`, for arithmetic whose rounding errors are part of the method: nothing is contracted."""
    return _compiled(function, False, _nrt=False)
