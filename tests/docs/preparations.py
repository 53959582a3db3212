"""What must lie in a page's directory before its first block runs: files that a reader has of his own."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

import piga
from piga.units import G0

from .runner import Runner, command

PHASES = ("20 deg", "140 deg", "250 deg")


def write_run(folder: Path, name: str, t: np.ndarray, psi: np.ndarray, f: np.ndarray) -> None:
    """A CSV log of angles and its run file."""
    rows = np.column_stack([t, psi, f])
    np.savetxt(folder / f"{name}.csv", rows, delimiter=",", header="t,psi,fx,fy,fz", comments="", fmt="%.15g")
    (folder / f"{name}.toml").write_text(
        f'[instrument]\nserial = "{name}"\nscale_factor = "0.8884 rad/s/g"\n'
        f'[data]\nfile = "{name}.csv"\ntime = {{ column = "t", unit = "s" }}\n'
        'output = { column = "psi", kind = "angle", unit = "rad" }\n'
        'reference = { columns = ["fx", "fy", "fz"], unit = "m/s^2" }\n'
        '[model]\nterms = ["tan_beta", "k0"]\n'
    )


def bench(runner: Runner) -> None:
    """``run.toml``, an instrument at rest for a minute and then moved, and its ``calibration.json``."""
    t = np.arange(0.0, 120.0, 0.05)
    a_x = 1.0 + np.where(t > 60.0, 0.3 * np.sin(0.5 * (t - 60.0)), 0.0)
    f = G0 * np.column_stack([a_x, 0.6 + 0 * t, 0 * t])
    inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="74 arcsec", alpha0="50 deg")
    psi = (
        piga.propagate(inst, t, f, between="linear")
        - inst.alpha0
        + 2e-6 * np.random.default_rng(1).standard_normal(t.size)
    )
    write_run(runner.folder, "run", t, psi, f)
    piga.calibrate(piga.read_run(runner.folder / "run.toml")).to_json(runner.folder / "calibration.json")


def triad(runner: Runner) -> None:
    """``x``, ``y``, ``z``: run and calibration of three instruments on one base, and ``triad.toml``."""
    t = np.arange(0.0, 60.0, 0.02)
    f = G0 * np.column_stack([0.6 + 0.2 * np.sin(0.5 * t), 0.5 + 0.1 * np.cos(0.7 * t), 0.7 + 0 * t])
    tables = []
    for k, name in enumerate("xyz"):
        axes = np.roll(np.eye(3, dtype=int), k, axis=1)
        inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="74 arcsec", alpha0=PHASES[k])
        own = f @ axes.T
        write_run(runner.folder, name, t, piga.propagate(inst, t, own, between="linear") - inst.alpha0, own)
        piga.calibrate(piga.read_run(runner.folder / f"{name}.toml")).to_json(runner.folder / f"{name}.json")
        tables.append(
            f'[[triad.instrument]]\nrun = "{name}.toml"\ncalibration = "{name}.json"\naxes = {axes.tolist()}\n'
        )
    (runner.folder / "triad.toml").write_text("\n".join(tables))


def stream(runner: Runner) -> None:
    """Programs ``logger`` and ``consumer``, and a ``source`` of chunks for the Python block."""
    record = piga.read_run(runner.folder / "run.toml")
    rows = np.column_stack([record.t, record.output, record.f])[:1000]
    np.savetxt(runner.folder / "live.csv", rows, delimiter=",", header="t,output,fx,fy,fz", comments="")
    programs = runner.folder / "bin"
    programs.mkdir()
    for name, text in (("logger", f"cat {runner.folder}/live.csv"), ("consumer", "cat > received.csv")):
        (programs / name).write_text(f"#!/bin/sh\n{text}\n")
        (programs / name).chmod(0o755)
    runner.names["calibration"] = piga.Calibration.from_json(runner.folder / "calibration.json")
    runner.names["source"] = [
        {"t": part[:, 0], "output": part[:, 1], "f": part[:, 2:]} for part in np.array_split(rows, 4)
    ]


def lab_log(runner: Runner) -> None:
    """A log of a spreadsheet and one of a dividing head, as the page names them."""
    logs = Path(__file__).parents[1] / "data" / "logs"
    shutil.copy(logs / "iso.csv", runner.folder / "log.csv")
    shutil.copy(logs / "head-angle.csv", runner.folder / "kopf.csv")


def held_set(runner: Runner) -> None:
    """``set.csv``, a set in 25 attitudes, and ``set.toml`` as the page has it."""
    rng, parts = np.random.default_rng(4), []
    for _ in range(25):
        up = rng.standard_normal(3)
        still = 414.0 * 9.81744 * up / np.linalg.norm(up) + rng.standard_normal((200, 3))
        parts += [still, still[:50] + 500.0 * rng.standard_normal((50, 3))]
    rows = np.concatenate(parts)
    rows = np.column_stack((0.02 * np.arange(len(rows)), rows))
    np.savetxt(runner.folder / "set.csv", rows, delimiter=",", header="t,x,y,z", comments="")
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "gravity-norm.md").read_text(encoding="utf-8")
    (runner.folder / "set.toml").write_text(page.split("```toml\n")[1].split("```")[0])


def static_log(runner: Runner) -> None:
    """An instrument at rest overnight, as the page names it."""
    rng = np.random.default_rng(3)
    rate = 3600.0 + 0.2 * rng.standard_normal(20000) + 2e-4 * np.cumsum(rng.standard_normal(20000))
    rows = np.column_stack([np.arange(20000.0), rate])
    np.savetxt(
        runner.folder / "static.csv",
        rows,
        delimiter=",",
        header="t [s],rate [arcsec/s]",
        comments="",
        fmt="%.9g",
    )


def demo(_runner: Runner) -> None:
    """``piga-demo``, as ``python3 dev.py demo`` writes it."""
    command(["demo"])


PREPARATIONS: dict[str, tuple[Callable[[Runner], None], ...]] = {
    "docs/how-to/compensate.md": (bench,),
    "docs/how-to/live-stream.md": (bench, stream),
    "docs/how-to/triad.md": (triad,),
    "docs/how-to/choosing-terms.md": (bench,),
    "README.md": (demo,),
    "docs/how-to/records.md": (demo,),
    "docs/reference/examples/compensation.md": (bench,),
    "docs/reference/examples/ledger.md": (bench,),
    "docs/reference/examples/records.md": (bench,),
    "docs/reference/examples/stand.md": (bench,),
    "docs/how-to/lab-data.md": (lab_log,),
    "docs/how-to/noise.md": (static_log,),
    "docs/how-to/gravity-norm.md": (held_set,),
}
