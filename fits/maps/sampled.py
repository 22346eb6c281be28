"""Posteriors of a few texels of a map, as its store keeps them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fits.maps import chunk_files

if TYPE_CHECKING:
    import zarr

Floats = NDArray[np.float64]

GROUP = "posterior"
"""Of the store."""

QUANTILES = (0.025, 0.16, 0.5, 0.84, 0.975)


@dataclass(frozen=True, eq=False)
class Sampled:
    """Posteriors of T texels with P parameters.

    Attributes:
        names: of the parameters.
        places: of the texels in the map, (T, rank).
        mean, sd: (T, P).
        quantiles: at `QUANTILES`, (T, P, 5).
        shift: from the fitted value to the mean, in standard errors, (T, P).
        ratio: standard deviation over standard error, (T, P): 1 where the error holds.
        converged: whether the chain was long enough, (T,).
    """

    names: tuple[str, ...]
    places: NDArray[np.int64]
    mean: Floats
    sd: Floats
    quantiles: Floats
    shift: Floats
    ratio: Floats
    converged: NDArray[np.bool_]


def sampled_in(
    root: "zarr.Group", names: Sequence[str], values: Mapping[str, Floats], errors: Mapping[str, Floats]
) -> Sampled | None:
    """What a store holds of posteriors; None if there are none. values, errors: of the map, by name."""
    if GROUP not in root or "texels" not in root[GROUP].attrs:  # written last
        return None
    group: Any = root[GROUP]
    places, mean, sd, quantiles, converged = (
        chunk_files.checked(group[name]) for name in ("places", "mean", "sd", "quantiles", "converged")
    )
    at = tuple(places.T)
    fitted, width = (np.stack([of[name][at] for name in names], axis=1) for of in (values, errors))
    with np.errstate(all="ignore"):
        shift, ratio = (mean - fitted) / width, sd / width
    return Sampled(tuple(names), places, mean, sd, quantiles, shift, ratio, converged)
