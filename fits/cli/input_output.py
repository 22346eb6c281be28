"""What goes into commands and comes out: refused before any work begins, and shown after it."""

import sys
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fits.data.reading import ReadOptions
    from fits.reports.tables import Table


def read_options(arguments: Namespace) -> "ReadOptions":
    """How files are read, from the options that the command has."""
    from fits.data.reading import ReadOptions

    names = ("min_retro_angle", "max_polar_angle", "select", "hold_out")
    masks: dict[str, Any] = {name: getattr(arguments, name) for name in names if hasattr(arguments, name)}
    return ReadOptions.parse(arguments.read, **masks)


def refuse_alone(arguments: Namespace, names: tuple[str, ...], needed: str) -> None:
    """ValueError for the first of these options that is given without the one that they belong to."""
    for name in names:
        if getattr(arguments, name) not in (None, ()):
            raise ValueError(f"--{name.replace('_', '-')} is given without --{needed}")


def require_free_place(arguments: Namespace, ending: str, what: str) -> None:
    """ValueError unless the file of --out has this ending and can be written; what: the content."""
    if Path(arguments.out).suffix.lower() != ending:
        raise ValueError(f"{arguments.out}: {what} can be written as {ending} only")
    refuse_existing(arguments.out, arguments.force)


def refuse_existing(path: str | Path | None, force: bool) -> None:
    """ValueError unless a file can be written there, and none would be overwritten without `force`."""
    if path is None:
        return
    if Path(path).is_dir():
        raise ValueError(f"{path}: is a directory, must be a file")
    if not Path(path).resolve().parent.is_dir():
        raise ValueError(f"{path}: there is no directory {Path(path).parent}")
    if Path(path).exists() and not force:
        raise ValueError(f"{path}: the file exists already (--force overwrites it)")


def show(*what: "Table | str") -> None:
    """Prints tables and sentences."""
    from fits.reports.tables import print_table

    for one in what:
        print(one) if isinstance(one, str) else print_table(one, sys.stdout)
