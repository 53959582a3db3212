"""The simulated tests of ``benchmarks/cases/coverage.toml`` by name, shared by the page on accuracy and the tests of the estimator.

Every scenario has constant force in each segment; its motion shares no code with the estimator
(``benchmarks/constant_force.py``).
"""

from __future__ import annotations

from benchmarks.constant_force import PHI, SCALE, Array, ConstantForce, Joint, tumble
from benchmarks.intervals import scenarios

__all__ = ["FAINT", "PHI", "SCALE", "SCENARIOS", "Array", "Joint", "Scenario", "tumble"]

Scenario = ConstantForce

FAINT = {name: test for name, test in scenarios().items() if name.startswith("faint-")}
"""White noise beside a random walk that hardly shows."""
SCENARIOS = {name: test for name, test in scenarios().items() if not name.startswith(("faint-", "other-"))}
