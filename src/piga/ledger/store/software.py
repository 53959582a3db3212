"""Which software computes here: what decides whether numbers are the same to the bit."""

from __future__ import annotations

import hashlib
import os
import platform
from functools import lru_cache
from importlib import resources
from pathlib import Path

from piga._version import __version__

NUMERIC_ROOMS = ("_kernels", "records", "instrument", "stand", "calibration")
"""Rooms whose source decides the numbers of a calibration; the store itself is left out."""


@lru_cache(maxsize=1)
def software_identity() -> dict[str, str]:
    """Versions, digest of the numeric source, platform, processor and threads, as text."""
    import llvmlite.binding
    import numba
    import numpy as np
    import pyarrow as pa
    import scipy

    blas = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
    threads = os.environ.get("OPENBLAS_NUM_THREADS") or os.environ.get("OMP_NUM_THREADS") or os.cpu_count()
    return {
        "piga": __version__,
        "source_sha256": source_digest(),
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "numba": numba.__version__,
        "pyarrow": pa.__version__,
        "compiled": "no" if getattr(numba.config, "DISABLE_JIT", 0) else "yes",
        "blas": f"{blas.get('name')} {blas.get('version')} {os.environ.get('OPENBLAS_CORETYPE', '')}".strip(),
        "threads": str(threads),
        "system": platform.system(),
        "machine": platform.machine(),
        "processor": llvmlite.binding.get_host_cpu_name(),
    }


def source_digest() -> str:
    """SHA-256 over the Python files that decide the numbers, in the order of their names."""
    root = Path(str(resources.files("piga")))
    files = [*root.glob("*.py"), *(path for room in NUMERIC_ROOMS for path in (root / room).rglob("*.py"))]
    store = root / "records" / "store"
    digest = hashlib.sha256()
    for path in sorted(
        (path for path in files if store not in path.parents),
        key=lambda path: path.relative_to(root).as_posix(),
    ):
        digest.update(f"{path.relative_to(root).as_posix()}\n".encode())
        digest.update(hashlib.sha256(path.read_bytes().replace(b"\r\n", b"\n")).digest())
    return digest.hexdigest()
