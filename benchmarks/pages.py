"""Figures of the pages on theory and platform: ``python -m benchmarks.pages [TABLE ...] [--record]``.

Truth is SciPy on the equations of motion (``tests/instrument/servo_truth.py``), not piga's own kernels. Every table takes
less than a minute. With ``--record`` it goes into ``docs/measured``; then run ``python benchmarks/measured.py``.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from benchmarks.harness import put_table
from benchmarks.measured import ROOT, Figure, Value, rounded
from tests.instrument.servo_truth import Design, centrifuge_record, mean_rate, waves

from piga.units import G0

Rows = dict[str, dict[str, Value | Figure]]
CASE = Design(K=0.8884 / G0)
BODY = "rigid body by SciPy, `tests/instrument/servo_truth.py`"


def servo_body() -> dict:
    """Change of the mean rate on a head."""
    row: dict[str, Value | Figure] = {}
    for degrees in (15, 30, 45, 60, 75):
        angle = math.radians(degrees)
        force = (G0 * math.cos(angle), -G0 * math.sin(angle), 0.0)
        shift = (mean_rate(CASE, force) / (CASE.K * force[0]) - 1.0) * 1e6
        row[f"{degrees} deg"] = {"value": round(shift, 4), "decimals": 4}
    return {
        "corner": "angle of the head",
        "rows": {"change of the mean rate": row},
        "units": dict.fromkeys(row, "ppm"),
        "conditions": f"{BODY}, at 1 g",
    }


def servo_order() -> dict:
    """The next order of the two terms and of the coupling."""
    body = replace(CASE, beta=0.0)
    rows: Rows = {}
    s, d = body.K * body.ml / (2 * body.k_i), body.c * body.K**2 / body.k_i
    for level in (1.0, 10.0, -8.0):
        w = body.K * level * G0
        mean, sine, cosine, _, _ = waves(body, (level * G0, G0, 0.0))
        printed = (body.J_y * body.k_i - body.c * body.k_p) / body.k_i**2 * w**3
        rows[f"{level:g} g, 1 g"] = {
            "factor of s": rounded(mean / (-s * w * G0**2), 5 if level == 1.0 else 4),
            "factor of d": rounded(cosine / (-d * w**2 / body.K * G0), 5 if level == 1.0 else 4),
            "change of tan_beta": rounded(sine / (body.K * G0), 4),
            "by the formula": rounded(printed, 4),
        }
    return {
        "corner": "input along, across",
        "rows": rows,
        "conditions": f"{BODY}, B = {body.J_y:g} kg m²",
    }


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


def compensated_servo() -> dict:
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


def platform_days() -> dict:
    """Lines of a day that models A and B leave in the published case, and how far the theory of A is."""
    from piga.platform.chain import compare
    from piga.platform.scenario import load_scenario

    document = compare(load_scenario(ROOT / "examples" / "platform-published.toml")).document()
    left, theory, better = document["models"]["A"], document["theory"]["A"], document["models"]["B"]
    shown = {
        "east velocity": ("east_velocity_line_m_s", 1e3, "mm/s"),
        "heading": ("heading_line_arcmin", 60.0, "arcsec"),
        "roll": ("roll_line_arcmin", 60.0, "arcsec"),
    }
    rows: Rows = {}
    for name, (key, scale, unit) in shown.items():
        for day in (1, 3, 10):
            value, expected = left[key][day - 1], theory[key][day - 1]
            row = rows.setdefault(f"model A, {name}", {})
            row[f"day {day}"] = {"value": rounded(value * scale, 4), "unit": unit}
            row = rows.setdefault(f"model A, {name}, less theory", {})
            row[f"day {day}"] = {"value": rounded(100 * (value / expected - 1), 2), "unit": "%"}
    key = "east_velocity_line_m_s"
    rows["east velocity of model B over that of A"] = {
        f"day {day}": {"value": rounded(100 * better[key][day - 1] / left[key][day - 1], 2), "unit": "%"}
        for day in (1, 3, 10)
    }
    return {
        "corner": "line of the day",
        "rows": rows,
        "conditions": "`examples/platform-published.toml`, ten days at 1 Hz",
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


TABLES: dict[str, Callable[[], dict]] = {
    "servo-body": servo_body,
    "servo-order": servo_order,
    "servo-fit": servo_fit,
    "servo-compensated": compensated_servo,
    "compensation-turning": compensation_turning,
    "compensation-starts": compensation_starts,
    "platform-days": platform_days,
}


def main() -> None:
    """Compute the tables that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tables", nargs="*", choices=[*TABLES, []], help="all when none is named")
    parser.add_argument("--record", action="store_true", help="write them into docs/measured")
    arguments = parser.parse_args()
    for name in arguments.tables or TABLES:
        table = TABLES[name]()
        put_table(name, record=arguments.record, command=f"python -m benchmarks.pages {name}", **table)


if __name__ == "__main__":
    main()
