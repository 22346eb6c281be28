"""How far neighbouring texels of a map differ: what smoothness expects of it, and how it pulls at each of them.

All is said in the coordinate of the fit, the unit box: 0 and 1 are the bounds of a parameter, between which it runs in
the value, or in its logarithm for the priors `LogUniform` and `LogNormal`. Edges lead from each texel to those beside
it along the axes of the map, four in two dimensions. They join fitted texels alone.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from fits.maps.chunk_files import Block

Floats = NDArray[np.float64]
Kind = Literal["gaussian", "total_variation"]

FLAT = 0.1
"""Of the scale: below, a difference counts by its square in a total variation, which has no derivative at 0."""

SMALLEST, LARGEST = 1e-6, 1e6
"""Scales, as shares of a box."""


@dataclass(frozen=True)
class Smoothness:
    """What neighbouring texels of a map have in common, see `fits.fit_map`.

    Args:
        kind: "gaussian": a difference d between neighbours adds d² / (2 scale²) to minus the log-posterior, a Gaussian
            Markov random field; changes are gradual. "total_variation": it adds abs(d) / scale, or
            d² / (2 eps scale) + eps / (2 scale) where abs(d) < eps = scale / 10; areas are even and edges stay.
        scale: of the difference between neighbours, as a share of the box of a parameter (of the logarithms, for
            `LogUniform` and `LogNormal`): its standard deviation, or for a total variation its mean absolute value. A
            number for all parameters, or numbers by name, such as ``{"base.albedo": 0.02}`` (of all channels) or
            ``{"base.albedo[2]": 0.02}``; others are not smoothed. From 1e-6 to 1e6.
        rounds: at most so many, in each of which every texel is fitted again.

    Raises:
        ValueError: a field is not what it must be.
    """

    kind: Kind
    scale: float | Mapping[str, float]
    rounds: int = 10

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ValueError(f"Smoothness.kind is {self.kind!r}; it must be one of {', '.join(get_args(Kind))}")
        given = self.scale if isinstance(self.scale, Mapping) else {"": self.scale}
        if not given:
            raise ValueError("Smoothness.scale is empty; it must name a parameter, or be a number")
        where = {name: f"Smoothness.scale[{name!r}]" if name else "Smoothness.scale" for name in given}
        plain = {str(name): _checked(where[name], one) for name, one in given.items()}
        object.__setattr__(self, "scale", plain if isinstance(self.scale, Mapping) else plain[""])
        whole("Smoothness.rounds", self.rounds, 1)

    def scales(self, names: Sequence[str]) -> dict[str, float]:
        """Of those of these parameters that are smoothed, by name.

        Raises:
            ValueError: a scale is of none of them.
        """
        if not isinstance(self.scale, Mapping):
            return dict.fromkeys(names, self.scale)
        found: dict[str, float] = {}
        for name, scale in self.scale.items():
            mine = [one for one in names if name in (one, re.sub(r"\[\d+\]$", "", one))]
            if not mine:
                raise ValueError(f"Smoothness.scale names {name!r}; it must be one of {', '.join(names)}")
            # a channel's own goes before that of all channels
            found |= {one: scale for one in mine if one == name or one not in self.scale}
        return found

    def edges(self, names: Sequence[str]) -> "Edges":
        """What it says of a map with these parameters. Errors as those of `scales`."""
        found = self.scales(names)
        return Edges(self.kind, np.array([found.get(name, math.inf) for name in names]))


def _checked(field: str, value: object) -> float:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        number = math.nan
    if not SMALLEST <= number <= LARGEST:
        raise ValueError(f"{field} is {value!r}; it must be a number from {SMALLEST:g} to {LARGEST:g}")
    return number


def whole(field: str, value: object, least: int) -> int:
    """A whole number of at least so much; ValueError that names the field for anything else."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
        raise ValueError(f"{field} is {value!r}; it must be a whole number of at least {least}")
    return int(value)


@dataclass(frozen=True, eq=False)
class Edges:
    """What differences between neighbours cost.

    scales: of each parameter, (P,), infinite where it is not smoothed.
    """

    kind: Kind
    scales: Floats

    def cost(self, units: Floats, fitted: NDArray[np.bool_]) -> float:
        """Of all edges of a map, a part of minus its log-posterior.

        units: (map shape, P), in the unit box, finite where `fitted`, (map shape).
        """
        smoothed = np.isfinite(self.scales)
        scales, total = self.scales[smoothed], 0.0
        for axis in range(fitted.ndim):
            first, second = (_along(axis, cut, fitted.ndim) for cut in (slice(None, -1), slice(1, None)))
            both = fitted[first] & fitted[second]
            total += self._energies(units[second][both][:, smoothed] - units[first][both][:, smoothed], scales)
        return total

    def pull(self, units: Floats, fitted: NDArray[np.bool_], block: Block) -> tuple[Floats, Floats]:
        """What the neighbours of each texel of a block draw it to, and how strongly: (block shape, P) each.

        As a Gaussian prior has it: its centre in the unit box, and its precision, 0 where no edge ends. Its logarithm
        and that of the smoothness have the same slope where the texel is, and it lies below elsewhere: what lowers the
        cost with it lowers that with the smoothness at least as much.
        """
        around, there = _with_margin(units, fitted, block)
        smoothed, size = np.isfinite(self.scales), [one.stop - one.start for one in block]
        inner = tuple(slice(1, 1 + length) for length in size)
        centre, precision = np.zeros((2, *size, len(self.scales)))
        own, scales = around[inner][..., smoothed], self.scales[smoothed]
        total, moment = np.zeros((2, *own.shape))
        for axis, length in enumerate(size):
            for first in (0, 2):
                beside = (*inner[:axis], slice(first, first + length), *inner[axis + 1 :])
                joined, other = there[inner] & there[beside], around[beside][..., smoothed]
                weights = np.where(joined[..., None], self._weights(other - own, scales), 0.0)
                total += weights
                moment += weights * other
        precision[..., smoothed] = total
        centre[..., smoothed] = moment / np.where(total > 0.0, total, 1.0)
        return centre, precision

    def _energies(self, differences: Floats, scales: Floats) -> float:
        """The sum over differences (K, S) of S parameters."""
        if self.kind == "gaussian":
            return 0.5 * float(np.sum(np.square(differences / scales)))
        share, eps = np.abs(differences) / scales, FLAT
        return float(np.sum(np.where(share < eps, 0.5 * share**2 / eps + 0.5 * eps, share)))

    def _weights(self, differences: Floats, scales: Floats) -> Floats:
        """Precisions of the Gaussians that touch the priors of differences (..., S) from below."""
        weights = np.broadcast_to(1.0 / np.square(scales), differences.shape)
        if self.kind == "gaussian":
            return weights
        return weights / np.maximum(np.abs(differences) / scales, FLAT)


def _along(axis: int, cut: slice, rank: int) -> tuple[slice, ...]:
    return tuple(cut if one == axis else slice(None) for one in range(rank))


def _with_margin(units: Floats, fitted: NDArray[np.bool_], block: Block) -> tuple[Floats, NDArray[np.bool_]]:
    """A block with the texels around it, none of which is fitted beyond the edge of the map."""
    size = tuple(one.stop - one.start + 2 for one in block)
    around, there = np.zeros((*size, units.shape[-1])), np.zeros(size, bool)
    within = tuple(
        slice(max(one.start - 1, 0), min(one.stop + 1, length)) for one, length in zip(block, fitted.shape, strict=True)
    )
    inside = tuple(
        slice(part.start - one.start + 1, part.stop - one.start + 1) for part, one in zip(within, block, strict=True)
    )
    there[inside] = fitted[within]
    around[inside] = np.where(fitted[within][..., None], units[within], 0.0)
    return around, there
