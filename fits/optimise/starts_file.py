"""The starts of a fit that have ended, kept in a file so that a fit which is killed does not begin again.

A text file: one line says which fit it belongs to, and one line a start where it ended, each with its checksum. A line
is written in one go as its start ends; a broken last line is as good as none.
"""

import hashlib
import json
import os
import zlib
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, NamedTuple, Self

import jax
import numpy as np
from numpy.typing import NDArray

import layerjax
from fits._files import locked, named, write_whole
from fits.optimise.descent import here
from fits.problem.problem import FittingProblem
from fits.problem.values import portable_repr

Solver = Literal["least_squares", "bounded"]
Floats = NDArray[np.float64]


class End(NamedTuple):
    """Where one start ended: physical vector (P,), cost, steps, whether it converged, whether it ran out of steps."""

    vector: Floats
    cost: float
    steps: int
    converged: bool
    unfinished: bool


class StartsFile:
    """A context manager: `ends` holds what was done before, by the number of the start, `add` keeps one more."""

    def __init__(self, path: str | Path, problem: FittingProblem, points: Floats, solver: Solver):
        self.path = Path(path)
        self.ends: dict[int, End] = {}
        self._fit = _identity(problem, points, solver)

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(locked(self.path.with_name(f"{self.path.name}.lock"), str(self.path)))
            whole = self._read()
            with named(self.path):
                descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o666)
                self._file = stack.enter_context(os.fdopen(descriptor, "r+b", buffering=0))
                self._file.truncate(whole)
                self._file.seek(whole)
            if not whole:
                self._write({"layerjax_starts": self._fit})
            self._open = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()

    def add(self, index: int, end: End) -> None:
        """Keep the end of the start with this number."""
        self.ends[index] = end
        self._write({"start": index, **end._asdict(), "vector": end.vector.tolist()})

    def _read(self) -> int:
        """Take in the lines of this fit up to the first that is not whole; returns their length in bytes."""
        whole = 0
        for line in self.path.read_bytes().splitlines(keepends=True) if self.path.is_file() else ():
            content = _checked(line)
            if content is None or (not whole and content.get("layerjax_starts") != self._fit):
                break
            if "start" in content:
                index, vector = content.pop("start"), np.array(content.pop("vector"), float)
                self.ends[int(index)] = End(vector=vector, **content)
            whole += len(line)
        return whole

    def _write(self, content: dict[str, Any]) -> None:
        # NaN and Infinity as Python's json has them: the file is read by nobody else
        text = json.dumps(content).encode()
        line = b"%08x %s\n" % (zlib.crc32(text), text)
        write_whole(self._file, line, self.path)


def _checked(line: bytes) -> dict[str, Any] | None:
    """The content of a line, None for one that is not whole."""
    checksum, _, text = line.rstrip(b"\n").partition(b" ")
    if not line.endswith(b"\n") or checksum != b"%08x" % zlib.crc32(text):
        return None
    return json.loads(text)


def _identity(problem: FittingProblem, points: Floats, solver: Solver) -> str:
    """A fingerprint of everything that the ends of the starts depend on."""
    arrays, static = problem.split_model
    told = portable_repr((layerjax.__version__, solver, problem.names, static.tree))
    digest = hashlib.sha256(told.encode())
    # a transport of the user's own may have changed its body under the same name
    for array in (*jax.tree.leaves(arrays), points, here(problem, points[0]).predicted):
        digest.update(repr((np.shape(array), str(np.asarray(array).dtype))).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
