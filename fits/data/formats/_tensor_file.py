"""The container of RGL's measured materials (Dupuy & Jakob 2018): named arrays, one after the other, in one file.

It starts with ``tensor_file`` and a zero byte, the version 1.0 as two bytes, and the number of fields as uint32. Each
field follows: the length of its name as uint16, the name, the number of dimensions as uint16, the type as one byte,
where its data start as uint64, and its shape as uint64. All is little-endian, and data are in C order.
"""

import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

MAGIC = b"tensor_file\0"
_VERSION = (1, 0)
_TYPES = ("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8")  # numbered from 1
_ALIGNED = 8
_MOST_FIELDS, _MOST_DIMENSIONS = 1000, 16

Fields = dict[str, NDArray]


def read_fields(path: Path) -> Fields:
    """The arrays of a file by name, mapped and not read; ValueError for what is no such file, or cut short."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError(f"{path}: does not start with {MAGIC!r}")
        header = _Header(path, file.read(min(size, 1 << 20)))
    version = header.unpack("<BB")
    if version != _VERSION:
        raise ValueError(f"{path}: a tensor file of version {version[0]}.{version[1]}, must be 1.0")
    (count,) = header.unpack("<I")
    if count > _MOST_FIELDS:
        raise ValueError(f"{path}: {count} fields announced, must be {_MOST_FIELDS} at most")
    fields: Fields = {}
    for _ in range(count):
        name, kind, offset, shape = header.field()
        if name in fields:
            raise ValueError(f"{path}: field {name!r} is there twice")
        length = kind.itemsize
        for extent in shape:
            length *= extent  # of Python's integers, which do not overflow
        if offset + length > size:
            raise ValueError(
                f"{path}: field {name!r} of shape {shape} ends at byte {offset + length}, the file at {size} "
                "(truncated?)"
            )
        mapped = length > 0
        fields[name] = np.memmap(path, kind, "r", offset, shape) if mapped else np.empty(shape, kind)
    return fields


class _Header:
    """The header before the data, read from front to back."""

    def __init__(self, path: Path, content: bytes) -> None:
        self.path, self.content, self.place = path, content, 0

    def take(self, count: int) -> bytes:
        taken = self.content[self.place : self.place + count]
        if len(taken) < count:
            raise ValueError(f"{self.path}: the file ends within its header (truncated?)")
        self.place += count
        return taken

    def unpack(self, layout: str) -> tuple[int, ...]:
        return struct.unpack(layout, self.take(struct.calcsize(layout)))

    def field(self) -> tuple[str, np.dtype, int, tuple[int, ...]]:
        (length,) = self.unpack("<H")
        raw = self.take(length)
        try:
            name = raw.decode()
        except UnicodeDecodeError:
            raise ValueError(f"{self.path}: the name of a field, {raw[:20]!r}, is not UTF-8") from None
        dimensions, kind, offset = self.unpack("<HBQ")
        if not 1 <= kind <= len(_TYPES):
            raise ValueError(f"{self.path}: field {name!r} is of type {kind}, must be in [1, {len(_TYPES)}]")
        if dimensions > _MOST_DIMENSIONS:
            raise ValueError(
                f"{self.path}: field {name!r} has {dimensions} dimensions, must be {_MOST_DIMENSIONS} at most"
            )
        return name, np.dtype(_TYPES[kind - 1]), offset, self.unpack(f"<{dimensions}Q")


def fields_as_bytes(fields: Mapping[str, NDArray | str]) -> bytes:
    """A file that holds these arrays; text becomes bytes."""
    arrays = {
        name: np.frombuffer(value.encode(), np.uint8) if isinstance(value, str) else np.ascontiguousarray(value)
        for name, value in fields.items()
    }
    offset = len(MAGIC) + struct.calcsize("<BBI")
    for name, array in arrays.items():
        offset += struct.calcsize("<HHBQ") + len(name.encode()) + 8 * array.ndim
    header = [MAGIC, struct.pack("<BBI", *_VERSION, len(arrays))]
    data = []
    for name, array in arrays.items():
        gap = -offset % _ALIGNED
        offset += gap
        label = name.encode()
        kind = _TYPES.index(array.dtype.newbyteorder("<").str.replace("|", "")) + 1
        header.append(struct.pack("<H", len(label)) + label)
        header.append(struct.pack(f"<HBQ{array.ndim}Q", array.ndim, kind, offset, *array.shape))
        data += [bytes(gap), array.astype(array.dtype.newbyteorder("<")).tobytes()]
        offset += array.nbytes
    return b"".join((*header, *data))
