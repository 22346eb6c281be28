"""Failures of tasks."""

import errno
from collections.abc import Callable
from typing import Any, NamedTuple

MOST_DEATHS = 3
"""A task is not repeated after so many deaths of its workers."""

FULL = (errno.ENOSPC, errno.EDQUOT)
"""Errors of a full disk, which affect every task."""


class Failure(NamedTuple):
    """Result of a task that failed; error: what it raised, on one line, or how its workers died."""

    error: str


def attempt(work: Callable[[Any, Any], Any], shared: Any, task: Any) -> Any:
    """The result of a task, or its failure; errors that end the run are raised."""
    try:
        return work(shared, task)
    except (ValueError, OSError) as error:
        if isinstance(error, OSError) and error.errno in FULL:
            raise
        return Failure(one_line(error))


def one_line(error: BaseException) -> str:
    """An error as the command line prints it."""
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror[0].lower()}{error.strerror[1:]}"
    return " ".join(str(error).split()) or type(error).__name__
