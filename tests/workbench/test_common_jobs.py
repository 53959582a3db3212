"""Jobs: what becomes of them, whatever becomes of the server."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from piga.errors import ArgumentError
from piga.workbench.common import Job, Jobs
from tests.workbench.conftest import entered, shipped_record, wait_until


def ended(job: Job, seconds: float = 120.0) -> str:
    wait_until(lambda: job.state != "running", seconds)
    return job.state


@pytest.fixture
def jobs(tmp_path: Path) -> Iterator[Jobs]:
    shipped_record(tmp_path)
    made = Jobs(tmp_path)
    yield made
    made.stop_all()


@pytest.mark.long
def test_a_job_is_the_command(jobs: Jobs, tmp_path: Path) -> None:
    job = jobs.start(("check", "tumble-a.toml", "--json"), "Check", "tumble-a.toml")
    assert ended(job) == "done"
    assert json.loads(job.text("out"))["serial"] == "tumble-a"
    refused = jobs.start(("check", "none.toml"), "Check", "none.toml")
    assert ended(refused) == "failed"
    assert refused.child.returncode == 2
    assert "none.toml" in refused.text("err")
    assert "Traceback" not in refused.text("err")
    assert jobs.all()[-1] is job


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="processes are halted by a signal of POSIX")
def test_the_same_asked_twice_is_one_job(jobs: Jobs) -> None:
    """A second tab or a double click."""

    def asked(place: str, *options: str) -> Job:
        command = ("calibrate", "tumble-a.toml", *options, "--out", place)
        job = jobs.start(command, "Calibrate", "tumble-a.toml", place)
        os.kill(job.child.pid, signal.SIGSTOP)  # it runs until the end of the test
        return job

    first = asked("a")
    try:
        assert asked("a") == first
        with pytest.raises(ArgumentError, match="other options"):
            asked("a", "--terms=k0")
        assert asked("c", "--terms=k0") != first
    finally:
        for job in jobs.all():
            os.kill(job.child.pid, signal.SIGCONT)
        jobs.stop_all()


def test_a_stop_leaves_nothing(jobs: Jobs, tmp_path: Path) -> None:
    job = jobs.start(("calibrate", "tumble-a.toml", "--out", "out"), "Calibrate", "tumble-a.toml", "out")
    jobs.stop(job)
    assert job.state == "stopped"
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".out*"))


@pytest.mark.skipif(sys.platform != "linux", reason="processes are listed from /proc")
def test_a_job_ends_when_its_server_is_killed(tmp_path: Path) -> None:
    shipped_record(tmp_path)
    server = entered(tmp_path)
    server.client.page("/record/tumble-a.toml")
    wait_until(lambda: len(jobs_in(tmp_path)) > 1)
    server.process.kill()
    server.process.communicate()
    wait_until(lambda: not jobs_in(tmp_path))


def jobs_in(folder: Path) -> list[int]:
    """Process numbers of the jobs that run or wait in a folder."""
    numbers = []
    for place in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            words = (place / "cmdline").read_bytes()
            if b"piga.cli.job" in words and (place / "cwd").resolve() == folder:
                numbers.append(int(place.name))
    return numbers


@pytest.mark.long
def test_a_server_that_is_killed_in_an_upload_leaves_no_half_file(tmp_path: Path) -> None:
    import socket

    first = entered(tmp_path)
    home = f"127.0.0.1:{first.client.port}"
    with socket.create_connection(("127.0.0.1", first.client.port), timeout=20) as raw:
        head = f"POST /upload?name=half.csv HTTP/1.1\r\nHost: {home}\r\nOrigin: http://{home}\r\n"
        raw.sendall(
            f"{head}Cookie: {first.client.cookie}\r\nContent-Length: 99999\r\n\r\nt,x\r\n0,1\r\n".encode()
        )
        parts = tmp_path / ".piga-ui" / "parts"
        wait_until(lambda: list(parts.glob("*")))  # the folder is made on demand
        first.process.kill()
        first.process.communicate()
    assert list(parts.glob("*"))
    assert [path.name for path in tmp_path.iterdir()] == [".piga-ui"]
    second = entered(tmp_path)
    assert not list(parts.glob("*"))
    assert "three steps" in second.client.page("/")
    assert second.end() == (0, "")
