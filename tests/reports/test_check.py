"""The figure of a record: its positions are drawn on the signals, moves are not."""

from __future__ import annotations

import numpy as np

import piga
from piga.reports.check import record_figure
from piga.units import G0

HELD, MOVE = 10.0, 4.0


def record(positions: int) -> piga.Run:
    """Positions of 10 s with moves of 4 s between them that the record leaves out."""
    inside = np.arange(0.0, HELD + 0.25, 0.5)
    t = np.add.outer((HELD + MOVE) * np.arange(positions), inside).ravel()
    segment = np.repeat(np.arange(positions), inside.size)
    f = np.tile([0.5 * G0, 0.5 * G0, 0.0], (t.size, 1)) * (1.0 + segment[:, None])
    labels = [f"at {k}" for k in range(positions)]
    return piga.Run.from_arrays(
        t, 0.4 * t, f, scale_factor="0.8884 rad/s/g", segment=segment, labels=labels, units="SI"
    )


def test_positions_are_areas_and_moves_are_not():
    output, reference = record_figure(record(4)).panels[1:]
    for panel, high in ((output, 0.4 * 52.0 / (2.0 * np.pi)), (reference, 2.0)):
        band, names = panel.series[:2]
        assert band.name == "positions"
        height = np.asarray(band.upper) - np.asarray(band.y)
        x = np.asarray(band.x)
        for at, inside in ((5.0, True), (12.0, False), (19.0, True), (26.0, False), (51.0, True)):
            assert (np.interp(at, x, height) > 0.0) == inside, at
        assert abs(np.asarray(band.upper).max() - high) < 1e-9
        assert names.text == ("at 0", "at 1", "at 2", "at 3")
        assert np.allclose(names.x, [5.0, 19.0, 33.0, 47.0])


def test_a_record_of_one_position_has_no_areas():
    assert all(series.mark != "band" for panel in record_figure(record(1)).panels for series in panel.series)
