"""Mutated files of every kind, and inputs that fuzzing found once: read, or refused with a remedy; nothing else may happen."""

from __future__ import annotations

import os
import random
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest

import piga
from piga.formats.columns import ParquetStream
from piga.formats.container import columns_stream
from piga.formats.text.convention import TextOptions
from piga.formats.text.reader import TextStream
from piga.records.run_file import read_run_file
from tests.records.containers import WRITERS, columns
from tests.records.files import lines, write_run

SCALE = int(os.environ.get("PIGA_FUZZ", "1"))


NAMES = ("t", "n", "fx", "fy", "fz")


LOG = ("t,n,fx,fy,fz\n" + "\n".join(lines(8)) + "\n").encode()


PIECES = [b",", b";", b"\n", b"\r", b"\0", b'"', b"\t", b"nan", b"inf", b"1e999", b"-", b"\xef\xbb\xbf", b"\xff\xfe",
          "１".encode(), "时间".encode("gb18030"), b"#", b" ", b"1,5", b"[s]", b"9" * 30, b"\x1a", b"|"]  # fmt: skip


def outcome(work: Callable[[], object]) -> bool:
    """True when it was read, False when it was refused with a remedy."""
    try:
        work()
    except piga.PigaError as error:
        assert error.remedy  # noqa: PT017 - either outcome is right
        return False
    return True


def seeded(seed: int) -> random.Random:
    """The same mutations every time."""
    return random.Random(seed)


def mutated(source: bytes, draw: random.Random) -> bytes:
    """A few bytes changed, removed, doubled or put in."""
    data = bytearray(source)
    for _ in range(draw.randint(1, 6)):
        at = draw.randrange(len(data) + 1)
        kind = draw.randrange(4)
        if kind == 0 and at < len(data):
            data[at] = draw.randrange(256)
        elif kind == 1:
            del data[at : at + draw.randint(1, 40)]
        elif kind == 2:
            data[at:at] = draw.choice(PIECES)
        else:
            data[at:at] = data[at : at + draw.randint(1, 40)]
    return bytes(data)


@pytest.mark.parametrize("mask", [False, True])
def test_mutated_text(tmp_path: Path, mask: bool) -> None:
    draw, path = seeded(1), tmp_path / "log.csv"
    kept = 0
    for _ in range(700 * SCALE):
        path.write_bytes(mutated(LOG, draw))
        kept += outcome(
            lambda: list(TextStream(path, NAMES[:4], "fz", TextOptions(mask_damaged=mask)).chunks())
        )
    assert kept > 0


def test_mutated_run_files(tmp_path: Path) -> None:
    draw = seeded(2)
    path = write_run(tmp_path, instrument="counter_bits = 16", data="range = { n = [0, 1] }")
    source = path.read_bytes()
    for _ in range(1000 * SCALE):
        path.write_bytes(mutated(source, draw))
        outcome(lambda: read_run_file(path))


@pytest.mark.parametrize("name", list(WRITERS))
def test_mutated_containers(tmp_path: Path, name: str) -> None:
    draw = seeded(4)
    path = tmp_path / name
    WRITERS[name](path, columns(8))
    source = path.read_bytes()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(70 * SCALE):
            path.write_bytes(mutated(source, draw))
            outcome(lambda: columns_stream(path, NAMES, None))


FOLDER = Path(__file__).parent / "findings"


def read(path: Path) -> object:
    if path.suffix == ".json":
        return piga.Calibration.from_json(path)
    if path.suffix == ".toml":
        return read_run_file(path)
    if path.suffix == ".csv":
        return list(TextStream(path, NAMES, None).chunks())
    if path.suffix == ".parquet":
        return list(ParquetStream(path, NAMES, None).chunks())
    return columns_stream(path, NAMES, None)


@pytest.mark.parametrize("path", sorted(FOLDER.iterdir()), ids=lambda path: path.name)
def test_refused_with_a_remedy(path: Path) -> None:
    with pytest.raises(piga.PigaError) as caught:
        read(path)
    assert caught.value.remedy
