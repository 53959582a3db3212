"""Stands at the borders of what they can do: wrong plans, other kinds of parts, columns and outputs."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from piga.earth import Site
from piga.errors import ArgumentError, DataError, RunFileError
from piga.instrument.parameters import ErrorModel
from piga.instrument.twin.parameters import PRESETS
from piga.stand import (
    Centrifuge,
    Composite,
    DividingHead,
    LoggedProfile,
    Specimen,
    SpinPlan,
    read_scenario,
    run_scenario,
    sample_stand,
    simulate_test,
)
from piga.stand.imperfections import NONE
from piga.stand.machines.logged import read_profile
from piga.stand.run_reference import _followed
from piga.stand.write_run import coefficients, predicted_angle_error, run_file_text, toml_table, truth_document
from piga.units import G0
from tests.stand.simulated import COUNTS, INST, SCENARIO, written

SITE = Site(math.radians(40.0), gravity=9.80166)
HEAD = DividingHead(SITE, (0.0, 1.0), dwell=4.0, move=2.0)


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
    assert both.spin.resolution == pytest.approx(2 * math.pi / 2.0 / 200.0)


@pytest.mark.parametrize(
    ("rates", "dwell", "words"), [((), 1.0, "none given"), ((1.0,), 0.0, "must be positive")]
)
def test_bad_spins(rates: tuple[float, ...], dwell: float, words: str) -> None:
    with pytest.raises(ArgumentError, match=words):
        SpinPlan(rates, dwell, 1.0)


def test_bad_parts() -> None:
    with pytest.raises(ArgumentError, match="radius"):
        Centrifuge(SITE, 0.0, SpinPlan((1.0,), 1.0, 1.0))
    with pytest.raises(ArgumentError, match="no parts"):
        Composite(())
    with pytest.raises(ArgumentError, match="pause"):
        Composite((HEAD,), pause=0.0)
    with pytest.raises(ArgumentError, match="2 rows of three finite numbers"):
        LoggedProfile(np.array([0.0, 1.0]), np.zeros((2, 3)), np.full((2, 3), np.nan))


def test_times_within_one_part_of_a_composite() -> None:
    stand = Composite((HEAD, replace(HEAD, positions=(2.0,))), pause=5.0)
    early, _ = stand.motion(np.array([1.0]), NONE)
    assert early[0] == pytest.approx(HEAD.motion(np.array([1.0]), NONE)[0][0])


@dataclass(frozen=True)
class Nothing:
    """A stand without a segment."""

    kind = "nothing"
    accepted = ()
    fastest = 1.0

    def segments(self) -> tuple[()]:
        return ()


def test_a_stand_without_segments() -> None:
    with pytest.raises(ArgumentError, match="no segment"):
        sample_stand(Nothing(), 1.0)


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
    with_tide = SCENARIO.split("[stand]")[0] + stand + "[run]\nearth_tide = { start = 2026-11-21T08:00:00Z }\n"
    with pytest.raises(ArgumentError, match="has no site"):
        run_scenario(read_scenario(written(tmp_path, with_tide)))


def test_text_in_a_profile(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("t,x,y,z\n0,one,0,0\n5,two,0,0\n")
    with pytest.raises(DataError, match="column 'x' does not hold numbers"):
        read_profile(path, ("t", "s"), (("x", "y", "z"), "g"))


def test_segments_of_a_log_are_taken_in_order_when_their_names_say_nothing() -> None:
    t = np.array([100.0, 101.0, 200.0, 203.0, 209.0])
    at = _followed(HEAD, None, lambda: ("first", "second")).times(t, np.array([0, 0, 1, 1, 1], dtype=np.int32))
    assert at == pytest.approx([0.0, 1.0, 6.0, 9.0, 10.0])  # no further than the end of the dwell
    log = LoggedProfile(np.array([0.0, 1.0]), np.zeros((2, 3)), np.zeros((2, 3)))
    assert _followed(log, None, tuple).times(t, np.zeros(5, dtype=np.int32)) is t


def test_temperature_table(tmp_path: Path) -> None:
    text = SCENARIO + '[temperature]\nstart = "25 degC"\ndrift = "1 K/h"\nswing = "0.5 K"\nperiod = "2 h"\n'
    result = read_scenario(written(tmp_path, text)).temperature
    assert (result.start, result.swing, result.period) == (298.15, 0.5, 7200.0)
    assert result.drift == pytest.approx(1.0 / 3600.0)


def test_bad_steps_and_harmonics() -> None:
    with pytest.raises(ArgumentError, match="step: 0 s is not positive"):
        simulate_test(HEAD, Specimen(INST), COUNTS, step=0.0)
    huge = Specimen(INST, harmonics={2: (30.0 * G0, 0.0)})
    with pytest.raises(ArgumentError, match="too large to be simulated"):
        simulate_test(HEAD, huge, COUNTS)


def test_first_harmonics_are_told_in_the_zero_of_the_output() -> None:
    """``s1 sin(alpha) + c1 cos(alpha)`` over the angle as read, ``alpha = psi + phase``."""
    model = ErrorModel(s1=2e-5 * G0, c1=-1e-5 * G0)
    test = simulate_test(HEAD, Specimen(INST, error_model=model), COUNTS)
    told = {value.name: value.value for value in coefficients(test)}
    psi, phase = 0.3, test.phases[0]
    assert told["s1"] * math.sin(psi) + told["c1"] * math.cos(psi) == pytest.approx(
        2e-5 * math.sin(psi + phase) - 1e-5 * math.cos(psi + phase), abs=1e-18
    )


@pytest.mark.only_compiled
def test_predicted_error_of_twin_and_quasi_steady_model() -> None:
    specimen = Specimen(INST, twin=PRESETS["example-stiff"])
    assert not predicted_angle_error(simulate_test(HEAD, specimen, COUNTS)).any()
    test = simulate_test(HEAD, specimen, COUNTS, model="twin")
    predicted = predicted_angle_error(test)
    assert predicted.shape == test.log.t.shape
    assert 0.0 < np.abs(predicted).max() < 1e-2


@pytest.mark.parametrize(("output", "unit"), [("angle", "rad"), ("rate", "rad/s")])
def test_run_file_of_an_output_in_rad(tmp_path: Path, output: str, unit: str) -> None:
    path = written(tmp_path, rate=('sample_rate = "10 Hz"', f'sample_rate = "10 Hz"\noutput = "{output}"'))
    scenario = read_scenario(path)
    test = run_scenario(scenario)
    document = tomllib.loads(run_file_text(scenario, test, "run.parquet"))
    assert document["data"]["output"] | {"column": ""} == {"column": "", "kind": output, "unit": unit}
    assert "counts_per_revolution" not in document["instrument"]
    assert "local_error" not in truth_document(scenario, test)["simulation"]


def test_toml_values() -> None:
    values = {"a": True, "b": "°", "c": [1, 2.5], "d": {"e": False}, "f": (1,)}
    assert tomllib.loads(toml_table("x", values))["x"] == values | {"f": [1]}


@pytest.mark.parametrize(
    ("noise", "words"),
    [
        ('flicker = "-1 ug"', r"\[noise\] flicker: -1 ug is negative"),
        ('markov = "1 ug"\nmarkov_time = "-3 s"', r"\[noise\] markov_time: -3 s is negative"),
        ('markov = "1 ug"', r"\[noise\] markov: its correlation time is missing"),
    ],
)
def test_levels_of_coloured_noise_that_cannot_be(tmp_path: Path, noise: str, words: str) -> None:
    """The message names the key of the scenario file in its own unit."""
    with pytest.raises((ArgumentError, RunFileError), match=words):
        read_scenario(written(tmp_path, f"{SCENARIO}\n[noise]\n{noise}\n"))
