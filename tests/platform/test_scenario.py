"""Scenario files: every key read in its unit, every mistake named."""

from __future__ import annotations

import numpy as np
import pytest

from piga.errors import PigaError
from piga.platform import load_scenario
from tests.platform.conftest import ARCMIN, ARCSEC, DEG, EXAMPLES

LEAST = '[site]\nlatitude = "40 deg"\n[run]\nduration = "1 h"\n'


def _load(tmp_path, text):
    path = tmp_path / "s.toml"
    path.write_text(text, encoding="utf-8")
    return load_scenario(path)


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("platform-*.toml")), ids=lambda p: p.stem)
def test_every_example_is_read(path):
    assert load_scenario(path).steps > 1000


def test_quantities_are_in_si():
    s = load_scenario(EXAMPLES / "platform-wobble.toml")
    assert s.place.latitude == pytest.approx(40 * DEG)
    assert s.polar_rotation == pytest.approx(2 * np.pi / 480)
    assert s.polar.misalignment == pytest.approx(4 * ARCMIN)
    assert s.polar.harmonics[0].order == 2
    assert s.polar.harmonics[0].amplitude == pytest.approx(0.3 * ARCMIN)
    assert s.equatorial.drift[0] == pytest.approx(0.01 * DEG / 3600)
    assert s.sensors.gimbal_noise == pytest.approx(ARCSEC)
    assert s.steps == 864000


@pytest.mark.parametrize(("text", "turns"), [("none", 0), ("each-turn", 1), ("4 turns", 4)])
def test_reversal_words(tmp_path, text, turns):
    s = _load(tmp_path, LEAST + f'[case_rotation]\nreversal = "{text}"\nequatorial_period = "none"\n')
    assert (s.reversal, s.equatorial_rotation) == (turns, 0.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nonsense", "not valid TOML"),
        ('[site]\nlatitude = "40 deg"\n', "run"),
        (LEAST + "[typo]\n", "typo"),
        (LEAST.replace("40 deg", "40 m"), r"\[site\] latitude"),
        (LEAST.replace("40 deg", "89 deg"), "gimbals lock"),
        (LEAST.replace("1 h", "3 s"), "at least 8"),
        (LEAST.replace("1 h", "-1 h"), r"\[run.duration\]: expected a number > 0"),
        (LEAST.replace("1 h", "1000.5 s"), "whole number"),
        (LEAST + '[case_rotation]\nperiod = "5 s"\n', "fewer than 8 samples"),
        (LEAST + '[case_rotation]\nreversal = "often"\n', "reversal = 'often' is not known"),
        (
            LEAST + '[polar]\nharmonics = [[0, "1 arcmin", "0 deg"]]\n',
            r"\[polar.harmonics\[0\]\[0\]\]: expected a whole number >= 1",
        ),
        (
            LEAST + '[polar]\nharmonics = [[1, "1 arcmin", "0 m"]]\n',
            r"\[polar\] harmonics\[0\]\[2\]: (?s:.*)'0 m'",
        ),
        (
            LEAST + '[motion]\nroll_sway = ["1 deg", "0 s"]\n',
            r"\[motion.roll_sway\[1\]\]: expected a number > 0",
        ),
        (LEAST + '[motion]\nnorth_sway = ["1 deg", "9 s"]\n', r"\[motion\] north_sway\[0\]: (?s:.*)'1 deg'"),
        (LEAST + '[sensors.piga]\nbeta = "1 m"\n', r"\[sensors.piga\] beta: (?s:.*)'1 m'"),
        (LEAST + "[sensors]\ngimbal_noise = true\n", r"\[sensors.gimbal_noise\]: expected a number"),
        (LEAST + '[equatorial]\ndrift = ["1 deg/h"]\n', r"\[equatorial.drift\]: expected"),
        (LEAST + '[motion]\nkind = "track"\n', "needs a file"),
        (LEAST + '[motion]\nkind = "sway"\n[compensation]\nattitude = "aligned"\n', "static base"),
        (LEAST + "[compensation]\nmodels = []\n", "models is empty"),
        (LEAST + '[compensation]\nmodels = ["D"]\n', "models"),
    ],
)
def test_mistakes_are_named(tmp_path, text, message):
    with pytest.raises(PigaError, match=message) as caught:
        _load(tmp_path, text)
    assert "s.toml" in str(caught.value)
