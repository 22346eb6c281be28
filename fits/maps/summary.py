"""What there is to say of a fitted map in a few numbers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fits.maps.fitted_map import FittedMap
from fits.maps.store import FLAGS

Quartiles = tuple[float, float, float]


@dataclass(frozen=True)
class Summary:
    """Counts of texels, and quartiles over those that are fitted.

    Attributes:
        texels: of the map.
        there: of them that have been dealt with.
        counts: of each flag.
        at_bound: of texels at which a parameter is at a bound, for each parameter.
        values, errors: quartiles of each parameter and of its standard error, where they are finite; NaN if nowhere.
        no_error: texels at which a parameter is fitted, and has no finite error.
        reduced_chi_square, readings: quartiles.
        numerical_error: quartiles, in standard deviations of the readings, and below what 95 % of the texels are; None
            where the transport has none.
    """

    texels: int
    there: int
    counts: dict[str, int]
    at_bound: dict[str, int]
    values: dict[str, Quartiles]
    errors: dict[str, Quartiles]
    no_error: dict[str, int]
    reduced_chi_square: Quartiles
    readings: Quartiles
    numerical_error: tuple[float, float, float, float] | None

    @property
    def fitted(self) -> int:
        """Texels with values."""
        return self.counts["fitted"]

    @property
    def converged(self) -> float:
        """The share of the fitted texels that converged; NaN if none is fitted."""
        return self.counts["converged"] / self.fitted if self.fitted else np.nan


def summarised(map: FittedMap) -> Summary:
    """The numbers of a map as far as it has got; arrays are read one after the other."""
    flags = map.flags  # first: a texel that has them has everything
    fitted = (flags & FLAGS["fitted"]) != 0
    at_bound = map.at_bound[fitted]
    values, errors, no_error = {}, {}, {}
    for name in map.names:
        values[name] = _quartiles(map.values[name][fitted])
        error = map.errors[name][fitted]
        errors[name], no_error[name] = _quartiles(error), int(np.count_nonzero(~np.isfinite(error)))
    numerical = map.numerical_error
    return Summary(
        texels=flags.size,
        there=int(np.count_nonzero(flags)),
        counts={name: int(np.count_nonzero(flags & bit)) for name, bit in FLAGS.items()},
        at_bound={
            name: int(np.count_nonzero((at_bound >> at_bound.dtype.type(place)) & at_bound.dtype.type(1)))
            for place, name in enumerate(map.names)
        },
        values=values,
        errors=errors,
        no_error=no_error,
        reduced_chi_square=_quartiles(map.reduced_chi_square[fitted]),
        readings=_quartiles(map.readings[fitted].astype(float)),
        numerical_error=None if numerical is None else (*_quartiles(numerical[fitted]), _quantile(numerical[fitted])),
    )


def _quartiles(values: NDArray[np.float64]) -> Quartiles:
    finite = values[np.isfinite(values)]
    if not finite.size:
        return np.nan, np.nan, np.nan
    low, middle, high = np.quantile(finite, (0.25, 0.5, 0.75))
    return float(low), float(middle), float(high)


def _quantile(values: NDArray[np.float64], level: float = 0.95) -> float:
    finite = values[np.isfinite(values)]
    return float(np.quantile(finite, level)) if finite.size else np.nan
