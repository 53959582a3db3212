"""Noise of a static record shown: levels, deviations and spectrum on a page, in a terminal and as figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from piga.noise.analysis import NoiseAnalysis, level_unit
from piga.noise.deviations import ONE_SIGMA, AllanDeviation, NoiseLevel, level_variances
from piga.reports.render.figure import Axis, Figure, Plot, Role
from piga.reports.render.numbers import count, pretty_unit, short, shown_output
from piga.reports.render.page import Notice, Page, Section, Table, TableOf, Tile, origin
from piga.units import MICRO_G

NAMES = {
    "quantisation": "quantisation Q",
    "random_walk": "random walk N",
    "bias_instability": "bias instability B",
    "rate_random_walk": "rate random walk K",
    "drift": "drift R",
}
"""Each level in words, with its usual letter."""
_ROLES: dict[str, Role] = {"allan": "after", "modified": "x", "hadamard": "warning"}


def figures(noise: NoiseAnalysis) -> dict[str, Callable[[], Figure]]:
    """The figures by name."""
    return {"deviations": partial(_deviations_figure, noise), "spectrum": partial(_spectrum_figure, noise)}


def _deviations_figure(noise: NoiseAnalysis) -> Figure:
    plot = Plot("deviations", "Deviations of the rate.", height=4.2)
    return draw_deviations(plot, noise.deviations, noise.levels, noise.unit).caption(
        "Overlapping Allan, modified and Hadamard deviation. Every difference counts. The full line is the Allan deviation "
        "of all levels together. Good: it runs in the band."
    )


def draw_deviations(
    plot: Plot, deviations: Sequence[AllanDeviation], levels: Sequence[NoiseLevel], unit: str
) -> Plot:
    """A panel of deviations of a rate with the 68 % band of the first, which is Allan's, and the Allan deviation of levels."""
    one, unit = shown_output(unit)
    allan = deviations[0]
    low = 0.2 * min(float(each.deviation[each.deviation > 0.0].min(initial=np.inf)) for each in deviations)
    limits = (low / one, 3.0 * float(allan.upper.max()) / one) if np.isfinite(low) else None
    plot.panel("log averaging time [s]", Axis("deviation", pretty_unit(unit), log=True, limits=limits))
    plot.band(allan.tau, allan.lower / one, allan.upper / one, "68 % band, Allan")
    for each in deviations:
        plot.marked(each.tau, each.deviation / one, each.kind, _ROLES[each.kind])
    variances = level_variances(allan.tau, levels)
    plot.line(allan.tau, np.sqrt(sum(variances.values())) / one, "all levels", "model")
    for level in levels:
        if level.seen:
            plot.dashed(allan.tau, np.sqrt(variances[level.name]) / one, NAMES[level.name], "reference")
    return plot


def _spectrum_figure(noise: NoiseAnalysis) -> Figure:
    """Root of the spectral density, and that of the levels."""
    one, unit = shown_output(noise.unit)
    spectrum = noise.spectrum
    y = f"log density [{pretty_unit(level_unit('random_walk', unit))}]"
    plot = Plot("spectrum", "Spectrum of the rate.", "log frequency [Hz]", y, height=3.4)
    plot.points(spectrum.frequency, np.sqrt(spectrum.density) / one, "record", "data")
    plot.line(spectrum.frequency, np.sqrt(spectrum.model) / one, "all levels", "model")
    return plot.caption(
        "Root of the two-sided spectral density of the rate, without its drift; white noise lies at the random walk N. "
        "Good: the points scatter around the line. A peak is a wave, a fall at the right end a filter."
    )


def remarks(noise: NoiseAnalysis) -> tuple[str, ...]:
    """What the levels do not say."""
    if noise.spectrum.misfit is None:
        return ()
    low, high, ratio = noise.spectrum.misfit
    words = (
        f"Between {short(low)} and {short(high)} Hz the spectrum is {short(ratio)} times that of the levels: they do not "
        "describe the whole record. Look for a wave, a filter, a change of temperature, or the lines that "
        "counts of a steady output make."
    )
    return (words,)


def _levels_table(noise: NoiseAnalysis) -> Table:
    one, unit = shown_output(noise.unit)
    table = TableOf(noise.levels).text("level", lambda level: NAMES[level.name])
    table.number("value", lambda level: short(level.value / one) if level.seen else "not seen")
    table.number("interval of 95 %", lambda level: _interval(level, one))
    table.text("unit", lambda level: pretty_unit(level_unit(level.name, unit)))
    if noise.scale_factor:
        gravity = noise.scale_factor * MICRO_G
        table.number("as acceleration", lambda level: short(level.value / gravity) if level.seen else "")
        table.number("interval", lambda level: _interval(level, gravity))
        table.text("its unit", lambda level: pretty_unit(level_unit(level.name, "ug")))
    return table.table()


def _interval(level: NoiseLevel, scale: float) -> str:
    if level.name != "drift" and not level.seen:
        return f"at most {short(level.upper / scale)}"
    return f"{short(level.lower / scale)} to {short(level.upper / scale)}"


def page(noise: NoiseAnalysis) -> Page:
    """Levels and figures."""
    lead = (
        "Levels are those of the largest likelihood of the spectrum. An interval ends where the likelihood falls to that of "
        "95 %. A level is not seen where its interval begins at zero."
    )
    notices = [Notice("warning", remark) for remark in remarks(noise)]
    drawn = partial(_deviations_figure, noise)
    stretches = "one stretch" if noise.stretches == 1 else f"{noise.stretches} stretches"
    return Page(
        f"Noise of {noise.source}",
        f"{count(noise.samples)} samples at {1.0 / noise.step:.6g} Hz, {noise.duration:.6g} s in {stretches}.",
        _tiles(noise),
        (
            Section("Levels", "levels", (lead, _levels_table(noise), *notices, drawn)),
            Section("Spectrum", "the-spectrum", (partial(_spectrum_figure, noise),)),
            origin(noise.input_sha256),
        ),
        kicker="piga noise",
    )


def _tiles(noise: NoiseAnalysis) -> tuple[Tile, ...]:
    one, unit = shown_output(noise.unit)
    allan = noise.deviations[0]
    best = int(np.argmin(allan.deviation))
    value, at = short(allan.deviation[best] / one), f"at {short(allan.tau[best])} s"
    levels = (
        Tile(NAMES[level.name], short(level.value / one), pretty_unit(level_unit(level.name, unit)))
        for level in noise.levels
        if level.seen
    )
    return Tile("Smallest Allan deviation", value, pretty_unit(unit), at), *levels


def brief(noise: NoiseAnalysis) -> Page:
    """Levels and remarks for terminal and notebook, and the figure of the deviations."""
    return page(noise).only("levels")


def noise_document(noise: NoiseAnalysis) -> dict[str, Any]:
    """The result as plain data for JSON, in the unit of the rate."""
    names = ("source", "unit", "scale_factor", "samples", "stretches", "input_sha256")
    of_deviation = ("deviation", "lower", "upper", "degrees_of_freedom")
    return {
        **{name: getattr(noise, name) for name in names},
        "step_s": noise.step,
        "duration_s": noise.duration,
        "levels": {
            level.name: {
                "value": level.value if level.seen else None,
                "interval_95": [level.lower, level.upper],
                "unit": level_unit(level.name, noise.unit),
                "seen": level.seen,
            }
            for level in noise.levels
        },
        "deviations": {
            each.kind: {name: getattr(each, name).tolist() for name in of_deviation}
            | {"tau_s": each.tau.tolist(), "probability": ONE_SIGMA}
            for each in noise.deviations
        },
        "spectrum": {
            "frequency_hz": noise.spectrum.frequency.tolist(),
            "density": noise.spectrum.density.tolist(),
            "model": noise.spectrum.model.tolist(),
        },
        "remarks": list(remarks(noise)),
    }
