"""Write a simulated test as a lab would leave it: data file, run file, and the truth beside them."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from piga._version import __version__
from piga.formats.arrow_columns import label_column, number_column
from piga.records.terms import SERVO_TERMS
from piga.stand.scenario import Scenario
from piga.stand.simulate import SimulatedTest
from piga.stand.truth import coefficients, imperfection_values, predictions, shares_phase
from piga.units import G0

if TYPE_CHECKING:
    import pyarrow as pa

TRUTH_SCHEMA = "piga.truth/1"
_AXES = "xyz"
_OUTPUT = {"counts": "counts", "angle": "psi_rad", "rate": "rate_rad_s"}


def log_table(test: SimulatedTest) -> pa.Table:
    """The log as a table: ``t_s``, ``segment``, output, ``fx_g ...``, ``wx_rad_s ...``, ``T_degC``."""
    import pyarrow as pa

    log = test.log
    if all(name.isdigit() for name in log.labels):
        segment = number_column(np.array(log.labels).astype(np.int32)[log.segment])
    else:
        segment = label_column(log.segment.astype(np.int32), log.labels).dictionary_decode()
    columns = {"t_s": number_column(log.t), "segment": segment}
    columns[_OUTPUT[test.electronics.kind]] = number_column(log.output)
    columns |= {f"f{axis}_g": number_column(log.reference[:, k] / G0) for k, axis in enumerate(_AXES)}
    columns |= {f"w{axis}_rad_s": number_column(log.base_rate[:, k]) for k, axis in enumerate(_AXES)}
    columns["T_degC"] = number_column(log.temperature - 273.15)
    return pa.Table.from_arrays(list(columns.values()), names=list(columns))


def write_data(test: SimulatedTest, path: Path) -> None:
    """Write the log as Parquet or CSV, by the ending of ``path``."""
    from pyarrow import csv, parquet

    table = log_table(test)
    if path.suffix == ".csv":
        csv.write_csv(table, path, csv.WriteOptions(quoting_style="needed"))
    else:
        parquet.write_table(table, path, compression="zstd")


def run_file_text(scenario: Scenario, test: SimulatedTest, data_file: str) -> str:
    """The run file (TOML) of the test, in the form that ``piga calibrate`` takes."""
    own, electronics = scenario.table.instrument, test.electronics
    instrument: dict[str, Any] = {"serial": own.serial, "scale_factor": own.scale_factor}
    output: dict[str, Any] = {"column": _OUTPUT[electronics.kind], "kind": electronics.kind}
    if electronics.kind == "counts":
        instrument["counts_per_revolution"] = own.counts_per_revolution
        if own.counter_bits is not None:
            instrument["counter_bits"] = own.counter_bits
    else:
        output["unit"] = "rad" if electronics.kind == "angle" else "rad/s"
    if own.servo is not None:
        instrument["servo"] = given_values(msgspec.to_builtins(own.servo))
    data = {
        "file": data_file,
        "time": {"column": "t_s", "unit": "s"},
        "output": output,
        "reference": {"columns": [f"f{axis}_g" for axis in _AXES], "unit": "g"},
        "base_rate": {"columns": [f"w{axis}_rad_s" for axis in _AXES], "unit": "rad/s"},
        "temperature": {"column": "T_degC", "unit": "degC"},
        "segment": "segment",
    }
    tables = {"instrument": instrument, "data": data, "model": _model(scenario, test)}
    tables |= {
        "stand": _stand(scenario),
        "estimation": scenario.table.estimation,
        "uncertainty": _uncertainty(scenario),
    }
    comment = (
        f"# Simulated by piga {__version__} from {scenario.path.name}, model {test.model}, seed {test.seed}.\n"
    )
    return comment + "\n".join(toml_table(name, table) for name, table in tables.items() if table)


def _model(scenario: Scenario, test: SimulatedTest) -> dict[str, Any]:
    """``[model]`` as the scenario wishes it; else every term that the truth has and the servo's parameters do not give."""
    model = dict(scenario.table.model)
    if "terms" not in model:
        known = _known_servo(scenario)
        names = [value.name for value in coefficients(test) if value.name not in ("phi", "k1", *known)]
        model["terms"] = names
    model.setdefault("phase", "shared" if shares_phase(test) else "per-segment")
    return model


def _known_servo(scenario: Scenario) -> tuple[str, ...]:
    """Terms that ``[instrument] servo`` gives."""
    servo = scenario.table.instrument.servo
    if servo is None:
        return ()
    return SERVO_TERMS if servo.damping is not None else SERVO_TERMS[:1]


def _stand(scenario: Scenario) -> dict[str, Any]:
    """The stand as the scenario gives it: the budget of the calibration uses it."""
    return given_values(msgspec.to_builtins(scenario.table.stand))


def given_values(value: Any) -> Any:
    """Nested tables without the keys that are not given (TOML has no null)."""
    if isinstance(value, dict):
        return {key: given_values(item) for key, item in value.items() if item is not None}
    if isinstance(value, (list, tuple)):
        return [given_values(item) for item in value]
    return value


def _uncertainty(scenario: Scenario) -> dict[str, Any]:
    """``[uncertainty]`` as written; where the imperfections were drawn, their standard uncertainties too."""
    drawn = scenario.table.imperfections if scenario.table.run.imperfections == "drawn" else {}
    return drawn | scenario.table.uncertainty


def toml_table(name: str, table: dict[str, Any]) -> str:
    """A table of a TOML file with its header; inner tables are written inline."""
    return f"[{name}]\n" + "".join(f"{key} = {_toml(value)}\n" for key, value in table.items())


def _toml(value: Any) -> str:
    """A value as TOML: text, numbers, booleans, lists and inline tables."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return repr(value)


def truth_document(scenario: Scenario, test: SimulatedTest) -> dict[str, Any]:
    """The truth as one JSON document (schema ``piga.truth/1``)."""
    document: dict[str, Any] = {
        "schema": TRUTH_SCHEMA,
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
