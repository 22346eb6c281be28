"""The `layerjax` command: it runs one command, and reports its errors and its exit code.

Exit codes: 0 done; 1 done, but not to be relied on (a chain or a fit that did not converge); 2 bad input, bad usage, a
full disk or too little memory, named on stderr, with nothing written but what the same command resumes; 130
interrupted.
"""

import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import TextIOWrapper
from typing import Any

from fits.cli.arguments import build_parser
from fits.engines import one_line

MAX_MESSAGE = 1000  # characters of an error that are shown: JAX adds a table of all arrays to one of memory


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit code; bad usage leaves through `SystemExit` as argparse does."""
    if isinstance(sys.stdout, TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="replace")  # degrees and Greek are not in every encoding
    parser = build_parser()
    arguments = parser.parse_args(argv)
    if arguments.version:
        from layerjax import __version__

        print(f"layerjax {__version__}")
        return 0
    if arguments.command is None:
        parser.error("COMMAND is required")

    try:
        from fits.cli.commands import COMMANDS

        with warnings_in_one_line():
            code = COMMANDS[arguments.command](arguments)
        sys.stdout.flush()  # while an error can still be reported
        return code
    except KeyboardInterrupt as interrupt:
        print(f"layerjax: interrupted{f': {interrupt}' if str(interrupt) else ''}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output has gone, as in `layerjax info FILE | head`
        _end_output()
        return 0
    except Exception as error:
        _end_output()
        # JAX has an error of its own for memory
        memory = isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error)
        if arguments.traceback or not (memory or isinstance(error, ValueError | OSError | OverflowError)):
            raise  # an error of the program needs its traceback
        what = "memory is not enough: " if memory else "a number is too large: " * isinstance(error, OverflowError)
        print(f"layerjax: error: {what}{one_line(error):.{MAX_MESSAGE}}", file=sys.stderr)
        return 2


def _end_output() -> None:
    """Discards what cannot be written to stdout: Python would try again as it ends, and complain."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextmanager
def warnings_in_one_line() -> Iterator[None]:
    """Within it, a warning that is meant for users is a line on stderr, once; others name the line of the program."""
    usual, shown = warnings.showwarning, set[str]()

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        words = " ".join(str(message).split())
        if not issubclass(category, UserWarning):
            usual(message, category, *where, **more)
        elif words not in shown:
            shown.add(words)
            print(f"layerjax: warning: {words}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield
