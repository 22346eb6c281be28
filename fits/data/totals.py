"""Shares of light that a sphere, or a detector behind the sample, takes in: totals beside the values of a BSDF."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fits.data.geometry import LIGHT_AZIMUTH, direction
from fits.data.measurements import Floats, Measurements, Source, channel_names
from fits.data.spheres import Spheres

Kind = Literal["reflectance", "transmittance", "unscattered"]
KINDS: tuple[Kind, ...] = get_args(Kind)
"""All light that leaves on the side of the light; all that leaves on the other; of this, what no medium scattered."""

BEYOND = 3.0
"""Standard errors above 1 from which a share, or what is reflected and transmitted together, is warned of."""


@dataclass(frozen=True, eq=False)
class Totals(Measurements):
    """N shares of light in C channels, each of light along one direction; see `of`.

    Args:
        wi: (N, 3), towards the light, above.
        wo: (N, 3), where a mirror, or nothing at all, would send it: it tells sides apart and nothing else.
        values, sigma: (N, C), shares of the light, in [0, 1].
        kinds: N names, of `KINDS`.
        spheres: that reflectance and transmittance were read by, and whose part in them the model takes on itself; None
            where they are of the sample alone.
    """

    kinds: tuple[Kind, ...] = ()
    spheres: Spheres | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.kinds) != len(self.values):
            raise ValueError(f"kinds has {len(self.kinds)} names, must be {len(self.values)}")
        for kind in self.kinds:
            if kind not in KINDS:
                raise ValueError(f"kinds holds {kind!r}, must be one of {', '.join(KINDS)}")
        if (self.values < 0).any():
            raise ValueError(f"values holds {self.values.min():g}, must be at least 0")
        if (self.wi[:, 2] <= 0).any():
            raise ValueError("wi lies below; totals are of light from above")

    @classmethod
    def of(
        cls,
        incidence: ArrayLike = 0.0,
        *,
        reflectance: ArrayLike | None = None,
        transmittance: ArrayLike | None = None,
        unscattered: ArrayLike | None = None,
        sigma: float | Mapping[str, ArrayLike] = 0.01,
        channels: Sequence[str] | None = None,
        spheres: Spheres | None = None,
    ) -> "Totals":
        """Totals at K incidences; those that are None were not read.

        Args:
            incidence: polar angles of the light, in [0, 90) degrees, one or (K,).
            reflectance, transmittance: all that leaves on either side, what passes straight included: one number, (K,),
                or (K, C).
            unscattered: what leaves on the other side and no medium has scattered.
            sigma: standard deviation of all of them, or of each kind by its name.
            channels: C names.
            spheres: if readings are those of integrating spheres, over a standard, rather than of the sample alone.

        Raises:
            ValueError: nothing is given, an angle or value is out of range, or shapes do not go together.

        Warns:
            UserWarning: shares that exceed 1, or 1 together, by more than 3 standard deviations; it names them.
        """
        angles = np.atleast_1d(np.asarray(incidence, float))
        if angles.ndim != 1 or not np.all((angles >= 0) & (angles < 90)):
            raise ValueError(f"incidence is {angles.tolist()}, must be in [0, 90) degrees")
        given = {"reflectance": reflectance, "transmittance": transmittance, "unscattered": unscattered}
        read = {kind: _columns(kind, value, len(angles)) for kind, value in given.items() if value is not None}
        if not read:
            raise ValueError("totals: give reflectance, transmittance or unscattered")
        count = {part.shape[1] for part in read.values()}
        if len(count) > 1:
            raise ValueError(f"totals: {sorted(count)} channels are given, must be as many for every kind")
        names = tuple(channels) if channels is not None else channel_names(*count)
        spread = {kind: _columns("sigma", _sigma_of(sigma, kind), len(angles), *count) for kind in read}
        wi = direction(angles, LIGHT_AZIMUTH)
        kinds = [kind for kind in KINDS if kind in read for _ in angles]
        found = cls(
            wi=np.tile(wi, (len(read), 1)),
            wo=np.concatenate([wi * (-1, -1, 1 if kind == "reflectance" else -1) for kind in KINDS if kind in read]),
            values=np.concatenate([read[kind] for kind in KINDS if kind in read]),
            sigma=np.concatenate([spread[kind] for kind in KINDS if kind in read]),
            mask=np.ones(len(kinds), bool),
            channels=names,
            source=Source("", "memory"),
            kinds=tuple(kinds),
            spheres=spheres,
        )
        for words in found.beyond():
            warnings.warn(words, stacklevel=2)
        return found

    def used(self) -> "Totals":
        """Only the samples that take part in fits."""
        keep: NDArray[np.bool_] = self.mask
        return replace(
            self,
            wi=self.wi[keep],
            wo=self.wo[keep],
            values=self.values[keep],
            sigma=None if self.sigma is None else self.sigma[keep],
            mask=self.mask[keep],
            kinds=tuple(kind for kind, kept in zip(self.kinds, keep, strict=True) if kept),
        )

    def beyond(self) -> list[str]:
        """What exceeds the light that there was by more than its errors allow, a sentence each."""
        sigma = np.zeros_like(self.values) if self.sigma is None else self.sigma
        words = [
            f"{self.kinds[row]} at {self.theta_i[row]:g} degrees, {self.channels[column]}, is "
            f"{self.values[row, column]:.4g}: more than 1 by more than {BEYOND:g} standard deviations"
            for row, column in zip(*np.nonzero(self.values > 1.0 + BEYOND * sigma), strict=True)
        ]
        rows = {kind: [k for k, own in enumerate(self.kinds) if own == kind] for kind in KINDS}
        for row in rows["reflectance"]:
            for other in rows["transmittance"]:
                if not np.allclose(self.wi[row], self.wi[other]):
                    continue
                both, error = self.values[row] + self.values[other], np.hypot(sigma[row], sigma[other])
                words += [
                    f"reflectance and transmittance at {self.theta_i[row]:g} degrees, {self.channels[column]}, are "
                    f"{both[column]:.4g} together: more than 1 by more than {BEYOND:g} standard deviations"
                    for column in np.flatnonzero(both > 1.0 + BEYOND * error)
                ]
        return words


def _columns(name: str, value: ArrayLike, rows: int, columns: int | None = None) -> Floats:
    """A number, (K,) or (K, C) as (K, C)."""
    array = np.asarray(value, float)
    array = array[:, None] if array.ndim == 1 else array
    try:
        return np.broadcast_to(array, (rows, columns or (array.shape[1] if array.ndim == 2 else 1))).copy()
    except ValueError:
        raise ValueError(f"{name} has shape {np.shape(value)}, must be a number, ({rows},) or ({rows}, C)") from None


def _sigma_of(sigma: float | Mapping[str, ArrayLike], kind: str) -> ArrayLike:
    if not isinstance(sigma, Mapping):
        return sigma
    if kind not in sigma:
        raise ValueError(f"sigma has nothing for {kind}")
    return sigma[kind]
