"""Runs on a Dask cluster: two processes on loopback, with and without TLS; whichever is killed, the bits are the same."""

import contextlib
import json
import os
import random
import re
import signal
import socket
import subprocess
import sys
import time

import pytest

from piga.campaign import open_campaign, plan_campaign
from piga.errors import PigaError
from tests.campaign.small import ROOT, SMALL, call, collected, start, written
from tests.campaign.test_run import LONG, whole
from tests.certificate.certificate_data import key_pair

pytest.importorskip("distributed")


class Cluster:
    """A scheduler and workers as processes of their own; ``tls`` names the folder of certificate and key."""

    def __init__(self, folder, workers=2, tls=None):
        self.folder, self.count, self.scheme = folder, workers, "tls" if tls else "tcp"
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.variables = {"PYTHONPATH": str(ROOT / "src"), "OPENBLAS_NUM_THREADS": "1"}
        self.tls = {}
        if tls:
            prefix = "DASK_DISTRIBUTED__COMM__"
            self.tls = {f"{prefix}TLS__CA_FILE": str(tls / "cert.pem"), f"{prefix}REQUIRE_ENCRYPTION": "True"}
            for who in ("SCHEDULER", "WORKER", "CLIENT"):
                self.tls |= {
                    f"{prefix}TLS__{who}__CERT": str(tls / "cert.pem"),
                    f"{prefix}TLS__{who}__KEY": str(tls / "key.pem"),
                }
        self.scheduler = None
        self.workers = []

    @property
    def address(self):
        return f"dask://127.0.0.1:{self.port}"

    def _start(self, *words):
        env = os.environ | self.variables | self.tls
        with (self.folder / f"{words[0]}.log").open("a") as log:
            program = [sys.executable, "-m", "dask", *words]
            return subprocess.Popen(
                program, env=env, cwd=self.folder, stdout=log, stderr=log, start_new_session=True
            )

    def start_scheduler(self):
        where = f"{self.scheme}://127.0.0.1"
        self.scheduler = self._start(
            "scheduler", "--host", where, "--port", str(self.port), "--no-dashboard", "--no-show"
        )

    def start_worker(self):
        words = (
            "--nthreads",
            "1",
            "--no-nanny",
            "--no-dashboard",
            "--death-timeout",
            "60",
            "--host",
            f"{self.scheme}://127.0.0.1",
        )
        self.workers.append(self._start("worker", f"{self.scheme}://127.0.0.1:{self.port}", *words))

    def __enter__(self):
        self.start_scheduler()
        for _ in range(self.count):
            self.start_worker()
        return self

    def __exit__(self, *error):
        for process in (self.scheduler, *self.workers):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    def wait(self):
        """Wait until all workers are there."""
        log = self.folder / "scheduler.log"
        began = time.monotonic()
        while time.monotonic() - began < 120:
            if log.exists() and log.read_text(errors="replace").count("Register worker") >= self.count:
                return
            time.sleep(0.2)
        raise AssertionError(log.read_text(errors="replace"))


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    """A folder with a certificate of its own authority, and its key."""
    folder = tmp_path_factory.mktemp("tls")
    for path in key_pair(folder, "node", start=-1, days=3, hosts=["127.0.0.1"]):
        path.rename(folder / path.name.removeprefix("node-"))
    return folder


@pytest.mark.only_compiled
def test_two_nodes_with_tls(tmp_path, certificate):
    """Two workers behind TLS make the same bits as this process; a client without the key is not let in."""
    path, out = written(tmp_path), tmp_path / "out"
    with Cluster(tmp_path, 2, certificate) as cluster:
        cluster.wait()
        code, said, err = call(
            "run", path, "--out", out, "--executor", cluster.address, "--json", **cluster.tls
        )
        assert code == 0, err
        content = json.loads(said)
        assert content["shards_done"] == 5
        assert sum(worker["records"] for worker in content["workers"]) == 17
        code, _, err = call("run", path, "--out", tmp_path / "other", "--executor", cluster.address)
        assert code == 2
        assert "no scheduler answers" in err
        assert "Traceback" not in err
    assert collected(out) == whole(tmp_path / "one", SMALL)


def test_off_the_local_machine_tls_is_required(tmp_path):
    code, _, err = call(
        "run", written(tmp_path), "--out", tmp_path / "out", "--executor", "dask://192.0.2.1:8786"
    )
    assert code == 2
    assert "there are no TLS certificates" in err
    assert "distributed.comm.tls" in err
    title = re.search("as the page '(.*)' shows", err)
    page = ROOT / "docs" / "how-to" / "campaigns.md"
    assert title is not None
    assert page.read_text(encoding="utf-8").startswith(f"# {title[1]}\n"), "the page that the remedy names"


@pytest.mark.parametrize(
    "address", ["127.0.0.1:8786", "dask://127.0.0.1", "dask://:1", "ray://a:1", "dask://a b:1"]
)
def test_addresses(address):
    from piga.campaign.run import DaskEngine

    with pytest.raises(PigaError, match="is not dask://HOST:PORT"):
        DaskEngine(address)


@pytest.mark.parametrize(
    ("host", "local"),
    [
        ("127.0.0.1", True),
        ("localhost", True),
        ("[::1]", True),
        ("10.1.2.3", False),
        ("192.0.2.1", False),
        ("no.such.host.invalid", False),
    ],
)
def test_what_is_local(host, local):
    from piga.campaign.run import is_local

    assert is_local(host) is local


def killed(tmp_path, rng, count, who):
    """Kill ``who`` at a random time in a run on a cluster, then run until all is done."""
    path, out = written(tmp_path, LONG), tmp_path / f"out-{who}-{count}-{rng.random():.6f}"
    plan_campaign(path, out)
    for tries in range(8):
        with Cluster(tmp_path, count) as cluster:
            (tmp_path / "scheduler.log").write_text("")
            cluster.wait()
            process = start("run", path, "--out", out, "--executor", cluster.address)
            if tries == 0:
                began = time.monotonic()
                while (
                    process.poll() is None
                    and not list((out / "parts").glob("part-*"))
                    and time.monotonic() - began < 120
                ):
                    time.sleep(0.05)
                time.sleep(rng.uniform(0.0, 2.0))
                if who == "scheduler":
                    cluster.scheduler.kill()
                elif who == "worker":
                    cluster.workers[0].kill()
                    cluster.start_worker()
                else:
                    process.kill()
            _, err = process.communicate(timeout=600)
            if tries == 0 and who == "scheduler" and process.returncode:
                assert process.returncode == 2, err
                assert "Traceback" not in err.partition("piga: ")[2]
                assert "then give the same command: parts that are written stay" in err
            if tries == 0 and who == "worker":
                assert process.returncode == 0, err
        if not open_campaign(out).missing():
            return out
    raise AssertionError("the campaign does not come to an end")


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("who", ["scheduler", "worker", "parent"])
def test_killed_at_random_times(tmp_path, who, count):
    rng = random.Random(f"{who} {count}")
    expected = whole(tmp_path / "one", LONG)
    for _ in range(2):
        assert collected(killed(tmp_path, rng, count, who)) == expected


@pytest.mark.slow
def test_workers_with_several_threads_are_refused(tmp_path):
    """Threads of one process share their linear algebra and their interpreter: one thread a worker."""
    with Cluster(tmp_path, 0) as cluster:
        words = ("--nthreads", "2", "--no-nanny", "--no-dashboard", "--host", "tcp://127.0.0.1")
        cluster.workers.append(cluster._start("worker", f"tcp://127.0.0.1:{cluster.port}", *words))
        cluster.count = 1
        cluster.wait()
        code, _, err = call("run", written(tmp_path), "--out", tmp_path / "out", "--executor", cluster.address)
    assert code == 2
    assert "a worker has 2 threads" in err
    assert "--nthreads 1" in err
