"""What goes into commands and comes out: refused before any work begins, and shown after it."""

import os
import sys
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fits._files import require_free_place

if TYPE_CHECKING:
    from fits.data.reading import ReadOptions
    from fits.reports.tables import Table

DONE, DOUBTFUL = 0, 1


def use_jax() -> None:
    """Double precision, all cores, and compiled programs kept in the user's cache folder from one run to the next."""
    # XLA reads it as it is loaded: below 3 it prints an alarm, as an error, for every program that is slow to compile.
    # What fails is raised all the same.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    import jax

    from fits.engines import quieten
    from fits.problem.compilation import devices_of_cores
    from layerjax.compiling import keep_programs

    quieten()
    jax.config.update("jax_enable_x64", True)
    devices_of_cores()
    keep_programs()


def read_options(arguments: Namespace) -> "ReadOptions":
    """How files are read, from the options that the command has."""
    from fits.data.reading import ReadOptions

    names = ("min_retro_angle", "max_polar_angle", "select", "hold_out")
    masks: dict[str, Any] = {name: getattr(arguments, name) for name in names if hasattr(arguments, name)}
    return ReadOptions.parse(arguments.read, **masks)


def require_place(path: str | Path | None, force: bool, ending: str = "", what: str = "") -> None:
    """ValueError unless a file, if any, of this ending for this content can be written there, see `force`."""
    if path is not None and not str(path).lower().endswith(ending):
        raise ValueError(f"{path}: {what} can be written as {ending} only")
    if path is not None:
        require_free_place(Path(path), force)


def show(*what: "Table | str") -> None:
    """Prints sentences, and tables that have a row."""
    from fits.reports.tables import print_table

    for one in what:
        if isinstance(one, str):
            print(one)
        elif one.rows:
            print_table(one, sys.stdout)


@contextmanager
def hint(what: str) -> Iterator[None]:
    """An interrupt in the block says what became of the work."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(what) from None
