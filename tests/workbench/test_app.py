"""Hostile requests: each is refused by a real server."""

from __future__ import annotations

import json
import signal
import sys
import time
from pathlib import Path
from urllib.parse import quote

import pytest

from piga.errors import ArgumentError
from piga.workbench.app import SESSION_AGE, Door, open_browser
from piga.workbench.common import Jobs
from piga.workbench.folder import Folder, OutsideError
from tests.workbench.conftest import Client, Server, entered, wait_until
from tests.workbench.test_common_jobs import jobs_in


def test_every_change_names_its_origin(client: Client) -> None:
    run = "/record/tumble-a.toml"
    for headers in (
        {},
        {"Origin": "null"},
        {"Origin": "http://evil.example"},
        {"Origin": f"https://127.0.0.1:{client.port}"},
        {"Origin": f"http://127.0.0.1:{client.port + 1}"},
        {"Origin": f"http://127.0.0.1:{client.port}.evil.example"},
    ):
        for method in ("POST", "PUT", "DELETE"):
            assert client.ask(run, method, b"term=k0", headers)[0] == 403, (method, headers)
    assert client.ask("/", headers={"Origin": "http://evil.example"})[0] == 403


def test_other_sites_cannot_load_pages_or_data(client: Client) -> None:
    for site in ("cross-site", "same-site"):
        assert client.ask("/jobs", headers={"Sec-Fetch-Site": site})[0] == 403
        assert client.ask("/jobs", headers={"Sec-Fetch-Site": site, "Sec-Fetch-Mode": "navigate"})[0] == 403
    assert client.ask("/jobs", headers={"Sec-Fetch-Site": "same-origin"})[0] == 200
    assert client.ask("/jobs", host=f"localhost:{client.port}")[0] == 200


def test_the_token_is_good_once_and_the_cookie_is_out_of_reach(server: Server) -> None:
    stranger = Client(server.client.port, server.client.token)
    assert stranger.ask("/")[0] == 403
    assert stranger.ask(f"/?token={server.client.token}")[0] == 403  # used by the fixture
    assert stranger.ask("/?token=wrong")[0] == 403
    assert stranger.ask("/?token=%FF%C3%A9")[0] == 403
    assert stranger.ask("/healthz")[::2] == (200, b"ok\n")
    assert stranger.ask("/assets/workbench.css")[0] == 403
    stranger.cookie = f"other=a b; piga-{stranger.port}=wrong"
    assert stranger.ask("/")[0] == 403


def test_age_of_a_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    now = [1000.0]
    monkeypatch.setattr("time.time", lambda: now[0])
    door = Door(8000)
    assert not door.has_session("")
    assert door.open_session("\u00e9") is None
    session = door.open_session(door.token)
    assert session is not None
    assert door.has_session(session)
    assert door.open_session(session) is None
    now[0] += SESSION_AGE + 1.0
    assert not door.has_session(session)


def test_policies_of_pages_and_of_reports(client: Client) -> None:
    _, headers, body = client.ask("/")
    policy = headers["content-security-policy"]
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert (rules["script-src"], rules["style-src"], rules["connect-src"]) == ("'self'", "'self'", "'self'")
    assert "unsafe-eval" not in policy
    assert "default-src 'none'" in policy
    assert headers["x-content-type-options"] == "nosniff"
    assert b"<script>" not in body
    assert b"onclick" not in body
    assert b" style=" not in body
    assert headers["cache-control"] == "no-store"
    status, headers, _ = client.ask("/assets/bench.js")
    assert (status, headers["cache-control"]) == (200, "max-age=3600")
    assert headers["content-type"].startswith("text/javascript")
    assert headers["content-security-policy"] == policy


def test_uploads_get_a_plain_free_name(client: Client, server: Server) -> None:
    origin = {"Origin": f"http://127.0.0.1:{client.port}"}
    hostile = ("log.csv", "log.csv", "../../up.csv", "C:\\data\\messung 1.csv", ".hidden.csv", "ключ<b>.csv")
    for wanted in hostile:
        status, _, body = client.ask(f"/upload?name={quote(wanted)}", "POST", b"t,x\n0,1\n", origin)
        assert status == 200
        name = json.loads(body)["name"]
        path = server.folder / name
        assert path.parent == server.folder
        assert path.read_bytes() == b"t,x\n0,1\n"
        assert not name.startswith(".")
        assert "<" not in name
    for wanted in ("run.exe", "page.html", "", "x" * 400):
        assert client.ask(f"/upload?name={wanted}", "POST", b"MZ", origin)[0] in (404, 422)
    assert not (server.folder.parent / "up.csv").exists()
    for path in server.folder.glob("*.csv"):
        if path.name != "tumble-a.csv":
            path.unlink()


@pytest.mark.long
def test_a_module_in_the_folder_is_not_imported(tmp_path: Path) -> None:
    for name in ("json.py", "piga.py", "numpy.py"):
        (tmp_path / name).write_text("open('owned', 'w').close()\n", encoding="utf-8")
    (tmp_path / "run.toml").write_text("[data]\n", encoding="utf-8")
    running = entered(tmp_path)
    running.client.page("/record/run.toml")
    assert running.end()[0] == 0
    jobs = Jobs(tmp_path)
    job = jobs.start(("calibrate", "run.toml"), "Calibrate", "run.toml")
    wait_until(lambda: job.state != "running", 120.0)
    assert job.child.returncode == 2
    assert "run.toml" in job.text("err")
    assert not (tmp_path / "owned").exists()
    jobs.stop_all()


def test_values_that_no_instrument_has(client: Client) -> None:
    for typed in ("K=0+rad/s/g", "beta=100+deg", "a_x=5"):
        assert client.ask(f"/explore?{typed}")[0] == 422
    assert client.ask("/explore?a_x=1e30+g&time=1e12+s")[0] == 200
    status, headers, _ = client.ask("/explore?report=1&a_x=1e30+g&time=1e12+s")
    assert (status, "sandbox" in headers["content-security-policy"]) == (200, True)


def test_forms_that_are_none(client: Client) -> None:
    origin = {"Origin": f"http://127.0.0.1:{client.port}"}
    bodies = [
        b"%",
        b"\xff=1",
        b"a" * 100,
        b"do=nonsense",
        b"do=set&key=model.terms&value=__import__('os')",
        b"x=1&" * 3000,
    ]
    for body in (
        *bodies,
        b"do=again&index=-1",
        b"do=leave&from=nan&to=inf&reason=x",
        b"do=leave",
        b"do=set",
        b"",
    ):
        status, _, answer = client.ask("/record/tumble-a.toml", "POST", body, origin)
        assert status == 422, body[:40]
        assert b"Traceback" not in answer
    assert client.ask("/record/tumble-a.toml", "POST", b"a=" + b"x" * (3 << 20), origin)[0] == 422


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="processes are listed from /proc")
@pytest.mark.parametrize(("number", "pause"), [(signal.SIGINT, 0.0), (signal.SIGTERM, 1.0)])
def test_signals_end_the_server_and_its_jobs(tmp_path: Path, number: int, pause: float) -> None:
    from tests.workbench.conftest import shipped_record

    shipped_record(tmp_path)
    running = entered(tmp_path)
    running.client.page("/record/tumble-a.toml")
    time.sleep(pause)
    assert running.end(number) == (0, "")
    assert not jobs_in(tmp_path)
    assert not list(tmp_path.glob("*-calibration"))


def test_the_address_for_the_browser_is_a_file_of_its_owner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Arguments of a process are seen by every user of a machine."""
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda address: opened.append(address) or True)
    door = Door(8000)
    open_browser(door, tmp_path)
    assert door.token not in opened[0]
    path = tmp_path / "open.html"
    assert opened == [path.as_uri()]
    assert path.stat().st_mode & 0o777 == 0o600
    assert door.address in path.read_text(encoding="utf-8")


@pytest.mark.long
def test_a_server_at_the_same_address_knows_its_browser_again(tmp_path: Path) -> None:
    first = entered(tmp_path)
    port, cookie = first.client.port, first.client.cookie
    assert first.end() == (0, "")
    (tmp_path / "other").mkdir()
    for folder, status in (
        (tmp_path, 200),
        (tmp_path / "other", 403),
    ):  # another folder at this port does not know it
        again = Server(folder, "--port", str(port))
        again.client.cookie = cookie
        again.client.page("/", status)
        assert again.end() == (0, "")


def test_what_is_no_folder_or_port(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match="is not a folder"):
        Folder(tmp_path / "none")
    (tmp_path / ".piga-ui").symlink_to(tmp_path.parent)
    with pytest.raises(OutsideError, match="piga-ui"):
        Folder(tmp_path).state_room()


def test_browsers_leave_port_80_out() -> None:
    assert Door(80).knows_host("127.0.0.1")
    assert not Door(80).knows_host("evil.example")
    assert not Door(8443).knows_origin("http://127.0.0.1")
