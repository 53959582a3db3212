"""Test stands as simulated machines. Each gives specific force and base rate, with its own errors."""

from piga.stand.machines import Centrifuge, DividingHead, Drive, RateTable, SpinPlan, VibrationTable
from piga.stand.profile import (
    Composite,
    Imperfections,
    LoggedProfile,
    Profile,
    Segment,
    Stand,
    force_change,
    sample_stand,
)
from piga.stand.run_reference import example_run, read_run, stand_changes
from piga.stand.scenario import Scenario, read_scenario, run_scenario
from piga.stand.simulate import SimulatedTest, Specimen, simulate_test

__all__ = [
    "Centrifuge",
    "Composite",
    "DividingHead",
    "Drive",
    "Imperfections",
    "LoggedProfile",
    "Profile",
    "RateTable",
    "Scenario",
    "Segment",
    "SimulatedTest",
    "Specimen",
    "SpinPlan",
    "Stand",
    "VibrationTable",
    "example_run",
    "force_change",
    "read_run",
    "read_scenario",
    "run_scenario",
    "sample_stand",
    "simulate_test",
    "stand_changes",
]
