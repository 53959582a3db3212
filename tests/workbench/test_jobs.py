"""Jobs: what becomes of them, whatever becomes of the server."""

from __future__ import annotations

import http.client
import json
import os
import signal
import time
from pathlib import Path

import pytest

from piga.errors import ArgumentError
from piga.workbench.jobs import BusyError, Job, Jobs, Status
from tests.workbench.conftest import Server, entered, shipped_record, wait_until


def ended(jobs: Jobs, job: Job, seconds: float = 120.0) -> Status:
    wait_until(lambda: jobs.status(job).state != "running", seconds)
    return jobs.status(job)


@pytest.fixture
def jobs(tmp_path: Path) -> Jobs:
    shipped_record(tmp_path)
    return Jobs(tmp_path / "jobs", tmp_path)


@pytest.mark.only_compiled
def test_a_job_is_the_command(jobs: Jobs, tmp_path: Path) -> None:
    job = jobs.start(("check", "tumble-a.toml", "--json"), "Check", "tumble-a.toml")
    status = ended(jobs, job)
    assert (status.state, status.code) == ("done", 0)
    assert json.loads(jobs.text(job, "out"))["serial"] == "tumble-a"
    again = Jobs(tmp_path / "jobs", tmp_path)
    assert again.all() == [job]
    assert again.status(job).state == "done"
    refused = jobs.start(("check", "none.toml"), "Check", "none.toml")
    assert ended(jobs, refused).code == 2
    assert "none.toml" in jobs.text(refused, "err")
    assert "Traceback" not in jobs.text(refused, "err")
    assert [one.key for one in jobs.all()][-1] == job.key


@pytest.mark.only_compiled
def test_the_same_asked_twice_is_one_job_unless_the_record_changed(jobs: Jobs, tmp_path: Path) -> None:
    """A second tab or a double click, each with a place of its own for the results."""

    record = tmp_path / "tumble-a.csv"

    def asked(place: str, *options: str) -> Job:
        command = ("calibrate", "tumble-a.toml", *options, "--out", place)
        return jobs.start(command, "Calibrate", "tumble-a.toml", place, [record])

    first = asked("a")
    try:
        assert asked("b") == asked("a") == first
        with pytest.raises(BusyError, match="other options"):
            asked("a", "--terms=k0")
        other = asked("c", "--terms=k0")
        record.touch()
        with pytest.raises(BusyError, match="another input"):
            asked("a")
        anew = asked("d")
        assert len({job.key for job in (first, other, anew)}) == 3
        assert asked("a") == anew
        check = (
            "calibrate",
            "tumble-a.toml",
            "--out",
            "e",
        )  # a preview and the thing itself have the same options
        assert jobs.start(check, "Preview", "tumble-a.toml", "e", [record]).key != anew.key
    finally:
        jobs.stop_all()


def test_the_state_may_be_removed_meanwhile(tmp_path: Path) -> None:
    jobs = Jobs(tmp_path / "jobs", tmp_path)
    (tmp_path / "jobs").rmdir()
    assert jobs.all() == []
    jobs.stop_all()
    assert jobs.start(("check", "none.toml"), "Check", "none.toml").key
    jobs.stop_all()


def test_a_stop_leaves_nothing(jobs: Jobs, tmp_path: Path) -> None:
    job = jobs.start(("calibrate", "tumble-a.toml", "--out", "out"), "Calibrate", "tumble-a.toml", "out")
    assert (
        jobs.start(("calibrate", "tumble-a.toml", "--out", "out"), "Calibrate", "tumble-a.toml", "out") == job
    )
    jobs.stop(job)
    assert jobs.status(job).state == "stopped"
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".out*"))


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_a_job_that_is_killed_is_lost_and_another_process_is_not_taken_for_it(jobs: Jobs) -> None:
    job = jobs.start(("calibrate", "tumble-a.toml", "--out", "out"), "Calibrate", "tumble-a.toml", "out")
    os.kill(job.pid, signal.SIGKILL)
    assert ended(jobs, job).state == "lost"
    stranger = Job("stranger", ("calibrate",), "Calibrate", "x", pid=os.getpid(), born="1")
    assert jobs.status(stranger).state == "lost"
    jobs.stop(stranger)  # does not signal this process


@pytest.mark.only_compiled
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_the_server_is_killed_and_its_job_goes_on(tmp_path: Path) -> None:
    shipped_record(tmp_path)
    first = entered(tmp_path)
    status, headers, _ = first.client.post(
        "/calibrate/tumble-a.toml", {"term": ["scale_factor", "tan_beta", "k0"]}
    )
    assert status == 303
    first.process.kill()
    first.process.communicate()
    second = entered(tmp_path)
    page = headers["location"].replace("/result/", "/jobs/")
    assert "lost" not in second.client.page(page)
    second.client.until(page, lambda text: '"state running"' not in text)
    assert "state done" in second.client.page(page)
    assert len(list((tmp_path / ".piga-ui" / "trials").glob("*/calibration.json"))) == 1
    assert second.end() == (0, "")


def test_progress_is_a_small_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from piga.cli import common, job

    monkeypatch.setattr(job, "BETWEEN", 0.0)
    note = job.Note(tmp_path / "progress", "reading", None)
    assert json.loads((tmp_path / "progress").read_text()) == {"what": "reading", "share": None}
    advance = common.Advance(None, note.show)
    advance(25, 100)
    advance(25)
    assert json.loads((tmp_path / "progress").read_text())["share"] == 0.5
    note.show(3, 4, "draws")
    assert json.loads((tmp_path / "progress").read_text()) == {"what": "reading: draws", "share": 0.75}


@pytest.mark.only_compiled
def test_only_so_many_run_and_only_so_many_are_kept(jobs: Jobs, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("piga.workbench.jobs.MOST_RUNNING", 1)
    monkeypatch.setattr("piga.workbench.jobs.MOST_KEPT", 1)
    job = jobs.start(("calibrate", "tumble-a.toml", "--out", "out"), "Calibrate", "tumble-a.toml", "out")
    with pytest.raises(ArgumentError, match="running"):
        jobs.start(("check", "tumble-a.toml"), "Check", "tumble-a.toml")
    jobs.stop(job)
    time.sleep(1.1)  # keys begin with the second
    after = jobs.start(("check", "tumble-a.toml"), "Check", "tumble-a.toml")
    assert jobs.all() == [after]
    ended(jobs, after)


def test_many_pages_may_ask_at_the_same_time(jobs: Jobs) -> None:
    from concurrent.futures import ThreadPoolExecutor

    job = jobs.start(("check", "none.toml"), "Check", "none.toml")
    with ThreadPoolExecutor(8) as pool:
        while True:
            states = list(pool.map(lambda _: jobs.status(job).state, range(64)))
            if states[-1] != "running":
                break
    assert set(states) <= {"running", "failed"}


@pytest.mark.only_compiled
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_a_job_that_is_killed_while_it_writes_leaves_the_older_results_whole(
    jobs: Jobs, tmp_path: Path
) -> None:
    command = ("calibrate", "tumble-a.toml", "--out", "out", "--force")
    assert ended(jobs, jobs.start(command, "Calibrate", "tumble-a.toml", "out")).state == "done"

    def shown() -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in (tmp_path / "out").glob("[!.]*")}

    before = shown()
    job = jobs.start(command, "Calibrate", "tumble-a.toml", "out")
    while not list((tmp_path / "out").glob(".piga-stage-*/*")):  # a result is being written there
        assert jobs.status(job).state == "running"
    os.kill(job.pid, signal.SIGKILL)
    assert ended(jobs, job).state == "lost"
    assert shown() == before
    assert ended(jobs, jobs.start(command, "Calibrate", "tumble-a.toml", "out")).state == "done"
    assert set(shown()) == set(before)
    assert not list((tmp_path / "out").glob(".piga-stage-*"))


@pytest.mark.only_compiled
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
        wait_until(lambda: list(parts.iterdir()))
        first.process.kill()
        first.process.communicate()
    assert list(parts.iterdir())
    assert [path.name for path in tmp_path.iterdir()] == [".piga-ui"]
    second = entered(tmp_path)
    assert not list(parts.iterdir())
    assert "no record in this folder" in second.client.page("/")
    assert second.end() == (0, "")


KILLED = """
import os
from pathlib import Path
from piga.cli.main import main
left = {left}
def counted(move):
    def moved(self, target):
        global left
        if ".piga-stage-" in str(self):
            if not left:
                os.kill(os.getpid(), 9)
            left -= 1
        return move(self, target)
    return moved
Path.rename, Path.replace = counted(Path.rename), counted(Path.replace)
main()
"""
"""A ``piga ui`` that is killed before a certain move of a hidden result: first the folder's, then each file's."""


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.only_compiled
@pytest.mark.parametrize("left", [0, 2, 4])
def test_a_server_that_is_killed_while_a_result_is_kept(tmp_path: Path, left: int) -> None:
    """The next start finds the former results or the new ones, never some of each; the trial is still there."""
    shipped_record(tmp_path)
    names = ("calibration.json", "report.html", "residuals.parquet")
    kept = tmp_path / "tumble-a-calibration"
    kept.mkdir()
    for name in (*names, "summary-old.json"):
        (kept / name).write_text('{"of": "the former"}', encoding="utf-8")
    trial = tmp_path / ".piga-ui" / "trials" / "0123456789ab"
    trial.mkdir(parents=True)
    for name in names:
        (trial / name).write_text('{"of": "the new"}', encoding="utf-8")
    place = tmp_path / ".piga-ui" / "jobs" / "20990101-000000-abcdef"
    place.mkdir(parents=True)
    result = ".piga-ui/trials/0123456789ab"
    job = {"command": ["calibrate", "tumble-a.toml", "--out", result], "title": "Calibrate", "result": result}
    (place / "job.json").write_text(json.dumps(job | {"key": "", "subject": "tumble-a.toml"}), encoding="utf-8")
    (place / "end.json").write_text(json.dumps({"code": 0, "seconds": 1.0}), encoding="utf-8")

    def shown() -> dict[str, str]:
        return {path.name: path.read_text(encoding="utf-8") for path in kept.iterdir() if path.name[0] != "."}

    before = shown()
    first = Server(tmp_path, program=("-c", KILLED.format(left=left)))
    first.client.enter()
    with pytest.raises((http.client.HTTPException, ConnectionError)):
        first.client.post(f"/result/{place.name}/adopt")
    first.process.communicate(timeout=20)
    assert first.process.returncode == -signal.SIGKILL
    second = entered(tmp_path)
    after = shown()
    assert after == (before if left == 0 else {path.name: path.read_text() for path in trial.iterdir()})
    assert second.client.post(f"/result/{place.name}/adopt")[0] == 303
    assert shown() == {path.name: path.read_text() for path in trial.iterdir()}
    assert not list(kept.glob(".piga-stage-*"))
    assert second.end() == (0, "")
