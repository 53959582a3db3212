"""The order of answers for a long record: the thinned copy alone first, then all rows."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

import piga
from piga.records.run_file import read_run_file
from piga.workbench import signals
from piga.workbench.folder import Folder, History
from piga.workbench.jobs import Jobs
from piga.workbench.pages.common import Bench
from piga.workbench.pages.record import _answer, _cache_of
from piga.workbench.security import Door
from tests.workbench.conftest import Client, shipped_record, wait_until

NAME, TERMS = "tumble-a.toml", ("scale_factor", "tan_beta", "k0")


@pytest.mark.long
def test_the_thinned_copy_is_answered_first_and_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signals, "LONG", 1000)
    run = shipped_record(tmp_path)
    folder, jobs = Folder(tmp_path), Jobs(tmp_path)
    bench = Bench(folder, jobs, History(folder), Door(1))
    cache = _cache_of(bench, NAME)
    monkeypatch.setattr(signals, "THINNED", 5000)
    outline = signals.write_envelopes(piga.read_run(run), read_run_file(run), cache)
    assert outline.thinned == 5

    def asked() -> Any:
        return _answer(bench, NAME, TERMS, outline)

    def ended(job: Any) -> bool:
        return job.state != "running"

    try:
        first, job = asked()
        assert first.every == 5
        assert job.command[1].endswith("thinned.toml")
        jobs.stop(job)
        assert asked()[1] == job  # what was stopped is not followed by the longer fit
        jobs.forget(job)
        _, job = asked()
        assert len(jobs.running()) == 1
        wait_until(lambda: ended(job))
        thinned, whole = asked()
        assert thinned.every == 5
        assert thinned.calibration is not None
        assert whole.command[1] == NAME
        wait_until(lambda: ended(whole))
        answer, none = asked()
        assert (answer.every, none) == (1, None)
        assert (answer.place / "report.html").is_file()
        shutil.rmtree(answer.place)
        shutil.rmtree(answer.place.with_name(f"{answer.key}-first"))
        for job in jobs.all():
            jobs.forget(job)
        (cache / "thinned.toml").write_text("nothing", encoding="utf-8")
        _, job = asked()
        wait_until(lambda: ended(job))
        assert asked()[1].command[1] == NAME  # a thinned copy that cannot be fitted is no reason to wait
    finally:
        jobs.stop_all()


@pytest.mark.long
def test_a_term_that_is_ticked_again_is_answered(client: Client) -> None:
    """Its first fit was stopped when another term was ticked."""
    client.until("/picture/tumble-a.toml", lambda text: "data-drawn" in text)
    k2, k3 = (f"/answer/tumble-a.toml?term=scale_factor&term={term}" for term in ("k2", "k3"))
    assert "The fit runs" in client.page(k2)
    assert "The fit runs" in client.page(k3)
    client.page(k2)
    answer = client.until(
        "/answer/tumble-a.toml?terms=scale_factor,k2", lambda text: "The fit runs" not in text
    )
    assert "Full report" in answer
    assert "No answer" not in answer
