"""The `layerjax` command: it runs one command, and reports its errors and its exit code.

Exit codes: 0 done; 1 done, but not to be relied on (a chain or a fit that did not converge); 2 bad input, bad usage, a
full disk or too little memory, named on stderr, with nothing written but what the same command resumes; 130
interrupted.
"""

import os
import sys
from collections.abc import Sequence
from io import TextIOWrapper

from fits.cli.arguments import build_parser
from fits.cli.interrupts import raised_again
from fits.engines.failures import one_line

MAX_MESSAGE = 1000
"""Characters of an error that are shown: JAX adds a table of all arrays to one of memory."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit code; bad usage leaves through `SystemExit` as argparse does."""
    if isinstance(sys.stdout, TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="replace")  # degrees and Greek are not in every encoding
    arguments = build_parser().parse_args(argv)

    try:
        from fits.cli import commands

        with raised_again():
            code = int(getattr(commands, arguments.command.replace("-", "_"))(arguments))
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
        if arguments.traceback or not (isinstance(error, ValueError | OSError | OverflowError) or _of_memory(error)):
            raise  # an error of the program needs its traceback
        print(f"layerjax: error: {_one_line(error)}", file=sys.stderr)
        return 2


def _end_output() -> None:
    """Discards what cannot be written to stdout: Python would try again as it ends, and complain."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _of_memory(error: Exception) -> bool:
    """Whether memory was not enough; JAX has an error of its own for it."""
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" in str(error))


def _one_line(error: Exception) -> str:
    words = f"{one_line(error):.{MAX_MESSAGE}}"
    if _of_memory(error):
        return f"memory is not enough: {words}"
    return f"a number is too large: {words}" if isinstance(error, OverflowError) else words
