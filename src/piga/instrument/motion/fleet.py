"""Many motions at once: instruments, inputs, or pairs of them, over all cores."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.errors import ArgumentError
from piga.instrument.checks import float_array, time_array
from piga.instrument.motion.sampled_motion import run_samples, sampled_input
from piga.instrument.parameters import Instrument

Array = NDArray[np.float64]
_NO_OUTPUT = np.empty(0)


def available_cores() -> int:
    """Number of cores this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1


def propagate_fleet(
    instruments: Instrument | Sequence[Instrument],
    t: ArrayLike,
    f: ArrayLike,
    base_rate: ArrayLike | None = None,
    *,
    output: str = "angle",
    workers: int | None = None,
) -> Array:
    """Angle or rate of many motions over the same times: the batch form of :func:`piga.propagate`.

    Many instruments under one input, one instrument under many inputs, or instruments and inputs in
    pairs. Row i is what :func:`piga.propagate` gives for motion i, to the bit, whatever ``workers``.

    Parameters
    ----------
    instruments:
        m instruments, or one for all inputs.
    t:
        Sample times [s], shape (n,), increasing; common to all.
    f:
        Specific force [m/s^2], base axes: shape (n, 3) for one input, (m, n, 3) for many.
    base_rate:
        Inertial rate of the base [rad/s], base axes: shape (3,), (n, 3) or (m, n, 3).
    output:
        ``"angle"`` [rad] or ``"rate"`` [rad/s].
    workers:
        Threads; None: one per core.

    Returns
    -------
    result:
        Shape (m, n).

    Raises
    ------
    ArgumentError
        If the numbers of instruments and inputs differ, a shape does not fit, a value is not finite,
        or times do not increase; names the motion and the index.
    """
    if output not in ("angle", "rate"):
        raise ArgumentError(f"output: {output!r} is not 'angle' or 'rate'")
    times = time_array("t", t)
    force = float_array("f", f)
    omega = None if base_rate is None else float_array("base_rate", base_rate)
    fleet = [instruments] if isinstance(instruments, Instrument) else list(instruments)
    counts = {"instruments": len(fleet)} if not isinstance(instruments, Instrument) else {}
    counts |= {
        name: len(a) for name, a in (("f", force), ("base_rate", omega)) if a is not None and a.ndim == 3
    }
    m = max(counts.values(), default=1)
    if not fleet or any(count != m for count in counts.values()):
        raise ArgumentError(
            f"instruments and inputs do not pair: {counts}",
            remedy="give the same number of each, or one for all",
        )
    result = np.empty((m, times.size))

    def run(i: int) -> None:
        inst = fleet[i if len(fleet) > 1 else 0]
        rates = omega[i] if omega is not None and omega.ndim == 3 else omega
        try:
            record = sampled_input(inst, times, force[i] if force.ndim == 3 else force, rates)
            angle, rate = (result[i], _NO_OUTPUT) if output == "angle" else (_NO_OUTPUT, result[i])
            run_samples(record, inst.alpha0, angle, rate, 1)
        except ArgumentError as error:
            raise ArgumentError(f"motion {i}: {error.message}", remedy=error.remedy) from None
        if output == "angle":
            result[i, 0] = inst.alpha0

    with ThreadPoolExecutor(min(m, workers or available_cores())) as pool:
        for _ in pool.map(run, range(m)):
            pass
    return result
