"""The compensator of a stream: chunks in, compensated chunks out, in bounded memory."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels.compensation import layout as at
from piga.compensation.model import Phase, check_method, make_model
from piga.compensation.result import Compensated, notes_on
from piga.compensation.step import (
    NO_MARKS,
    NO_RATES,
    NONE,
    Chunk,
    empty_step,
    find_begins,
    init_state,
    run_kernel,
    work_array,
)
from piga.compensation.validity import Limits, age_flag
from piga.errors import ArgumentError
from piga.records.calibration import Calibration
from piga.records.limits import LARGEST_SAMPLE
from piga.records.run import Run

Array = NDArray[np.float64]

KEYS = ("t", "output", "f", "base_rate", "temperature", "begins", "angle")


class Compensator:
    """Compensate a stream of one instrument with a transverse reference.

    The result does not depend, to the bit, on how the stream is cut into chunks, and is that of
    :func:`piga.compensate` on the whole record.

    Parameters
    ----------
    calibration:
        The coefficients.
    kind:
        What ``output`` is: ``"angle"`` psi [rad], unwrapped, or ``"rate"`` [rad/s].
    method:
        ``"exact"`` or ``"published"``; None: what the calibration's phase asks for.
    segment, phase:
        Segment whose phase is used (per-segment calibrations), or the phase itself.
    step:
        Nominal interval [s], to tell gaps and for the noise of a rate sample that begins a stretch (nan
        without); None: gaps are told by the median interval of a :class:`piga.Run`, or else by the first interval.
    uncertainty, flags, limits, max_age_days:
        As for :func:`piga.compensate`. ``ax`` and ``dv`` are the same to the bit with and without.
    state:
        State of an earlier compensator, to go on where it stopped.

    Raises
    ------
    CalibrationError
        If the calibration lacks the phase.
    """

    def __init__(
        self,
        calibration: Calibration,
        *,
        kind: str = "angle",
        method: str | None = None,
        segment: str | None = None,
        phase: Phase | None = None,
        step: float | None = None,
        uncertainty: bool = True,
        flags: bool = True,
        limits: Limits | None = None,
        max_age_days: float | None = None,
        state: Array | None = None,
    ) -> None:
        if kind not in ("angle", "rate"):
            raise ArgumentError(
                f"kind: '{kind}' is neither 'angle' nor 'rate'", remedy="turn counts into angle"
            )
        self.method = check_method(method, calibration)
        self.serial, self.notes = calibration.serial, notes_on(calibration)
        self._kind = kind
        self._uncertainty, self._flags = uncertainty, flags
        self._model = make_model(
            calibration, method=self.method, segment=segment, phase=phase,
            limits=limits, flag=age_flag(calibration, max_age_days),
        )  # fmt: skip
        self._state = init_state() if state is None else np.array(state, dtype=float)
        self._typical = np.nan if step is None else step
        if step is not None:
            self._state[at.S_NOMINAL] = step
        self._work = work_array()

    @property
    def state(self) -> Array:
        """A copy of the state: with it another compensator goes on where this one stands."""
        return self._state.copy()

    def push(self, chunk: Mapping[str, ArrayLike] | Run | Chunk) -> Compensated:
        """Compensate the next samples.

        Parameters
        ----------
        chunk:
            A mapping of columns in SI: ``t`` (n,) [s], ``output`` (n,), ``f`` (n, 3) [m/s^2] and, if there are,
            ``base_rate`` (n, 3) [rad/s], ``temperature`` (n,) [K], ``angle`` (n,) [rad] beside a rate,
            ``begins`` (n,); single samples may be plain numbers. Or a :class:`piga.Run` that continues the one
            before, or a checked :class:`Chunk`. Without ``begins``, time that jumps back or leaves a gap
            (more than 1.5 nominal intervals) begins a new stretch, as in :func:`piga.read_run`.

        Raises
        ------
        ArgumentError
            If a column is missing, has another length, or holds a number that is not finite.
        """
        before = self._state.copy()
        samples = chunk if isinstance(chunk, Chunk) else self._samples(self._columns(chunk))
        n = samples.t.size
        result = empty_step(n, self._uncertainty, self._flags)
        if n:
            run_kernel(self._model, self._state, samples, self._kind, self._typical, self._work, result)
            if not math.isfinite(result.dv.sum()):
                self._state = before
                _check_finite(samples)
                raise ArgumentError(
                    "chunk: its numbers are too large to compute with", remedy="check the units"
                )
        return Compensated(
            samples.t, result.ax, result.dv, result.u_ax, result.flags, self.serial, self.method, self.notes
        )  # fmt: skip

    def _columns(self, chunk: Mapping[str, ArrayLike] | Run) -> Mapping[str, Any]:
        """A record brings its stretches; only for its first sample it is asked whether the stream goes on there."""
        if not isinstance(chunk, Run):
            return chunk
        if self._state[at.S_NOMINAL] == 0.0:
            self._state[at.S_NOMINAL] = chunk.median_step
        begins = chunk.begins.copy()
        begins[:1] = find_begins(self._state, chunk.t[:1])
        columns: dict[str, Any] = {"t": chunk.t, "output": chunk.output, "f": chunk.f, "begins": begins}
        columns |= {} if chunk.base_rate is None else {"base_rate": chunk.base_rate}
        return columns | ({} if chunk.temperature is None else {"temperature": chunk.temperature})

    def _samples(self, columns: Mapping[str, Any]) -> Chunk:
        unknown = [name for name in columns if name not in KEYS]
        missing = [name for name in KEYS[:3] if name not in columns]
        if unknown or missing:
            what = f"lacks '{missing[0]}'" if missing else f"has the unknown key '{unknown[0]}'"
            raise ArgumentError(f"chunk: {what}", remedy=f"keys: {', '.join(KEYS)}")
        t = np.atleast_1d(np.asarray(columns["t"], dtype=float))
        n = t.size
        output = _column(columns, "output", n)
        force = _rows(columns, "f", n)
        temperature = _column(columns, "temperature", n) if columns.get("temperature") is not None else NONE
        if self._model.needs_temperature and not temperature.size:
            raise ArgumentError(
                "chunk: no 'temperature' for the calibration's temperature terms", remedy="add it"
            )
        base_rate = _rows(columns, "base_rate", n) if columns.get("base_rate") is not None else NO_RATES
        angle = _column(columns, "angle", n) if columns.get("angle") is not None else NONE
        given = columns.get("begins")
        y, z = np.ascontiguousarray(force[:, 1]), np.ascontiguousarray(force[:, 2])
        _check_finite(Chunk(t, output, y, z, NO_MARKS, base_rate, temperature, angle))
        begins = (
            find_begins(self._state, t) if given is None else np.atleast_1d(np.asarray(given, dtype=np.bool_))
        )
        return Chunk(t, output, y, z, begins, base_rate, temperature, angle)


def _column(columns: Mapping[str, Any], name: str, n: int) -> Array:
    values = np.ascontiguousarray(np.atleast_1d(np.asarray(columns[name], dtype=float)))
    if values.shape != (n,):
        raise ArgumentError(
            f"chunk['{name}']: shape {values.shape} instead of ({n},)", remedy="one value per time"
        )
    return values


def _rows(columns: Mapping[str, Any], name: str, n: int) -> Array:
    values = np.ascontiguousarray(np.atleast_2d(np.asarray(columns[name], dtype=float)))
    if values.shape != (n, 3):
        raise ArgumentError(
            f"chunk['{name}']: shape {values.shape} instead of ({n}, 3)", remedy="one row per time"
        )
    return values


def _check_finite(samples: Chunk) -> None:
    """Name the sample that is no number, or so large that a result would be none."""
    named = {
        "t": samples.t,
        "output": samples.output,
        "f": np.maximum(np.abs(samples.a_Y), np.abs(samples.a_Z)),
    }
    named |= {"base_rate": samples.base_rate, "temperature": samples.temperature, "angle": samples.angle}
    for name, values in named.items():
        if values.size == 0:
            continue
        fits = np.abs(values) <= LARGEST_SAMPLE
        if not fits.all():
            index = int(np.argwhere(~fits)[0][0])
            what = "too large" if np.isfinite(values[index]).all() else "not finite"
            raise ArgumentError(f"chunk['{name}'][{index}] is {what}", remedy="leave such samples out")
