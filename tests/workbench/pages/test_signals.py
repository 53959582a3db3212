"""The page Signals: what is refused while a record is not read yet."""

from __future__ import annotations

from tests.workbench.conftest import Client


def test_nothing_is_left_out_of_a_record_that_is_not_read_yet(client: Client) -> None:
    for path, fields in (
        ("/leave-out/tumble-a.toml", {"from": 1.0, "to": 2.0, "reason": "moved"}),
        ("/signal-data/tumble-a.toml?keys=output&from=0&to=1&width=10", None),
    ):
        status, _, body = client.ask(path) if fields is None else client.post(path, fields)
        assert status == 422, body
        assert "tumble-a.toml: is not read yet" in body.decode()
