"""Hostile folders, names and connections: what a stranger's files and half requests can do."""

from __future__ import annotations

import json
import os
import socket
import time
from pathlib import Path
from urllib.parse import quote

import pytest

from piga.workbench.folder import Folder, OutsideError
from tests.reports.example import calibration
from tests.workbench.conftest import Client, Server, entered, memory, shipped_record, wait_until

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
        "GET / HTTP/1.1\r\nHost: 127.0.0.1.evil.example:{port}\r\nCookie: {cookie}\r\n\r\n",
        "GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: {cookie}\r\n\r\n",
        "GET / HTTP/1.1\r\nHost: 127.1:{port}\r\n\r\n",
        "GET / HTTP/1.1\r\nHost: 0x7f000001:{port}\r\n\r\n",
        "GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nHost: evil.example\r\nCookie: {cookie}\r\n\r\n",
        "GET / HTTP/1.1\r\nHost: evil.example\r\nX-Forwarded-Host: 127.0.0.1:{port}\r\nCookie: {cookie}\r\n\r\n",
        "GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nCookie: {cookie}\r\nCookie: {cookie}\r\n\r\n",
        ("GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nOrigin: http://evil.example\r\n"
         "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\nCookie: {cookie}\r\n\r\n"),
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
    assert b"bench" not in answer


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
        assert "tumble-a" in client.page("/record/tumble-a.toml")
        assert time.monotonic() - started < 10.0
    finally:
        for raw in held:
            raw.close()
    wait_until(lambda: not list((server.folder / ".piga-ui" / "parts").iterdir()))
    assert not list(server.folder.glob("*slow*"))
    assert "tumble-a" in client.page("/record/tumble-a.toml")


SMALL = (
    "from piga.workbench import record; record.MOST_UPLOAD = 4 << 20; from piga.cli.main import main; main()"
)


@pytest.mark.long
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
        for _ in range(64):
            raw.sendall(piece)
        answer = raw.recv(4000)
    assert answer.startswith(b"HTTP/1.1 422 ")
    assert client.page("/healthz") == "ok\n"
    assert memory(running.process.pid) - before < 30.0
    assert not list((tmp_path / ".piga-ui").glob("parts/*"))
    assert [path.name for path in tmp_path.iterdir()] == [".piga-ui"]
    assert running.end() == (0, "")


@pytest.mark.parametrize(
    "path",
    [
        "/jobs/..%2f..%2fetc", "/jobs/%2e%2e", "/assets/..%2fapp.py", "/assets/%2e%2e/app.py",
        "/file/.piga-ui/trials/../tags.json", "/file/.piga-ui/trials/%2e%2e/%2e%2e/%2e%2e/secret.toml", "/file/.piga-ui/tags.json",
        "/file/../secret.toml", "/file//etc/passwd", "/file/.piga-ui",
        "/record/%252e%252e%252fsecret.toml", "/record/..%c0%af..%c0%afsecret.toml", "/record/tumble-a.toml%00.csv",
        "/log/%2fetc%2fpasswd", "/log/..%5csecret.toml", "/log//etc/passwd", "/log/./.piga-ui/x.toml",
        "/kept/..", "/kept/..%2fsecret",
        "/text?file=..%2fsecret.toml", "/text?file=%2fetc%2fpasswd", "/text?file=.piga-ui", "/text?file=tumble-a.csv%2f..",
        "/text?example=..%2fx",
        "/certificate?of=..%2fsecret", "/compare?of=..&of=../x",
        "/signal-data/..%2fsecret.toml?keys=output&from=0&to=1&width=10", "/file/tumble-a.csv/x",
        "/record/" + "a" * 5000, "/log/" + "a/" * 2000,
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
        assert client.post(f"/record/{quote(path.name)}", {"do": "again"})[0] == 404
        assert client.ask(f"/record/{quote(path.name)}")[0] == 404
    finally:
        path.unlink()
    with pytest.raises(OutsideError):
        Folder(server.folder).path("sub/-x.toml")


@pytest.mark.long
def test_every_page_escapes_what_files_say(tmp_path: Path) -> None:
    run = shipped_record(tmp_path)
    rows = (tmp_path / "tumble-a.csv").read_text(encoding="utf-8").splitlines()
    evil = EVIL.replace('"', "'").replace(",", "")
    rows[0] = rows[0].replace("position", evil)
    (tmp_path / "tumble-a.csv").write_text("\n".join(rows[:3000]) + "\n", encoding="utf-8")
    (tmp_path / "open.csv").write_text("\n".join(rows[:50]) + "\n", encoding="utf-8")
    text = run.read_text(encoding="utf-8")
    text = text.replace('"position"', json.dumps(evil)).replace(
        'serial = "tumble-a"', f"serial = {json.dumps(EVIL)}"
    )
    text = text.replace("[model]", f"leave_out = [{{ rows = [5, 9], reason = {json.dumps(EVIL)} }}]\n[model]")
    run.write_text(text, encoding="utf-8")
    example = (Path("examples") / "certificate.toml").read_text(encoding="utf-8")
    changed = example.replace('"12 Meridian Road"', json.dumps(EVIL))
    (tmp_path / "certificate.toml").write_text(f"# {EVIL}\n{changed}", encoding="utf-8")
    for name in ("tumble-a-calibration", "tumble-a-calibration-v1"):
        (tmp_path / name).mkdir()
        calibration(serial=EVIL, with_residuals=False).to_json(tmp_path / name / "calibration.json")
    running = entered(tmp_path)
    try:
        client = running.client
        client.post("/tag", {"name": "tumble-a.toml", "tags": "<script>alert(1)</script>"})
        client.until("/record/tumble-a.toml", lambda text: "data-drawn" in text)
        kept = "tumble-a-calibration"
        pages = [
            "/jobs", "/record/tumble-a.toml", "/log/open.csv", "/text?file=certificate.toml", f"/kept/{kept}",
            f"/certificate?of={kept}", f"/compare?of={kept}&of={kept}-v1", f"/plan?of={kept}",
        ]  # fmt: skip
        given = ("explore?a_x=", "text?file=", "jobs/", "record/", "log/", "kept/")
        pages += [f"/{page}{quote(EVIL)}" for page in given]
        for page in pages:
            status, _, body = client.ask(page)
            assert status in (200, 404, 422), (page, status)
            for wrong in RAW:
                assert wrong not in body.decode(), (page, wrong)
        assert "alert(1)" in client.page("/record/tumble-a.toml")
        _, _, body = client.post(
            "/log/open.csv", {"instrument.scale_factor": EVIL, "u:instrument.scale_factor": EVIL}
        )
        assert not [wrong for wrong in RAW if wrong in body.decode()]
    finally:
        assert running.end() == (0, "")


@pytest.mark.long
@pytest.mark.skipif(os.name == "nt", reason="links and pipes of POSIX")
def test_a_strangers_folder_neither_hangs_nor_is_left(tmp_path: Path) -> None:
    """Pipes and links in place of results, a sparse file of 20 GiB, names of a hundred Chinese letters."""
    lab, outside = tmp_path / "lab", tmp_path / "outside"
    lab.mkdir()
    outside.mkdir()
    (outside / "calibration.json").write_text("k7Qz", encoding="utf-8")
    run = shipped_record(lab)
    (lab / "pipe-calibration").mkdir()
    os.mkfifo(lab / "pipe-calibration" / "calibration.json")
    (lab / "large-calibration").mkdir()
    for path in (lab / "large-calibration" / "calibration.json", lab / "huge.toml", lab / "huge.csv"):
        with path.open("wb") as stream:
            stream.truncate(20 << 30)
    (lab / "tumble-a-calibration").symlink_to(outside)
    (lab / "link.toml").symlink_to(outside / "calibration.json")
    os.mkfifo(lab / "certificate.toml")
    os.mkfifo(lab / "pipe.csv")
    chinese = "\u53f0" * 80
    (lab / f"{chinese}.toml").write_bytes(run.read_bytes())
    (lab / ".piga-ui").mkdir(mode=0o700)
    os.mkfifo(lab / ".piga-ui" / "tags.json")
    running = entered(lab)
    try:
        pages = [
            "/", "/record/tumble-a.toml", f"/record/{quote(chinese)}.toml", "/log/huge.csv", "/log/pipe.csv",
            "/text?file=huge.toml", "/kept/pipe-calibration", "/kept/large-calibration", "/kept/tumble-a-calibration",
            "/text?file=link.toml", "/certificate",
            "/file/tumble-a-calibration/calibration.json", "/certificate?of=pipe-calibration",
        ]  # fmt: skip
        for page in pages:
            started = time.monotonic()
            status, _, body = running.client.ask(page)
            assert status in (200, 303, 404, 422), (page, status)
            assert time.monotonic() - started < 20.0, page
            assert b"k7Qz" not in body, page
        assert running.client.post("/kept/tumble-a-calibration/discard")[0] == 404
        name = quote(f"{chinese}{chinese}.csv")
        headers = {"Origin": running.client.home}
        assert running.client.ask(f"/upload?name={name}", "POST", b"t,x\n0,1\n", headers)[0] == 200
    finally:
        assert running.end() == (0, "")
    assert (outside / "calibration.json").is_file()


@pytest.mark.skipif(os.name == "nt", reason="links of POSIX")
def test_results_are_not_written_through_a_link_that_leads_out(tmp_path: Path) -> None:
    outside, lab = tmp_path / "outside", tmp_path / "lab"
    outside.mkdir()
    lab.mkdir()
    shipped_record(lab)
    for name in ("certificate-7", "plan-tumble-a"):
        (lab / name).symlink_to(outside)
    (lab / "tumble-a-calibration").mkdir()
    calibration(serial="tumble-a", with_residuals=False).to_json(
        lab / "tumble-a-calibration" / "calibration.json"
    )
    running = entered(lab)
    try:
        fields = {"hours": "1", "u:hours": "h"}
        assert running.client.post("/plan?of=tumble-a-calibration", fields)[0] == 404
    finally:
        assert running.end() == (0, "")
    assert not list(outside.iterdir())
