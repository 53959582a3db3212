"""How often a bias that follows a swinging temperature is suggested or remarked, on independent records.

Each record has a sine of temperature of a random period, phase and size. The bias follows it so that the scale factor is
moved by 1 to 5 of its standard uncertainties. The same noise without the bias gives the shift, and a sound record.
``python -m tests.calibration.made.temperature --tests 30 --record`` writes the table of docs/accuracy.md.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass, replace

import numpy as np
from benchmarks import measured
from numpy.typing import NDArray
from scipy.stats import norm

import piga
from tests.calibration.made.independent import Bench, head

Array = NDArray[np.float64]

TERMS = ("scale_factor", "tan_beta", "k0")
BENCHES = (
    Bench(forces=head(8), seconds=40.0, rate=10.0),
    Bench(forces=head(16), seconds=20.0, rate=10.0),
    Bench(forces=head(12), seconds=20.0, rate=10.0, walk=5e-5),
    Bench(forces=head(24), seconds=60.0, rate=5.0),
)
BANDS = ((30.0, 100.0), (100.0, 300.0), (300.0, 1000.0), (1000.0, 3000.0))
LARGEST = 5e-5
"""Largest k0_T [g/K]; it is the largest that the product takes to be possible."""
ALARMS = 0.01
"""False alarms of the best test."""


@dataclass(frozen=True)
class Said:
    """What a calibration says of the temperature."""

    suggested: bool
    remarked: bool

    @property
    def anything(self) -> bool:
        return self.suggested or self.remarked


@dataclass(frozen=True)
class Swing:
    """A sound record, and the same with a bias that follows the temperature; None where k0_T would be too large.

    ``shift`` is that of the scale factor in its standard uncertainty, ``signature`` is k0_T over its own standard
    uncertainty in a fit with ``k0_T``.
    """

    sound: Said
    moved: Said | None = None
    shift: float = 0.0
    signature: float = 0.0

    @property
    def best_power(self) -> float:
        """Probability that the best two-sided test sees the bias, at :data:`ALARMS` false alarms."""
        limit = float(norm.isf(ALARMS / 2.0))
        return float(norm.sf(limit - self.signature) + norm.cdf(-limit - self.signature))


def said(calibration: piga.Calibration) -> Said:
    """What a calibration says of the temperature."""
    terms = [(*entry.terms, *entry.alike) for entry in calibration.diagnostics.missing_terms]
    return Said(
        any("k0_T" in names for names in terms),
        any("does not exclude a bias that follows the temperature" in remark for remark in calibration.remarks),
    )


def swinging(rng: np.random.Generator, band: tuple[float, float]) -> Bench:
    """A bench whose temperature swings with a random period of a band [s], phase and size (0.1 to 3 K)."""
    period = math.exp(rng.uniform(*np.log(band)))
    size, phase = 3.0 ** rng.uniform(-2.1, 1.0), rng.uniform(0.0, 2.0 * np.pi)
    bench = BENCHES[int(rng.integers(len(BENCHES)))]
    return replace(bench, warmth=lambda t: size * np.sin(2.0 * np.pi * t / period + phase))


def one_swing(seed: int, band: tuple[float, float], shift: float | None = None) -> Swing:
    """A random record of a band of periods [s]; ``shift`` is a random one of 1 to 5 if it is not given."""
    rng = np.random.default_rng([seed, round(band[0]), 1909])
    bench = swinging(rng, band)
    wanted = rng.uniform(1.0, 5.0) if shift is None else shift
    sign = rng.choice([-1.0, 1.0])
    sound = piga.calibrate(bench.record(seed), TERMS)
    probe = piga.calibrate(replace(bench, k0_T=1e-6).record(seed), TERMS)
    name = "scale_factor"
    slope = (probe[name].value - sound[name].value) / 1e-6
    k0_T = wanted * sound[name].std / max(abs(slope), 1e-300)
    if k0_T > LARGEST:
        return Swing(said(sound))
    moved = piga.calibrate(replace(bench, k0_T=sign * k0_T).record(seed), TERMS)
    own = piga.calibrate(bench.record(seed), (*TERMS, "k0_T"))["k0_T"].std
    moves = abs(moved[name].value - sound[name].value) / moved[name].std
    return Swing(said(sound), said(moved), moves, k0_T / own)


def shares(swings: list[Swing]) -> dict[str, float]:
    """Numbers of records, and shares [%] of what is said; of the biased, those that move K by more than u."""
    biased = [swing for swing in swings if swing.moved and swing.shift > 1.0]

    def percent(values: list[float]) -> float:
        return round(100.0 * float(np.mean(values)), 1) if values else math.nan

    moved = [swing.moved for swing in biased if swing.moved]
    return {
        "records": len(moved),
        "best test": percent([swing.best_power for swing in biased]),
        "suggested": percent([item.suggested for item in moved]),
        "suggested or remarked": percent([item.anything for item in moved]),
        "sound records": len(swings),
        "sound: suggested": percent([swing.sound.suggested for swing in swings]),
        "sound: remarked": percent([swing.sound.remarked for swing in swings]),
    }


def campaign(band: tuple[float, float], tests: int) -> dict[str, float]:
    """Records of a band until so many are moved."""
    swings: list[Swing] = []
    moved = 0
    while moved < tests:
        swings.append(one_swing(len(swings), band))
        moved += swings[-1].moved is not None and swings[-1].shift > 1.0
    return shares(swings)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tests", type=int, default=30)
    parser.add_argument("--record", action="store_true", help="put the figures into docs/measured")
    chosen = parser.parse_args()
    for band in BANDS:
        figures = campaign(band, chosen.tests)
        row = f"{band[0]:g} to {band[1]:g} s"
        sys.stdout.write(f"{row}: {figures}\n")
        sys.stdout.flush()
        if chosen.record:
            measured.record("temperature", {f"{row}: {column}": value for column, value in figures.items()})


if __name__ == "__main__":
    main()
