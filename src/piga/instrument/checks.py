"""Checks of arrays from users: one clear message with the index of the fault.

Values are checked for nan and infinity only after a kernel has stopped. So a clean record is read once, and only the
output needs memory of its size.
"""

from __future__ import annotations

from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike

from piga.errors import ArgumentError
from piga.results import Array


def float_array(name: str, values: ArrayLike, shape: tuple[int, ...] | None = None) -> Array:
    """``values`` as contiguous float64, a read-only view if they already are.

    Kernels are compiled for read-only input, so that any array finds the compiled code.

    Raises
    ------
    ArgumentError
        If the values are not numbers or the shape differs; the message names both shapes.
    """
    try:
        array = np.ascontiguousarray(values, dtype=np.float64).reshape(np.shape(values))
    except (TypeError, ValueError) as error:
        raise ArgumentError(
            f"{name}: not an array of numbers ({error})", remedy="give numbers, or an array of them"
        ) from None
    if shape is not None and array.shape != shape:
        raise ArgumentError(
            f"{name}: shape {array.shape} instead of {shape}", remedy="give one row per sample time"
        )
    view = array.view()
    view.flags.writeable = False
    return view


def time_array(name: str, values: ArrayLike, least: int = 1) -> Array:
    """Times as a float64 vector of at least ``least`` entries; order is checked by the kernels.

    Raises
    ------
    ArgumentError
        If there are too few times, or they are not a vector.
    """
    times = float_array(name, values)
    if times.ndim != 1 or times.size < least:
        raise ArgumentError(
            f"{name}: shape {times.shape} instead of (n,) with n >= {least}", remedy="give one time per sample"
        )
    return times


def require_finite(name: str, array: Array) -> None:
    """Refuse a value that is not a finite number.

    Raises
    ------
    ArgumentError
        Naming the value and the first index.
    """
    if np.isfinite(array).all():
        return
    index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
    at = index if len(index) > 1 else index[0]
    raise ArgumentError(
        f"{name}: {array[index]} at index {at} is not a finite number",
        remedy="repair or leave out the samples that are missing",
    )


def require_increasing(name: str, times: Array) -> None:
    """Refuse times that do not increase.

    Raises
    ------
    ArgumentError
        Naming the two times and indices.
    """
    stuck = np.flatnonzero(~(np.diff(times) > 0.0))
    if stuck.size:
        k = int(stuck[0]) + 1
        raise ArgumentError(
            f"{name}: {times[k]} s at index {k} is not after {times[k - 1]} s at index {k - 1}",
            remedy="sort the samples by time and drop repeated ones",
        )


def explain(times: Array, first: int, **inputs: Array) -> NoReturn:
    """Say what made a kernel stop in the block that starts at ``first``.

    Raises
    ------
    ArgumentError
        Always; names argument and index.
    """
    require_finite("t", times)
    require_increasing("t", times)
    for name, array in inputs.items():
        require_finite(name, array)
    raise ArgumentError(
        f"{' or '.join(inputs)}: too large at index {first} or {first + 1}",
        remedy="specific force is in m/s^2, rates in rad/s",
    )
