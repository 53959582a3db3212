"""Whole turns: the record at the ends of whole turns of the output, as laboratories take mean rates by hand.

The average over whole turns removes the ripple of the coupling but not its pulling: at the drive ``u`` the mean rate is
``u sqrt(1 - r^2)``, where ``r`` is the ratio of the lock zone to ``u`` (docs/understanding/locking). The ripple of the turn shows
``r``, because the output stays longer where it is slow. So each turn is divided by ``sqrt(1 - r^2)``. The estimator of all other
records then takes the turns. The method does not use the angle within the turns, so its uncertainty is larger.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from piga.calibration.fit import fit_run
from piga.calibration.model.request import make_request
from piga.errors import CalibrationError, IdentifiabilityError
from piga.records.calibration.diagnostics import Event
from piga.records.run import Run
from piga.results import Array

_FULL_TURN = 2.0 * np.pi
_STEADY = 2e-3
"""Largest change of the specific force in a position, relative to its size."""
_PARTS = 32
"""Parts of a turn whose durations give the ripple."""
_LOCKING = 0.85
"""Ratio of the lock zone to the drive above which a position is left out: a small disturbance changes the time of a
turn much there."""
_FEWEST_TURNS = 3
"""Fewest turns beyond one for each position."""
_NO_TURN = "the output does not turn once"


def whole_turns(run: Run) -> Run:
    """The record at the ends of whole turns of every position: calibrate it with terms that do not turn.

    The coupling averages out, and so do harmonics of the output angle. Bad samples are left out first, by the fit of the terms
    in the run file.

    Raises
    ------
    CalibrationError
        If the record holds rates, or there are too few turns.
    """
    if run.kind == "rate":
        raise CalibrationError(
            "whole turns need the angle of the output, and the record holds rates",
            remedy="calibrate it as it is",
        )
    with suppress(CalibrationError, IdentifiabilityError):
        request = make_request(run, method="information", phases="per-segment", phase_source="output")
        run = fit_run(run, request).design.run
    positions: list[tuple[int, slice, Array, float]] = []
    left_out: dict[str, list[str]] = {}
    for index, label in enumerate(run.labels):
        stretch = _longest_stretch(run, index)
        position = _position(run, stretch)
        if isinstance(position, str):
            left_out.setdefault(position, []).append(label)
        else:
            positions.append((index, stretch, *position))
    turns = sum(at.size - 1 for *_, at, _ in positions)
    if turns < len(positions) + _FEWEST_TURNS:
        short = left_out.get(_NO_TURN)
        raise CalibrationError(
            f"the output makes {turns} whole turns in {len(positions)} positions"
            + (f"; not one in {', '.join(short[:6])}" if short else ""),
            remedy="record longer, name the positions in [data] segment, or calibrate the record as it is",
        )
    events = []
    for why, labels in left_out.items():
        named = f"positions {', '.join(labels[:8])}{' ...' * (len(labels) > 8)}"
        events.append(Event("position-left-out", len(labels), None, f"{named}: {why}; left out"))
    quality = replace(run.quality, events=(*run.quality.events, *events))
    model = msgspec.structs.replace(run.model, compare=())
    return replace(_run_of_turns(run, positions), quality=quality, model=model)


def _longest_stretch(run: Run, segment: int) -> slice:
    """The longest part of a segment without a gap."""
    inside = np.flatnonzero(run.segment_index == segment)
    edges = np.union1d(inside[run.begins[inside]], [inside[0], inside[-1] + 1])
    longest = int(np.argmax(np.diff(edges)))
    return slice(int(edges[longest]), int(edges[longest + 1]))


def _position(run: Run, stretch: slice) -> tuple[Array, float] | str:
    """Times [s] of the ends of whole turns and the angle of one turn without pulling [rad]; or why the position is left out."""
    t, output, force = run.t[stretch], run.output[stretch], run.f[stretch]
    x = np.maximum.accumulate(np.abs(output - output[0]))
    count = int(x[-1] / _FULL_TURN)
    if count < 1:
        return _NO_TURN
    if np.ptp(force, axis=0).max() > _STEADY * np.linalg.norm(force, axis=1).max():
        return "the specific force changes while the output turns"
    inner = np.interp(_FULL_TURN / _PARTS * np.arange(_PARTS * count + 1), x, t)
    ratio = ripple(np.diff(inner).reshape(count, _PARTS).mean(axis=0))
    if ratio > _LOCKING:
        return f"the lock zone is above {_LOCKING:g} of the drive"
    sign = float(np.sign(output[-1] - output[0]))
    return inner[::_PARTS], sign * _FULL_TURN / float(np.sqrt(1.0 - ratio**2))


def ripple(times: Array) -> float:
    """Ratio r of the lock zone to the drive from the times in equal parts of a turn.

    The time at the angle x is proportional to ``1/(1 + r sin(x - x0))``. Its first harmonic over its mean is
    ``2 (1 - sqrt(1 - r^2))/r = 2 tan(asin(r)/2)``. The mean over a part of the turn reduces it by a sinc.
    """
    parts = times.size
    wave = np.exp(-1j * _FULL_TURN * (np.arange(parts) + 0.5) / parts)
    size = 2.0 * abs(complex(wave @ times)) / float(times.sum()) / float(np.sinc(1.0 / parts))
    return float(np.sin(2.0 * np.arctan(0.5 * size)))


def _run_of_turns(run: Run, positions: list[tuple[int, slice, Array, float]]) -> Run:
    """An angle log with one sample for each end of a turn; force, base rate and temperature are means over the position."""
    counts = [at.size for *_, at, _ in positions]
    rows = [stretch.start + np.searchsorted(run.t[stretch], at) for _, stretch, at, _ in positions]
    means: dict[str, Any] = {
        name: np.repeat([values[stretch].mean(axis=0) for _, stretch, *_ in positions], counts, axis=0)
        for name in ("f", "base_rate", "temperature", "vibration")
        if (values := getattr(run, name)) is not None
    }
    return replace(
        run,
        **means,
        kind="angle",
        resolution=0.0,
        t=np.concatenate([at for *_, at, _ in positions]),
        output=np.concatenate([turn * np.arange(at.size) for *_, at, turn in positions]),
        segment_index=np.repeat(np.arange(len(positions), dtype=np.int32), counts),
        labels=tuple(run.labels[index] for index, *_ in positions),
        begins=np.concatenate([np.arange(count) == 0 for count in counts]),
        phase_group=(0,) * len(positions),
        row=run.row[np.minimum(np.concatenate(rows), run.size - 1)],
        left_out=None,
    )
