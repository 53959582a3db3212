"""Runs on the local pool: the same bits however often they are killed, and what is said when something goes wrong."""

import json
import os
import random
import signal
import subprocess
import threading
import time
from collections import deque
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool

import psutil
import pytest

from piga.campaign import open_campaign, plan_campaign
from piga.campaign.run import LocalEngine, RunReport, _Loop, run_campaign
from piga.campaign.shard import ShardReport, run_shard
from piga.errors import PigaError
from tests.campaign.small import SMALL, call, children, collected, computed, rows, start, workers, written

LONG = SMALL.replace("repeats = 10", "repeats = 40").replace("repeats = 7", "repeats = 20")
LONG = LONG.replace("records_per_shard = 4", "records_per_shard = 5")


def whole(folder, text):
    """What ``collect`` makes of a campaign that is computed without interruption, in this process."""
    folder.mkdir(exist_ok=True)
    computed(written(folder, text), folder / "out")
    return collected(folder / "out")


@pytest.mark.only_compiled
def test_two_workers_and_one_process_make_the_same(tmp_path):
    path = written(tmp_path)
    code, out, err = call("run", path, "--out", tmp_path / "out", "--workers", 2, "--json")
    assert code == 0, err
    content = json.loads(out)
    assert (content["shards"], content["shards_done"], content["records_of_this_run"]) == (5, 5, 17)
    assert sum(worker["records"] for worker in content["workers"]) == 17
    assert collected(tmp_path / "out") == whole(tmp_path / "one", SMALL)
    code, out, err = call("run", path, "--out", tmp_path / "out", "--workers", 1, "--json")
    assert code == 0
    assert json.loads(out)["records_of_this_run"] == 0, "what is done is not computed again"


def kill_somebody(process, who, rng):
    """SIGKILL for the parent or for one worker of a running command."""
    victims = workers(process) if who == "worker" else [psutil.Process(process.pid)]
    if victims:
        rng.choice(victims).kill()


def interrupted(path, out, rng, count, kills):
    """Kill the parent or a worker at random times, run again until the campaign is done; returns the number of kills."""
    done = tries = 0
    while tries < 60:
        tries += 1
        process = start("run", path, "--out", out, "--workers", count)
        if done < kills:
            began = time.monotonic()
            while process.poll() is None and time.monotonic() - began < 120 and not workers(process):
                time.sleep(0.05)
            time.sleep(rng.uniform(0.0, 4.0))
            who = rng.choice(["parent", "worker"])
            alive = process.poll() is None
            left = children(process)
            kill_somebody(process, who, rng)
            done += alive
            if who == "parent":
                _, alive_still = psutil.wait_procs(left, timeout=30)
                assert not alive_still, "workers end with their parent"
        process.communicate(timeout=600)
        if not open_campaign(out).missing():
            return done
    raise AssertionError("the campaign does not come to an end")


@pytest.mark.only_compiled
def test_killed_at_random_times(tmp_path):
    rng = random.Random(3)
    path = written(tmp_path, LONG)
    assert plan_campaign(path, tmp_path / "out").shards == 12
    interrupted(path, tmp_path / "out", rng, 2, 2)
    assert collected(tmp_path / "out") == whole(tmp_path / "one", LONG)
    assert (
        not list((tmp_path / "out" / "set-aside").glob("*"))
        if (tmp_path / "out" / "set-aside").exists()
        else True
    )


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_killed_many_times(tmp_path, count):
    rng = random.Random(count)
    expected = whole(tmp_path / "one", LONG)
    path = written(tmp_path, LONG)
    for k in range(8):
        interrupted(path, tmp_path / f"out-{k}", rng, count, 4)
        assert collected(tmp_path / f"out-{k}") == expected


@pytest.mark.slow
def test_a_shard_whose_worker_always_dies_is_set_aside(tmp_path):
    """Every worker is killed as soon as it exists: all shards are set aside, exit 1; the next run computes them."""
    path = written(tmp_path, SMALL.replace("records_per_shard = 4", "records_per_shard = 9"))
    out = tmp_path / "out"
    process = start("run", path, "--out", out, "--workers", 1)
    stop = threading.Event()

    def kill():
        while not stop.is_set() and process.poll() is None:
            for worker in workers(process):
                worker.kill()
            time.sleep(0.02)

    killer = threading.Thread(target=kill)
    killer.start()
    _, err = process.communicate(timeout=600)
    stop.set()
    killer.join()
    assert process.returncode == 1, err
    assert "shard 0 was set aside: records 0 to 8: the worker died twice" in err
    assert "shard 1 was set aside" in err
    assert "try these shards again with: piga campaign run" in err
    code, said, _ = call("status", out, "--json")
    assert code == 0
    assert [entry["shard"] for entry in json.loads(said)["set_aside"]] == [0, 1]
    assert call("run", path, "--out", out, "--workers", 1)[0] == 0
    assert collected(out)["json"] == whole(tmp_path / "one", SMALL)["json"]
    assert not open_campaign(out).set_aside()


class Dying:
    """An engine whose workers die at some shards; all that is under way dies with them, as in a pool."""

    workers = 2

    def __init__(self, deadly):
        self.deadly, self.renewed, self.submitted = deadly, 0, []
        self.waiting = []

    def submit(self, folder, shard):
        future = Future()
        self.submitted.append(shard)
        self.waiting.append((future, shard))
        if shard in self.deadly:
            for other, _ in self.waiting:
                other.set_exception(BrokenProcessPool("died"))
            self.waiting = []
        elif len(self.waiting) == self.workers:
            self._finish()
        else:
            threading.Timer(0.05, self._finish).start()
        return future

    def _finish(self):
        waiting, self.waiting = self.waiting, []
        for future, shard in waiting:
            future.set_result(ShardReport(shard, 1, 0, 0.0, "w"))

    def renew(self):
        self.renewed += 1

    def check(self):
        pass


def test_only_the_shard_that_kills_is_set_aside(tmp_path):
    """Shards that were lost with a broken pool are tried again one by one: the innocent are done."""
    campaign = plan_campaign(written(tmp_path), tmp_path / "out")
    engine, report = Dying({1, 4}), RunReport(campaign.shards)
    _Loop(campaign, engine, deque(range(5)), report, lambda _progress: None).run()
    assert sorted(report.set_aside) == [1, 4]
    assert report.done == 3
    assert engine.submitted.count(1) == engine.submitted.count(4) == 2
    assert engine.renewed >= 2
    assert sorted(campaign.set_aside()) == [1, 4]


@pytest.mark.only_compiled
def test_ctrl_c_finishes_the_shards_under_way(tmp_path):
    path, out = written(tmp_path, LONG), tmp_path / "out"
    plan_campaign(path, out)
    process = start("run", path, "--out", out, "--workers", 1)
    while not list((out / "parts").glob("part-*")):
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)  # a terminal sends it to all processes
    _, err = process.communicate(timeout=120)
    done = len(open_campaign(out).done())
    assert process.returncode == 1
    assert 0 < done < 12
    assert "Traceback" not in err
    assert "the shards under way are finished" in err
    assert f"go on with: piga campaign run {path} --out {out} --workers 1" in err
    assert not [path for path in (out / "parts").iterdir() if not path.name.startswith("part-")]


@pytest.mark.slow
def test_second_ctrl_c_drops_them(tmp_path):
    text = LONG.replace("records_per_shard = 5", "records_per_shard = 500").replace(
        'rate = "5 Hz"', 'rate = "50 Hz"'
    )
    path, out = written(tmp_path, text), tmp_path / "out"
    plan_campaign(path, out)
    process = start("run", path, "--out", out, "--workers", 1)
    while not workers(process):
        assert process.poll() is None
        time.sleep(0.05)
    time.sleep(2.0)
    process.send_signal(signal.SIGINT)
    time.sleep(1.0)
    began = time.monotonic()
    process.send_signal(signal.SIGINT)
    try:
        _, err = process.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        raise
    assert time.monotonic() - began < 30.0
    assert process.returncode == 1
    assert "Traceback" not in err
    assert "the shards under way are dropped" in err
    assert open_campaign(out).missing() == [0]


def test_two_runs_in_one_folder(tmp_path):
    campaign = plan_campaign(written(tmp_path), tmp_path / "out")
    from piga.output import hold

    release = hold(tmp_path / "out" / "running.lock")
    try:
        with pytest.raises(PigaError, match="another 'piga campaign run' works in this folder"):
            run_campaign(campaign, workers=1)
    finally:
        release()


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


def test_disk_full(tmp_path):
    """A part that cannot be written ends the run with one message and exit code 2."""
    path, out = written(tmp_path), tmp_path / "out"
    plan_campaign(path, out)
    limited = ["bash", "-c", 'ulimit -f 4; exec "$@"', "_"]
    import sys

    from tests.campaign.small import ROOT

    words = [sys.executable, "-m", "piga", "campaign", "run", str(path), "--out", str(out), "--workers", "1"]
    env = os.environ | {"PYTHONPATH": str(ROOT / "src"), "NUMBA_DISABLE_JIT": "1"}
    env["PYTHONDONTWRITEBYTECODE"] = "1"  # Python would keep module files that are cut at the limit
    done = subprocess.run([*limited, *words], check=False, env=env, capture_output=True, text=True, timeout=600)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.count("piga: ") == 1
    assert "cannot be written" in done.stderr
    assert "run the campaign again" in done.stderr
    assert rows(out) == []


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--workers", "0"], "at least one is needed"),
        (["--workers", "2", "--executor", "dask://127.0.0.1:1"], "--workers is for this machine only"),
    ],
)
def test_options(tmp_path, options, words, capsys):
    from piga.cli.main import app

    with pytest.raises(PigaError, match=words):
        app(
            ["campaign", "run", str(written(tmp_path)), "--out", str(tmp_path / "o"), *options],
            standalone_mode=False,
        )


def test_threads_of_workers(tmp_path):
    """Workers have one thread each; the variables of this process are as before."""
    before = dict(os.environ)
    engine = LocalEngine(1)
    try:
        assert os.environ["OMP_NUM_THREADS"] == os.environ["NUMBA_NUM_THREADS"] == "1"
    finally:
        engine.close(drop=True)
    assert dict(os.environ) == before
