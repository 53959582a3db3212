"""A live stream: the last minutes of indicated and compensated specific force, and the flags.

The lines come on the standard input of ``piga ui``, in the form that ``piga compensate -`` takes. A thread compensates
each line as it comes.
"""

from __future__ import annotations

import io
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from piga.compensation import FLAGS, Compensator, Phase
from piga.compensation.files.live import answered_lines
from piga.errors import PigaError
from piga.records import Calibration

Array = NDArray[np.float64]

KEPT = 120_000
"""Rows that are kept: 20 minutes at 100 Hz."""


@dataclass(frozen=True)
class Alarm:
    """Rows from ``first`` to ``last`` [s] that carry a flag."""

    flag: str
    first: float
    last: float
    rows: int


class Live:
    """The latest rows of a stream.

    Parameters
    ----------
    calibration:
        Calibration record of the instrument.
    phase:
        Phase of the output zero [rad]; None: that of the calibration.
    """

    def __init__(self, calibration: Path, phase: float | None = None) -> None:
        record = Calibration.from_json(calibration)
        self.serial = record.serial
        self.state, self.message = "waiting", ""
        self.rows = 0
        named = {coefficient.name: coefficient.value_si for coefficient in record.coefficients}
        self._scale_factor = named.get("scale_factor", record.scale_factor_nominal)
        self._stream = Compensator(record, phase=None if phase is None else Phase(phase))
        self._table = np.full((KEPT, 4), np.nan)  # time, indicated, compensated, u_ax
        self._alarms: dict[str, Alarm] = {}
        self._lock = threading.Lock()

    def start(self, source: IO[str]) -> None:
        """Read the stream in a thread until it ends."""
        if isinstance(source, io.TextIOWrapper):
            source.reconfigure(encoding="utf-8-sig", errors="replace")
        threading.Thread(target=self.read, args=(source,), daemon=True).start()

    def read(self, source: IO[str]) -> None:
        """Read the stream until it ends. A wrong line ends it, too. The message is kept."""
        before: tuple[float, float] | None = None
        try:
            for row, answer in answered_lines(source, self._stream):
                t, output = row["t"], row["output"]
                step = t - before[0] if before is not None else 0.0
                indicated = (
                    (output - before[1]) / (step * self._scale_factor) if before and step > 0.0 else np.nan
                )
                before = (t, output)
                self._add(t, indicated, float(answer.ax[0]), float(answer.u_ax[0]), int(answer.flags[0]))
            self.state = "ended"
        except PigaError as error:
            self.state, self.message = "stopped", str(error)

    def _add(self, t: float, indicated: float, ax: float, u_ax: float, flags: int) -> None:
        with self._lock:
            self.state = "receiving"
            at = self.rows % KEPT
            self._table[at] = t, indicated, np.nan if flags & FLAGS["no_increment"] else ax, u_ax
            self.rows += 1
            for name, bit in FLAGS.items():
                if flags & bit and name != "no_increment":
                    before = self._alarms.get(name, Alarm(name, t, t, 0))
                    self._alarms[name] = replace(before, last=t, rows=before.rows + 1)

    def alarms(self) -> list[Alarm]:
        """Flags since the start."""
        with self._lock:
            return list(self._alarms.values())

    def latest(self, seconds: float, width: int) -> Array:
        """The last seconds, thinned to about ``width`` columns of least and largest values.

        Returns
        -------
        Array
            Rows of time, least and largest indicated, least and largest compensated specific force [m/s^2], and the
            largest standard uncertainty; shape (n, 6).
        """
        with self._lock:
            count = min(self.rows, KEPT)
            order = np.arange(self.rows - count, self.rows) % KEPT
            table = self._table[order]
        if not len(table):
            return np.empty((0, 6))
        table = table[table[:, 0] >= table[-1, 0] - seconds]
        block = max(len(table) // max(width, 1), 1)
        starts = np.arange(0, len(table), block)
        least, largest = np.fmin.reduceat(table, starts), np.fmax.reduceat(table, starts)
        return np.column_stack(
            (table[starts, 0], least[:, 1], largest[:, 1], least[:, 2], largest[:, 2], largest[:, 3])
        )
