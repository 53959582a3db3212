"""One thread of linear algebra inside the library, the former number outside, whatever the environment says."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest
import scipy.linalg  # noqa: F401 - brings a library of linear algebra of its own
import threadpoolctl
from threadpoolctl import threadpool_info, threadpool_limits

from piga import threads
from piga.threads import one_thread


def counts() -> set[int]:
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_one_inside_and_the_former_number_outside() -> None:
    with threadpool_limits(limits=3, user_api="blas"):
        before = counts()
        with one_thread():
            assert counts() == {1}
            with one_thread():
                assert counts() == {1}
            assert counts() == {1}
        assert counts() == before


def test_a_stop_during_the_search_for_libraries_is_not_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search runs inside a callback of C, where Python prints an interrupt and forgets it."""
    ended = []

    class Search:
        def __init__(self) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            ended.append(sum(range(1000)))  # Python would raise here

    monkeypatch.setattr(threadpoolctl, "ThreadpoolController", Search)
    threads._libraries.cache_clear()
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    try:
        with pytest.raises(KeyboardInterrupt), one_thread():
            raise AssertionError("not reached")
        assert ended
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
        threads._libraries.cache_clear()


CODE = """
import pathlib, resource, tempfile, warnings
import piga
from piga.data import copy_example
warnings.simplefilter("ignore")
run = piga.read_run(copy_example(pathlib.Path(tempfile.mkdtemp())))
piga.calibrate(run)
spent = lambda: sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
before = spent()
piga.calibrate(run)
print(spent() - before)
"""


@pytest.mark.long
@pytest.mark.parametrize("threads", [None, "4"])
def test_a_calibration_of_the_shipped_record_takes_less_than_three_seconds(threads: str | None) -> None:
    """Processor time, warm: 1.2 s; 9 to 20 s without the limit on a busy machine of two cores."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    environment = {name: value for name, value in os.environ.items() if name not in names}
    environment |= dict.fromkeys(names, threads) if threads else {}
    done = subprocess.run(
        [sys.executable, "-c", CODE], capture_output=True, text=True, check=True, env=environment
    )
    assert float(done.stdout) < 3.0
