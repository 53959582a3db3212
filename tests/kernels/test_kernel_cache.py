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
    [(ending, damage) for ending in ("nbi", "nbc") for damage in DAMAGE],
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


@pytest.mark.only_compiled
@pytest.mark.parametrize("write", ["index", "data"])
def test_a_full_disk_costs_only_the_compilation(tmp_path: Path, write: str) -> None:
    """Index or data cannot be written: the kernel is used all the same, and nothing half-written stays."""
    (tmp_path / "small.py").write_text(KERNEL)
    full = f"""
import errno
from numba.core.caching import IndexDataCacheFile as Files
real = Files._open_for_write

def refuse(self, path):
    if path.endswith({".nbi" if write == "index" else ".nbc"!r}):
        raise OSError(errno.ENOSPC, "No space left on device")
    return real(self, path)

Files._open_for_write = refuse
"""
    environment = os.environ | {"NUMBA_DISABLE_JIT": "0", "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    for program in (full + PROGRAM, full + PROGRAM, PROGRAM):
        done = subprocess.run(
            [sys.executable, "-c", program, str(tmp_path)],
            capture_output=True, text=True, check=False, env=environment,
        )  # fmt: skip
        assert (done.stdout.strip(), done.stderr) == ("42.0", "")
    assert not list(tmp_path.rglob("*.tmp.*"))


@pytest.mark.only_compiled
@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
def test_no_folder_to_keep_kernels_in(tmp_path: Path) -> None:
    """A package and a home that cannot be written to (a service account): compiled, not kept."""
    (tmp_path / "small.py").write_text(KERNEL)
    (tmp_path / "__pycache__").write_text("in the place of the folder")
    environment = os.environ | {"NUMBA_DISABLE_JIT": "0", "HOME": "/proc/none", "XDG_CACHE_HOME": "/proc/none"}
    environment["NUMBA_CACHE_DIR"] = ""
    environment["PYTHONDONTWRITEBYTECODE"] = "1"
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
    )
    assert (done.stdout.strip(), done.stderr) == ("42.0", "")


@pytest.mark.only_compiled
def test_a_module_that_a_cached_kernel_calls_has_another_name_now(tmp_path: Path) -> None:
    """Code of an older version: the caller is unchanged, the module of what it calls was renamed."""
    helper = "from piga._kernels.jit import inline\n\n@inline\ndef double(x):\n    return 2.0 * x\n"
    caller = "from piga._kernels.jit import kernel\ntry:\n    from first import double\n"
    caller += "except ImportError:\n    from second import double\n"
    caller += "\n@kernel\ndef twice(x):\n    return double(x)\n"
    (tmp_path / "first.py").write_text(helper)
    (tmp_path / "small.py").write_text(caller)
    environment = os.environ | {"NUMBA_DISABLE_JIT": "0", "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    for name in ("first", "second"):
        if name == "second":
            (tmp_path / "first.py").rename(tmp_path / "second.py")
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, str(tmp_path)],
            capture_output=True,
            text=True,
            check=False,
            env=environment,
        )
        assert (done.stdout.strip(), done.stderr) == ("42.0", ""), name


@pytest.mark.only_compiled
def test_a_kept_kernel_is_loaded_without_the_compiler(tmp_path: Path) -> None:
    """A kernel that allocates memory: right again in a new process, in which the parts that only compile are not loaded."""
    kernel = "import numpy as np\nfrom piga._kernels.jit import kernel\n\n@kernel\ndef twice(x):\n"
    kernel += "    held = np.empty(2)\n    held[0] = held[1] = x\n    return held[0] + held[1]\n"
    (tmp_path / "small.py").write_text(kernel)
    environment = os.environ | {"NUMBA_DISABLE_JIT": "0", "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    program = PROGRAM + "print('numba.np.linalg' in sys.modules)\n"
    for loaded in ("True", "False"):
        done = subprocess.run(
            [sys.executable, "-c", program, str(tmp_path)],
            capture_output=True,
            text=True,
            check=False,
            env=environment,
        )
        assert (done.stdout.split(), done.stderr) == (["42.0", loaded], "")
