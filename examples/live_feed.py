"""A live feed over a socket on this machine: samples go in, specific force comes out, row by row.

Run it as it stands: ``python examples/live_feed.py``. A 'logger' thread sends the samples of a cross-coupled
instrument as lines of JSON, as a data acquisition would; the main thread compensates each line as it comes.
"""

from __future__ import annotations

import json
import socket
import sys
import threading

import numpy as np

import piga
from piga.compensation import identify_phase
from piga.units import G0

RATE, REST, ROWS = 100.0, 30.0, 4000


def made_record() -> piga.Run:
    """A made instrument at rest for 30 s, then under a slow sine; its angle starts anywhere."""
    inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec", alpha0="77 deg")
    t = np.arange(ROWS) / RATE
    a_x = G0 * (0.8 + np.where(t > REST, 0.2 * np.sin(2.0 * (t - REST)), 0.0))
    f = np.stack([a_x, np.full(ROWS, 0.6 * G0), np.zeros(ROWS)], axis=1)
    noise = 2e-6 * np.random.default_rng(1).standard_normal(ROWS)
    psi = piga.propagate(inst, t, f) - inst.alpha0 + noise
    return piga.Run.from_arrays(t, psi, f, scale_factor=inst.scale_factor, serial="example", units="SI")


def made_calibration(record: piga.Run) -> piga.Calibration:
    """Calibrate the same instrument on its own record (a real one comes from its test: calibration.json)."""
    return piga.calibrate(record, terms=["tan_beta", "k0"])


def logger(address: tuple[str, int], record: piga.Run) -> None:
    """Send one line per sample."""
    with socket.create_connection(address) as link, link.makefile("w", encoding="ascii") as lines:
        for t, output, force in zip(record.t, record.output, record.f, strict=True):
            lines.write(json.dumps({"t": t, "output": output, "f": force.tolist()}) + "\n")


def main() -> None:
    """Feed, compensate, compare."""
    record = made_record()
    calibration = made_calibration(record)
    phase = identify_phase(record, calibration, REST)
    stream = piga.Compensator(calibration, phase=phase)
    velocity, rows = 0.0, 0
    with socket.create_server(("127.0.0.1", 0)) as server:
        sender = threading.Thread(target=logger, args=(server.getsockname(), record))
        sender.start()
        link, _ = server.accept()
        with link, link.makefile("r", encoding="ascii") as lines:
            for line in lines:
                result = stream.push(json.loads(line))
                velocity += float(result.dv[0])
                rows += 1
                if rows % 1000 == 0:
                    force = f"a_x = {result.ax[0] / G0:.6f} g, u = {result.u_ax[0] / G0:.1e} g"
                    sys.stdout.write(f"t = {result.t[0]:6.2f} s: {force}\n")
        sender.join()
    truth = float(np.sum(np.diff(record.t) * 0.5 * (record.f[1:, 0] + record.f[:-1, 0])))
    sys.stdout.write(f"{rows} rows, velocity {velocity:.6f} m/s, reference {truth:.6f} m/s\n")


if __name__ == "__main__":
    main()
