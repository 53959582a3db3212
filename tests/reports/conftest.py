import pytest
from example import calibration


@pytest.fixture(scope="session")
def cal():
    return calibration()
