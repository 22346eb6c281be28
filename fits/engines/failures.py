"""What becomes of a task that fails."""

import errno
from collections.abc import Callable
from typing import Any, NamedTuple

MOST_DEATHS = 3
"""A task whose workers died so often is not tried again."""

FULL = (errno.ENOSPC, errno.EDQUOT)
"""Errors of a disk that is full: they meet every task."""


class Failure(NamedTuple):
    """In the place of a result; error: what the task raised, on one line, or how its workers died."""

    error: str


def attempt(work: Callable[[Any, Any], Any], shared: Any, task: Any) -> Any:
    """What `work` makes of a task, or its failure. What must end the run is raised."""
    try:
        return work(shared, task)
    except (ValueError, OSError) as error:
        if isinstance(error, OSError) and error.errno in FULL:
            raise
        return Failure(one_line(error))


def one_line(error: BaseException) -> str:
    """An error as the command line says it."""
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror[0].lower()}{error.strerror[1:]}"
    return " ".join(str(error).split()) or type(error).__name__
