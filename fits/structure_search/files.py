"""A search in a directory: each structure as it is fitted, and what the closer looks found, so that it can go on.

search.json     which search it is
STRUCTURE/      a fit with noise alone, and STRUCTURE+closer/ one as it was looked at, as `save_fit` writes them
STRUCTURE.json  what was left out, and the evidence
.STRUCTURE.json the incidences that were left out so far, until all of them were
"""

import hashlib
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from fits._files import locked, named, read_json, write_json
from fits.data.measurements import Measurements
from fits.optimise.result import Fit
from fits.prediction.cross_validation import CrossValidation
from fits.prediction.evidence import Evidence
from fits.reports.results import load_fit, save_fit
from fits.structure_search.library import Structure

Floats = NDArray[np.float64]

IDENTITY, LOCK = "search.json", "search.lock"


class Groups(dict[str, tuple[Floats, bool]]):
    """What a fit foretold of the groups that were left out of it so far, in a file: see `cross_validation.Done`.

    A file of another fit is not looked at. ValueError for one that is damaged.
    """

    def __init__(self, path: Path, fit: Fit):
        super().__init__()
        self._path, self._of = path, fit.vector.tolist()
        content = read_json(path) if path.is_file() else {}
        if content.get("of") == self._of:
            for name, one in content["groups"].items():
                super().__setitem__(
                    name, (np.array(one["log_density"], float).reshape(one["shape"]), bool(one["converged"]))
                )

    def __setitem__(self, name: str, found: tuple[Floats, bool]) -> None:
        super().__setitem__(name, found)
        groups = {
            name: {"log_density": density, "shape": density.shape, "converged": converged}
            for name, (density, converged) in self.items()
        }
        write_json(self._path, {"of": self._of, "groups": groups}, force=True)


class Kept:
    """What a directory holds of a search: a context manager, while one process writes there.

    Raises ValueError on entry if it is another search's, is in use, or holds something else.
    """

    def __init__(self, directory: str | Path, data: Measurements, *settings: Any):
        self.directory = Path(directory)
        used = data.used()
        digest = hashlib.sha256(repr(settings).encode())
        for array in (used.wi, used.wo, used.values, np.zeros(0) if used.sigma is None else used.sigma):
            digest.update(np.ascontiguousarray(array, float).tobytes())
        self._of = digest.hexdigest()

    def __enter__(self) -> Self:
        path = self.directory / IDENTITY
        if not path.is_file() and _holds_something(self.directory):
            raise ValueError(f"{self.directory}: is not empty, and holds no search")
        with named(self.directory):
            self.directory.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            stack.enter_context(locked(self.directory / LOCK, str(self.directory)))
            if not path.is_file():
                write_json(path, {"layerjax_search": 1, "of": self._of})
            elif read_json(path).get("of") != self._of:
                raise ValueError(f"{self.directory}: holds a search of other data, or with another library or settings")
            self._open = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()

    def fit(self, structure: Structure, closer: bool) -> Fit | None:
        """The fit of a structure, if it is there."""
        path = self._place(structure, closer)
        return load_fit(path) if path.is_dir() else None

    def keep(self, structure: Structure, closer: bool, fit: Fit) -> None:
        """Write the fit of a structure."""
        save_fit(fit, self._place(structure, closer))

    def look(self, structure: Structure) -> tuple[CrossValidation, Evidence] | None:
        """What a closer look found, if it is there. ValueError for a file that is damaged."""
        path = self._look(structure)
        if not path.is_file():
            return None
        content = read_json(path)
        try:
            groups = content["groups"]
            left = CrossValidation(
                groups=tuple(groups),
                rows=tuple(np.array(rows, np.int64) for rows in groups.values()),
                log_density=np.array(content["log_density"], float).reshape(content["shape"]),
                converged=bool(content["converged"]),
            )
            return left, Evidence(*(float(content["evidence"][part]) for part in ("log", "error", "shape")))
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path}: damaged: {error!r}") from None

    def keep_look(self, structure: Structure, left: CrossValidation, evidence: Evidence) -> None:
        """Write what a closer look found."""
        content = {
            "groups": dict(zip(left.groups, left.rows, strict=True)),
            "shape": left.log_density.shape,
            "log_density": left.log_density,
            "converged": left.converged,
            "evidence": {"log": evidence.log_evidence, "error": evidence.error, "shape": evidence.pareto_k},
        }
        write_json(self._look(structure), content, force=True)
        self._groups(structure).unlink(missing_ok=True)

    def groups(self, structure: Structure, fit: Fit) -> Groups:
        """What a closer look at this fit has found so far."""
        return Groups(self._groups(structure), fit)

    def _place(self, structure: Structure, closer: bool) -> Path:
        return self.directory / (_slug(structure) + ("+closer" if closer else ""))

    def _groups(self, structure: Structure) -> Path:
        return self.directory / f".{_slug(structure)}.json"

    def _look(self, structure: Structure) -> Path:
        return self.directory / f"{_slug(structure)}.json"


def _holds_something(directory: Path) -> bool:
    if not directory.is_dir():
        return directory.exists()
    return any(one.name != LOCK for one in directory.iterdir())


def _slug(structure: Structure) -> str:
    return "+".join(name.replace(" ", "-") for name in structure)
