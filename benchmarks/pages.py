"""Tables of the page on accuracy: ``python -m benchmarks.pages [TABLE ...] [--record]``.

Truth is SciPy on the equations of motion (``tests/instrument/servo_truth.py``), not piga's own kernels. Every table takes
less than a minute. With ``--record`` it goes into ``docs/measured``; then run ``python benchmarks/measured.py``.
"""

from __future__ import annotations

import argparse
import math
import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from benchmarks.measured import ROOT, Figure, Value, rounded, write
from tests.instrument.servo_truth import centrifuge_record

from piga.units import G0

Rows = dict[str, dict[str, Value | Figure]]
BODY = "rigid body by SciPy, `tests/instrument/servo_truth.py`"


def servo_fit() -> dict:
    """Calibrations of a head and a centrifuge of the rigid body."""
    from tests.calibration.test_servo_truth import BODY as TILTED
    from tests.calibration.test_servo_truth import HEAD, head, off, run_of

    import piga

    rows: Rows = {}
    cases = {
        "head, 12 positions of 20 s": (),
        "head, and levels of -10, -8, 8, 10 g": (-10.0, -8.0, 8.0, 10.0),
        "head, and levels of -8, 8, 10 g": (-8.0, 8.0, 10.0),
    }
    for name, levels in cases.items():
        runs = [run_of(head())]
        if levels:
            runs.append(
                run_of(centrifuge_record(TILTED, np.array(levels) * G0, dwell=20.0, sampling=0.04), seed=2)
            )
        errors = off(piga.calibrate(runs if levels else runs[0], HEAD))
        rows[name] = {"K": {"value": rounded(errors["K"], 1), "unit": "ppm"}}
        for key in ("tan_beta", "servo", "servo_damping"):
            rows[name][f"`{key}`"] = {"value": rounded(100 * errors[key], 1), "unit": "%"}
    return {
        "corner": "record",
        "rows": rows,
        "conditions": f"errors of the coefficients; {BODY}, tan_beta = {math.tan(TILTED.beta):.3g}, white noise of 2e-7 rad",
    }


def servo_compensated() -> dict:
    """Errors of compensated records of the rigid body, with and without the terms."""
    from tests.compensation.test_compensator_servo import BASIC, SERVO, WHOLE, error, record

    rows: Rows = {}
    for force in ((1.0, 5.0, 0.0), (-1.0, 5.0, 1.0), (2.0, 3.0, -4.0)):
        cells: dict[str, Value | Figure] = {}
        for name, values in (
            ("without the terms", BASIC),
            ("with `servo`", {**BASIC, "servo": SERVO}),
            ("with both", WHOLE),
        ):
            left = error(record(*force), values) * 1e6
            cells[f"{name}: mean"] = {"value": round(float(left.mean()), 1), "unit": "micro-g"}
            cells[f"{name}: largest row"] = {"value": rounded(float(np.abs(left).max()), 2), "unit": "micro-g"}
        rows[", ".join(f"{x:g}" for x in force)] = cells
    return {
        "corner": "force [g]",
        "rows": rows,
        "conditions": f"{BODY}, K = 0.8885 (rad/s)/g, k_i = 3000, k_p = 30, s = d = 13.16 micro-g/g³, records of a turn at 20 Hz",
    }


def compensation_turning() -> dict:
    """Largest error of a row on the swaying base of the tests, with the chord alone and with the second derivative."""
    from tests.compensation.test_compensator_turning_base import K, left, record, steady, swaying

    rows: Rows = {}
    turn = 2.0 * math.pi * 0.3
    for rate in (50.0, 100.0):
        columns = record(rate, 20.0, steady, swaying)
        t = columns[0]
        mean = -0.3 * np.diff(np.cos(turn * t)) * rate / turn
        chord = 0.15 * (np.sin(turn * t[1:]) + np.sin(turn * t[:-1])) - mean
        error, _ = left(columns)
        rows[f"{rate:g} Hz"] = {
            "chord alone": rounded(1e6 * np.abs(chord).max() / (K * G0), 2),
            "with the second derivative": rounded(1e6 * np.abs(error[2:]).max(), 2),
            "median of that": rounded(1e6 * float(np.median(np.abs(error[2:]))), 2),
        }
    return {
        "corner": "0.3 rad/s at 0.3 Hz, error of a row",
        "rows": rows,
        "units": dict.fromkeys(rows["50 Hz"], "micro-g"),
        "conditions": "truth by SciPy, `tests/compensation/test_compensator_turning_base.py`, 20 s without the first two intervals",
    }


def compensation_starts() -> dict:
    """Errors and uncertainties of the first two intervals of stretches, where the specific force changes."""
    from tests.compensation.test_compensator_turning_base import QUIET, calibration, record, still, surging

    import piga

    rows: Rows = {}
    for rate in (5.0, 20.0, 100.0):
        t, psi, f, omega, mean = record(rate, 6.0, surging, still)
        begins = np.arange(t.size) % 3 == 0
        first = np.flatnonzero(begins[:-1])
        compensated = piga.Compensator(calibration(QUIET)).push(
            {"t": t, "output": psi, "f": f, "base_rate": omega, "begins": begins}
        )
        error = 1e6 * np.abs(compensated.ax[1:] - mean) / G0
        u = 1e6 * compensated.u_ax[1:] / G0
        row: dict[str, Value | Figure] = {}
        for name, at in (("first", first), ("second", first[first < t.size - 2] + 1)):
            row[f"{name} interval: largest error"] = rounded(float(error[at].max()), 2)
            row[f"{name} interval: median `u_ax`"] = rounded(float(np.median(u[at])), 2)
        rows[f"{rate:g} Hz"] = row
    return {
        "corner": "sampling",
        "rows": rows,
        "units": dict.fromkeys(rows["5 Hz"], "micro-g"),
        "conditions": "truth by SciPy, `tests/compensation/test_compensator_turning_base.py`; a_x = 1 + 0.3 sin g at 0.75 Hz, "
        "5 g across, stretches of two intervals",
    }


def fixed(value: float, decimals: int, unit: str = "1") -> Figure:
    """A cell with so many decimals."""
    return {"value": round(float(value), decimals) + 0.0, "unit": unit, "decimals": decimals}


def twin_loop() -> dict:
    """Nutation and margins of the presets."""
    from piga.instrument.twin.linear import analyse_loop
    from piga.instrument.twin.parameters import PRESETS

    turn, rows = 2.0 * math.pi, {}
    for name, p in PRESETS.items():
        a = analyse_loop(p)
        cells = {
            "H/sqrt(J_x B)": fixed(p.nutation / turn, 1, "Hz"),
            "nutation in the loop": fixed(a.nutation / turn, 1, "Hz"),
            "damping": fixed(a.nutation_damping, 2),
            "crossover": fixed(a.crossover / turn, 1, "Hz"),
            "phase margin": fixed(math.degrees(a.phase_margin), 1, "deg"),
            "gain margin": fixed(20.0 * math.log10(a.gain_margin), 1, "dB"),
            "bandwidth": fixed(a.bandwidth / turn, 0, "Hz"),
        }
        rows[name] = {column: cell for column, cell in cells.items() if math.isfinite(cell["value"])}
    return {
        "corner": "preset",
        "rows": rows,
        "conditions": "an empty gain margin: no gain makes the loop unstable",
    }


def twin_round_trip() -> dict:
    """A twin on a dividing head, calibrated without the servo's terms, with the predicted error taken off, with the terms."""
    import tempfile
    from pathlib import Path

    from tests.stand.simulated import predicted_angle_error

    import piga
    from piga.stand import read_scenario, run_scenario
    from piga.stand.write_run import coefficients, run_file_text, write_data

    scenario = read_scenario(ROOT / "examples" / "twin.toml")
    test = run_scenario(scenario)
    truth = {v.name: v.value for v in coefficients(test)}
    with tempfile.TemporaryDirectory() as folder:
        write_data(test, Path(folder) / "run.parquet")
        path = Path(folder) / "run.toml"
        path.write_text(run_file_text(scenario, test, "run.parquet"), encoding="utf-8")
        run = piga.read_run(path)
    plain = [name for name in run.model.terms if not name.startswith("servo")]
    full = piga.calibrate(run)
    fits = {
        "without the terms": piga.calibrate(run, plain),
        "predicted error taken off": piga.calibrate(
            replace(run, output=run.output - predicted_angle_error(test)), plain
        ),
        "with the terms": full,
    }
    rows: Rows = {}
    for c in full.coefficients:
        values = {"truth": truth[c.name]}
        values |= {
            name: fit[c.name].value
            for name, fit in fits.items()
            if c.name in {b.name for b in fit.coefficients}
        }
        rows[f"{c.name} [{c.unit}]"] = {
            column: {"value": rounded(value, 7), "digits": 7} for column, value in values.items()
        } | {"u": rounded(c.std, 2), "error/u": fixed((c.value - truth[c.name]) / c.std, 1)}
    rows["residual, rms [rad]"] = {name: rounded(fit.residual_rms) for name, fit in fits.items()}
    return {
        "corner": "coefficient",
        "rows": rows,
        "conditions": "`examples/twin.toml`; u is the standard uncertainty with the terms",
    }


TABLES: tuple[Callable[[], dict], ...] = (
    servo_fit, servo_compensated, compensation_turning, compensation_starts, twin_loop, twin_round_trip,
)  # fmt: skip


def main() -> None:
    """Compute the tables that are named, or all."""
    tables = {table.__name__.replace("_", "-"): table for table in TABLES}
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tables", nargs="*", choices=[*tables, []], help="all when none is named")
    parser.add_argument("--record", action="store_true", help="write them into docs/measured")
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    for name in asked.tables or tables:
        table = tables[name]()
        print(table)
        if asked.record:
            write(name, command=f"python -m benchmarks.pages {name}", **table)


if __name__ == "__main__":
    main()
