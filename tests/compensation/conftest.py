from __future__ import annotations

import pytest

from tests.compensation.files import test_file_to_file_memory


@pytest.fixture(scope="session")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> None:
    """The kernels of ``piga compensate`` stand on disk: compiling takes memory of its own, once."""
    test_file_to_file_memory.memory(test_file_to_file_memory.written(tmp_path_factory.mktemp("one"), 2000))
    test_file_to_file_memory.memory(
        test_file_to_file_memory.written_set(tmp_path_factory.mktemp("set"), 3, 2000)
    )
