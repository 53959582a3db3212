"""The calibration that certificates are made from."""

from tests.reports.conftest import cal

__all__ = ["cal"]
