"""A search in a directory: each structure as it is fitted, and what the closer looks found, so that it can go on.

search.json    which search it is
STRUCTURE/     a fit with noise alone, and STRUCTURE+closer/ one as it was looked at, as `save_fit` writes them
STRUCTURE.npz  what was left out, and the evidence
"""

import hashlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from fits._files import read_json, write_bytes, write_json
from fits.data.measurements import Measurements
from fits.inference.fit_result import Fit
from fits.inference.left_out import LeftOut
from fits.inference.marginal_likelihood import Evidence
from fits.reporting.results import load_fit, save_fit
from fits.structures.library import Structure

IDENTITY = "search.json"


class Kept:
    """What a directory holds of a search. Raises ValueError if it is another search's, or holds something else."""

    def __init__(self, directory: str | Path, data: Measurements, *settings: Any):
        self.directory = Path(directory)
        used = data.used()
        digest = hashlib.sha256(repr(settings).encode())
        for array in (used.wi, used.wo, used.values, np.zeros(0) if used.sigma is None else used.sigma):
            digest.update(np.ascontiguousarray(array, float).tobytes())
        identity = {"layerjax_search": 1, "of": digest.hexdigest()}
        path = self.directory / IDENTITY
        if path.is_file():
            if read_json(path).get("of") != identity["of"]:
                raise ValueError(f"{self.directory}: holds a search of other data, or with another library or settings")
            return
        if self.directory.exists() and any(self.directory.iterdir()):
            raise ValueError(f"{self.directory}: is not empty, and holds no search")
        self.directory.mkdir(parents=True, exist_ok=True)
        write_json(path, identity)

    def fit(self, structure: Structure, closer: bool) -> Fit | None:
        """The fit of a structure, if it is there."""
        path = self._place(structure, closer)
        return load_fit(path) if path.is_dir() else None

    def keep(self, structure: Structure, closer: bool, fit: Fit) -> None:
        """Write the fit of a structure."""
        save_fit(fit, self._place(structure, closer))

    def look(self, structure: Structure) -> tuple[LeftOut, Evidence] | None:
        """What a closer look found, if it is there."""
        path = self.directory / f"{_slug(structure)}.npz"
        if not path.is_file():
            return None
        with np.load(path, allow_pickle=False) as stored:
            count = int(stored["count"])
            left = LeftOut(
                groups=tuple(map(str, stored["groups"])),
                rows=tuple(stored[f"rows{number}"] for number in range(count)),
                log_density=stored["log_density"],
                converged=bool(stored["converged"]),
            )
            return left, Evidence(*map(float, stored["evidence"]))

    def keep_look(self, structure: Structure, left: LeftOut, evidence: Evidence) -> None:
        """Write what a closer look found."""
        content = io.BytesIO()
        arrays: dict[str, Any] = {f"rows{number}": rows for number, rows in enumerate(left.rows)}
        arrays["evidence"] = np.array([evidence.log, evidence.error, evidence.shape])
        arrays |= {"groups": np.array(left.groups), "count": len(left.groups), "converged": left.converged}
        np.savez(content, log_density=left.log_density, **arrays)
        write_bytes(self.directory / f"{_slug(structure)}.npz", content.getvalue(), force=True)

    def _place(self, structure: Structure, closer: bool) -> Path:
        return self.directory / (_slug(structure) + ("+closer" if closer else ""))


def _slug(structure: Structure) -> str:
    return "+".join(name.replace(" ", "-") for name in structure)
