"""The space-stable platform with case rotation: simulate, align, identify, navigate, analyse.

One run is ``load_scenario`` - ``simulate`` - ``identify`` / ``align`` - ``compensator`` - ``navigate``;
``compare`` does all of it for every compensation model. See docs/platform.md.
"""

from piga.stable_platform.alignment import Alignment, align
from piga.stable_platform.analysis import daily_lines, line_amplitudes, spectrum, theory_lines
from piga.stable_platform.budget import error_budget, monte_carlo, standard_sources
from piga.stable_platform.capstone import Capstone, capstone
from piga.stable_platform.chain import Comparison, compare, prepare, run_model
from piga.stable_platform.error_model import Perturbation, linear_errors
from piga.stable_platform.geometry import nulled_attitude, small_angle_attitude, small_angles
from piga.stable_platform.identification import identify
from piga.stable_platform.identified import Identification
from piga.stable_platform.models import Compensator, Knowledge, compensator, true_knowledge
from piga.stable_platform.navigation import Navigation, Navigator, Start, errors, navigate
from piga.stable_platform.observability import observability
from piga.stable_platform.recursion import identify_recursively
from piga.stable_platform.scenario import Scenario, load_scenario
from piga.stable_platform.simulate import Readouts, Run, simulate

__all__ = [
    "Alignment",
    "Capstone",
    "Comparison",
    "Compensator",
    "Identification",
    "Knowledge",
    "Navigation",
    "Navigator",
    "Perturbation",
    "Readouts",
    "Run",
    "Scenario",
    "Start",
    "align",
    "capstone",
    "compare",
    "compensator",
    "daily_lines",
    "error_budget",
    "errors",
    "identify",
    "identify_recursively",
    "line_amplitudes",
    "linear_errors",
    "load_scenario",
    "monte_carlo",
    "navigate",
    "nulled_attitude",
    "observability",
    "prepare",
    "run_model",
    "simulate",
    "small_angle_attitude",
    "small_angles",
    "spectrum",
    "standard_sources",
    "theory_lines",
    "true_knowledge",
]
