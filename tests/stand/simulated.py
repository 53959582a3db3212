"""An instrument, a stand and a scenario that the tests of simulated runs share."""

import math

import numpy as np

from piga.earth import Site
from piga.instrument import Instrument
from piga.instrument.electronics import Electronics
from piga.stand import (
    DividingHead,
    read_run,
)
from piga.stand.write_run import coefficients, run_file_text, write_data
from tests.instrument.twin_predicted import predicted_rate_error

SITE = Site(math.radians(40.0), gravity=9.80166)
HEAD = DividingHead(SITE, (0.0, 1.0, 2.0, 4.0), dwell=20.0, move=5.0)
INST = Instrument("0.8884 rad/s/g", "74 arcsec", 0.8)
COUNTS = Electronics(sample_rate=10.0, zero=0.5)

SCENARIO = """
[instrument]
serial = "S-1"
scale_factor = "0.8884 rad/s/g"

[truth]
beta = "74 arcsec"
alpha0 = "0.8 rad"
k0 = "3e-4 g"

[electronics]
sample_rate = "10 Hz"
zero = "0.5 rad"

[stand]
kind = "dividing-head"
latitude = "40 deg"
positions = "0:360:60 deg"
dwell = "20 s"
move = "5 s"
"""


def written(tmp_path, text=SCENARIO, **changes):
    for old, new in changes.values():
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "scenario.toml"
    path.write_text(text, encoding="utf-8")
    return path


def truth_of(test):
    return {(v.name, v.segment): v.value for v in coefficients(test)}


def saved(scenario, test, folder):
    write_data(test, folder / "run.parquet")
    (folder / "run.toml").write_text(run_file_text(scenario, test, "run.parquet"), encoding="utf-8")
    return read_run(folder / "run.toml")


def predicted_angle_error(test):
    """Predicted output angle of the twin minus that of the quasi-steady model [rad], at the rows of the log.

    It is the integral of :func:`tests.instrument.twin_predicted.predicted_rate_error` along the test; zero for the
    quasi-steady model. The errors of a calibration of the log are the projection of this angle on its regressors.
    """
    if test.model != "twin":
        return np.zeros(test.log.t.size)
    profile = test.profile
    error = predicted_rate_error(test.specimen.design, profile.t, test.alpha, profile.force, profile.base_rate)
    steps = 0.5 * (error[1:] + error[:-1]) * np.diff(profile.t)
    return np.interp(test.log.t, profile.t, np.concatenate([[0.0], np.cumsum(steps)]))
