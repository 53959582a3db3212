"""Every command with ``--json``, once, on the shipped examples; each document has the schema of its command.

The comparison itself is that of all tests (``tests/conftest.py``).
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests import json_documents
from tests.certificate.certificate_data import key_pair
from tests.cli.runner import exit_code

SCENARIO = """
{head}
[campaign]
title = "t"
seed = 1
repeats = 2
"""
COMMANDS = """
terms
check --explain data.time
examples
demo --out lab
init lab/tumble-a.csv --out drafted.toml
check lab/tumble-a.toml --terms
calibrate lab/tumble-a.toml --no-report --out c
calibrate lab/tumble-a.toml --no-report --phases per-segment --terms scale_factor,tan_beta,k0 --out c2
compensate lab/tumble-a.toml --calibration c/calibration.json --out out.parquet
simulate examples/joint-dividing-head.toml --out head
simulate examples/joint-centrifuge.toml --out arm
calibrate head/run.toml arm/run.toml --no-report --out joint
plan planned.toml --out planned
campaign plan small.toml --out many
campaign run small.toml --out many --workers 1
campaign status many
campaign collect many
campaign repeat small.toml --record 1 --out again
records add lab/tumble-a.toml --store s.sqlite --operator A --reason B
calibrate lab/tumble-a.toml --terms scale_factor,k0 --out fewer
records add lab/tumble-a.toml --results fewer --store s.sqlite --operator A --reason B --measured 2026-11-20 --supersedes 1
records list --store s.sqlite
records show 1 --store s.sqlite
records diff 1 2 --store s.sqlite
records verify --store s.sqlite
records export all.zip --store s.sqlite
records import all.zip --store t.sqlite --operator A --reason B
records list --store t.sqlite
records show 2 --store t.sqlite
records reproduce 1 --store s.sqlite
records export copy.zip --store s.sqlite
records restore copy.zip --store u.sqlite
records trend history/0 history/1 history/2 history/3 history/4 history/5 history/6 history/7
certificate issue lab/calibration.json --data examples/certificate.toml --out cert --dcc --key K --certificate C
certificate verify cert/certificate.xml --certificate C
"""
EXAMPLES = Path(__file__).parents[2] / "examples"
FEWER = (
    ("0:360:5 deg", "0:360:15 deg"),
    ("20 Hz", "4 Hz"),
    ("150 s", "75 s"),
    ("2130 s", "1065 s"),
)
"""Changes of the shipped plan: the same document, sooner."""
WITHOUT_JSON = ("examples", "demo")


def write_history(path: Path, folder: Path) -> None:
    """The same calibration on eight days, with values that scatter and end with a step."""
    document = json.loads(path.read_text(encoding="utf-8"))
    for day in range(8):
        document["provenance"]["created"] = f"2026-0{day + 1}-15T09:00:00Z"
        for coefficient in document["coefficients"]:
            coefficient["value"] += coefficient["std"] * ((-1) ** day + 40.0 * (day == 7))
        target = folder / str(day) / "calibration.json"
        target.parent.mkdir(parents=True)
        target.write_text(json.dumps(document), encoding="utf-8")


@pytest.mark.long
def test_every_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    key, certificate = key_pair(tmp_path, "laboratory")
    monkeypatch.chdir(tmp_path)
    plan = (EXAMPLES / "plan-dividing-head.toml").read_text(encoding="utf-8")
    for change in FEWER:
        assert change[0] in plan
        plan = plan.replace(*change)
    Path("planned.toml").write_text(plan, encoding="utf-8")
    Path("small.toml").write_text(SCENARIO.format(head='scenario = "examples/dividing-head.toml"'))
    for line in COMMANDS.strip().splitlines():
        words = [{"K": str(key), "C": str(certificate)}.get(word, word) for word in line.split()]
        code = exit_code(*words, *([] if words[0] in WITHOUT_JSON else ["--json"]))
        printed = capsys.readouterr()
        assert code == 0, f"{line}: {printed.err}"
        if words[0] not in WITHOUT_JSON:
            json.loads(printed.out)
        if line.endswith("--out c"):
            write_history(Path("c/calibration.json"), Path("history"))


def test_schemas_are_valid() -> None:
    paths = sorted(json_documents.FOLDER.glob("*.json"))
    assert len(paths) > 25
    for path in paths:
        json_documents.Draft202012Validator.check_schema(json.loads(path.read_text(encoding="utf-8")))
