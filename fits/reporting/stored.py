"""Parts of a fit as they stand in its JSON file."""

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from fits.inference.fit_result import Alone


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
