"""The folder of a campaign: its manifest, the cut, and parts that cannot be trusted."""

import json
import os
import random
import subprocess
import sys

import pytest

from piga.campaign import collect, open_campaign, plan_campaign, run_campaign
from piga.campaign.shards import read_part, run_shard
from piga.errors import DataError, PigaError
from tests.campaign.small import ROOT, SMALL, computed, rows, written


def test_manifest_is_a_function_of_the_file(tmp_path):
    path = written(tmp_path)
    first, second = (plan_campaign(path, tmp_path / name) for name in ("a", "b"))
    texts = [(c.folder / "manifest.json").read_bytes() for c in (first, second)]
    assert texts[0] == texts[1]
    assert first.key == second.key
    other = written(tmp_path, SMALL.replace("seed = 7", "seed = 8"), "other.toml")
    assert plan_campaign(other, tmp_path / "c").key != first.key


def test_folder_of_another_campaign(tmp_path):
    plan_campaign(written(tmp_path), tmp_path / "out")
    changed = written(tmp_path, SMALL.replace("repeats = 7", "repeats = 8"))
    with pytest.raises(PigaError, match="holds another campaign"):
        plan_campaign(changed, tmp_path / "out")
    (tmp_path / "file").write_text("x")
    with pytest.raises(NotADirectoryError):
        plan_campaign(changed, tmp_path / "file")


def test_no_campaign_there(tmp_path):
    with pytest.raises(PigaError, match="holds no campaign"):
        open_campaign(tmp_path)
    (tmp_path / "manifest.json").write_text('{"schema": "piga.camp')
    with pytest.raises(PigaError, match=r"manifest\.json: is damaged"):
        open_campaign(tmp_path)


@pytest.mark.parametrize("name", ["", "stand.toml"])
def test_a_manifest_that_lacks_a_file_is_damaged(tmp_path, name):
    plan_campaign(written(tmp_path), tmp_path / "out")
    path = tmp_path / "out" / "manifest.json"
    manifest = json.loads(path.read_text())
    del manifest["texts"][name]
    path.write_text(json.dumps(manifest))
    with pytest.raises(PigaError, match="is damaged"):
        open_campaign(tmp_path / "out")


def test_other_software_is_refused(tmp_path):
    path, out = written(tmp_path), tmp_path / "out"
    plan_campaign(path, out)
    manifest = json.loads((out / "manifest.json").read_text())
    manifest["software"]["source_sha256"] = "0" * 64
    (out / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(PigaError, match="begun with other software") as caught:
        plan_campaign(path, out)
    assert "source_sha256 000000000000 then" in str(caught.value)
    with pytest.raises(PigaError, match="has other software than the campaign"):
        run_shard(str(out), 0)


@pytest.mark.long
def test_damaged_parts_are_named(tmp_path):
    """Parts that are cut, empty, or those of another shard, however they are named, are refused and computed anew."""
    campaign = computed(written(tmp_path), tmp_path / "out", (0, 1))
    other, part = campaign.parts().values()
    whole, before = part.read_bytes(), rows(tmp_path / "out")[4:]
    for damage in (whole[: len(whole) // 2], b"", b"\0" * len(whole), other.read_bytes()):
        part.write_bytes(damage)
        with pytest.raises(DataError, match=r"part-00001-\w+\.parquet: is damaged"):
            collect(campaign)
        with pytest.raises(DataError, match=r"part-00001-\w+\.parquet.*\n.*delete it"):
            run_campaign(campaign, workers=1)
    part.unlink()
    copied = part.with_name(other.name.replace("part-00000", "part-00001"))
    copied.write_bytes(other.read_bytes())
    with pytest.raises(DataError, match="is damaged, or belongs to another campaign or shard"):
        collect(campaign)
    copied.unlink()
    run_shard(str(tmp_path / "out"), 1)
    again = rows(tmp_path / "out")[4:]
    assert [row | {"seconds": 0} for row in again] == [row | {"seconds": 0} for row in before]


@pytest.mark.long
def test_every_flip_of_a_part_is_seen(tmp_path):
    campaign = computed(written(tmp_path), tmp_path / "out", (0,))
    (path,) = campaign.parts().values()
    whole, rng = path.read_bytes(), random.Random(5)
    for _ in range(300):
        damaged = bytearray(whole)
        damaged[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        with pytest.raises(DataError):
            read_part(campaign, 0, path)
    path.write_bytes(whole)
    assert read_part(campaign, 0, path).num_rows == 12


def test_disk_full(tmp_path):
    """A part that cannot be written ends the shard with one message."""
    path, out = written(tmp_path), tmp_path / "out"
    code = "import sys; from piga.campaign.shards import *; plan_campaign(*sys.argv[1:]); run_shard(sys.argv[2], 0)"
    limited = ["bash", "-c", 'ulimit -f 4; exec "$@"', "_", sys.executable, "-c", code, str(path), str(out)]
    variables = {"PYTHONPATH": str(ROOT / "src"), "NUMBA_DISABLE_JIT": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        limited, check=False, env=os.environ | variables, capture_output=True, text=True, timeout=600
    )
    assert "cannot be written (File too large)" in done.stderr
    assert "run the campaign again" in done.stderr
    assert rows(out) == []
