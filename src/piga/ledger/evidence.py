"""Calibrate and store; recompute a stored record and compare the numbers; compare two records.

Inputs, result and report of a calibration become one record. On an error nothing is stored.
The same software on the same platform must give the same bits. Another platform, or another version of a library, may round
otherwise. Then every coefficient, standard uncertainty and covariance has to agree within :data:`ROUNDING` of its standard
uncertainty.
A record of piga 0.1 or 0.2 was computed by another estimator. Its values have to agree within :data:`_ESTIMATOR` of their standard
uncertainty. The uncertainties are not compared.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import posixpath
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from importlib import resources
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from piga._version import __version__
from piga.errors import CalibrationError, RunFileError, StoreError
from piga.ledger.store import Draft, DraftFile, Record, RecordDocument, check_measured
from piga.output import check_results
from piga.reading.columns import stand_files
from piga.records.calibration import document as record_file
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.coefficient import NO_REFERENCE, Coefficient
from piga.records.run_file import read_run_file
from piga.results import Result
from piga.text_files import read_whole
from piga.units import numbers_are_si

if TYPE_CHECKING:
    from piga.ledger.store.store import Store

ROUNDING = 1e-6
"""Difference allowed where the arithmetic differs, as a share of the standard uncertainty (own choice)."""
_ESTIMATOR = 0.3
"""Difference allowed from the estimator of piga 0.1 and 0.2, as a share of the standard uncertainty (own choice)."""
_OTHER_ESTIMATOR = ("piga 0.1", "piga 0.2")
"""Beginning of the software of calibrations that another estimator made."""

_UNCOMPARED = ("created", "software", "source", "input_sha256")
"""Provenance entries whose bits are not compared: time, software, folder, and inputs, which are compared as facts."""
_RESULT, _PAGE = "results/calibration.json", "results/report.html"
"""Names of the results in a record."""
_MAX_PAGE = 1 << 28
"""Largest page that is kept [bytes]. The page of a calibration has a few MB."""


# -- keep ----------------------------------------------------------------------------------------------


def input_files(run: Path, digests: dict[str, str]) -> tuple[DraftFile, ...]:
    """Run file, data file, and the files of a ``[stand]`` table.

    Names keep their places relative to each other: a data file in ``../data`` moves the run file one folder down. ``digests``
    are those of the inputs as they were read for the calibration; the store refuses others.
    """
    run_file = read_run_file(run)
    names = [run_file.data.file, *stand_files(run_file.stand)]
    for name in names:
        if PurePosixPath(name).is_absolute() or Path(name).is_absolute():
            raise RunFileError(
                f"{run}: '{name}' is an absolute path: the record could not be read elsewhere",
                remedy="name the file relative to the run file",
            )
    plain = [os.path.normpath(name).replace(os.sep, "/") for name in names]
    below = "run/" * max(name.split("/").count("..") for name in plain)

    def kept(role: str, name: str, key: str) -> DraftFile:
        return DraftFile(role, posixpath.normpath(below + name), run.parent / name, digests.get(key, ""))

    stand = (kept("stand", name, name) for name in dict.fromkeys(plain[1:]))
    return (kept("run", run.name, run.name), kept("data", plain[0], Path(plain[0]).name), *stand)


def prepare_run(
    run: Path,
    operator: str,
    reason: str,
    *,
    measured: str | None = None,
    supersedes: str | None = None,
    report: bool = True,
    results: Path | None = None,
) -> Draft:
    """Calibrate a run and prepare its record: inputs, result, and a report that shows the record's name and the head.

    The record is stored by ``store.append(prepare_run(...))``.

    Parameters
    ----------
    run:
        Run file.
    operator, reason:
        Who stores the record, and why.
    measured:
        Time of the test, in ISO form; UTC if no zone is given.
    supersedes:
        Name of the record that this one amends.
    report:
        Create the report, too.
    results:
        Folder that ``piga calibrate`` wrote for this run. Its files are stored unchanged, and nothing is computed.

    Raises
    ------
    PigaError
        If the run cannot be calibrated.
    """
    if measured is not None:
        check_measured(measured)
    if results is None:
        from piga.calibration.calibrate import calibrate
        from piga.stand import read_run

        calibration, software = calibrate(read_run(run)), software_identity()
        files = [DraftFile("calibration", _RESULT, record_file.calibration_to_bytes(calibration))]
    else:
        path, page = results / "calibration.json", results / "report.html"
        raw = read_whole(path, record_file.MOST_BYTES, "a calibration.json", CalibrationError)
        calibration = record_file.calibration_from_bytes(raw, path)
        software = {"piga": calibration.provenance.software.removeprefix("piga ")}
        files = [DraftFile("calibration", _RESULT, raw)]
        if page.is_file():
            html = read_whole(page, _MAX_PAGE, "a report.html", CalibrationError)
            files.append(DraftFile("report", _PAGE, html))
        check_results(results)
    options = {
        "terms": list(calibration.terms),
        "method": calibration.method,
        "phase": calibration.phases,
        "phase_source": calibration.phase_source,
    }
    kept = (*input_files(run, calibration.provenance.input_sha256), *files)
    shown = partial(_report, calibration) if report and results is None else None
    return Draft(calibration.serial, operator, reason, kept, options, software, measured, supersedes, shown)


def _report(calibration: Calibration, record: RecordDocument) -> DraftFile:
    """The report of a record, with its place in the chain."""
    from piga.reports.calibration.page import page as calibration_page
    from piga.reports.render.page import Section, named_values, page_html

    lead = (
        "This report is part of a record that is never changed. The head below vouches for every record before it: "
        "piga records verify --head compares it with the store."
    )
    rows = [
        ("Record", record.id),
        ("Number in the store", str(record.number)),
        ("Store", record.store),
        ("Head before this record", record.after),
        ("Operator", record.operator),
        ("Reason", record.reason),
    ]
    rows += [("Measured", record.measured)] if record.measured else []
    rows += [("Supersedes", record.supersedes)] if record.supersedes else []
    page = calibration_page(calibration)
    section = Section("Record", "record", (lead, named_values("Item", "Value", rows, code=True)))
    footer = f"Record {record.id}, number {record.number}, after head {record.after}. {page.footer}"
    html = page_html(replace(page, sections=(*page.sections, section), footer=footer))
    return DraftFile("report", _PAGE, html.encode())


# -- reproduce -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Comparison:
    """``identical``: every number has the same bits. ``worst``: largest ratio of difference to allowed difference.

    ``differences`` are in words: everything that is neither equal nor within its tolerance.
    """

    identical: bool
    worst: float
    differences: tuple[str, ...]

    @property
    def agrees(self) -> bool:
        """True if everything is equal or within its tolerance."""
        return not self.differences


def compare_calibrations(stored: Calibration, recomputed: Calibration) -> Comparison:
    """Compare two calibrations of the same inputs."""
    former = stored.provenance.software.startswith(_OTHER_ESTIMATOR)
    facts, again = _facts(stored, stored, former), _facts(recomputed, stored, former)
    differences = [
        f"{name}: {fact!r}, recomputed {again[name]!r}" for name, fact in facts.items() if fact != again[name]
    ]
    worst = 0.0
    for name, then, now, allowed in () if differences else _compared(stored, recomputed, former):
        off = 0.0 if then == now else abs(now - then) / allowed if allowed else math.inf
        worst = max(worst, off)
        if not off <= 1.0:
            differences.append(f"{name}: {then!r}, recomputed {now!r}, allowed {allowed:.2g}")
    identical = not differences and _numbers(stored) == _numbers(recomputed)
    return Comparison(identical, worst, tuple(differences))


def _numbers(calibration: Calibration) -> dict[str, Any]:
    """The content of ``calibration.json`` without :data:`_UNCOMPARED`."""
    document = json.loads(json.dumps(record_file.to_document(calibration)))
    for name in _UNCOMPARED:
        document["provenance"].pop(name, None)
        document["provenance"]["options"].pop(name, None)
    return document


def _facts(calibration: Calibration, stored: Calibration, former: bool) -> dict[str, Any]:
    """What rounding cannot change (``former``: nor another estimator), and the digests of the inputs of the ``stored`` one."""
    names = ["serial", "terms", "phases"]
    names += [] if former else ["phase_source", "method", "surplus_observations", "quality"]
    facts: dict[str, Any] = {name: getattr(calibration, name) for name in names}
    facts["coefficients"] = [c.key for c in calibration.coefficients]
    # .sha256 files are not read any more; piga 0.1 stored run and data file only
    inputs = [name for name in stored.provenance.input_sha256 if not name.endswith(".sha256")]
    return facts | {"inputs": {name: calibration.provenance.input_sha256.get(name) for name in inputs}}


def _compared(a: Calibration, b: Calibration, former: bool) -> Iterator[tuple[str, float, float, float]]:
    """Name, both values and allowed difference of each number; of the former estimator the values alone."""
    share = _ESTIMATOR if former else ROUNDING
    for c, d in zip(a.coefficients, b.coefficients, strict=True):
        yield c.key, c.value, _near(c, d), share * c.std
        if not former:
            yield f"u({c.key})", c.std, d.std, share * c.std
    if former:
        return
    std = np.array([c.std for c in a.coefficients])
    allowed = share * np.outer(std, std)
    i, j = np.unravel_index(int(np.argmax(np.abs(a.covariance - b.covariance) - allowed)), allowed.shape)
    name = f"covariance ({a.coefficients[i].key}, {a.coefficients[j].key})"
    yield name, float(a.covariance[i, j]), float(b.covariance[i, j]), float(allowed[i, j])
    for name in ("angle_rms", "angle_random_walk", "residual_rms", "residual_rms_before"):
        yield name, getattr(a, name), getattr(b, name), share * getattr(a, name)


def _near(stored: Coefficient, recomputed: Coefficient) -> float:
    """The recomputed value; a phase within half a turn of the stored one."""
    if stored.name != "phi":
        return recomputed.value
    return stored.value + math.remainder(recomputed.value - stored.value, 2.0 * math.pi)


def difference(store: Store, first: str | int, second: str | int) -> dict[str, Any]:
    """Compare two records: their names, the changes of the coefficients, other facts that differ, and notes.

    The uncertainty ``std`` of a change assumes that the two are independent; ``ratio`` is the change over it. A fact is a pair.
    Software is compared as far as both records name it: one made from results names piga alone.
    """
    a, b = store.record(first), store.record(second)
    then, now = _facts_of(a), _facts_of(b)
    names = (n for n in then | now if not n.startswith("software ") or (n in then and n in now))
    calibrations = {record.id: store.calibration(record.id) for record in (a, b)}
    old, new = ({c.key: c for c in calibrations[record.id].coefficients} for record in (a, b))
    return {
        "first": a.id,
        "second": b.id,
        "coefficients": [_change(key, old.get(key), new.get(key)) for key in old | new],
        "facts": {name: (then.get(name), now.get(name)) for name in names if then.get(name) != now.get(name)},
        "notes": [f"{name}: {NO_REFERENCE}" for name, one in calibrations.items() if one.type_a_only],
    }


def _change(key: str, old: Coefficient | None, new: Coefficient | None) -> dict[str, Any]:
    """The change of one coefficient; without a difference where one of the records lacks it."""
    change = std = None
    if old and new:
        change, std = _near(old, new) - old.value, math.hypot(old.std, new.std)
    return {
        "key": key,
        "unit": (old or new).unit,  # type: ignore[union-attr]
        "first": old and old.value,
        "second": new and new.value,
        "difference": change,
        "std": std,
        "ratio": change / std if change is not None and std else None,
    }


def _facts_of(record: Record) -> dict[str, Any]:
    document = record.document
    facts: dict[str, Any] = {"instrument": document.serial}
    facts |= {"operator": document.operator, "measured": document.measured}
    inputs = (file for file in document.files if file.role not in ("report", "calibration"))
    facts |= {f"file {file.role}": file.sha256 for file in inputs}
    facts |= {f"request {name}": value for name, value in document.request.items()}
    return facts | {f"software {name}": value for name, value in document.software.items()}


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
    def verdict(self) -> Literal["identical", "within tolerance", "different"]:
        """``identical`` (to the bit), or ``within tolerance``, which is accepted only if software or platform differ."""
        if self.comparison.identical:
            return "identical"
        return "within tolerance" if self.comparison.agrees and not self.same_platform else "different"


def reproduce(store: Store, name: str | int) -> Reproduced:
    """Compute a record again from its own inputs.

    With the same software and platform the numbers must be identical to the bit. Otherwise they must agree as
    :mod:`piga.ledger.reproduce` states.

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
    request = record.document.request
    with (
        tempfile.TemporaryDirectory(prefix="piga-") as folder,
        numbers_are_si(stored.provenance.software.startswith(_OTHER_ESTIMATOR)),
    ):
        run = read_run(store.extract(record.id, Path(folder), inputs_only=True))
        recomputed = calibrate(
            run,
            request.get("terms"),
            request.get("method"),
            phases=request.get("phase"),
            phase_source=request.get("phase_source"),
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
