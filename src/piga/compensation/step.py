"""One step of compensation: state in, chunk in; state out, result out. Batch is a loop over it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga._kernels.compensation import layout as at
from piga._kernels.compensation.record import Rows, Samples, Settings, compensate_record
from piga.compensation.model import Model
from piga.records.time_base import begins_stretch

Array = NDArray[np.float64]

NONE = np.zeros(0)
NO_RATES = np.zeros((0, 3))
NO_MARKS = np.zeros(0, dtype=np.bool_)
NO_FLAGS = np.zeros(0, dtype=np.int32)


@dataclass(frozen=True)
class Chunk:
    """Some samples in SI: ``t`` [s], ``output`` (psi [rad], or rate [rad/s]), ``a_Y``, ``a_Z`` [m/s^2].

    ``begins`` marks samples that begin a stretch; ``base_rate`` (n, 3) [rad/s] and ``temperature`` [K] may
    be empty. ``angle`` is the output angle [rad] beside a recorded rate; empty: it follows from the rate.
    All arrays are contiguous float64.
    """

    t: Array
    output: Array
    a_Y: Array
    a_Z: Array
    begins: NDArray[np.bool_]
    base_rate: Array
    temperature: Array
    angle: Array


@dataclass(frozen=True)
class Step:
    """Result of one chunk: ``ax`` [m/s^2], ``dv`` [m/s], ``u_ax`` [m/s^2] and ``flags`` (empty if unwanted)."""

    ax: Array
    dv: Array
    u_ax: Array
    flags: NDArray[np.int32]


def init_state() -> Array:
    """The state before the first sample."""
    return np.zeros(at.STATE)


def find_begins(state: Array, t: Array) -> NDArray[np.bool_]:
    """Which samples of a stream, at times ``t`` (n,) [s] behind ``state``, begin a stretch.

    Where ``state`` holds no nominal interval yet, the first one forward is taken and kept there.
    """
    steps = np.empty_like(t)
    steps[:1] = t[:1] - state[at.S_TIME] if state[at.S_VALID] else 0.0
    np.subtract(t[1:], t[:-1], out=steps[1:])
    forward = steps[steps > 0.0]
    if state[at.S_NOMINAL] == 0.0 and forward.size:
        state[at.S_NOMINAL] = forward[0]
    return begins_stretch(steps, float(state[at.S_NOMINAL]))


def work_array() -> Array:
    """Scratch memory of the kernels; one per thread."""
    return np.zeros(at.WORK)


def empty_step(n: int, uncertainty: bool, flags: bool) -> Step:
    """Room for ``n`` rows."""
    marks = np.empty(n if flags else 0, dtype=np.int32)
    return Step(np.empty(n), np.empty(n), np.empty(n if uncertainty else 0), marks)


def step(
    model: Model,
    state: Array,
    chunk: Chunk,
    *,
    kind: str = "angle",
    typical_step: float = 1.0,
    uncertainty: bool = True,
    work: Array | None = None,
) -> tuple[Array, Step]:
    """Compensate a chunk.

    Parameters
    ----------
    model:
        The instrument, from :func:`piga.compensation.model.make_model`.
    state:
        From :func:`init_state` or the step before; not changed.
    chunk:
        The samples, of the stretch that the state left, or beginning one.
    kind:
        ``"angle"`` or ``"rate"``.
    typical_step:
        Interval [s] taken for the noise of a rate sample that begins a stretch.
    uncertainty:
        Whether ``u_ax`` is computed.
    work:
        Scratch memory (:func:`work_array`) to be used again; None: its own.

    Returns
    -------
    state, result:
        The state behind the chunk, and one row per sample.
    """
    new = state.copy()
    result = empty_step(chunk.t.size, uncertainty, flags=True)
    run_kernel(model, new, chunk, kind, typical_step, work_array() if work is None else work, result)
    return new, result


def run_kernel(
    model: Model, state: Array, chunk: Chunk, kind: str, typical_step: float, work: Array, result: Step
) -> None:
    """Fill ``result`` and move ``state`` on."""
    rate = chunk.output if kind == "rate" else None
    angle = chunk.angle if chunk.angle.size else None
    compensate_record(
        Samples(chunk.t, chunk.a_Y, chunk.a_Z, chunk.begins, chunk.base_rate, chunk.temperature),
        chunk.output if rate is None else angle,
        rate,
        model.instrument,
        Settings(model.has_terms, model.formula, model.base_flag, typical_step),
        state,
        work,
        Rows(result.ax, result.dv, result.u_ax, result.flags),
    )
