"""A data file as read: named columns of numbers, with the file row of each and what was found."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from piga.records.calibration import Event


@dataclass(frozen=True)
class RawTable:
    """Columns as read, before units.

    ``numbers`` maps column name to float64 or int64, all of one length; missing values are NaN.
    ``labels`` maps the segment column to (codes, names). ``first_row`` is the 1-based file row of the
    first data row (a header counts), so that messages can point into the file.
    """

    path: Path
    numbers: dict[str, NDArray[np.float64] | NDArray[np.int64]]
    labels: dict[str, tuple[NDArray[np.int32], tuple[str, ...]]]
    rows: int
    first_row: int = 1
    units: dict[str, str] = field(default_factory=dict)
    events: tuple[Event, ...] = ()
    row_numbers: NDArray[np.int64] | None = None

    def file_rows(self, part: slice) -> NDArray[np.int64]:
        """1-based file rows of some data rows (blank lines are counted, as an editor does)."""
        if self.row_numbers is not None:
            return np.array(self.row_numbers[part])
        return np.arange(self.first_row + part.start, self.first_row + part.stop, dtype=np.int64)


def column_letter(index: int) -> str:
    """Spreadsheet letter of a 0-based column index: 0 is A, 26 is AA."""
    letters = ""
    index += 1
    while index:
        index, rest = divmod(index - 1, 26)
        letters = chr(ord("A") + rest) + letters
    return letters
