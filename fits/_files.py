"""Writing files whole or not at all."""

import os
import tempfile
from pathlib import Path


def write_text(path: str | Path, text: str, force: bool = False) -> None:
    """Write a UTF-8 text file; an existing file is a ValueError unless `force`."""
    write_bytes(path, text.encode(), force)


def write_bytes(path: str | Path, content: bytes, force: bool = False) -> None:
    """Write a file by way of a temporary one beside it; an existing file is a ValueError unless `force`."""
    path = Path(path)
    if path.exists() and not force:
        raise ValueError(f"{path}: the file exists already (--force, or force=True, overwrites it)")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: there is no directory {path.parent}")
    descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
        os.chmod(temporary, permissions(0o666))  # mkstemp makes files that only their owner can read
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def permissions(mode: int) -> int:
    """The mode less what the user's umask takes away."""
    current = os.umask(0)
    os.umask(current)
    return mode & ~current
