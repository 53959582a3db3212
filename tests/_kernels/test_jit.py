"""The cache of compiled kernels: what a first run compiles, a warm one does not, and who may write to it."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

import piga

COUNTED = """
import json, sys
from numba.core.event import Listener, register

compiled = []

class Count(Listener):
    def on_start(self, event):
        function = event.data["dispatcher"].py_func
        compiled.append(f"{function.__module__}.{function.__qualname__}")

    def on_end(self, event):
        pass

register("numba:compile", Count())
from piga.cli.main import main
try:
    main()
except SystemExit as end:
    assert not end.code, end.code
print("COMPILED", json.dumps(compiled))
"""

MOST_COMPILED = 93
"""Functions that the first calibration and compensation of the shipped record compile, parts of Numba included: 87."""


def call(folder: Path, program: str, *words: str, **variables: str) -> tuple[str, str]:
    """Output and messages of a process that runs in ``folder``; its kernels are kept in the folder ``cache`` there."""
    environment = os.environ | {"NUMBA_DISABLE_JIT": "0", "NUMBA_CACHE_DIR": str(folder / "cache")} | variables
    done = subprocess.run(
        [sys.executable, "-c", program, *words],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
        env=environment,
    )
    return done.stdout.strip(), done.stderr


def compiled_by(folder: Path, *words: str) -> list[str]:
    out, messages = call(folder, COUNTED, *words)
    assert "COMPILED" in out, messages
    names: list[str] = json.loads(out.rsplit("COMPILED", 1)[1])
    return names


@pytest.mark.long
def test_first_run_compiles_each_kernel_once(tmp_path: Path) -> None:
    compiled = compiled_by(tmp_path, "demo", "--out", "demo")
    ours = [name for name in compiled if name.startswith("piga.")]
    assert len(ours) == len(set(ours)) > 10
    assert ours.count("piga._kernels.compensation.sample.compensate_record") == 1
    assert len(compiled) <= MOST_COMPILED
    assert compiled_by(tmp_path, "demo", "--out", "again") == []


PROGRAM = "import sys, small; print(small.twice(21.0))\n"
KERNEL = """
from piga._kernels.jit import kernel

@kernel
def twice(x):
    return 2.0 * x
"""


@pytest.mark.long
def test_kernels_are_kept_in_a_folder_of_the_user_alone(tmp_path: Path) -> None:
    """The user's own code keeps its place beside the source."""
    (tmp_path / "small.py").write_text(KERNEL)
    own = PROGRAM + "import numba; print(numba.config.CACHE_DIR == '')\n"
    assert call(tmp_path, own, NUMBA_CACHE_DIR="", XDG_CACHE_HOME=str(tmp_path / "home")) == ("42.0\nTrue", "")
    (folder,) = (tmp_path / "home").iterdir()
    assert folder.name.startswith("piga-kernels-")
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert list(folder.rglob("small.twice*.nbc"))


def test_other_sources_have_another_folder(tmp_path: Path) -> None:
    """Numba takes a cached kernel whose callee changed or is gone."""
    from piga._kernels.jit import cache_folder, sources_digest

    (tmp_path / "inner").mkdir()
    (tmp_path / "outer.py").write_text("a")
    (tmp_path / "inner" / "callee.py").write_text("b")
    digests = {sources_digest(tmp_path)}
    (tmp_path / "inner" / "callee.py").write_text("c")
    digests.add(sources_digest(tmp_path))
    (tmp_path / "inner" / "callee.py").rename(tmp_path / "inner" / "other.py")
    digests.add(sources_digest(tmp_path))
    assert len(digests) == 3
    folder = cache_folder(tmp_path / "home")
    assert folder is not None
    assert folder.name.endswith(sources_digest(Path(piga.__file__).parent / "_kernels"))


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="owners are POSIX")
def test_a_folder_of_another_user_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from piga._kernels.jit import cache_folder

    folder = cache_folder(tmp_path / "home")
    assert folder is not None
    folder.chmod(0o777)
    assert cache_folder(tmp_path / "home") == folder
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    with monkeypatch.context() as patch:
        patch.setattr(os, "getuid", lambda: folder.stat().st_uid + 1)
        assert cache_folder(tmp_path / "home") is None
    folder.rename(tmp_path / "elsewhere")
    folder.symlink_to(tmp_path / "elsewhere")
    assert cache_folder(tmp_path / "home") is None
    folder.unlink()
    folder.write_text("a file in the place of the folder")
    assert cache_folder(tmp_path / "home") is None


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
def test_no_folder_to_keep_kernels_in(tmp_path: Path) -> None:
    """A package and a home that cannot be written to (a service account): compiled, not kept."""
    (tmp_path / "small.py").write_text(KERNEL)
    (tmp_path / "__pycache__").write_text("in the place of the folder")
    homes = {"HOME": "/proc/none", "XDG_CACHE_HOME": "/proc/none", "NUMBA_CACHE_DIR": ""}
    assert call(tmp_path, PROGRAM, **homes, PYTHONDONTWRITEBYTECODE="1") == ("42.0", "")


@pytest.mark.long
def test_a_kept_kernel_is_loaded_without_the_compiler(tmp_path: Path) -> None:
    """A kernel that allocates memory: right again in a new process, in which the parts that only compile are not loaded."""
    kernel = "import numpy as np\nfrom piga._kernels.jit import kernel\n\n@kernel\ndef twice(x):\n"
    kernel += "    held = np.empty(2)\n    held[0] = held[1] = x\n    return held[0] + held[1]\n"
    (tmp_path / "small.py").write_text(kernel)
    program = PROGRAM + "print('numba.np.linalg' in sys.modules)\n"
    for loaded in ("True", "False"):
        assert call(tmp_path, program) == (f"42.0\n{loaded}", "")
