"""Readings of a map by blocks: values of every texel, their directions, standard deviations and a mask of texels.

A map is an array (..., N, C): texels along the leading axes, N readings of each, C channels; or (..., N) for one
channel. It may be far larger than memory: it is opened here, and read block by block.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fits.data.geometry import Floats, Geometry
from fits.maps.directions import Directions, directions
from fits.maps.sources import Block, Named, Place, Source, beside, opened, source, words

SAMPLE, CHANNEL = "sample", "channel"
"""Names of the axes of readings and of channels of an xarray DataArray; by them they are found wherever they stand."""

TOGETHER = 2**20  # directions in memory that are checked at a time


@dataclass(frozen=True)
class Portable:
    """Where another process finds the readings of a map: paths and names; what is small is there itself, directions and
    deviations (N,) that all texels share, and a mask that is only in memory."""

    values: Place
    directions: Mapping[str, Place | Floats]
    sigma: Place | Floats | None
    mask: Place | NDArray[np.bool_] | None

    def open(self) -> "Readings":
        """The readings, opened again. Errors as in `readings`."""
        return readings(self.values, self.directions, sigma=self.sigma, mask=self.mask)


@dataclass(frozen=True, eq=False)
class Readings:
    """The readings of a map, opened and not loaded.

    shape: of the map. samples: N, of each texel. channels: C. geometry: the directions if all texels have the same.
    """

    values: Source
    directions: Directions
    sigma: Source | None
    mask: Source | None
    shape: tuple[int, ...]
    channels: int

    @property
    def samples(self) -> int:
        return self.directions.samples

    @property
    def geometry(self) -> Geometry | None:
        return self.directions.common

    def read(self, block: Block) -> Floats:
        """The readings of a block, (block shape, N, C), in 1/sr; NaN stays NaN.

        Raises:
            ValueError: it cannot be read, whatever the reason; it names file and block.
        """
        return self._filled(self.values, self._whole(block))

    def read_sigma(self, block: Block) -> Floats | None:
        """Their standard deviations, (block shape, N, C), NaN where unknown, or of no use in a masked texel; None if
        there are none.

        Raises:
            ValueError: as `read`, or one of a texel that is not masked is not above 0.
        """
        if self.sigma is None:
            return None
        block = self._whole(block)
        found = self._filled(self.sigma, block)
        bad = (found <= 0.0) & self.read_mask(block)[..., None, None]
        if np.any(bad):
            raise ValueError(
                f"{self.sigma.where}: sigma is {found[bad][0]:g} in block {words(block)}, must be above 0, or NaN "
                "where it is unknown"
            )
        return np.where(found > 0.0, found, np.nan)

    def read_mask(self, block: Block) -> NDArray[np.bool_]:
        """Which texels of a block take part, (block shape): all if there is no mask. Errors as `read`."""
        block = self._whole(block)
        if self.mask is None:
            return np.ones([one.stop - one.start for one in block], bool)
        return self.mask.read(block) != 0.0

    def read_directions(self, block: Block) -> tuple[Floats, Floats]:
        """Unit vectors towards light and viewer: (N, 3) each if all texels have the same, else (block shape, N, 3).

        Raises:
            ValueError: as `read`, or one of a texel that is not masked is no direction. Those of masked texels are
                along the normal where they are none.
        """
        if self.geometry is not None:
            return self.geometry.wi, self.geometry.wo
        block = self._whole(block)
        return self.directions.read(block, self.read_mask(block))

    def digest(self) -> str:
        """What tells these readings from others: hashes of shapes, types and content, see `fits.maps.identity.alike`.

        Arrays up to 64 MiB enter whole, of longer ones blocks from all over them: a change between those is not seen,
        see `fits.maps.sources.Source.digest`. Names and dates of files do not enter: a copy is the same.
        """
        rank = len(self.shape)
        parts = [f"{self.shape} {self.samples} {self.channels}", self.directions.digest()]
        for one in (self.values, self.sigma, self.mask):
            parts.append("" if one is None else one.digest(rank if len(one.shape) > 1 or one is self.mask else 0))
        return ",".join(parts)

    @property
    def portable(self) -> Portable | None:
        """What another process opens them from, cheap to pickle; None if a large part of them is only in memory.

        Raises:
            ValueError: a small part that is only in memory cannot be read.
        """
        own, sigma, mask = self.directions.places(), self.sigma, self.mask
        if own is None or self.values.place is None:
            return None
        if sigma is not None and sigma.place is None and len(sigma.shape) > 1:
            return None
        return Portable(
            self.values.place,
            own,
            None if sigma is None else sigma.place or sigma.read(),
            None if mask is None else mask.place or self.read_mask(()),
        )

    def _whole(self, block: Block) -> Block:
        """The block with all its ends said, within the map."""
        if len(block) > len(self.shape) or any(one.step not in (None, 1) for one in block):
            raise ValueError(f"block is {block}, must be slices without a step along {len(self.shape)} axes")
        given = (*block, *[slice(None)] * (len(self.shape) - len(block)))
        return tuple(slice(*one.indices(size)[:2]) for one, size in zip(given, self.shape, strict=True))

    def _filled(self, one: Source, block: Block) -> Floats:
        """A block of values or their deviations at its full shape, (block shape, N, C)."""
        over = tuple(part.stop - part.start for part in block)
        if len(one.shape) > 1:
            block = tuple(slice(0, 1) if n == 1 else part for part, n in zip(block, one.shape, strict=False))
        found = one.read(block if len(one.shape) > 1 else ())
        if len(one.shape) < len(over) + 2:  # without an axis of channels
            found = found[..., None]
        shape = (*over, self.samples, self.channels)
        return found if found.shape == shape else np.broadcast_to(found, shape).copy()


def readings(values: Any, geometry: Any = None, *, sigma: Any = None, mask: Any = None) -> Readings:
    """Open the readings of a map.

    Each array may be one of numpy (mapped or not), a `zarr.Array`, an `h5py.Dataset`, an `xarray.DataArray`, or a path:
    of a .npy file, of an HDF5 file or zarr store that holds one array, or one of the argument's name, or
    ``file.h5:/name``, ``store.zarr:/name``. Axes of a DataArray that are called "sample" and "channel" are found
    wherever they stand; others are taken in their order.

    Args:
        values: (..., N, C), or (..., N) for one channel, BSDF in 1/sr. Where both fit it is (..., N, C). A reading that
            is NaN is left out.
        geometry: the directions, see `fits.maps.directions.directions`; None: they stand beside the values.
        sigma: standard deviations in 1/sr, above 0, (..., N, C) or (..., N), where axes of texels may be 1, or (N,).
            NaN leaves a reading out.
        mask: (...), truth values or whole numbers: which texels take part, others being 0.

    Raises:
        ValueError: an array is not there or no such array, or shapes do not fit together.
    """
    if isinstance(values, Readings):
        return values
    found, near = _values(values)
    along = directions(geometry, near, tuple(name for name in found.dims if name != CHANNEL))
    shape, channels = _told_apart(found, along.samples)
    along.require_over(shape)
    more = {
        name: None if given is None else source(given, name).ordered(found.dims)
        for name, given in (("sigma", sigma), ("mask", mask))
    }
    _require_fitting(more["sigma"], more["mask"], found, shape)
    whole = Readings(found, along, **more, shape=shape, channels=channels)
    if along.in_memory:  # what is wrong with them is told now
        rows = max(1, TOGETHER // (along.samples * math.prod(shape[1:])))
        for row in range(0, shape[0], rows):
            whole.read_directions((slice(row, row + rows),))
    return whole


def _values(given: Any) -> tuple[Source, Named | None]:
    """The values, with named axes in the order texels, readings, channels, and what lies beside them."""
    everything = opened(given, "values")
    found = everything.one("values") if isinstance(everything, Named) else everything
    near = everything if isinstance(everything, Named) else beside(found)
    if 0 in found.shape:
        raise ValueError(f"{found.where} has shape {found.shape}, must hold something along every axis")
    last = [name for name in (SAMPLE, CHANNEL) if name in found.dims]
    return found.ordered([*(name for name in found.dims if name not in last), *last]), near


def _told_apart(values: Source, samples: int) -> tuple[tuple[int, ...], int]:
    """The shape of the map, and how many channels it has."""
    shape, fitting = values.shape, []
    if len(shape) > 2 and shape[-2] == samples and (CHANNEL in values.dims or SAMPLE not in values.dims):
        fitting.append((shape[:-2], shape[-1]))
    if len(shape) > 1 and shape[-1] == samples and CHANNEL not in values.dims:
        fitting.append((shape[:-1], 1))
    if not fitting:
        raise ValueError(
            f"{values.where} has shape {shape}, the geometry {samples} pairs of directions: values must be "
            f"(..., {samples}, C), or (..., {samples}) for one channel, with an axis or more of texels"
        )
    return fitting[0]


def _require_fitting(sigma: Source | None, mask: Source | None, values: Source, shape: tuple[int, ...]) -> None:
    """Refuse deviations and a mask whose shapes are not those of the values and of the map."""
    alike, alone = values.shape[: len(shape) + 1], values.shape[len(shape) : len(shape) + 1]
    fitting = [values.shape, alike]
    if sigma is not None and sigma.shape != alone and not any(_broadcasts(sigma.shape, o, len(shape)) for o in fitting):
        raise ValueError(
            f"{sigma.where} has shape {sigma.shape}, sigma must be {values.shape}, {alike}, the same with 1 for axes "
            f"of texels, or {alone}"
        )
    if mask is not None and mask.shape != shape:
        raise ValueError(f"{mask.where} has shape {mask.shape}, a mask must have that of the map, {shape}")
    if mask is not None and mask.array.dtype.kind == "f":
        raise ValueError(f"{mask.where} holds {mask.array.dtype}, a mask must hold truth values or whole numbers")


def _broadcasts(shape: tuple[int, ...], full: tuple[int, ...], leading: int) -> bool:
    """Whether an array is of this shape, or has 1 in place of some of the leading axes."""
    same = len(shape) == len(full) and shape[leading:] == full[leading:]
    return same and all(one in (1, size) for one, size in zip(shape, full, strict=True))
