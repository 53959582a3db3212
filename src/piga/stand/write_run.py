"""Write a simulated test in the files of a lab (data file, run file), and its truth.

The truth has the names and units of a calibration.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from piga._version import __version__
from piga.instrument.twin.linear import (
    predicted_k2,
    predicted_rate_error,
    predicted_rectification,
    predicted_second_harmonic,
    servo_terms,
)
from piga.instrument.twin.parameters import TwinParameters
from piga.records.terms import SERVO_TERMS, si_factor, unit_of
from piga.records.text_files import toml_text
from piga.results import Array, label_column, number_column
from piga.stand.profile import Imperfections
from piga.stand.scenario import Scenario
from piga.stand.simulate import SimulatedTest
from piga.units import G0, parse_unit

if TYPE_CHECKING:
    import pyarrow as pa


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

    With the twin, the bias and k2 of its torques and inertias are added to those of the error model. The terms
    ``servo`` and ``servo_damping`` are then predicted from its servo at a small rate.
    Harmonics refer to the zero of the output angle.
    """
    instrument = test.specimen.instrument
    values = {"scale_factor": instrument.scale_factor}
    values |= {} if test.specimen.direct else {"tan_beta": abs(instrument.tan_beta)}
    model = test.specimen.error_model
    values |= {f.name: getattr(model, f.name) for f in fields(model) if f.name not in ("T_ref", "s1", "c1")}
    values |= {"servo": test.specimen.servo, "servo_damping": test.specimen.servo_damping}
    values["k2v"] = test.specimen.k2v
    if test.model == "twin":
        for name, extra in _of_twin(test.specimen.design).items():
            values[name] += extra
    kept = [
        TrueValue(name, value / si_factor(name), unit_of(name, test.specimen.unit))
        for name, value in values.items()
        if value != 0.0 or name in ("scale_factor", "tan_beta", "k0")
    ]
    return tuple(kept) if test.specimen.direct else (*kept, *_harmonics(test), *_phases(test))


def _of_twin(p: TwinParameters) -> dict[str, float]:
    """Bias [m/s^2] from torques about the inner axis, k2 [1/(m/s^2)] from the float's inertia, the servo's terms."""
    bias = (p.restoring * (p.pick_off_null - p.restoring_zero) - p.inner_torque) / p.pendulosity
    values = {"k0": bias, "k2": predicted_k2(p)}
    if p.integral_gain > 0.0:
        terms = servo_terms(p)
        values |= {"servo": terms.servo, "servo_damping": terms.servo_damping}
    return values


def _harmonics(test: SimulatedTest) -> tuple[TrueValue, ...]:
    orders = dict(test.specimen.harmonics)
    model = test.specimen.error_model
    if model.s1 or model.c1:
        sine, cosine = orders.get(1, (0.0, 0.0))
        orders[1] = (sine + model.s1, cosine + model.c1)
    values = []
    for order, (sine, cosine) in sorted(orders.items()):
        c, s = math.cos(order * test.phases[0]), math.sin(order * test.phases[0])
        values.append(TrueValue(f"s{order}", (sine * c - cosine * s) / G0, "g"))
        values.append(TrueValue(f"c{order}", (sine * s + cosine * c) / G0, "g"))
    return tuple(values)


def _phases(test: SimulatedTest) -> tuple[TrueValue, ...]:
    """``phi``: one value if all segments share it, else one per segment. A log of rates has no zero, and so no phase."""
    if test.electronics.kind == "rate":
        return ()
    turn = math.pi if test.specimen.instrument.beta < 0.0 else 0.0
    phases = [math.remainder(phase + turn, 2.0 * math.pi) for phase in test.phases]
    if _shares_phase(test):
        return (TrueValue("phi", phases[0], "rad"),)
    return tuple(TrueValue("phi", p, "rad", name) for p, name in zip(phases, test.log.labels, strict=True))


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
        value, unit = getattr(errors, entry.name), str(entry.metadata["unit"])
        factor = parse_unit(unit).factor
        if entry.name == "angle_harmonics":
            rows += [
                TrueValue(f"{entry.name}[{n}]", a / factor, unit, note=f"phase {p:g} rad") for n, a, p in value
            ]
        elif isinstance(value, tuple):
            names = ("X0", "Y0", "Z0") if len(value) == 3 else ("1", "2")
            rows += [
                TrueValue(f"{entry.name} {n}", v / factor, unit) for n, v in zip(names, value, strict=True) if v
            ]
        elif value:
            rows.append(TrueValue(entry.name, value / factor, unit))
    return tuple(rows)


def predicted_angle_error(test: SimulatedTest) -> Array:
    """Predicted output angle of the twin minus that of the quasi-steady model [rad], at the rows of the log.

    It is the integral of :func:`piga.instrument.twin.linear.predicted_rate_error` along the test; zero for the
    quasi-steady model. The errors of a calibration of the log are the projection of this angle on its regressors.
    """
    if test.model != "twin":
        return np.zeros(test.log.t.size)
    profile = test.profile
    error = predicted_rate_error(test.specimen.design, profile.t, test.alpha, profile.force, profile.base_rate)
    steps = 0.5 * (error[1:] + error[:-1]) * np.diff(profile.t)
    return np.interp(test.log.t, profile.t, np.concatenate([[0.0], np.cumsum(steps)]))


def predictions(test: SimulatedTest) -> tuple[TrueValue, ...]:
    """Predicted effects of the twin that the quasi-steady model lacks, at 1 g along and 1 g across the input axis."""
    if test.model != "twin":
        return ()
    p = test.specimen.design
    rate = p.K * G0
    shift = predicted_rectification(p, G0, rate)
    ripple = predicted_second_harmonic(p, G0, rate)
    return (
        TrueValue("rectification", shift / rate, "1", note="relative shift of the mean rate, 1 g and 1 g"),
        TrueValue("second_harmonic", ripple / (p.K * G0), "g", note="at twice the gimbal angle, 1 g and 1 g"),
    )


_TRUTH_SCHEMA = "piga.truth/1"
_AXES = "xyz"
_OUTPUT = {"counts": "counts", "angle": "psi_rad", "rate": "rate_rad_s"}


def _output_name(test: SimulatedTest) -> str:
    """Column of the output."""
    return (
        "output" if test.specimen.direct and test.electronics.kind == "rate" else _OUTPUT[test.electronics.kind]
    )


def log_table(test: SimulatedTest) -> pa.Table:
    """The log as a table: ``t_s``, ``segment``, output, ``fx_g ...``, ``wx_rad_s ...``, ``T_degC``."""
    import pyarrow as pa

    log = test.log
    if all(name.isdigit() for name in log.labels):
        segment = number_column(np.array(log.labels).astype(np.int32)[log.segment])
    else:
        segment = label_column(log.segment.astype(np.int32), log.labels).dictionary_decode()
    columns = {"t_s": number_column(log.t), "segment": segment}
    columns[_output_name(test)] = number_column(log.output)
    columns |= {f"f{axis}_g": number_column(log.reference[:, k] / G0) for k, axis in enumerate(_AXES)}
    if not test.specimen.direct:
        columns |= {f"w{axis}_rad_s": number_column(log.base_rate[:, k]) for k, axis in enumerate(_AXES)}
    columns["T_degC"] = number_column(log.temperature - 273.15)
    if log.vibration is not None:
        columns["vibration_g"] = number_column(log.vibration / G0)
    return pa.Table.from_arrays(list(columns.values()), names=list(columns))


def write_data(test: SimulatedTest, path: Path) -> None:
    """Write the log as Parquet or CSV, by the ending of ``path``."""
    from pyarrow import csv, parquet

    table = log_table(test)
    if path.suffix == ".csv":
        csv.write_csv(table, path, csv.WriteOptions(quoting_style="needed"))
    else:
        parquet.write_table(table, path, compression="zstd", write_page_checksum=True)


def run_file_text(scenario: Scenario, test: SimulatedTest, data_file: str) -> str:
    """The run file (TOML) of the test, for ``piga calibrate``."""
    described, electronics = scenario.table.instrument, test.electronics
    instrument: dict[str, Any] = {"serial": described.serial, "scale_factor": described.scale_factor}
    output: dict[str, Any] = {"column": _output_name(test), "kind": electronics.kind}
    direct = test.specimen.direct
    instrument |= {"kind": "direct"} if direct else {}
    if electronics.kind == "counts":
        instrument |= {} if direct else {"counts_per_revolution": described.counts_per_revolution}
        if described.counter_bits is not None:
            instrument["counter_bits"] = described.counter_bits
    else:
        output["unit"] = "rad" if electronics.kind == "angle" else test.specimen.unit
    if described.servo is not None:
        instrument["servo"] = given_values(msgspec.to_builtins(described.servo))
    data = {
        "file": data_file,
        "time": {"column": "t_s", "unit": "s"},
        "output": output,
        "reference": {"columns": [f"f{axis}_g" for axis in _AXES], "unit": "g"},
        "base_rate": {"columns": [f"w{axis}_rad_s" for axis in _AXES], "unit": "rad/s"},
        "temperature": {"column": "T_degC", "unit": "degC"},
        "segment": "segment",
    }
    if direct:
        del data["base_rate"]
    if test.log.vibration is not None:
        data["vibration"] = {"column": "vibration_g", "unit": "g"}
    tables = {"instrument": instrument, "data": data, "model": _model(scenario, test)}
    tables |= {
        "stand": given_values(msgspec.to_builtins(scenario.table.stand)),
        "estimation": scenario.table.estimation,
        "uncertainty": _uncertainty(scenario),
    }
    comment = (
        f"# Simulated by piga {__version__} from {scenario.path.name}, model {test.model}, seed {test.seed}.\n"
    )
    return comment + toml_text({name: table for name, table in tables.items() if table})


def _model(scenario: Scenario, test: SimulatedTest) -> dict[str, Any]:
    """``[model]`` of the scenario; else every term of the truth that the servo's parameters do not give."""
    model = dict(scenario.table.model)
    if "terms" not in model:
        known = _known_servo(scenario)
        names = [value.name for value in coefficients(test) if value.name not in ("phi", "k1", *known)]
        model["terms"] = names
    if not test.specimen.direct:
        model.setdefault("phases", "shared" if _shares_phase(test) else "per-segment")
    return model


def _known_servo(scenario: Scenario) -> tuple[str, ...]:
    """Terms that ``[instrument] servo`` gives."""
    servo = scenario.table.instrument.servo
    if servo is None:
        return ()
    return SERVO_TERMS if servo.damping is not None else SERVO_TERMS[:1]


def given_values(value: Any) -> Any:
    """Nested tables without empty keys (TOML has no null)."""
    if isinstance(value, dict):
        return {key: given_values(item) for key, item in value.items() if item is not None}
    if isinstance(value, (list, tuple)):
        return [given_values(item) for item in value]
    return value


def _uncertainty(scenario: Scenario) -> dict[str, Any]:
    """``[uncertainty]`` as written and, if imperfections were drawn, their standard uncertainties."""
    drawn = scenario.table.imperfections if scenario.table.run.imperfections == "drawn" else {}
    return drawn | scenario.table.uncertainty


def truth_document(scenario: Scenario, test: SimulatedTest) -> dict[str, Any]:
    """The truth as one JSON document (schema ``piga.truth/1``)."""
    document: dict[str, Any] = {
        "schema": _TRUTH_SCHEMA,
        "instrument": {"serial": scenario.table.instrument.serial},
        "simulation": {"model": test.model, "stand": test.stand.kind, "seed": test.seed},
        "coefficients": [_entry(value) for value in coefficients(test)],
        "imperfections": [_entry(value) for value in imperfection_values(test.imperfections)],
        "predicted": [_entry(value) for value in predictions(test)],
        "provenance": {"software": f"piga {__version__}", "scenario": scenario.path.name},
    }
    if test.motion is not None:
        changes = [{"t": t, "lock": change} for t, change in test.motion.lock_changes()]
        document["simulation"] |= {"local_error": {"value": test.motion.local_error, "unit": "rad"}}
        document["simulation"] |= {"steps": test.motion.steps, "lock_changes": changes}
    return document


def _entry(value: Any) -> dict[str, Any]:
    entry = {key: item for key, item in asdict(value).items() if item not in (None, "")}
    return entry | ({"segment": None} if value.name == "phi" and value.segment is None else {})


def truth_text(scenario: Scenario, test: SimulatedTest) -> str:
    """The truth as JSON text."""
    return json.dumps(truth_document(scenario, test), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
