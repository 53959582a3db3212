"""Small plan files for the tests of planning."""

from __future__ import annotations

from pathlib import Path

from piga.planning.candidates import PlanRequest, read_plan

HEAD = """
[instrument]
serial = "plan-test"
scale_factor = "0.8884 rad/s/g"
[truth]
beta = "200 arcsec"
alpha0 = "0.8 rad"
k0 = "3e-4 g"
[electronics]
sample_rate = "{rate} Hz"
output = "angle"
angle_noise = "{white} rad"
angle_random_walk = "{walk} rad/sqrt(s)"
[stand]
kind = "dividing-head"
latitude = "40 deg"
positions = "{positions}"
move = "20 s"
[model]
terms = [{terms}]
phases = "{phases}"
[plan]
duration = "{duration} s"
whole_revolutions = {whole}
{plan}
{more}
"""
DEFAULTS = {
    "rate": 2,
    "white": 0,
    "walk": 1e-5,
    "positions": "0:360:30 deg",
    "terms": '"scale_factor", "tan_beta", "k0", "k2", "m_Y"',
    "phases": "shared",
    "duration": 720,
    "whole": "false",
    "plan": "",
    "more": "",
}


def request(folder: Path, **changes: object) -> PlanRequest:
    """A plan file with these changes, read."""
    path = folder / "plan.toml"
    path.write_text(HEAD.format(**(DEFAULTS | changes)), encoding="utf-8")
    return read_plan(path)
