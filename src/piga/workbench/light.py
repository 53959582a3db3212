"""The light beside an answer: green, amber or red. It shows the verdict of the calibration and nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from piga.records.calibration import Calibration

_LIGHTS: dict[str, tuple[Literal["green", "amber", "red"], str]] = {
    "clear": ("green", "Good"),
    "doubt": ("amber", "Look first"),
    "do not use": ("red", "Do not use"),
}
"""Colour and words of each grade."""


@dataclass(frozen=True)
class Light:
    """``grade`` and its words: what to do, the reason, and the other doubts."""

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
    first, *others = [doubt.words for doubt in verdict.doubts] or [verdict.reason]
    return Light(*_LIGHTS[verdict.grade], first, (*others, *calibration.remarks))
