"""Scenario files: tables of stands, temperature and noise are read as meant, or refused by name."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from piga.errors import ArgumentError, RunFileError
from piga.stand import (
    read_scenario,
)
from piga.stand.profile import NONE
from piga.units import G0
from tests.stand.simulated import SCENARIO, written


def centrifuge(keys: str) -> str:
    stand = f'[stand]\nkind = "centrifuge"\nlatitude = "40 deg"\ndwell = "4 s"\nramp = "2 s"\n{keys}'
    return SCENARIO.split("[stand]")[0] + stand


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ('radius = "0 m"\nlevels = ["1 g"]', "radius: 0 m is not positive"),
        ('levels = ["1 g"]\nrates = ["1 rad/s"]', "either levels or rates"),
        ("", "either levels or rates"),
        ('levels = ["-1 g"]', "negative"),
        ('rates = ["1 rad/s"]', ""),
    ],
)
def test_centrifuge_tables(tmp_path: Path, keys: str, words: str) -> None:
    path = written(tmp_path, centrifuge(keys))
    if not words:
        assert read_scenario(path).stand.spin.rates == (1.0,)  # up only: one level has no way down
        return
    with pytest.raises(RunFileError, match=words):
        read_scenario(path)


def test_rates_go_up_and_down_unless_told_otherwise(tmp_path: Path) -> None:
    both = read_scenario(written(tmp_path, centrifuge('rates = ["1 rad/s", "2 rad/s"]'))).stand
    up = read_scenario(written(tmp_path, centrifuge('rates = ["1 rad/s", "2 rad/s"]\ndown = false'))).stand
    assert both.spin.rates == (1.0, 2.0, 1.0)
    assert up.spin.rates == (1.0, 2.0)
    assert both.fastest == pytest.approx(2 * math.pi / 2.0 / 200.0)


def test_profile_and_composite_from_a_scenario(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("t,x,y,z\n0,1,0,0\n5,1,0.2,0\n10,1,0,0\n")
    stand = (
        '[stand]\nkind = "composite"\npause = "5 s"\n'
        '[[stand.parts]]\nkind = "dividing-head"\nlatitude = "40 deg"\npositions = ["0 deg", "30 deg"]\ndwell = "4 s"\n'
        'move = "2 s"\n[[stand.parts]]\nkind = "profile"\nfile = "log.csv"\n'
        'time = { column = "t", unit = "s" }\nforce = { columns = ["x", "y", "z"], unit = "g" }\n'
    )
    scenario = read_scenario(written(tmp_path, SCENARIO.split("[stand]")[0] + stand))
    assert scenario.stand.segments()[-1].label == "1.0"
    f, rate = scenario.stand.motion(np.array([20.0]), NONE)
    assert f[0] / G0 == pytest.approx([1.0, 0.2, 0.0])
    assert not rate.any()


@pytest.mark.parametrize(
    ("noise", "words"),
    [
        ('flicker = "-1 ug"', r"\[noise\] flicker: .* is negative"),
        ('markov = "1 ug"\nmarkov_time = "-3 s"', r"\[noise\] markov_time: -3 is negative"),
        ('markov = "1 ug"', r"\[noise\] markov: its correlation time is missing"),
    ],
)
def test_levels_of_coloured_noise_that_cannot_be(tmp_path: Path, noise: str, words: str) -> None:
    """The message names the key of the scenario file."""
    with pytest.raises((ArgumentError, RunFileError), match=words):
        read_scenario(written(tmp_path, f"{SCENARIO}\n[noise]\n{noise}\n"))
