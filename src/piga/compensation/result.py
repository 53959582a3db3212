"""The compensated record: plain arrays with their units, and what was used to make them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from piga.compensation.flags import FLAGS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Compensated:
    """Specific force and velocity increments of one instrument; arrays share their length.

    Attributes
    ----------
    t:
        Time [s].
    ax:
        Specific force along the input axis [m/s^2]: for an angle (or count) record its mean over the interval
        that ends at ``t``, for a rate record its value at ``t``; nan where no increment is formed.
    dv:
        Velocity increment since the row before [m/s]; 0 where no increment is formed.
    u_ax:
        Standard uncertainty of ``ax`` [m/s^2], coefficients and noise; empty when not asked for.
    flags:
        Bits, see :data:`piga.compensation.FLAGS`; empty when not asked for.
    serial, method:
        Instrument, and ``"exact"`` or ``"published"``.
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
        """Running sum of ``dv`` [m/s]; what happened between stretches is not in it."""
        return np.cumsum(self.dv)

    def columns(self) -> dict[str, NDArray]:
        """The columns of the written file, in order."""
        found = {"t": self.t, "ax": self.ax, "dv": self.dv}
        if self.u_ax.size:
            found["u_ax"] = self.u_ax
        return found | ({"flags": self.flags} if self.flags.size == self.size else {})

    def to_parquet(self, path: str | Path) -> None:
        """Write a Parquet file; units and flag names stand in its metadata."""
        from piga.compensation.writers import write_table

        write_table(Path(path), self.columns(), "parquet")

    def to_csv(self, path: str | Path) -> None:
        """Write a CSV file with the units in its header."""
        from piga.compensation.writers import write_table

        write_table(Path(path), self.columns(), "csv")
