"""Write a simulated test in the files of a lab (data file, run file), and its truth.

The truth has the names and units of a calibration.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from piga._version import __version__
from piga.instrument.twin import predicted_k2, servo_terms
from piga.records.terms import SERVO_TERMS, si_factor, unit_of
from piga.stand.profile import Imperfections
from piga.stand.scenario import Scenario
from piga.stand.simulate import SimulatedTest
from piga.tables import label_column, number_column
from piga.text_files import toml_text
from piga.units import G0, parse_unit


@dataclass(frozen=True)
class TrueValue:
    """One true value: ``value`` in ``unit``. ``segment`` is set if it holds for one segment only."""

    name: str
    value: float
    unit: str
    segment: str | None = None
    note: str = ""


def coefficients(test: SimulatedTest) -> tuple[TrueValue, ...]:
    """True coefficients: scale factor, tan beta, phases, and every term that is not zero.

    With the twin, the bias of torques about its inner axis and the k2 of the float's inertia are added to those of the
    error model. The terms ``servo`` and ``servo_damping`` are then predicted from its servo at a small rate.
    Harmonics refer to the zero of the output angle. ``phi``: one value if all segments share it, else one per
    segment; a log of rates has no zero, and so no phase.
    """
    specimen, model = test.specimen, test.specimen.error_model
    instrument, direct = specimen.instrument, specimen.direct
    values = {"scale_factor": instrument.scale_factor}
    values |= {} if direct else {"tan_beta": abs(instrument.tan_beta)}
    values |= {f.name: getattr(model, f.name) for f in fields(model) if f.name not in ("T_ref", "s1", "c1")}
    values |= {"servo": specimen.servo, "servo_damping": specimen.servo_damping, "k2v": specimen.k2v}
    if test.model == "twin":
        p = specimen.design
        values["k0"] += (p.restoring * (p.pick_off_null - p.restoring_zero) - p.inner_torque) / p.pendulosity
        values["k2"] += predicted_k2(p)
        if p.integral_gain > 0.0:
            terms = servo_terms(p.K, p.pendulosity, p.integral_gain, damping=p.damping)
            for name, value in zip(SERVO_TERMS, terms, strict=True):
                values[name] += value
    rows = [
        TrueValue(name, value / si_factor(name), unit_of(name, specimen.unit))
        for name, value in values.items()
        if value != 0.0 or name in ("scale_factor", "tan_beta", "k0")
    ]
    if direct:
        return tuple(rows)
    waves = dict(specimen.harmonics)
    if model.s1 or model.c1:
        sine, cosine = waves.get(1, (0.0, 0.0))
        waves[1] = (sine + model.s1, cosine + model.c1)
    for order, (sine, cosine) in sorted(waves.items()):
        c, s = math.cos(order * test.phases[0]), math.sin(order * test.phases[0])
        rows.append(TrueValue(f"s{order}", (sine * c - cosine * s) / G0, "g"))
        rows.append(TrueValue(f"c{order}", (sine * s + cosine * c) / G0, "g"))
    if test.electronics.kind == "rate":
        return tuple(rows)
    turn = math.pi if instrument.beta < 0.0 else 0.0
    phases = [math.remainder(phase + turn, 2.0 * math.pi) for phase in test.phases]
    if _shares_phase(test):
        return (*rows, TrueValue("phi", phases[0], "rad"))
    each = zip(phases, test.log.labels, strict=True)
    return (*rows, *(TrueValue("phi", phase, "rad", label) for phase, label in each))


def _shares_phase(test: SimulatedTest) -> bool:
    """Whether the zero of the output angle is one through the whole test: a log of rates loses it in a move."""
    e = test.electronics
    folds = e.counter_bits is not None and float(1 << e.counter_bits) % e.counts_per_revolution != 0.0
    moved = bool((np.diff(test.log.t) > 1.5 * e.interval).any())
    return not (moved and (e.kind == "rate" or folds))


def imperfection_values(errors: Imperfections) -> tuple[TrueValue, ...]:
    """Non-zero imperfections in the units of the uncertainty budget, vectors by component."""
    rows = []
    for entry in fields(errors):
        name, value, unit = entry.name, getattr(errors, entry.name), str(entry.metadata["unit"])
        parts = [(name, value, "")]
        if name == "angle_harmonics":
            parts = [(f"{name}[{n}]", a, f"phase {p:g} rad") for n, a, p in value]
        elif isinstance(value, tuple):
            axes = ("X0", "Y0", "Z0") if len(value) == 3 else ("1", "2")
            parts = [(f"{name} {axis}", v, "") for axis, v in zip(axes, value, strict=True)]
        rows += [
            TrueValue(key, v / parse_unit(unit).factor, unit, note=note) for key, v, note in parts if v or note
        ]
    return tuple(rows)


_OUTPUT = {"counts": "counts", "angle": "psi_rad", "rate": "rate_rad_s"}
"""Column of the output, by its kind."""
_FORCE, _RATE = [f"f{axis}_g" for axis in "xyz"], [f"w{axis}_rad_s" for axis in "xyz"]


def _output_name(test: SimulatedTest) -> str:
    kind = test.electronics.kind
    return "output" if test.specimen.direct and kind == "rate" else _OUTPUT[kind]


def write_data(test: SimulatedTest, path: Path) -> None:
    """Write the log as Parquet or CSV, by the ending of ``path``.

    Its columns: ``t_s``, ``segment``, output, ``fx_g ...``, ``wx_rad_s ...``, ``T_degC``.
    """
    import pyarrow as pa
    from pyarrow import csv, parquet

    log = test.log
    if all(name.isdigit() for name in log.labels):
        segment = number_column(np.array(log.labels).astype(np.int32)[log.segment])
    else:
        segment = label_column(log.segment.astype(np.int32), log.labels).dictionary_decode()
    columns = {"t_s": log.t, "segment": segment, _output_name(test): log.output}
    columns |= dict(zip(_FORCE, (log.reference / G0).T, strict=True))
    columns |= {} if test.specimen.direct else dict(zip(_RATE, log.base_rate.T, strict=True))
    columns["T_degC"] = log.temperature - 273.15
    columns |= {} if log.vibration is None else {"vibration_g": log.vibration / G0}
    made = [number_column(c) if isinstance(c, np.ndarray) else c for c in columns.values()]
    table = pa.Table.from_arrays(made, names=list(columns))
    if path.suffix == ".csv":
        csv.write_csv(table, path, csv.WriteOptions(quoting_style="needed"))
    else:
        parquet.write_table(table, path, compression="zstd", write_page_checksum=True)


def run_file_text(scenario: Scenario, test: SimulatedTest, data_file: str) -> str:
    """The run file (TOML) of the test, for ``piga calibrate``."""
    table, direct, kind = scenario.table, test.specimen.direct, test.electronics.kind
    described, counts = table.instrument, kind == "counts"
    unit = None if counts else "rad" if kind == "angle" else test.specimen.unit
    tables: dict[str, Any] = {
        "instrument": {
            "serial": described.serial,
            "scale_factor": described.scale_factor,
            "kind": "direct" if direct else None,
            "counts_per_revolution": described.counts_per_revolution if counts and not direct else None,
            "counter_bits": described.counter_bits if counts else None,
            "servo": described.servo and msgspec.to_builtins(described.servo),
        },
        "data": {
            "file": data_file,
            "time": {"column": "t_s", "unit": "s"},
            "output": {"column": _output_name(test), "kind": kind, "unit": unit},
            "reference": {"columns": _FORCE, "unit": "g"},
            "base_rate": None if direct else {"columns": _RATE, "unit": "rad/s"},
            "temperature": {"column": "T_degC", "unit": "degC"},
            "segment": "segment",
            "vibration": None if test.log.vibration is None else {"column": "vibration_g", "unit": "g"},
        },
        "model": _model(scenario, test),
        "stand": msgspec.to_builtins(table.stand),
        "estimation": table.estimation,
        "uncertainty": (table.imperfections if table.run.imperfections == "drawn" else {}) | table.uncertainty,
    }
    comment = (
        f"# Simulated by piga {__version__} from {scenario.path.name}, model {test.model}, seed {test.seed}.\n"
    )
    return comment + toml_text({name: part for name, part in tables.items() if part})


def _model(scenario: Scenario, test: SimulatedTest) -> dict[str, Any]:
    """``[model]`` of the scenario; else every term of the truth that the servo's known parameters do not give."""
    model, servo = dict(scenario.table.model), scenario.table.instrument.servo
    given = () if servo is None else SERVO_TERMS if servo.damping is not None else SERVO_TERMS[:1]
    if "terms" not in model:
        model["terms"] = [v.name for v in coefficients(test) if v.name not in ("phi", "k1", *given)]
    if not test.specimen.direct:
        model.setdefault("phases", "shared" if _shares_phase(test) else "per-segment")
    return model


def truth_document(scenario: Scenario, test: SimulatedTest) -> dict[str, Any]:
    """The truth as one JSON document (schema ``piga.truth/1``)."""
    document: dict[str, Any] = {
        "schema": "piga.truth/1",
        "instrument": {"serial": scenario.table.instrument.serial},
        "simulation": {"model": test.model, "stand": test.stand.kind, "seed": test.seed},
        "coefficients": [_entry(value) for value in coefficients(test)],
        "imperfections": [_entry(value) for value in imperfection_values(test.imperfections)],
        "provenance": {"software": f"piga {__version__}", "scenario": scenario.path.name},
    }
    if test.motion is not None:
        changes = [{"t": t, "lock": change} for t, change in test.motion.lock_changes()]
        document["simulation"] |= {"local_error": {"value": test.motion.local_error, "unit": "rad"}}
        document["simulation"] |= {"steps": test.motion.steps, "lock_changes": changes}
    return document


def _entry(value: TrueValue) -> dict[str, Any]:
    entry = {key: item for key, item in asdict(value).items() if item not in (None, "")}
    return entry | ({"segment": None} if value.name == "phi" and value.segment is None else {})
