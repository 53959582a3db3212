"""Set calibration by the size of gravity: the truth put in, its intervals, both conventions, what attitudes do not tell."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import piga
from piga.errors import ArgumentError, DataError, IdentifiabilityError, RunFileError
from piga.gravity_norm import calibrate_set_file, is_set_file
from tests.cli.runner import outcome

G = 9.81
STEP = 0.02
LOWER = np.array([[400.0, 0.0, 0.0], [2.0, 410.0, 0.0], [-3.0, 5.0, 420.0]])
"""Sensitivities [count/(m/s^2)]."""
BIAS = np.array([100.0, -250.0, 40.0])


def directions(rng: np.random.Generator, count: int):
    """Directions all over the sphere, in random order."""
    vectors = rng.standard_normal((count, 3))
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


def record(rng: np.random.Generator, attitudes, matrix=LOWER, bias=BIAS, scatter=0.05, noise=2.0, dwell=3.0):
    """Time and outputs: each attitude held for ``dwell`` seconds, and half a second of motion before the next.

    ``scatter`` [count] is that of the bias from spell to spell, ``noise`` [count] white.
    """
    still, moving = int(dwell / STEP), int(0.5 / STEP)
    parts = []
    for direction in attitudes:
        base = matrix @ (G * direction) + bias + scatter * rng.standard_normal(len(bias))
        parts.append(np.tile(base, (still, 1)))
        wave = np.sin(np.linspace(0.0, 9.0, moving))[:, None] * rng.uniform(500.0, 1500.0, len(bias))
        parts.append(base + wave)
    outputs = np.concatenate(parts)
    return STEP * np.arange(len(outputs)), outputs + noise * rng.standard_normal(outputs.shape)


def truth(matrix, bias, lower=True):
    """Terms of a set whose matrix is triangular."""
    scale = np.diag(matrix)
    m = (matrix / scale[:, None])[np.tril_indices(3, -1) if lower else np.triu_indices(3, 1)]
    return np.concatenate((bias, scale, m))


def test_the_truth_is_in_the_intervals():
    """15 records of 30 attitudes: of each term the interval of 95 % holds at least 11 times; of all, 90 to 100 %."""
    rng, held, degrees = np.random.default_rng(41), [], []
    for _ in range(15):
        cal = piga.calibrate_set(*record(rng, directions(rng, 30), scatter=0.3), G, convention="lower")
        assert len(cal.spells) == 30
        off = np.array([term.value for term in cal.terms]) - truth(LOWER, BIAS)
        held.append(np.abs(off) <= [term.expanded for term in cal.terms])
        degrees.append([term.degrees_of_freedom for term in cal.terms])
    assert np.sum(held, axis=0).min() >= 11
    assert 0.90 <= np.mean(held) <= 1.0
    assert 3.0 < np.mean(degrees) < 21.0


def test_conventions_are_the_same_set():
    """Both describe the same ellipsoid: S'S is equal, and each matrix is triangular."""
    rng = np.random.default_rng(42)
    log = record(rng, directions(rng, 30))
    lower, upper = (piga.calibrate_set(*log, G, convention=one) for one in ("lower", "upper"))
    metrics = [np.linalg.inv(cal.matrix @ cal.matrix.T) for cal in (lower, upper)]
    assert metrics[0] == pytest.approx(metrics[1], rel=1e-6, abs=1e-12)
    assert np.triu(lower.matrix, 1) == pytest.approx(0.0)
    assert np.tril(upper.matrix, -1) == pytest.approx(0.0)
    assert lower["scale_factor[3]"].value != pytest.approx(upper["scale_factor[3]"].value, rel=1e-6)
    assert np.linalg.norm(upper.force(log[1][10:100]), axis=1).mean() == pytest.approx(G, rel=1e-3)


def test_a_redundant_set_of_four():
    """A fourth accelerometer along the diagonal: its three sensitivities and its bias."""
    rng = np.random.default_rng(43)
    matrix, bias = np.vstack((LOWER, [230.0, 231.0, 232.0])), np.append(BIAS, 12.0)
    cal = piga.calibrate_set(
        *record(rng, directions(rng, 25), matrix, bias), G, convention="lower", names=tuple("abcd")
    )
    for key, true in zip(("s_X[d]", "s_Y[d]", "s_Z[d]", "bias[d]"), (230.0, 231.0, 232.0, 12.0), strict=True):
        assert abs(cal[key].value - true) < 4.0 * cal[key].std
        assert cal[key].std < 0.5
    assert cal.covariance.shape == (13, 13)


def test_spells_are_the_attitudes():
    """Begin and end of each, half a window inside."""
    rng = np.random.default_rng(44)
    found = piga.calibrate_set(*record(rng, directions(rng, 20)), G).spells
    begins = 3.5 * np.arange(20)
    assert [one.begin for one in found] == pytest.approx(begins + 0.5, abs=0.2)
    assert [one.end for one in found] == pytest.approx(begins + 2.5, abs=0.2)
    assert found[3].samples == pytest.approx(2.0 / STEP, abs=12)


def test_gravity_moves_sensitivities_alone():
    """With another g all scale factors change by its share; its uncertainty is in theirs."""
    rng = np.random.default_rng(45)
    log = record(rng, directions(rng, 20))
    one, other = (piga.calibrate_set(*log, g, gravity_std=1e-3 * g) for g in (G, 1.01 * G))
    assert other["scale_factor[1]"].value * 1.01 == pytest.approx(one["scale_factor[1]"].value, rel=1e-9)
    assert other["bias[2]"].value == pytest.approx(one["bias[2]"].value, abs=1e-5)
    sharp = piga.calibrate_set(*log, G)
    assert one["scale_factor[1]"].std == pytest.approx(
        np.hypot(sharp["scale_factor[1]"].std, 1e-3 * one["scale_factor[1]"].value), rel=1e-6
    )
    assert one["bias[2]"].std == pytest.approx(sharp["bias[2]"].std, rel=1e-9)


def test_attitudes_that_do_not_tell():
    """About one axis only: the terms of the two other axes' tilt are not told; nearly so is refused or remarked by name."""
    rng = np.random.default_rng(46)
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    plane = np.column_stack((np.cos(angles), np.sin(angles), 0.0 * angles))
    for scatter in (0.0, 0.3):
        with pytest.raises(IdentifiabilityError, match="lie in one plane: they cannot tell"):
            piga.calibrate_set(*record(rng, plane, scatter=scatter), G)
    half = directions(rng, 40)
    half[:, 2] = np.abs(half[:, 2]) * 0.2 + 0.9
    half /= np.linalg.norm(half, axis=1)[:, None]
    cal = piga.calibrate_set(*record(rng, half), G)
    assert any("bias[3]" in remark and "scale_factor[3]" in remark for remark in cal.remarks)


def test_one_attitude_that_alone_determines_a_term_is_named():
    rng = np.random.default_rng(47)
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    cone = np.column_stack((np.cos(angles), np.sin(angles), 1e-9 * angles))
    one = np.vstack((cone, [[0.6, 0.0, 0.8], [0.0, 0.6, -0.8], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))
    with pytest.raises(IdentifiabilityError, match="alone determines"):
        piga.calibrate_set(*record(rng, one), G)


def test_too_few_spells_and_wrong_shapes():
    rng = np.random.default_rng(48)
    t, outputs = record(rng, directions(rng, 7))
    with pytest.raises(DataError, match="7 static spells are found, and 9 terms need 10"):
        piga.calibrate_set(t, outputs, G)
    with pytest.raises(ArgumentError, match="3 or more"):
        piga.calibrate_set(t, outputs[:, :2], G)
    with pytest.raises(DataError, match="no noise at rest"):
        piga.calibrate_set(t, np.round(outputs / 1e4), G)


DATA = Path(__file__).parents[1] / "validation" / "data"


def test_the_published_record_of_an_xsens():
    """All nine parameters of imu_tk's published run (38 spells, lower triangle) within 2 u; its offsets, LSB/(m/s^2), skews."""
    digest = hashlib.sha256((DATA / "xsens-acc.csv.gz").read_bytes()).hexdigest()
    assert digest in (DATA / "README.md").read_text()
    cal = calibrate_set_file(DATA / "xsens.toml")
    assert 36 <= len(cal.spells) <= 42
    skews = np.eye(3)
    skews[1, 0], skews[2, 0], skews[2, 1] = -0.0035492, -0.0089041, -0.0213032
    m = np.linalg.inv(skews)
    published = [33124.2, 33275.2, 32364.4, 414.478, 412.102, 414.538, m[1, 0], m[2, 0], m[2, 1]]
    off = [(term.value - value) / term.std for term, value in zip(cal.terms, published, strict=True)]
    assert np.abs(off).max() < 2.0
    assert np.array([term.std for term in cal.terms]) == pytest.approx(
        [0.25, 0.14, 0.16, 0.027, 0.014, 0.017, 1e-4, 5e-4, 1e-4], rel=0.5
    )


@pytest.fixture
def folder(tmp_path):
    rng = np.random.default_rng(61)
    t, outputs = record(rng, directions(rng, 15))
    rows = np.column_stack((t, outputs, 0.5 * outputs.sum(axis=1)))
    np.savetxt(tmp_path / "set.csv", rows, delimiter=",", header="t,x,y,z,w", comments="", fmt="%.9g")
    (tmp_path / "set.toml").write_text(
        f'[instrument]\nserial = "S"\ngravity = "{G} m/s^2"\ngravity_uncertainty = "0.001 m/s^2"\n[data]\n'
        'file = "set.csv"\nreference = "gravity-norm"\ntime = { column = "t", unit = "s" }\n'
        'outputs = { columns = ["x", "y", "z"], unit = "mV" }\n'
    )
    return tmp_path


def test_calibrate_writes_page_and_json(folder, capsys):
    code, out, err = outcome(capsys, "calibrate", folder / "set.toml", "--out", folder / "out")
    assert code == 0, err
    assert "scale_factor[x]" in out
    assert "Convention upper" in out
    document = json.loads((folder / "out" / "set-calibration.json").read_text())
    assert document["terms"]["bias[y]"]["unit"] == "mV"
    assert document["gravity_std"] == pytest.approx(0.001)
    assert set(document["input_sha256"]) == {"set.toml", "set.csv"}
    page = (folder / "out" / "report.html").read_text()
    assert "Size of the force less gravity" in page
    code, out, _ = outcome(capsys, "calibrate", folder / "set.toml", "--json", "--out", folder / "again")
    assert json.loads(out)["terms"] == document["terms"]


@pytest.mark.parametrize(
    "command", [("check",), ("records", "add", "--operator", "A", "--reason", "B", "--store", "a.sqlite")]
)
def test_other_commands_say_that_it_is_a_set(folder, capsys, command):
    code, _, err = outcome(capsys, *command, folder / "set.toml")
    assert code == 2
    assert "the run file of a set of accelerometers" in err
    assert "remedy: give it to 'piga calibrate'" in err


def test_refusals(folder, capsys):
    assert is_set_file(folder / "set.toml")
    code, _, err = outcome(capsys, "calibrate", folder / "set.toml", "--terms", "k0")
    assert code == 2
    assert "is calibrated alone" in err
    text = (folder / "set.toml").read_text()
    (folder / "time.toml").write_text(text.replace("time = {", "#"))
    with pytest.raises(RunFileError, match="either time or sample_rate"):
        calibrate_set_file(folder / "time.toml")
    (folder / "two.toml").write_text(text.replace('"y", "z"', '"y"'))
    with pytest.raises(RunFileError, match="columns"):
        calibrate_set_file(folder / "two.toml")
    shutil.copy(folder / "set.toml", folder / "key.toml")
    (folder / "key.toml").write_text(text + '[model]\nconvention = "middle"\n')
    with pytest.raises(RunFileError, match="convention"):
        calibrate_set_file(folder / "key.toml")
