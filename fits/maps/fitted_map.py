"""A fitted map, read from its store as far as it has got."""

import json
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fits._files import require_there
from fits._lazy import shown_by
from fits.maps import chunk_files
from fits.maps.sampled import Sampled, sampled_in
from fits.maps.store import FLAGS, FORMAT, KEY, KIND, arrays_of

if TYPE_CHECKING:
    import zarr

Floats = NDArray[np.float64]

ROOT = "zarr.json"

SMOOTHED = "smoothed"
"""The group of the map smoothed, see `fits.maps.alternating`."""


class FittedMap:
    """Parameters of every texel of a map, with errors and flags; arrays are read when they are asked for.

    Of a store that still grows the parts that are not there are NaN, with flags of 0; asking again reads again.
    `map["values/base.albedo"]` is the array of zarr, to be read in parts.

    Attributes:
        path: of the store.
        names: of the parameters, as in `Problem.names`.
        units: of each parameter by name; "1" for plain ratios.
        shape: of the map.
        chunk: texels along each axis of what is written at once.
        attributes: what the store says of how it was made.
    """

    path: Path
    names: tuple[str, ...]
    units: dict[str, str]
    shape: tuple[int, ...]
    chunk: tuple[int, ...]
    attributes: dict[str, Any]

    def __init__(self, path: str | Path, attributes: Mapping[str, Any]):
        self.path, self.attributes = Path(path), dict(attributes)
        self.names, self.units = tuple(attributes["names"]), dict(attributes["units"])
        self.shape, self.chunk = tuple(attributes["shape"]), tuple(attributes["chunk"])

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
        """Values of the map with neighbours held together, by name; None if it was not smoothed."""
        return None if self.smoothing is None else _Arrays(self, f"{SMOOTHED}/values")

    @property
    def smoothed_errors(self) -> Mapping[str, Floats] | None:
        """Their standard errors by name, with the neighbours of a texel held where they are; None as `smoothed`."""
        return None if self.smoothing is None else _Arrays(self, f"{SMOOTHED}/errors")

    @property
    def smoothing(self) -> dict[str, Any] | None:
        """How the map was smoothed: what was asked for, rounds, largest moves, objective; None if it was not."""
        if not is_store(self.path / SMOOTHED):
            return None
        return _attributes(self.path / SMOOTHED)

    @property
    def reduced_chi_square(self) -> Floats:
        """Chi-square per degree of freedom of every texel."""
        return self._read("reduced_chi_square")

    @property
    def flags(self) -> NDArray[np.uint16]:
        """What became of every texel, in bits (see `has`); 0: it is not there yet."""
        return self._read("flags")

    @property
    def start(self) -> NDArray[np.int16]:
        """Which start the best end came from; -1: a neighbour's values, -2: random ones, -32768: it is not fitted."""
        return self._read("start")

    @property
    def at_bound(self) -> NDArray[np.unsignedinteger]:
        """Which parameters are at a bound: bit p for `names[p]`."""
        return self._read("at_bound")

    @property
    def readings(self) -> NDArray[np.uint32]:
        """How many readings entered."""
        return self._read("readings")

    @property
    def numerical_error(self) -> Floats | None:
        """Of the model, in standard deviations of the readings; None for transports that have none."""
        return self._read("numerical_error") if "numerical_error" in self._types else None

    @property
    def done(self) -> float:
        """The share of texels that are there."""
        return float(np.count_nonzero(self.flags)) / float(np.prod(self.shape))

    def has(self, meaning: str) -> NDArray[np.bool_]:
        """Which texels have a flag.

        Args:
            meaning: "fitted", "converged", "at_bound", "poor" (chi-square above what noise and the pilot explain),
                "restarted", "masked", "too_few_readings", "failed" (no finite value) or "unidentified".
        """
        if meaning not in FLAGS:
            raise ValueError(f"meaning: {meaning!r} given, must be one of {', '.join(FLAGS)}")
        return (self.flags & FLAGS[meaning]) != 0

    @property
    def posterior(self) -> Sampled | None:
        """Posteriors of a few texels beside their standard errors; None where `fit_map` was not asked for any."""
        return sampled_in(self._group, self.names, self.values, self.errors)

    def __getitem__(self, path: str) -> "zarr.Array[Any]":
        if path not in self._every:
            raise KeyError(f"{path!r} is not one of {', '.join(self._every)}")
        return self._group[path]  # type: ignore[return-value]

    def __repr__(self) -> str:
        size = " x ".join(map(str, self.shape))
        return f"<FittedMap of {size} texels, {100.0 * self.done:.4g} % done: {', '.join(self.names)}; {self.path}>"

    def _repr_html_(self) -> str:
        return str(shown_by("fits.maps.report.notebook:map_fragment", self))

    @cached_property
    def _types(self) -> dict[str, tuple[np.dtype, Any]]:
        return arrays_of(self.names, self.attributes["numerical_error"])

    @property
    def _every(self) -> dict[str, tuple[np.dtype, Any]]:
        """With the arrays of the map smoothed, where there are any."""
        if not is_store(self.path / SMOOTHED):
            return self._types
        plain = {name: one for name, one in self._types.items() if name.partition("/")[0] in ("values", "errors")}
        return self._types | {f"{SMOOTHED}/{name}": one for name, one in plain.items()}

    @cached_property
    def _group(self) -> "zarr.Group":
        import zarr

        return zarr.open_group(self.path, mode="r")

    def _read(self, name: str) -> Any:
        """A whole array. A damaged chunk is a ValueError that names it; zarr would tell of it in many words."""
        array, (dtype, _) = self[name], self._every[name]
        if not _is_plain(array):  # somebody wrote it anew, compressed
            return chunk_files.checked(array)
        whole = np.full(self.shape, array.fill_value, dtype)
        for place in chunk_files.grid(self.shape, array.chunks):
            values = chunk_files.read(self.path / name, place, dtype, array.chunks)
            if values is not None:
                block = chunk_files.block_at(place, self.shape, array.chunks)
                whole[block] = values[tuple(slice(one.stop - one.start) for one in block)]
        return whole


class _Arrays(Mapping[str, Floats]):
    """Arrays of a group by the names of parameters, each read when it is asked for."""

    def __init__(self, of: FittedMap, group: str):
        self._of, self._group = of, group

    def __getitem__(self, name: str) -> Floats:
        if name not in self._of.names:
            raise KeyError(f"{name!r} is not one of {', '.join(self._of.names)}")
        return self._of._read(f"{self._group}/{name}")

    def __iter__(self) -> Iterator[str]:
        return iter(self._of.names)

    def __len__(self) -> int:
        return len(self._of.names)

    def __repr__(self) -> str:
        return f"<{self._group} of {', '.join(self)}, each {' x '.join(map(str, self._of.shape))}>"


def _is_plain(array: "zarr.Array[Any]") -> bool:
    """Whether its chunks are files as `fits.maps.chunk_files` has them."""
    described: Any = array.metadata.to_dict()
    codecs = [dict(codec) for codec in described.get("codecs", ())]
    names, keys = [codec["name"] for codec in codecs], described.get("chunk_key_encoding", {})
    plain = names == ["bytes", "crc32c"] and _configured(codecs[0], "endian", "little") == "little"
    return plain and keys.get("name") == "default" and _configured(keys, "separator", "/") == "/"


def _configured(described: Mapping[str, Any], what: str, default: str) -> Any:
    return (described.get("configuration") or {}).get(what, default)


def is_store(path: str | Path) -> bool:
    """Whether this is a directory of zarr, of whatever content."""
    return (Path(path) / ROOT).is_file()


def is_ours(path: str | Path) -> bool:
    """Whether this is the store of a fitted map, be it damaged or of another version."""
    try:
        return _attributes(Path(path)).get("kind") == KIND
    except (ValueError, FileNotFoundError):
        return False


def open_map(path: str | Path) -> FittedMap:
    """Open the store of a fitted map, finished or not.

    Raises:
        FileNotFoundError: nothing is there.
        ValueError: it is none, or its description is damaged.
    """
    path = Path(path)
    attributes = _attributes(path)
    kind, version = attributes.get("kind"), attributes.get("format")
    if kind != KIND:
        raise ValueError(f"{path}: holds a {kind}, must be a {KIND}")
    if version != FORMAT:
        raise ValueError(f"{path}: is version {version} of the format, must be {FORMAT}")
    try:
        found = FittedMap(path, attributes)
        for name in found._types:
            array = found[name]
            if array.shape != found.shape:
                raise ValueError(f"{name} has shape {array.shape}, must be {found.shape}")
    except (LookupError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: damaged, {type(error).__name__} {' '.join(str(error).split())}") from None
    except OSError as error:
        raise ValueError(f"{path}: damaged, {' '.join(str(error).split())}") from None
    except ValueError as error:
        raise ValueError(f"{path}: damaged, {' '.join(str(error).split())}") from None
    return found


def _attributes(path: Path) -> dict[str, Any]:
    """What the root of a store says under our key; ValueError that says what `path` is instead."""
    must = f"must be the store of a {KIND}, as `layerjax fit-map` writes it"
    require_there(path, "no such file or directory")
    if not path.is_dir():
        raise ValueError(f"{path}: is a file, {must}")
    if not is_store(path):
        raise ValueError(f"{path}: is a directory without {ROOT}, {must}")
    try:
        described = json.loads((path / ROOT).read_bytes())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path / ROOT}: damaged, not valid JSON: {error}") from None
    if not isinstance(described, dict) or described.get("node_type") != "group":
        raise ValueError(f"{path}: is no group of zarr arrays, {must}")
    attributes = described.get("attributes")
    found = attributes.get(KEY) if isinstance(attributes, dict) else None
    if not isinstance(found, dict):
        raise ValueError(f"{path}: is a zarr group that is not ours, {must}")
    return found
