from __future__ import annotations

import pytest

from tests.compensation import test_files_memory


@pytest.fixture(scope="session")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> None:
    """The kernels of ``piga compensate`` stand on disk: compiling takes memory of its own, once."""
    test_files_memory.memory(test_files_memory.written(tmp_path_factory.mktemp("one"), 2000))
