"""What an installation brings: pinned packages under named licences; what works with NumPy and Numba alone."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = SETTINGS["project"]
GROUPS = {
    name: [wish for wish in group if isinstance(wish, str)]
    for name, group in SETTINGS["dependency-groups"].items()
}
EXTRAS: dict[str, list[str]] = {"core": PROJECT["dependencies"]} | PROJECT["optional-dependencies"] | GROUPS


def plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def packages(extra: str) -> set[str]:
    seen = {plain(re.match(r"[A-Za-z0-9._-]+", wish)[0]) for wish in EXTRAS[extra]}  # type: ignore[index]
    return seen - {"piga"}


def pins(file: str) -> dict[str, str]:
    """Entry of each pinned package."""
    blocks = re.split(r"\n(?=\S)", (ROOT / "requirements" / file).read_text())
    return {plain(re.split(r"[\[=]", block)[0]): block for block in blocks if "==" in block.splitlines()[0]}


@pytest.mark.parametrize("extra", list(EXTRAS))
def test_every_package_of_an_extra_is_pinned_with_hashes_and_its_licence_is_named(extra: str) -> None:
    pinned = pins("installer.txt" if extra == "installer" else "all.txt")
    notice = (ROOT / "NOTICE").read_text()
    own = re.search(rf"^{extra} .*?(?=^\S)", notice, flags=re.MULTILINE | re.DOTALL)
    assert own, f"NOTICE has no line for the extra {extra}"
    for name in packages(extra):
        assert "--hash=sha256:" in pinned[name]
        licence = re.search(rf"(?<![\w-]){re.escape(name)} (?:\w+-)?[A-Z]", own[0], flags=re.IGNORECASE)
        assert licence, f"NOTICE names no licence of {name}"


def test_every_pin_has_hashes_and_a_named_licence_that_is_not_the_gpl() -> None:
    notice = (ROOT / "NOTICE").read_text()
    assert [name for name, block in pins("all.txt").items() if "--hash=sha256:" not in block] == []
    assert [name for name in pins("demo.txt") if f" {name} " not in notice.lower()] == []
    assert not re.search(r"(?<!L)GPL-[23]", notice)


@pytest.mark.parametrize("file", ["demo.txt", "ui.txt"])
def test_an_exported_file_has_the_versions_and_hashes_of_the_lock(file: str) -> None:
    every, some = pins("all.txt"), pins(file)
    bare = {name: re.sub(r" ; .*", " \\\\", block).strip() for name, block in every.items()}
    for name, block in some.items():
        assert re.sub(r" ; .*", " \\\\", block).strip() == bare[name], "nox -s lock renews them together"


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
run = piga.Run.from_arrays(t, alpha, f, scale_factor="0.8884 rad/s/g", units="SI")
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
