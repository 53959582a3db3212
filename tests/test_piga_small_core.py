"""What works with NumPy and Numba alone, and what the rest says when its packages are not installed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HIDE = """
import sys
class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {"scipy", "pyarrow", "jinja2", "matplotlib"}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Hidden())
import importlib.util
real = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name in {"scipy", "pyarrow"} else real(name, package)
"""

CORE = """
import numpy as np, piga
inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec", alpha0=0.7)
t = np.arange(0.0, 2.0, 0.01)
f = 9.80665 * np.column_stack([1 + 0.1 * np.sin(t), 3 * np.cos(t), 0 * t])
alpha = piga.propagate(inst, t, f)
run = piga.Run.from_arrays(t, alpha, f, scale_factor="0.8884 rad/s/g")
print(piga.regime(inst, 9.8, 0.0, 0.0), piga.closed_form(inst, 1.0, 9.8, 0.0, 0.0)[0], alpha[-1])
"""


def without_lab(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", HIDE + code], capture_output=True, text=True, check=False, env=os.environ
    )


def test_motion_and_records_in_memory_need_the_core_alone():
    done = without_lab(CORE)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("running")


@pytest.mark.parametrize(("name", "package"), [("read_run", "pyarrow"), ("calibrate", "scipy")])
def test_a_name_that_needs_more_says_which_extra(name, package):
    done = without_lab(f"import piga; piga.{name}")
    assert done.returncode == 1
    assert f"needs the package {package}" in done.stderr
    assert "pip install 'piga[lab]'" in done.stderr


def test_a_command_that_needs_more_says_which_extra(tmp_path: Path):
    code = f"import sys; sys.argv = ['piga', 'demo', '--out', {str(tmp_path)!r}]\n"
    done = without_lab(code + "from piga.cli.main import main; main()")
    assert done.returncode == 2
    assert "pip install 'piga[lab]'" in done.stderr
    assert "Traceback" not in done.stderr
