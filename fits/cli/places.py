"""Where a command may write: refused before any work begins, not after it."""

from argparse import Namespace
from pathlib import Path


def require_free_place(arguments: Namespace, ending: str, what: str) -> None:
    """Before any work: the file of --out can be written, and holds nothing that must stay."""
    if Path(arguments.out).suffix.lower() != ending:
        raise ValueError(f"{arguments.out}: {what} can be written as {ending} only")
    refuse_existing(arguments.out, arguments.force)


def refuse_existing(path: str | None, force: bool) -> None:
    """Before any work: a file can be written there, and none is there that must stay; None is no place at all."""
    if path is None:
        return
    if Path(path).is_dir():
        raise ValueError(f"{path}: is a directory, must be a file")
    if not Path(path).resolve().parent.is_dir():
        raise ValueError(f"{path}: there is no directory {Path(path).parent}")
    if Path(path).exists() and not force:
        raise ValueError(f"{path}: the file exists already (--force overwrites it)")
