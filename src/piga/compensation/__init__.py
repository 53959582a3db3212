"""Compensation: specific force and velocity from the output of calibrated instruments."""

from piga.compensation.compensate import compensate
from piga.compensation.flags import FLAGS
from piga.compensation.model import Phase
from piga.compensation.result import Compensated
from piga.compensation.validity import Limits

__all__ = ["FLAGS", "Compensated", "Limits", "Phase", "compensate"]
