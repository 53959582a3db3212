"""``kill -9`` of a command, many times, at random moments."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence

DRIVER = """
import os, signal, sys, time
import numpy as np
from piga.cli.main import main

def work(words):
    sys.argv = ["piga", *words]
    try:
        main()
    except SystemExit as done:
        return done.code or 0

exec(sys.argv[1])
words, kills = sys.argv[3:], int(sys.argv[2])
work(words)
started = time.monotonic()
assert work(words) == 0
usual = time.monotonic() - started
chance = np.random.default_rng(2)
for _ in range(kills):
    child = os.fork()
    if child == 0:
        os._exit(work(words))
    time.sleep(usual * chance.uniform(0.3, 1.1))
    os.kill(child, signal.SIGKILL)
    print("killed" if os.WIFSIGNALED(os.waitpid(child, 0)[1]) else "done", file=sys.stderr, flush=True)
    sys.stdin.readline()
assert work(words) == 0
"""
"""A command again and again in children of one process, in which everything is loaded: a kill takes no start-up."""


def kills(count: int, words: Sequence[str], before: str = "") -> Iterator[str]:
    """Run a command twice, kill it ``count`` times, run it again; yields ``killed`` or ``done`` after each kill.

    ``before`` is Python that is run first, for settings.
    """
    with subprocess.Popen(
        [sys.executable, "-c", DRIVER, before, str(count), *words],
        stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    ) as driver:  # fmt: skip
        assert driver.stdin is not None
        assert driver.stderr is not None
        said: list[str] = []
        for line in driver.stderr:
            said.append(line)
            if line.strip() in ("killed", "done"):
                yield line.strip()
                driver.stdin.write("\n")
                driver.stdin.flush()
        assert driver.wait() == 0, "".join(said[-30:])
