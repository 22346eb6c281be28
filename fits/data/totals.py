"""Hemispherical reflectance and transmittance and collimated transmittance, as integrating spheres measure them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from fits.data.geometry import LIGHT_AZIMUTH, direction
from fits.data.measurements import Floats, Measurements, channel_names
from fits.data.spheres import Spheres

Kind = Literal["reflectance", "transmittance", "unscattered"]
KINDS: tuple[Kind, ...] = get_args(Kind)
"""Hemispherical reflectance, hemispherical transmittance, and its collimated (unscattered) part."""


@dataclass(frozen=True, eq=False)
class Totals(Measurements):
    """N hemispherical or collimated values in C channels, each for one incident direction; see `of`.

    Args:
        wi: (N, 3), towards the light, in the upper hemisphere.
        wo: (N, 3), specular or undeviated direction, in the hemisphere that the light is measured in.
        values, sigma: (N, C), shares of the incident light, in [0, 1].
        kinds: N names, of `KINDS`.
        spheres: integrating spheres, which the model then includes; None for values of the sample itself.
    """

    kinds: tuple[Kind, ...] = ()
    spheres: Spheres | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.kinds) != len(self.values):
            raise ValueError(f"kinds has {len(self.kinds)} names, must be {len(self.values)}")
        if unknown := [kind for kind in self.kinds if kind not in KINDS]:
            raise ValueError(f"kinds holds {unknown[0]!r}, must be one of {', '.join(KINDS)}")
        if (self.values < 0).any():
            raise ValueError(f"values holds {self.values.min():g}, must be at least 0")
        if (self.wi[:, 2] <= 0).any():
            raise ValueError("wi lies in the lower hemisphere; totals are of light from the upper one")

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
        """Totals at K incidences; None: not measured.

        Args:
            incidence: polar angles of the light, in [0, 90) degrees, one or (K,).
            reflectance, transmittance: hemispherical, with specular and collimated light; a number, (K,) or (K, C).
            unscattered: collimated transmittance: light that no medium has scattered.
            sigma: standard deviation of all values, or by the name of their kind.
            channels: C names.
            spheres: integrating spheres, if values are relative to their standard rather than those of the sample.

        Raises:
            ValueError: no value is given, an angle or value is out of range, or shapes do not agree.
        """
        angles = np.atleast_1d(np.asarray(incidence, float))
        if angles.ndim != 1 or not np.all((angles >= 0) & (angles < 90)):
            raise ValueError(f"incidence is {angles.tolist()}, must be in [0, 90) degrees")
        given = {"reflectance": reflectance, "transmittance": transmittance, "unscattered": unscattered}
        measured = {kind: _columns(kind, value, len(angles)) for kind, value in given.items() if value is not None}
        if not measured:
            raise ValueError("totals: give reflectance, transmittance or unscattered")
        count = {part.shape[1] for part in measured.values()}
        if len(count) > 1:
            raise ValueError(f"totals: {sorted(count)} channels are given, must be as many for every kind")
        names = tuple(channels) if channels is not None else channel_names(*count)
        sigmas = sigma if isinstance(sigma, Mapping) else dict.fromkeys(measured, sigma)
        if missing := measured.keys() - sigmas.keys():
            raise ValueError(f"sigma has nothing for {', '.join(sorted(missing))}")
        spreads = {kind: _columns("sigma", sigmas[kind], len(angles), *count) for kind in measured}
        wi = direction(angles, LIGHT_AZIMUTH)
        kinds = [kind for kind in KINDS if kind in measured for _ in angles]  # in the order of `measured`
        return cls(
            wi=np.tile(wi, (len(measured), 1)),
            wo=np.concatenate([wi * (-1, -1, 1 if kind == "reflectance" else -1) for kind in measured]),
            values=np.concatenate(list(measured.values())),
            sigma=np.concatenate(list(spreads.values())),
            mask=np.ones(len(kinds), bool),
            channels=names,
            kinds=tuple(kinds),
            spheres=spheres,
        )


def _columns(name: str, value: ArrayLike, rows: int, columns: int | None = None) -> Floats:
    """A number, (K,) or (K, C) as (K, C)."""
    array = np.asarray(value, float)
    array = array[:, None] if array.ndim == 1 else array
    try:
        return np.broadcast_to(array, (rows, columns or (array.shape[1] if array.ndim == 2 else 1))).copy()
    except ValueError:
        raise ValueError(f"{name} has shape {np.shape(value)}, must be a number, ({rows},) or ({rows}, C)") from None
