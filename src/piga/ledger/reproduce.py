"""Recompute a record from its stored inputs, and say whether the numbers are the same."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from piga.errors import StoreError
from piga.ledger.compare import Comparison, compare_calibrations
from piga.ledger.store import Record, Store
from piga.ledger.store.software import software_identity
from piga.records import Calibration

Verdict = Literal["identical", "within tolerance", "different"]


@dataclass(frozen=True)
class Reproduced:
    """A record recomputed: verdict, comparison, and what of software or platform is not as it was."""

    record: Record
    calibration: Calibration
    comparison: Comparison
    changed: dict[str, tuple[str | None, str | None]]

    @property
    def same_platform(self) -> bool:
        """True when software and platform are those that made the record."""
        return not self.changed

    @property
    def verdict(self) -> Verdict:
        """``identical`` to the bit; ``within tolerance`` counts only where software or platform differ."""
        if self.comparison.identical:
            return "identical"
        return "within tolerance" if self.comparison.agrees and not self.same_platform else "different"

    @property
    def reproduced(self) -> bool:
        """True when the record stands."""
        return self.verdict != "different"


def reproduce(store: Store, name: str | int) -> Reproduced:
    """Compute a record again from its own inputs.

    The same numbers to the bit are demanded where software and platform are the same, and a relative difference of
    1e-12 times the condition number elsewhere (:mod:`piga.ledger.compare`).

    Raises
    ------
    StoreError
        If the record holds no inputs, or is damaged.
    PigaError
        If it cannot be computed any more.
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
        found = calibrate(
            run,
            wish.get("terms"),
            wish.get("method"),
            phase=wish.get("phase"),
            phase_source=wish.get("phase_source"),
        )
    then, now = record.document.software, software_identity()
    changed = {key: (then.get(key), now.get(key)) for key in now if then.get(key) != now.get(key)}
    return Reproduced(record, found, compare_calibrations(stored, found), changed)
