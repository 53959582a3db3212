import pytest

from tests.reports.example import calibration


@pytest.fixture(scope="session")
def cal():
    return calibration()
