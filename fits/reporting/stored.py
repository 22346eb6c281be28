"""Parts of a fit as they stand in its directory."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fits.data.formats import read
from fits.data.measurements import Measurements

if TYPE_CHECKING:
    from fits.inference.fit_result import Alone

HELD_OUT = "held_out.csv"
"""Readings that were held out of a fit, as `write_csv` writes them."""


def held_out_of(directory: str | Path) -> Measurements | None:
    """The readings that the fit of a directory has not seen; None if none were kept."""
    path = Path(directory) / HELD_OUT
    return read(path, format="csv") if path.is_file() else None


def stored_number(value: float | str) -> float:
    """A number; what is not finite stands there as a word."""
    return float(value)


def stored_array(values: list[Any], *shape: int) -> np.ndarray:
    """Numbers in an array of this shape."""
    return np.array(values, dtype=float).reshape(shape)


def stored_alone(content: dict[str, Any]) -> "Alone":
    """The fit without errors that readings share."""
    from fits.inference.fit_result import Alone

    return Alone(
        values={name: stored_number(value) for name, value in content["values"].items()},
        errors={name: stored_number(value) for name, value in content["errors"].items()},
        chi_square=stored_number(content["chi_square"]),
        degrees_of_freedom=content["degrees_of_freedom"],
        log_likelihood=stored_number(content["log_likelihood"]),
        alike=stored_number(content["alike"]),
        pairs=content["pairs"],
    )
