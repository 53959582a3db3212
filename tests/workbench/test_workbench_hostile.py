"""Hostile folders, names and connections: what a stranger's files and half requests can do."""

from __future__ import annotations

import json
import os
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.parse import quote

import pytest

from piga.workbench.folder import Folder, OutsideError
from piga.workbench.jobs import MOST_RUNNING
from tests.workbench.conftest import Client, Server, entered, shipped_record, wait_until
from tests.workbench.size import memory

EVIL = "\"'><img src=x onerror=alert(1)></textarea><script>alert(1)</script>{{7*7}}"
RAW = ("<img src=x", "<script>alert", "</textarea><s", ">49<")


def raw_answer(client: Client, request: str, size: int = 400) -> bytes:
    with socket.create_connection(("127.0.0.1", client.port), timeout=20) as raw:
        raw.sendall(request.encode())
        return raw.recv(size)


@pytest.mark.parametrize(
    "head",
    [
        "GET / HTTP/1.0\r\n\r\n",
        "GET / HTTP/1.1\r\n\r\n",
        "GET http://evil.example/ HTTP/1.1\r\nHost: evil.example\r\n\r\n",
        "GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}@evil.example\r\n\r\n",
        "GET / HTTP/1.1\r\nHost: 127.1:{port}\r\n\r\n",
        "GET / HTTP/1.1\r\nHost: 0x7f000001:{port}\r\n\r\n",
        "GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nHost: evil.example\r\nCookie: {cookie}\r\n\r\n",
        "GET / HTTP/1.1\r\nHost: evil.example\r\nX-Forwarded-Host: 127.0.0.1:{port}\r\nCookie: {cookie}\r\n\r\n",
        "GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nCookie: {cookie}\r\nCookie: {cookie}\r\n\r\n",
        "POST / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nContent-Length: 3\r\nTransfer-Encoding: chunked\r\n\r\nabc",
        "GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nX: " + "a" * 100_000 + "\r\n\r\n",
        "GET /" + "a" * 100_000 + " HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n",
        "\x16\x03\x01\x02\x00\x01\x00",
    ],
)  # fmt: skip
def test_heads_that_are_none(client: Client, head: str) -> None:
    request = head.replace("{port}", str(client.port)).replace("{cookie}", client.cookie)
    answer = raw_answer(client, request)
    assert answer.split()[1:2] in ([b"400"], [b"421"], [b"403"], [b"431"]), answer[:80]
    assert b"Records" not in answer


def test_half_requests_keep_nobody_out(client: Client, server: Server) -> None:
    held = []
    try:
        for number in range(120):
            raw = socket.create_connection(("127.0.0.1", client.port), timeout=20)
            head = f"POST /upload?name=slow.csv HTTP/1.1\r\nHost: 127.0.0.1:{client.port}\r\n"
            session = f"Cookie: {client.cookie}\r\nOrigin: http://127.0.0.1:{client.port}\r\nContent-Length: 999999\r\n\r\nt,x"
            raw.sendall((head if number % 2 else head + session).encode())
            held.append(raw)
        started = time.monotonic()
        assert "Records" in client.page("/")
        assert time.monotonic() - started < 10.0
    finally:
        for raw in held:
            raw.close()
    wait_until(lambda: not list((server.folder / ".piga-ui" / "parts").iterdir()))
    assert not list(server.folder.glob("*slow*"))
    assert "Records" in client.page("/")


@pytest.mark.only_compiled
def test_fifty_jobs_at_once(tmp_path: Path) -> None:
    """So many run as may run. The others are told so, and the server goes on answering."""
    shipped_record(tmp_path)
    running = entered(tmp_path)
    try:
        running.client.page("/calibrate/tumble-a.toml")
        with ThreadPoolExecutor(50) as pool:
            sent = [
                pool.submit(running.client.post, "/calibrate/tumble-a.toml", {"term": [f"s{n}", f"c{n}"]})
                for n in range(1, 51)
            ]
            while not all(answer.done() for answer in sent):
                started = time.monotonic()
                assert running.client.page("/healthz") == "ok\n"
                assert time.monotonic() - started < 5.0
        answers = [answer.result() for answer in sent]
        assert sorted(status for status, _, _ in answers) == [303] * MOST_RUNNING + [429] * (50 - MOST_RUNNING)
        assert all(
            f"{MOST_RUNNING} jobs are running".encode() in body for status, _, body in answers if status == 429
        )
    finally:
        assert running.end() == (0, "")
    assert not list(tmp_path.glob(".piga-ui/trials/*"))


SMALL = "from piga.workbench.pages import records; records.MOST_UPLOAD = 4 << 20; from piga.cli.main import main; main()"


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")
@pytest.mark.parametrize("declared", [True, False])
def test_an_upload_without_end_is_cut_off(tmp_path: Path, declared: bool) -> None:
    """Whether it says its length or comes in pieces."""
    running = Server(tmp_path, program=("-c", SMALL))
    client = running.client
    client.enter()
    client.page("/")
    before = memory(running.process.pid)
    head = f"POST /upload?name=endless.csv HTTP/1.1\r\nHost: 127.0.0.1:{client.port}\r\n"
    head += f"Cookie: {client.cookie}\r\nOrigin: http://127.0.0.1:{client.port}\r\n"
    head += f"Content-Length: {64 << 20}\r\n\r\n" if declared else "Transfer-Encoding: chunked\r\n\r\n"
    piece = b"x" * (1 << 20)
    piece = piece if declared else b"%x\r\n%b\r\n" % (len(piece), piece)
    with socket.create_connection(("127.0.0.1", client.port), timeout=20) as raw:
        raw.sendall(head.encode())
        for _ in range(0 if declared else 64):
            raw.sendall(piece)
        answer = raw.recv(4000)
    assert answer.startswith(b"HTTP/1.1 413 ")
    assert client.page("/healthz") == "ok\n"
    assert memory(running.process.pid) - before < 30.0
    assert not list((tmp_path / ".piga-ui" / "parts").iterdir())
    assert [path.name for path in tmp_path.iterdir()] == [".piga-ui"]
    assert running.end() == (0, "")


@pytest.mark.parametrize(
    "path",
    [
        "/jobs/..%2f..%2fetc", "/jobs/%2e%2e", "/assets/..%2fapp.py", "/assets/%2e%2e/app.py", "/result/../jobs",
        "/signals/%252e%252e%252fsecret.toml", "/signals/..%c0%af..%c0%afsecret.toml", "/signals/tumble-a.toml%00.csv",
        "/describe/%2fetc%2fpasswd", "/describe/..%5csecret.toml", "/describe//etc/passwd", "/describe/./.piga-ui/x.toml",
        "/plan?file=..%2fsecret.toml", "/plan?file=%2fetc%2fpasswd", "/plan?file=.piga-ui", "/twin?file=tumble-a.csv%2f..",
        "/compensate/..%2fsecret.toml", "/term-prospects/..%2fsecret.toml",
        "/signal-data/..%2fsecret.toml?keys=output&from=0&to=1&width=10",
        "/describe/" + "a" * 5000, "/describe/" + "a/" * 2000,
    ],
)  # fmt: skip
def test_paths_that_lead_out(client: Client, server: Server, path: str) -> None:
    (server.folder.parent / "secret.toml").write_text("secret = 'k7Qz'\n", encoding="utf-8")
    status, _, body = client.ask(path)
    assert status in (404, 422), (path, status)
    assert b"k7Qz" not in body
    assert b"root:" not in body
    assert b"Traceback" not in body


def test_a_name_that_looks_like_an_option_is_refused(client: Client, server: Server) -> None:
    text = (server.folder / "tumble-a.toml").read_text(encoding="utf-8")
    path = server.folder / "--out=owned.toml"
    path.write_text(text, encoding="utf-8")
    try:
        assert client.post(f"/calibrate/{quote(path.name)}", {"term": "k0"})[0] == 404
        assert client.ask(f"/signals/{quote(path.name)}")[0] == 404
        assert "--out=owned.toml" in client.page("/")
    finally:
        path.unlink()
    with pytest.raises(OutsideError):
        Folder(server.folder).path("sub/-x.toml")


@pytest.mark.only_compiled
def test_every_page_escapes_what_files_say(tmp_path: Path) -> None:
    run = shipped_record(tmp_path)
    rows = (tmp_path / "tumble-a.csv").read_text(encoding="utf-8").splitlines()
    evil = EVIL.replace('"', "'").replace(",", "")
    rows[0] = rows[0].replace("position", evil)
    (tmp_path / "tumble-a.csv").write_text("\n".join(rows[:3000]) + "\n", encoding="utf-8")
    (tmp_path / "open.csv").write_text("\n".join(rows[:50]) + "\n", encoding="utf-8")
    text = run.read_text(encoding="utf-8")
    quoted = json.dumps(EVIL)
    text = text.replace('"position"', json.dumps(evil)).replace('serial = "tumble-a"', f"serial = {quoted}")
    run.write_text(text, encoding="utf-8")
    for name in ("plan-dividing-head.toml", "platform-published.toml", "twin.toml", "certificate.toml"):
        example = (Path("examples") / name).read_text(encoding="utf-8")
        (tmp_path / name).write_text(f"# {EVIL}\n{example}", encoding="utf-8")
    kept = tmp_path / "x-calibration"
    kept.mkdir()
    (kept / "calibration.json").write_text(json.dumps({"instrument": {"serial": EVIL}}), encoding="utf-8")
    running = entered(tmp_path)
    try:
        pages = ["/", "/jobs", "/instrument", "/plan", "/twin", "/platform", "/describe/tumble-a.toml"]
        pages += [
            "/describe/open.csv",
            "/calibrate/tumble-a.toml",
            "/compensate/tumble-a.toml",
        ]
        pages += [
            f"/explore?a_x={quote(EVIL)}",
            f"/plan?file={quote(EVIL)}",
            f"/jobs/{quote(EVIL)}",
            f"/signals/{quote(EVIL)}",
        ]
        for page in pages:
            status, _, body = running.client.ask(page)
            assert status in (200, 404, 422), (page, status)
            for wrong in RAW:
                assert wrong not in body.decode(), (page, wrong)
        running.client.until(
            "/describe/tumble-a.toml", lambda page: "The record is read and checked" not in page
        )
        prospects = running.client.until(
            "/term-prospects/tumble-a.toml", lambda page: "is asked which terms" not in page
        )
        signals = running.client.until("/signals/tumble-a.toml", lambda page: "is read and checked" not in page)
        for body in (prospects, signals, running.client.page("/describe/tumble-a.toml")):
            assert not [wrong for wrong in RAW if wrong in body]
    finally:
        assert running.end() == (0, "")


@pytest.mark.skipif(os.name == "nt", reason="links of POSIX")
def test_state_folders_that_lead_out_are_refused(tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    lab = tmp_path / "lab"
    (lab / ".piga-ui").mkdir(parents=True)
    (lab / ".piga-ui" / "signals").symlink_to(outside)
    with pytest.raises(OutsideError):
        Folder(lab).state_room("signals")
    assert not list(outside.iterdir())


@pytest.mark.skipif(os.name == "nt", reason="links of POSIX")
def test_results_are_not_written_through_a_link_that_leads_out(tmp_path: Path) -> None:
    outside, lab = tmp_path / "outside", tmp_path / "lab"
    outside.mkdir()
    lab.mkdir()
    shipped_record(lab)
    kept = lab / "x-calibration"
    kept.mkdir()
    (kept / "calibration.json").write_text(json.dumps({"instrument": {"serial": "x"}}), encoding="utf-8")
    for name in ("tumble-a-calibration", "reproduction", "trend-x", "certificate-x-calibration", "p-plan"):
        (lab / name).symlink_to(outside)
    running = entered(lab)
    try:
        for path, fields in (
            ("/explore/reproduce", {}),
            ("/instrument/trend", {"serial": "x"}),
            ("/plan", {"name": "p", "text": "a = 1", "do": "plan"}),
            (
                "/certificate",
                {"name": "c", "text": "a = 1", "calibration": "x-calibration/calibration.json", "do": "issue"},
            ),
        ):
            status, _, body = running.client.post(path, fields)
            assert status == 404, (path, status)
            assert b"is not a regular file of this folder" in body, path
    finally:
        assert running.end() == (0, "")
    assert not list(outside.iterdir())
