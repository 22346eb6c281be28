"""Directions of the readings of a map: the same N pairs for all texels, or pairs of each texel's own."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fits.data.formats.csv import read_directions
from fits.data.geometry import Floats, Geometry, Pairs, direction
from fits.maps.sources import Block, Named, Place, Source, is_arrays, library, opened, words

VECTORS = ("wi", "wo")
ANGLES = ("theta_i", "phi_i", "theta_o", "phi_o")

_NORMAL = (0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Directions:
    """N pairs of directions, as unit vectors `wi` and `wo` or as angles in degrees.

    sources: by name, `VECTORS` or `ANGLES`. samples: N. over: the shape of the map if texels have their own, else ().
    common: the pairs if all texels have the same.
    """

    sources: Mapping[str, Source]
    samples: int
    over: tuple[int, ...]
    common: Geometry | None

    def read(self, block: Block, mask: np.ndarray | None = None) -> tuple[Floats, Floats]:
        """`wi` and `wo` of a block, (N, 3) if all texels have the same, else (block shape, N, 3).

        mask: (block shape), texels that take part; the directions of others are not looked at, and along the normal
        where they are none.

        Raises:
            ValueError: one cannot be read, is not finite, or not of length 1.
        """
        if self.common is not None:
            return self.common.wi, self.common.wo
        leading = [slice(*one.indices(size)) for one, size in zip(block, self.over, strict=False)]
        shape = (*(one.stop - one.start for one in leading), *self.over[len(leading) :])
        given = np.ones(shape, bool) if mask is None else mask
        found = _vectors({name: self._of(name, tuple(leading)) for name in self.sources}, given)
        return _checked("wi", found[0], shape, given, block), _checked("wo", found[1], shape, given, block)

    def digest(self) -> str:
        """What tells them from others, see `Source.digest`."""
        return " ".join(f"{name} {one.digest(len(self.over) if self._own(one) else 0)}" for name, one in self._items())

    def places(self) -> dict[str, Place | Floats] | None:
        """Where another process finds them; the numbers themselves if all texels have the same; None: only here."""
        if self.common is not None:
            return {"wi": self.common.wi, "wo": self.common.wo}
        found: dict[str, Place | Floats] = {}
        for name, one in self._items():
            place = one.place if self._own(one) else one.read()
            if place is None:
                return None
            found[name] = place
        return found

    def require_over(self, shape: tuple[int, ...]) -> None:
        """Refuse directions of texels that are not those of a map of this shape."""
        if self.over not in ((), shape):
            raise ValueError(
                f"geometry has directions of its own for a map of {self.over}, the readings are of {shape}"
            )

    @property
    def in_memory(self) -> bool:
        """Whether to look at all of them costs no reading."""
        return all(one.place is None and not library(one.array) for one in self.sources.values())

    def _items(self) -> list[tuple[str, Source]]:
        return sorted(self.sources.items())

    def _own(self, one: Source) -> bool:
        """Whether texels have their own of this source."""
        return len(one.shape) > len(self.over) > 0

    def _of(self, name: str, block: Block) -> Floats:
        one = self.sources[name]
        return one.read(block if self._own(one) else ())


def directions(geometry: Any, beside: Named | None, dims: tuple[str, ...] = ()) -> Directions:
    """The directions that were given, or where nothing is, those beside the readings.

    Args:
        geometry: `fits.Geometry` (or measurements, for where they were taken), a pair (wi, wo) of arrays, (N, 3) or
            (..., N, 3), a mapping of arrays by name, a csv of directions, or a file or object with the arrays `wi`,
            `wo`, or `theta_i`, `phi_i`, `theta_o`, `phi_o`, (N,) or (..., N), in degrees.
        beside: arrays by name beside the readings.
        dims: of the readings, in order, where axes have names.

    Raises:
        ValueError: they are not there, do not fit together, or, of those that all texels share, are no directions.
    """
    sources = {name: one.ordered(dims) for name, one in _named(geometry, beside).items()}
    shapes = {name: one.shape for name, one in sources.items()}
    own = 2 if "wi" in sources else 1
    for name, shape in shapes.items():
        if len(shape) < own or (own == 2 and shape[-1] != 3):
            wanted = "(N, 3) or (..., N, 3), the map's axes in front" if own == 2 else "(N,) or (..., N)"
            raise ValueError(f"{sources[name].where} ({name}) has shape {shape}, must be {wanted}")
    counts = {name: shape[-own] for name, shape in shapes.items()}
    over = {shape[:-own] for shape in shapes.values() if len(shape) > own}
    samples = next(iter(counts.values()))
    if len(set(counts.values())) > 1 or len(over) > 1 or samples == 0:
        told = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise ValueError(f"geometry: shapes {told} do not fit together, N and the map's axes must be the same")
    common = None
    if not over:
        whole = np.ones((), bool)
        wi, wo = _vectors({name: one.read() for name, one in sources.items()}, whole)
        common = Geometry(_checked("wi", wi, (), whole, ()), _checked("wo", wo, (), whole, ()))
    return Directions(sources, samples, next(iter(over), ()), common)


def _named(geometry: Any, beside: Named | None) -> dict[str, Source]:
    """The arrays of directions by their names."""
    if isinstance(geometry, str | Path) and Path(geometry).is_file() and not is_arrays(geometry):
        geometry = read_directions(Path(geometry))
    if isinstance(geometry, Pairs):
        geometry = (geometry.wi, geometry.wo)
    if isinstance(geometry, tuple | list):
        if len(geometry) != 2:
            raise ValueError(f"geometry has {len(geometry)} entries, must be two: wi and wo")
        geometry = dict(zip(VECTORS, geometry, strict=True))
    if isinstance(geometry, Mapping) and not library(geometry):
        return {name: _source(geometry[name], f"geometry {name}") for name in _known(geometry, "geometry")}
    found = beside if geometry is None else opened(geometry, "geometry")
    if isinstance(found, Source):
        raise ValueError(f"{found.where} is one array, must be directions by name: {_WANTED}")
    if found is None:
        raise ValueError(f"geometry is not given, and there is nothing beside the readings; it must be {_WANTED}")
    return {name: found.source(name) for name in _known(found, found.where)}


_WANTED = f"{' and '.join(VECTORS)}, or {', '.join(ANGLES)} in degrees"


def _known(group: Any, where: str) -> tuple[str, ...]:
    """The names of directions that stand there."""
    for names in (VECTORS, ANGLES):
        if all(name in group for name in names):
            return names
    raise ValueError(f"{where} has no directions, must hold {_WANTED}")


def _source(given: Any, where: str) -> Source:
    found = opened(given, where)
    return found.one(where.rpartition(" ")[2]) if isinstance(found, Named) else found


def _vectors(found: Mapping[str, Floats], given: np.ndarray) -> tuple[Floats, Floats]:
    """`wi` and `wo`, not finite where a polar angle of a texel that is not given is none."""
    if "wi" in found:
        return found["wi"], found["wo"]
    polar = {}
    for name in ("theta_i", "theta_o"):
        theta = found[name]
        out = (theta < 0.0) | (theta > 180.0)
        wrong = out & given[..., None]
        if wrong.any():
            first = np.broadcast_to(theta, wrong.shape)[wrong][0]
            raise ValueError(f"geometry: {name} is {first:g}, must be in [0, 180] degrees")
        polar[name] = np.where(out, np.nan, theta)
    return direction(polar["theta_i"], found["phi_i"]), direction(polar["theta_o"], found["phi_o"])


def _checked(name: str, w: Floats, shape: tuple[int, ...], given: np.ndarray, block: Block) -> Floats:
    """Vectors (..., N, 3) at the shape of a block, refused if one of a given texel is no direction."""
    w = np.broadcast_to(w, (*shape, *w.shape[-2:]))
    length = np.linalg.norm(w, axis=-1)
    bad = ~(np.abs(length - 1.0) <= 1e-6)
    if np.any(bad & given[..., None]):
        where = f" in block {words(block)}" if block else ""
        first = w[bad & given[..., None]][0]
        raise ValueError(f"geometry: {name} is {first.tolist()}{where}, must be finite and of length 1")
    return np.where(bad[..., None], _NORMAL, w)
