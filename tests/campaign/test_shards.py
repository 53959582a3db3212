"""The folder of a campaign, parts that cannot be trusted, and runs on Dask: the same bits however often they are killed."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request

import pytest

from piga.campaign import collect, open_campaign, plan_campaign, run_campaign
from piga.campaign.shards import _client, run_shard
from piga.errors import CancelledError, DataError, PigaError
from tests.campaign.small import ROOT, SMALL, call, collected, computed, rows, start, written
from tests.certificate.certificate_data import key_pair

pytest.importorskip("distributed")
LONG = SMALL.replace("repeats = 10", "repeats = 20").replace("repeats = 7", "repeats = 10")
LONG = LONG.replace("records_per_shard = 4", "records_per_shard = 3")
"""30 records in 10 shards: the first part is written long before the last."""


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
    plan_campaign(written(tmp_path), tmp_path / "out")
    path = tmp_path / "out" / "manifest.json"
    manifest = json.loads(path.read_text())
    for damage in ({"texts": {"": manifest["texts"][""]}}, {"texts": {}}, {"schema": "piga.campaign/1"}):
        path.write_text(json.dumps(manifest | damage))
        with pytest.raises(PigaError, match="is damaged, or from another version"):
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
    with pytest.raises(PigaError, match=r"worker .*begun with other software"):
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


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """What ``collect`` makes of ``LONG`` that is computed without interruption, in this process."""
    folder = tmp_path_factory.mktemp("one")
    computed(written(folder, LONG), folder / "out")
    return collected(folder / "out")


def wait_for(process, ready, seconds=300.0):
    """Wait until ``ready`` or the end of a process."""
    began = time.monotonic()
    while process.poll() is None and time.monotonic() - began < seconds and not ready():
        time.sleep(0.05)


@pytest.mark.long
def test_two_workers_and_one_process_make_the_same(tmp_path, uninterrupted):
    path = written(tmp_path, LONG)
    code, out, err = call("run", path, "--out", tmp_path / "out", "--workers", 2, "--json")
    assert code == 0, err
    content = json.loads(out)
    assert (content["shards"], content["shards_done"], content["records_of_this_run"]) == (10, 10, 30)
    assert collected(tmp_path / "out") == uninterrupted
    code, out, err = call("run", path, "--out", tmp_path / "out", "--workers", 1, "--json")
    assert code == 0
    assert json.loads(out)["records_of_this_run"] == 0, "what is done is not computed again"


@pytest.mark.long
def test_a_shard_whose_worker_always_dies_is_named(tmp_path):
    """The other shards are computed, and the exit code is 1."""
    path, out = written(tmp_path), tmp_path / "out"
    plan_campaign(path, out)
    deadly = tmp_path / "deadly"
    deadly.mkdir()
    (deadly / "sitecustomize.py").write_text(
        "import sys, os\n"
        "if 'spawn_main' in ' '.join(sys.orig_argv):\n"
        "    import piga.campaign.shards as t\n"
        "    real = t.compute\n"
        "    t.compute = lambda plan, record: os._exit(9) if record.number == 13 else real(plan, record)\n"
    )
    variables = {"PYTHONPATH": f"{deadly}{os.pathsep}{ROOT / 'src'}"}
    code, said, err = call("run", path, "--out", out, "--workers", 2, "--json", **variables)
    assert code == 1, err
    assert [entry["shard"] for entry in json.loads(said)["set_aside"]] == [3]
    assert "shard 3 is not computed: records 12 to 15: its worker died 4 times" in err
    assert open_campaign(out).missing() == [3]


@pytest.mark.long
def test_nobody_else_gets_a_page_of_the_cluster(tmp_path):
    """Dask's pages listen on loopback alone, on any free port, and show nothing (of two campaigns at once one had a warning)."""
    campaign = plan_campaign(written(tmp_path), tmp_path / "out")
    with _client(campaign, None, 1, None) as client:
        servers = [
            client.run_on_scheduler(lambda dask_scheduler: dask_scheduler.http_server.address),
            *client.run(lambda dask_worker: dask_worker.http_server.address).values(),
        ]
        ports = [
            client.run_on_scheduler(lambda dask_scheduler: dask_scheduler.http_server.port),
            *client.run(lambda dask_worker: dask_worker.http_server.port).values(),
        ]
        assert set(servers) == {"127.0.0.1"}
        assert 8787 not in ports
        for port in ports:
            for page in ("info/main/workers.html", "metrics", "json/identity.json", "health", "status"):
                with pytest.raises(urllib.error.HTTPError, match="404"):
                    urllib.request.urlopen(f"http://127.0.0.1:{port}/{page}", timeout=20)


@pytest.mark.long
def test_ctrl_c_says_how_to_go_on(tmp_path):
    path = written(tmp_path, LONG.replace("repeats = 20", "repeats = 200"))
    out = tmp_path / "out"
    plan_campaign(path, out)
    process = start("run", path, "--out", out, "--workers", 1)
    wait_for(process, lambda: list(out.glob("parts/part-*")))
    os.killpg(process.pid, signal.SIGINT)  # a terminal sends it to all processes
    _, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert 0 < len(open_campaign(out).parts()) < open_campaign(out).shards
    assert "give the same command again" in err
    assert "Traceback" not in err
    assert all(part.name.startswith("part-") for part in (out / "parts").iterdir())


def test_a_caller_stops_a_run(tmp_path):
    campaign = plan_campaign(written(tmp_path), tmp_path / "out")
    with pytest.raises(CancelledError, match="stopped before"):
        run_campaign(campaign, workers=1, progress=lambda *_step: False)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"workers": 0}, "is the number of processes of this machine, at least one"),
        (
            {"workers": 2, "executor": "tcp://127.0.0.1:1"},
            "--workers 2: is the number of processes of this machine",
        ),
        ({"executor": "127.0.0.1:1"}, "needs a tls:// address"),
        ({"executor": "tcp://192.0.2.1:8786"}, "needs a tls:// address"),
    ],
)
def test_options(tmp_path, options, words):
    with pytest.raises(PigaError, match=words):
        run_campaign(plan_campaign(written(tmp_path), tmp_path / "o"), **options)


@contextlib.contextmanager
def cluster(folder, tls):
    """A scheduler and two workers behind TLS (``tls`` has certificate and key): address, variables, and the scheduler."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        where = f"127.0.0.1:{free.getsockname()[1]}"
    dask = "DASK_DISTRIBUTED__COMM__"
    variables = {f"{dask}TLS__CA_FILE": str(tls / "cert.pem"), f"{dask}REQUIRE_ENCRYPTION": "True"}
    for who in ("SCHEDULER", "WORKER", "CLIENT"):
        variables |= {f"{dask}TLS__{who}__{kind.upper()}": str(tls / f"{kind}.pem") for kind in ("cert", "key")}
    worker = ("worker", f"tls://{where}", "--nthreads", "1", "--no-nanny", "--death-timeout", "60")
    processes = []
    try:
        for words in (("scheduler", "--port", where.partition(":")[2], "--no-show"), worker, worker):
            program = [sys.executable, "-m", "dask", *words, "--no-dashboard", "--host", "tls://127.0.0.1"]
            env = os.environ | {"PYTHONPATH": str(ROOT / "src"), "OPENBLAS_NUM_THREADS": "1"} | variables
            quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            processes.append(subprocess.Popen(program, env=env, cwd=folder, start_new_session=True, **quiet))
        yield f"tls://{where}", variables, processes[0]
    finally:
        for process in processes:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    """A folder with a certificate of its own authority, and its key."""
    folder = tmp_path_factory.mktemp("tls")
    for path in key_pair(folder, "node", start=-1, days=3, hosts=["127.0.0.1"]):
        path.rename(folder / path.name.removeprefix("node-"))
    return folder


@pytest.mark.long
@pytest.mark.parametrize("who", ["parent", pytest.param("scheduler", marks=pytest.mark.slow)])
def test_a_scheduler_with_tls(tmp_path, certificate, uninterrupted, who):
    """Whoever is killed, the bits are the same; a client without the key is not let in."""
    path, out = written(tmp_path, LONG), tmp_path / "out"
    plan_campaign(path, out)
    with cluster(tmp_path, certificate) as (address, variables, scheduler):
        words = ("run", path, "--out", out, "--executor", address)
        if who == "parent":
            code, _, err = call("run", path, "--out", tmp_path / "other", "--executor", address)
            assert code == 2
            assert "TLS certificates here" in err
            assert "Traceback" not in err
        process = start(*words, **variables)
        wait_for(process, lambda: list(out.glob("parts/part-*")))
        (process if who == "parent" else scheduler).kill()
        _, err = process.communicate(timeout=600)
        assert process.returncode == {"parent": -9, "scheduler": 2}[who], err
        if who == "parent":
            assert call(*words, **variables)[0] == 0
    if who == "scheduler":
        assert "give the same command: parts that are written stay" in err
        assert "Traceback" not in err.partition("piga: ")[2]
        assert call("run", path, "--out", out, "--workers", 2)[0] == 0
    assert collected(out) == uninterrupted
