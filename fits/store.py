"""Work that survives: what grows while it is computed, each finished piece a line of one file.

The starts of a fit, the steps of a chain, the candidates of a search and the rows of a batch are kept in this way. A
file only grows, and a record counts once its line has an end: a process that is killed, or a disk that is full, costs
the record that was being written and no other.

One process writes, and holds a lock file beside the store while it does. Readers need no lock and change nothing. Every
line carries a checksum, so that damage is reported instead of read. A fingerprint says whose work the store holds; the
work of another problem is refused.

    with Store.open("chain.store", fingerprint(data=values, seed=0)) as store:
        store.put("moves", {"kind": "stretch"})                        # one record a key, the last one counts
        store.append("steps", {"coords": coords, "log_prob": log_prob, "random_state": state})
    posterior = Store.read("chain.store")
    steps = posterior.all("steps")                                     # in the order in which they were appended

A record is what JSON can hold (lists come back in place of tuples), with numpy arrays anywhere inside: of a chain, for
instance, arrays (steps, walkers, P) and (steps, walkers) and the state of the random generator.
"""

import base64
import errno
import hashlib
import json
import os
import re
import threading
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Self

import numpy as np

from fits._files import locked, named, require_there, write_bytes

HEAD = b"layerjax store 3"
"""First line of every store, with the version of its layout; others are checksum, kind, key and record."""
_ARRAY, _WHOSE = "numpy", "fingerprint"
_LONGEST = 60  # letters of a value that a fingerprint shows


class Store:
    """The records of one file, by key; made by `Store.open` to write it, or by `Store.read`.

    Attributes:
        path: of the file.
        fingerprint: whose work it holds; empty before the first record was written.
    """

    def __init__(self, path: Path, content: bytes):
        """The records of this content; ValueError if it is no store, or not as it was written."""
        self.path = path
        self._records: dict[str, list[str]] = {}
        self._lock = threading.Lock()
        self._size = content.rfind(b"\n") + 1  # behind it is what a killed process has not finished
        head, *lines = content[: self._size].splitlines() or [b""]
        for line in lines if head == HEAD else ():
            checksum, _, row = line.partition(b"\t")
            if checksum != _checksum(row):
                raise ValueError(damaged(path))
            self._keep(row)
        self.fingerprint: dict[str, str] = self.get(_WHOSE) or {}
        if content and not self.fingerprint:
            raise ValueError(damaged(path))

    @classmethod
    @contextmanager
    def open(
        cls, path: str | Path, fingerprint: Mapping[str, str], *, replace: bool = False, fresh: bool = False
    ) -> Iterator[Self]:
        """Write a store, as the only process that does, and resume from the records that it holds.

        Args:
            path: of the file, which is made if it is not there.
            fingerprint: of the problem, see `fingerprint`.
            replace: throw records of another problem away.
            fresh: throw away whatever the file holds.

        Raises:
            ValueError: another process writes it; it is damaged, is no store, or holds the work of another problem.
            OSError: names the file: no room or no permission to write.
        """
        path = Path(path)
        with locked(path.with_name(f"{path.name}.lock"), str(path)):
            store = cls(path, b"" if fresh or not path.exists() else path.read_bytes())
            different = differences(store.fingerprint, fingerprint) if store.fingerprint else ""
            if different and not replace:
                raise ValueError(another(path, different))
            if different or not store.fingerprint:
                content = HEAD + b"\n" + _line(_WHOSE, dict(fingerprint), "put")
                write_bytes(path, content, force=True)
                store = cls(path, content)
            os.truncate(path, store._size)
            yield store

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """The records as they are now, though another process may be writing.

        FileNotFoundError: there is no such file. ValueError: it is damaged, or no store.
        """
        require_there(path)
        return cls(Path(path), Path(path).read_bytes())

    def keys(self) -> list[str]:
        """Keys of all records, in the order in which they were first written."""
        return [key for key in self._records if key != _WHOSE]

    def get(self, key: str) -> Any:
        """The record of a key, the last one of several; None without any."""
        return found[-1] if (found := self.all(key)) else None

    def all(self, key: str) -> list[Any]:
        """The records that were appended to a key."""
        return [json.loads(text, object_hook=_decoded) for text in self._records.get(key, ())]

    def put(self, key: str, record: Any) -> None:
        """Keep a record in the place of what the key has."""
        self._write(_line(key, record, "put"))

    def append(self, key: str, record: Any) -> None:
        """Keep a record behind those that the key has."""
        self._write(_line(key, record, "append"))

    def _write(self, line: bytes) -> None:
        with self._lock, named(self.path):
            if self.path.stat().st_size != self._size:
                raise OSError(errno.EIO, "Replaced, or changed, while it was written")
            try:
                with open(self.path, "r+b") as file:
                    file.seek(self._size)
                    file.write(line)
                    file.flush()
                    os.fsync(file.fileno())
            except OSError:
                with suppress(OSError):
                    os.truncate(self.path, self._size)
                raise
            self._size += len(line)
            self._keep(line.rstrip(b"\n").partition(b"\t")[2])

    def _keep(self, row: bytes) -> None:
        kind, key, record = row.decode().split("\t")
        if kind == "put":
            self._records[json.loads(key)] = []
        self._records.setdefault(json.loads(key), []).append(record)


def _line(key: str, record: Any, kind: str) -> bytes:
    """A record as a line: JSON holds no tabs and no ends of lines."""
    row = "\t".join((kind, json.dumps(key), json.dumps(record, default=_encoded))).encode()
    return _checksum(row) + b"\t" + row + b"\n"


def _checksum(row: bytes) -> bytes:
    return b"%08x" % zlib.crc32(row)


def make_directory(directory: Path, store: str) -> Path:
    """The path of the store of this name in a directory, which is made if it is not there.

    ValueError: there is no such store in it, but something that is not of one. OSError: named.
    """
    others = [one for one in directory.iterdir() if not one.name.startswith(store)] if directory.is_dir() else []
    if others and not (directory / store).is_file():
        raise ValueError(f"{directory}: is not empty, and holds no {store}: choose another directory")
    with named(directory):
        directory.mkdir(parents=True, exist_ok=True)
    return directory / store


def fingerprint(**parts: Any) -> dict[str, str]:
    """What tells the work of one problem from that of others, part by part.

    A part is a number or a word, which stands there as it is, or anything else, of which a digest does: arrays by their
    type, shape and numbers, lists and mappings by what is in them, all else by how it shows itself.
    """
    return {name: _digest(part) for name, part in parts.items()}


def differences(stored: Mapping[str, str], expected: Mapping[str, str]) -> str:
    """In words, where two fingerprints differ; empty if they do not."""
    words = []
    for name in dict.fromkeys((*stored, *expected)):
        one, other = stored.get(name, "none"), expected.get(name, "none")
        if one != other:
            hidden = one.startswith(_DIGEST) or other.startswith(_DIGEST)
            words.append(name if hidden else f"{name} {one}, not {other}")
    return ", ".join(words)


def another(path: str | Path, different: str) -> str:
    """The message of a place that holds the work of another problem."""
    return f"{path}: holds the work of another problem ({different})"


def damaged(path: str | Path) -> str:
    """The message of a file that is not as it was written."""
    return f"{path}: damaged, or no store of this version of layerjax"


def portable_repr(thing: Any) -> str:
    """As it shows itself, but not where in memory it is, which no other process knows."""
    return re.sub(r" at 0x[0-9a-fA-F]+", "", repr(thing))


_DIGEST = "sha256:"


def _digest(part: Any) -> str:
    if part is None or isinstance(part, str | int | float):
        shown = str(part)
        if len(shown) <= _LONGEST and not shown.startswith(_DIGEST):
            return shown
    found = hashlib.sha256()

    def add(value: Any) -> None:
        if isinstance(value, Mapping):
            value = list(value.items())
        if isinstance(value, list | tuple):
            found.update(f"[{len(value)}".encode())
            for one in value:
                add(one)
        elif hasattr(value, "__array__"):
            array = np.asarray(value)
            found.update(f"{array.dtype}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        else:
            found.update(f"{portable_repr(value)};".encode())

    add(part)
    return _DIGEST + found.hexdigest()


def _encoded(value: Any) -> dict[str, Any]:
    """An array as JSON holds it."""
    array = np.asarray(value)
    if array.dtype.hasobject:
        raise TypeError(f"{type(value).__name__} cannot be kept in a store")
    return {_ARRAY: array.dtype.str, "shape": array.shape, "data": base64.b64encode(array.tobytes()).decode()}


def _decoded(table: dict[str, Any]) -> Any:
    if _ARRAY not in table:
        return table
    array = np.frombuffer(base64.b64decode(table["data"]), table[_ARRAY]).reshape(table["shape"])
    return array.copy() if array.shape else array[()]
