"""``piga platform``: files, every N-th row, JSON and exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.cli.runner import exit_code, invoked
from tests.platform.conftest import INTERPRETED

STEP = "8 s" if INTERPRETED else "2 s"


SHORT = f"""
[site]
latitude = "40 deg"
[run]
duration = "1 h"
step = "{STEP}"
[polar]
misalignment = "4 arcmin"
phase = "20 deg"
[equatorial]
misalignment = "4 arcmin"
phase = "75 deg"
drift = ["0.01 deg/h", "0 deg/h"]
[sensors]
gimbal_noise = "1 arcsec"
pickoff_noise = "1 arcsec"
velocity_random_walk = "1e-5 m/s/sqrt(s)"
"""


@pytest.fixture
def scenario(tmp_path):
    path = tmp_path / "scenario.toml"
    path.write_text(SHORT)
    return path


def _run(capsys, *arguments):
    return exit_code("platform", *arguments), capsys.readouterr()


@pytest.mark.parametrize(
    ("command", "files"),
    [
        ("simulate", {"readouts.parquet", "truth.parquet", "simulated.toml"}),
        ("align", {"alignment.json"}),
        ("identify", {"identification.json"}),
        ("navigate", {f"navigation-{m}.parquet" for m in ("none", "A", "B", "C")}),
        ("compare", {"comparison.json"}),
    ],
)
def test_a_command_leaves_its_files_and_a_page(capsys, scenario, tmp_path, command, files):
    code, streams = _run(capsys, command, scenario, "--out", tmp_path / "out", "--json")
    assert code == 0
    assert isinstance(json.loads(streams.out), dict)
    assert {p.name for p in (tmp_path / "out").glob("[!.]*")} == {*files, "report.html"}
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "<svg" in page


def test_identify_takes_the_folder_of_simulate(capsys, scenario, tmp_path):
    assert _run(capsys, "simulate", scenario, "--out", tmp_path / "sim")[0] == 0
    documents = []
    for given in (scenario, tmp_path / "sim"):
        code, streams = _run(capsys, "identify", given, "--out", tmp_path / f"of-{given.name}", "--json")
        assert code == 0
        documents.append(json.loads(streams.out))
    assert documents[0] == documents[1]


def test_budget_is_added_on_request(capsys, scenario, tmp_path):
    code, streams = _run(capsys, "compare", scenario, "--out", tmp_path, "--json", "--budget")
    document = json.loads(streams.out)
    assert code == 0
    assert document["budget"][-1]["source"] == "all together"


@pytest.mark.long
def test_gyro_accelerometers_get_their_own_page(capsys, scenario, tmp_path):
    step = "1 s"
    text = SHORT.replace(STEP, step).replace("1 h", "20 min")
    text = text.replace("[sensors]", '[sensors]\naccelerometers = "piga"')
    models = '[compensation]\nmodels = ["B"]\nmisalignment = "true"\nattitude = "true"\n'
    scenario.write_text(text + models)
    code, _ = _run(capsys, "compare", scenario, "--out", tmp_path / "out")
    assert code == 0
    assert "Gyro accelerometers" in (tmp_path / "out" / "capstone.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("compare", "absent.toml"), "absent.toml: cannot be read"),
        (("align", "sway.toml", "--out", "x"), "needs a base at rest"),
        (("identify", "short.toml", "--out", "x"), "two turns of the cases"),
        (("simulate", "short.toml", "--out", "x", "--every", "0"), "--every"),
    ],
)
def test_wrong_use_ends_with_two_and_one_message(capsys, monkeypatch, tmp_path, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sway.toml").write_text(SHORT + '[motion]\nkind = "sway"\n')
    (tmp_path / "short.toml").write_text(SHORT.replace("1 h", "800 s"))
    code, streams = _run(capsys, *arguments)
    assert code == 2
    assert message in streams.err
    assert "Traceback" not in streams.err


SCENARIO = """\
[site]
latitude = "40 deg"
[run]
duration = "100 s"
[sensors]
gimbal_noise = "1 arcsec"
"""


def _tables(command: str, folder: Path, every: int) -> dict[str, pa.Table]:
    """Tables of a run of 100 s, written with ``--every``."""
    out = folder / f"{command}-{every}"
    done = invoked("platform", command, folder / "s.toml", "--out", out, "--every", every)
    assert done.exit_code == 0, done.exception
    return {path.name: pq.read_table(path) for path in out.glob("*.parquet")}


def test_every_n_th_row(tmp_path: Path) -> None:
    """States are thinned; velocity increments are those from row to row, so that no velocity is lost."""
    every = 7
    (tmp_path / "s.toml").write_text(SCENARIO)
    whole, thin = (_tables("simulate", tmp_path, n) for n in (1, every))
    assert set(thin) == {"readouts.parquet", "truth.parquet"}
    assert whole["readouts.parquet"].schema.field("dvx").metadata == {b"unit": b"m/s"}
    rows = 100 // every
    for name, table in thin.items():
        assert table.num_rows == 1 + rows
        assert table.schema.equals(whole[name].schema, check_metadata=True)
        for column in table.column_names:
            values, kept = (t[name].column(column).to_numpy() for t in (whole, thin))
            if column.startswith("dv"):
                assert np.isnan(kept[0])
                sums = values[1 : 1 + rows * every].reshape(rows, every).sum(axis=1)
                np.testing.assert_allclose(kept[1:], sums, rtol=1e-12, atol=1e-15)
            else:
                np.testing.assert_array_equal(kept, values[::every])
