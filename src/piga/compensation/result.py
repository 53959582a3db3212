"""Compensated records of one instrument or of a set: plain arrays with their units."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from piga.compensation.model import FLAGS
from piga.records.calibration import Calibration
from piga.records.coverage import TYPE_A_ONLY

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Compensated:
    """Specific force and velocity increments of one instrument; arrays share their length.

    Attributes
    ----------
    t:
        Time [s].
    ax:
        Specific force along the input axis [m/s^2]. Angle (or count) record: mean over the interval that ends
        at ``t``. Rate record: value at ``t``. nan where no increment is formed.
    dv:
        Velocity increment since the previous row [m/s]; 0 where no increment is formed.
    u_ax:
        Standard uncertainty of ``ax`` [m/s^2] from coefficients and noise; empty if not requested.
    flags:
        Bits, see :data:`piga.compensation.FLAGS`; empty if not requested.
    serial, method:
        Serial number of the instrument, and ``"exact"`` or ``"published"``.
    notes:
        Notes that every display of ``u_ax`` must show, from :func:`notes_on`; files hold them too.
    """

    t: Array
    ax: Array
    dv: Array
    u_ax: Array
    flags: NDArray[np.int32]
    serial: str = ""
    method: str = "exact"
    notes: tuple[str, ...] = field(default=())

    @property
    def size(self) -> int:
        """Number of rows."""
        return int(self.t.size)

    def flagged(self, name: str) -> NDArray[np.bool_]:
        """Rows with the flag ``name`` (see :data:`piga.compensation.FLAGS`)."""
        return (self.flags & FLAGS[name]) != 0

    def velocity(self) -> Array:
        """Running sum of ``dv`` [m/s]; it does not include the time between stretches."""
        return np.cumsum(self.dv)

    def columns(self) -> dict[str, NDArray]:
        """The columns of the written file, in order."""
        found = {"t": self.t, "ax": self.ax, "dv": self.dv}
        if self.u_ax.size:
            found["u_ax"] = self.u_ax
        return found | ({"flags": self.flags} if self.flags.size == self.size else {})

    def to_parquet(self, path: str | Path) -> None:
        """Write a Parquet file; its metadata hold units, flag names and notes."""
        from piga.compensation.writers import write_table

        write_table(Path(path), self.columns(), "parquet", self.notes)

    def to_csv(self, path: str | Path) -> None:
        """Write a CSV file with units in the header. If ``u_ax`` is Type A only, its heading says so."""
        from piga.compensation.writers import write_table

        write_table(Path(path), self.columns(), "csv", self.notes)


def notes_on(*calibrations: Calibration) -> tuple[str, ...]:
    """Notes on the uncertainties from these calibrations. With several calibrations each note names the serial number."""
    alone = [c.serial or f"instrument {n}" for n, c in enumerate(calibrations, 1) if c.type_a_only]
    if not alone:
        return ()
    return (TYPE_A_ONLY if len(calibrations) == 1 else f"{', '.join(alone)}: {TYPE_A_ONLY}",)


@dataclass(frozen=True)
class CompensatedSet:
    """Specific force and velocity increments in the common frame; arrays share their length n.

    ``t`` [s]; ``f`` (n, 3) [m/s^2], ``dv`` (n, 3) [m/s], ``u_f`` (n, 3) [m/s^2] (or (0, 3)). ``residual``
    [m/s^2] is the root of the summed squared misfits of the instruments (0 for three). ``flags`` are those of one
    instrument; a flag is set if it is set for any instrument.
    """

    t: Array
    f: Array
    dv: Array
    u_f: Array
    residual: Array
    flags: NDArray[np.int32]
    misfit: Array = field(default_factory=lambda: np.zeros((0, 0)))
    each: NDArray[np.int32] = field(default_factory=lambda: np.zeros((0, 0), np.int32))

    @property
    def size(self) -> int:
        """Number of rows."""
        return int(self.t.size)

    def flagged(self, name: str) -> NDArray[np.bool_]:
        """Rows with the flag ``name``."""
        return (self.flags & FLAGS[name]) != 0

    def columns(self) -> dict[str, NDArray]:
        """The columns of the written file, in order."""
        found: dict[str, NDArray] = {"t": self.t}
        for prefix, values in (("f", self.f), ("dv", self.dv), ("u_f", self.u_f)):
            if values.shape[0]:
                found |= {prefix + axis: np.ascontiguousarray(values[:, i]) for i, axis in enumerate("xyz")}
        return found | {"residual": self.residual, "flags": self.flags}
