"""Checks of arrays handed to :meth:`piga.Run.from_arrays`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError

Array = NDArray[np.float64]


def check_arrays(
    t: Array,
    output: Array,
    f: Array,
    base_rate: Array | None,
    temperature: Array | None,
    segment: NDArray[np.int32],
    kind: str,
) -> None:
    """Refuse arrays that do not fit together, naming argument and first index."""
    if kind not in ("angle", "rate"):
        raise ArgumentError(
            f"kind: '{kind}' is neither 'angle' nor 'rate'", remedy="turn counts into an angle first"
        )
    if t.ndim != 1 or t.size < 2:
        raise ArgumentError(f"t: shape {t.shape}, needs at least two samples in one dimension")
    shapes: dict[str, tuple[NDArray[Any], tuple[int, ...]]]
    shapes = {"output": (output, (t.size,)), "f": (f, (t.size, 3)), "segment": (segment, (t.size,))}
    if base_rate is not None:
        shapes["base_rate"] = (np.asarray(base_rate), (t.size, 3))
    if temperature is not None:
        shapes["temperature"] = (np.asarray(temperature), (t.size,))
    for name, (array, shape) in shapes.items():
        if array.shape != shape:
            raise ArgumentError(f"{name}: shape {array.shape}, but t has {t.size} samples: {shape} is needed")
    arrays: dict[str, NDArray[Any]] = {"t": t} | {name: pair[0] for name, pair in shapes.items()}
    for name, array in arrays.items():
        finite = np.isfinite(array)
        if not finite.all():
            index = int(np.argwhere(~finite)[0][0])
            raise ArgumentError(f"{name}[{index}] is not finite", remedy="leave such samples out")
    step = np.diff(t)
    same = np.diff(segment) == 0
    if (same & (step <= 0.0)).any():
        index = int(np.argmax(same & (step <= 0.0))) + 1
        raise ArgumentError(
            f"t[{index}] = {t[index]!r} does not come after t[{index - 1}]", remedy="sort by time"
        )
