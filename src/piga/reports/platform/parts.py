"""Parts that the platform pages share: the frame of a page, the table of what was identified."""

from __future__ import annotations

import numpy as np

from piga.platform.identification.identified import UNKNOWN_PHASE, Identification, Parameter
from piga.platform.model.case_rotation import apparent_gyro
from piga.platform.model.scenario import Gyro, Scenario
from piga.reports.render.page import Column, Page, Section, Table, Tile
from piga.units import ARCSEC

_FOOTER = (
    "Simulated with the exact geometry of both nulled pick-offs; compensated with the small-angle matrices."
)


def page(title: str, s: Scenario, tiles: tuple[Tile, ...], sections: tuple[Section, ...]) -> Page:
    """A page with the run in its subtitle."""
    length = f"{s.duration / 86400.0:.4g} d at {s.step:g} s"
    where = f"{np.degrees(s.place.latitude):.3f} deg latitude, {length}, base {s.motion.kind}"
    return Page(title, where, tiles, sections, "piga platform", _FOOTER)


def parameter_table(found: Identification, s: Scenario) -> Table:
    """Identified amplitudes and phases with their uncertainties, beside the truth."""
    truth = _truth_by_name(
        apparent_gyro(s.polar, s.polar_rotation), apparent_gyro(s.equatorial, s.equatorial_rotation)
    )
    rows = [_parameter_row(p, truth.get(p.name)) for p in found.parameters]
    columns = (
        Column("quantity", align="text"),
        Column("value"),
        Column("standard uncertainty"),
        Column("unit", align="text"),
        Column("off truth, in uncertainties"),
    )
    noise = ", ".join(f"{name} {_noise(name, level)}" for name, level in found.noise.items())
    return Table(
        columns,
        tuple(rows),
        notes=(f"Noise found in the residuals: {noise}. Truth includes the circle of case-fixed drift.",),
    )


def _parameter_row(p: Parameter, true: float | None) -> tuple[str, ...]:
    phase = p.name.endswith("phase")
    scale, unit = (ARCSEC, "arcsec") if p.unit == "rad" else (np.radians(1.0) / 3600.0, "deg/h")
    scale, unit = (np.radians(1.0), "deg") if phase else (scale, unit)
    name = p.name.replace(".", " ").replace("harmonic", "harmonic ")
    if phase and p.std > 0.25 * UNKNOWN_PHASE:
        return name, "not determined", "–", unit, "–"
    off = "–"
    if true is not None:
        difference = p.value - true
        difference = float(np.remainder(difference + np.pi, 2.0 * np.pi) - np.pi) if phase else difference
        off = f"{difference / p.std:+.2f}" if p.std > 1e-11 else f"{difference / scale:+.1e}"
    return name, f"{p.value / scale:.5f}", f"{p.std / scale:.2g}", unit, off


def _noise(name: str, level: float) -> str:
    return f"{level:.2g} m/s^2" if name == "force" else f"{level / ARCSEC:.3g} arcsec"


def _truth_by_name(polar: Gyro, equatorial: Gyro) -> dict[str, float]:
    truth = {}
    for name, gyro in (("polar", polar), ("equatorial", equatorial)):
        truth[f"{name}.misalignment"], truth[f"{name}.phase"] = gyro.misalignment, gyro.phase
        for h in gyro.harmonics:
            truth[f"{name}.harmonic{h.order}.amplitude"] = h.amplitude
            truth[f"{name}.harmonic{h.order}.phase"] = h.phase
    return truth
