"""The cache of compiled kernels: what a first run compiles, a warm one does not; damaged files are removed after a power cut."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

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


MOST_IN_CALIBRATE = 36
"""Functions that the first calibration of the shipped record compiles, parts of Numba included: 35."""


MOST_IN_COMPENSATE = 57
"""What the compensation of it compiles besides: 52."""


def start(folder: Path, *words: str) -> subprocess.Popen[str]:
    environment = os.environ | {"NUMBA_DISABLE_JIT": "0", "NUMBA_CACHE_DIR": str(folder / "cache")}
    return subprocess.Popen(
        [sys.executable, "-c", COUNTED, *words], cwd=folder, env=environment, text=True, stdout=subprocess.PIPE
    )


def compiled_by(process: subprocess.Popen[str]) -> list[str]:
    out, _ = process.communicate()
    assert process.returncode == 0
    names: list[str] = json.loads(out.rsplit("COMPILED", 1)[1])
    return names


@pytest.mark.only_compiled
def test_first_run_compiles_each_kernel_once(tmp_path: Path) -> None:
    from piga.data import copy_example

    run = str(copy_example(tmp_path))
    both = [start(tmp_path, "calibrate", run, "--out", str(tmp_path / name)) for name in "ab"]
    compiled = [name for process in both for name in compiled_by(process)]
    ours = [name for name in compiled if name.startswith("piga.")]
    assert len(ours) == len(set(ours)) > 10
    assert len(compiled) <= MOST_IN_CALIBRATE

    more = compiled_by(start(tmp_path, "demo", "--out", str(tmp_path / "demo")))
    assert not set(more) & set(ours)  # kept from the calibration
    assert more.count("piga._kernels.compensation.record.compensate_record") == 1
    assert len(more) <= MOST_IN_COMPENSATE
    assert compiled_by(start(tmp_path, "demo", "--out", str(tmp_path / "again"))) == []


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


def call(folder: Path, program: str = PROGRAM, **variables: str) -> tuple[str, str]:
    """Output and messages of a process that uses the kernels of ``folder``; they are kept in its folder ``cache``."""
    environment = os.environ | {"NUMBA_DISABLE_JIT": "0", "NUMBA_CACHE_DIR": str(folder / "cache")} | variables
    done = subprocess.run(
        [sys.executable, "-c", program, str(folder)],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
    )
    return done.stdout.strip(), done.stderr


@pytest.mark.only_compiled
def test_damaged_cache_files(tmp_path: Path) -> None:
    """A kernel for each damage of index and data, since a process costs much more than a kernel."""
    damaged = [(ending, damage) for ending in ("nbi", "nbc") for damage in DAMAGE]
    kernels = [f"@kernel\ndef twice_{k}(x):\n    return 2.0 * x\n" for k in range(len(damaged))]
    (tmp_path / "small.py").write_text("\n".join(["from piga._kernels.jit import kernel\n", *kernels]))
    answers = "\n".join(f"print({k}, small.twice_{k}(21.0))" for k in range(len(damaged)))
    program = PROGRAM.replace("print(small.twice(21.0))", answers)
    right = ("\n".join(f"{k} 42.0" for k in range(len(damaged))), "")
    assert call(tmp_path, program) == right
    sizes = {}
    for k, (ending, damage) in enumerate(damaged):
        (path,) = tmp_path.rglob(f"small.twice_{k}-*.{ending}")
        sound = path.read_bytes()
        path.write_bytes(DAMAGE[damage](sound))
        assert path.read_bytes() != sound
        sizes[path] = len(sound)
    assert call(tmp_path, program) == right
    for path, size in sizes.items():
        assert path.stat().st_size > 0.5 * size, path
    assert call(tmp_path, program) == right


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
    for program in (full + PROGRAM, full + PROGRAM, PROGRAM):
        assert call(tmp_path, program) == ("42.0", "")
    assert not list(tmp_path.rglob("*.tmp.*"))


@pytest.mark.only_compiled
@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
def test_no_folder_to_keep_kernels_in(tmp_path: Path) -> None:
    """A package and a home that cannot be written to (a service account): compiled, not kept."""
    (tmp_path / "small.py").write_text(KERNEL)
    (tmp_path / "__pycache__").write_text("in the place of the folder")
    homes = {"HOME": "/proc/none", "XDG_CACHE_HOME": "/proc/none", "NUMBA_CACHE_DIR": ""}
    assert call(tmp_path, **homes, PYTHONDONTWRITEBYTECODE="1") == ("42.0", "")


@pytest.mark.only_compiled
def test_a_module_that_a_cached_kernel_calls_has_another_name_now(tmp_path: Path) -> None:
    """Code of an older version: the caller is unchanged, the module of what it calls was renamed."""
    helper = "from piga._kernels.jit import inline\n\n@inline\ndef double(x):\n    return 2.0 * x\n"
    caller = "from piga._kernels.jit import kernel\ntry:\n    from first import double\n"
    caller += "except ImportError:\n    from second import double\n"
    caller += "\n@kernel\ndef twice(x):\n    return double(x)\n"
    (tmp_path / "first.py").write_text(helper)
    (tmp_path / "small.py").write_text(caller)
    for name in ("first", "second"):
        if name == "second":
            (tmp_path / "first.py").rename(tmp_path / "second.py")
        assert call(tmp_path) == ("42.0", ""), name


@pytest.mark.only_compiled
def test_a_kept_kernel_is_loaded_without_the_compiler(tmp_path: Path) -> None:
    """A kernel that allocates memory: right again in a new process, in which the parts that only compile are not loaded."""
    kernel = "import numpy as np\nfrom piga._kernels.jit import kernel\n\n@kernel\ndef twice(x):\n"
    kernel += "    held = np.empty(2)\n    held[0] = held[1] = x\n    return held[0] + held[1]\n"
    (tmp_path / "small.py").write_text(kernel)
    program = PROGRAM + "print('numba.np.linalg' in sys.modules)\n"
    for loaded in ("True", "False"):
        assert call(tmp_path, program) == (f"42.0\n{loaded}", "")


SCRIPT = """
import numpy as np, piga
from piga.instrument import *
inst = Instrument(0.09, 0.005, 0.3)
t, f = np.arange(5.0), np.ones((5, 3))
frozen = f.copy(); frozen.flags.writeable = False
propagate(inst, t, f); propagate(inst, t, frozen); propagate(inst, t, np.asfortranarray(f))
propagate_rate(inst, t, f)
propagate(inst, t, f, f, with_rate=True, error_model=ErrorModel(k0=1e-3))
propagate_increments(inst, t, f[1:])
propagate_segments(inst, t, f); propagate_fleet([inst, inst], t, f)
sensitivities(inst, t, f); closed_form(inst, t, 1, 2, 3)
propagate_function(inst, t, lambda s: (1.0, 2.0, s))
big = np.arange(40000.0) * 1e-3; propagate(inst, big, np.ones((40000, 3)))
from numba.core.dispatcher import Dispatcher
import piga._kernels as room, pkgutil, importlib
compiled = hits = 0
for module in pkgutil.walk_packages(room.__path__, room.__name__ + "."):
    for thing in vars(importlib.import_module(module.name)).values():
        if isinstance(thing, Dispatcher) and thing.py_func.__module__ == module.name:
            compiled += sum(thing.stats.cache_misses.values()); hits += sum(thing.stats.cache_hits.values())
print(compiled, hits)
"""


@pytest.mark.compiled
@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="nothing is compiled")
def test_a_warm_cache_compiles_nothing():
    """In the cache of the other tests, so that little is compiled here. A cold one is tested above."""
    for _ in range(2):
        run = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
        compiled, hits = map(int, run.stdout.split())
        if not compiled:
            break
    assert compiled == 0
    assert hits > 0
