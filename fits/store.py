"""Work that survives: starts, chains, candidates of a search, rows of a batch, each piece a record of one SQLite file.

A record is written in a transaction, so that a process which is killed, or a disk which is full, costs the record that
was being written and no other; with SQLite's rollback journal, as its write-ahead log does not work on network file
systems. One process writes, and holds a lock file beside the store while it does. Readers take a copy: they need no
lock, change nothing, and hold up nobody. Every record carries a checksum, so that damage is reported instead of read. A
fingerprint says whose work the store holds; the work of another problem is refused.

    with Store.open("chain.store", fingerprint(data=values, seed=0)) as store:
        store.put("moves", {"kind": "stretch"})                   # one record a key, the last one counts
        store.append("steps", {"coords": coords, "log_prob": log_prob})
    steps = Store.read("chain.store").all("steps")                # in the order in which they were appended

A record is what JSON can hold (lists come back in place of tuples), with numpy arrays anywhere inside.
"""

import base64
import errno
import hashlib
import json
import re
import sqlite3
import tempfile
import threading
import zlib
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any, Self

import numpy as np

from fits._files import locked, named, require_there

APPLICATION = 0x6C6A7802  # SQLite's application_id of a store; its last digits are the version of the layout
_LAYOUT = "CREATE TABLE records (number INTEGER PRIMARY KEY, key TEXT, checksum INTEGER, text TEXT)"
_ARRAY, _WHOSE, _DIGEST = "numpy", "fingerprint", "sha256:"
_NO_ROOM = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR_WRITE, sqlite3.SQLITE_IOERR_FSYNC, sqlite3.SQLITE_IOERR_TRUNCATE)
_OF_SYSTEM = (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PERM, sqlite3.SQLITE_IOERR)
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
        self.fingerprint: dict[str, str] = self._checked()

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
    def read(cls, path: str | Path) -> Self:
        """The records as they are now, though another process may be writing: a copy in memory.

        FileNotFoundError: there is no such file. ValueError: it is damaged, or no store.
        """
        path = Path(path)
        require_there(path)
        with _errors_of(path):
            return cls(path, _copied(path))

    def get(self, key: str) -> Any:
        """The record of a key, the last one of several; None without any."""
        return found[-1] if (found := self.all(key)) else None

    def all(self, key: str) -> list[Any]:
        """The records that were appended to a key."""
        rows = self._select("SELECT text FROM records WHERE key = ? ORDER BY number", key) if self.fingerprint else []
        return [json.loads(text, object_hook=_decoded) for (text,) in rows]

    def put(self, key: str, record: Any) -> None:
        """Keep a record in the place of what the key has."""
        self._write(key, record, replace=True)

    def append(self, key: str, record: Any) -> None:
        """Keep a record behind those that the key has."""
        self._write(key, record, replace=False)

    def _write(self, key: str, record: Any, replace: bool) -> None:
        text = json.dumps(record, default=_encoded)
        row = (key, _checksum(key, text), text)
        with self._turn, _errors_of(self.path), self._connection:  # a transaction
            if replace:
                self._connection.execute("DELETE FROM records WHERE key = ?", (key,))
            self._connection.execute("INSERT INTO records (key, checksum, text) VALUES (?, ?, ?)", row)

    def _begin(self, fingerprint: dict[str, str]) -> None:
        """Without records, of this problem."""
        with self._connection:
            self._connection.execute("BEGIN")
            self._connection.execute("DROP TABLE IF EXISTS records")
            self._connection.execute(_LAYOUT)
            self._connection.execute(f"PRAGMA application_id = {APPLICATION}")
            self.fingerprint = fingerprint
            self._write(_WHOSE, fingerprint, replace=True)

    def _checked(self) -> dict[str, str]:
        """The fingerprint. ValueError if records are not as they were written."""
        ((application,),), tables = self._select("PRAGMA application_id"), self._select("SELECT * FROM sqlite_schema")
        if not application and not tables:
            return {}  # killed before it was begun
        if application != APPLICATION or self._select("PRAGMA integrity_check") != [("ok",)]:
            raise ValueError(damaged(self.path))
        rows = self._connection.execute("SELECT key, checksum, text FROM records ORDER BY number")
        if not all(stored == _checksum(key, text) for key, stored, text in rows):
            raise ValueError(damaged(self.path))
        ((whose,),) = self._select("SELECT text FROM records WHERE key = ?", _WHOSE)
        return json.loads(whose)

    def _select(self, statement: str, *values: str) -> list[Any]:
        with self._turn, _errors_of(self.path):
            return self._connection.execute(statement, values).fetchall()


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


def _checksum(key: str, text: str) -> int:
    return zlib.crc32(f"{len(key)} {key} {text}".encode())


def _copied(path: Path) -> sqlite3.Connection:
    """The last whole state of a database in memory, from its file and the journal of a writer at work or killed."""
    while True:
        before, content = _state(path), path.read_bytes()
        if _state(path) == before:  # nobody has written in the meantime
            break
    memory = sqlite3.connect(":memory:", check_same_thread=False)
    with tempfile.TemporaryDirectory() as folder:  # SQLite takes back what was not finished
        copy = Path(folder) / "copy"
        copy.write_bytes(content)
        if journal := before[1]:
            _journal(copy).write_bytes(journal)
        with closing(sqlite3.connect(copy)) as connection:
            connection.backup(memory)
    return memory


def _state(path: Path) -> tuple[bytes, bytes]:
    """What every transaction changes: the header, which counts them, and the journal."""
    with open(path, "rb") as file:
        header = file.read(100)
    with suppress(FileNotFoundError):
        return header, _journal(path).read_bytes()
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
        if code & 0xFF in _OF_SYSTEM:
            raise OSError(errno.EIO, str(error).capitalize(), str(path)) from None
        raise ValueError(damaged(path)) from None
    except (UnicodeError, TypeError, LookupError):  # what stands there is of another kind
        raise ValueError(damaged(path)) from None
