"""Terms as one text are the terms as a list; scenario paths may be text."""

from __future__ import annotations

from pathlib import Path

import pytest

import piga
from piga.calibration.model.request import make_request
from piga.platform.model.scenario import load_scenario
from piga.records.terms import term_names
from piga.stand.scenario import read_scenario
from tests.records.files import lines, read

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"


def test_one_text_is_a_list(tmp_path: Path) -> None:
    run = read(tmp_path, lines())
    for text in ("scale_factor,k0", "scale_factor k0", " scale_factor , k0 "):
        assert term_names(text) == ("scale_factor", "k0")
        assert make_request(run, text, None, None, None).terms == ("scale_factor", "k0")
    with pytest.raises(piga.RunFileError, match="unknown term 'k99'"):
        piga.calibrate(run, "scale_factor, k99")


def test_scenario_paths_as_text() -> None:
    assert read_scenario(str(EXAMPLES / "dividing-head.toml")).path == EXAMPLES / "dividing-head.toml"
    assert load_scenario(str(EXAMPLES / "platform-moving.toml")) == load_scenario(
        EXAMPLES / "platform-moving.toml"
    )
