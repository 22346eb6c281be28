"""Atomic writes, checksums and lock files: a file is written whole or not at all, by one process at a time."""

import errno
import json
import math
import os
import secrets
import shutil
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

CHECKSUM = "checksum"
PARTIAL = ".partial"  # how names of directories end, here and in zarr, that have not been written to their end


def given_path(name: str, path: object) -> Path:
    """The path that an argument is. ValueError for one that is none."""
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"{name}: {' '.join(repr(path).split()):.60} is not the path of a file or directory")
    return Path(path)


def require_switch(name: str, value: object, *others: None) -> None:
    """ValueError for what is neither True nor False, nor None if that is given besides: any text is true."""
    if not isinstance(value, bool) and not (value is None and others):
        allowed = "True, False or None" if others else "True or False"
        raise ValueError(f"{name}: {' '.join(repr(value).split()):.60} is not {allowed}")


def require_file(path: Path) -> None:
    """FileNotFoundError if it does not exist, ValueError if it is no file: pipes cannot be read more than once."""
    require_there(path)
    if path.is_dir():
        raise ValueError(f"{path}: is a directory, must be a file")
    if not path.is_file():
        raise ValueError(f"{path}: is a pipe or a device, must be a file")


def require_there(path: str | Path, what: str = "no such file") -> None:
    """FileNotFoundError, which names the path, if it does not exist."""
    if not os.path.exists(path):
        raise FileNotFoundError(errno.ENOENT, what, str(path))


def require_free_place(path: Path, force: bool) -> None:
    """ValueError unless a file can be written there, and none would be overwritten without `force`."""
    if path.is_dir():
        raise ValueError(f"{path}: is a directory, must be a file")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: there is no directory {path.parent}")
    if path.exists() and not force:
        raise ValueError(f"{path}: the file exists already (--force, or force=True, overwrites it)")


def write_text(path: str | Path, text: str, force: bool = False) -> None:
    """Write a UTF-8 text file; an existing file is a ValueError unless `force`."""
    write_bytes(path, text.encode(), force)


def write_bytes(path: str | Path, content: bytes, force: bool = False) -> None:
    """Write a file atomically, by a temporary one beside it; an existing file is a ValueError unless `force`. An
    OSError names the file."""
    path = given_path("path", path)
    require_switch("force", force)
    require_free_place(path, force)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}{PARTIAL}")
    with named(path):
        try:
            temporary.write_bytes(content)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def replacing(target: Path) -> Iterator[Path]:
    """A new folder beside a directory that takes its place when the block ends well, and is removed when it does not.

    One process at a time may do so: the caller holds a lock.
    """
    restore(target)
    new, old = _scratch(target)
    try:
        new.mkdir()
        yield new
        if target.exists():
            target.rename(old)
        new.rename(target)
    finally:
        restore(target)


def restore(target: Path) -> None:
    """Tidy up what a process that was killed left beside a directory: half of a new one goes, an old one comes back."""
    new, old = _scratch(target)
    if old.exists() and not target.exists():
        old.rename(target)
    for left in (new, old):
        shutil.rmtree(left, ignore_errors=True)


def _scratch(target: Path) -> tuple[Path, Path]:
    return target.with_name(f".{target.name}.new{PARTIAL}"), target.with_name(f".{target.name}.old{PARTIAL}")


def write_json(path: Path, content: Mapping[str, Any], force: bool = False) -> None:
    """Write a JSON file that holds a checksum of itself; numbers that are not finite become "nan", "inf", "-inf"."""
    written = plain(content)
    write_text(path, json.dumps(written | {CHECKSUM: _checksum(written)}, indent=1) + "\n", force)


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object, of `write_json` or another program. ValueError for other content, or a wrong checksum."""
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not valid JSON: {error}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path}: holds a {type(content).__name__}, must be an object")
    checksum = content.pop(CHECKSUM, None)  # layerjax 0.1.0 wrote none
    if checksum is not None and checksum != _checksum(content):
        raise ValueError(f"{path}: damaged or changed since it was written, its checksum is not that of its content")
    return content


def text_checksum(path: Path) -> str:
    """Checksum of a text file, whatever its line ends: version control and editors may change those."""
    text = path.read_bytes().replace(b"\r\n", b"\n")
    return f"{zlib.crc32(text):08x}"


def _checksum(content: Mapping[str, Any]) -> str:
    return f"{zlib.crc32(json.dumps(content).encode()):08x}"


def plain(value: Any) -> Any:
    """The value as JSON holds it: mappings, lists and strings; numbers that are not finite are "nan", "inf", "-inf"."""
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if hasattr(value, "tolist"):
        return plain(np.asarray(value).tolist())
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Errors of the operating system in the block, such as a full disk, name this file."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None


@contextmanager
def locked(path: Path, what: str) -> Iterator[None]:
    """Hold a lock file for the block; it is released when the process ends, in whatever way. ValueError, with the
    number of the process that holds the lock, if another one does."""
    import filelock

    lock = filelock.FileLock(path)
    try:
        lock.acquire(blocking=False)
    except filelock.Timeout:
        holder = "unknown"
        with suppress(OSError):
            holder = path.read_text().strip() or holder
        raise ValueError(f"{what} is in use by another process ({holder}): one at a time may write it") from None
    try:
        with suppress(OSError):  # on a full disk the lock holds without a number in it
            path.write_text(f"{os.getpid()}\n")
        yield
    finally:
        with suppress(OSError):  # Windows does not delete open files
            path.unlink()  # while it is held: a process that opened it before sees that it is deleted
        lock.release()
