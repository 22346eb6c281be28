"""A search for the stack behind readings, in a directory with its report: what `layerjax search` does."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fits._files import write_together
from fits.data.measurements import Measurements
from fits.problem.instrument import Instrument
from fits.problem.noise import Noise
from fits.problem.parameters import Free, LogNormal
from fits.progress import Progress
from fits.reports.plots.data import as_png
from fits.structure_search import telling
from fits.structure_search.library import Library
from fits.structure_search.searching import STARTS, Search, search

REPORT, PICTURE = "search.html", "search.png"


@dataclass(frozen=True)
class Searching:
    """What is looked for, and how.

    Args:
        library, layers, instrument, starts, seed: see `fits.search`.
        noise: relative, beside the file's sigma; None: 0.05 without one.
        scale_sd: relative standard deviation of the global scale; 0: it is exact.
    """

    library: Library | None = None
    layers: int = 3
    noise: float | None = None
    scale_sd: float = 0.0
    instrument: Instrument | None = None
    starts: int = STARTS
    seed: int = 0


def search_into(
    directory: str | Path,
    data: Measurements,
    given: Searching,
    progress: Progress | None = None,
    budget: float | None = None,
) -> Search:
    """Look for the stack behind data, in a directory that keeps what was fitted, and write the report there.

    budget: minutes, see `fits.search`.
    """
    sd = given.scale_sd
    # far enough for four standard deviations
    scale = Free(1.0, float(np.exp(-4.0 * sd)), float(np.exp(4.0 * sd)), LogNormal(1.0, sd)) if sd > 0.0 else None
    found = search(
        data,
        given.library,
        layers=given.layers,
        noise=Noise() if given.noise is None else Noise(relative=given.noise),
        scale=scale,
        instrument=given.instrument,
        starts=given.starts,
        seed=given.seed,
        progress=progress,
        directory=directory,
        budget=budget,
    )
    picture = as_png(telling.search_picture(found))
    write_together(Path(directory), {PICTURE: picture, REPORT: telling.search_page(found).encode()})
    return found
