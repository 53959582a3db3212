"""Calibration of a set of accelerometers by the size of gravity alone, in many static attitudes.

>>> from piga.gravity_norm import calibrate_set
>>> calibrate_set.__name__
'calibrate_set'
"""

from piga.gravity_norm.estimate import (
    SetCalibration,
    SetFile,
    SetTerm,
    Spell,
    calibrate_set,
    calibrate_set_file,
    is_set_file,
)

__all__ = [
    "SetCalibration",
    "SetFile",
    "SetTerm",
    "Spell",
    "calibrate_set",
    "calibrate_set_file",
    "is_set_file",
]
