"""Calibrations asked for in odd ways: sound ones are met, others are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import piga
from piga.calibration.model.request import make_request
from piga.records.terms import term_names
from tests.calibration.made.scenarios_joint import joint_test
from tests.calibration.made.synthetic import TERMS, record
from tests.records.files import lines, read

pytestmark = pytest.mark.interpreted


def short(seed: int, **options: Any) -> piga.Run:
    return record(np.random.default_rng(seed), **({"seconds": 7.0, "rate": 2.0, "count": 4} | options))


@pytest.mark.long
def test_harmonics_without_a_coupling() -> None:
    """Their phase is that of the output zero, not one to be found: nothing turns with an angle that is estimated."""
    run = short(51)
    terms = ["scale_factor", "k0", "k2", "m_Y", "s3", "c3"]
    calibration = piga.calibrate(run, terms)
    assert "phi" not in {c.name for c in calibration.coefficients}
    assert [c.name for c in calibration.coefficients] == terms
    with_coupling = piga.calibrate(run, [*TERMS, "s3", "c3"])
    for name in ("s3", "c3"):
        assert abs(with_coupling[name].value) < 4.5 * with_coupling[name].std


def test_temperatures_of_reference_of_a_joint_calibration() -> None:
    runs, _ = joint_test(np.random.default_rng(54), seconds=5.0, rate=2.0)
    warm = [replace(run, temperature=293.15 + 3.0 * np.sin(run.segment_index)) for run in runs]
    other = replace(warm[1], model=msgspec.structs.replace(warm[1].model, temperature_reference="25 degC"))
    with pytest.raises(piga.CalibrationError, match="different reference temperatures"):
        piga.calibrate([warm[0], other], ["scale_factor", "k0", "k0_T"])


def test_one_text_is_a_list(tmp_path: Path) -> None:
    run = read(tmp_path, lines())
    for text in ("scale_factor,k0", "scale_factor k0", " scale_factor , k0 "):
        assert term_names(text) == ("scale_factor", "k0")
        assert make_request(run, text).terms == ("scale_factor", "k0")
    with pytest.raises(piga.RunFileError, match="unknown term 'k99'"):
        piga.calibrate(run, "scale_factor, k99")
