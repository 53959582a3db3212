"""The page Explore."""

from __future__ import annotations

from piga import Instrument
from piga.workbench.pages.explore import _numbers


def test_a_zone_that_is_empty_has_no_limits() -> None:
    inst = Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec")
    assert dict(_numbers(inst, (9.8, 0.0, 0.0)))["locked zone of a_x"] == "none"
    assert dict(_numbers(inst, (9.8, 9.80665, 0.0)))["locked zone of a_x"] == "\u22124.848 to 4.848 mg"
