"""The cache of compiled kernels after a power cut: damaged files are removed, and the kernels compiled again."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

PROGRAM = """
import sys
sys.path.insert(0, sys.argv[1])
import small
print(small.twice(21.0))
"""
KERNEL = """
from piga._kernels.jit import kernel

@kernel
def twice(x):
    return 2.0 * x
"""
DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "cut": lambda data: data[: len(data) // 2],
    "zeros": lambda data: bytes(len(data)),
    "one bit": lambda data: data[:-9] + bytes([data[-9] ^ 1]) + data[-8:],
    "noise": lambda data: b"\x80\x05garbage",
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Callable[[], tuple[str, str, Path]]:
    folder = tmp_path_factory.mktemp("kernel")
    (folder / "small.py").write_text(KERNEL)
    cache = folder / "cache"
    environment = os.environ | {"NUMBA_DISABLE_JIT": "0", "NUMBA_CACHE_DIR": str(cache)}

    def call() -> tuple[str, str, Path]:
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, str(folder)],
            capture_output=True,
            text=True,
            check=False,
            env=environment,
        )
        return done.stdout.strip(), done.stderr, cache

    call()
    return call


@pytest.mark.only_compiled
@pytest.mark.parametrize(
    ("ending", "damage"),
    [*(("nbi", damage) for damage in DAMAGE if damage != "one bit"), *(("nbc", damage) for damage in DAMAGE)],
)
def test_damaged_cache_files(run: Callable[[], tuple[str, str, Path]], ending: str, damage: str) -> None:
    cache = run()[2]
    (path,) = cache.rglob(f"small.twice*.{ending}")
    sound = path.read_bytes()
    path.write_bytes(DAMAGE[damage](sound))
    answer, err, _ = run()
    assert (answer, err) == ("42.0", "")
    assert path.stat().st_size > 0.5 * len(sound)
    assert run()[0] == "42.0"
