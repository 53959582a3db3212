"""The light beside an answer: green, amber or red, with one reason.

The grades follow :attr:`piga.records.calibration.Calibration.verdict`. This is the only place that makes a light of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from piga.records.calibration import Calibration
from piga.records.calibration.coefficient import TYPE_A_ONLY
from piga.units import G0

OFF_NOMINAL = 0.01
"""Relative difference [1] of K from the nominal value above which a result is not used."""
LARGE_RESIDUAL = 0.01745
"""Root mean square [rad] (one degree) above which residuals that the fit hardly reduced show a wrong model or wrong data."""
REDUCED = 0.7071
"""Ratio [1] of the residuals after and before the fit at which it explains half of their variance."""


@dataclass(frozen=True)
class Light:
    """``grade`` and its words: what to do, the reason, and remarks that are neither."""

    grade: Literal["green", "amber", "red"]
    words: str
    reason: str
    more: tuple[str, ...] = ()

    @property
    def may_keep(self) -> bool:
        """False if the result must not be used."""
        return self.grade != "red"


def light(calibration: Calibration) -> Light:
    """The light of a calibration."""
    verdict = calibration.verdict
    doubts = [
        doubt
        for doubt in verdict.doubts
        if doubt.what != TYPE_A_ONLY and doubt.words not in calibration.remarks
    ]
    notes = tuple(doubt.words for doubt in verdict.doubts if doubt not in doubts)
    values = {one.name: one.value for one in calibration.coefficients}
    nominal = calibration.scale_factor_nominal * G0
    ratio = values.get("scale_factor", nominal) / nominal + values.get("k1", 0.0)
    grave = next((doubt.words for doubt in doubts if doubt.grave), "")
    if abs(ratio - 1.0) > OFF_NOMINAL:
        size = f"{ratio:.3g} times" if abs(ratio - 1.0) > 0.5 else f"{100.0 * (ratio - 1.0):+.2g} % off"
        grave = (
            f"K is {size} its nominal value. Check the nominal value, the units and the counts per revolution."
        )
    before, after = calibration.residual_rms_before, calibration.residual_rms
    if not grave and after > LARGE_RESIDUAL and after > REDUCED * before:
        grave = "The fit leaves more than it explains. The reference and the output do not belong together."
    if grave:
        return Light(
            "red", "Do not use", grave, (*[doubt.words for doubt in doubts if doubt.words != grave], *notes)
        )
    if doubts:
        return Light("amber", "Look first", doubts[0].words, (*[doubt.words for doubt in doubts[1:]], *notes))
    return Light("green", "Good", "Every test that was made holds.", notes)
