"""Output files, refused before any work begins rather than after it."""

from argparse import Namespace
from pathlib import Path


def require_free_place(arguments: Namespace, ending: str, what: str) -> None:
    """ValueError unless the file of --out has this ending and can be written; what: the content."""
    if Path(arguments.out).suffix.lower() != ending:
        raise ValueError(f"{arguments.out}: {what} can be written as {ending} only")
    refuse_existing(arguments.out, arguments.force)


def refuse_existing(path: str | None, force: bool) -> None:
    """ValueError unless a file can be written there, and none would be overwritten without `force`."""
    if path is None:
        return
    if Path(path).is_dir():
        raise ValueError(f"{path}: is a directory, must be a file")
    if not Path(path).resolve().parent.is_dir():
        raise ValueError(f"{path}: there is no directory {Path(path).parent}")
    if Path(path).exists() and not force:
        raise ValueError(f"{path}: the file exists already (--force overwrites it)")
