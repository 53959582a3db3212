"""Coverage-guided fuzzing of every reader: ``python -m builders.fuzz_readers TARGET --runs N --seed S``.

Needs ``pip install atheris``. Each input is read as the program would read it; a refusal must be a ``PigaError``
with a remedy. Anything else is a finding: the run stops and the input is left in ``--findings``. What was found is
kept in ``tests/formats/findings`` and read again by the tests.

Containers are read in the fuzzing process, under the limit on memory that their own process has, so that a run of
1e5 takes minutes. Where the library itself hangs or crashes, the input is read again as the program does, in a
process of its own: when that ends in a refusal within 10 s of computing it is counted as contained and the run goes on.
HDF5 files, on which the library often hangs, are first tried in a forked child that may compute for a sixth of a second; what the
child survives is read in the fuzzing process, which learns from it.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import logging
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["piga.records", "piga.units"]):
    from piga.formats.columns import RecordStream
    from piga.formats.containers.container import READERS, read_container
    from piga.formats.parquet import ParquetStream
    from piga.formats.text.reader import TextStream
    from piga.records.calibration.document import read_calibration
    from piga.records.run_file import read_run_file

from builders.fuzz_seeds import NAMES, SEEDS, SUFFIX, seeds

from piga.errors import PigaError

PATIENCE = 0.15
"""Computing time of the child for an input [s]: what takes longer is read as the program does, or taken as ended."""
PROVEN = 20
"""Inputs that end the child: so many are read as the program does, the others are taken as ended in the same way."""
MEMORY = 4 << 30
"""Address space [bytes]; the process that reads containers has 6 GiB."""


def drain(stream: RecordStream) -> None:
    """Take every chunk and what was found."""
    for _ in stream.chunks():
        pass
    stream.events()


def reader(target: str, path: Path) -> Callable[[int], object]:
    """How the target reads ``path``; the number varies the options."""
    if target == "csv":
        return lambda choice: drain(
            TextStream(
                path,
                NAMES,
                "seg" if choice & 1 else None,
                mask_damaged=bool(choice & 2),
                piece=600 if choice & 4 else 1 << 20,
            )
        )
    if target == "run-file":
        return lambda _: read_run_file(path)
    if target == "parquet":
        return lambda choice: drain(ParquetStream(path, NAMES, "n" if choice & 1 else None))
    if target == "calibration":
        return lambda _: read_calibration(path)
    labels = ("pos", None, "n") if target == "hdf5" else (None, "n")
    return lambda choice: READERS[path.suffix](path, NAMES, labels[choice % len(labels)])


def main() -> None:
    options = argparse.ArgumentParser(description="Coverage-guided fuzzing of a reader")
    options.add_argument("target", choices=list(SEEDS))
    options.add_argument("--runs", type=int, default=100_000)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--findings", type=Path, default=Path("findings"))
    options.add_argument("--inside", action="store_true", help="this is the fuzzing process itself")
    chosen = options.parse_args()
    chosen.findings.mkdir(parents=True, exist_ok=True)
    if not chosen.inside:
        sys.exit(supervise(chosen))
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, resource.RLIM_INFINITY))
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as name:
        fuzz(chosen, Path(name))


def supervise(chosen: argparse.Namespace) -> int:
    """Run the fuzzing process until it has done its executions; 1 when there is a finding."""
    left, seed, contained = chosen.runs, chosen.seed, 0
    corpus = chosen.findings / f"corpus-{chosen.target}"
    corpus.mkdir(exist_ok=True)
    while left > 0:
        before = set(chosen.findings.iterdir())
        command = [
            sys.executable,
            "-m",
            "builders.fuzz_readers",
            chosen.target,
            "--inside",
            f"--runs={left}",
            f"--seed={seed}",
        ]
        done = subprocess.run(
            [*command, f"--findings={chosen.findings}"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True, errors="replace", check=False,
        )  # fmt: skip
        counted = re.findall(r"number_of_executed_units: (\d+)", done.stdout)
        left -= max(int(counted[-1]) if counted else 1, 1)
        lines = [line for line in done.stdout.splitlines() if " executions, " in line]
        print(f"seed {seed}: {lines[-1] if lines else done.stdout[-300:]}", flush=True)
        new = sorted(set(chosen.findings.iterdir()) - before)
        if done.returncode and (
            not new or not all(is_contained(chosen.target, path, contained) for path in new)
        ):
            print(done.stdout[-3000:], flush=True)
            return 1
        contained += len(new)
        seed += 1
    print(
        f"{chosen.target}: {chosen.runs - left} executions, {contained} ended by the reading process",
        flush=True,
    )
    return 0


class Trial:
    """A forked child that reads each input first and may compute for PATIENCE on it."""

    def __init__(self, read: Callable[[int], object]) -> None:
        self.read = read
        self.child = 0

    def survives(self, choice: int) -> bool:
        """Whether the child comes back from this input."""
        if not self.child:
            self.begin()
        os.write(self.to_child, bytes([choice]))
        if os.read(self.from_child, 1):
            return True
        os.waitpid(self.child, 0)
        os.close(self.to_child)
        os.close(self.from_child)
        self.child = 0
        return False

    def begin(self) -> None:
        asked, self.to_child = os.pipe()
        self.from_child, answer = os.pipe()
        self.child = os.fork()
        if self.child == 0:
            os.close(self.to_child)
            os.close(self.from_child)
            self.serve(asked, answer)
        os.close(asked)
        os.close(answer)

    def serve(self, asked: int, answer: int) -> None:
        """Read what is asked for until the parent closes its end."""
        for caught in (
            signal.SIGSEGV,
            signal.SIGBUS,
            signal.SIGFPE,
            signal.SIGILL,
            signal.SIGABRT,
            signal.SIGPROF,
        ):
            signal.signal(caught, signal.SIG_DFL)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        while choice := os.read(asked, 1):
            signal.setitimer(signal.ITIMER_PROF, PATIENCE)
            with contextlib.suppress(Exception):
                self.read(choice[0])
            os.write(answer, b".")
        os._exit(0)


def is_contained(target: str, path: Path, before: int) -> bool:
    """Whether the program, which reads containers in a process of their own, refuses this input within 10 s of computing.

    After the first ten, endless loops are taken as ended by the limit on computing time, which knows no exception.
    """
    if target not in ("hdf5", "mat", "tdms", "xlsx"):
        return False
    if before >= 10 and "-timeout-" in path.name:
        return True
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name) / f"run{SUFFIX.get(target, '.' + target)}"
        copy.write_bytes(path.read_bytes()[1:])
        begun = _computing()
        try:
            read_container(copy, copy.suffix, NAMES, None)
        except PigaError as error:
            print(
                f"{path.name}: {error.message[-120:]} ({_computing() - begun:.1f} s of computing)", flush=True
            )
            return bool(error.remedy) and _computing() - begun < 10.0
    return True


def _computing() -> float:
    """Computing time of the processes started here [s]: the machine may be busy with others."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def fuzz(chosen: argparse.Namespace, folder: Path) -> None:
    """Run atheris on one target."""
    corpus = chosen.findings / f"corpus-{chosen.target}"
    corpus.mkdir(exist_ok=True)
    for index, seed in enumerate(seeds(chosen.target)):
        (corpus / f"{index}").write_bytes(b"\0" + seed)
    path = folder / f"run{SUFFIX.get(chosen.target, '.' + chosen.target)}"
    read = reader(chosen.target, path)
    trial = Trial(read)
    slowest, started, count, contained = 0.0, time.monotonic(), 0, 0

    def report() -> None:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        words = (
            f"{contained} contained, {time.monotonic() - started:.0f} s, slowest {slowest:.3f} s, {peak:.0f} MB"
        )
        print(f"{count} executions, {words}", flush=True)

    def one(data: bytes) -> None:
        nonlocal slowest, count, contained
        path.write_bytes(data[1:])
        if chosen.target == "hdf5" and not trial.survives(data[0] if data else 0):
            keep = chosen.findings / f"hdf5-ended-{hashlib.sha1(data).hexdigest()}"
            keep.write_bytes(data)
            if contained < PROVEN and not is_contained(chosen.target, keep, contained):
                raise RuntimeError(f"{keep} is not refused by the program")
            count, contained = count + 1, contained + 1
            return
        begun = time.monotonic()
        try:
            read(data[0] if data else 0)
        except PigaError as error:
            if not error.remedy:
                raise
        except MemoryError:
            if chosen.target not in ("hdf5", "mat", "tdms", "xlsx"):
                raise
        count += 1
        slowest = max(slowest, time.monotonic() - begun)
        if count % 5000 == 0 or count == chosen.runs:
            report()

    arguments = [
        sys.argv[0],
        str(corpus),
        f"-runs={chosen.runs}",
        f"-seed={chosen.seed}",
        f"-timeout={120 if chosen.target == 'hdf5' else 10}",
        "-rss_limit_mb=2048",
        "-report_slow_units=200",
        f"-max_len={4000 if chosen.target in ('csv', 'run-file') else 20000}",
        "-len_control=0",
        f"-artifact_prefix={chosen.findings}/{chosen.target}-",
        "-verbosity=0",
        "-print_final_stats=1",
    ]
    atheris.Setup(arguments, one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
