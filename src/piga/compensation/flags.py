"""Validity flags of compensated rows: bits of the ``flags`` column."""

from __future__ import annotations

from piga._kernels.compensation import layout as at

FLAGS = {
    "no_increment": at.NO_INCREMENT,
    "locked": at.LOCKED,
    "near_critical": at.NEAR_CRITICAL,
    "out_of_range": at.OUT_OF_RANGE,
    "temperature": at.TEMPERATURE,
    "age": at.AGE,
    "coarse": at.COARSE,
    "fault": at.FAULT,
}
"""Bit of each flag by name."""

MEANING = {
    "no_increment": "a stretch begins here: no increment is formed into this row, dv is 0 and not known",
    "locked": "|a_x| < a_t tan(beta): the output stands, a_x is known to the dead zone only",
    "near_critical": "|a_x| below 1.25 a_t tan(beta): next to the dead zone",
    "out_of_range": "specific force outside the calibrated range",
    "temperature": "temperature outside the calibrated range",
    "age": "the calibration is older than allowed",
    "coarse": "the output turned by more than 1 rad since the row before",
    "fault": "the instruments of the set contradict each other",
}
"""Each flag in words."""


def describe(mask: int) -> tuple[str, ...]:
    """Names of the flags set in ``mask``."""
    return tuple(name for name, bit in FLAGS.items() if mask & bit)
