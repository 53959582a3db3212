"""Scenario files: from TOML to a simulated test."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from piga.errors import ArgumentError, PigaError, RunFileError, UnitError
from piga.instrument import ErrorModel, Instrument
from piga.instrument.twin.electronics import Electronics, Temperature
from piga.instrument.twin.parameters import twin_parameters
from piga.records.terms import UNITS, harmonic, unit_of
from piga.records.toml_file import read_toml
from piga.stand.imperfections import Imperfections, imperfections
from piga.stand.profile import Stand
from piga.stand.scenario_tables import ScenarioTable
from piga.stand.simulate import Harmonics, Model, SimulatedTest, Specimen, simulate_test
from piga.stand.tide import EarthTide
from piga.units import to_si

_SERVO = ("servo", "servo_damping")
_MOTION = ("scale_factor", "beta", "tan_beta", "alpha0", "T_ref")


@dataclass(frozen=True)
class Scenario:
    """A scenario file in SI, ready to run; ``table`` is the file as read."""

    path: Path
    table: ScenarioTable
    stand: Stand
    specimen: Specimen
    electronics: Electronics
    temperature: Temperature | None

    def imperfections(self, seed: int) -> Imperfections:
        """The imperfections as given, or drawn with ``seed``."""
        drawn = self.table.run.imperfections == "drawn"
        rng = np.random.default_rng([seed, 1]) if drawn else None
        return imperfections(self.table.imperfections, rng=rng)


def read_scenario(path: str | Path) -> Scenario:
    """Read a scenario file.

    Raises
    ------
    RunFileError
        For an unknown key, a missing one, a wrong unit or an implausible value; names file and key.
    """
    path = Path(path)
    return scenario_of(path, read_toml(path, ScenarioTable))


def scenario_of(path: Path, table: ScenarioTable) -> Scenario:
    """The scenario of a table that was read from ``path``.

    Raises
    ------
    RunFileError
        As :func:`read_scenario`.
    """
    try:
        if table.instrument.servo is not None:
            table.instrument.servo.parameters()
    except (RunFileError, UnitError) as error:
        raise RunFileError(f"{path}: {error.message}", remedy=error.remedy) from None
    try:
        scenario = Scenario(
            path,
            table,
            table.stand.build(path.parent),
            _specimen(table),
            _electronics(table),
            _temperature(table),
        )
        scenario.imperfections(table.run.seed).require(scenario.stand.accepted, scenario.stand.kind)
    except (ArgumentError, UnitError) as error:
        raise RunFileError(f"{path}: {error.message}", remedy=error.remedy) from None
    return scenario


def run_scenario(
    scenario: Scenario, *, model: Model | None = None, seed: int | None = None, force: bool = False
) -> SimulatedTest:
    """Simulate a scenario; ``model`` and ``seed`` override the file, ``force`` runs an unstable servo loop.

    Raises
    ------
    PigaError
        If its parts do not fit each other, or the servo loop is unstable and not forced; names the file.
    """
    run = scenario.table.run
    chosen = run.seed if seed is None else seed
    try:
        return simulate_test(
            scenario.stand,
            scenario.specimen,
            scenario.electronics,
            imperfections=scenario.imperfections(chosen),
            temperature=scenario.temperature,
            model=model or run.model,
            seed=chosen,
            step=None if run.step is None else to_si(run.step, "s", what="[run] step"),
            force=force,
            tide=_tide(scenario),
        )
    except PigaError as error:
        raise type(error)(f"{scenario.path}: {error.message}", remedy=error.remedy) from None


def _tide(scenario: Scenario) -> EarthTide | None:
    table = scenario.table.run.earth_tide
    if table is None:
        return None
    site = getattr(scenario.stand, "site", None)
    if site is None:
        raise ArgumentError(
            f"[run] earth_tide: a stand of kind '{scenario.stand.kind}' has no site",
            remedy="use it with a dividing head, centrifuge, rate table or vibration table",
        )
    if table.start.tzinfo is None:
        raise ArgumentError("[run] earth_tide start has no time zone", remedy="write e.g. 2026-11-21T08:00:00Z")
    return EarthTide(site, table.start, table.reference == "includes")


def _specimen(table: ScenarioTable) -> Specimen:
    truth = table.truth
    for name in truth:
        if name not in _MOTION and (name == "phi" or (name not in UNITS and harmonic(name) is None)):
            known = [
                *_MOTION,
                *(term for term in UNITS if term not in ("phi", *_MOTION)),
                "s1",
                "c1",
                "s2",
                "...",
            ]
            raise ArgumentError(f"[truth]: unknown key '{name}'", remedy=f"known keys: {', '.join(known)}")
    if "beta" in truth and "tan_beta" in truth:
        raise ArgumentError("[truth]: beta and tan_beta are the same thing", remedy="leave one out")
    tangent = to_si(truth.get("tan_beta", 0.0), "1", what="[truth] tan_beta")
    instrument = Instrument(
        to_si(truth.get("scale_factor", table.instrument.scale_factor), "rad/s/g", what="[truth] scale_factor"),
        to_si(truth["beta"], "rad", what="[truth] beta") if "beta" in truth else math.atan(tangent),
        to_si(truth.get("alpha0", 0.0), "rad", what="[truth] alpha0"),
    )
    twin = twin_parameters(table.twin) if table.twin or table.run.model == "twin" else None
    s, d = (to_si(truth.get(name, 0.0), unit_of(name), what=f"[truth] {name}") for name in _SERVO)
    return Specimen(instrument, _error_model(table), _harmonics(table), s, d, twin, table.run.start)


def _error_model(table: ScenarioTable) -> ErrorModel:
    terms = {
        name: to_si(value, unit_of(name), what=f"[truth] {name}")
        for name, value in table.truth.items()
        if name not in (*_MOTION, *_SERVO) and harmonic(name) is None
    }
    model = ErrorModel.from_terms(terms)
    reference = table.truth.get("T_ref", table.model.get("temperature_reference", "20 degC"))
    return replace(model, T_ref=to_si(reference, "K", what="[truth] T_ref"))


def _harmonics(table: ScenarioTable) -> Harmonics:
    """Amplitudes [m/s^2] of sine and cosine by order."""
    result: dict[int, tuple[float, float]] = {}
    for name, value in table.truth.items():
        found = harmonic(name)
        if found is not None:
            amplitude = to_si(value, "g", what=f"[truth] {name}")
            sine, cosine = result.get(found[1], (0.0, 0.0))
            result[found[1]] = (amplitude, cosine) if found[0] == "s" else (sine, amplitude)
    return result


def _electronics(table: ScenarioTable) -> Electronics:
    e = table.electronics

    def si(key: str, unit: str) -> float:
        return to_si(getattr(e, key), unit, what=f"[electronics] {key}")

    return Electronics(
        sample_rate=si("sample_rate", "Hz"),
        kind=e.output,
        counts_per_revolution=table.instrument.counts_per_revolution,
        counter_bits=table.instrument.counter_bits if e.output == "counts" else None,
        zero=si("zero", "rad"),
        angle_noise=si("angle_noise", "rad"),
        angle_random_walk=si("angle_random_walk", "rad/sqrt(s)"),
        bias_random_walk=si("bias_random_walk", "g/sqrt(s)"),
        clock_offset=si("clock_offset", "s"),
        clock_jitter=si("clock_jitter", "s"),
    )


def _temperature(table: ScenarioTable) -> Temperature | None:
    t = table.temperature
    if t is None:
        return None
    return Temperature(
        to_si(t.start, "K", what="[temperature] start"),
        to_si(t.drift, "K/s", what="[temperature] drift"),
        to_si(t.swing, "K", what="[temperature] swing"),
        to_si(t.period, "s", what="[temperature] period"),
    )
