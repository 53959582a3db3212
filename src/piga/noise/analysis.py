"""Noise of a static record, from arrays, from the log of any program, or from a run file."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.errors import ArgumentError, DataError
from piga.formats.columns import no_column
from piga.noise.deviations import (
    ALLAN,
    FEWEST,
    ORDERS,
    SOURCES,
    AllanDeviation,
    NoiseLevel,
    NoiseSpectrum,
    allan_deviation,
    noise_levels,
)
from piga.records.run import examine_time
from piga.records.run_file import DataTable
from piga.results import Array, Plotted, Reported, Result
from piga.text_files import converted
from piga.units import to_si
from piga.upper import doors


@dataclass(frozen=True, eq=False, repr=False)
class NoiseAnalysis(Reported, Plotted, Result):
    """Noise of a static record.

    ``plot()`` shows the deviations with the levels.

    Attributes
    ----------
    source:
        What was analysed: a file, or a name.
    unit:
        Unit of the rate. Deviations are in this unit; a level is in it times a power of the second.
    scale_factor:
        Rate of one m/s^2, with which levels are also shown as accelerations; None if it is not known.
    step, duration:
        Time between samples and sum of the recorded intervals [s].
    samples, stretches:
        Numbers of samples, and of stretches without a gap.
    deviations:
        Allan, modified and Hadamard deviation.
    levels:
        Quantisation, random walk, bias instability, rate random walk, drift.
    spectrum:
        Spectrum of the rate and of the levels.
    """

    source: str
    unit: str
    scale_factor: float | None
    step: float
    duration: float
    samples: int
    stretches: int
    deviations: tuple[AllanDeviation, ...]
    levels: tuple[NoiseLevel, ...]
    spectrum: NoiseSpectrum
    input_sha256: dict[str, str] = field(default_factory=dict)

    def _subject(self) -> ModuleType:
        return doors().shown_noise()


def level_unit(name: str, unit: str) -> str:
    """Unit of a level, for a rate in this unit.

    Examples
    --------
    >>> level_unit("random_walk", "V"), level_unit("quantisation", "arcsec/s"), level_unit("drift", "1")
    ('V/sqrt(Hz)', 'arcsec', '1/s')
    """
    whole = unit.removesuffix("/s")
    plain, of_integral = {
        "quantisation": ("{} s", "{}"),
        "random_walk": ("{}/sqrt(Hz)", "{}/sqrt(s)"),
        "bias_instability": ("{}", "{}/s"),
        "rate_random_walk": ("{}/sqrt(s)", "{}/s^1.5"),
        "drift": ("{}/s", "{}/s^2"),
    }[name]
    return (plain if whole == unit else of_integral).format(whole).removeprefix("1 ")


def analyse_noise(
    values: ArrayLike,
    t: ArrayLike,
    *,
    kind: Literal["rate", "angle"] = "rate",
    unit: str = "1",
    begins: ArrayLike | None = None,
    scale_factor: float | None = None,
    source: str = "a record",
    input_sha256: dict[str, str] | None = None,
) -> NoiseAnalysis:
    """Deviations and levels of the noise of a static record.

    Parameters
    ----------
    values, t:
        Output (n,) and time (n,) [s].
    kind:
        ``"rate"``: each value is the mean of the output over its step, as a voltage. ``"angle"``: a running integral of
        the output, as an angle, a count or a phase.
    unit:
        Unit of the rate: that of the values, for an angle per second. It is shown, not converted.
    begins:
        True where a stretch begins (n,); gaps of the clock also begin one.
    scale_factor, source, input_sha256:
        As in the result.

    Raises
    ------
    ArgumentError
        If the arrays do not fit together, or no stretch has 18 samples.
    """
    values, t = (np.asarray(one, dtype=float).reshape(-1) for one in (values, t))
    marked = np.zeros(t.size, np.bool_) if begins is None else np.asarray(begins, np.bool_)
    if not values.size == t.size == marked.size or not np.isfinite(values).all():
        raise ArgumentError(
            "values, t, begins: differ in length, or a value is not finite", remedy="correct them"
        )
    starts = marked | examine_time(t, np.zeros(t.size, np.int32), np.arange(t.size)).begins
    edges = [*np.flatnonzero(starts).tolist(), t.size]
    longest = max((b - a for a, b in pairwise(edges)), default=0)
    if longest < FEWEST + 2:
        raise ArgumentError(
            f"{source}: the longest stretch without a gap has {longest} samples",
            remedy=f"give at least {FEWEST + 2}; an overnight log has more than ten thousand",
        )
    step = float(np.median(np.diff(t)[~starts[1:]]))
    parts = [slice(a, b) for a, b in pairwise(edges)]
    if kind == "rate":
        rates = [values[part] for part in parts]
        angle, times, starts = _integrated(rates, t, starts, step)
    else:
        rates = [np.diff(values[part] - values[part.start]) / step for part in parts]
        angle, times = values, t
    levels, spectrum = noise_levels(rates, step, source=source)
    seen = {one.name: one.value for one in levels if one.name in SOURCES and one.value > 0.0}
    noise = {ALLAN[name][0]: value**2 * ALLAN[name][1] for name, value in seen.items()}
    return NoiseAnalysis(
        source=source,
        unit=unit,
        scale_factor=scale_factor,
        step=step,
        duration=float(sum(rate.size for rate in rates) * step),
        samples=int(t.size),
        stretches=len(parts),
        deviations=tuple(allan_deviation(angle, times, starts, noise=noise, kind=one) for one in ORDERS),
        levels=levels,
        spectrum=spectrum,
        input_sha256=input_sha256 or {},
    )


def _integrated(
    rates: list[Array], t: Array, starts: NDArray[np.bool_], step: float
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Angle, time and beginnings of mean rates: each stretch has one angle more than rates."""
    first = t[starts]
    angle = np.concatenate([np.append(0.0, np.cumsum(y - y.mean()) * step) for y in rates])
    times = np.concatenate([t0 + step * np.arange(y.size + 1) for t0, y in zip(first, rates, strict=True)])
    begins = np.zeros(angle.size, np.bool_)
    begins[np.cumsum([0, *(y.size + 1 for y in rates[:-1])])] = True
    return angle, times, begins


def read_static_log(
    path: str | Path,
    *,
    column: str | None = None,
    kind: Literal["rate", "angle"] = "rate",
    unit: str | None = None,
    sample_rate: str | None = None,
) -> NoiseAnalysis:
    """Noise of a static log: of a run file, or of one column of a file in any format that piga reads.

    Parameters
    ----------
    path:
        A run file (.toml), which needs no other argument, or a log.
    column, kind, unit:
        Column of the output, what it holds, and the unit of its values. Without ``unit`` that of the file is shown.
    sample_rate:
        With unit, e.g. ``"20 Hz"``, if no column holds the time; a log with a time of another rate is refused.

    Raises
    ------
    ArgumentError
        If an argument does not fit, or the log is too short.
    DataError
        If the file cannot be read.
    """
    from piga.describe import describe_log, draft_run_file
    from piga.reading.columns import read_series
    from piga.stand import read_run

    path = Path(path)
    if path.suffix == ".toml":
        if column or unit or sample_rate:
            raise ArgumentError(f"{path}: the run file states column, unit and time", remedy="leave them out")
        run = read_run(path, need_reference=False)
        return analyse_noise(
            run.output, run.t, kind="rate" if run.kind == "rate" else "angle", unit=run.unit, begins=run.begins,
            scale_factor=run.scale_factor, source=str(path), input_sha256=run.input_sha256,
        )  # fmt: skip
    described = describe_log(path)
    if column is None:
        timed = {one.name for one in described.columns if one.kind in ("time", "date", "segment", "sequence")}
        others = [name for name in described.numbers if name not in timed]
        if len(others) != 1:
            may = ", ".join(others[:20]) or "no column of numbers is left"
            raise DataError(
                f"{path}: the column of the output is not known; it may be: {may}", remedy="name it: --column"
            )
        column = others[0]
    units = {one.name: "" if one.unwritten else one.unit for one in described.columns}
    if column not in units:
        raise no_column(path, column, list(units), remedy="correct --column")
    data = draft_run_file(described, folder=path.parent).document["data"]
    layout = {key: value for key, value in data.items() if key in _LAYOUT}
    if sample_rate is not None and not {"time", "sample_rate"} & layout.keys():
        layout["sample_rate"] = sample_rate
    if not {"time", "sample_rate"} & layout.keys():
        raise DataError(
            f"{path}: no column holds the time", remedy="give the rate of the samples: --sample-rate"
        )
    table = converted(layout | {"output": {"column": column, "kind": "counts"}}, DataTable)
    values, t, digests = read_series(path.parent, table, (column,))
    shown = unit or units[column] or "1"
    unit = f"{shown}/s" if kind == "angle" else shown
    noise = analyse_noise(values, t, kind=kind, unit=unit, source=str(path), input_sha256=digests)
    if sample_rate is not None and abs(noise.step * to_si(sample_rate, "Hz") - 1.0) > _AS_STATED:
        raise ArgumentError(
            f"{path}: --sample-rate {sample_rate}, but the time in the log gives {1.0 / noise.step:.6g} Hz",
            remedy="leave --sample-rate out, or write a run file with [data] sample_rate, which leaves the log's time unread",
        )
    return noise


_AS_STATED = 0.01
"""Largest relative difference of a given rate of the samples from that of the log: rounding of the time."""
_LAYOUT = (
    "file", "time", "sample_rate", "delimiter", "decimal", "encoding", "skip_rows", "header_row", "units_row", "sheet",
    "missing",
)  # fmt: skip
"""Keys of a drafted run file that say how the log is read."""
