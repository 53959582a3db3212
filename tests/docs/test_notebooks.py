"""A real kernel executes the cells of a how-to; its results show themselves."""

from __future__ import annotations

import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[2]


def notebook(page: Path) -> nbformat.NotebookNode:
    """The cells of a page as a notebook."""
    code = re.findall(r"```\{code-cell\} ipython3\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    made = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in code])
    made.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return made


@pytest.fixture
def kernel_environment(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "src"))
    monkeypatch.setenv("PYDEVD_DISABLE_FILE_VALIDATION", "1")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.long
def test_a_kernel_runs_a_notebook_and_shows_tables_and_figures(tmp_path, kernel_environment):
    made = notebook(ROOT / "docs" / "how-to" / "dividing-head.md")
    NotebookClient(made, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [set(output.get("data", ())) for cell in made.cells for output in cell.outputs]
    assert sum("text/html" in kinds for kinds in shown) >= 1
    assert sum("image/png" in kinds for kinds in shown) == 1
    assert list(Path(tmp_path).iterdir()) == []
