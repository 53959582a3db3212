"""Does the verdict name what makes a coefficient wrong? Records with one fault each, and sound ones.

``python -m benchmarks.verdict [CASE ...] [--records N] [--record]`` prints a row for each case: records with a coefficient
outside of its interval, those among them that nothing names, and records with a doubt. The motion is that of the model's
differential equation, integrated by SciPy; ``--record`` puts the rows into ``docs/measured``.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks import measured
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import piga
from piga.records.run_file import UncertaintyTable
from piga.stand.run_reference import stand_reference
from piga.units import ARCSEC, G0

Array = NDArray[np.float64]
K, TANGENT, PHASE, BIAS = 0.8884 / G0, 6e-4, 0.7, 1e-3 * G0
TRUTH = {"scale_factor": K * G0, "k0": 1e-3, "m_Y": 0.0}
DWELL, STEP, MOVE = 60.0, 0.5, 5.0
TERMS = ["scale_factor", "tan_beta", "k0", "k2", "m_Y"]
LEVELS = ("1 g", "2 g", "3 g", "4 g", "5 g", "6 g", "8 g", "10 g")
HEAD = {"kind": "dividing-head", "latitude": "40 deg", "height": "0 m", "azimuth": "90 deg"}
ARM = {"kind": "centrifuge", "latitude": "40 deg", "height": "0 m", "radius": "1 m", "levels": list(LEVELS)}
STATED = {"gravity": "0.1 ug", "levelling": "0.1 arcsec", "angle_error": "0.1 arcsec"}
OTHERS = ("reference_misalignment", "timing", "vibration", "settling")


@dataclass(frozen=True)
class Fault:
    """What is true of a record and not said to piga: ``force`` [m/s^2] more, ``scale`` of the force, ``turn`` [rad] about Z0.

    ``turn`` may be one for each position.
    ``creep`` [m/s^2] decays in 5 s in each position, ``servo`` [1/(m/s^2)^2] is the stiffness, ``counts`` the factor of the counts
    per turn.
    """

    force: Array | float = 0.0
    scale: float = 1.0
    turn: Array | float = 0.0
    creep: float = 0.0
    servo: float = 0.0
    counts: float = 1.0


def positions(seed: int, *, shuffled: bool = True) -> list[str]:
    """Angles of 24 positions of a head."""
    rng = np.random.default_rng([seed, 1])
    angles = rng.uniform(0.0, 15.0) + 15.0 * np.arange(24)
    return [f"{angle:.9f} deg" for angle in (rng.permutation(angles) if shuffled else angles)]


def nominal(stand: dict[str, Any], labels: list[str], uncertainty: dict[str, Any]) -> piga.Run:
    """The record of a stand as piga knows it, without an output."""
    inside = np.arange(0.0, DWELL + 0.5 * STEP, STEP)
    t = np.add.outer((DWELL + MOVE) * np.arange(len(labels)), inside).ravel()
    index = np.repeat(np.arange(len(labels), dtype=np.int32), inside.size)
    f, base_rate = stand_reference(stand, Path(), t, index, tuple(labels))
    run = piga.Run.from_arrays(
        t, np.zeros(t.size), f, base_rate=base_rate, scale_factor="0.8884 rad/s/g", segment=np.repeat(labels, inside.size),
        stand=stand, uncertainty=uncertainty, units="SI",
    )  # fmt: skip
    return replace(run, computed_reference=True)


def measured_by(run: piga.Run, fault: Fault, seed: int, walk: float = 2e-5) -> piga.Run:
    """The record with the output of an instrument under the true force."""
    edges = run.segment_edges()[:-1]
    inside = run.t[: edges[1]] - run.t[0]
    f = (fault.scale * run.f + fault.force).reshape(edges.size, inside.size, 3)
    f[:, :, :2] += np.reshape(fault.turn, (-1, 1, 1)) * f[:, :, 1::-1] * np.array([1.0, -1.0])
    u = f - (0.0 if run.base_rate is None else run.base_rate.reshape(f.shape)) / K
    force = CubicSpline(inside, u, axis=1)
    rng = np.random.default_rng([seed, 2])

    def rate(t: float, alpha: Array) -> Array:
        x, y, z = force(t).T
        across = y * np.sin(alpha) - z * np.cos(alpha)
        bias = BIAS + fault.creep * np.exp(-t / 5.0)
        return np.asarray(K * (x + bias + TANGENT * across - 2.0 * fault.servo * x * across**2))

    start = rng.uniform(0.0, 6.0, edges.size)
    alpha = solve_ivp(rate, (0.0, inside[-1]), start, "DOP853", inside, rtol=1e-10, atol=1e-9).y
    noise = walk * np.sqrt(STEP) * rng.standard_normal(alpha.shape)
    noise[:, 0] = 0.0
    output = alpha - PHASE + np.cumsum(noise, axis=1) + 2e-5 * rng.standard_normal(alpha.shape)
    return replace(run, output=output.ravel() * fault.counts)


def head(seed: int, fault: Fault, *, shuffled: bool = True, lacks: str = "") -> piga.Run:
    """A test on a dividing head. All of its sources are stated or waived, but what it ``lacks``."""
    labels = positions(seed, shuffled=shuffled)
    stand = HEAD | {"positions": {label: label for label in labels}}
    stated = STATED | {"waived": dict.fromkeys(OTHERS, "none here")}
    if lacks == "height":
        del stand["height"], stated["gravity"]
    elif lacks:
        del stated[lacks]
    return measured_by(nominal(stand, labels, stated), fault, seed)


def there_and_back(seed: int, lag: float) -> piga.Run:
    """A head that turns one way through its positions and back, and lags [rad] behind each way."""
    there = positions(seed, shuffled=False)
    visits = {
        f"{label} {way}": label for way, angles in (("up", there), ("down", there[::-1])) for label in angles
    }
    stated = STATED | {"waived": dict.fromkeys(OTHERS, "none here")}
    run = nominal(HEAD | {"positions": visits}, list(visits), stated)
    return measured_by(run, Fault(turn=np.repeat([lag, -lag], len(there))), seed)


def without_site(run: piga.Run) -> piga.Run:
    """The record with its reference logged, and no base rate."""
    stated = UncertaintyTable(reference_scale="0.1 ppm", waived=dict.fromkeys(OTHERS[:3], "none here"))
    return replace(run, base_rate=None, stand=None, computed_reference=False, uncertainty=stated)


def together(seed: int, on_head: float = 0.0, on_arm: float = 0.0) -> list[piga.Run]:
    """Head and centrifuge of one instrument, either off by an angle [rad]."""
    runs = [head(seed, Fault(turn=on_head), lacks="angle_error"), arm(seed, Fault(force=on_arm * TILT))]
    return [replace(run, input_sha256={str(k): f"{seed}{k}"}) for k, run in enumerate(runs)]


def arm(seed: int, fault: Fault) -> piga.Run:
    """A test on a centrifuge of which only the scale is stated; what turns with the arm is averaged in each level."""
    run = nominal(ARM, [f"level {k}" for k in range(15)], {"reference_scale": "0.1 ppm"})
    f, base = (_level(values, run) for values in (run.f, run.base_rate))
    return measured_by(replace(run, f=f, base_rate=base), fault, seed)


def _level(values: Array | None, run: piga.Run) -> Array:
    """Mean of the values (n, 3) in each segment, at each sample."""
    edges = run.segment_edges()
    means = np.add.reduceat(np.asarray(values), edges[:-1]) / np.diff(edges)[:, None]
    return np.ascontiguousarray(means[run.segment_index])


Said = Callable[[piga.Calibration, str, float], bool]


def doubted(*words: str) -> Said:
    """True if a doubt or a remark has one of these words."""

    def said(result: piga.Calibration, _key: str, _error: float) -> bool:
        texts = [*(doubt.words for doubt in result.verdict.doubts), *result.remarks]
        return any(word in text for text in texts for word in words)

    return said


def listed(size: dict[str, float]) -> Said:
    """True if sources that are not stated, each of this size in its unit, explain half of the error or more."""

    def said(result: piga.Calibration, key: str, error: float) -> bool:
        open_ones = [source for source in result.sources if source.status == "unstated" and source.name in size]
        effect = sum(
            max((abs(change.get(key, 0.0)) for change in source.effects.values()), default=0.0)
            * size[source.name]
            for source in open_ones
        )
        return effect > 0.5 * abs(error)

    return said


def spread(seed: int, low: float, high: float) -> float:
    """A size of a fault, drawn for each record."""
    return float(np.random.default_rng([seed, 3]).uniform(low, high))


ANGLE = 20.0 * ARCSEC
TILT = np.array([G0, 0.0, 0.0])
CASES: dict[str, tuple[Callable[[int], Any], Said]] = {
    "arm tilted by 20 arcsec, not stated": (
        lambda seed: arm(seed, Fault(force=ANGLE * TILT)), listed({"reference_misalignment": 20.0}),
    ),
    "base rate not given": (lambda seed: without_site(head(seed, Fault())), doubted("earth_rate")),
    "height of 700 m, not given": (
        lambda seed: head(seed, Fault(scale=1.0 - 2.17e-4), lacks="height"), doubted("height"),
    ),
    "creep of 20 to 100 µg after each move": (
        lambda seed: head(seed, Fault(creep=spread(seed, 2e-5, 1e-4) * G0)), doubted("creep"),
    ),
    "servo of 2 to 6.6 µg/g³, not named": (
        lambda seed: head(seed, Fault(servo=spread(seed, 2e-6, 6.6e-6) / G0**2)), doubted("servo"),
    ),
    "lag of 20 arcsec, head turned one way": (
        lambda seed: head(seed, Fault(turn=ANGLE), shuffled=False), doubted("one way"),
    ),
    "lag of 20 arcsec, head turned there and back": (lambda seed: there_and_back(seed, ANGLE), doubted("scatter")),
    "servo of 2 to 6.6 µg/g³, not named, centrifuge alone": (
        lambda seed: arm(seed, Fault(servo=spread(seed, 2e-6, 6.6e-6) / G0**2)), doubted("servo"),
    ),
    "counts per turn ten times too large": (lambda seed: head(seed, Fault(counts=0.1)), doubted("counts_per_", "nominal")),
    "head and centrifuge, 20 arcsec on the head": (
        lambda seed: together(seed, on_head=ANGLE), listed({"angle_error": 20.0, "reference_misalignment": 20.0}),
    ),
    "head and centrifuge, 20 arcsec on the arm": (
        lambda seed: together(seed, on_arm=ANGLE), listed({"angle_error": 20.0, "reference_misalignment": 20.0}),
    ),
    "sound head, all sources stated": (lambda seed: head(seed, Fault()), doubted("none")),
}  # fmt: skip


def outcome(name: str, seed: int) -> tuple[bool, bool, bool]:
    """A coefficient is outside of its interval; nothing names why; there is a doubt."""
    record, said = CASES[name]
    flat = name.startswith("arm") or name.endswith("alone")
    result = piga.calibrate(record(seed), TERMS[:4] if flat else TERMS)
    held = {c.key: c for c in result.coefficients}
    missed = {key: held[key].value - true for key, true in TRUTH.items() if key in held}
    missed = {key: error for key, error in missed.items() if abs(error) > held[key].expanded}
    return (
        bool(missed),
        any(not said(result, key, error) for key, error in missed.items()),
        result.verdict.grade != "clear",
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", metavar="CASE", help="all when none is named")
    parser.add_argument("--records", type=int, default=100)
    parser.add_argument("--record", action="store_true", help="put the figures into docs/measured")
    chosen = parser.parse_args()
    warnings.simplefilter("ignore")
    rows: dict[str, dict[str, measured.Value]] = {}
    for name in chosen.cases or CASES:
        shares = np.mean([outcome(name, seed) for seed in range(chosen.records)], axis=0) * 100.0
        rows[name] = {"records": chosen.records} | dict(zip(COLUMNS, shares.tolist(), strict=True))
        print(name, rows[name], flush=True)
    if chosen.record and not chosen.cases:
        command = f"python -m benchmarks.verdict --records {chosen.records}"
        measured.write(
            "verdict", "fault", rows, dict.fromkeys(COLUMNS, "%"), conditions=CONDITIONS, command=command
        )


COLUMNS = ("outside", "outside, nothing names it", "a doubt")
CONDITIONS = (
    "24 positions of 60 s on a head, or 8 levels of 60 s on an arm; K, k0 and m_Y; noise of 4 arcsec and 4 arcsec/√s. "
    "Outside: one of them is not in its 95 % interval"
)

if __name__ == "__main__":
    main()
