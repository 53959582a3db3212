"""A direct accelerometer simulated with NumPy alone: a tumble on a head, positions there and back."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from piga.results import Array

G = 9.80665
TERMS = ("scale_factor", "k0", "k2", "k3", "m_Y")


@dataclass(frozen=True)
class Tumble:
    """A tumble; ``K`` in output units per g, the other coefficients in powers of g, ``noise`` in output units."""

    K: float = 0.6
    truth: dict[str, float] = field(default_factory=lambda: {"k0": 2e-3, "k2": 20e-6, "k3": 5e-6, "m_Y": 3e-4})
    noise: float = 2e-6
    samples: int = 100
    step: float = 0.1
    seed: int = 1

    def force(self) -> tuple[Array, Array, Array]:
        """Time [s], segment and specific force [g] (n, 3): 24 positions there and back."""
        there = np.arange(24) * np.pi / 12.0
        angle = np.repeat(np.concatenate((there, there[::-1] + 0.01)), self.samples)
        segment = np.repeat(np.arange(48), self.samples)
        t = self.step * np.arange(angle.size) + 30.0 * segment
        return t, segment, np.stack((np.cos(angle), np.sin(angle), np.zeros(angle.size)), axis=1)

    def rate(self) -> Array:
        """Output at every sample."""
        x, y, _ = self.force()[2].T
        c = self.truth
        indicated = x + c["k0"] + c["k2"] * x**2 + c["k3"] * x**3 + c["m_Y"] * y + c.get("k1a", 0.0) * np.abs(x)
        noise = np.random.default_rng(self.seed).standard_normal(x.size)
        return np.asarray(self.K * indicated + self.noise * noise)

    def pulses(self) -> Array:
        """Pulses of a voltage-to-frequency converter in each sample."""
        count = np.floor(np.cumsum(self.rate() * self.step) + 0.37)
        return np.diff(count, prepend=0.0)

    def write(self, folder: Path, kind: str, unit: str, scale_factor: str, more: str = "") -> Path:
        """The log and its run file. Returns the run file."""
        t, segment, f = self.force()
        output = {"rate": self.rate, "pulses": self.pulses, "counts": lambda: np.cumsum(self.pulses())}[kind]()
        table = np.column_stack((t, output, f, segment))
        np.savetxt(
            folder / "log.csv", table, delimiter=",", header="t,out,fx,fy,fz,p", comments="", fmt="%.12g"
        )
        stated = f', unit = "{unit}"' if unit else ""
        path = folder / "run.toml"
        path.write_text(
            f"""
[instrument]
serial = "QA-1"
kind = "direct"
scale_factor = "{scale_factor}"

[data]
file = "log.csv"
time = {{ column = "t", unit = "s" }}
output = {{ column = "out", kind = "{kind}"{stated} }}
reference = {{ columns = ["fx", "fy", "fz"], unit = "g" }}
segment = "p"

[model]
terms = {list(TERMS)}

[uncertainty]
reference_misalignment = "0.2 arcsec"
waived = {{ reference_scale = "gravity", reference_bias = "gravity", timing = "clock", vibration = "still" }}
{more}"""
        )
        return path
