"""A log that nothing describes: corrected columns, answers, refusals. The answer: other terms, what must not be kept."""

from __future__ import annotations

import re
import shutil
import time
from pathlib import Path
from typing import Any

import pytest

import piga
from piga.records.run_file import read_run_file
from piga.workbench import signals
from piga.workbench.common import FIT, LAPSE, Bench, Jobs
from piga.workbench.folder import Folder
from piga.workbench.record import _answer, _cache_of, sheet
from tests.workbench.conftest import Client, shipped_record, wait_until
from tests.workbench.logs import german

NAME = "tumble-a.toml"
KEY = "instrument.scale_factor"


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    (tmp_path / "log.csv").write_bytes(german())
    return Folder(tmp_path)


@pytest.mark.parametrize(
    ("typed", "words"), [("0,8884", "unit is missing"), ("0.8884 rad/s", "rad/s"), ("0,8884.1 rad/s/g", "comma in the number")]
)  # fmt: skip
def test_a_wrong_number_is_refused_at_its_field_and_kept(folder: Folder, typed: str, words: str) -> None:
    made = sheet(folder, "log.csv", {KEY: typed, f"u:{KEY}": ""})
    (field,) = [one for one in made.fields if one.key == KEY]
    assert (field.typed, made.complete) == (typed, False)
    assert words in field.refusal


def test_the_run_file_is_complete_once_the_questions_are_answered(folder: Folder) -> None:
    made = sheet(folder, "log.csv", {KEY: "0,8884", f"u:{KEY}": "rad/s/g"})
    assert made.complete, made
    run_file = read_run_file(folder.root / "log.toml", made.draft.text().encode())
    assert run_file.instrument.scale_factor == "0.8884 rad/s/g"
    assert run_file.data.output.column == "Z\u00e4hlerstand"


def test_a_column_is_corrected_at_the_column(folder: Folder) -> None:
    plain = sheet(folder, "log.csv", {})
    names = [column.name for column in plain.described.columns]
    at = names.index("fz")
    made = sheet(folder, "log.csv", {f"role:{at}": "temperature", f"unit:{at}": "degC"})
    assert made.draft.document["data"]["temperature"]["column"] == "fz"
    assert made.described.columns[at].reason == "as you said"
    assert "fz" not in str(made.draft.document["data"].get("reference", ""))
    unknown = sheet(folder, "log.csv", {f"role:{at}": "<script>"})
    assert "is not what a column can hold" in unknown.message
    assert unknown.described.columns[at].kind == "force"


def test_a_direct_instrument_is_asked_for_its_own_unit(tmp_path: Path) -> None:
    rows = "".join(
        f"{0.05 * k:.2f},{1.3 * (1 - 2 * (k // 50 % 2)):.5f},{1 - 2 * (k // 50 % 2)},0,0\n" for k in range(200)
    )
    (tmp_path / "direct.csv").write_text("time [s],output [V],fx [g],fy [g],fz [g]\n" + rows, encoding="utf-8")
    made = sheet(Folder(tmp_path), "direct.csv", {"role:1": "direct", KEY: "1,3 V/g"})
    assert made.draft.document["instrument"]["scale_factor"] == "1.3 V/g", made


@pytest.mark.long
def test_a_thinned_copy_of_a_long_record_is_answered_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Alone; then the whole record, which alone can be kept. A copy that cannot be fitted is no reason to wait."""
    monkeypatch.setattr(signals, "LONG", 1000)
    monkeypatch.setattr(signals, "THINNED", 5000)
    run = shipped_record(tmp_path)
    bench = Bench(Folder(tmp_path))
    cache = _cache_of(bench, NAME)
    every = signals.write_envelopes(piga.read_run(run), read_run_file(run), cache).every
    assert every == 5

    def asked() -> dict[str, Any]:
        return _answer(bench, NAME, every, [])

    def ended(job: Any) -> dict[str, Any]:
        wait_until(lambda: job.state != "running")
        return asked()

    try:
        job = asked()["fit"]
        assert job.command[1].endswith("thinned.toml")
        bench.jobs.stop(job)
        assert ended(job)["fit"] == job  # what was stopped is not followed by the longer fit
        bench.jobs.forget(job)
        early = ended(asked()["fit"])
        assert (early["every"], early["fit"].command[1]) == (5, NAME)
        scale, whole = early["answer"].calibration["scale_factor"], ended(early["fit"])
        assert (whole["every"], whole["fit"]) == (1, None)
        assert scale.value == pytest.approx(whole["answer"].K, abs=3.0 * scale.std)
        shutil.rmtree(tmp_path / ".piga-ui" / "trials")
        for job in bench.jobs.all():
            bench.jobs.forget(job)
        (cache / "thinned.toml").write_text("nothing", encoding="utf-8")
        assert ended(asked()["fit"])["fit"].command[1] == NAME
    finally:
        bench.jobs.stop_all()


@pytest.mark.long
def test_two_tabs_with_other_terms_are_both_answered(client: Client) -> None:
    """Neither stops the fit of the other while its page asks."""
    client.until(f"/record/{NAME}", lambda text: "data-drawn" in text)
    pages = [f"/record/{NAME}?term=scale_factor&term={term}" for term in ("k2", "k3")]
    keys = [re.search(r'hx-get="/jobs/([^/"]+)/progress"', client.page(page))[1] for page in pages]  # type: ignore[index]
    assert keys[0] != keys[1]
    limit = time.monotonic() + 120.0
    while b"".join(client.ask(f"/jobs/{key}/progress")[2] for key in keys):
        assert time.monotonic() < limit
        time.sleep(0.2)
    assert all("Full report" in client.page(page) for page in pages)


@pytest.mark.long
def test_a_fit_that_no_page_asks_for_ends_and_comes_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped_record(tmp_path)
    jobs = Jobs(tmp_path)
    try:
        left, shown, other = (
            jobs.start(("calibrate", NAME, "--out", place), FIT, subject, place)
            for place, subject in (("a", NAME), ("b", NAME), ("c", "other.toml"))
        )
        left.asked = other.asked = time.time() - LAPSE - 1.0
        jobs.attend(shown)
        assert (left.was_stopped, shown.was_stopped, other.was_stopped) == (True, False, False)
        assert left.place.name not in jobs.by_key  # the page that comes back starts it anew
    finally:
        jobs.stop_all()


@pytest.mark.long
def test_what_must_not_be_used_is_not_kept(client: Client, lab: Path) -> None:
    text = (lab / NAME).read_text(encoding="utf-8")
    (lab / "nine.toml").write_text(text.replace("0.8884 rad/s/g", "0.0987 rad/s/g"), encoding="utf-8")
    page = client.until("/record/nine.toml", lambda text: 'class="light' in text)
    assert 'class="light red"' in page
    assert "times the nominal" in page
    key = re.search(r'name="key" value="([^"]+)"', page)[1]  # type: ignore[index]
    status, _, body = client.post("/keep/nine.toml", {"key": key})
    assert (status, b"cannot be kept" in body) == (422, True)
    assert not (lab / "nine-calibration").exists()
    (lab / "nine.toml").unlink()


@pytest.mark.long
def test_a_pair_of_terms_needs_both(client: Client) -> None:
    """The boxes stay, and the answer says what is wrong."""
    client.until(f"/record/{NAME}", lambda text: "data-drawn" in text)
    page = client.page(f"/record/{NAME}?term=scale_factor&term=s1")
    assert "No answer" in page
    assert 'value="c1"' in page or "c1" in page


@pytest.mark.long
def test_not_the_whole_record_is_left_out(client: Client) -> None:
    client.until(f"/record/{NAME}", lambda text: "data-drawn" in text)
    status, _, body = client.post(f"/record/{NAME}", {"do": "leave", "from": "0", "to": "1e9", "reason": "all"})
    assert (status, b"these are all rows of the record" in body) == (422, True)
