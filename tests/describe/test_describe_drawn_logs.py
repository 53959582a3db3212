"""Logs that a builder draws by a seed: the drafted run file gives K within its uncertainty."""

from __future__ import annotations

from pathlib import Path

import pytest

from piga.describe import describe_log, draft_run_file
from tests.describe.drawn_logs import K, drawn, outcome

CHOSEN = {
    0: "de, head, folded, gap kept, two rows, s, ';' comma, numbered, preamble",
    1: "fr, arm, pulses, falling, gap lost, two rows, stamp, '\\t' comma, preamble",
    3: "zh, head, saw-tooth, gap none, two rows, ms, ',' point, preamble",
    16: "en, head, pulses, falling, gap none, two rows, s, sheet",
    25: "en, head, folded, gap kept, in the name, stamp, sheet, preamble",
    207: "fr, head, saw-tooth, gap lost, second row, stamp, '\\t' comma, numbered",
}


@pytest.mark.long
@pytest.mark.parametrize("seed", CHOSEN)
def test_k_of_a_drawn_log_is_right(tmp_path: Path, seed: int) -> None:
    log, error, said = outcome(seed, tmp_path)
    assert log.what == CHOSEN[seed]
    assert abs(error) < 3.0, said
    assert float(said.split()[1]) < 20.0, "ppm"


@pytest.mark.slow
def test_forty_drawn_logs(tmp_path: Path) -> None:
    """Seeds that were drawn after the last change of the reading."""
    outcomes = [outcome(seed, tmp_path) for seed in range(240, 280)]
    assert sum(abs(error) < 2.0 for _, error, _ in outcomes) >= 36
    assert not [log for log, error, said in outcomes if abs(error) > 3.0 and said.endswith("; ")]


def test_counts_that_are_no_usual_number_are_asked_for(tmp_path: Path) -> None:
    """From the slope and the nominal scale factor they would make K the nominal one."""
    log = drawn(10, tmp_path)
    described = describe_log(tmp_path / log.name)
    for nominal, kept in ((f"{K} rad/s/g", True), (f"{1.05 * K} rad/s/g", False)):
        draft = draft_run_file(described, {"instrument.scale_factor": nominal})
        assert ("counts_per_revolution" in draft.document["instrument"]) == kept
        asked = [one.key for one in draft.open]
        assert ("instrument.counts_per_revolution" in asked) != kept
        assert kept or "not a usual number" in draft.text()
