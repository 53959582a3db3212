from __future__ import annotations

import pytest

from tests.compensation import test_sets_memory


@pytest.fixture(scope="session")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> None:
    """The kernels of ``piga compensate`` stand on disk: compiling takes memory of its own, once."""
    test_sets_memory.memory(test_sets_memory.written(tmp_path_factory.mktemp("one"), 2000))
