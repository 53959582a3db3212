"""The space-stable platform with case rotation: simulate, align, identify, navigate, analyse.

One run is ``load_scenario`` - ``simulate`` - ``identify`` / ``align`` - ``compensator`` - ``navigate``;
``compare`` does all of it for every compensation model. See docs/theory/platform.md.
"""

from piga.platform.chain import (
    ModelComparisonRun,
    compare,
    error_budget,
    prepare,
    run_model,
    standard_sources,
)
from piga.platform.identify import (
    Alignment,
    Identification,
    align,
    identify,
)
from piga.platform.navigator import (
    CaseCompensator,
    Knowledge,
    Navigation,
    Start,
    compensator,
    errors,
    navigate,
    true_knowledge,
)
from piga.platform.scenario import PlatformScenario, load_scenario
from piga.platform.simulate import PlatformRun, Readouts, simulate

__all__ = [
    "Alignment",
    "CaseCompensator",
    "Identification",
    "Knowledge",
    "ModelComparisonRun",
    "Navigation",
    "PlatformRun",
    "PlatformScenario",
    "Readouts",
    "Start",
    "align",
    "compare",
    "compensator",
    "error_budget",
    "errors",
    "identify",
    "load_scenario",
    "navigate",
    "prepare",
    "run_model",
    "simulate",
    "standard_sources",
    "true_knowledge",
]
