"""A fitted map, read from its store as far as it has got, and what there is to say of it in a few numbers."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fits._lazy import shown_by
from fits.maps.store import FLAGS, KEY, Store

if TYPE_CHECKING:
    import zarr

Floats = NDArray[np.float64]
Quartiles = tuple[float, float, float]

SMOOTHED = "smoothed"
"""The group of the map with a spatial prior, see `fits.maps.spatial`."""


class FittedMap:
    """Parameters of every texel of a map, with errors and flags; arrays are read when they are accessed.

    Of a store that still grows the parts that are not there have flags of 0; asking again reads again.
    `map["values/base.albedo"]` is the array of zarr, to be read in parts.

    Attributes:
        path: of the store.
        names: of the parameters, as in `Problem.names`.
        units: of each parameter by name; "1" for plain ratios.
        shape: of the map.
        chunk: texels along each axis of what is written at once.
        attributes: what the store says of how it was made.
    """

    def __init__(self, path: str | Path):
        self._store = store = Store(path, "r")
        self.path, self.attributes = store.path, store.about
        self.names, self.units, self.shape, self.chunk = store.names, store.units, store.shape, store.chunk

    @property
    def values(self) -> Mapping[str, Floats]:
        """Fitted values by name, each of the map's shape, in the parameter's unit; NaN where nothing is fitted."""
        return _Arrays(self, "values")

    @property
    def errors(self) -> Mapping[str, Floats]:
        """Standard errors by name; NaN at a bound, infinite where nothing holds a parameter."""
        return _Arrays(self, "errors")

    @property
    def smoothed(self) -> Mapping[str, Floats] | None:
        """Values of the map with a spatial prior, by name; None if there was none."""
        return None if self.smoothing is None else _Arrays(self, f"{SMOOTHED}/values")

    @property
    def smoothed_errors(self) -> Mapping[str, Floats] | None:
        """Their standard errors by name, with the neighbours of a texel held where they are; None as `smoothed`."""
        return None if self.smoothing is None else _Arrays(self, f"{SMOOTHED}/errors")

    @property
    def smoothing(self) -> dict[str, Any] | None:
        """How the map was smoothed: its prior, rounds, largest moves, objective; None if it was not."""
        if not (self.path / SMOOTHED).is_dir():
            return None
        about: Any = self._store.root[SMOOTHED].attrs[KEY]
        return {name: one for name, one in about.items() if name != "arrays"}

    @property
    def reduced_chi_square(self) -> Floats:
        """Chi-square per degree of freedom of every texel."""
        return self.read("reduced_chi_square")

    @property
    def flags(self) -> NDArray[np.uint16]:
        """What became of every texel, in bits (see `has`); 0: it is not there yet."""
        return self.read("flags")

    @property
    def start(self) -> NDArray[np.int16]:
        """Which start the best fit came from; -1: a neighbour's values, -2: random ones, -32768: it is not fitted."""
        return self.read("start")

    @property
    def at_bound(self) -> NDArray[np.unsignedinteger]:
        """Which parameters are at a bound: bit p for `names[p]`."""
        return self.read("at_bound")

    @property
    def measurements(self) -> NDArray[np.uint32]:
        """How many measurements entered."""
        return self.read("measurements")

    @property
    def numerical_error(self) -> Floats | None:
        """Numerical error of the model, in standard deviations of the data; None for transports that have none."""
        return self.read("numerical_error") if "numerical_error" in self._store.types else None

    @property
    def done(self) -> float:
        """The share of texels that are there."""
        return float(np.count_nonzero(self.flags)) / float(np.prod(self.shape))

    def has(self, meaning: str) -> NDArray[np.bool_]:
        """Which texels have a flag.

        Args:
            meaning: "fitted", "converged", "at_bound", "poor" (chi-square above what noise and the pilot explain),
                "restarted", "masked", "too_few_measurements", "failed" (no finite value) or "unidentified".
        """
        if meaning not in FLAGS:
            raise ValueError(f"meaning: {meaning!r} given, must be one of {', '.join(FLAGS)}")
        return (self.flags & FLAGS[meaning]) != 0

    def option(self, name: str) -> Any:
        """A number of the `MapOptions` that the map was fitted with."""
        from fits.maps.options import MapOptions

        return self.attributes.get("options", {}).get(name, getattr(MapOptions, name))

    def __getitem__(self, path: str) -> "zarr.Array[Any]":
        own = path.removeprefix(f"{SMOOTHED}/")
        if own not in self._store.types or (own != path and self.smoothing is None):
            raise KeyError(f"{path!r} is not one of {', '.join(self._store.types)}")
        return self._store.root[path]  # type: ignore[return-value]

    def read(self, path: str) -> Any:
        """A whole array. ValueError, on one line, that names it: a chunk is damaged."""
        array = self[path]
        try:
            return np.asarray(array[...])
        except Exception as error:  # codecs raise what they like
            raise ValueError(f"{self.path}/{path}: damaged, {' '.join(str(error).split())}") from None

    def __repr__(self) -> str:
        size = " x ".join(map(str, self.shape))
        return f"<FittedMap of {size} texels, {100.0 * self.done:.4g} % done: {', '.join(self.names)}; {self.path}>"

    def _repr_html_(self) -> str:
        return str(shown_by("fits.maps.report.verdicts:fragment", self))


class _Arrays(Mapping[str, Floats]):
    """Arrays of a group by the names of parameters, each read when it is accessed."""

    def __init__(self, map: FittedMap, group: str):
        self._map, self._group = map, group

    def __getitem__(self, name: str) -> Floats:
        if name not in self._map.names:
            raise KeyError(f"{name!r} is not one of {', '.join(self._map.names)}")
        found: Floats = self._map.read(f"{self._group}/{name}")
        return found

    def __iter__(self) -> Iterator[str]:
        return iter(self._map.names)

    def __len__(self) -> int:
        return len(self._map.names)

    def __repr__(self) -> str:
        return f"<{self._group} of {', '.join(self)}, each {' x '.join(map(str, self._map.shape))}>"


def open_map(path: str | Path) -> FittedMap:
    """Open the store of a fitted map, finished or not.

    Raises:
        FileNotFoundError: nothing is there.
        ValueError: it is none, or its description is damaged.
    """
    return FittedMap(path)


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
        reduced_chi_square, measurements: quartiles.
        numerical_error: quartiles, in standard deviations of the data, and below what 95 % of the texels are; None
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
    measurements: Quartiles
    numerical_error: tuple[float, float, float, float] | None

    @property
    def fitted(self) -> int:
        """Texels with values."""
        return self.counts["fitted"]

    @property
    def converged(self) -> float:
        """The share of the fitted texels that converged; NaN if none is fitted."""
        return self.counts["converged"] / self.fitted if self.fitted else np.nan


def summarise(map: FittedMap) -> Summary:
    """The numbers of a map as far as it has got; arrays are read one after the other."""
    flags = map.flags  # first: a texel that has them has everything
    fitted = (flags & FLAGS["fitted"]) != 0
    bounds, numerical = map.at_bound[fitted].astype(np.uint64), map.numerical_error
    errors = {name: map.errors[name][fitted] for name in map.names}
    return Summary(
        texels=flags.size,
        there=int(np.count_nonzero(flags)),
        counts={name: int(np.count_nonzero(flags & bit)) for name, bit in FLAGS.items()},
        at_bound={
            name: int(np.count_nonzero(bounds >> np.uint64(place) & np.uint64(1)))
            for place, name in enumerate(map.names)
        },
        values={name: _quantiles(map.values[name][fitted]) for name in map.names},
        errors={name: _quantiles(error) for name, error in errors.items()},
        no_error={name: int(np.count_nonzero(~np.isfinite(error))) for name, error in errors.items()},
        reduced_chi_square=_quantiles(map.reduced_chi_square[fitted]),
        measurements=_quantiles(map.measurements[fitted].astype(float)),
        numerical_error=None if numerical is None else _quantiles(numerical[fitted], (0.25, 0.5, 0.75, 0.95)),
    )


def _quantiles(values: Floats, levels: tuple[float, ...] = (0.25, 0.5, 0.75)) -> Any:
    finite = values[np.isfinite(values)]
    return tuple(map(float, np.quantile(finite, levels))) if finite.size else (np.nan,) * len(levels)
