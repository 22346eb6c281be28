"""Parts of a fit as they stand in its directory."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fits.data.formats import read
from fits.data.measurements import Measurements, Source
from fits.data.spheres import Sphere, Spheres

if TYPE_CHECKING:
    from fits.optimise.result import WithoutDiscrepancy
    from fits.problem.problem import Problem
    from fits.problem.stack_file import ProblemFile

HELD_OUT = "held_out.csv"
"""Readings that were held out of a fit, as `write_csv` writes them."""


def held_out_of(directory: str | Path) -> Measurements | None:
    """The readings that the fit of a directory has not seen; None if none were kept."""
    path = Path(directory) / HELD_OUT
    return read(path, format="csv") if path.is_file() else None


def stored_problem(content: dict[str, Any], given: "ProblemFile", data: Measurements) -> "Problem":
    """What was fitted to what: the stack file, with what the fit chose beside it."""
    from fits.problem.problem import Problem
    from fits.problem.toml import transport_from_dict

    source = content["source"] | {"notes": tuple(content["source"]["notes"])}
    transport = transport_from_dict(content["transport"])  # with the resolution that the fit chose
    noise = given.noise if content["without_discrepancy"] is None else replace(given.noise, discrepancy=True)
    scale = given.scale if given.scale is not None else content["fixed_scale"]
    data = replace(data, source=Source(**source))
    return Problem(given.stack, data, transport, noise, scale, given.objective, given.instrument)


def stored_number(value: float | str) -> float:
    """A number; what is not finite stands there as a word."""
    return float(value)


def stored_array(values: list[Any], *shape: int) -> np.ndarray:
    """Numbers in an array of this shape."""
    return np.array(values, dtype=float).reshape(shape)


def stored_without_discrepancy(content: dict[str, Any] | None) -> "WithoutDiscrepancy | None":
    """The fit without errors that readings share."""
    from fits.optimise.result import WithoutDiscrepancy

    if content is None:
        return None

    return WithoutDiscrepancy(
        values={name: stored_number(value) for name, value in content["values"].items()},
        errors={name: stored_number(value) for name, value in content["errors"].items()},
        chi_square=stored_number(content["chi_square"]),
        degrees_of_freedom=content["degrees_of_freedom"],
        log_likelihood=stored_number(content["log_likelihood"]),
        residual_autocorrelation=stored_number(content["residual_autocorrelation"]),
        pairs=content["pairs"],
    )


def stored_spheres(content: "dict[str, Any] | None") -> Spheres | None:
    """The spheres that totals were read by."""
    if content is None:
        return None
    both = {name: None if content[name] is None else Sphere(**content[name]) for name in ("reflection", "transmission")}
    return Spheres(**(content | both))
