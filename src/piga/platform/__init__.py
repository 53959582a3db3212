"""The space-stable platform with case rotation: simulate, align, identify, navigate, analyse.

One run is ``load_scenario`` - ``simulate`` - ``identify`` / ``align`` - ``compensator`` - ``navigate``;
``compare`` does all of it for every compensation model. See docs/platform.md.
"""

from piga.platform.identification.alignment import Alignment, align
from piga.platform.identification.identify import Identification, identify, identify_recursively, observability
from piga.platform.model.geometry import nulled_attitude, small_angle_attitude, small_angles
from piga.platform.model.models import CaseCompensator, Knowledge, compensator, true_knowledge
from piga.platform.model.scenario import PlatformScenario, load_scenario
from piga.platform.model.simulate import PlatformRun, Readouts, simulate
from piga.platform.navigation.analysis import daily_lines, line_amplitudes, spectrum, theory_lines
from piga.platform.navigation.navigator import (
    Navigation,
    Navigator,
    Perturbation,
    Start,
    errors,
    linear_errors,
    navigate,
)
from piga.platform.runs.budget import error_budget, standard_sources
from piga.platform.runs.capstone import Capstone, capstone
from piga.platform.runs.chain import ModelComparisonRun, compare, prepare, run_model

__all__ = [
    "Alignment",
    "Capstone",
    "CaseCompensator",
    "Identification",
    "Knowledge",
    "ModelComparisonRun",
    "Navigation",
    "Navigator",
    "Perturbation",
    "PlatformRun",
    "PlatformScenario",
    "Readouts",
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
