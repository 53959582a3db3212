"""Columns of MATLAB files of level 5 (v5 to v7), unpacked piece by piece.

Plain real arrays of numbers are read, and such fields of single structs. Whatever is of another kind, doubtful or
damaged is left to SciPy, which holds a variable whole and says what is wrong with it.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError
from piga.formats.containers.array_columns import PIECE_ROWS, as_numbers, long_column, split_name
from piga.records.limits import open_regular

HEAD = 128
"""Bytes before the first element."""
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""How numbers are stored, by the type of an element."""
INT8, INT32, UINT32, MATRIX, COMPRESSED = 1, 5, 6, 14, 15
STRUCT, STRUCTURED, NUMERIC = 2, (2, 3), range(6, 16)
"""Classes of arrays: a struct; a struct or an object; double to uint64."""
KNOWN = range(1, 16)
"""Classes whose arrays begin with flags, dimensions and name."""
NOT_PLAIN = 0x0A00
"""Flags of complex and logical arrays."""
MOST_HEAD = 1 << 16
"""Bytes of names and dimensions."""
MOST_LEVELS = 4
PACKED = 1 << 16
"""Packed bytes taken at a time."""


class OtherKindError(Exception):
    """What stands here is not read here."""


@dataclass(frozen=True)
class _Array:
    """The beginning of an array: class, flags, dimensions and name."""

    kind: int
    flags: int
    shape: tuple[int, ...]
    name: str


class _Bytes:
    """The bytes of one element of the file in order, unpacked on the way."""

    def __init__(self, stream: BinaryIO, order: str, size: int, packed: bool) -> None:
        self.order = order
        self._stream, self._left = stream, size
        self._unpack = zlib.decompressobj() if packed else None

    def read(self, count: int) -> bytes:
        """So many bytes."""
        parts = []
        while count > 0:
            parts.append(self._next(count))
            count -= len(parts[-1])
        return b"".join(parts)

    def skip(self, count: int) -> None:
        """Go past so many bytes."""
        while count > 0:
            count -= len(self._next(min(count, PACKED)))

    def _next(self, most: int) -> bytes:
        """The next bytes, ``most`` at most."""
        tail = b"" if self._unpack is None else self._unpack.unconsumed_tail
        taken = tail or self._stream.read(min(most if self._unpack is None else PACKED, self._left))
        self._left -= 0 if tail else len(taken)
        found = taken if self._unpack is None else self._unpack.decompress(taken, most)
        if not taken and not found:
            raise OtherKindError
        return found

    def tag(self) -> tuple[int, int, bytes | None]:
        """Type and size of an element, and the data of one that is so small that they stand in the tag."""
        head = self.read(8)
        kind, size = struct.unpack(self.order + "II", head)
        if kind >> 16 == 0:
            return kind, size, None
        if kind >> 16 > 4:
            raise OtherKindError
        return kind & 0xFFFF, kind >> 16, head[4 : 4 + (kind >> 16)]

    def element(self, wanted: int) -> bytes:
        """The data of a small element of the type ``wanted``."""
        kind, size, data = self.tag()
        if kind != wanted or size > MOST_HEAD:
            raise OtherKindError
        if data is None:
            data = self.read(size)
            self.skip(-size % 8)
        return data

    def integers(self, wanted: int) -> tuple[int, ...]:
        """The same as 32-bit integers."""
        data = self.element(wanted)
        if len(data) % 4:
            raise OtherKindError
        return struct.unpack(f"{self.order}{len(data) // 4}{'I' if wanted == UINT32 else 'i'}", data)

    def array(self) -> _Array:
        """The beginning of an array, behind its tag."""
        flags = self.integers(UINT32)
        if len(flags) != 2 or flags[0] & 0xFF not in KNOWN:
            raise OtherKindError
        shape = self.integers(INT32)
        return _Array(flags[0] & 0xFF, flags[0], shape, self.element(INT8).decode("latin-1"))

    def field(self, of: _Array, wanted: str) -> _Array:
        """The beginning of the array in a field of a single struct."""
        if of.kind != STRUCT or of.shape != (1, 1):
            raise OtherKindError
        (length,), names = self.integers(INT32) or (0,), self.element(INT8)
        if not 0 < length <= len(names):
            raise OtherKindError
        fields = [
            names[at : at + length].split(b"\0")[0].decode("latin-1") for at in range(0, len(names), length)
        ]
        if fields.count(wanted) != 1:
            raise OtherKindError
        for name in fields:
            kind, size, data = self.tag()
            if kind != MATRIX or data is not None or size % 8:
                raise OtherKindError
            if name == wanted:
                return self.array()
            self.skip(size)
        raise OtherKindError


class MatColumns:
    """The columns of a file of level 5; ``order`` is ``<`` or ``>``, its byte order.

    ``plain`` are the names of the variables that are no structs and no objects.

    Raises
    ------
    OtherKindError
        If it holds something that has no name, or a name twice, or is damaged.
    """

    def __init__(self, path: Path, order: str) -> None:
        self._path, self._order = path, order
        self._places: dict[str, tuple[int, int, bool]] = {}
        self.plain: set[str] = set()
        with open_regular(path) as stream:
            stream.seek(HEAD)
            while len(tag := stream.read(8)) == 8:
                kind, size = struct.unpack(order + "II", tag)
                place = stream.tell(), size, kind == COMPRESSED
                if kind not in (MATRIX, COMPRESSED):
                    raise OtherKindError
                array = self._open(stream, *place)[1]
                if not array.name or array.name in self._places:
                    raise OtherKindError
                self._places[array.name] = place
                if array.kind not in STRUCTURED:
                    self.plain.add(array.name)
                stream.seek(place[0] + size)
            if tag:
                raise OtherKindError

    def _open(self, stream: BinaryIO, start: int, size: int, packed: bool) -> tuple[_Bytes, _Array]:
        stream.seek(start)
        source = _Bytes(stream, self._order, size, packed)
        if packed and source.tag()[::2] != (MATRIX, None):
            raise OtherKindError
        return source, source.array()

    def column(self, name: str) -> NDArray:
        """The numbers of ``name``, ``struct.field`` or ``name(:,2)``; long ones lie on disk.

        Raises
        ------
        OtherKindError
            If there are none, or not of this kind.
        """
        plain, column = split_name(name)
        first, *fields = plain.split(".")
        if first not in self._places or len(fields) > MOST_LEVELS:
            raise OtherKindError
        with open_regular(self._path) as stream:
            source, array = self._open(stream, *self._places[first])
            for field in fields:
                array = source.field(array, field)
            return self._numbers(source, array, name, column)

    def _numbers(self, source: _Bytes, array: _Array, name: str, column: int | None) -> NDArray:
        """All numbers of an array of one row or column, or those of one column."""
        if (
            array.kind not in NUMERIC
            or array.flags & NOT_PLAIN
            or len(array.shape) != 2
            or min(array.shape) < 0
        ):
            raise OtherKindError
        rows, columns = array.shape
        if 1 not in array.shape if column is None else not 1 <= column <= columns:
            raise OtherKindError
        kind, size, small = source.tag()
        dtype = np.dtype(source.order + NUMBERS.get(kind, "V1"))
        if dtype.kind == "V" or size != rows * columns * dtype.itemsize:
            raise OtherKindError
        start, count = (0, rows * columns) if column is None else ((column - 1) * rows, rows)
        if small is not None:
            return as_numbers(self._path, name, np.frombuffer(small, dtype)[start : start + count])
        source.skip(start * dtype.itemsize)
        found = long_column(dtype)
        for at in range(0, count, PIECE_ROWS):
            some = min(PIECE_ROWS, count - at)
            piece = np.frombuffer(source.read(some * dtype.itemsize), dtype)
            try:
                found.append(as_numbers(self._path, name, piece), count)
            except DataError:
                raise OtherKindError from None
        return found.finish()
