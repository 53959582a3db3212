"""Recompute a record from its stored inputs and compare the numbers."""

from __future__ import annotations

import hashlib
import os
import platform
import tempfile
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Literal

from piga._version import __version__
from piga.errors import StoreError
from piga.ledger.compare import Comparison, compare_calibrations
from piga.ledger.store import Record, Store
from piga.records import Calibration
from piga.results import Result

Verdict = Literal["identical", "within tolerance", "different"]


@dataclass(frozen=True, eq=False, repr=False)
class Reproduced(Result):
    """A recomputed record: verdict, comparison, and changes of software or platform."""

    record: Record
    calibration: Calibration
    comparison: Comparison
    changed: dict[str, tuple[str | None, str | None]]

    @property
    def same_platform(self) -> bool:
        """True if software and platform are those that made the record."""
        return not self.changed

    @property
    def verdict(self) -> Verdict:
        """``identical`` (to the bit), or ``within tolerance``, which is accepted only if software or platform differ."""
        if self.comparison.identical:
            return "identical"
        return "within tolerance" if self.comparison.agrees and not self.same_platform else "different"

    @property
    def reproduced(self) -> bool:
        """True if the record was reproduced."""
        return self.verdict != "different"


def reproduce(store: Store, name: str | int) -> Reproduced:
    """Compute a record again from its own inputs.

    With the same software and platform the numbers must be identical to the bit. Otherwise a relative difference of
    1e-12 times the condition number is allowed (:mod:`piga.ledger.compare`).

    Raises
    ------
    StoreError
        If the record holds no inputs, or is damaged.
    PigaError
        If it can no longer be computed.
    """
    from piga.calibration.calibrate import calibrate
    from piga.stand import read_run

    record = store.record(name)
    if record.file("run") is None or record.file("calibration") is None:
        raise StoreError(f"record {record.id} holds no run or no calibration", remedy="it cannot be recomputed")
    stored = store.calibration(record.id)
    wish = record.document.request
    with tempfile.TemporaryDirectory(prefix="piga-") as folder:
        run = read_run(store.extract(record.id, Path(folder), inputs_only=True))
        recomputed = calibrate(
            run,
            wish.get("terms"),
            wish.get("method"),
            phases=wish.get("phase"),
            phase_source=wish.get("phase_source"),
        )
    then, now = record.document.software, software_identity()
    changed = {key: (then.get(key), now.get(key)) for key in now if then.get(key) != now.get(key)}
    return Reproduced(record, recomputed, compare_calibrations(stored, recomputed), changed)


NUMERIC_ROOMS = ("_kernels", "records", "formats", "reading", "instrument", "stand", "calibration")
"""Packages whose source determines the numbers of a calibration."""


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


def source_digest(rooms: tuple[str, ...] = NUMERIC_ROOMS) -> str:
    """SHA-256 of the Python files of these rooms, in the order of their names. Default: those that determine a calibration."""
    root = Path(str(resources.files("piga")))
    files = [*root.glob("*.py"), *(path for room in rooms for path in (root / room).rglob("*.py"))]
    digest = hashlib.sha256()
    for path in sorted(files, key=lambda path: path.relative_to(root).as_posix()):
        digest.update(f"{path.relative_to(root).as_posix()}\n".encode())
        digest.update(hashlib.sha256(path.read_bytes().replace(b"\r\n", b"\n")).digest())
    return digest.hexdigest()
