"""Measured or simulated BSDF samples, in one convention whatever the file used.

Values are the BSDF in 1/sr without the cosine. Readers of files convert to it, and `Source` records the file's own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import Any, Self, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fits.data.geometry import TANGENT_COSINE, Floats, Pairs
from fits.data.scans import Angles, rows_of
from fits.names import QUANTITIES, Quantity

LARGEST, SMALLEST_SIGMA = 1e30, 1e-100
"""Bounds of |values| and of the standard deviations of used samples, in 1/sr: squared residuals are then finite."""


@dataclass(frozen=True)
class Source:
    """Origin of samples and the convention of their file.

    Args:
        path: the file; empty for data that were never in one.
        format: of the file, or "memory", "simulated".
        quantity: what the file held. "brdf": f in 1/sr; "brdf_cos": f |cos theta_o|; "reflectance_factor": pi f.
        notes: what a reader decided or skipped, one sentence each.
        attribution: whose data they are, and under which licence.
    """

    path: str
    format: str
    quantity: Quantity = "brdf"
    notes: tuple[str, ...] = ()
    attribution: str = ""


# what to do where something else is given for `Measurements`
TO_HAVE_THEM = "fits.read(path) reads a file, fits.Measurements(wi, wo, values, ...) holds arrays"


@dataclass(frozen=True, eq=False)
class Measurements(Pairs):
    """N measurements of a BSDF in C channels.

    Args:
        wi: (N, 3) unit vectors towards the light, pointing away from the surface.
        wo: (N, 3) unit vectors towards the viewer, pointing away from the surface.
        values: (N, C), BSDF in 1/sr without the cosine, at most 1e30 in size.
        sigma: (N, C), standard deviations in 1/sr, at least 1e-100 in used measurements; None if they are unknown.
        mask: (N,) bool, True for measurements that are used.
        channels: C names.
        source: origin of the data.

    Raises:
        ValueError: shapes do not agree, a number is not finite or too large, a direction is not a unit vector, or sigma
            is negative, or nearly zero in a measurement that is used.
    """

    wi: Floats
    wo: Floats
    values: Floats
    sigma: Floats | None
    mask: NDArray[np.bool_]
    channels: tuple[str, ...]
    source: Source = field(default=Source(path="", format="memory"))

    def __post_init__(self) -> None:
        if np.ndim(self.values) == 0:
            raise ValueError(f"values is {self.values!r:.60}, must be an array (N, C)")
        if isinstance(self.channels, str) or not isinstance(self.channels, Sequence):
            raise ValueError(f"channels is {self.channels!r:.60}, must be C names")
        count, channels = len(self.values), len(self.channels)
        shapes = {"wi": (count, 3), "wo": (count, 3), "values": (count, channels), "mask": (count,)}
        if self.sigma is not None:
            shapes["sigma"] = (count, channels)
        for name, shape in shapes.items():
            array = np.array(getattr(self, name), dtype=bool if name == "mask" else np.float64)
            if array.shape != shape:
                raise ValueError(f"{name} has shape {array.shape}, must be {shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"{name} holds {array[~np.isfinite(array)][0]}, must be finite")
            if (size := np.max(np.abs(array), initial=0.0)) > LARGEST:
                raise ValueError(f"{name} holds {size:g}, must be at most {LARGEST:g} in size")
            if name in ("wi", "wo") and (abs((length := np.linalg.norm(array, axis=-1)) - 1) > 1e-6).any():
                raise ValueError(f"{name} has length {length[abs(length - 1) > 1e-6][0]:g}, must be 1")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if self.sigma is not None:
            if (self.sigma < 0).any():
                raise ValueError(f"sigma is {self.sigma.min():g}, must be >= 0")
            if (least := np.min(self.sigma[self.mask], initial=np.inf)) < SMALLEST_SIGMA:
                words = f"must be > 0, at least {SMALLEST_SIGMA:g} (sigma=None where it is unknown)"
                raise ValueError(f"sigma is {least:g} in a sample that is used, {words}")

    def __repr__(self) -> str:
        note = "" if self.mask.all() else f", {np.count_nonzero(~self.mask):,} of them masked"
        name = self.source.path or f"{self.source.format} data"
        return f"<Measurements: {len(self):,} data points{note}, of {', '.join(self.channels)}, from {name}>"

    def used(self) -> Self:
        """Only the measurements that are used."""
        rows: dict[str, Any] = {}
        for name in ("wi", "wo", "values", "sigma", "mask", "kinds"):  # the last of `Totals`
            if (given := getattr(self, name, None)) is not None:
                rows[name] = tuple(compress(given, self.mask)) if isinstance(given, tuple) else given[self.mask]
        return replace(self, **rows)

    def where(self, keep: ArrayLike, note: str | None = None) -> "Measurements":
        """The same samples, masked where `keep` is False.

        Args:
            keep: (N,) bool.
            note: a sentence that is added to the source.

        Raises:
            ValueError: `keep` has another shape or type.
        """
        keep = np.asarray(keep)
        if keep.dtype != bool or keep.shape != self.mask.shape:
            raise ValueError(f"keep has shape {keep.shape} and type {keep.dtype}, must be {self.mask.shape} bool")
        changed = replace(self, mask=self.mask & keep)
        return changed if note is None else changed.noted(note)

    def select(
        self,
        *,
        incidence: Angles | None = None,
        azimuth: Angles | None = None,
        theta_o: Angles | None = None,
        in_plane: bool | None = None,
        channels: str | Sequence[str] | None = None,
    ) -> "Measurements":
        """The used samples that fulfil all of these, in these channels. Angles in degrees, to 0.5.

        Args:
            incidence: polar angles of the light.
            azimuth: planes of the viewer, from the plane of incidence; 0 and 180 are the same.
            theta_o: polar angles of the viewer, on either side of the normal.
            in_plane: whether the viewer lies in the plane of incidence.
            channels: their names.

        Angles are a number, several, or a ``slice(low, high)`` of all between two, ends included.

        Raises:
            ValueError: no argument is given, or the data hold no such sample.
        """
        angles: dict[str, Any] = {"incidence": incidence, "azimuth": azimuth, "theta_o": theta_o, "in_plane": in_plane}
        if channels is None and all(one is None for one in angles.values()):
            raise ValueError(f"select: no argument is given; it takes {', '.join(angles)} and channels")
        keep = self.mask & rows_of(self, **angles)
        if not keep.any():
            raise ValueError("select: no sample of the data fulfils all of this")
        part = self.where(keep).used()
        return part if channels is None else part.of_channels(channels)

    def drop(self, *, channels: str | Sequence[str] | None = None, **angles: Any) -> "Measurements":
        """The used samples that `select` does not choose by these angles, in all channels; or the other channels.

        Raises:
            ValueError: as `select`, no sample remains, or channels are given together with angles.
        """
        if channels is not None and angles:
            raise ValueError("drop: channels are given together with angles; drop one after the other")
        own = self.select(channels=channels, **angles).channels
        others = [name for name in self.channels if channels is None or name not in own]
        rest = (self if channels is not None else self.where(~rows_of(self, **angles))).used().of_channels(others)
        if not rest.values.size:
            raise ValueError("drop: no sample of the data remains")
        return rest

    def of_channels(self, names: str | Sequence[str]) -> "Measurements":
        """Only these channels, in the order of the data. ValueError for a channel that the data do not have."""
        names = [names] if isinstance(names, str) else names
        for name in names:
            if name not in self.channels:
                raise ValueError(f"channel {name} is not in the data; there are {', '.join(self.channels)}")
        columns = [column for column, name in enumerate(self.channels) if name in names]
        return replace(
            self,
            values=self.values[:, columns],
            sigma=None if self.sigma is None else self.sigma[:, columns],
            channels=tuple(self.channels[column] for column in columns),
        )

    def noted(self, *notes: str) -> "Measurements":
        """The same samples with notes added to their source."""
        return replace(self, source=replace(self.source, notes=self.source.notes + notes))


def to_bsdf(values: Floats, wo: Floats, quantity: Quantity) -> Floats:
    """BSDF in 1/sr from values (N, C) of `quantity` seen along wo (N, 3); also right for standard deviations.

    A product with the cosine says nothing about f in the tangent plane: such rows become 0, and readers mask them.
    """
    if quantity == "reflectance_factor":
        return values / np.pi
    if quantity == "brdf_cos":
        cosine = abs(wo[:, 2:])
        tangent = cosine < TANGENT_COSINE
        return np.where(tangent, 0.0, values / np.where(tangent, 1.0, cosine))
    return values


def check_quantity(quantity: str | None) -> Quantity | None:
    """The name of a quantity, or None; anything else is a ValueError."""
    if quantity is not None and quantity not in QUANTITIES:
        raise ValueError(f"quantity is {quantity!r}, must be one of {', '.join(QUANTITIES)}")
    return cast(Quantity | None, quantity)


def channel_names(count: int) -> tuple[str, ...]:
    """Names for channels that have none: value, or red, green, blue, or channel1, channel2, ..."""
    known: dict[int, Sequence[str]] = {1: ("value",), 3: ("red", "green", "blue")}
    return tuple(known.get(count, [f"channel{number}" for number in range(1, count + 1)]))
