"""Work that survives: what grows while it is computed, each finished piece a record of one SQLite file.

The starts of a fit, the steps of a chain, the candidates of a search and the rows of a batch are kept in this way. A
record is written in a transaction, so that a process which is killed, or a disk which is full, costs the record that
was being written and no other. SQLite's rollback journal is used, not its write-ahead log, which does not work on
network file systems.

One process writes, and holds a lock file beside the store while it does. Readers take a copy: they need no lock, change
nothing, and hold up nobody. Every record carries a checksum, and the store one over all of them, so that damage is
reported instead of read. A fingerprint says whose work the store holds; the work of another problem is refused.

    with Store.open("chain.store", fingerprint(data=values, seed=0)) as store:
        store.put("moves", {"kind": "stretch"})                        # one record a key, the last one counts
        store.append("steps", {"coords": coords, "log_prob": log_prob, "random_state": state})
    posterior = Store.read("chain.store")
    steps = posterior.all("steps")                                     # in the order in which they were appended

A record is what JSON can hold (lists come back in place of tuples), with numpy arrays anywhere inside: of a chain, for
instance, arrays (steps, walkers, P) and (steps, walkers) and the state of the random generator.
"""

import errno
import hashlib
import json
import re
import sqlite3
import tempfile
import threading
import zlib
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any, Self

import numpy as np

from fits._files import locked, require_there

APPLICATION = 0x6C6A7801
"""SQLite's application_id of a store; its last digits are the version of the layout."""
_LAYOUT = """
CREATE TABLE head (fingerprint TEXT, total INTEGER, checksum INTEGER);
CREATE TABLE records (number INTEGER PRIMARY KEY, key TEXT, checksum INTEGER, text TEXT, content BLOB);
"""
_ARRAY = "numpy"
_NO_ROOM = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR_WRITE, sqlite3.SQLITE_IOERR_FSYNC, sqlite3.SQLITE_IOERR_TRUNCATE)
_NO_ACCESS = (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PERM)
_LONGEST = 60  # letters of a value that a fingerprint shows


class Store:
    """The records of one file, by key; made by `Store.open` to write it, or by `Store.read`.

    Attributes:
        path: of the file.
        fingerprint: whose work it holds; empty before the first record was written.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection):
        self.path = path
        self._connection, self._turn = connection, threading.RLock()
        self.fingerprint, self._total = self._checked()

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
        with locked(path.with_name(f"{path.name}.lock"), str(path)), ExitStack() as stack:
            with _errors_of(path):
                if fresh:
                    for one in (path, _journal(path)):
                        one.unlink(missing_ok=True)
                _require_store(path)
                # the lock file is what keeps others out: SQLite's own locks do not hold on every file system
                place = f"{path.resolve().as_uri()}?nolock=1"
                connection = sqlite3.connect(place, uri=True, check_same_thread=False)
                stack.enter_context(closing(connection))
                connection.execute("PRAGMA synchronous = NORMAL")
                store = cls(path, connection)
                different = differences(store.fingerprint, fingerprint) if store.fingerprint else ""
                if different and not replace:
                    raise ValueError(another(path, different))
                if different or not store.fingerprint:
                    store._begin(dict(fingerprint))
            yield store

    @classmethod
    def read(cls, path: str | Path, fingerprint: Mapping[str, str] | None = None) -> Self:
        """The records as they are now, though another process may be writing: a copy in memory.

        fingerprint: of the problem, if the work of another one is to be refused.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is damaged, is no store, or holds the work of another problem.
        """
        path = Path(path)
        require_there(path)
        with _errors_of(path):
            _require_store(path)
            store = cls(path, _copied(path))
        if fingerprint is not None and store.fingerprint and (words := differences(store.fingerprint, fingerprint)):
            raise ValueError(another(path, words))
        return store

    def keys(self) -> list[str]:
        """Keys of all records, in the order in which they were written."""
        rows = self._records("SELECT key FROM records ORDER BY number")
        return list(dict.fromkeys(key for (key,) in rows))

    def get(self, key: str) -> Any:
        """The record of a key, the last one of several; None without any."""
        return found[-1] if (found := self.all(key)) else None

    def all(self, key: str) -> list[Any]:
        """The records that were appended to a key."""
        rows = self._records("SELECT text, content FROM records WHERE key = ? ORDER BY number", key)
        return [_decoded(text, content) for text, content in rows]

    def put(self, key: str, record: Any) -> None:
        """Keep a record in the place of what the key has."""
        self._write(key, record, replace=True)

    def append(self, key: str, record: Any) -> None:
        """Keep a record behind those that the key has."""
        self._write(key, record, replace=False)

    def _write(self, key: str, record: Any, replace: bool) -> None:
        text, content = _encoded(record)
        checksum = _checksum(key, text, content)
        with self._turn, _errors_of(self.path):
            total = self._total + checksum
            with self._connection:  # a transaction
                if replace:
                    for (old,) in self._select("SELECT checksum FROM records WHERE key = ?", (key,)):
                        total -= old
                    self._connection.execute("DELETE FROM records WHERE key = ?", (key,))
                self._connection.execute(
                    "INSERT INTO records (key, checksum, text, content) VALUES (?, ?, ?, ?)",
                    (key, checksum, text, content),
                )
                self._write_head(total)
            self._total = total

    def _begin(self, fingerprint: dict[str, str]) -> None:
        """Without records, of this problem."""
        with self._connection:
            self._connection.execute("BEGIN")
            for statement in ("DROP TABLE IF EXISTS head", "DROP TABLE IF EXISTS records", *_LAYOUT.split(";")):
                self._connection.execute(statement)
            self._connection.execute(f"PRAGMA application_id = {APPLICATION}")
            self.fingerprint, self._total = fingerprint, 0
            self._connection.execute("INSERT INTO head VALUES ('', 0, 0)")
            self._write_head(0)

    def _write_head(self, total: int) -> None:
        text = json.dumps(self.fingerprint)
        head = (text, total, _checksum(text, str(total), b""))
        self._connection.execute("UPDATE head SET fingerprint = ?, total = ?, checksum = ?", head)

    def _checked(self) -> tuple[dict[str, str], int]:
        """The fingerprint and the checksum over all records. ValueError if they are not as they were written."""
        ((application,),), tables = self._select("PRAGMA application_id"), self._select("SELECT * FROM sqlite_schema")
        if not application and not tables:
            return {}, 0  # killed before it was begun
        if application != APPLICATION or self._select("PRAGMA quick_check") != [("ok",)]:
            raise ValueError(damaged(self.path))
        text, total, checksum = self._select("SELECT fingerprint, total, checksum FROM head")[0]
        whole, found = checksum == _checksum(text, str(total), b""), 0
        for key, stored, *record in self._connection.execute("SELECT key, checksum, text, content FROM records"):
            whole &= stored == _checksum(key, *record)
            found += stored
        if not whole or found != total:
            raise ValueError(damaged(self.path))
        return json.loads(text), total

    def _records(self, statement: str, *values: str) -> list[Any]:
        if not self.fingerprint:
            return []
        with self._turn, _errors_of(self.path):
            return self._select(statement, values)

    def _select(self, statement: str, values: tuple[Any, ...] = ()) -> list[Any]:
        return self._connection.execute(statement, values).fetchall()


def holds_other_files(directory: Path, store: str) -> bool:
    """Whether there is no store of this name in a directory, but something that is not of one."""
    if not directory.is_dir() or (directory / store).is_file():
        return False
    return any(not one.name.startswith(store) for one in directory.iterdir())


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


def _encoded(record: Any) -> tuple[str, bytes]:
    """A record as JSON, and the numbers of its arrays one after the other."""
    content = bytearray()

    def place(value: Any) -> dict[str, Any]:
        array = np.asarray(value)
        if array.dtype.hasobject:
            raise TypeError(f"{type(value).__name__} cannot be kept in a store")
        content.extend(np.ascontiguousarray(array).tobytes())
        return {_ARRAY: array.dtype.str, "shape": array.shape}

    return json.dumps(record, default=place), bytes(content)


def _decoded(text: str, content: bytes) -> Any:
    begin = 0

    def taken(table: dict[str, Any]) -> Any:
        nonlocal begin
        if _ARRAY not in table:
            return table
        dtype, shape = np.dtype(table[_ARRAY]), tuple(table["shape"])
        count = int(np.prod(shape, dtype=int))
        array = np.frombuffer(content, dtype, count, begin).reshape(shape)
        begin += count * dtype.itemsize
        return array.copy() if shape else array[()]

    return json.loads(text, object_hook=taken)


def _checksum(key: str, text: str, content: bytes) -> int:
    return zlib.crc32(content, zlib.crc32(f"{len(key)} {key} {text}".encode()))


def _require_store(path: Path) -> None:
    """ValueError for a file that is something else."""
    if path.is_file():
        with open(path, "rb") as file:
            begin = file.read(16)
        if begin not in (b"", b"SQLite format 3\0"):
            raise ValueError(damaged(path))


def _copied(path: Path) -> sqlite3.Connection:
    """The last whole state of a database in memory, from its file and the journal of a writer at work or killed."""
    while True:
        before, content = _state(path), path.read_bytes()
        if _state(path) == before:  # nobody has written in the meantime
            break
    _, journal = before
    memory = sqlite3.connect(":memory:", check_same_thread=False)
    if not journal:
        if content:
            memory.deserialize(content)
        return memory
    with tempfile.TemporaryDirectory() as folder:  # SQLite takes back what was not finished
        copy = Path(folder) / "copy"
        copy.write_bytes(content)
        _journal(copy).write_bytes(journal)
        with closing(sqlite3.connect(copy)) as connection:
            connection.backup(memory)
    return memory


def _state(path: Path) -> tuple[bytes, bytes]:
    """What every transaction changes: the header, which counts them, and the journal."""
    journal = _journal(path)
    with open(path, "rb") as file:
        header = file.read(100)
    try:
        return header, journal.read_bytes()
    except FileNotFoundError:
        return header, b""


def _journal(path: Path) -> Path:
    return path.with_name(f"{path.name}-journal")


@contextmanager
def _errors_of(path: Path) -> Iterator[None]:
    """SQLite's errors in the block as those of the operating system that they are, or of a file that is damaged."""
    try:
        yield
    except sqlite3.Error as error:
        code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR)
        if code in _NO_ROOM:
            raise OSError(errno.ENOSPC, "No space left on device, or more than a quota allows", str(path)) from None
        if code == sqlite3.SQLITE_READONLY_DBMOVED:
            raise OSError(errno.ENOENT, "Removed, or replaced, while it was written", str(path)) from None
        if code & 0xFF in _NO_ACCESS:
            raise OSError(errno.EACCES, "Permission denied", str(path)) from None
        if code & 0xFF == sqlite3.SQLITE_IOERR:
            raise OSError(errno.EIO, "Input/output error", str(path)) from None
        raise ValueError(damaged(path)) from None
    except (UnicodeError, TypeError, LookupError):  # what stands there is of another kind
        raise ValueError(damaged(path)) from None
