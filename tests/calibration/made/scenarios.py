"""The simulated tests of ``examples/campaigns/coverage.toml`` by name: the campaign and the tests of the estimator share them.

Every scenario has constant force in each segment; its motion shares no code with the estimator
(:mod:`piga.campaign.constant_force`).
"""

from __future__ import annotations

from pathlib import Path

from piga.campaign.campaign_file import read_campaign
from piga.campaign.constant_force import PHI, SCALE, Array, ConstantForce, Joint, tumble
from piga.campaign.subjects import built

__all__ = ["FAINT", "PHI", "SCALE", "SCENARIOS", "Array", "Joint", "Scenario", "tumble"]

Scenario = ConstantForce
COVERAGE = Path(__file__).parents[3] / "examples" / "campaigns" / "coverage.toml"


def _scenarios() -> dict[str, ConstantForce | Joint]:
    plan = read_campaign(COVERAGE)
    firsts = [plan.record(group.start) for group in plan.groups]
    return {record.group.name: built(plan, record, plan.document(record)) for record in firsts}


_ALL = _scenarios()
FAINT = {name: test for name, test in _ALL.items() if name.startswith("faint-")}
"""White noise beside a random walk that hardly shows."""
SCENARIOS = {name: test for name, test in _ALL.items() if name not in FAINT}
