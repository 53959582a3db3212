"""Convert a counter, a folded angle or a rate to the output in SI, or raise an error with the reason."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError
from piga.records.calibration import Event
from piga.records.spool import Arrays, spans, steps

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OutputScale:
    """Conversion from a reading to the output.

    ``factor``: SI per unit of the reading. ``span``: range after which the reading folds back, in its own unit
    (None: never). ``keeps_phase``: the span is a whole number of revolutions. ``counts``: the reading is a count.
    """

    factor: float
    span: float | None = None
    keeps_phase: bool = True
    counts: bool = False


@dataclass(frozen=True)
class Reading:
    """A logged output with the data that its checks need.

    ``values`` (n,) are in the unit of the column ``name``. ``rows`` are file rows. ``begins`` marks the first samples of
    stretches. ``largest`` is the largest output step [rad] between samples that the reference allows, nan without a
    reference. ``nominal`` is the nominal step [s].
    """

    path: Path
    name: str
    values: Array
    rows: NDArray[np.int64]
    begins: NDArray[np.bool_]
    largest: float
    nominal: float
    scale: OutputScale

    def output(self, arrays: Arrays) -> tuple[Array, NDArray[np.bool_], list[Event]]:
        """Unwrapped output angle [rad], samples at which the number of turns was lost, and events.

        A folded reading is unwrapped to the nearest turn inside stretches. Between samples it must move by less
        than half its range. The check uses the largest rate that the reference allows.

        Raises
        ------
        DataError
            If the reading is not a whole number, is outside its range, is too fast to unwrap, jumps, or was reset.
        """
        if self.scale.counts:
            self._check_counts()
        if self.scale.span is not None:
            self._check_span(self.scale.span)
        lost = arrays.zeros(self.values.size, np.bool_)
        psi, wraps, jump, resets = self._unwrap(arrays, lost)
        if self.scale.span is None:
            self._check_jump(jump)
        self._check_resets(resets)
        self._check_jump(jump)
        events = [Event("counter-roll-over", wraps, None, "unwrapped")] if wraps else []
        return psi, lost, events

    def _unwrap(
        self, arrays: Arrays, lost: NDArray[np.bool_]
    ) -> tuple[Array, int, tuple[float, int], list[int]]:
        """The output; number of roll-overs; largest step inside a stretch and its place; possible resets of the counter."""
        span, factor = self.scale.span, self.scale.factor
        psi = arrays.empty(self.values.size)
        wraps, turned, start = 0, 0.0, float(self.values[0])
        jump, resets = (0.0, 0), []
        for part in spans(self.values.size):
            inside = ~self.begins[part]
            if span is None:
                psi[part] = self.values[part] * factor
            else:
                step = steps(self.values, part)
                folded = self._folded(part)
                wraps += int(np.count_nonzero((np.abs(step - folded) > 0.5 * span) & inside))
                folded[0] += turned
                turns = np.cumsum(folded)
                turned = float(turns[-1])
                psi[part] = (start + turns) * factor
                if not self.scale.keeps_phase:
                    lost[part] = ~inside
            size = np.abs(steps(psi, part))
            size *= inside
            at = int(np.argmax(size))
            if size[at] > jump[0]:
                jump = float(size[at]), part.start + at
            if self.scale.counts and size[at] > 1.4 * self.largest + 9.0 * factor:
                resets += self._reset_candidates(part)
        lost[0] = False
        return psi, wraps, jump, resets

    def _folded(self, part: slice) -> Array:
        """Change from the sample before, without roll-over."""
        step = steps(self.values, part)
        span = self.scale.span
        return step if span is None else step - span * np.round(step / span)

    def _check_counts(self) -> None:
        for part in spans(self.values.size):
            reading = self.values[part]
            bad = (reading != np.rint(reading)) | (np.abs(reading) >= 2.0**53)
            if bad.any():
                at = int(np.argmax(bad))
                raise DataError(
                    f"{self.path}: row {self.rows[part][at]}, column '{self.name}': {reading[at]!r} is not a whole count",
                    remedy="set kind to 'angle' or 'rate' with its unit",
                )

    def _check_span(self, span: float) -> None:
        low, high, at = np.inf, -np.inf, 0
        fastest = 0.0
        for part in spans(self.values.size):
            reading = self.values[part]
            low = min(low, float(reading.min()))
            top = int(np.argmax(reading))
            if reading[top] > high:
                high, at = float(reading[top]), part.start + top
            if np.isnan(self.largest):
                fastest = max(fastest, float(np.abs(self._folded(part) * ~self.begins[part]).max()))
        if high - low > span:
            raise DataError(
                f"{self.path}: row {self.rows[at]}, column '{self.name}': {high:.17g} lies outside the range of "
                f"{span:.17g}",
                remedy="correct [instrument] counter_bits (or wraps_at)",
            )
        factor = self.scale.factor
        largest = 1.2 * factor * fastest if np.isnan(self.largest) else self.largest
        if largest >= 0.5 * span * factor:
            rate = largest / self.nominal / (0.5 * span * factor)
            raise DataError(
                f"{self.path}: column '{self.name}': between samples the output may move by {largest:.3g} "
                f"rad, more than half of the counter's range ({span * factor:.3g} rad): a roll-over cannot be "
                "recognised",
                remedy=f"sample at {1.2 * rate:.3g} Hz or more, or use a wider counter",
            )

    def _check_jump(self, jump: tuple[float, int]) -> None:
        """Refuse an output with a jump that only a folded counter or a reset can make."""
        size, at = jump
        if size > 10.0 * self.largest + 2.0:
            raise DataError(
                f"{self.path}: row {self.rows[at]}, column '{self.name}': the output jumps by "
                f"{size:.4g} rad in one sample, the reference allows {self.largest:.3g} rad",
                remedy="if the counter wraps, give [instrument] counter_bits (for an angle: wraps_at); "
                "if it was reset, start a new segment there; otherwise check scale_factor and the units",
            )

    def _reset_candidates(self, part: slice) -> list[int]:
        """Rows where a counter jumped to about zero, by more than it can have moved, and continued from there."""
        largest = self.largest / self.scale.factor
        size = np.abs(self._folded(part)) * ~self.begins[part]
        sudden = (size > 1.5 * largest + 10.0) & (np.abs(self.values[part]) <= largest + 2.0)
        return [part.start + at for at in np.flatnonzero(sudden).tolist() if self._stands_out(part.start + at)]

    def _stands_out(self, k: int) -> bool:
        window = slice(max(k - 3, 0), min(k + 4, self.values.size))
        size = np.abs(self._folded(window)) * ~self.begins[window]
        around = np.delete(size, k - window.start)
        return bool(around.size and around.max() < size[k - window.start] / 3.0)

    def _check_resets(self, resets: list[int]) -> None:
        """Refuse a counter that returned to zero inside a stretch without roll-over or motion."""
        if not resets:
            return
        listed = "; ".join(
            f"row {self.rows[k]}, column '{self.name}': the counter goes to {self.values[k]:.17g}, by "
            f"{self._folded(slice(k, k + 1))[0]:+.0f} counts"
            for k in resets[:100]
        )
        raise DataError(
            f"{self.path}: {listed}: it was reset there",
            remedy="start a new segment there (a segment column) and use phases = 'per-segment'; "
            "if it wrapped instead, give [instrument] counter_bits",
        )
