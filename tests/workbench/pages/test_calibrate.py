"""What the form of a calibration asks of the command."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import pytest

import piga
from piga.records.run_file import read_run_file
from piga.workbench.pages.calibrate import _options

RUN = read_run_file(Path(str(files("piga.data").joinpath("tumble-a.toml"))))


def test_only_what_differs_from_the_run_file_is_asked() -> None:
    same = {"method": ["information"], "phases": ["shared"], "phase_source": ["output"], "compare": [""]}
    assert _options(RUN, RUN.model.terms, same) == []
    asked = {"method": ["rate"], "phases": ["per-segment"], "compare": [" scale_factor tan_beta ; k0,k2;"]}
    assert _options(RUN, ("k0",), asked) == [
        "--terms", "k0", "--method", "rate", "--phases", "per-segment", "--compare=scale_factor,tan_beta; k0,k2",
    ]  # fmt: skip


@pytest.mark.parametrize(
    "fields", [{"method": ["--out=/tmp"]}, {"phases": ["x"]}, {"compare": ["k0; nonsense"]}]
)
def test_other_words_are_refused(fields: dict[str, list[str]]) -> None:
    with pytest.raises(piga.PigaError):
        _options(RUN, RUN.model.terms, fields)
